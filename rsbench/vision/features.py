"""Sub-pixel point correspondences of a stereo rig over two frames: SIFT, ratio test, mutual check, alignment.

SIFT runs with ``enable_precise_upscale``: OpenCV's default enlarges the image by mapping index x to 2x + 0.5 and
so reports every keypoint a quarter of a pixel too far right and down (measured 0.249, 0.244 px; 0.000 with it).
Positions then follow this package's convention, centre of the top-left pixel (0, 0).

SIFT descriptors are whole numbers up to 255 with a squared length below 2**24, so their products are exact in
float32 whatever the order of the sums: the nearest descriptors depend neither on the BLAS nor on its threads.

A keypoint detector places each end of a match on its own, to about a tenth of a pixel. ``refine_matches`` fits the
grey levels of the patch at one end to the other image by an affine map, a gain and a bias, which leaves a few
hundredths. A plain shift is not enough: on a patch that is rotated or slanted it errs by a tenth itself.

Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004. Gruen, "Adaptive least squares
correlation", South African Journal of Photogrammetry 1985; the iteration is the inverse compositional one of
Baker and Matthews, IJCV 2004.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, Self, TypeVar, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.arguments import check_ranges
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import BoolArray, Correspondences, track_pairs, unlinked_pairs
from rsbench.core.rig import SIDES, AlignedCamera, Side, StereoRig, View
from rsbench.core.so3 import FloatArray
from rsbench.vision.feature_matcher import FeatureMatcher
from rsbench.vision.images import SPLINE_INVERSE, at_full_size, grey_u8, halved, map_frames, spline_weights

_CHUNK = 256
F32 = NDArray[np.float32]
Found = tuple[NDArray[np.int64], F32, F32, NDArray[np.int64]]


def best_two(
    points_a: FloatArray,
    descriptors_a: F32,
    points_b: FloatArray,
    descriptors_b: F32,
    dx: tuple[float, float],
    dy: tuple[float, float],
) -> Found:
    """For each descriptor in a: its best candidate in b, and the squared distances of the best and the
    second-best; for each in b: the best in a.

    Points (n, 2) must be sorted by y; the candidates b of a point a are those with b - a within ``dx`` and ``dy``
    (px, both ends included). Indices are -1 and distances inf if there is no candidate.
    """
    n, m = len(points_a), len(points_b)
    best, nearest = np.full(n, -1, dtype=np.int64), np.full(n, np.inf, dtype=np.float32)
    second, back = np.full(n, np.inf, dtype=np.float32), np.full(m, -1, dtype=np.int64)
    back_nearest = np.full(m, np.inf, dtype=np.float32)
    norms_a: F32 = np.asarray(np.sum(descriptors_a * descriptors_a, axis=1, dtype=np.float32))
    norms_b: F32 = np.asarray(np.sum(descriptors_b * descriptors_b, axis=1, dtype=np.float32))
    window = np.array([*dx, *dy], dtype=np.float64)
    for start in range(0, n, _CHUNK):
        stop = min(start + _CHUNK, n)
        low = int(np.searchsorted(points_b[:, 1], points_a[start, 1] + dy[0] - 1.0))
        high = int(np.searchsorted(points_b[:, 1], points_a[stop - 1, 1] + dy[1] + 1.0))
        if low >= high:
            continue
        products = descriptors_a[start:stop] @ descriptors_b[low:high].T
        _scan(
            products,
            norms_a,
            norms_b,
            points_a,
            points_b,
            start,
            low,
            window,
            best,
            nearest,
            second,
            back,
            back_nearest,
        )
    return best, nearest, second, back


@compiled
def _scan(
    products: F32,
    norms_a: F32,
    norms_b: F32,
    points_a: FloatArray,
    points_b: FloatArray,
    start: int,
    low: int,
    window: FloatArray,
    best: NDArray[np.int64],
    nearest: F32,
    second: F32,
    back: NDArray[np.int64],
    back_nearest: F32,
) -> None:
    """Update the results with one block of products, rows from ``start`` of a, columns from ``low`` of b."""
    rows, columns = products.shape
    for r in range(rows):
        i = start + r
        x, y = points_a[i, 0], points_a[i, 1]
        for c in range(columns):
            j = low + c
            distance = norms_a[i] + norms_b[j] - np.float32(2.0) * products[r, c]
            # Most candidates improve nothing; only the others are tested against the window.
            if distance >= second[i] and distance >= back_nearest[j]:
                continue
            dx, dy = points_b[j, 0] - x, points_b[j, 1] - y
            if dx < window[0] or dx > window[1] or dy < window[2] or dy > window[3]:
                continue
            if distance < nearest[i]:
                second[i] = nearest[i]
                nearest[i], best[i] = distance, j
            elif distance < second[i]:
                second[i] = distance
            if distance < back_nearest[j]:
                back_nearest[j], back[j] = distance, i


_BLUR_PX = 0.8
"""Standard deviation of the smoothing of images, px."""
_HALF = 7
"""Patches are 2 _HALF + 1 px wide, with Gaussian weights."""
_SPREAD = 0.6 * _HALF
_ROUNDS, _CONVERGED_PX = 12, 1e-3
_MOST_PX, _MOST_SHEAR, _MOST_GAIN = 1.0, 0.5, 0.5
"""Largest changes: of the place, of an element of the affine map, and of the contrast."""
_MOST_SIGMA_PX = 0.1
"""Largest standard deviation of an accepted place, px, computed from the gradients and the residuals of the patch.
"""
_PARAMETERS = 8
_LEFT: Side = "left"
_RIGHT: Side = "right"


def refine_matches(
    images: Mapping[View, NDArray[Any]], matches: Correspondences, rig: StereoRig | None = None
) -> Correspondences:
    """Align the later ends of matches to their first ends; an end that cannot be aligned stays as it is.

    The first end is the one in the left image of frame 0, otherwise in the right one, otherwise in the left image
    of frame 1. Copies of a track in several sets remain equal. The order within a set may change, except in
    ``left`` if it has affine frames.

    Args:
        images: (H, W) or (H, W, 3), uint8 or uint16, of both cameras and frames, in whose pixels the matches are.
        rig: its cameras may differ in scale and orientation; None: they are equal.
    """
    across = np.eye(2) if rig is None else rig.right_by_left()
    with ThreadPoolExecutor() as pool:
        views: list[View] = [("left", 0), ("right", 0), ("left", 1), ("right", 1)]
        smooth = dict(zip(views, pool.map(lambda view: smoothed(images[view]), views), strict=True))
        tracks, left, right = matches.tracks, matches.left, matches.right[unlinked_pairs(matches, _RIGHT)]
        stereo_0, stereo_1 = (_not_of_tracks(matches, frame) for frame in (0, 1))
        tasks = [
            (views[0], views[1], tracks[:, 0:2], tracks[:, 2:4]),
            (views[0], views[2], tracks[:, 0:2], tracks[:, 4:6]),
            (views[0], views[3], tracks[:, 0:2], tracks[:, 6:8]),
            (views[0], views[2], left[:, :2], left[:, 2:]),
            (views[1], views[3], right[:, :2], right[:, 2:]),
            (views[0], views[1], stereo_0[:, :2], stereo_0[:, 2:]),
            (views[2], views[3], stereo_1[:, :2], stereo_1[:, 2:]),
        ]
        found = list(
            pool.map(
                lambda t: (
                    align(
                        smooth[t[0]], smooth[t[1]], t[2], t[3], across if t[0][0] != t[1][0] else np.eye(2)
                    ).places
                ),
                tasks,
            )
        )
    tracks = np.concatenate([tracks[:, :2], *found[:3]], axis=1)
    return replace(
        matches,
        tracks=tracks,
        left=np.concatenate([left[:, :2], found[3]], axis=1),
        right=np.concatenate([track_pairs(tracks, _RIGHT), np.concatenate([right[:, :2], found[4]], axis=1)]),
        stereo_0=np.concatenate([tracks[:, :4], np.concatenate([stereo_0[:, :2], found[5]], axis=1)]),
        stereo_1=np.concatenate([tracks[:, 4:], np.concatenate([stereo_1[:, :2], found[6]], axis=1)]),
    )


def _not_of_tracks(matches: Correspondences, frame: int) -> FloatArray:
    """The left-right matches of a frame that are not part of a track."""
    rows = matches.stereo_1 if frame else matches.stereo_0
    half = matches.tracks[:, 4 * frame : 4 * frame + 4]
    return rows[unlinked_pairs(Correspondences(left=rows, tracks=half[:, [0, 1, 0, 1, 2, 3, 2, 3]]), _LEFT)]


def smoothed(image: NDArray[Any]) -> F32:
    """Return ``smooth_spline`` of the grey levels of an image (H, W[, 3]), uint8 or uint16."""
    return smooth_spline(grey_u8(image).astype(np.float32))


def smooth_spline(levels: F32) -> F32:
    """Coefficients (H, W) of the cubic B-spline through the smoothed grey levels (H, W), from which patches are
    taken.

    A kernel on the levels themselves smooths noise and aliasing most in the middle between two pixels, where
    patches therefore seem to match better. On aliased textures, Keys' kernel pulls matches there by 0.02 px, the
    spline by 0.003 px.
    """
    return np.asarray(cv2.sepFilter2D(levels, -1, _SMOOTHING, _SMOOTHING))


def _smoothing() -> F32:
    """Kernel of the smoothing and of ``SPLINE_INVERSE``."""
    found = np.convolve(np.exp(-0.5 * (np.arange(-6, 7) / _BLUR_PX) ** 2), SPLINE_INVERSE)
    return np.asarray(found / np.sum(found), dtype=np.float32)


_SMOOTHING = _smoothing()


class Aligned(NamedTuple):
    """Places of patches of one image in another image."""

    places: FloatArray
    """(n, 2) px; the given place if the patch cannot be aligned."""
    done: BoolArray
    """(n,) whether the patch was aligned."""
    covariance: FloatArray
    """(n, 3) xx, xy, yy, px^2, from the gradients and residuals of the patch; valid for aligned patches. Smoothing
    correlates the residuals: this common factor is not included."""


def align(
    a: F32,
    b: F32,
    points_a: FloatArray,
    points_b: FloatArray,
    start: FloatArray | None = None,
    most_px: float = _MOST_PX,
    most_sigma: float = _MOST_SIGMA_PX,
) -> Aligned:
    """Align patches at points of a with places in b nearby.

    Args:
        a, b: (H, W) images from ``smoothed`` or ``smooth_spline``.
        points_a, points_b: (n, 2) px; a point that cannot be aligned keeps its place in b.
        start: (2, 2) approximate affine map from the pixels around a point of a to those of b; None: the identity.
        most_px: largest change of a place.
        most_sigma: largest standard deviation of an accepted place, px.
    """
    out = np.array(points_b, dtype=np.float64)
    done, covariance = np.zeros(len(out), dtype=np.bool_), np.zeros((len(out), 3))
    start = np.eye(2) if start is None else np.ascontiguousarray(start)
    source = np.ascontiguousarray(points_a, dtype=np.float64)
    _align_all(a, b, source, start, (most_px, most_sigma), out, done, covariance)
    return Aligned(out, done, covariance)


@compiled(error_model="numpy", fastmath={"contract"})
def _sample(image: F32, x: float, y: float) -> np.float32:
    """The smoothed image at a place; ``image`` has the coefficients, and the window of 4 x 4 px lies inside it."""
    i, j = int(x), int(y)
    wx, wy = spline_weights(np.float32(x - i)), spline_weights(np.float32(y - j))
    total = np.float32(0.0)
    for k in range(4):
        row = image[j - 1 + k]
        total += wy[k] * (wx[0] * row[i - 1] + wx[1] * row[i] + wx[2] * row[i + 1] + wx[3] * row[i + 2])
    return total


@compiled(error_model="numpy", fastmath={"contract"})
def _template(image: F32, x: float, y: float, grid: F32, J: F32) -> None:
    """Derivatives (8, n) of the patch's grey levels by the parameters; the last two are 1 and the levels."""
    size = 2 * _HALF + 3
    for j in range(size):
        for i in range(size):
            grid[j, i] = _sample(image, x + i - _HALF - 1, y + j - _HALF - 1)
    half, k = np.float32(0.5), 0
    for j in range(1, size - 1):
        for i in range(1, size - 1):
            gx, gy = half * (grid[j, i + 1] - grid[j, i - 1]), half * (grid[j + 1, i] - grid[j - 1, i])
            u, v = np.float32(i - _HALF - 1), np.float32(j - _HALF - 1)
            J[0, k], J[1, k], J[2, k], J[3, k], J[4, k], J[5, k] = gx, gy, gx * u, gx * v, gy * u, gy * v
            J[6, k], J[7, k] = np.float32(1.0), grid[j, i]
            k += 1


@compiled(error_model="numpy")
def _align_all(
    a: F32,
    b: F32,
    points: FloatArray,
    start: FloatArray,
    most: tuple[float, float],
    places: FloatArray,
    done: BoolArray,
    covariance: FloatArray,
) -> None:
    size = 2 * _HALF + 1
    grid, J = (
        np.zeros((size + 2, size + 2), dtype=np.float32),
        np.zeros((_PARAMETERS, size * size), dtype=np.float32),
    )
    weights = np.zeros(size * size)
    for k in range(size * size):
        weights[k] = np.exp(-((k % size - _HALF) ** 2 + (k // size - _HALF) ** 2) / (2.0 * _SPREAD**2))
    margin = _HALF + 3
    for n in range(len(points)):
        x, y = points[n]
        if not (margin <= x < a.shape[1] - margin and margin <= y < a.shape[0] - margin):
            continue
        _template(a, x, y, grid, J)
        done[n] = _align(b, J, weights, start, most, places[n], covariance[n])


@compiled(error_model="numpy")
def _align(
    b: F32,
    J: F32,
    weights: FloatArray,
    start: FloatArray,
    most: tuple[float, float],
    place: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Move one place (2,) to the best fit of the patch; return False, without a move, if there is none."""
    H, row = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros(J.shape[1])
    for p in range(_PARAMETERS):
        for k in range(len(row)):
            row[k] = weights[k] * J[p, k]
        for q in range(p + 1):
            H[p, q] = H[q, p] = _dot(row, J[q])
        H[p, p] *= 1.0 + 1e-9
        if not H[p, p] > 0.0:
            return False
    inverse = np.linalg.inv(H)
    x, y, gain, bias = place[0], place[1], 1.0, 0.0
    A = start.copy()
    residuals, slope = np.zeros(len(row)), np.zeros(_PARAMETERS)
    for _ in range(_ROUNDS):
        if not _residuals(b, J, A, x, y, gain, bias, residuals):
            return False
        for k in range(len(row)):
            row[k] = weights[k] * residuals[k]
        for p in range(_PARAMETERS):
            slope[p] = _dot(row, J[p])
        step = inverse @ slope
        _compose_inverse(A, 1.0 + step[2], step[3], step[4], 1.0 + step[5])
        dx, dy = A[0, 0] * step[0] + A[0, 1] * step[1], A[1, 0] * step[0] + A[1, 1] * step[1]
        x, y, bias, gain = x - dx, y - dy, bias + step[6], gain + step[7]
        if not (abs(x - place[0]) < most[0] and abs(y - place[1]) < most[0]):
            return False
        if dx * dx + dy * dy < _CONVERGED_PX**2:
            break
    shear = np.max(np.abs(A - start))
    left = np.sum(weights * residuals**2) / np.sum(weights)
    covariance[0], covariance[1], covariance[2] = left * inverse[0, 0], left * inverse[0, 1], left * inverse[1, 1]
    variance = left * max(inverse[0, 0], inverse[1, 1])
    if not (shear < _MOST_SHEAR and abs(gain - 1.0) < _MOST_GAIN and variance < most[1] ** 2):
        return False
    place[0], place[1] = x, y
    return True


@compiled(error_model="numpy")
def _compose_inverse(A: FloatArray, a: float, b: float, c: float, d: float) -> None:
    """Multiply A (2, 2) by the inverse of ((a, b), (c, d)) on the right; not finite if there is none."""
    det = a * d - b * c
    for row in range(2):
        p, q = A[row, 0], A[row, 1]
        A[row, 0], A[row, 1] = (p * d - q * c) / det, (q * a - p * b) / det


@compiled(error_model="numpy")
def _residuals(
    b: F32, J: F32, A: FloatArray, x: float, y: float, gain: float, bias: float, out: FloatArray
) -> bool:
    """Grey levels of b under the patch less the patch's; False where it leaves the image."""
    reach_x, reach_y = _HALF * (abs(A[0, 0]) + abs(A[0, 1])) + 2.0, _HALF * (abs(A[1, 0]) + abs(A[1, 1])) + 2.0
    if not (reach_x <= x < b.shape[1] - reach_x - 1.0 and reach_y <= y < b.shape[0] - reach_y - 1.0):
        return False
    k = 0
    for v in range(-_HALF, _HALF + 1):
        for u in range(-_HALF, _HALF + 1):
            level = _sample(b, x + A[0, 0] * u + A[0, 1] * v, y + A[1, 0] * u + A[1, 1] * v)
            out[k] = level - (gain * J[7, k] + bias)
            k += 1
    return True


@compiled(error_model="numpy", fastmath={"reassoc", "contract"})
def _dot(a: FloatArray, b: F32) -> float:
    """Scalar product, with terms added in any order, so that vector instructions can be used."""
    total = 0.0
    for k in range(len(a)):
        total += a[k] * b[k]
    return total


T = TypeVar("T")


class Recent(Generic[T]):
    """Cache of the most recently requested results, with a limited number; threads may share it.

    Two threads that request the same at the same time both compute it.
    """

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, threading.Lock()
        self._kept = OrderedDict[Hashable, T]()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result of ``make``, or that of an earlier call with an equal key."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        found = make()
        with self._lock:
            self._kept[key] = found
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return found

    def clear(self) -> None:
        """Remove all results."""
        with self._lock:
            self._kept.clear()


def content_key(image: NDArray[Any]) -> Hashable:
    """Return a key that is equal for images of equal size, type and content."""
    digest = hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=16).digest()
    return digest, image.shape, image.dtype.str


Indices = NDArray[np.int64]
_MOST_FEATURES = 100_000
ROW_TOLERANCE_PX = 1.5
_STILL_PX = 0.01
_DETECTION_BYTES = 300.0
"""Bytes per pixel: the float32 pyramids of twice the size, and of their differences."""
_RANGES = {
    "max_features": (0, _MOST_FEATURES),
    "contrast_threshold": (0.0, 1.0),
    "edge_threshold": (1.0, 1e6),
    "ratio": (1e-6, 1.0),
    "max_distance": (1e-6, 1e6),
    "search_radius": (1e-6, 1e6),
    "row_tolerance": (1e-6, 1e6),
    "max_disparity": (1e-6, 1e6),
    "enough_tracks": (0, _MOST_FEATURES),
}


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Options of features and matches; distances between descriptors are SIFT's, 0 to about 720."""

    max_features: int = 6000
    """Number of strongest features kept per image; 0 keeps all, 100 000 at most."""
    contrast_threshold: float = 0.04
    """OpenCV's contrast threshold of SIFT: features with less contrast are dropped."""
    edge_threshold: float = 10.0
    """OpenCV's edge threshold of SIFT: features more edge-like than this are dropped."""
    ratio: float = 0.8
    """Largest ratio of the best to the second-best distance."""
    max_distance: float = 300.0
    """Largest distance of a match; the ratio does not apply where there is only one candidate."""
    search_radius: float | None = None
    """Largest displacement of temporal matches in x and in y, px; None searches the whole image."""
    row_tolerance: float | None = ROW_TOLERANCE_PX
    """Largest difference of rows of left-right matches if both cameras read a row at the same time. None if they
    do not: the partner may lie anywhere."""
    max_disparity: float | None = None
    """Largest disparity of left-right matches, px; None is the image width."""
    drop_contradicted: bool = True
    """Drop a temporal match if its loop through the other camera ends at another place."""
    refine: bool = False
    """Align the ends of matches by the grey levels around them, see ``refine_matches``."""
    enough_tracks: int = 0
    """Return only tracks if there are at least this many, which is faster; 0 returns all matches."""
    half: bool = False
    """Find features at half the size, which is faster but gives fewer; for matches that are then aligned
    (``refine``)."""
    affine: bool = False
    """Add affine frames to left matches: similarities from the sizes and orientations of the keypoints."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)


@final
@dataclass(frozen=True, kw_only=True)
class SiftMatcher(MatchOptions, FeatureMatcher):
    """SIFT features, matched by ``match_stereo_frames``."""

    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        return self._matched(images, None)

    def match_of_rig(self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig) -> Correspondences:
        """Features are found in the images as they are: interpolating them would add a tenth to the noise."""
        return self._matched(images, rig)

    def apart(self) -> Self:
        return replace(self, row_tolerance=None)

    def with_enough(self, tracks: int) -> Self:
        return replace(self, enough_tracks=tracks)

    def faster(self) -> Self:
        return replace(self, half=True)

    def _matched(self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig | None) -> Correspondences:
        four = (images["left", 0], images["right", 0], images["left", 1], images["right", 1])
        matches = match_stereo_frames(*four, self, rig)
        alone = 0 < self.enough_tracks <= len(matches.tracks)
        if alone:
            matches = Correspondences(tracks=matches.tracks)
        if self.refine and not still(matches):
            matches = refine_matches(images, matches, None if rig is None or rig.aligned else rig)
        return Correspondences(tracks=matches.tracks) if alone else matches


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Keypoints of one image, sorted by the rows of their places."""

    points: FloatArray
    """(n, 2) px."""
    places: FloatArray
    """(n, 2) ideal px."""
    descriptors: NDArray[np.float32]
    """(n, 128), whole numbers from 0 to 255."""
    frames: FloatArray
    """(n, 2) first column of the matrix that rotates and scales the unit square to the keypoint: its diameter, px,
    times the cosine and the sine of its orientation, from x towards y."""


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Region of the partner of a keypoint: bounds, px, of partner minus keypoint."""

    dx: tuple[float, float]
    dy: tuple[float, float]


_DETECTED, _PAIRED = Recent[Features](28), Recent[Indices](42)
"""Sizes for 12 windows: a sequence requests each image in two windows, and again after its shutter was estimated.
"""
_REMEMBERED = 10_000
"""Images with more features, 6 MB, are not cached."""


def forget_features() -> None:
    """Clear the cache of features, so that later calls compute them again: for timings."""
    _DETECTED.clear()
    _PAIRED.clear()


def detect(
    image: NDArray[Any], options: MatchOptions | None = None, camera: PinholeCamera | AlignedCamera | None = None
) -> Features:
    """SIFT features of an image (H, W) or (H, W, 3), uint8 or uint16; none in an image without texture.

    Args:
        camera: the camera of the image; None: its pixels are ideal. Features without a ray in it are dropped.
    """
    options, grey = options or MatchOptions(), grey_u8(image)
    if not 0 < options.max_features <= _REMEMBERED:
        return _detected(grey, options, camera)
    key = (
        content_key(grey),
        options.max_features,
        options.contrast_threshold,
        options.edge_threshold,
        options.half,
        camera,
    )
    return _DETECTED.get(key, lambda: _detected(grey, options, camera))


def _detected(
    grey: NDArray[np.uint8], options: MatchOptions, camera: PinholeCamera | AlignedCamera | None
) -> Features:
    sift = cv2.SIFT.create(
        nfeatures=options.max_features or _MOST_FEATURES,
        contrastThreshold=options.contrast_threshold,
        edgeThreshold=options.edge_threshold,
        enable_precise_upscale=True,
    )
    keypoints, descriptors = sift.detectAndCompute(halved(grey) if options.half else grey, None)
    if not keypoints:
        empty = np.zeros((0, 2))
        return Features(points=empty, places=empty, descriptors=np.zeros((0, 128), dtype=np.float32), frames=empty)
    points = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
    points = at_full_size(points, grey.shape) if options.half else points
    places = points if camera is None else camera.ideal_pixels(points)
    order = np.lexsort((places[:, 0], places[:, 1]))
    order = order[np.all(np.isfinite(places[order]), axis=1)]
    size, angle = np.array([(k.size, np.deg2rad(k.angle)) for k in keypoints]).T[:, order]
    frames = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Features(points=points[order], places=places[order], descriptors=descriptors[order], frames=frames)


def match(a: Features, b: Features, gate: Gate, options: MatchOptions | None = None) -> Indices:
    """Mutual nearest neighbours (m, 2), indices into ``a`` and ``b``; each is the best of its candidates in the
    gate.

    The ratio test compares with the second-best candidate in the gate. Points with several orientations give the
    same match several times; only one is kept.
    """
    options = options or MatchOptions()
    if max(len(a.points), len(b.points)) > _REMEMBERED:
        return _paired(a, b, gate, options)
    key = a, b, gate, options.ratio, options.max_distance
    return _PAIRED.get(key, lambda: _paired(a, b, gate, options))


def _paired(a: Features, b: Features, gate: Gate, options: MatchOptions) -> Indices:
    best, nearest, second, back = best_two(a.places, a.descriptors, b.places, b.descriptors, gate.dx, gate.dy)
    rows = np.flatnonzero(best >= 0)
    mutual = back[best[rows]] == rows
    distinct = nearest[rows] <= options.ratio**2 * second[rows]
    rows = rows[mutual & distinct & (nearest[rows] <= options.max_distance**2)]
    pairs = np.stack([rows, best[rows]], axis=1)
    positions = np.concatenate([a.points[pairs[:, 0]], b.points[pairs[:, 1]]], axis=1)
    _, first = np.unique(positions, axis=0, return_index=True)
    return pairs[np.sort(first)]


def match_stereo_frames(
    left_0: NDArray[Any],
    right_0: NDArray[Any],
    left_1: NDArray[Any],
    right_1: NDArray[Any],
    options: MatchOptions | None = None,
    rig: StereoRig | None = None,
) -> Correspondences:
    """Correspondences of the four images (H, W[, 3]), uint8 or uint16, of a rig over two frames.

    With ``rig``, images and matches are in the pixels of its cameras, and the bounds of the options in ideal
    pixels. Tracks are points whose four matches close the loop L0-R0-R1-L1-L0. Sets may be empty. Raises
    ValueError if the images differ in size or are of another type.
    """
    options = options or MatchOptions()
    images = {"left_0": left_0, "right_0": right_0, "left_1": left_1, "right_1": right_1}
    for name, image in images.items():
        same, first = (
            ("left_0", left_0) if rig is None or rig.aligned else (f"{name[:-1]}0", images[f"{name[:-1]}0"])
        )
        if image.shape[:2] != first.shape[:2]:
            raise ValueError(f"{name} must have the size of {same}, {first.shape[:2]}, got {image.shape[:2]}")
    reach = float(max(left_0.shape)) if options.search_radius is None else options.search_radius
    anywhere = Gate(dx=(-reach, reach), dy=(-reach, reach))
    disparity = float(left_0.shape[1]) if options.max_disparity is None else options.max_disparity
    tolerance = options.row_tolerance
    beside = anywhere
    if tolerance is not None:
        beside = Gate(dx=(-disparity, -np.finfo(np.float64).tiny), dy=(-tolerance, tolerance))
    # OpenCV, the BLAS and the compiled loop release the GIL.
    pixels = left_0.shape[0] * left_0.shape[1]
    eyes = [None if rig is None else rig.eye(side) for side in (*SIDES, *SIDES)]
    l0, r0, l1, r1 = map_frames(
        lambda each: detect(each[0], options, each[1]),
        list(zip(images.values(), eyes, strict=True)),
        pixels,
        _DETECTION_BYTES,
    )
    tasks = ((l0, l1, anywhere), (r0, r1, anywhere), (l0, r0, beside), (l1, r1, beside))
    with ThreadPoolExecutor() as pool:
        left, right, stereo_0, stereo_1 = pool.map(lambda t: match(t[0], t[1], t[2], options), tasks)
    tracks = close_loops(left, right, stereo_0, stereo_1)
    if options.drop_contradicted:
        left, right = _agreeing(left, right, stereo_0, stereo_1)
    return Correspondences(
        left=_positions((l0, l1), left),
        affine=_similarities(l0.frames[left[:, 0]], l1.frames[left[:, 1]])[: None if options.affine else 0],
        right=_positions((r0, r1), right),
        stereo_0=_positions((l0, r0), stereo_0),
        stereo_1=_positions((l1, r1), stereo_1),
        tracks=_positions((l0, r0, l1, r1), tracks),
    )


def still(matches: Correspondences) -> bool:
    """Whether nothing moves between the frames: equal errors of all matches would leave solvers no noise to
    estimate."""
    pairs = matches.left, matches.right, matches.tracks[:, [0, 1, 4, 5]]
    moved = np.concatenate([each[:, 2:] - each[:, :2] for each in pairs])
    return len(moved) == 0 or float(np.median(np.abs(moved))) < _STILL_PX


def _similarities(a: FloatArray, b: FloatArray) -> FloatArray:
    """Affine frames (m, 4) that rotate and scale keypoint frames a (m, 2) to b: quotients of complex numbers.

    They do not include the effect of a slanted surface.
    """
    first = a / np.sum(a * a, axis=1, keepdims=True)
    c = np.sum(first * b, axis=1)
    s = first[:, 0] * b[:, 1] - first[:, 1] * b[:, 0]
    return np.stack([c, -s, s, c], axis=1)


def close_loops(left: Indices, right: Indices, stereo_0: Indices, stereo_1: Indices) -> Indices:
    """Tracks (n, 4), indices l0, r0, l1, r1, of pairs (m, 2) whose loop L0-R0-R1-L1-L0 closes."""
    r0 = _lookup(stereo_0, left[:, 0])
    r1 = _lookup(stereo_1, left[:, 1])
    closed = (r0 >= 0) & (r1 >= 0) & (_lookup(right, r0) == r1)
    return np.stack([left[closed, 0], r0[closed], left[closed, 1], r1[closed]], axis=1)


def _agreeing(left: Indices, right: Indices, stereo_0: Indices, stereo_1: Indices) -> tuple[Indices, Indices]:
    """The temporal matches that no loop contradicts: open loops are kept, loops that close at another place are
    dropped."""
    wanted = _lookup(stereo_1, left[:, 1])
    found = _lookup(right, _lookup(stereo_0, left[:, 0]))
    keep_left = (wanted < 0) | (found < 0) | (wanted == found)
    back_0, back_1 = stereo_0[:, ::-1], stereo_1[:, ::-1]
    wanted = _lookup(back_1, right[:, 1])
    found = _lookup(left, _lookup(back_0, right[:, 0]))
    keep_right = (wanted < 0) | (found < 0) | (wanted == found)
    return left[keep_left], right[keep_right]


def _lookup(pairs: Indices, keys: Indices) -> Indices:
    """Second entries of the pairs whose first entry is the key; -1 if there is none."""
    size = 1 + max(int(pairs[:, 0].max(initial=-1)), int(keys.max(initial=-1)), 0)
    table = np.full(size + 1, -1, dtype=np.int64)
    table[pairs[:, 0]] = pairs[:, 1]
    return table[np.where(keys >= 0, keys, size)]


def _positions(features: tuple[Features, ...], indices: Indices) -> FloatArray:
    return np.concatenate([f.points[i] for f, i in zip(features, indices.T, strict=True)], axis=1)
