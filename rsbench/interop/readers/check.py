"""Whether a recording is what its layout says: files, sizes, depth against poses, disparities against images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import Side
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.pipeline.footage import read_frame

_ROWS = 30
"""Steps to the row that sees a point; each leaves readout ratio times speed, rows per row, of the error."""
_TOLERANCE = 0.01
"""Relative difference of depths that agree: text has four decimals, and depth is interpolated between pixels."""
_TYPICAL = 2e-3
"""Median of the relative differences, at most: wrong poses, times or kinds of depth leave more."""
_SHARE = 0.8
_LEAST_DISPARITY_SHARE = 0.9


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How the depth of one frame agrees with that of the next one."""

    side: Side
    frames: tuple[int, int]
    pixels: int
    """That the other frame sees, and nothing before them."""
    share: float
    """Of them, that agree within a hundredth."""
    typical: float
    """Median of the relative differences."""

    @property
    def fault(self) -> str:
        """What is wrong with it; empty for nothing."""
        if self.pixels == 0 or (self.share >= _SHARE and self.typical <= _TYPICAL):
            return ""
        return (
            f"depth of {self.side} frames {self.frames[0]} and {self.frames[1]} do not agree under poses and row "
            f"times: {100 * self.share:.1f} % within {100 * _TOLERANCE:g} %, typically {self.typical:.1e} apart"
        )


def file_faults(recording: Recording, progress: Callable[[str], object] = str) -> Iterator[str]:
    """Images that are missing, unreadable, or not of their camera's size; ``progress`` gets their names."""
    for path, side in (
        *((path, side) for (side, _), path in recording.images.items()),
        *((path, side) for (side, *_), path in (*recording.truths.items(), *recording.masks.items())),
    ):
        camera = recording.cameras[side]
        progress(path.name)
        try:
            height, width = read_frame(path).shape[:2]
        except RsbenchError as error:
            yield str(error)
            continue
        if (width, height) != (camera.width, camera.height):
            yield f"{path}: is {width} x {height} pixels, its camera {camera.width} x {camera.height}"


def disparity_faults(recording: Recording) -> Iterator[str]:
    """Disparities of another size, or that lead out of the other image."""
    for (side, frame), read in recording.disparities.items():
        found, camera = read(), recording.cameras[side]
        if found.shape != (camera.height, camera.width):
            yield f"disparities of {side} frame {frame} are {found.shape[1]} x {found.shape[0]} pixels"
            continue
        other = recording.cameras["right" if side == "left" else "left"]
        shift = (found - (other.cx - camera.cx)) * (1.0 if side == "left" else -1.0)
        there = (np.arange(camera.width) - shift)[np.isfinite(found)]
        inside = float(np.mean((there >= -0.5) & (there <= other.width - 0.5))) if there.size else 0.0
        if inside < _LEAST_DISPARITY_SHARE:
            yield f"disparities of {side} frame {frame}: {100 * inside:.0f} % lead into the other image"


def agreements(recording: Recording) -> Iterator[Agreement]:
    """Of the depth maps of each camera, every two successive ones, as far as poses and row times are known."""
    for side in recording.cameras:
        frames = sorted(frame for each, frame in recording.depths if each == side)
        if side not in recording.poses or side not in recording.shutters:
            continue
        for first, second in pairwise(frames):
            yield _agreement(recording, side, first, second)


def _agreement(recording: Recording, side: Side, first: int, second: int) -> Agreement:
    camera, shutter = recording.cameras[side], recording.shutters[side]
    pose_at = recording.poses[side]
    depth, other = recording.depths[side, first](), recording.depths[side, second]()
    x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    seen = depth > 0.0
    pixels = np.stack([x[seen], y[seen]], axis=-1)
    in_camera = depth[seen][:, None] * camera.unproject(pixels)
    world = transform(inverse(pose_at(shutter.pixel_time(pixels, first, side))), in_camera)
    landed, points = pixels, world
    for _ in range(_ROWS):
        points = transform(pose_at(shutter.pixel_time(landed, second, side)), world)
        moved = camera.project(points)
        landed = np.where(np.isfinite(moved), moved, landed)
    inside = camera.contains(landed) & (points[:, 2] > 0.0)
    there = _sampled(other, landed[inside])
    difference = (there - points[inside, 2]) / points[inside, 2]
    difference = difference[np.isfinite(difference) & (difference > -10.0 * _TOLERANCE)]  # what hides it is nearer
    sizes = np.abs(difference)
    return Agreement(
        side=side,
        frames=(first, second),
        pixels=len(sizes),
        share=float(np.mean(sizes <= _TOLERANCE)) if len(sizes) else float("nan"),
        typical=float(np.median(sizes)) if len(sizes) else float("nan"),
    )


def _sampled(depth: FloatArray, pixels: FloatArray) -> FloatArray:
    """Depth (n,) at pixels (n, 2), its inverse interpolated: exact on planes; NaN where a neighbour has none."""
    with np.errstate(divide="ignore"):
        near = np.where(depth > 0.0, 1.0 / depth, np.nan)
    where = pixels.astype(np.float32)[None]
    with np.errstate(divide="ignore"):
        found = 1.0 / cv2.remap(near, where, None, cv2.INTER_LINEAR, borderValue=float("nan"))[0]
    return np.asarray(found, dtype=np.float64)
