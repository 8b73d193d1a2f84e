"""Reprojection of whole depth maps, compiled: poses between lines by interpolation whose error is measured.

Where a target sees a point, the row equation says (``core.projection``); solving it asks for the pose at a time
of its own for each pixel, several times. Here a table has the camera's poses and their rates at whole lines, or
closer, and between two of them a point moves along the cubic that has its places and speeds at both. In a smooth
motion that errs by at most h^4 / 384 of the fourth derivative, with h the distance of two entries; a spline's
third derivative jumps at its knots. Whatever the motion, the error is measured in the middle of all entries, where
it is largest, and a table that errs by more than ``_ROTATION`` or ``_SHIFT`` is made closer; where none suffices,
there is no table.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core import so3
from rsbench.core.geometry import MovingRig
from rsbench.core.projection import ROW_TOLERANCE_PX
from rsbench.core.so3 import FloatArray
from rsbench.dataset.views import ImageView
from rsbench.verification.row_bands import by_bands
from rsbench.vision.reprojection import Table, across_lines, line_of, look, optics_of, see

_ROTATION, _SHIFT = 1e-10, 1e-10
"""What entries of a pose between two lines may err by, and metres: 1e-7 px of the longest lenses, and less than a
thousandth of what float32 says of depths."""
ROUNDING_PX = 1e-9
"""A place so far before a pixel's centre counts as on it: the two cameras see whole rows in whole rows."""
_PARTS = (1, 2, 4, 8, 16)
"""Entries of a table for each line."""
_MAX_STEPS = 12
"""Of Newton's method, as ``core.projection`` has it."""
_TOLERANCE = ROW_TOLERANCE_PX


class LinePoses(NamedTuple):
    """``cam_from_world`` of the lines of a source: (n, 3, 3), (n, 3); of a global shutter one for all."""

    R: FloatArray
    t: FloatArray
    columns: bool


class PoseTable(NamedTuple):
    """``cam_from_world`` of a target at lines ``first + k / parts``, and its derivatives by k."""

    R: FloatArray
    """(n, 3, 3)."""
    t: FloatArray
    """(n, 3) metres."""
    R_rate: FloatArray
    t_rate: FloatArray
    first: float
    parts: float
    columns: bool
    """Whether lines are columns."""


class Optics(NamedTuple):
    """The camera of both views."""

    numbers: FloatArray
    """(6,) fx, fy, cx, cy, width, height."""
    ideal: Table
    """As ``reprojection.Optics`` has it, and ``lens``."""
    lens: Table


class Surface(NamedTuple):
    """The depth map of a target; see ``DepthMap``."""

    inverse: FloatArray
    flat_blocks: NDArray[np.bool_]
    empty_blocks: NDArray[np.bool_]
    slope: Table
    """(H, W, 2), and ``bent`` (H, W, 2) the ideal pixels; None without a lens."""
    bent: Table


class Carried(NamedTuple):
    """What is carried, and where to."""

    depth: NDArray[np.float32]
    """(h, w) of every ``stride``-th pixel of the source, m; 0 = sky."""
    stride: int
    far: float
    """Where the sky is, m."""
    chosen: NDArray[np.bool_] | None
    """(h, w) pixels to be carried; None for all."""
    pixels: NDArray[np.float32]
    """(h, w, 2) filled in: see ``frame_comparison.Reprojection``, as the next one."""
    relative: NDArray[np.float32]


def poses_of_source(geometry: MovingRig, view: ImageView) -> LinePoses:
    """Of the lines of a view."""
    rig, shutter, side = geometry.rig, geometry.shutter, view.side
    columns = shutter.axis(side) == 0
    if view.shutter == "gs":
        tau = np.atleast_1d(shutter.time_after(view.row, view.frame, side))
    else:
        tau = shutter.line_times(view.frame, side)
    R, t = rig.cam_from_world(geometry.motion, tau, side)
    return LinePoses(np.ascontiguousarray(R), np.ascontiguousarray(t), columns)


def table_of_target(geometry: MovingRig, view: ImageView) -> PoseTable | None:
    """Of a view; None where no table is exact enough."""
    shutter, side = geometry.shutter, view.side
    columns = shutter.axis(side) == 0
    if view.shutter == "gs":
        source = poses_of_source(geometry, view)
        still = np.zeros_like(source.R), np.zeros_like(source.t)
        return PoseTable(source.R, source.t, *still, 0.0, 1.0, columns)
    for parts in _PARTS:
        table = _table(geometry, view, parts)
        if _errors(geometry, view, table) <= 1.0:
            return table
    return None


def _table(geometry: MovingRig, view: ImageView, parts: int) -> PoseTable:
    """With so many entries for each line, from one line before the first to one after the last."""
    shutter, side = geometry.shutter, view.side
    count = (shutter.lines(side) + 1) * parts + 1
    lines = np.arange(count) / parts - 1.0
    tau = shutter.line_time(lines, view.frame, side)
    R, t = geometry.rig.cam_from_world(geometry.motion, tau, side)
    w_rate, speed = geometry.motion.velocity(tau)
    by_entry = shutter.rate(side)[shutter.axis(side)] / parts
    rates = so3.hat(w_rate) @ R * by_entry, np.asarray(speed) * by_entry
    R, t, R_rate, t_rate = (np.ascontiguousarray(each) for each in (R, t, *rates))
    return PoseTable(R, t, R_rate, t_rate, -1.0, float(parts), shutter.axis(side) == 0)


def _errors(geometry: MovingRig, view: ImageView, table: PoseTable) -> float:
    """The largest error half-way between two entries, of what is allowed; infinite where one is not finite."""
    shutter, side = geometry.shutter, view.side
    lines = table.first + (np.arange(len(table.t) - 1) + 0.5) / table.parts
    exact = geometry.rig.cam_from_world(geometry.motion, shutter.line_time(lines, view.frame, side), side)
    pairs = (table.R, table.R_rate, exact.R, _ROTATION), (table.t, table.t_rate, exact.t, _SHIFT)
    worst = 0.0
    for value, rate, true, allowed in pairs:
        middle = 0.5 * (value[:-1] + value[1:]) + 0.125 * (rate[:-1] - rate[1:])
        worst = max(worst, float(np.max(np.abs(middle - true))) / allowed)
    return worst if np.isfinite(worst) else np.inf


def carry(carried: Carried, source: LinePoses, target: PoseTable, optics: Optics, surface: Surface) -> None:
    """Fill in ``carried``."""
    by_bands(partial(_carry_rows, carried, source, target, optics, surface), len(carried.depth))


def optics_of_camera(geometry: MovingRig) -> Optics:
    """Of the rig's camera."""
    camera = geometry.rig.camera
    ideal, lens, _ = optics_of(camera)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return Optics(np.array(numbers, dtype=np.float64), ideal, lens)


@compiled(error_model="numpy")
def _carry_rows(
    carried: Carried,
    source: LinePoses,
    target: PoseTable,
    optics: Optics,
    surface: Surface,
    first: int,
    last: int,
) -> None:
    """``carry`` for rows ``first`` to ``last`` of those that are carried."""
    fx, fy, cx, cy = optics.numbers[0], optics.numbers[1], optics.numbers[2], optics.numbers[3]
    for row in range(first, last):
        for column in range(carried.depth.shape[1]):
            if not _is_chosen(carried.chosen, row, column):
                continue
            x, y = column * carried.stride, row * carried.stride
            z = carried.depth[row, column]
            sky = z == 0.0
            far = carried.far if sky else float(z)
            u, v = look(optics.ideal, x, y)
            a, b, c = far * ((u - cx) / fx), far * ((v - cy) / fy), far
            line = min(line_of(source.columns, x, y), len(source.t) - 1)
            R, t = source.R[line], source.t[line]
            a, b, c = a - t[0], b - t[1], c - t[2]
            X = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
            Y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
            Z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
            guess = across_lines(target.columns, float(x), float(y))
            pu, pv, iu, iv, depth = _seen(X, Y, Z, guess, target, optics)
            carried.pixels[row, column, 0] = pu
            carried.pixels[row, column, 1] = pv
            carried.relative[row, column] = _relative(pu, pv, iu, iv, depth, sky, surface)


@compiled(error_model="numpy")
def _seen(
    X: float, Y: float, Z: float, guess: float, target: PoseTable, optics: Optics
) -> tuple[float, float, float, float, float]:
    """Pixel, ideal pixel and depth at which the target sees a point of the world; NaN where it does not."""
    fx, fy, cx, cy = optics.numbers[0], optics.numbers[1], optics.numbers[2], optics.numbers[3]
    entries, parts, lens = len(target.t), target.parts, optics.lens
    none = np.nan, np.nan, np.nan, np.nan, np.nan
    place, at, before, value_before = guess, -1, np.nan, np.nan
    p0 = p1 = p2 = v0 = v1 = v2 = q0 = q1 = q2 = w0 = w1 = w2 = 0.0
    for _ in range(_MAX_STEPS):
        k, s = 0, 0.0
        if entries > 1:
            s = (place - target.first) * parts
            k = min(max(int(np.floor(s)), 0), entries - 2)
            s -= k
        if k != at:
            p0, p1, p2 = _moved(target.R[k], X, Y, Z, target.t[k])
            if entries > 1:
                v0, v1, v2 = _moved(target.R_rate[k], X, Y, Z, target.t_rate[k])
                q0, q1, q2 = _moved(target.R[k + 1], X, Y, Z, target.t[k + 1])
                w0, w1, w2 = _moved(target.R_rate[k + 1], X, Y, Z, target.t_rate[k + 1])
            at = k
        x, dx = _between(p0, v0, q0, w0, s, entries)
        y, dy = _between(p1, v1, q1, w1, s, entries)
        z, dz = _between(p2, v2, q2, w2, s, entries)
        if not z > 0.0:
            return none
        iu, iv = fx * x / z + cx, fy * y / z + cy
        pu, pv = see(lens, iu, iv)
        if entries == 1:
            return _inside(pu, pv, iu, iv, z, optics)
        value = across_lines(target.columns, pu, pv) - place
        if abs(value) <= _TOLERANCE:
            return _inside(pu, pv, iu, iv, z, optics)
        if not np.isfinite(value):
            return none
        slope = across_lines(target.columns, fx * (dx - x / z * dz) / z, fy * (dy - y / z * dz) / z) * parts - 1.0
        if _bends(lens) and place != before and np.isfinite(before):
            slope = (value - value_before) / (place - before)  # a lens bends the way of the pixel
        before, value_before = place, value
        place -= value / slope if slope != 0.0 else np.nan
        if not np.isfinite(place):
            return none
    return none


@compiled(error_model="numpy", inline="always")
def _moved(R: FloatArray, X: float, Y: float, Z: float, t: FloatArray) -> tuple[float, float, float]:
    return (
        R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0],
        R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1],
        R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2],
    )


@compiled(error_model="numpy", inline="always")
def _between(p: float, v: float, q: float, w: float, s: float, entries: int) -> tuple[float, float]:
    """Value and derivative at ``s`` of the cubic with values p, q and slopes v, w at 0 and 1; straight beyond."""
    if entries == 1:
        return p, 0.0
    if s < 0.0:
        return p + s * v, v
    if s > 1.0:
        return q + (s - 1.0) * w, w
    rise = q - p
    c, d = 3.0 * rise - 2.0 * v - w, v + w - 2.0 * rise
    return p + s * (v + s * (c + s * d)), v + s * (2.0 * c + 3.0 * s * d)


@compiled(error_model="numpy", inline="always")
def _inside(
    pu: float, pv: float, iu: float, iv: float, z: float, optics: Optics
) -> tuple[float, float, float, float, float]:
    """What is given, or NaN outside of the image."""
    width, height = optics.numbers[4], optics.numbers[5]
    if -0.5 <= pu <= width - 0.5 and -0.5 <= pv <= height - 0.5:
        return pu, pv, iu, iv, z
    return np.nan, np.nan, np.nan, np.nan, np.nan


@compiled(error_model="numpy")
def _relative(pu: float, pv: float, iu: float, iv: float, z: float, sky: bool, surface: Surface) -> float:
    """See ``frame_comparison.relative_depth``."""
    height, width = surface.inverse.shape
    if not np.isfinite(pu):
        return np.nan
    x, y = int(np.floor(pu + ROUNDING_PX)), int(np.floor(pv + ROUNDING_PX))
    if not (1 <= x < width - 2 and 1 <= y < height - 2):
        return np.nan
    if surface.empty_blocks[y - 1, x - 1]:
        return 0.0 if sky else -np.inf
    if sky or not surface.flat_blocks[y - 1, x - 1]:
        return np.nan
    right, down = pu - x, pv - y
    inverse = surface.inverse
    top = (1 - right) * inverse[y, x] + right * inverse[y, x + 1]
    bottom = (1 - right) * inverse[y + 1, x] + right * inverse[y + 1, x + 1]
    found = (1 - down) * top + down * bottom
    for axis, ideal in ((0, iu), (1, iv)):
        found += _by_lens(surface.slope, surface.bent, x, y, right, down, axis, ideal)
    return z * found - 1.0


# Not inlined by Numba, which would then not leave out the branch of what is None.
@compiled(error_model="numpy")
def _is_chosen(chosen: NDArray[np.bool_] | None, row: int, column: int) -> bool:
    return True if chosen is None else chosen[row, column]


@compiled(error_model="numpy")
def _bends(lens: Table) -> bool:
    return lens is not None


@compiled(error_model="numpy")
def _by_lens(
    slope: Table, bent: Table, x: int, y: int, right: float, down: float, axis: int, ideal: float
) -> float:
    """What a lens adds to inverse depth between four pixels, by one axis of the ideal pixel."""
    if slope is None or bent is None:
        return 0.0
    top = (1 - right) * bent[y, x, axis] + right * bent[y, x + 1, axis]
    bottom = (1 - right) * bent[y + 1, x, axis] + right * bent[y + 1, x + 1, axis]
    return slope[y, x, axis] * (ideal - ((1 - down) * top + down * bottom))
