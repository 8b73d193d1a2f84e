"""Depth of both frames of one moving camera: a semi-global search along every pixel's own epipolar curve.

Dense flow follows gradients and loses what moves by more than its own size: posts, signs, branches. Where the
motion is known the flow of a pixel has one unknown, its inverse depth. Planes of it, evenly apart, are compared at
a fraction of the size (Zabih and Woodfill's census and the truncated difference of grey levels), aggregated
(``semiglobal``), and count where the other frame's sweep agrees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.vision.compiled_camera import across_lines
from rsbench.vision.frame_threads import map_frames
from rsbench.vision.motion_sweep import census, ones
from rsbench.vision.reprojection import (
    Reprojection,
    homography,
    land,
    parallax_gain,
    reproject_pixels,
    reprojection_of,
)
from rsbench.vision.semiglobal import aggregated, winners

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
_BIT, _LEVEL, _LEVELS = 6, 4, 16
"""Costs of a differing bit of 24 and of a grey level, of which at most so many count: 208 together."""
_NOWHERE = 90
"""Cost of a place outside the other frame, between those of like and of unlike places."""
_MEDIAN = 5
_FEWEST = 4
_COARSE, _REACH = 4, 0.2
"""Shrinking of the first search, at options of half the size, and its parallax, of the image's longer side."""
_TEXTURED, _TEXTURE_LEVELS = 5, 5.0
"""Side of a window, px, and the deviation of its grey levels; in a smooth sky anything looks alike."""
_NEAREST, _MARGIN, _MARGIN_PX = 0.998, 1.2, 2.0
_BYTES = 500.0
"""Per pixel of the swept frame: the volume and its sums."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions:
    """The search along the curves."""

    shrink: int = 2
    """Part of the frames' size at which they are compared: a half, a third."""
    step_px: float = 1.0
    """Parallax between two planes at that size."""
    planes: int = 128
    """At most so many."""
    window: int = 3
    """Side, px, of the square over which costs are averaged."""
    p1: int = 48
    """What a step to the next plane costs, of 255."""
    p2: int = 255
    """Of larger steps."""
    agree_px: float = 1.0
    """Largest difference of parallax to the other frame's, at that size."""

    def __post_init__(self) -> None:
        if not (self.shrink >= 1 and self.step_px > 0.0 and self.planes >= _FEWEST and self.agree_px > 0.0):
            raise ValueError(f"shrink, step_px, agree_px must be positive and planes at least {_FEWEST}: {self}")
        if self.window % 2 == 0 or not 0 <= self.p1 <= self.p2 <= 4000:
            raise ValueError(f"window must be odd and 0 <= p1 <= p2 <= 4000: {self}")


class Swept(NamedTuple):
    """Of one frame, at the size of the search."""

    rho: F32
    """(h, w) inverse depth in each row's own camera, in the motion's unit; at least 0."""
    agrees: Mask
    """(h, w) whether the other frame's search confirms it."""


def sweep_frames(
    greys: Sequence[U8],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    most: float,
    options: SweepOptions,
) -> tuple[Swept, Swept]:
    """Inverse depth of both frames of one camera, searched from 0 to ``most``.

    Args:
        greys: (H, W) of frames 0 and 1.
        rig: its body is where that camera is; without a lens.
        shutter: reads rows.
        motion: of the body.
        side: which camera.
        most: largest inverse depth.
        options: see there.
    """
    height, width = search_size(greys[0].shape, options)
    camera = _resized(rig.camera, width, height)
    small = [np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)) for grey in greys]
    poses = [_poses(rig, shutter, motion, side, frame, height) for frame in FRAMES]
    maps = [reprojection_of(camera, poses[frame], poses[1 - frame]) for frame in FRAMES]
    gain = parallax_gain(camera, *maps)
    count = min(max(math.ceil(gain * most / options.step_px) + 1, _FEWEST), options.planes)
    step = most / (count - 1)
    codes = [census(grey) for grey in small]

    def search(frame: int) -> F32:
        volume = np.zeros((height, width, count), dtype=np.uint8)
        other = 1 - frame
        _fill_volume(small[frame], small[other], codes[frame], codes[other], maps[frame], step, volume)
        volume = np.asarray(cv2.blur(volume, (options.window, options.window))).reshape(volume.shape)
        found = winners(aggregated(volume, options.p1, options.p2)) * np.float32(step)
        return np.asarray(cv2.medianBlur(np.maximum(found, np.float32(0.0)), _MEDIAN))

    rhos = map_frames(search, FRAMES, width * height, _BYTES)
    least = options.agree_px / max(gain, 1e-12)
    first, second = (Swept(rhos[i], _agrees(rhos[i], rhos[1 - i], maps[i], least)) for i in FRAMES)
    return first, second


def largest_seen(
    greys: Sequence[U8],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    options: SweepOptions,
) -> float:
    """Largest inverse depth of textured places that both frames show, with a margin; arguments: ``sweep_frames``.

    By a search at a quarter of the size, as far as things are expected to move: where flow lost a near thing, its
    depth would not be looked for. 0 where there is none.
    """
    poses = [_poses(rig, shutter, motion, side, frame, greys[0].shape[0]) for frame in FRAMES]
    maps = [reprojection_of(rig.camera, poses[frame], poses[1 - frame]) for frame in FRAMES]
    gain = max(parallax_gain(rig.camera, *maps), 1e-9)
    coarse = replace(options, shrink=_COARSE * options.shrink // 2)
    swept = sweep_frames(greys, rig, shutter, motion, side, _REACH * max(greys[0].shape) / gain, coarse)
    height, width = swept[0].rho.shape
    known = []
    for grey, each in zip(greys, swept, strict=True):
        small = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
        mean, square = (cv2.blur(part, (_TEXTURED, _TEXTURED)) for part in (small, small * small))
        known.append(each.rho[each.agrees & (square - mean * mean > _TEXTURE_LEVELS**2)])
    rho = np.concatenate(known)
    return _MARGIN * float(np.quantile(rho, _NEAREST)) + _MARGIN_PX / gain if len(rho) else 0.0


def search_size(shape: tuple[int, ...], options: SweepOptions) -> tuple[int, int]:
    """Rows and columns at which frames (H, W) are compared."""
    return max(shape[0] // options.shrink, 8), max(shape[1] // options.shrink, 8)


def _resized(camera: PinholeCamera, width: int, height: int) -> PinholeCamera:
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=(camera.cx + 0.5) * x - 0.5,
        cy=(camera.cy + 0.5) * y - 0.5,
    )


def _poses(rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int, height: int) -> Pose:
    """``cam_from_world`` of the rows of a frame of ``height`` rows, each at the mean time of its own."""
    scale = shutter.height / height
    rows = (np.arange(height) + 0.5) * scale - 0.5
    tau = shutter.pixel_time(np.stack([np.zeros_like(rows), rows], axis=-1), frame, side)
    return rig.cam_from_world(motion, tau, side)


def _agrees(rho: F32, other: F32, maps: Reprojection, tolerance: float) -> Mask:
    """(h, w) whether the other frame's inverse depth is the same within ``tolerance`` where it sees the point."""
    height, width = rho.shape
    places, factors = reproject_pixels(maps, rho, np.indices(rho.shape, dtype=np.int32)[0])
    seen = np.isfinite(places[..., 0])
    nearest = np.rint(np.where(seen[..., None], places, 0.0)).astype(np.intp)
    x, y = np.moveaxis(np.clip(nearest, 0, (width - 1, height - 1)), -1, 0)
    return np.asarray(seen & (np.abs(other[y, x] - rho * factors) < tolerance))


@compiled(error_model="numpy")
def _fill_volume(
    grey: U8,
    other: U8,
    code: NDArray[np.uint32],
    other_code: NDArray[np.uint32],
    maps: Reprojection,
    step: float,
    volume: U8,
) -> None:
    """Costs (h, w, n) of the inverse depths 0, step, 2 step, ... of every pixel."""
    height, width, count = volume.shape
    last = len(maps.A) - 1
    for y in range(height):
        for x in range(width):
            costs, own, own_code, line = volume[y, x], np.int64(grey[y, x]), code[y, x], min(y, last)
            M, b = homography(x, y, line, maps)
            for k in range(count):
                u, v, _ = land(M, b, k * step, maps.lens)
                # One plane further changes the row by one at most: its pose is that of the last landing.
                along = across_lines(maps.there, u, v)
                seen_by = min(max(int(along + 0.5), 0), last) if -last < along < 2 * last else line
                if seen_by != line:
                    line = seen_by
                    M, b = homography(x, y, line, maps)
                if -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5:
                    ty, tx = int(v + 0.5), int(u + 0.5)
                    apart = min(abs(own - np.int64(other[ty, tx])), _LEVELS)
                    costs[k] = _BIT * ones(own_code ^ other_code[ty, tx]) + _LEVEL * apart
                else:
                    costs[k] = _NOWHERE
