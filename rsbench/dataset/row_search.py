"""Compiled projection of many points into a picture: the row equation of ``core.projection``.

The poses of a picture are read from a table between whose entries they are cubic. The table is made so fine that
poses half-way, where a cubic errs most, are those of the motion model to ``_SAME``: some 1e-8 px.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import Geometry
from rsbench.core.projection import ProjectionStatus, rs_project
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray, hat
from rsbench.dataset.views import ImageView

_SAME = 1e-11
"""Largest difference of entries of a pose: of rotations, and metres."""
_FINEST, _AT_JUMPS = 64, 1e-8
"""Entries of a table for each line, at most, and their largest difference then: accelerations jump, as at the end
of a spline."""
_TOLERANCE_PX = 1e-8
"""Residual of the row equation that needs no further step; stored values are rounded to 1e-3 px."""
_MOST_STEPS = 12
_SEEN, _NOT_SEEN, _UNSURE = 0, 1, 2


class Reprojected(NamedTuple):
    """Where points (...) lie in a picture."""

    pixels: FloatArray
    """(..., 2) px; NaN where it does not see them."""
    eyes: FloatArray
    """(..., 3) the camera's centre at that time, world frame; at any time where it does not see them."""
    unsolved: NDArray[np.bool_]
    """(...) whether it is not known if it sees them."""


class _Table(NamedTuple):
    """Poses of a picture over its lines, from line -1 on."""

    entries: FloatArray
    """(n, 24): rotation and translation of ``cam_from_world``, and their changes by an entry."""
    per_line: float
    """Entries for each line; 0: one pose for all."""


def find(geometry: Geometry, target: ImageView, points: FloatArray, start: FloatArray) -> Reprojected:
    """Search the lines of a picture that see points (rows, n, 3), world frame, from lines (rows, n) near them.

    Raises:
        RsbenchError: a motion that no table of poses follows.
    """
    camera, shutter = geometry.rig.camera, geometry.shutter
    table = _pose_table(geometry, target)
    pixels, eyes = np.full((*start.shape, 2), np.nan), np.zeros(points.shape)
    status = np.zeros(start.shape, dtype=np.uint8)
    axis, lines = shutter.axis(target.side), shutter.lines(target.side)
    reproject_rows(
        table.entries, table.per_line, _intrinsics(camera), axis, lines, points, start, pixels, eyes, status
    )
    unsure = status == _UNSURE
    if np.any(unsure):
        found = rs_project(geometry.rig, shutter, geometry.motion, target.side, target.frame, points[unsure])
        pixels[unsure] = found.pixels
        times = np.where(np.isnan(found.tau), target.frame, found.tau)
        eyes[unsure] = inverse(geometry.rig.cam_from_world(geometry.motion, times, target.side)).t
        unsure[unsure] = found.status == ProjectionStatus.NOT_CONVERGED
    return Reprojected(pixels, eyes, unsure)


def _pose_table(geometry: Geometry, view: ImageView) -> _Table:
    rig, shutter, motion = geometry.rig, geometry.shutter, geometry.motion
    if view.shutter == "gs":
        R, t = rig.cam_from_world(motion, shutter.time_after(view.row, view.frame, view.side), view.side)
        entry = np.concatenate([R.ravel(), t, np.zeros(12)])
        return _Table(np.stack([entry, entry]), 0.0)
    lines = shutter.lines(view.side)
    rate = shutter.rate(view.side)[shutter.axis(view.side)]
    per_line = 1
    while per_line <= _FINEST:
        at = np.linspace(-1.0, lines, (lines + 1) * per_line + 1)
        tau = shutter.line_time(at, view.frame, view.side)
        R, t = rig.cam_from_world(motion, tau, view.side)
        spin, speed = motion.velocity(tau)
        changes = np.concatenate([(hat(spin) @ R).reshape(-1, 9), speed], axis=1) * (rate / per_line)
        entries = np.concatenate([R.reshape(-1, 9), t, changes], axis=1)
        between = shutter.line_time(at[:-1] + 0.5 / per_line, view.frame, view.side)
        R, t = rig.cam_from_world(motion, between, view.side)
        middle = 0.5 * (entries[:-1, :12] + entries[1:, :12]) + 0.125 * (entries[:-1, 12:] - entries[1:, 12:])
        off = np.max(np.abs(middle - np.concatenate([R.reshape(-1, 9), t], axis=1)))
        if off <= (_SAME if per_line < _FINEST else _AT_JUMPS):
            return _Table(entries, float(per_line))
        per_line *= 2
    raise RsbenchError(
        f"motion model {type(motion).__name__}: jumps between the lines of {view.image}, or its velocity is not "
        "the derivative of its poses: channels of truth cannot be made"
    )


def _intrinsics(camera: PinholeCamera) -> FloatArray:
    """(14,): width, height, fx, fy, cx, cy; which lens, its coefficients and its reach."""
    lens = camera.lens
    own = [0.0] * 8
    if lens is not None:
        kind = 1.0 if lens.model == "brown-conrady" else 2.0
        own = [kind, lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.reach]
    return np.array([camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, *own])


@compiled
def reproject_rows(
    table: FloatArray,
    per_line: float,
    camera: FloatArray,
    axis: int,
    lines: int,
    points: FloatArray,
    start: FloatArray,
    pixels: FloatArray,
    eyes: FloatArray,
    status: NDArray[np.uint8],
) -> None:
    """Fill what ``Reprojected`` has; NumPy: ``core.projection.rs_project``.

    Each point starts where its two neighbours in the row landed would lead, with the slope found there. That no
    other row is heard keeps the bits of a row the same whatever rows are asked for with it.
    """
    pose = np.zeros(12)
    _pose_between(table, 0.0, pose)
    for row in range(start.shape[0]):
        offset, change, slope = 0.0, 0.0, -1.0
        for k in range(start.shape[1]):
            X = points[row, k, 0], points[row, k, 1], points[row, k, 2]
            near = start[row, k] + offset + change
            x, y, line, slope, found = _line(table, per_line, camera, axis, lines, X, near, slope, pose)
            status[row, k] = found
            if found == _SEEN:
                change = line - start[row, k] - offset
                offset += change
                pixels[row, k, 0], pixels[row, k, 1] = x, y
            else:
                offset, change, slope = 0.0, 0.0, -1.0
            for j in range(3):
                eyes[row, k, j] = -(pose[j] * pose[9] + pose[3 + j] * pose[10] + pose[6 + j] * pose[11])


@compiled
def _line(
    table: FloatArray,
    per_line: float,
    camera: FloatArray,
    axis: int,
    lines: int,
    X: tuple[float, float, float],
    start: float,
    slope: float,
    pose: FloatArray,
) -> tuple[float, float, float, float, int]:
    """Pixel, line, slope and status of one point, by secant steps; leaves the line's pose in ``pose`` (12,)."""
    line, step, before = start, 0.0, 0.0
    x, y, off = math.nan, math.nan, math.nan
    for _ in range(_MOST_STEPS):
        if per_line > 0.0:
            _pose_between(table, (line + 1.0) * per_line, pose)
        x, y = _pixel(pose, camera, X)
        off = (x if axis == 0 else y) - line
        if not abs(off) > _TOLERANCE_PX:
            break
        if step != 0.0:
            slope = (off - before) / step
        if not slope < 0.0:
            break
        before, step = off, -off / slope
        line += step
    if abs(off) <= _TOLERANCE_PX:
        if -0.5 <= x <= camera[0] - 0.5 and -0.5 <= y <= camera[1] - 0.5:
            return x, y, line, slope, _SEEN
        if -0.5 <= line <= lines - 0.5:
            return x, y, line, slope, _NOT_SEEN
    # Another crossing, or one behind a pole, cannot be told from here: the solver that looks for all of them does.
    first = _off(table, per_line, camera, axis, X, -0.5, pose)
    last = _off(table, per_line, camera, axis, X, lines - 0.5, pose)
    if math.isnan(first) and math.isnan(last):
        return x, y, line, slope, _NOT_SEEN
    if abs(off) <= _TOLERANCE_PX and first * last > 0.0:
        return x, y, line, slope, _NOT_SEEN
    return x, y, line, slope, _UNSURE


@compiled
def _off(
    table: FloatArray,
    per_line: float,
    camera: FloatArray,
    axis: int,
    X: tuple[float, float, float],
    line: float,
    pose: FloatArray,
) -> float:
    """How far beyond a line its camera sees a point, px; NaN behind it."""
    _pose_between(table, (line + 1.0) * per_line, pose)
    x, y = _pixel(pose, camera, X)
    return (x if axis == 0 else y) - line


@compiled
def _pose_between(table: FloatArray, place: float, pose: FloatArray) -> None:
    """Fill rotation and translation (12,) at a place between entries (Hermite), that of the ends beyond them."""
    below = min(max(math.floor(place), 0), table.shape[0] - 2)
    u = min(max(place - below, 0.0), 1.0)
    v = 1.0 - u
    a, b, c, d = v * v * (1.0 + 2.0 * u), u * v * v, u * u * (1.0 + 2.0 * v), -u * u * v
    for k in range(12):
        pose[k] = (
            a * table[below, k] + b * table[below, 12 + k] + c * table[below + 1, k] + d * table[below + 1, 12 + k]
        )


@compiled
def _pixel(pose: FloatArray, camera: FloatArray, X: tuple[float, float, float]) -> tuple[float, float]:
    """NaN behind the camera or beyond the lens. NumPy: ``PinholeCamera.project``."""
    z = pose[6] * X[0] + pose[7] * X[1] + pose[8] * X[2] + pose[11]
    if not z > 0.0:
        return math.nan, math.nan
    x = (pose[0] * X[0] + pose[1] * X[1] + pose[2] * X[2] + pose[9]) / z
    y = (pose[3] * X[0] + pose[4] * X[1] + pose[5] * X[2] + pose[10]) / z
    if camera[6] > 0.0:
        x, y = _bent(camera, x, y)
    return camera[2] * x + camera[4], camera[3] * y + camera[5]


@compiled
def _bent(camera: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Distorted coordinates. NumPy: ``Lens.distort``."""
    k1, k2, p1, p2, k3, k4 = camera[7], camera[8], camera[9], camera[10], camera[11], camera[12]
    s = x * x + y * y
    r = math.sqrt(s)
    if not r < camera[13]:
        return math.nan, math.nan
    if camera[6] == 1.0:
        gain = 1.0 + s * (k1 + s * (k2 + s * k3))
        return (
            x * gain + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * gain + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    angle = math.atan(r)
    a = angle * angle
    gain = 1.0 + s * (k1 - 1.0 / 3.0)
    if s >= 1e-12:
        gain = angle / r * (1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
    return x * gain, y * gain
