"""Paths of the files of a sequence below its folder, by its sequence.json."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal

from rsbench.core.rig import FRAMES, Side, views_of
from rsbench.dataset.channels import CHANNELS, channel_files

Shutter = Literal["rs", "gs"]
SHUTTERS: tuple[Shutter, Shutter] = ("rs", "gs")
MOST_TWINS = 64
MOST_FRAMES = 1000
"""A number in a manifest must not ask for a list of millions, nor does the next."""
_MOST_WHOLE_FRAMES = 1 << 14
"""Of one camera and time."""
_KINDS = (("rs", "png"), ("rs_depth", "exr"), ("gs", "png"), ("gs_depth", "exr"), ("poses", "csv"))
_VIEW = re.compile(r"(left|right)_(0|[1-9][0-9]*)(?=[./])")
_STACK = re.compile(r"gs_stack/left_0/[0-9]{4,}\.png")
_MATCHES = re.compile(r"matches/(0|[1-9][0-9]*)\.npz")
_TWIN = re.compile(r"gs_twin(|_depth|_exposed|_flow|_flow_mask|_moving|_gloss)/[0-9]{4,}/left_0\.(png|exr)")


def relative_files(frames: int) -> tuple[str, ...]:
    """What every sequence of so many frames has."""
    return tuple(f"{folder}/{side}_{frame}.{end}" for folder, end in _KINDS for side, frame in views_of(frames))


RELATIVE_FILES = relative_files(len(FRAMES))
"""Of a sequence of two frames."""


def clean_file(side: str, frame: int) -> str:
    """Only where a sensor is not ideal: the rolling-shutter frame that an ideal one would have seen."""
    return f"rs_clean/{side}_{frame}.png"


def is_of_sequence(name: str) -> bool:
    """Whether a path below a sequence's folder is one that rsbench writes."""
    first = _VIEW.sub("left_0", name)
    return first in _KNOWN or any(form.fullmatch(first) for form in (_STACK, _TWIN, _MATCHES))


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


def files_of(manifest: Mapping[str, Any]) -> tuple[str, ...]:
    """Paths that a sequence must have, by its sequence.json."""
    frames, rows = frames_of(manifest), twins_of(manifest)
    views = views_of(frames)
    clean = tuple(clean_file(*view) for view in views if manifest.get("sensor"))
    stacks = tuple(stack_file(*view, row) for view in views for row in range(whole_frames(manifest)))
    pictures = [("gs", *view, row, depth) for row in rows for depth in (False, True) for view in views]
    twins = tuple(picture_file(*each) for each in pictures)  # pyrefly: ignore[bad-argument-type]
    every = [("rs", *view, 0) for view in views] + [("gs", *view, row) for row in (0, *rows) for view in views]
    labels = tuple(moving_file(*each) for each in every if manifest.get("moving"))  # pyrefly: ignore[bad-argument-type]
    gloss = tuple(gloss_file(*each) for each in every if manifest.get("glossy"))  # pyrefly: ignore[bad-argument-type]
    shown = manifest.get("sensor") and manifest.get("exposed_twins") is True
    exposed = tuple(exposed_file(*view, row) for row in (0, *rows) for view in views if shown)
    own = relative_files(frames) + clean + stacks + twins + exposed + labels + gloss
    return own + channel_files(channels_of(manifest), rows, frames)


def stack_file(side: Side, frame: int, row: int) -> str:
    """The whole global-shutter image at a row's pose, where a dataset keeps those."""
    return f"gs_stack/{side}_{frame}/{row:04d}.png"


def whole_frames(manifest: Mapping[str, Any]) -> int:
    """How many whole frames each camera has at each time, by a sequence.json: one for each row, or none."""
    renderer, camera = manifest.get("renderer"), manifest.get("camera")
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


_KNOWN = {"sequence.json"} | {
    _VIEW.sub("left_0", name)
    for name in (
        *relative_files(1),
        clean_file("left", 0),
        exposed_file("left", 0),
        *(file(shutter, "left", 0) for file in (moving_file, gloss_file) for shutter in SHUTTERS),
        *channel_files(CHANNELS, frames=len(FRAMES) + 1),
    )
}
