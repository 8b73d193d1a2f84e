"""The layouts of others by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from rsbench.components.cards import choices
from rsbench.core.errors import RsbenchError
from rsbench.dataset.recording import Recording
from rsbench.interop.readers.carla import read_carla
from rsbench.interop.readers.colmap import read_colmap
from rsbench.interop.readers.euroc import read_euroc
from rsbench.interop.readers.fastec import read_fastec
from rsbench.interop.readers.stereo import read_kitti, read_middlebury

_TUM_RSVI = {"left": 0.0, "right": 29.4737e-6}
"""Line delays, s: D. Schubert et al., Rolling-Shutter Modelling for Direct Visual-Inertial Odometry, IROS 2019."""


def _read_tum_rsvi(folder: Path) -> list[Recording]:
    return read_euroc(folder, _TUM_RSVI)  # pyrefly: ignore[bad-argument-type]


FORMATS: Mapping[str, Callable[[Path], list[Recording]]] = {
    "carla-rs": read_carla,
    "colmap": read_colmap,
    "euroc": read_euroc,
    "fastec-rs": read_fastec,
    "kitti": read_kitti,
    "middlebury": read_middlebury,
    "tum-rsvi": _read_tum_rsvi,
}


def read_others(folder: Path, format_name: str) -> list[Recording]:
    """The recordings of a folder in some layout.

    Raises:
        RsbenchError: no such layout, or the folder does not have it.
    """
    if format_name not in FORMATS:
        raise RsbenchError(f"--from {format_name}: is no layout{choices(format_name, FORMATS)}")
    if not folder.is_dir():
        raise RsbenchError(f"{folder}: no such folder")
    return FORMATS[format_name](folder)
