"""Projection of world points into a rolling-shutter frame: the implicit row equation, solved exactly.

A point is seen at row y when its projection at row y's pose falls on row y:
``f(y) = project(cam_from_world(row_time(y)) X).y - y = 0``. It may have no solution (never seen) or several
(seen twice, when the image of the point keeps pace with the readout).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import Pose, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

ROW_TOLERANCE_PX = 1e-9
"""Accepted residual of the row equation."""
_COARSE_ROWS, _FINE_ROWS, _MAX_ITERATIONS, _MAX_NEWTON_STEPS = 17, 513, 60, 12


class ProjectionStatus(IntEnum):
    """What became of a point."""

    SEEN = 0
    NEVER = 1
    """The row equation has no solution inside the image, or the point is behind the camera."""
    TWICE = 2
    """Several rows see the point; the first one is reported."""
    NOT_CONVERGED = 3


@dataclass(frozen=True, kw_only=True)
class RSProjection:
    """Pixels of points in one rolling-shutter frame; batch axes as the points had."""

    pixels: FloatArray
    """(..., 2) px; NaN unless the status is SEEN or TWICE."""
    depth: FloatArray
    """(...) z in the camera of the row that saw the point, metres; NaN likewise."""
    tau: FloatArray
    """(...) time at which the point was seen, frame periods; NaN likewise."""
    status: NDArray[np.uint8]
    """(...) of ``ProjectionStatus``."""


def project_at(rig: StereoRig, motion: Motion, side: Side, tau: ArrayLike, points: FloatArray) -> FloatArray:
    """Pixels and depth (..., 3) of world points (..., 3) at given times: a global-shutter projection."""
    x_in_cam = transform(rig.cam_from_world(motion, tau, side), points)
    return np.concatenate([rig.camera.project(x_in_cam), x_in_cam[..., 2:]], axis=-1)


def _row_residual(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    frame: int,
    X: FloatArray,
    y: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """f(y), f'(y) and the point in the camera of row y."""
    tau = shutter.row_time(y, frame)
    R, t = rig.cam_from_world(motion, tau, side)
    rotated = (R @ X[..., None])[..., 0]
    x = rotated + t
    w_rate, t_rate = motion.velocity(tau)
    x_rate = np.cross(w_rate, rotated) + t_rate
    z = np.where(x[..., 2] > 0.0, x[..., 2], np.nan)
    fy = rig.camera.fy
    value = fy * x[..., 1] / z + rig.camera.cy - y
    slope = shutter.h * fy * (x_rate[..., 1] - x[..., 1] / z * x_rate[..., 2]) / z - 1.0
    return value, slope, x


def _brackets(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int, X: FloatArray, rows: int
) -> tuple[NDArray[np.int64], FloatArray, FloatArray, NDArray[np.bool_]]:
    """Crossings per point, first bracket (low, high), and points whose samples may hide a double crossing."""
    n = len(X)
    count = np.zeros(n, dtype=np.int64)
    low, high = np.full(n, np.nan), np.full(n, np.nan)
    suspicious = np.zeros(n, dtype=np.bool_)
    grid = np.linspace(-0.5, shutter.height - 0.5, rows)
    previous: tuple[FloatArray, FloatArray] | None = None
    for k, y in enumerate(grid):
        value, slope, _ = _row_residual(rig, shutter, motion, side, frame, X, np.full(1, y))
        if previous is not None:
            value0, slope0 = previous
            crosses = ((value0 >= 0.0) & (value < 0.0)) | ((value0 < 0.0) & (value >= 0.0))
            first = crosses & (count == 0)
            low[first], high[first] = grid[k - 1], y
            count += crosses
            # Same sign at both ends while the slopes point at zero: two crossings may hide in between.
            same_sign = np.sign(value0) * np.sign(value) > 0
            suspicious |= same_sign & (slope0 * np.sign(value0) < 0) & (slope * np.sign(value) > 0)
        previous = value, slope
    return count, low, high, suspicious


def rs_project(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int, points: ArrayLike
) -> RSProjection:
    """Project world points (..., 3) into frame ``frame`` (0 or 1) of one rolling-shutter camera.

    Solves the implicit row equation to ``ROW_TOLERANCE_PX`` by bracketing and safeguarded Newton steps.
    """
    X_all = np.asarray(points, dtype=np.float64)
    X = X_all.reshape(-1, 3)
    count, low, high, suspicious = _brackets(rig, shutter, motion, side, frame, X, _COARSE_ROWS)
    if np.any(suspicious):
        fine = _brackets(rig, shutter, motion, side, frame, X[suspicious], _FINE_ROWS)
        count[suspicious], low[suspicious], high[suspicious] = fine[:3]
    pixels, depth = np.full((len(X), 2), np.nan), np.full(len(X), np.nan)
    tau = np.full(len(X), np.nan)
    status = np.full(len(X), ProjectionStatus.NEVER, dtype=np.uint8)
    hit = np.flatnonzero(count > 0)
    if len(hit):
        y, converged = _solve_rows(rig, shutter, motion, side, frame, X[hit], low[hit], high[hit])
        times = shutter.row_time(y, frame)
        seen = project_at(rig, motion, side, times, X[hit])
        inside = rig.camera.contains(seen[:, :2])
        found = np.where(count[hit] > 1, ProjectionStatus.TWICE, ProjectionStatus.SEEN)
        found = np.where(inside, found, ProjectionStatus.NEVER)
        status[hit] = np.where(converged, found, ProjectionStatus.NOT_CONVERGED)
        keep = converged & inside
        pixels[hit[keep]], depth[hit[keep]] = seen[keep, :2], seen[keep, 2]
        tau[hit[keep]] = times[keep]
    shape = X_all.shape[:-1]
    return RSProjection(
        pixels=pixels.reshape(*shape, 2),
        depth=depth.reshape(shape),
        tau=tau.reshape(shape),
        status=status.reshape(shape),
    )


def rs_project_near(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    frame: int,
    points: ArrayLike,
    start_rows: ArrayLike,
) -> RSProjection:
    """Like ``rs_project`` from a row guess (...) per point: Newton only, for dense maps.

    Finds one crossing and does not look for others, so the status is never TWICE.
    """
    X = np.asarray(points, dtype=np.float64)
    y = np.broadcast_to(np.asarray(start_rows, dtype=np.float64), X.shape[:-1]).copy()
    for _ in range(_MAX_NEWTON_STEPS):
        value, slope, x_in_cam = _row_residual(rig, shutter, motion, side, frame, X, y)
        converged = np.abs(value) <= ROW_TOLERANCE_PX
        # Points behind the camera have no residual and need no further steps.
        if np.all(converged | np.isnan(value)):
            break
        y = np.where(converged | np.isnan(value), y, y - value / np.where(slope == 0.0, np.nan, slope))
    pixels = rig.camera.project(x_in_cam)
    inside = converged & rig.camera.contains(pixels)
    lost = np.isfinite(value) & ~converged
    status = np.where(inside, ProjectionStatus.SEEN, ProjectionStatus.NEVER)
    return RSProjection(
        pixels=np.where(inside[..., None], pixels, np.nan),
        depth=np.where(inside, x_in_cam[..., 2], np.nan),
        tau=np.where(inside, shutter.row_time(y, frame), np.nan),
        status=np.where(lost, ProjectionStatus.NOT_CONVERGED, status).astype(np.uint8),
    )


def _solve_rows(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    frame: int,
    X: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Root of the row equation inside (low, high): Newton, replaced by bisection when a step leaves it."""
    low, high = low.copy(), high.copy()
    sign_low = np.sign(_row_residual(rig, shutter, motion, side, frame, X, low)[0])
    y = 0.5 * (low + high)
    value = np.full(len(y), np.nan)
    for _ in range(_MAX_ITERATIONS):
        value, slope, _ = _row_residual(rig, shutter, motion, side, frame, X, y)
        if np.all(np.abs(value) <= ROW_TOLERANCE_PX):
            break
        below = np.sign(value) == sign_low
        low, high = np.where(below, y, low), np.where(below, high, y)
        step = y - value / np.where(slope == 0.0, np.nan, slope)
        y = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        # np.where keeps finished points where they are instead of bisecting away from the root.
        done = np.abs(value) <= ROW_TOLERANCE_PX
        y = np.where(done, np.where(below, low, high), y)
    return y, np.abs(value) <= ROW_TOLERANCE_PX


def back_project(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    frame: int,
    pixels: ArrayLike,
    depth: ArrayLike,
) -> FloatArray:
    """World points (..., 3) of pixels (..., 2) with depth z (...) in their own row's camera (paper, eq. 11a)."""
    p = np.asarray(pixels, dtype=np.float64)
    x_in_cam = np.asarray(depth, dtype=np.float64)[..., None] * rig.camera.unproject(p)
    R, t = rig.cam_from_world(motion, shutter.row_time(p[..., 1], frame), side)
    return (np.swapaxes(R, -1, -2) @ (x_in_cam - t)[..., None])[..., 0]


def row_poses(rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int) -> Pose:
    """``cam_from_world`` of every integer row, (height, 3, 3) and (height, 3), for the renderer and the files."""
    rows = np.arange(shutter.height, dtype=np.float64)
    return rig.cam_from_world(motion, shutter.row_time(rows, frame), side)
