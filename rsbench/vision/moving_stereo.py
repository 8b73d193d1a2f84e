"""Disparity of a pair whose cameras read their lines at different times, by a rig whose motion is known.

With columns, opposite scans or a late camera the two ends of a match lie on lines of two times, and the motion
between them moves one end off the row of the other. Each image is therefore matched with what the other camera
would have shown at the times of its own pixels: the other image, resampled where it sees, at its own times, the
surfaces that are known so far. At first all is infinitely far, so that only rotation is undone; each round knows
the surfaces better. What a matcher finds between the two is a place of the resampled image, and so one of the
image as it was: these two ends, each at its own time, are triangulated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.resample import resample
from rsbench.vision.stereo_depth import fill_holes
from rsbench.vision.stereo_matcher import F32, MatcherEntry, find_disparities
from rsbench.vision.undistortion import between_pixels, widened

_ROUNDS, _SETTLED, _STILL_PX = 5, 0.02, 0.5
"""Of matching, at most; it ends earlier where what is known moves by more than so many px at less than this share
of the pixels. Late cameras and columns take two or three, opposite scans all."""
_STEPS = 5
"""Of the search for the line that sees a point: it leaves of the error what a pixel moves in a line."""
_SMOOTH = 5
"""Window, px, of the median that what is known passes before images are resampled by it."""


class _Eye(NamedTuple):
    """One camera of the rig, and the poses of its lines."""

    camera: PinholeCamera
    poses: Pose
    axis: int

    def pose_at(self, pixels: FloatArray) -> Pose:
        """Pose (..., 3, 3), (..., 3) of the line of pixels (..., 2), between lines by straight interpolation.

        It errs by an eighth of the square of the turn between two lines, 1e-10 of a fast one.
        """
        R, t = self.poses
        count = len(t)
        line = np.clip(np.nan_to_num(pixels[..., self.axis]), -count, 2 * count)
        below = np.clip(np.floor(line).astype(np.int64), 0, count - 2)
        share = (line - below)[..., None]
        return Pose(
            R[below] + share[..., None] * (R[below + 1] - R[below]), t[below] + share * (t[below + 1] - t[below])
        )


class _Looked(NamedTuple):
    """Pixels (H, W, 2) of a camera and their rays (H, W, 3); NaN where its lens shows nothing.

    Both from ideal places: from pixels with a lens Newton's method would have to find the rays.
    """

    pixels: FloatArray
    rays: FloatArray


def moving_disparities(
    entry: MatcherEntry,
    images: Mapping[Side, NDArray[np.uint8]],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    frame: int,
) -> tuple[F32, F32]:
    """Disparities (H, W) on the pixels of both cameras, ideal px, NaN where unknown; by any matcher and scan.

    A disparity is that which the other camera would have shown at the time of the pixel: ``rig.depth`` makes it
    the depth in the camera of the pixel's own line. ``images`` (H, W[, 3]) by side.

    Raises:
        RsbenchError: see ``find_disparities``.
    """
    eyes = {
        side: _Eye(rig.camera, row_poses(rig, shutter, motion, side, frame), shutter.axis(side)) for side in SIDES
    }
    first, second = (_of_side(entry, images, rig, eyes, side) for side in SIDES)
    return first, second


def _of_side(
    entry: MatcherEntry,
    images: Mapping[Side, NDArray[np.uint8]],
    rig: StereoRig,
    eyes: Mapping[Side, _Eye],
    side: Side,
) -> F32:
    camera, wide = rig.camera, widened(rig.camera)
    other: Side = "right" if side == "left" else "left"
    sign, grid, level = (1.0 if side == "left" else -1.0), wide.pixel_grid(), replace(rig, camera=wide)
    own = images[side] if camera.lens is None else resample(images[side], _shown(camera, wide, grid))
    rho = np.zeros(grid.shape[:2])
    for _ in range(_ROUNDS):
        ends = _ends(level, eyes[side], eyes[other], sign, rho)
        seen = resample(images[other], _inside(camera, ends).astype(np.float32))
        left, right = (own, seen) if side == "left" else (seen, own)
        both = find_disparities(entry, left, right, level)
        here, there = both if side == "left" else both[::-1]
        partner = grid + _across(sign * there)
        before, gain = rho, camera.fx * rig.baseline
        rho = _known(_inverse_depth(eyes[side], eyes[other], _looked(camera, wide, partner), ends))
        if np.mean(gain * np.abs(rho - before) > _STILL_PX) < _SETTLED:
            break
    known = np.isfinite(here)
    places: FloatArray = np.where(known[..., None], grid - _across(sign * here), 0.0)
    moved = (ends - grid).astype(np.float32)
    ends = places + np.stack([between_pixels(moved[..., k], places) for k in (0, 1)], axis=-1)
    rho = _inverse_depth(eyes[side], eyes[other], _looked(camera, wide, grid), _inside(camera, ends))
    disparity = np.where(known, gain * rho, np.nan)
    return _on_sensor(camera, wide, disparity.astype(np.float32))


def _ends(rig: StereoRig, eye: _Eye, other: _Eye, sign: float, rho: FloatArray) -> FloatArray:
    """Where the other camera, at its own times, sees what it would see at its ideal pixels at those of ``eye``.

    (H, W, 2) px of the other image, NaN where it does not; ``rho`` (H, W) 1 / m is the inverse depth there, and
    that of the partner in ``eye``, whose line's time is meant.
    """
    grid = rig.camera.pixel_grid()
    partner = _looked(eye.camera, rig.camera, grid + _across(sign * rig.camera.fx * rig.baseline * rho))
    R, t = eye.pose_at(partner.pixels)
    X = _turned(np.swapaxes(R, -1, -2), partner.rays - rho[..., None] * t)
    ends = _pixels(eye.camera, rig.camera, grid)
    for _ in range(_STEPS):
        R, t = other.pose_at(ends)
        ends = other.camera.project(_turned(R, X) + rho[..., None] * t)
    return ends


def _inverse_depth(eye: _Eye, other: _Eye, own: _Looked, ends: FloatArray) -> FloatArray:
    """Inverse depth (H, W), 1 / m, of pixels (H, W, 2) whose points the other camera sees at ``ends``; NaN: none.

    By the columns of the ends, as disparities are; the rows hold the guess that the image was resampled by.
    """
    (R, t), (S, s) = eye.pose_at(own.pixels), other.pose_at(ends)
    turn = S @ np.swapaxes(R, -1, -2)
    way, step = _turned(turn, own.rays), s - _turned(turn, t)
    column = other.camera.unproject(ends)[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        rho = (way[..., 0] - column * way[..., 2]) / (column * step[..., 2] - step[..., 0])
        return np.where(np.isfinite(rho) & (rho >= 0.0), rho, np.nan)


def _known(rho: FloatArray) -> FloatArray:
    """Inverse depth (H, W) without holes: there that of the farther neighbour in the row; and without specks."""
    filled = fill_holes(rho.astype(np.float32))
    anywhere = np.nanmedian(filled) if np.any(np.isfinite(filled)) else 0.0
    filled = np.where(np.isfinite(filled), filled, np.float32(anywhere))
    return np.asarray(cv2.medianBlur(filled, _SMOOTH), dtype=np.float64)


def _turned(R: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray((R @ x[..., None])[..., 0])


def _across(steps: NDArray[Any]) -> FloatArray:
    """(H, W, 2) px along rows."""
    return np.stack([steps, np.zeros_like(steps)], axis=-1).astype(np.float64)


def _pixels(camera: PinholeCamera, wide: PinholeCamera, places: FloatArray) -> FloatArray:
    """Pixels (H, W, 2) of the camera with its lens at places of the wide one without."""
    return places if wide is camera else camera.project(wide.unproject(places))


def _looked(camera: PinholeCamera, wide: PinholeCamera, places: FloatArray) -> _Looked:
    rays, pixels = wide.unproject(places), _pixels(camera, wide, places)
    return _Looked(pixels, np.where(np.isfinite(pixels[..., :1]), rays, np.nan))


def _shown(camera: PinholeCamera, wide: PinholeCamera, places: FloatArray) -> F32:
    return _inside(camera, _pixels(camera, wide, places)).astype(np.float32)


def _inside(camera: PinholeCamera, pixels: FloatArray) -> FloatArray:
    """Pixels (H, W, 2), NaN beside the image."""
    return np.where(camera.contains(pixels)[..., None], pixels, np.nan)


def _on_sensor(camera: PinholeCamera, wide: PinholeCamera, disparity: F32) -> F32:
    """Disparity of the wide camera on the pixels of the camera with its lens."""
    if wide is camera:
        return disparity
    shift = np.array([wide.cx - camera.cx, wide.cy - camera.cy])
    return between_pixels(disparity, camera.ideal_pixels(camera.pixel_grid()) + shift)
