"""Paths of the files of a sequence, relative to its folder, derived from its sequence.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from rsbench.core.rig import FRAMES, Side, views_of

Shutter = Literal["rs", "gs"]
SHUTTERS: tuple[Shutter, Shutter] = ("rs", "gs")
MOST_TWINS = 64
MOST_FRAMES = 1000
"""This limit and the next prevent a number in a manifest from creating huge lists."""
_MOST_WHOLE_FRAMES = 1 << 14
"""Largest number of whole frames of one camera at one time."""
_KINDS = (("rs", "png"), ("rs_depth", "exr"), ("gs", "png"), ("gs_depth", "exr"), ("poses", "csv"))


def relative_files(frames: int) -> tuple[str, ...]:
    """Return the files that every sequence of ``frames`` frames has."""
    return tuple(f"{folder}/{side}_{frame}.{end}" for folder, end in _KINDS for side, frame in views_of(frames))


def clean_file(side: str, frame: int) -> str:
    """Return the path of the frame that an ideal sensor would record; it exists only for other sensors."""
    return f"rs_clean/{side}_{frame}.png"


def picture_file(shutter: Shutter, side: str, frame: int, row: int = 0, depth: bool = False) -> str:
    """Return the path of an image or its depth; ``row`` is that of a global-shutter twin, in readout order."""
    folder = f"{'gs_twin' if row else shutter}{'_depth' if depth else ''}"
    return f"{folder}{f'/{row:04d}' if row else ''}/{side}_{frame}.{'exr' if depth else 'png'}"


def moving_file(shutter: Shutter, side: str, frame: int, row: int = 0) -> str:
    """Return the path of the labels of moving objects, if there are any; ``row`` as for ``picture_file``."""
    return _beside("moving", shutter, side, frame, row)


def gloss_file(shutter: Shutter, side: str, frame: int, row: int = 0) -> str:
    """Return the path of the mask of glossy surfaces, if there are any; ``row`` as for ``picture_file``."""
    return _beside("gloss", shutter, side, frame, row)


def exposed_file(side: str, frame: int, row: int = 0) -> str:
    """Return the path of a noise-free global-shutter image of the sensor; only if ``exposed_twins`` is set."""
    return _beside("exposed", "gs", side, frame, row)


def _beside(kind: str, shutter: Shutter, side: str, frame: int, row: int) -> str:
    return f"gs_twin_{kind}/{row:04d}/{side}_{frame}.png" if row else f"{shutter}_{kind}/{side}_{frame}.png"


def frames_of(manifest: Mapping[str, Any]) -> int:
    """Return the number of frames of each camera from a sequence.json; two if missing or invalid."""
    frames = manifest.get("frames")
    sound = isinstance(frames, int) and not isinstance(frames, bool) and len(FRAMES) <= frames <= MOST_FRAMES
    return frames if sound and isinstance(frames, int) else len(FRAMES)


def twins_of(manifest: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the rows of the global-shutter twins, except row 0, from a sequence.json; empty if invalid."""
    rows = manifest.get("twins")
    listed = rows if isinstance(rows, list) and len(rows) <= MOST_TWINS else []
    return tuple(row for row in listed if isinstance(row, int) and not isinstance(row, bool) and row > 0)


def stack_file(side: Side, frame: int, row: int) -> str:
    """Return the path of the whole global-shutter image at a row's pose, if a dataset keeps these images."""
    return f"gs_stack/{side}_{frame}/{row:04d}.png"


def whole_frames(manifest: Mapping[str, Any], side: str = "left") -> int:
    """Return the number of whole images per camera and frame from a sequence.json: one per row, or 0."""
    renderer, camera, cameras = (manifest.get(key) for key in ("renderer", "camera", "cameras"))
    camera = cameras.get(side) if isinstance(cameras, dict) else camera
    if not (isinstance(renderer, dict) and renderer.get("full_frames") is True and isinstance(camera, dict)):
        return 0
    height = camera.get("height")
    if any(manifest.get(key) in ("left", "right") for key in ("scan", "right_scan")):
        return 0  # its lines are columns
    return height if isinstance(height, int) and 0 < height <= _MOST_WHOLE_FRAMES else 0


def channels_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of channels in a sequence.json, including unknown ones; empty if it has no valid list."""
    names = manifest.get("channels")
    return tuple(name for name in names if isinstance(name, str)) if isinstance(names, list) else ()
