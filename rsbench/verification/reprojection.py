"""Where the surface that one picture of a sequence sees lies in another, and how well both agree."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.geometry import Geometry, MovingRig
from rsbench.core.projection import ROW_TOLERANCE_PX
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import FAR, ImageView, Seen, numbers_of, points_of, seen_by, seen_from
from rsbench.vision.reprojection import Table, across_lines, line_of, look, optics_of, see

T = TypeVar("T")
_LEAST_ROWS = 64
"""Of a band: starting a thread costs what some rows do."""
_threads = os.cpu_count() or 1


def set_threads(count: int) -> None:
    """Let this process use so many (one of several that share the cores)."""
    global _threads
    _threads = count


def by_bands(work: Callable[[int, int], T], height: int) -> list[T]:
    """What ``work`` makes of bands of rows, first to last without the last, in their order.

    It runs in threads, so it must let go of the interpreter, and write to no place that another band writes to.
    """
    threads = min(_threads, max(1, height // _LEAST_ROWS))
    bands = 1 if threads == 1 else min(4 * threads, height // _LEAST_ROWS)
    ends = [height * k // bands for k in range(bands + 1)]
    if bands == 1:
        return [work(0, height)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, ends[:-1], ends[1:]))


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
    """The camera of a view."""

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
    """(h, w, 2) filled in: see ``reprojection.Reprojection``, as the next one."""
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
    if not geometry.rig.aligned:
        turn = geometry.rig.own(side).R.T
        w_rate, speed = w_rate @ turn, speed @ turn
    by_entry = shutter.rate(side)[shutter.axis(side)] / parts
    rates = so3.hat(w_rate) @ R * by_entry, np.asarray(speed) * by_entry
    R, t, R_rate, t_rate = (np.ascontiguousarray(each) for each in (R, t, *rates))
    return PoseTable(R, t, R_rate, t_rate, -1.0, float(parts), shutter.axis(side) == 0)


def _errors(geometry: MovingRig, view: ImageView, table: PoseTable) -> float:
    """The largest error midway between two entries, over the allowed one; infinite where one is not finite."""
    shutter, side = geometry.shutter, view.side
    lines = table.first + (np.arange(len(table.t) - 1) + 0.5) / table.parts
    exact = geometry.rig.cam_from_world(geometry.motion, shutter.line_time(lines, view.frame, side), side)
    pairs = (table.R, table.R_rate, exact.R, _ROTATION), (table.t, table.t_rate, exact.t, _SHIFT)
    worst = 0.0
    for value, rate, true, allowed in pairs:
        middle = 0.5 * (value[:-1] + value[1:]) + 0.125 * (rate[:-1] - rate[1:])
        worst = max(worst, float(np.max(np.abs(middle - true))) / allowed)
    return worst if np.isfinite(worst) else np.inf


def carry(
    carried: Carried, source: LinePoses, target: PoseTable, optics: tuple[Optics, Optics], surface: Surface
) -> None:
    """Fill in ``carried``; ``optics`` are those of the source and of the target."""
    by_bands(partial(_carry_rows, carried, source, target, optics, surface), len(carried.depth))


def optics_of_camera(camera: PinholeCamera) -> Optics:
    """Of a camera in its own axes."""
    ideal, lens, _ = optics_of(camera)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return Optics(np.array(numbers, dtype=np.float64), ideal, lens)


@compiled(error_model="numpy")
def _carry_rows(
    carried: Carried,
    source: LinePoses,
    target: PoseTable,
    optics: tuple[Optics, Optics],
    surface: Surface,
    first: int,
    last: int,
) -> None:
    """``carry`` for rows ``first`` to ``last`` of those that are carried."""
    own, there = optics
    fx, fy, cx, cy = own.numbers[0], own.numbers[1], own.numbers[2], own.numbers[3]
    for row in range(first, last):
        for column in range(carried.depth.shape[1]):
            if not _is_chosen(carried.chosen, row, column):
                continue
            x, y = column * carried.stride, row * carried.stride
            z = carried.depth[row, column]
            sky = z == 0.0
            far = carried.far if sky else float(z)
            u, v = look(own.ideal, x, y)
            a, b, c = far * ((u - cx) / fx), far * ((v - cy) / fy), far
            line = min(line_of(source.columns, x, y), len(source.t) - 1)
            R, t = source.R[line], source.t[line]
            a, b, c = a - t[0], b - t[1], c - t[2]
            X = R[0, 0] * a + R[1, 0] * b + R[2, 0] * c
            Y = R[0, 1] * a + R[1, 1] * b + R[2, 1] * c
            Z = R[0, 2] * a + R[1, 2] * b + R[2, 2] * c
            guess = across_lines(target.columns, float(x), float(y))
            pu, pv, iu, iv, depth = _seen(X, Y, Z, guess, target, there)
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
            slope = (value - value_before) / (place - before)  # a lens bends the path of the pixel
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
    """See ``reprojection.relative_depth``."""
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


DEPTH_TOLERANCE = 1e-4
"""Relative difference of two depths of one surface point that still agree."""
FLATNESS = 2e-5
"""Largest relative second difference of inverse depth (linear on planes by ideal pixels) of a locally flat
surface: bilinear interpolation errs by an eighth of it along each axis, well under the tolerance; an edge bends
far more."""
_CHUNK_PIXELS = 1 << 17

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth map, and where it is one flat surface."""

    view: ImageView
    depth: NDArray[np.float32]
    """(H, W) metres, 0 = no surface."""
    camera: PinholeCamera
    labels: NDArray[np.uint8] | None = None
    """(H, W) what moves there, see ``Sequence.labels``; None where nothing does."""
    gloss: BoolArray | None = None
    """(H, W) whether the surface is glossy; None where none is."""

    @cached_property
    def inverse(self) -> FloatArray:
        """(H, W) 1 / m, NaN where there is no surface."""
        solid = self.depth > 0
        return np.where(solid, 1.0 / np.where(solid, self.depth, 1.0).astype(np.float64), np.nan)

    @cached_property
    def slope(self) -> FloatArray:
        """(H, W, 2) derivative of inverse depth by the ideal pixel, as ``_Bending.by_ideal`` has it."""
        by_pixel = np.stack([np.gradient(self.inverse, axis=axis) for axis in (1, 0)], axis=-1)
        return np.asarray(np.einsum("hwij,hwi->hwj", _bending(self.camera).by_ideal, by_pixel))

    def _bends(self) -> tuple[FloatArray, ...]:
        """Second differences of inverse depth: across (H, W-2), down (H-2, W), twist (H-1, W-1).

        Without what a lens adds: it bends the pixels of a plane.
        """
        found = _second_differences(self.inverse)
        if self.camera.lens is not None and min(self.depth.shape) > 1:
            slopes = self.slope[:, 1:-1], self.slope[1:-1], self.slope[:-1, :-1]
            lens = _bending(self.camera).differences
            found = tuple(
                each - np.sum(slope * bend, axis=-1) for each, slope, bend in zip(found, slopes, lens, strict=True)
            )
        return tuple(np.nan_to_num(np.abs(each), nan=np.inf) for each in found)

    @cached_property
    def flat(self) -> BoolArray:
        """(H, W) pixels whose 3 x 3 neighbourhood is one flat surface, too wide to slip between pixels."""
        flat = np.zeros(self.depth.shape, dtype=np.bool_)
        flat[1:-1, 1:-1] = self._evenness[0] <= FLATNESS
        return flat

    @cached_property
    def _evenness(self) -> tuple[FloatArray, BoolArray]:
        """Relative second difference of inverse depth (H-2, W-2) in 3 x 3 pixels, infinite beside no surface, and
        ``flat_blocks``: of one pass, as the differences take more memory than all else that is kept of a map."""
        across, down, twist = self._bends()
        with np.errstate(invalid="ignore"):
            bend = np.maximum(_window_max(across, 3, 1), _window_max(down, 1, 3)) / self.inverse[1:-1, 1:-1]
            widest = [_window_max(across, 4, 2), _window_max(down, 2, 4), _window_max(twist, 3, 3)]
            blocks = np.maximum.reduce(widest) <= FLATNESS * self.inverse[1:-2, 1:-2]
        return np.nan_to_num(bend, nan=np.inf), np.asarray(blocks)

    def share_of_edges(self, jump: float) -> float:
        """Share of the pixels with a surface around which inverse depth bends by more than ``jump`` of itself."""
        solid = self.depth[1:-1, 1:-1] > 0
        return float(np.mean(self._evenness[0][solid] > jump)) if np.any(solid) else 0.0

    @property
    def flat_blocks(self) -> BoolArray:
        """(H-3, W-3) whether pixels [y, x] to [y + 3, x + 3] are one flat surface."""
        return self._evenness[1]

    @property
    def surface(self) -> Surface:
        """What ``carry`` looks at."""
        bending = None if self.camera.lens is None else _bending(self.camera)
        lens = (None, None) if bending is None else (self.slope, bending.ideal)
        return Surface(self.inverse, self.flat_blocks, self.empty_blocks, *lens)

    @cached_property
    def empty_blocks(self) -> BoolArray:
        """(H-3, W-3) whether pixels [y, x] to [y + 3, x + 3] see no surface at all."""
        return _window_max(self.depth, 4, 4) == 0


class _Bending(NamedTuple):
    """What a lens does to straight lines of pixels."""

    ideal: FloatArray
    """(H, W, 2) ideal pixels."""
    by_ideal: FloatArray
    """(H, W, 2, 2) [pixel, ideal]: turns central differences over pixels into a derivative by the ideal pixel."""
    differences: tuple[FloatArray, ...]
    """Second differences of ``ideal``, as ``DepthMap._bends``."""


@lru_cache(maxsize=4)
def _bending(camera: PinholeCamera) -> _Bending:
    ideal = camera.ideal_pixels(camera.pixel_grid())
    # Both sides of the equation are differences of the same pixels, so that it is exact on planes.
    steps = np.stack([np.gradient(ideal, axis=axis) for axis in (1, 0)], axis=-2)
    return _Bending(ideal, np.swapaxes(np.linalg.inv(steps), -1, -2), _second_differences(ideal))


def _second_differences(values: FloatArray) -> tuple[FloatArray, ...]:
    """Of (H, W, ...) across, down and twist, as ``DepthMap._bends``."""
    return np.diff(values, 2, axis=1), np.diff(values, 2, axis=0), np.diff(np.diff(values, axis=0), axis=1)


def _window_max(values: NDArray, rows: int, columns: int) -> NDArray:  # pyrefly: ignore[implicit-any-type-argument]
    """Largest value (H - rows + 1, W - columns + 1) of each window."""
    height, width = values.shape
    tall = np.maximum.reduce([values[k : height - rows + 1 + k] for k in range(rows)])
    return np.maximum.reduce([tall[:, k : width - columns + 1 + k] for k in range(columns)])


class Reprojection(NamedTuple):
    """Where the pixels of a source are seen in a target; all (h, w) of the source's pixels, strided."""

    pixels: NDArray[np.float32]
    """(h, w, 2) px in the target; NaN outside of it."""
    relative: NDArray[np.float32]
    """How far the source's surface lies behind (+) or before (-) the target's, of its depth. NaN where the target
    is not one flat surface, -inf where it sees none; sky is at 0 in sky, NaN elsewhere."""


def reproject(sequence: Sequence, source: DepthMap, target: DepthMap, stride: int = 1) -> Reprojection:
    """Carry every ``stride``-th pixel of the source, in both directions, into the target."""
    depth = np.ascontiguousarray(source.depth[::stride, ::stride])
    found = Reprojection(np.full((*depth.shape, 2), np.nan, np.float32), np.full(depth.shape, np.nan, np.float32))
    labels = np.zeros(0) if source.labels is None else numbers_of(source.labels[::stride, ::stride])
    for number in sorted({0, *np.unique(labels).tolist()}):
        own, chosen = seen_from(sequence, int(number)), labels == number if labels.size else None
        table = table_of_target(own, target.view)
        if table is None:
            _reproject_exactly(sequence, source, target, found, stride)
            break
        carried = Carried(depth, stride, FAR, chosen, *found)
        optics = optics_of_camera(source.camera), optics_of_camera(target.camera)
        carry(carried, poses_of_source(own, source.view), table, optics, target.surface)
    return found


def _reproject_exactly(
    sequence: Sequence, source: DepthMap, target: DepthMap, found: Reprojection, stride: int
) -> None:
    """The same with the pose at each pixel's own time."""
    grid = source.camera.pixel_grid()[::stride, ::stride]
    depth = source.depth[::stride, ::stride].astype(np.float64)
    step = max(1, _CHUNK_PIXELS // grid.shape[1])
    for first in range(0, len(grid), step):
        rows = slice(first, first + step)
        sky = depth[rows] == 0
        numbers = None if source.labels is None else numbers_of(source.labels[::stride, ::stride][rows])
        seen = seen_with(sequence, source.view, target.view, grid[rows], np.where(sky, FAR, depth[rows]), numbers)
        found.pixels[rows] = seen.pixels
        found.relative[rows] = relative_depth(target, seen.pixels, seen.depth, sky)


def seen_with(
    geometry: Geometry,
    source: ImageView,
    target: ImageView,
    pixels: FloatArray,
    depth: FloatArray,
    numbers: NDArray[np.uint8] | None,
) -> Seen:
    """Where a target sees what a source sees at pixels (..., 2) with depth (...).

    ``numbers`` (...) of the objects that are seen, and move in between; 0 and None of what stands still.
    """

    def of(number: int, chosen: Any) -> Seen:
        own = seen_from(geometry, number)
        X = points_of(own, source, pixels[chosen], depth[chosen])
        return seen_by(own, target, X, pixels[chosen][..., own.shutter.axis(target.side)])

    seen = of(0, ...)
    for number in () if numbers is None else np.unique(numbers[numbers > 0]):
        chosen = numbers == number
        for whole, part in zip(seen[:2], of(int(number), chosen)[:2], strict=True):
            whole[chosen] = part
    return seen


def without_changing_light(
    sequence: Sequence, source: DepthMap, target: DepthMap, reprojection: Reprojection, stride: int
) -> Reprojection:
    """The same without what colours do not tell: gloss, and what turns, or is shaded by what moves, at another
    time."""
    one_time = source.view.side != target.view.side and sequence.shutter.plain and sequence.rig.rectified
    changing = [_changing(each, one_time) for each in (source, target)]
    if not any(map(np.any, changing)):
        return reprojection
    own = cv2.dilate(changing[0], np.ones((3, 3), np.uint8))[::stride, ::stride] > 0
    other = cv2.dilate(changing[1], np.ones((5, 5), np.uint8)) > 0
    x, y = np.rint(np.nan_to_num(reprojection.pixels)).astype(np.int64).reshape(-1, 2).T
    height, width = other.shape
    there = other[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].reshape(own.shape)
    return reprojection._replace(relative=np.where(own | there, np.float32(np.nan), reprojection.relative))


def _changing(each: DepthMap, one_time: bool) -> NDArray[np.uint8]:
    """(H, W) 1 where another picture may see another light on the same surface."""
    found = np.zeros(each.depth.shape, dtype=np.uint8)
    if each.labels is not None and not one_time:
        found[each.labels > 0] = 1
    if each.gloss is not None:
        found[each.gloss] = 1
    return found


def relative_depth(target: DepthMap, pixels: FloatArray, z: FloatArray, sky: BoolArray) -> FloatArray:
    """See ``Reprojection.relative``; of points (...) with depth ``z`` at ``pixels`` (..., 2) of the target."""
    height, width = target.depth.shape
    relative = np.full(z.shape, np.nan)
    corner = np.floor(np.where(np.isfinite(pixels), pixels + ROUNDING_PX, -1.0)).astype(np.int64)
    x0, y0 = corner[..., 0], corner[..., 1]
    inner = (x0 >= 1) & (x0 < width - 2) & (y0 >= 1) & (y0 < height - 2)
    block = y0[inner] - 1, x0[inner] - 1
    flat, empty = np.zeros((2, *z.shape), dtype=np.bool_)
    flat[inner], empty[inner] = target.flat_blocks[block], target.empty_blocks[block]
    relative[empty] = np.where(sky[empty], 0.0, -np.inf)
    flat &= ~sky
    relative[flat] = z[flat] * _interpolated(target, pixels[flat], y0[flat], x0[flat]) - 1.0
    return relative


def _interpolated(
    target: DepthMap, pixels: FloatArray, y0: NDArray[np.int64], x0: NDArray[np.int64]
) -> FloatArray:
    """Inverse depth (n,) at pixels (n, 2) between four that see one flat surface, the first of them y0, x0."""
    share = pixels - np.stack([x0, y0], axis=-1)

    def between(values: FloatArray) -> FloatArray:
        """Bilinear, of (H, W, ...)."""
        fx, fy = (each.reshape(-1, *[1] * (values.ndim - 2)) for each in share.T)
        top = (1 - fx) * values[y0, x0] + fx * values[y0, x0 + 1]
        bottom = (1 - fx) * values[y0 + 1, x0] + fx * values[y0 + 1, x0 + 1]
        return np.asarray((1 - fy) * top + fy * bottom)

    found = between(target.inverse)
    if target.camera.lens is None:
        return found
    beside = target.camera.ideal_pixels(pixels) - between(_bending(target.camera).ideal)
    return np.asarray(found + np.sum(target.slope[y0, x0] * beside, axis=-1))
