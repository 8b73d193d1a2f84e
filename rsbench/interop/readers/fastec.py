"""Fastec-RS (Liu et al., Deep Shutter Unrolling Network, CVPR 2020): frames of one camera and their truth.

A sequence is a folder with ``%03d_rolling.png``, ``%03d_global_first.png``, taken at the time of the first row,
and ``%03d_global_middle.png``, of row ``height // 2``. Rows are those of successive frames of a high-speed
camera that moves on from frame to frame: a readout ratio of 1. There is no calibration, depth or motion.
"""

from __future__ import annotations

from pathlib import Path

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import View
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.recording import Recording
from rsbench.pipeline.footage import read_frame
from rsbench.pipeline.one_camera_card import DEFAULT_FOCAL

_DIGITS = "[0-9][0-9][0-9]"


def read_fastec(folder: Path) -> list[Recording]:
    """Every sequence below a folder, or the folder itself.

    Raises:
        RsbenchError: no frame, or the first one of a sequence is no image.
    """
    places = sorted({path.parent for path in folder.rglob(f"{_DIGITS}_rolling.png")})
    if not places:
        raise RsbenchError(f"{folder}: holds no 000_rolling.png, as sequences of Fastec-RS do")
    return [_read(place, folder) for place in places]


def _read(place: Path, folder: Path) -> Recording:
    images: dict[View, Path] = {("left", frame): path for frame, path in _pictures(place, "rolling").items()}
    height, width = read_frame(next(iter(images.values()))).shape[:2]
    focal = DEFAULT_FOCAL * width
    kinds = (("global_first", 0), ("global_middle", height // 2))
    return Recording(
        name=place.name if place == folder else place.relative_to(folder).as_posix(),
        cameras={"left": PinholeCamera.centred(width, height, focal)},
        images=images,
        shutters={"left": RollingShutter(height=height, readout_ratio=1.0)},
        truths={
            ("left", frame, row): path for kind, row in kinds for frame, path in _pictures(place, kind).items()
        },
        notes=(f"no calibration: a focal length of {focal:g} px, the width, and a readout ratio of 1 are taken",),
    )


def _pictures(place: Path, kind: str) -> dict[int, Path]:
    """Files of images of one kind, by frame."""
    return {int(path.name[:3]): path for path in sorted(place.glob(f"{_DIGITS}_{kind}.png"))}
