"""Tracks of a stereo rig over two frames from dense flow and disparity, aligned on the levels of a pyramid.

In blurred or noisy frames a detector finds few keypoints. Dense flow gives a value for every pixel, either right
to one or two pixels or wrong. Here it is the start of an alignment of patches (``features.align``), whose
predicted deviation decides which points are used. A coarse level has less blur and less noise, so that patches can
be aligned there that cannot be aligned at full size. If the displacement is beyond the search range of the flow,
the flow starts from an affine map of the whole image, which is estimated by correlation of blocks.

All steps use ideal pixels, in which both ends of a left-right match are in one row for any rig.

Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016 (OpenCV); Shi, Tomasi, "Good features to
track", CVPR 1994.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_ranges
from rsbench.core.correspondences import BoolArray, Correspondences, track_pairs
from rsbench.core.rig import SIDES, VIEWS, StereoRig, View
from rsbench.core.so3 import FloatArray
from rsbench.vision.feature_matcher import FeatureMatcher, of_sensors, undistorted
from rsbench.vision.features import (
    ROW_TOLERANCE_PX,
    Aligned,
    Recent,
    SiftMatcher,
    align,
    content_key,
    forget_features,
    refine_matches,
    smooth_spline,
    still,
)
from rsbench.vision.flow import dense_flow
from rsbench.vision.images import grey_u8, halved

F32, U8 = NDArray[np.float32], NDArray[np.uint8]
_MOST_POINTS = 20_000
_RANGES = {
    "points": (50, _MOST_POINTS),
    "enough": (12, _MOST_POINTS),
    "fewest": (0, _MOST_POINTS),
    "levels": (1, 6),
    "row_tolerance": (1e-6, 1e6),
    "most_deviation": (1e-3, 10.0),
}


@dataclass(frozen=True, kw_only=True)
class DenseOptions:
    """Options of the search for tracks. A pixel of level l is 2^l px."""

    points: int = 2000
    """Number of places that are tried on each level: the best corner of each of this many cells."""
    levels: int = 3
    """Number of levels of the pyramid, from the full size on."""
    enough: int = 400
    """Number of tracks with which no coarser level is used."""
    most_deviation: float = 0.1
    """Largest predicted standard deviation of an end, in pixels of its level."""
    row_tolerance: float | None = 1.0
    """Largest difference of rows of left-right ends, in rows of the level, if both cameras read a row at the same
    time. None if they do not."""
    fewest: int = 700
    """With fewer tracks than this, aligned SIFT tracks are added, of which more lie on thin and near objects; 0:
    never."""
    half: bool = False
    """Use images of half the size: faster, and less accurate."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)


@final
@dataclass(frozen=True, kw_only=True)
class DenseMatcher(DenseOptions, FeatureMatcher):
    """Tracks with their covariance from ``dense_tracks``; if there are few, also SIFT tracks."""

    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        return self._matched(images, None)

    def match_of_rig(self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig) -> Correspondences:
        return self._matched(images, rig)

    def apart(self) -> Self:
        return replace(self, row_tolerance=None)

    def with_enough(self, tracks: int) -> Self:
        points = min(self.points, max(int(_TRIED * tracks), 50))
        return replace(self, points=points, fewest=min(self.fewest, tracks // 2))

    def faster(self) -> Self:
        return replace(self, half=True)

    def _matched(self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig | None) -> Correspondences:
        if rig is None:
            found = dense_tracks(images, self)
        else:
            straight = {view: undistorted(image, rig.eye(view[0])) for view, image in images.items()}
            found = of_sensors(dense_tracks(straight, self), rig, _BORDER_PX)
            if not self.half:  # interpolation moved the content by hundredths of a pixel
                alone = refine_matches(images, Correspondences(tracks=found.tracks), None if rig.aligned else rig)
                found = replace(found, tracks=alone.tracks)
        if len(found.tracks) < self.fewest or still(found):
            rows = None if self.row_tolerance is None else ROW_TOLERANCE_PX
            sift = SiftMatcher(refine=True, half=self.half, row_tolerance=rows)
            more = sift.match(images) if rig is None else sift.match_of_rig(images, rig)
            if still(found) or len(found.tracks) == 0:
                return more
            tracks = np.concatenate([found.tracks, more.tracks])
            return replace(more, tracks=tracks, **_halves(found.tracks, more))
        return replace(found, **_halves(found.tracks))


def _halves(tracks: FloatArray, more: Correspondences | None = None) -> dict[str, FloatArray]:
    """The pairwise sets: the given matches, followed by the pairs of the tracks."""
    own = {"left": track_pairs(tracks, "left"), "right": track_pairs(tracks, "right")}
    own |= {"stereo_0": tracks[:, :4], "stereo_1": tracks[:, 4:]}
    return own if more is None else {name: np.concatenate([getattr(more, name), own[name]]) for name in own}


_FLOW_BLUR_PX = 1.0
_BORDER_PX = 8
"""Half the size of a patch, which must not contain mirrored pixels beyond the border of an image."""
_MOST_PX = 1.5
"""Largest change of an end by the alignment, pixels of the level."""
_RETURN_PX = 1.0
"""Largest distance between a pixel and the end of its flow there and back, pixels of the level."""
_FLAT = 0.002
"""Least strength of a corner, as a share of that of strong ones."""
_FLOOR_PX = 0.02
"""Standard deviation of an end that grey levels do not predict."""
_SMALLEST, _SMALLEST_CELL = 64, 6
"""Least width or height of a level, and of a cell, px."""
_TRIED = 2.5
"""Number of places that are tried for each requested track."""
_REMEMBERED, _LARGE = 4, 2_500_000
"""Number of image pairs whose flow is cached, and number of pixels above which it is not cached."""


def dense_tracks(images: Mapping[View, NDArray[Any]], options: DenseOptions | None = None) -> Correspondences:
    """Tracks, with their covariance, of four images (H, W[, 3]) of one size, uint8 or uint16, in ideal pixels.

    The covariance is the mean of those of the three later ends relative to the first one. There may be no tracks.
    Raises ValueError if the images differ in size or are of another type.
    """
    options = options or DenseOptions()
    grey = {view: grey_u8(images[view]) for view in VIEWS}
    shape = grey["left", 0].shape
    for (side, frame), image in grey.items():
        if image.shape != shape:
            raise ValueError(f"{side}_{frame} must have the size of left_0, {shape}, got {image.shape}")
    if options.half:
        grey = {view: halved(image) for view, image in grey.items()}
    flows, tracks, covariances = (
        _flows(grey, options.row_tolerance is not None),
        list[FloatArray](),
        list[FloatArray](),
    )
    for level in range(options.levels):
        found = _of_level(grey, flows, level, options)
        tracks.append(found.tracks)
        covariances.append(found.covariance)
        if sum(map(len, tracks)) >= options.enough:
            break
    together, covariance = np.concatenate(tracks), np.concatenate(covariances)
    if len(together) > options.enough:
        best = _worth_taking(covariance, options.enough)
        together, covariance = together[best], covariance[best]
    if options.half:
        scale = _scale(shape, grey["left", 0].shape)
        together, covariance = _resized(together, scale), covariance * _products(scale)
    inside = np.all((together >= 0.0) & (together <= np.tile(np.array(shape[::-1]) - 1.0, 4)), axis=1)
    return Correspondences(tracks=together[inside], covariance=covariance[inside])


def _worth_taking(covariance: FloatArray, least: int) -> NDArray[np.int64]:
    """Mask of the tracks, at least ``least``, for which an unweighted mean would have the smallest variance."""
    variance = 0.5 * (covariance[:, 0] + covariance[:, 2]) + _FLOOR_PX**2
    order, count = np.argsort(variance, kind="stable"), np.arange(1, len(variance) + 1)
    of_mean = np.cumsum(variance[order]) / count**2
    return np.sort(order[: max(least, int(np.argmin(of_mean)) + 1)])


class _Flows(NamedTuple):
    """Flows (H, W, 2), px: left 0 to left 1, left 0 to right 0, left 1 to right 1; and back."""

    there: tuple[F32, ...]
    back: tuple[F32, ...]


def _flows(grey: Mapping[View, U8], beside: bool) -> _Flows:
    """``beside``: whether both ends of a left-right match lie on one row."""
    l0, r0, l1, r1 = (grey[side, frame] for frame in (0, 1) for side in ("left", "right"))
    tasks = ((l0, l1, False), (l0, r0, beside), (l1, r1, beside))
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(lambda task: _both_ways(*task), tasks))
    there, back = zip(*found, strict=True)
    return _Flows(there, back)


class _Pair(NamedTuple):
    there: F32
    back: F32


_KEPT: Recent[_Pair] = Recent(_REMEMBERED)


def forget_matches() -> None:
    """Clear the caches of features and flows, so that later calls compute them again: for timings."""
    forget_features()
    _KEPT.clear()


def _both_ways(first: U8, second: U8, along_rows: bool) -> _Pair:
    """Flow from one grey image to another and back, cached because neighbouring windows share a frame."""
    if first.size > _LARGE:
        return _found_both_ways(first, second, along_rows)
    key = content_key(first), content_key(second), along_rows
    return _KEPT.get(key, lambda: _found_both_ways(first, second, along_rows))


def _found_both_ways(first: U8, second: U8, along_rows: bool) -> _Pair:
    a, b = (np.asarray(cv2.GaussianBlur(image, (0, 0), _FLOW_BLUR_PX)) for image in (first, second))
    start = start_of_flow(a, b, along_rows)
    there, back = (None, None) if start is None else (_field(each, a.shape) for each in (start, _inverse(start)))
    return _Pair(dense_flow(a, b, there, quick=True), dense_flow(b, a, back, quick=True))


def stereo_by_flow(left: NDArray[Any], right: NDArray[Any]) -> FloatArray:
    """Matches (n, 4), px, of two images (H, W[, 3]) of one size, on any rows, accurate to a fraction of a pixel.

    They begin at corners and end where flows end that lead back to their start; ``dense_tracks`` of these images
    uses the same flows. Small images have none.
    """
    a, b = grey_u8(left), grey_u8(right)
    if min(a.shape) < _SMALLEST:
        return np.zeros((0, 4))
    flows, points = _both_ways(a, b, True), corners(_reduced(a, a.shape), DenseOptions.points)
    ends = points + _at(flows.there, points)
    return np.concatenate([points, ends], axis=1)[_returns(flows.back, ends, points, 0.5 * _RETURN_PX)]


def _returns(back: F32, ends: FloatArray, points: FloatArray, most: float) -> BoolArray:
    return np.asarray(np.linalg.norm(ends + _at(back, ends) - points, axis=1) <= most)


class _Found(NamedTuple):
    """Results of one level, in pixels of the images."""

    tracks: FloatArray
    """(n, 8)"""
    covariance: FloatArray
    """(n, 3)"""


def _of_level(grey: Mapping[View, U8], flows: _Flows, level: int, options: DenseOptions) -> _Found:
    height, width = grey["left", 0].shape
    shape = height >> level, width >> level
    if min(shape) < _SMALLEST:
        return _Found(np.zeros((0, 8)), np.zeros((0, 3)))
    scale, rows = _scale((height, width), shape), options.row_tolerance
    pixel = float(np.max(scale))
    small = {view: _reduced(image, shape) for view, image in grey.items()}
    source = corners(small["left", 0], options.points)

    def followed(points: FloatArray, number: int) -> tuple[FloatArray, BoolArray]:
        ends = points + _at(flows.there[number], points)
        good = _returns(flows.back[number], ends, points, _RETURN_PX * pixel)
        if number and rows is not None:
            good &= np.abs(ends[:, 1] - points[:, 1]) <= rows * pixel
            ends[:, 1] = points[:, 1]
        return ends, good & np.all((ends >= 0.0) & (ends <= [width - 1.0, height - 1.0]), axis=1)

    first = _resized(source, scale)
    (l1, moved), (r0, beside_0) = followed(first, 0), followed(first, 1)
    r1, beside_1 = followed(l1, 2)
    smooth = {view: smooth_spline(image) for view, image in small.items()}
    left, places = np.flatnonzero(moved & beside_0 & beside_1), {view: source.copy() for view in VIEWS}
    covariance = np.zeros((len(source), 3))
    for view, ends in ((("right", 0), r0), (("left", 1), l1), (("right", 1), r1)):
        near = (ends[left] + 0.5) / scale - 0.5
        found = _aligned(smooth["left", 0], smooth[view], source[left], near, options.most_deviation)
        left = left[found.done]  # points lost in one image are not searched in the next one
        places[view][left] = found.places[found.done]
        covariance[left] += found.covariance[found.done] / 3.0
    tracks = np.concatenate([places[side, frame][left] for frame in (0, 1) for side in SIDES], axis=1)
    tracks, covariance = _resized(tracks, scale), covariance[left] * _products(scale)
    if rows is None:
        return _Found(tracks, covariance)
    off = np.maximum(np.abs(tracks[:, 1] - tracks[:, 3]), np.abs(tracks[:, 5] - tracks[:, 7]))
    on_rows = off <= rows * pixel
    return _Found(tracks[on_rows], covariance[on_rows])


def _aligned(a: F32, b: F32, points_a: FloatArray, points_b: FloatArray, most_deviation: float) -> Aligned:
    """``align`` in several threads."""
    parts = [np.array_split(points, os.cpu_count() or 1) for points in (points_a, points_b)]
    with ThreadPoolExecutor() as pool:
        found = pool.map(lambda p, q: align(a, b, p, q, None, _MOST_PX, most_deviation), *parts)
    return Aligned(*map(np.concatenate, zip(*found, strict=True)))


def corners(image: F32, most: int) -> FloatArray:
    """Pixels (n, 2), at most ``most``: the best corner, by Shi and Tomasi, of each of that many cells.

    ``image`` (H, W) are grey levels. Cells without texture, and the border, have none.
    """
    height, width = image.shape
    strength = cv2.cornerMinEigenVal(cv2.GaussianBlur(image, (0, 0), _FLOW_BLUR_PX), 7, ksize=3)
    cell = max(_SMALLEST_CELL, math.ceil(math.sqrt(height * width / most)))
    down, across = (height - 2 * _BORDER_PX) // cell, (width - 2 * _BORDER_PX) // cell
    inner = strength[_BORDER_PX:, _BORDER_PX:][: down * cell, : across * cell]
    cells = inner.reshape(down, cell, across, cell).swapaxes(1, 2).reshape(down * across, cell * cell)
    best = np.argmax(cells, axis=1)
    value, (row, column) = np.max(cells, axis=1), np.divmod(np.arange(len(best)), across)
    places = np.stack([column * cell + best % cell, row * cell + best // cell], axis=1) + float(_BORDER_PX)
    return places[value > _FLAT * np.percentile(value, 98.0)]


_BLOCKS = (7, 5)
"""Numbers of blocks across and down."""
_REACH = 0.3
"""Reach of the search for a block, in widths of the image."""
_TEXTURE, _ALIKE = 4.0, 0.6
"""Least standard deviation of the grey levels of a block, and least correlation."""
_FEWEST_BLOCKS, _BLOCK_PX = 6, 3.0
"""Least number of blocks for an affine map, and their largest distance from it, pixels of the small image."""
_MOVED = 0.02
"""Displacement of a corner, in widths of the image, below which flow needs no start."""


def start_of_flow(first: U8, second: U8, along_rows: bool = False) -> FloatArray | None:
    """Affine map (2, 3), px, from one grey image (H, W) to another; None if it is unknown or close to no motion.

    Blocks are searched by normalised correlation at a quarter or an eighth of the size; ``along_rows``: only in
    their row.
    """
    height, width = first.shape
    shape = tuple(side // (8 if width > 1000 else 4) for side in first.shape)
    block = max(16, shape[1] // 7)
    if 2 * min(shape) < 3 * block:
        return None
    a, b = (_reduced(image, shape) for image in (first, second))
    down = 1 if along_rows else int(_REACH * shape[1])
    across, found = int(_REACH * shape[1]), list[tuple[float, float, float, float]]()
    for y in np.linspace(0, shape[0] - block, _BLOCKS[1]).astype(int).tolist():
        for x in np.linspace(0, shape[1] - block, _BLOCKS[0]).astype(int).tolist():
            patch = a[y : y + block, x : x + block]
            if np.std(patch) < _TEXTURE:
                continue
            top, near = max(0, y - down), max(0, x - across)
            window = b[top : y + block + down, near : x + block + across]
            _, score, _, (dx, dy) = cv2.minMaxLoc(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED))
            if score > _ALIKE:
                found.append((x, y, near + dx, top + dy))
    if len(found) < _FEWEST_BLOCKS:
        return None
    ends = (np.stack(np.split(np.array(found), 2, axis=1)) + 0.5 * block) * _scale(first.shape, shape) - 0.5
    least = _BLOCK_PX * width / shape[1]
    affine, kept = cv2.estimateAffine2D(ends[0], ends[1], ransacReprojThreshold=least)
    if affine is None or np.count_nonzero(kept) < _FEWEST_BLOCKS or not np.linalg.det(affine[:, :2]) > 0.1:
        return None
    rims = np.array([[x, y] for x in (0.0, width) for y in (0.0, height)])
    moved = rims @ affine[:, :2].T + affine[:, 2] - rims
    return np.asarray(affine) if np.max(np.abs(moved)) > _MOVED * width else None


def _inverse(affine: FloatArray) -> FloatArray:
    back = np.asarray(np.linalg.inv(affine[:, :2]), dtype=np.float64)
    return np.column_stack([back, -back @ affine[:, 2]])


def _field(affine: FloatArray, shape: tuple[int, ...]) -> F32:
    """The flow (H, W, 2) of an affine map."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    ends = [row[0] * x + row[1] * y + row[2] for row in affine]
    return np.stack([ends[0] - x, ends[1] - y], axis=-1).astype(np.float32)


def _at(field: F32, points: FloatArray) -> FloatArray:
    """Values (n, 2) of a flow at points (n, 2), px; beyond the border the value at the border."""
    places = points.astype(np.float32)[:, None]
    if len(points) == 0:
        return np.zeros((0, 2))
    found = cv2.remap(field, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _reduced(image: U8, shape: tuple[int, ...]) -> F32:
    """Grey levels averaged to a smaller or equal shape (h, w), not rounded."""
    return np.asarray(cv2.resize(image.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA))


def _scale(shape: tuple[int, ...], small: tuple[int, ...]) -> FloatArray:
    """(2,) size in x and y, px, of a pixel of the smaller image."""
    return np.array([shape[1] / small[1], shape[0] / small[0]])


def _resized(points: FloatArray, scale: FloatArray) -> FloatArray:
    """Convert points (n, 2 k), px of a smaller image, to px of the larger one."""
    return ((points.reshape(-1, 2) + 0.5) * scale - 0.5).reshape(points.shape)


def _products(scale: FloatArray) -> FloatArray:
    """(3,) factors of xx, xy, yy."""
    return np.array([scale[0] ** 2, scale[0] * scale[1], scale[1] ** 2])
