"""Projection of world points into a rolling-shutter frame: the implicit row equation, solved exactly.

A point is seen at row y if its projection with the pose at the time of row y lies on row y:
``f(y) = project(cam_from_world(row_time(y)) X).y - y = 0``. There may be no solution (the point is never seen) or
several (it is seen twice, if its image moves along with the readout). Rows are those of the distorted image. For a
camera that reads columns, replace row by column and y by x.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import so3
from rsbench.core.camera import inverse_2x2
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import Pose, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

ROW_TOLERANCE_PX = 1e-9
"""Accepted residual of the row equation."""
_COARSE_ROWS, _MAX_ITERATIONS, _MAX_NEWTON_STEPS = 17, 60, 12


class ProjectionStatus(IntEnum):
    """Whether and how often a point is seen."""

    SEEN = 0
    NEVER = 1
    """The row equation has no solution inside the image, or the point is behind the camera."""
    TWICE = 2
    """Several rows see the point; the first one is reported."""
    NOT_CONVERGED = 3


@dataclass(frozen=True, kw_only=True)
class RSProjection:
    """Pixels of points in one rolling-shutter frame, with the batch axes of the points."""

    pixels: FloatArray
    """(..., 2) px; NaN unless the status is SEEN or TWICE."""
    depth: FloatArray
    """(...) z in the camera of the row that saw the point, metres; NaN likewise."""
    tau: FloatArray
    """(...) time at which the point was seen, frame periods; NaN likewise."""
    status: NDArray[np.uint8]
    """(...) of ``ProjectionStatus``."""


def project_at(rig: StereoRig, motion: Motion, side: Side, tau: ArrayLike, points: FloatArray) -> FloatArray:
    """Return pixels and depth (..., 3) of world points (..., 3) at given times, as for a global shutter."""
    x_in_cam = transform(rig.cam_from_world(motion, tau, side), points)
    return np.concatenate([rig.sensor(side).project(x_in_cam), x_in_cam[..., 2:]], axis=-1)


class _RowEquation(NamedTuple):
    """The row equation f(y) of points in one frame, which is zero if row y sees the point."""

    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    side: Side
    frame: int

    def __call__(self, X: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return f (...) in px, f' (...) and the points (..., 3) in the camera at rows y (...), in the body's
        axes.

        f and f' are NaN behind the camera.
        """
        axis = self.shutter.axis(self.side)
        tau = self.shutter.line_time(y, self.frame, self.side)
        R, t = self.rig.eye_from_world(self.motion, tau, self.side)
        rotated = (R @ X[..., None])[..., 0]
        x, eye = rotated + t, self.rig.eye(self.side)
        w_rate, t_rate = self.motion.velocity(tau)
        x_rate = so3.cross(w_rate, rotated) + t_rate
        value = eye.project(x)[..., axis] - y
        velocity = eye.velocity(x, x_rate)[..., axis]
        return value, self.shutter.rate(self.side)[axis] * velocity - 1.0, x


class _Brackets(NamedTuple):
    """Intervals (low, high) of rows, each with one root of the row equation of one point; all (m,)."""

    point: NDArray[np.int64]
    """Index of the point."""
    low: FloatArray
    high: FloatArray


def _brackets(equation: _RowEquation, X: FloatArray) -> _Brackets:
    """Bracket all roots for points (n, 3), including pairs of roots between two samples with the same sign."""
    grid = np.linspace(-0.5, equation.shutter.lines(equation.side) - 0.5, _COARSE_ROWS)
    samples = [equation(X, np.full(1, y)) for y in grid]
    found = []
    for (low, high), (at_low, at_high) in zip(pairwise(grid), pairwise(samples), strict=True):
        (value0, slope0, _), (value1, slope1, _) = at_low, at_high
        crosses = ((value0 >= 0.0) & (value1 < 0.0)) | ((value0 < 0.0) & (value1 >= 0.0))
        index = np.flatnonzero(crosses)
        found.append(_Brackets(index, np.full(len(index), low), np.full(len(index), high)))
        # If both ends have the same sign but slopes towards zero, the extremum between them may be beyond zero.
        sign = np.sign(value0)
        dips = np.flatnonzero((sign * np.sign(value1) > 0) & (slope0 * sign < 0) & (slope1 * sign > 0))
        turn = _extremum(equation, X[dips], low, high, sign[dips])
        hidden = equation(X[dips], turn)[0] * sign[dips] < 0
        index, turn = dips[hidden], turn[hidden]
        found.append(_Brackets(index, np.full(len(index), low), turn))
        found.append(_Brackets(index, turn, np.full(len(index), high)))
    return _Brackets(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _extremum(equation: _RowEquation, X: FloatArray, low: float, high: float, sign: FloatArray) -> FloatArray:
    """Find by bisection the row (n,) in (low, high) at which f has its extremum, nearest to zero."""
    a, b = np.full(len(X), low), np.full(len(X), high)
    for _ in range(_MAX_ITERATIONS if len(X) else 0):
        middle = 0.5 * (a + b)
        towards = equation(X, middle)[1] * sign < 0
        a, b = np.where(towards, middle, a), np.where(towards, b, middle)
    return 0.5 * (a + b)


def rs_project(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int, points: ArrayLike
) -> RSProjection:
    """Project world points (..., 3) into frame ``frame`` (0 or 1) of one rolling-shutter camera.

    Solves the implicit row equation to ``ROW_TOLERANCE_PX`` by bracketing and safeguarded Newton steps.
    """
    given = np.asarray(points, dtype=np.float64)
    X = given.reshape(-1, 3)
    equation = _RowEquation(rig, shutter, motion, side, frame)
    index, low, high = _brackets(equation, X)
    y, converged = _solve_rows(equation, X[index], low, high)
    times = shutter.line_time(y, frame, side)
    seen = project_at(rig, motion, side, times, X[index])
    inside = converged & rig.sensor(side).contains(seen[:, :2])
    rows_that_see = np.bincount(index[inside], minlength=len(X))
    status = np.select(
        [rows_that_see > 1, rows_that_see == 1, np.bincount(index[~converged], minlength=len(X)) > 0],
        [ProjectionStatus.TWICE, ProjectionStatus.SEEN, ProjectionStatus.NOT_CONVERGED],
        ProjectionStatus.NEVER,
    )
    # Select the first row of each point: rows are sorted, and unique() keeps the first of equal indices.
    order = np.lexsort((y, index))
    order = order[inside[order]]
    hit, first = np.unique(index[order], return_index=True)
    chosen = order[first]
    pixels, depth, tau = np.full((len(X), 2), np.nan), np.full(len(X), np.nan), np.full(len(X), np.nan)
    pixels[hit], depth[hit], tau[hit] = seen[chosen, :2], seen[chosen, 2], times[chosen]
    shape = given.shape[:-1]
    return RSProjection(
        pixels=pixels.reshape(*shape, 2),
        depth=depth.reshape(shape),
        tau=tau.reshape(shape),
        status=status.astype(np.uint8).reshape(shape),
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
    """Project like ``rs_project``, starting from a guess (...) of each point's row (or column), for dense maps.

    Only Newton steps are used. They find one root and do not search for others, so the status is never TWICE.
    """
    X = np.asarray(points, dtype=np.float64)
    y = np.broadcast_to(np.asarray(start_rows, dtype=np.float64), X.shape[:-1]).copy()
    equation = _RowEquation(rig, shutter, motion, side, frame)
    for _ in range(_MAX_NEWTON_STEPS):
        value, slope, x = equation(X, y)
        converged = np.abs(value) <= ROW_TOLERANCE_PX
        # Points behind the camera have no residual (NaN) and need no further steps.
        if np.all(converged | np.isnan(value)):
            break
        y = np.where(converged | np.isnan(value), y, y - value / np.where(slope == 0.0, np.nan, slope))
    pixels = rig.eye(side).project(x)
    inside = converged & rig.sensor(side).contains(pixels)
    lost = np.isfinite(value) & ~converged
    status = np.where(inside, ProjectionStatus.SEEN, ProjectionStatus.NEVER)
    return RSProjection(
        pixels=np.where(inside[..., None], pixels, np.nan),
        depth=np.where(inside, x @ rig.own(side).R[2] if rig.left is not None else x[..., 2], np.nan),
        tau=np.where(inside, shutter.line_time(y, frame, side), np.nan),
        status=np.where(lost, ProjectionStatus.NOT_CONVERGED, status).astype(np.uint8),
    )


def _solve_rows(
    equation: _RowEquation, X: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Solve the row equation in (low, high) by Newton steps, or by bisection if a step leaves the interval.

    Return the rows and whether each has converged.
    """
    sign_low = np.sign(equation(X, low)[0])
    y = 0.5 * (low + high)
    value, slope, _ = equation(X, y)
    for _ in range(_MAX_ITERATIONS):
        done = np.abs(value) <= ROW_TOLERANCE_PX
        if np.all(done):
            break
        below = np.sign(value) == sign_low
        low, high = np.where(below, y, low), np.where(below, high, y)
        step = y - value / np.where(slope == 0.0, np.nan, slope)
        y = np.where(done, y, np.where((step > low) & (step < high), step, 0.5 * (low + high)))
        value, slope, _ = equation(X, y)
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
    """Return world points (..., 3) of pixels (..., 2) with depth z (...) at their row (paper, eq. 11a)."""
    p = np.asarray(pixels, dtype=np.float64)
    x_in_cam = np.asarray(depth, dtype=np.float64)[..., None] * rig.sensor(side).unproject(p)
    R, t = rig.cam_from_world(motion, shutter.pixel_time(p, frame, side), side)
    return (np.swapaxes(R, -1, -2) @ (x_in_cam - t)[..., None])[..., 0]


def pixel_moves(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side,
    tau: FloatArray,
    points: FloatArray,
    along: FloatArray,
) -> FloatArray:
    """Return the derivative (n, 2, 2) of the pixels of points (n, 3), seen at tau (n,), by steps ``along`` (n, 3,
    2).

    The implicit row equation q = proj(pose(time(q)) X) gives (1 - v r^T)^-1 J, with J the derivative of the
    projection at that time, v the velocity of the pixel and r the derivative of the time by the pixel.
    """
    camera = rig.eye(side)
    R, t = rig.eye_from_world(motion, tau, side)
    turned = (R @ points[..., None])[..., 0]
    w_rate, t_rate = motion.velocity(tau)
    velocity = camera.velocity(turned + t, so3.cross(w_rate, turned) + t_rate)
    steps = R @ along
    by_plane = np.stack([camera.velocity(turned + t, steps[..., j]) for j in range(2)], axis=-1)
    return inverse_2x2(np.eye(2) - velocity[:, :, None] * shutter.rate(side)) @ by_plane


def plane_basis(normals: FloatArray) -> FloatArray:
    """Return two orthogonal vectors (n, 3, 2) in planes with unit normals (n, 3); 0 for a normal of 0."""
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = so3.cross(normals, least)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return np.stack([first, so3.cross(normals, first)], axis=-1)


def row_poses(rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int) -> Pose:
    """Return ``cam_from_world`` of every line, (lines, 3, 3) and (lines, 3), for renderers and files.

    Lines are rows from the top or, if the camera reads columns, columns from the left.
    """
    return rig.cam_from_world(motion, shutter.line_times(frame, side), side)
