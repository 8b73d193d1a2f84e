"""Paths of the files of a sequence below its folder, by its sequence.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from rsbench.core.rig import FRAMES, Side, views_of

Shutter = Literal["rs", "gs"]
SHUTTERS: tuple[Shutter, Shutter] = ("rs", "gs")
MOST_TWINS = 64
MOST_FRAMES = 1000
"""A number in a manifest must not ask for a list of millions, nor does the next."""
_MOST_WHOLE_FRAMES = 1 << 14
"""Largest number of whole frames of one camera at one time."""
_KINDS = (("rs", "png"), ("rs_depth", "exr"), ("gs", "png"), ("gs_depth", "exr"), ("poses", "csv"))


def relative_files(frames: int) -> tuple[str, ...]:
    """What every sequence of so many frames has."""
    return tuple(f"{folder}/{side}_{frame}.{end}" for folder, end in _KINDS for side, frame in views_of(frames))


def clean_file(side: str, frame: int) -> str:
    """Only where a sensor is not ideal: the rolling-shutter frame that an ideal one would have seen."""
    return f"rs_clean/{side}_{frame}.png"


def picture_file(shutter: Shutter, side: str, frame: int, row: int = 0, depth: bool = False) -> str:
    """Below the folder of a sequence; ``row``: of a global-shutter twin, counted as rows are read."""
    folder = f"{'gs_twin' if row else shutter}{'_depth' if depth else ''}"
    return f"{folder}{f'/{row:04d}' if row else ''}/{side}_{frame}.{'exr' if depth else 'png'}"


def moving_file(shutter: Shutter, side: str, frame: int, row: int = 0) -> str:
    """Labels of what moves in a picture, where anything does; ``row`` as of ``picture_file``."""
    return _beside("moving", shutter, side, frame, row)


def gloss_file(shutter: Shutter, side: str, frame: int, row: int = 0) -> str:
    """Where surfaces are glossy in a picture, where any is; ``row`` as of ``picture_file``."""
    return _beside("gloss", shutter, side, frame, row)


def exposed_file(side: str, frame: int, row: int = 0) -> str:
    """A global-shutter image as the sensor exposes it, without noise; only where ``exposed_twins`` is set."""
    return _beside("exposed", "gs", side, frame, row)


def _beside(kind: str, shutter: Shutter, side: str, frame: int, row: int) -> str:
    return f"gs_twin_{kind}/{row:04d}/{side}_{frame}.png" if row else f"{shutter}_{kind}/{side}_{frame}.png"


def frames_of(manifest: Mapping[str, Any]) -> int:
    """How many frames each camera has, by a sequence.json; two where it does not say."""
    frames = manifest.get("frames")
    sound = isinstance(frames, int) and not isinstance(frames, bool) and len(FRAMES) <= frames <= MOST_FRAMES
    return frames if sound and isinstance(frames, int) else len(FRAMES)


def twins_of(manifest: Mapping[str, Any]) -> tuple[int, ...]:
    """Rows of the global-shutter twins beside that of row 0, by a sequence.json; none where it lists none."""
    rows = manifest.get("twins")
    listed = rows if isinstance(rows, list) and len(rows) <= MOST_TWINS else []
    return tuple(row for row in listed if isinstance(row, int) and not isinstance(row, bool) and row > 0)


def stack_file(side: Side, frame: int, row: int) -> str:
    """The whole global-shutter image at a row's pose, where a dataset keeps those."""
    return f"gs_stack/{side}_{frame}/{row:04d}.png"


def whole_frames(manifest: Mapping[str, Any], side: str = "left") -> int:
    """How many whole frames a camera has at each time, by a sequence.json: one for each row, or none."""
    renderer, camera, cameras = (manifest.get(key) for key in ("renderer", "camera", "cameras"))
    camera = cameras.get(side) if isinstance(cameras, dict) else camera
    if not (isinstance(renderer, dict) and renderer.get("full_frames") is True and isinstance(camera, dict)):
        return 0
    height = camera.get("height")
    if any(manifest.get(key) in ("left", "right") for key in ("scan", "right_scan")):
        return 0  # its lines are columns
    return height if isinstance(height, int) and 0 < height <= _MOST_WHOLE_FRAMES else 0


def channels_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Names of the channels that a sequence.json lists, unknown ones too; what is no list of names has none."""
    names = manifest.get("channels")
    return tuple(name for name in names if isinstance(name, str)) if isinstance(names, list) else ()
