"""Surfaces of one picture reprojected into another, and how well the depth maps agree."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.geometry import Geometry
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.dataset.views import ImageView, SeenSurfaces, carry, numbers_of

T = TypeVar("T")
S = TypeVar("S", bound=np.generic)
_LEAST_ROWS = 64
"""Fewest rows of a band: starting a thread costs as much as some rows."""
_threads = os.cpu_count() or 1


def set_threads(count: int) -> None:
    """Set the number of threads of this process, one of several that share the cores."""
    global _threads
    _threads = count


def by_bands(work: Callable[[int, int], T], height: int) -> list[T]:
    """Call ``work(first, last)`` for bands of rows, ``last`` excluded; returns the results in their order.

    It runs in threads: it should release the interpreter, and must not write where another band writes.
    """
    threads = min(_threads, max(1, height // _LEAST_ROWS))
    bands = 1 if threads == 1 else min(4 * threads, height // _LEAST_ROWS)
    ends = [height * k // bands for k in range(bands + 1)]
    if bands == 1:
        return [work(0, height)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, ends[:-1], ends[1:]))


ROUNDING_PX = 1e-9
"""A place so far before a pixel's centre counts as on it: the two cameras see whole rows in whole rows."""

FLATNESS = 2e-5
"""Largest relative second difference of inverse depth (linear on planes by ideal pixels) of a locally flat
surface: bilinear interpolation errs by an eighth of it along each axis, well under the tolerance; an edge bends
far more."""
_CHUNK_PIXELS = 1 << 20
"""Pixels that are carried at once."""

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A depth map, and the pixels at which its surface is locally flat."""

    view: ImageView
    depth: NDArray[np.float32]
    """(H, W) metres, 0 = no surface."""
    camera: PinholeCamera
    labels: NDArray[np.uint8] | None = None
    """(H, W) labels of moving objects, see ``Sequence.labels``; None where nothing moves."""
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

    @cached_property
    def empty_blocks(self) -> BoolArray:
        """(H-3, W-3) whether pixels [y, x] to [y + 3, x + 3] see no surface at all."""
        return _window_max(self.depth, 4, 4) == 0


class _Bending(NamedTuple):
    """How a lens bends straight lines of pixels."""

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
    """Second differences of values (H, W, ...): across, down and twist, as in ``DepthMap._bends``."""
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


def reproject(geometry: Geometry, source: DepthMap, target: DepthMap, stride: int = 1) -> Reprojection:
    """Carry every ``stride``-th pixel of the source, in both directions, into the target."""
    depth = source.depth[::stride, ::stride]
    found = Reprojection(np.full((*depth.shape, 2), np.nan, np.float32), np.full(depth.shape, np.nan, np.float32))
    step = max(1, _CHUNK_PIXELS // depth.shape[1])
    for first in range(0, len(depth), step):
        rows = slice(first, first + step)
        pixels, x_in_cam = seen_in(geometry, source, target, range(len(source.depth))[::stride][rows], stride)
        ideal = target.camera.ideal.project(x_in_cam)
        found.pixels[rows] = pixels
        found.relative[rows] = relative_depth(target, pixels, x_in_cam[..., 2], depth[rows] == 0, ideal)
    return found


def stride_for(pixels: float, tried: int) -> int:
    """Stride in both directions at which about ``tried`` of so many pixels are left."""
    return max(1, int(np.sqrt(pixels / tried)))


def seen_in(
    geometry: Geometry, source: DepthMap, target: DepthMap, rows: range, stride: int
) -> tuple[FloatArray, FloatArray]:
    """Where the target sees what the source shows in some rows (h,) of every ``stride``-th column.

    Returns:
        Pixels (h, w, 2), NaN outside of the target; the points (h, w, 3) in its camera then, metres.
    """
    depth = source.depth[rows, ::stride]
    numbers = None if source.labels is None else numbers_of(source.labels[rows, ::stride])
    surfaces = SeenSurfaces(geometry, source.view, depth, rows, numbers, stride)
    x_in_cam = np.full((*depth.shape, 3), np.nan)
    found = carry(surfaces, target.view, x_in_cam, any_motion=True, by_bands=by_bands)
    return found.landed.pixels, x_in_cam


def nearest(values: NDArray[S], pixels: NDArray[Any]) -> NDArray[S]:
    """Values (...) of a map (H, W) at the pixels nearest to places (..., 2); of any pixel for NaN."""
    height, width = values.shape
    x, y = np.moveaxis(np.rint(np.nan_to_num(pixels)).astype(np.int64), -1, 0)
    return values[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]


def around(values: NDArray[S], pixels: NDArray[Any], steps: Iterable[int]) -> NDArray[S]:
    """Values (k, n) of a map (H, W) by all these steps, down and across, from places (n, 2) rounded down."""
    height, width = values.shape
    x, y = np.floor(pixels).astype(np.int64).T
    down, across = np.array(list(product(steps, repeat=2))).T[..., None]
    return values[np.clip(y + down, 0, height - 1), np.clip(x + across, 0, width - 1)]


def without_changing_light(
    sequence: Sequence, source: DepthMap, target: DepthMap, reprojection: Reprojection, stride: int
) -> Reprojection:
    """The same without pixels whose colours may change: gloss, and what moves, or is shaded by what moves, at
    another time."""
    one_time = source.view.side != target.view.side and sequence.shutter.plain and sequence.rig.rectified
    changing = [_changing(each, one_time) for each in (source, target)]
    if not any(map(np.any, changing)):
        return reprojection
    own = cv2.dilate(changing[0], np.ones((3, 3), np.uint8))[::stride, ::stride] > 0
    other = cv2.dilate(changing[1], np.ones((5, 5), np.uint8)) > 0
    there = nearest(other, reprojection.pixels)
    return reprojection._replace(relative=np.where(own | there, np.float32(np.nan), reprojection.relative))


def _changing(each: DepthMap, one_time: bool) -> NDArray[np.uint8]:
    """(H, W) 1 where another picture may see another light on the same surface."""
    found = np.zeros(each.depth.shape, dtype=np.uint8)
    if each.labels is not None and not one_time:
        found[each.labels > 0] = 1
    if each.gloss is not None:
        found[each.gloss] = 1
    return found


def relative_depth(
    target: DepthMap, pixels: FloatArray, z: FloatArray, sky: BoolArray, ideal: FloatArray
) -> FloatArray:
    """See ``Reprojection.relative``; of points (...) with depth ``z`` at ``pixels`` (..., 2) of the target.

    ``ideal`` (..., 2) are the pixels that it would see without its lens.
    """
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
    relative[flat] = z[flat] * _interpolated(target, pixels[flat], ideal[flat], y0[flat], x0[flat]) - 1.0
    return relative


def _interpolated(
    target: DepthMap, pixels: FloatArray, ideal: FloatArray, y0: NDArray[np.int64], x0: NDArray[np.int64]
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
    beside = ideal - between(_bending(target.camera).ideal)
    return np.asarray(found + np.sum(target.slope[y0, x0] * beside, axis=-1))
