"""Depth from a known motion by a plane sweep in which each pixel has the pose of its own line.

For every inverse depth of a grid the other views are resampled as if the surface of each pixel were there; the
inverse depth with the most similar views is used. Two frames of one camera give depth from time, the two cameras
depth from stereo, and all views combine both. The planes face the camera of the pixel's line.

Saurer, Koeser, Bouguet, Pollefeys, "Rolling shutter stereo", ICCV 2013. The aggregation and the last rounds, in
which the planes follow the surface that was found, are ours. Views in which a pixel may be hidden: Kang, Szeliski,
Chai, "Handling occlusions in dense multi-view stereo", CVPR 2001.

Aggregation (``aggregated``): Hirschmueller, "Stereo processing by semi-global matching and mutual information",
PAMI 2008: along each direction ``L(p, k) = C(p, k) + min(L(q, k), L(q, k +- 1) + p1, min L(q) + p2) - min L(q)``,
with q the pixel before p; the sum over directions is least at the hypothesis of a pixel. OpenCV's implementation
takes images, not costs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, final, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.arguments import check_ranges
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import VIEWS, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.vision.images import grey_u8, resample
from rsbench.vision.reprojection import Reprojection, parallax_gain, reproject_pixels, reprojection_of
from rsbench.vision.stereo_matcher import F32, Cameras, MotionMatcher

_NOISE = 4.0
"""Variance of grey levels, about that of noise and rounding: windows with less are similar by chance."""


class Comparer:
    """Zero-mean normalised cross-correlation of one image with others."""

    def __init__(self, grey: F32, window: int) -> None:
        self._grey, self._window = grey - np.float32(128.0), (window, window)
        self._mean = self._box(self._grey)
        self._variance = self._box(self._grey * self._grey) - self._mean * self._mean

    def _box(self, values: NDArray[Any]) -> F32:
        return np.asarray(cv2.boxFilter(values, -1, self._window, borderType=cv2.BORDER_REFLECT))

    def cost_of(self, other: F32, places: F32, *, cubic: bool) -> F32:
        """Cost (H, W), 0 (equal) to 1, of the other image (H, W) at places (H, W, 2), px; NaN where those are."""
        return np.where(
            np.isnan(places[..., 0]), np.float32(np.nan), self.compared(self._seen(other, places, cubic))
        )

    def compared(self, other: F32) -> F32:
        """Cost (H, W), 0 (equal) to 1, of another image (H, W) on the same pixels."""
        seen = other - np.float32(128.0)
        mean = self._box(seen)
        variance = self._box(seen * seen) - mean * mean
        together = self._box(seen * self._grey) - mean * self._mean
        noise = np.float32(_NOISE)
        alike = together / np.sqrt((np.maximum(variance, 0) + noise) * (np.maximum(self._variance, 0) + noise))
        return np.asarray(np.float32(0.5) * (1.0 - alike), dtype=np.float32)

    @staticmethod
    def _seen(other: F32, places: F32, cubic: bool) -> F32:
        if cubic:
            return np.asarray(resample(other, places))
        known = np.nan_to_num(places, nan=0.0)
        return np.asarray(cv2.remap(other, known, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
_FAR = np.float32(1e9)


def aggregated(costs: U8, p1: int, p2: int) -> U16:
    """Sum (H, W, n) over the eight directions for the costs (H, W, n) of n ordered hypotheses.

    ``p1`` and ``p2``, each at most 4000, are the costs of steps by one and by more hypotheses.
    """
    total = np.zeros(costs.shape, dtype=np.uint16)
    for step in (1, -1):
        # Seen from the opposite corner, the same loops run in the opposite direction.
        _pass(costs[::step, ::step], total[::step, ::step], np.float32(p1), np.float32(p2))
    return total


def winners(total: U16) -> F32:
    """Hypothesis (H, W) of least cost, plus the fraction at the minimum of the parabola through it and its
    neighbours."""
    best = np.zeros(total.shape[:2], dtype=np.float32)
    _winners(total, best)
    return best


@compiled(error_model="numpy", fastmath={"nnan", "nsz"})
def _pass(costs: U8, total: U16, p1: np.float32, p2: np.float32) -> None:
    """Add the sums along the four directions that come from above and from the left."""
    height, width, n = costs.shape
    # One hypothesis of padding at both ends, and one pixel at both ends of a row.
    above, here = np.zeros((3, width + 2, n + 2), np.float32), np.zeros((3, width + 2, n + 2), np.float32)
    least_above, least_here = np.zeros((3, width + 2), np.float32), np.zeros((3, width + 2), np.float32)
    beside = np.zeros((2, n + 2), np.float32)
    for lines in (above, here):
        lines[:, :, 0], lines[:, :, n + 1] = _FAR, _FAR
    beside[:, 0], beside[:, n + 1] = _FAR, _FAR
    for y in range(height):
        beside[0, 1 : n + 1] = np.float32(0.0)
        least = np.float32(0.0)
        for x in range(width):
            cost, into = costs[y, x], total[y, x]
            least = _extend(cost, beside[x % 2], least, p1, p2, beside[1 - x % 2], into)
            for k in range(3):
                before = x + k  # the pixels above: to the left, straight, to the right
                least_here[k, x + 1] = _extend(
                    cost, above[k, before], least_above[k, before], p1, p2, here[k, x + 1], into
                )
        above, here = here, above
        least_above, least_here = least_here, least_above


@compiled(error_model="numpy", fastmath={"nnan", "nsz"}, inline="always")
def _extend(
    cost: U8, before: F32, least_before: np.float32, p1: np.float32, p2: np.float32, here: F32, into: U16
) -> np.float32:
    """Proceed by one pixel: fill ``here``, add it to ``into``, and return its least value."""
    least, jump = _FAR, least_before + p2
    for k in range(len(cost)):
        reached = min(min(before[k + 1], jump), min(before[k], before[k + 2]) + p1)
        value = np.float32(cost[k]) + reached - least_before
        here[k + 1] = value
        into[k] += np.uint16(np.int32(value))
        least = min(least, value)
    return least


@compiled(error_model="numpy")
def _winners(total: U16, best: F32) -> None:
    height, width, n = total.shape
    for y in range(height):
        for x in range(width):
            sums = total[y, x]
            k = 0
            for j in range(1, n):
                if sums[j] < sums[k]:
                    k = j
            offset = np.float32(0.0)
            if 0 < k < n - 1:
                before, here, after = np.float32(sums[k - 1]), np.float32(sums[k]), np.float32(sums[k + 1])
                bend = before - np.float32(2.0) * here + after
                if bend > 0.0:
                    offset = np.float32(0.5) * (before - after) / bend
            best[y, x] = np.float32(k) + offset


Sources = Literal["time", "stereo", "all"]
_RANGES = {
    "planes": (3, 1024),
    "step_px": (0.05, 10.0),
    "window": (3, 51),
    "p1": (0, 4000),
    "p2": (0, 4000),
    "nearest_depth": (1e-6, 1e9),
    "least_parallax_px": (1e-6, 1e6),
    "consistency_px": (1e-6, 1e6),
    "refine_rounds": (0, 20),
}
_COARSE, _RANGE_QUANTILE, _RANGE_MARGIN = 4, 0.999, 1.1
"""The range is searched at a quarter of the size, as in ``stereo_depth``."""
_FEWEST = 8
_FOLLOW_WINDOW = 7
"""Side of the window in the last rounds, px: if the plane follows the surface, a larger window is better."""
_ROUND = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Number of steps of a last round; each is a quarter of a plane's, and half of that in each further round."""


@final
@dataclass(frozen=True, kw_only=True)
class SweepMatcher(MotionMatcher):
    """Plane sweep with a known motion, over time, stereo, or both."""

    sources: Sources = "all"
    """``time``: the other frame of the same camera; ``stereo``: the other camera; ``all``: the three others."""
    rolling: bool = True
    """False: all lines of a frame are assumed to have the pose of the first."""
    planes: int = 128
    """Largest number of planes; there are fewer if ``step_px`` needs fewer."""
    step_px: float = 0.5
    """Parallax between two planes, in the view in which it is largest."""
    window: int = 3
    """Side, px, of the window in which views are compared."""
    p1: int = 24
    """Cost of a step to the next plane; the largest cost of a pixel is 255."""
    p2: int = 200
    """Cost of larger steps."""
    nearest_depth: float | None = None
    """Least depth, metres; None: the range is estimated from the images, by a sweep at a quarter of the size."""
    least_parallax_px: float = 0.5
    """Least parallax, px: depth with less is unknown, as it is hardly distinguishable from infinity."""
    consistency_px: float = 1.0
    """Largest difference, px, from the parallax by the depth of one other view that sees the pixel."""
    refine_rounds: int = 2
    """Number of rounds in which depth is refined below the step of the planes; 0: none."""

    def __post_init__(self) -> None:
        if self.sources not in get_args(Sources):
            raise ValueError(f"sources = {self.sources!r}: must be one of {', '.join(get_args(Sources))}")
        if self.window % 2 == 0:
            raise ValueError(f"window = {self.window}: must be odd")
        if self.p1 > self.p2:
            raise ValueError(f"p1 = {self.p1}: must not exceed p2, {self.p2}")
        check_ranges(self, _RANGES)

    @property
    def cameras(self) -> Cameras:
        return "any"

    def depths(
        self, images: Mapping[View, NDArray[Any]], rig: StereoRig, shutter: RollingShutter, motion: Motion
    ) -> dict[View, F32]:
        return sweep_depths(images, rig, shutter, motion, self)

    def depths_of(
        self,
        images: Mapping[View, NDArray[Any]],
        rig: StereoRig,
        shutter: RollingShutter,
        motion: Motion,
        views: Sequence[View],
    ) -> dict[View, F32]:
        return sweep_depths(images, rig, shutter, motion, self, views)


def sweep_depths(
    images: Mapping[View, NDArray[Any]],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    options: SweepMatcher | None = None,
    views: Sequence[View] = VIEWS,
) -> dict[View, F32]:
    """Depth (H, W), metres, of the pixels of these views, in each line's own camera; NaN where it is unknown.

    ``images`` (H, W[, 3]) are uint8 or uint16. Depth is unknown where no other view sees or confirms it, where the
    parallax is too small, and everywhere if the motion gives no depth.
    """
    options = options or SweepMatcher()
    scene = _Scene({view: grey_u8(images[view]) for view in VIEWS}, rig, shutter, motion, options)
    if not scene.gain > 0.0:
        return {view: np.full(scene.size, np.nan, np.float32) for view in views}
    nearest = options.nearest_depth
    most = _range(scene.coarse()) if nearest is None else 1.0 / nearest
    rhos = scene.confirmed(scene.sweep_all(most, options.refine_rounds, scene.confirming(views)), views)
    with np.errstate(divide="ignore"):
        return {view: np.where(rho > 0.0, 1.0 / rho, np.float32(np.nan)) for view, rho in rhos.items()}


def _range(scene: _Scene) -> float:
    """Largest inverse depth, 1 / m, to be searched."""
    found = scene.confirmed(scene.sweep_all(0.5 * max(scene.size) / scene.gain, 0, VIEWS), VIEWS)
    known = np.concatenate([rho[np.isfinite(rho)] for rho in found.values()])
    largest = float(np.quantile(known, _RANGE_QUANTILE)) if known.size else 0.0
    return largest * _RANGE_MARGIN + 1.0 / scene.gain


class _Scene:
    """Four grey images (H, W), float32, with the geometry between them."""

    def __init__(
        self,
        images: Mapping[View, NDArray[np.uint8]],
        rig: StereoRig,
        shutter: RollingShutter,
        motion: Motion,
        options: SweepMatcher,
    ) -> None:
        self.images, self.rig, self.shutter, self.motion = images, rig, shutter, motion
        self.options, self.size = options, images["left", 0].shape
        self.greys = {view: image.astype(np.float32) for view, image in images.items()}
        believed = shutter if options.rolling else shutter.at_once()
        poses = {view: row_poses(rig, believed, motion, *view) for view in VIEWS}
        axes = {view: believed.axis(view[0]) for view in VIEWS}
        self.maps: dict[tuple[View, View], Reprojection] = {
            (view, other): reprojection_of(rig.camera, poses[view], poses[other], (axes[view], axes[other]))
            for view in VIEWS
            for other in self._others(view)
        }

    def _others(self, view: View) -> list[View]:
        side, frame = view
        chosen = {"time": lambda v: v[0] == side, "stereo": lambda v: v[1] == frame, "all": lambda v: True}
        return [other for other in VIEWS if other != view and chosen[self.options.sources](other)]

    @cached_property
    def gain(self) -> float:
        """Largest displacement, px, of a point of inverse depth 1 / m between two views."""
        return max(parallax_gain(self.rig.camera, m, self.maps[b, a]) for (a, b), m in self.maps.items())

    def coarse(self) -> _Scene:
        """The same scene at a quarter of the size; a line is then read 1.5 lines too early, which does not change
        ranges."""
        height, width = (max(n // _COARSE, _FEWEST) for n in self.size)
        camera = self.rig.camera.resized(width, height)
        small = {
            view: np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
            for view, image in self.images.items()
        }
        shutter = self.shutter.scanning.shutter_of(width, height, self.shutter.readout_ratio)
        return _Scene(small, replace(self.rig, camera=camera), shutter, self.motion, self.options)

    def confirming(self, views: Sequence[View]) -> list[View]:
        """These views, and all views that may confirm their results."""
        return [view for view in VIEWS if view in views or set(views) & set(self._others(view))]

    def sweep_all(self, most: float, rounds: int, views: Sequence[View]) -> dict[View, F32]:
        """Inverse depth (H, W), 1 / m, of some views, searched from 0 to ``most``; NaN where it is unknown."""
        with ThreadPoolExecutor(2) as pool:
            return dict(zip(views, pool.map(lambda view: self._sweep(view, most, rounds), views), strict=True))

    def _sweep(self, view: View, most: float, rounds: int) -> F32:
        options, others = self.options, self._others(view)
        count = math.ceil(self.gain * most / options.step_px) + 1
        grid = np.linspace(0.0, most, min(max(count, _FEWEST), options.planes), dtype=np.float32)
        comparer = Comparer(self.greys[view], options.window)
        lines = [self._first_lines(view, other) for other in others]
        volume = np.zeros((*self.size, len(grid)), dtype=np.uint8)
        for k, rho in enumerate(grid):
            plane = np.full(self.size, rho)
            cost = self._cost(comparer, view, plane, lines, cubic=False)
            _store(cost, volume, k)
        step = grid[1] - grid[0]
        rho = winners(aggregated(volume, options.p1, options.p2)) * step
        rho[rho >= most - 0.5 * step] = np.nan  # beyond the range, where nothing is searched
        comparer = Comparer(self.greys[view], _FOLLOW_WINDOW)
        for number in range(rounds):
            rho = self._follow(comparer, view, rho, step * 0.25 / 2**number, lines)
        parallax = self._parallax(view, rho, lines)
        return np.where(parallax >= options.least_parallax_px, rho, np.float32(np.nan))

    def _first_lines(self, view: View, other: View) -> NDArray[np.int32]:
        row, column = np.indices(self.size, dtype=np.int32)
        return row if self.maps[view, other].there is False else column

    def _cost(
        self, comparer: Comparer, view: View, rho: F32, lines: Sequence[NDArray[np.int32]], *, cubic: bool
    ) -> F32:
        """Cost (H, W), 0 to 1, of surfaces of inverse depth (H, W); NaN where no view sees them.

        It is the mean over the views that see a pixel, without the least similar view, in which the pixel may be
        hidden.
        """
        costs = []
        for other, start in zip(self._others(view), lines, strict=True):
            places, _ = reproject_pixels(self.maps[view, other], rho, start)
            costs.append(comparer.cost_of(self.greys[other], places, cubic=cubic))
        if len(costs) == 1:
            return costs[0]
        found = np.zeros_like(costs[0])
        _all_but_the_worst(np.stack(costs), found)
        return found

    def _follow(
        self, comparer: Comparer, view: View, rho: F32, step: float, lines: Sequence[NDArray[np.int32]]
    ) -> F32:
        """One last round: inverse depths near the current ones are compared, and the minimum of the parabola is
        used."""
        steps = np.array(_ROUND, dtype=np.float32) * np.float32(step)
        smooth = _smoothed(rho)
        costs = np.stack([self._cost(comparer, view, smooth + each, lines, cubic=True) for each in steps])
        best = np.argmin(np.nan_to_num(costs, nan=2.0), axis=0)
        inner = np.clip(best, 1, len(steps) - 2)[None]
        before, here, after = (np.take_along_axis(costs, inner + k, axis=0)[0] for k in (-1, 0, 1))
        bend = before - 2.0 * here + after
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = np.where(bend > 0.0, np.clip(0.5 * (before - after) / bend, -1.0, 1.0), 0.0)
        moved = smooth + steps[inner[0]] + np.float32(step) * offset
        return np.where(np.isfinite(rho) & np.isfinite(moved), np.maximum(moved, 0.0), rho).astype(np.float32)

    def _parallax(self, view: View, rho: F32, lines: Sequence[NDArray[np.int32]]) -> F32:
        """Parallax (H, W), px, by the pixel's own inverse depth, in the view where it is largest."""
        found = np.zeros(self.size, np.float32)
        for other, start in zip(self._others(view), lines, strict=True):
            maps = self.maps[view, other]
            here, far = (reproject_pixels(maps, at, start)[0] for at in (rho, np.zeros_like(rho)))
            # A point at infinity may lie outside the image: then the parallax is large enough.
            moved = np.linalg.norm(here - far, axis=-1)
            moved = np.where(np.isfinite(here[..., 0]), np.nan_to_num(moved, nan=np.inf), 0.0)
            found = np.maximum(found, moved).astype(np.float32)
        return found

    def confirmed(self, rhos: Mapping[View, F32], views: Sequence[View]) -> dict[View, F32]:
        """The inverse depths of some views that at least one other view that sees the point confirms."""
        found = {}
        for view in views:
            rho = rhos[view]
            agrees = np.zeros(self.size, np.bool_)
            for other in self._others(view):
                places, factors = reproject_pixels(self.maps[view, other], rho, self._first_lines(view, other))
                seen = np.isfinite(places[..., 0])
                nearest = np.rint(np.where(seen[..., None], places, 0.0)).astype(np.int64)
                x, y = np.moveaxis(np.clip(nearest, 0, [self.size[1] - 1, self.size[0] - 1]), -1, 0)
                off = np.abs(rhos[other][y, x] - rho * factors)
                agrees |= seen & (off * self.gain <= self.options.consistency_px)
            found[view] = np.where(agrees, rho, np.float32(np.nan))
        return found


def _smoothed(rho: F32) -> F32:
    """Inverse depth smoothed over the steps of its planes; surfaces of a few pixels keep their value."""
    known = np.isfinite(rho)
    filled = np.where(known, rho, np.float32(0.0))
    return np.where(known, cv2.medianBlur(filled, 5), np.float32(np.nan))


@compiled(error_model="numpy")
def _store(cost: F32, volume: NDArray[np.uint8], k: int) -> None:
    """Store a cost (H, W), 0 to 1, in plane k of a volume (H, W, n) as 0 to 255, rounded; NaN gets the largest
    cost."""
    height, width = cost.shape
    for y in range(height):
        for x in range(width):
            level = np.float32(255.0) * cost[y, x] + np.float32(0.5)
            volume[y, x, k] = np.uint8(level) if level == level else np.uint8(255)


@compiled(error_model="numpy")
def _all_but_the_worst(costs: F32, found: F32) -> None:
    """Mean (H, W) of the known costs (n, H, W), without the largest if there are two or more."""
    n, height, width = costs.shape
    for y in range(height):
        for x in range(width):
            total, worst, known = np.float32(0.0), np.float32(-1.0), 0
            for k in range(n):
                cost = costs[k, y, x]
                if cost == cost:
                    total, worst, known = total + cost, max(worst, cost), known + 1
            if known > 1:
                total, known = total - worst, known - 1
            found[y, x] = total / np.float32(known) if known > 0 else np.nan
