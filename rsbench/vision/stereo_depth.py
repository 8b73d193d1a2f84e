"""Dense disparity of the rig's two images: semi-global matching, left-right check, sub-pixel refinement.

If both cameras read a row at the same time, the image pair is rectified like one with a global shutter, and
``disparity = x_left - x_right`` does not depend on the motion. If they read it at different times,
``moving_disparities`` and ``timed_depth`` use a known motion.

Hirschmueller, "Stereo processing by semi-global matching and mutual information", PAMI 2008 (OpenCV's StereoSGBM).

Semi-global matching interpolates its cost between whole disparities, which biases results by up to a quarter of a
pixel, depending on the fraction of the disparity (pixel locking). ``refine_disparity`` fits each pixel's disparity
to the images: in a window the disparity is a plane, ``d(u, v) = d + a u + b v``, and each window pixel q measures
``d_q + e_q / g_q`` with weight ``g_q^2``, i.e. its current disparity corrected by one Lucas-Kanade step along the
row (``e``: difference of the two images, ``g``: their slope). The matcher's value is included as a weak
measurement, so that windows without texture are smoothed and not lost. Pixels of other surfaces are excluded. For
smooth textures the bias falls from 0.25 px to 0.003 px and the median error from 0.15 px to 0.01 px.

Lucas and Kanade, IJCAI 1981; along the row only, on the rectified pair.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import Vector
from rsbench.core.arguments import check_ranges
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.images import SPLINE_INVERSE, grey_u8, guided_upsample, halved, resample, spline_weights
from rsbench.vision.stereo_matcher import (
    F32,
    MatcherEntry,
    StereoMatcher,
    between_pixels,
    body_depth,
    camera_of_body,
    find_disparities,
    level_pixels,
    own_depths,
    pixel_rays,
    seen_at,
    widened,
)

_RADIUS = 4  # a window is three times a whole number wide, see ``_fit_planes``
_SURFACE_STEP = np.float32(1.5)  # px of disparity between the centre and a window pixel of the same surface
_PRIOR = np.float32(
    4.0
)  # weight of the matcher's value, (grey levels per px)^2: half a grey level of noise against 1/4 px
_FARTHEST = 1.0  # px that the refinement may move a disparity
_BAND = 32  # rows of one piece of work


def refine_disparity(
    reference: NDArray[np.uint8], other: NDArray[np.uint8], disparity: F32, *, iterations: int = 2
) -> F32:
    """Refined disparity (H, W), px; NaN stays NaN. Grey images (H, W), ``reference`` as the left one.

    Rows are interpolated by cubic B-splines: Keys' kernel smooths most in the middle between two pixels, where
    aliased images therefore seem to match better, and shifts disparities by up to 0.05 px, splines by 0.012 px.
    """
    levels = reference.astype(np.float32)
    a, b = _along_rows(levels), _along_rows(other.astype(np.float32))
    start = np.ascontiguousarray(disparity, dtype=np.float32)
    current = start
    for _ in range(iterations):
        weight, pull, fitted = (np.zeros_like(start) for _ in range(3))
        _in_bands(len(a), lambda y0, y1: _measure(levels, a, b, current, y0, y1, weight, pull))  # noqa: B023
        padded = _padded(current, np.nan), _padded(weight, 0.0), _padded(pull, 0.0)
        _in_bands(len(a), lambda y0, y1: _fit_planes(*padded, y0, y1, fitted))  # noqa: B023
        current = np.clip(fitted, start - np.float32(_FARTHEST), start + np.float32(_FARTHEST))
    return current


def _along_rows(levels: F32) -> F32:
    """Coefficients (H, W) of the cubic B-splines through the rows of ``levels`` (H, W)."""
    kernel = (SPLINE_INVERSE / np.sum(SPLINE_INVERSE)).astype(np.float32)
    return np.asarray(cv2.sepFilter2D(levels, -1, kernel, np.ones(1, dtype=np.float32)))


def _padded(values: F32, beyond: float) -> F32:
    """Values (H, W) with ``_RADIUS`` more columns on both sides."""
    return np.pad(values, ((0, 0), (_RADIUS, _RADIUS)), constant_values=beyond)


def _in_bands(height: int, work: Callable[[int, int], None]) -> None:
    """Call ``work(first_row, end_row)`` over all rows, on all cores; the compiled loops run without the GIL."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pieces = [pool.submit(work, y, min(y + _BAND, height)) for y in range(0, height, _BAND)]
        for piece in pieces:
            piece.result()


@compiled(error_model="numpy")
def _measure(
    levels: F32, a: F32, b: F32, disparity: F32, first_row: int, end_row: int, weight: F32, pull: F32
) -> None:
    """Fill each pixel's weight, ``g^2`` plus that of the prior, and ``g e``, for a step of its disparity.

    ``g`` is the mean of the slopes along the row at the pixel and at its partner, and ``e`` is the difference of
    their grey levels. ``a`` and ``b`` have the splines' coefficients, ``levels`` those of the pixels themselves.
    """
    width = a.shape[1]
    for y in range(first_row, end_row):
        for x in range(width):
            weight[y, x] = _PRIOR
            at = x - disparity[y, x]
            if not (at > -1.0 and at < width):
                continue
            i = int(np.floor(at))
            t = np.float32(at - i)
            w0, w1, w2, w3 = spline_weights(t)
            before, here = b[y, min(max(i - 1, 0), width - 1)], b[y, min(max(i, 0), width - 1)]
            ahead, beyond = b[y, min(max(i + 1, 0), width - 1)], b[y, min(max(i + 2, 0), width - 1)]
            partner = w0 * before + w1 * here + w2 * ahead + w3 * beyond
            # The spline's derivative; on a whole pixel it is the coefficients' central difference, as for ``a``.
            bend = before - 2.0 * here + ahead
            twist = 3.0 * here - before - 3.0 * ahead + beyond
            slope_b = 0.5 * (ahead - before) + t * bend + 0.5 * t * t * twist
            slope_a = 0.5 * (a[y, min(x + 1, width - 1)] - a[y, max(x - 1, 0)])
            slope = 0.5 * (slope_a + slope_b)
            weight[y, x] += slope * slope
            pull[y, x] = slope * (partner - levels[y, x])


@compiled(error_model="numpy")
def _fit_planes(disparity: F32, weight: F32, pull: F32, first_row: int, end_row: int, fitted: F32) -> None:
    """Centre value of the plane fitted to each pixel's window; NaN where the disparity is NaN.

    ``disparity``, ``weight`` and ``pull`` have ``_RADIUS`` more columns on both sides, where the disparity is NaN.
    """
    height, width = fitted.shape
    line, window = np.zeros((5, width), np.float32), np.zeros((9, width))
    for y in range(first_row, end_row):
        centre = disparity[y, _RADIUS : _RADIUS + width]
        window[:] = 0.0
        for row in range(max(y - _RADIUS, 0), min(y + _RADIUS + 1, height)):
            line[:] = 0.0
            for first in range(0, 2 * _RADIUS + 1, 3):
                part, u = slice(first, first + width + 2), np.float32(first - _RADIUS)
                _add_three(
                    u,
                    centre,
                    disparity[row, part],
                    weight[row, part],
                    pull[row, part],
                    line[0],
                    line[1],
                    line[2],
                    line[3],
                    line[4],
                )
            _add_line(float(row - y), line, window)
        _fill_centres(centre, window, fitted[y])


@compiled(error_model="numpy", inline="always")
def _tap(offset: np.float32, weight: np.float32, pull: np.float32) -> tuple[np.float32, np.float32]:
    """Weight and weighted measurement of a window pixel: 0 if it is on another surface."""
    same = abs(offset) <= _SURFACE_STEP
    return (weight if same else np.float32(0.0)), (weight * offset + pull if same else np.float32(0.0))


@compiled(error_model="numpy")
def _add_three(
    u: np.float32,
    centre: F32,
    disparity: F32,
    weight: F32,
    pull: F32,
    w0: F32,
    wu: F32,
    wuu: F32,
    r0: F32,
    ru: F32,
) -> None:
    """Add the window pixels at columns u to u + 2 from every pixel of a row to its sums of w, w u, w u^2, r, r u.

    The loop over a row is contiguous and has no branch, so that the compiler can vectorise it.
    """
    one, two = u + np.float32(1.0), u + np.float32(2.0)
    for x in range(len(centre)):
        here = centre[x]
        w, r = _tap(disparity[x] - here, weight[x], pull[x])
        w_1, r_1 = _tap(disparity[x + 1] - here, weight[x + 1], pull[x + 1])
        w_2, r_2 = _tap(disparity[x + 2] - here, weight[x + 2], pull[x + 2])
        w0[x] = ((w0[x] + w) + w_1) + w_2
        wu[x] = ((wu[x] + w * u) + w_1 * one) + w_2 * two
        wuu[x] = ((wuu[x] + w * u * u) + w_1 * one * one) + w_2 * two * two
        r0[x] = ((r0[x] + r) + r_1) + r_2
        ru[x] = ((ru[x] + r * u) + r_1 * one) + r_2 * two


@compiled(error_model="numpy")
def _add_line(v: float, line: F32, window: FloatArray) -> None:
    """Add the sums of a window row, v rows below the centre, to (9, n): these 5, w v, w u v, w v^2, r v."""
    for x in range(line.shape[1]):
        w0, wu, r0 = line[0, x], line[1, x], line[3, x]
        for k in range(5):
            window[k, x] += line[k, x]
        window[5, x] += w0 * v
        window[6, x] += wu * v
        window[7, x] += w0 * v * v
        window[8, x] += r0 * v


@compiled(error_model="numpy")
def _fill_centres(centre: F32, window: FloatArray, fitted: F32) -> None:
    """Fill the values of the planes at the windows' centres, ``centre`` being the disparities there."""
    for x in range(len(centre)):
        w0, wu, wuu, r0, ru = window[0, x], window[1, x], window[2, x], window[3, x], window[4, x]
        wv, wuv, wvv, rv = window[5, x], window[6, x], window[7, x], window[8, x]
        # Moments about the weighted centre, regularised for windows one pixel wide, which have no slope across.
        uu, uv, vv = wuu - wu * wu / w0 + 0.1 * w0, wuv - wu * wv / w0, wvv - wv * wv / w0 + 0.1 * w0
        su, sv = ru - wu * r0 / w0, rv - wv * r0 / w0
        determinant = uu * vv - uv * uv
        slope_u, slope_v = (su * vv - sv * uv) / determinant, (sv * uu - su * uv) / determinant
        fitted[x] = centre[x] + (r0 - slope_u * wu - slope_v * wv) / w0


U8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]
_MODES = {
    "sgbm": cv2.StereoSGBM_MODE_SGBM,
    "hh": cv2.StereoSGBM_MODE_HH,
    "3way": cv2.StereoSGBM_MODE_SGBM_3WAY,
    "hh4": cv2.StereoSGBM_MODE_HH4,
}
_RANGES = {
    "num_disparities": (1, 1 << 16),
    "least_disparity": (1e-6, 1e6),
    "nearest_depth": (1e-6, 1e9),
    "block_size": (1, 51),
    "p1": (1, 100_000),
    "p2": (1, 100_000),
    "uniqueness_percent": (0, 100),
    "prefilter_cap": (0, 255),
    "speckle_window": (0, 1_000_000),
    "speckle_range": (0, 10_000),
    "consistency_px": (1e-6, 1e6),
    "refine_iterations": (0, 100),
}
"""Allowed ranges; beyond them the matcher overflows, or takes minutes for an image."""
_FRACTION = 16.0  # StereoSGBM counts sixteenths of a pixel
_COARSE = 4
_RANGE_MARGIN = 1.1
_RANGE_QUANTILE = 0.999


@dataclass(frozen=True, kw_only=True)
class SgmOptions:
    """Parameters of StereoSGBM and of the steps after it."""

    num_disparities: int | None = None
    """Number of disparities that are searched, from 0; None: derived from ``nearest_depth``."""
    least_disparity: float = 0.5
    """Smaller disparities are set to unknown: they hardly differ from infinity, or result without texture."""
    nearest_depth: float | None = None
    """Smallest depth, metres; None: the range is found by matching the images at a quarter of the size."""
    block_size: int = 5
    """Side of the matched window, pixels, odd."""
    p1: int = 8
    """Penalty of a disparity step of 1, times block_size squared."""
    p2: int = 32
    """Penalty of larger steps, times block_size squared."""
    mode: Literal["sgbm", "hh", "3way", "hh4"] = "3way"
    """Number of paths along which OpenCV sums costs: ``sgbm`` 5, ``hh`` 8, ``3way`` 3, ``hh4`` 4."""
    uniqueness_percent: int = 5
    """Per cent by which the best cost must be below the second-best."""
    prefilter_cap: int = 31
    """Horizontal derivatives are clipped to this before matching, grey levels."""
    speckle_window: int = 100
    """Connected regions of at most this many pixels are removed; 0: all are kept."""
    speckle_range: int = 2
    """Largest difference of disparity within a connected region, px."""
    consistency_px: float = 1.0
    """Largest difference between a pixel's disparity and that of its partner in the other image, px."""
    refine_iterations: int = 2
    """Number of least-squares iterations on the images, see ``refine_disparity``; 0: SGM's is kept."""
    half: bool = False
    """Match at half the size; depth edges are then aligned with edges of the full image."""

    def __post_init__(self) -> None:
        if self.mode not in _MODES:
            raise ValueError(f"mode must be one of {sorted(_MODES)}, got {self.mode!r}")
        if self.block_size % 2 == 0:
            raise ValueError(f"block_size = {self.block_size}: must be odd")
        if not self.p1 <= self.p2:
            raise ValueError(f"p1 = {self.p1}: must not exceed p2, {self.p2}")
        check_ranges(self, _RANGES)


@final
@dataclass(frozen=True, kw_only=True)
class SgmMatcher(SgmOptions, StereoMatcher):
    """Semi-global matching by ``stereo_disparities``."""

    def disparities(self, left: NDArray[Any], right: NDArray[Any], rig: StereoRig) -> tuple[F32, F32]:
        return stereo_disparities(left, right, rig, self)

    def limited(self, left: NDArray[Any], right: NDArray[Any], rig: StereoRig, seen: Sequence[Mask]) -> SgmMatcher:
        if self.num_disparities is not None or self.nearest_depth is not None:
            return self
        largest = _largest_disparity(*_greys(left, right, rig), self, seen)
        return replace(self, num_disparities=math.ceil(min(max(largest, 1.0), rig.camera.width)))


def stereo_disparity(
    left: NDArray[Any], right: NDArray[Any], rig: StereoRig, side: Side = "left", options: SgmOptions | None = None
) -> F32:
    """Disparity (H, W), px, on the pixels of one image; NaN where it is unknown. ``rig.depth`` gives metres.

    Images (H, W[, 3]) are uint8 or uint16. Pixels without a consistent partner are unknown, including the band
    that the other camera does not show. Raises ValueError if the images' sizes do not match the rig's.
    """
    options = options or SgmOptions()
    grey_left, grey_right = _greys(left, right, rig)
    raw_left, raw_right = _raw_pair(grey_left, grey_right, rig, options)
    if side == "left":
        return _finish(grey_left, grey_right, raw_left, raw_right, options)
    return _finish_mirrored(grey_left, grey_right, raw_left, raw_right, options)


def stereo_disparities(
    left: NDArray[Any], right: NDArray[Any], rig: StereoRig, options: SgmOptions | None = None
) -> tuple[F32, F32]:
    """Disparities on the left image's pixels and on the right image's; arguments as in ``stereo_disparity``."""
    options = options or SgmOptions()
    grey_left, grey_right = _greys(left, right, rig)
    raw_left, raw_right = _raw_pair(grey_left, grey_right, rig, options)
    return (
        _finish(grey_left, grey_right, raw_left, raw_right, options),
        _finish_mirrored(grey_left, grey_right, raw_left, raw_right, options),
    )


def _greys(left: NDArray[Any], right: NDArray[Any], rig: StereoRig) -> tuple[U8, U8]:
    greys = grey_u8(left), grey_u8(right)
    size = (rig.camera.height, rig.camera.width)
    for name, grey in zip(SIDES, greys, strict=True):
        if grey.shape != size:
            raise ValueError(f"{name} image must have the camera's size {size}, got {grey.shape}")
    return greys


def _raw_pair(left: U8, right: U8, rig: StereoRig, options: SgmOptions) -> tuple[F32, F32]:
    """The matcher's disparities on the left image's pixels and on the right image's."""
    count = disparity_range(left, right, rig, options)
    if not options.half:
        return _match_both(left, right, count, options)
    small, scale = (halved(left), halved(right)), left.shape[1] / max(left.shape[1] // 2, 1)
    coarse = replace(options, least_disparity=options.least_disparity / scale)
    raws = _match_both(*small, 16 * math.ceil(count / scale / 16), coarse)
    pieces = zip(raws, small, (left, right), strict=True)
    found = [guided_upsample(raw, image, full) * np.float32(scale) for raw, image, full in pieces]
    return found[0], found[1]


def _match_both(left: U8, right: U8, count: int, options: SgmOptions) -> tuple[F32, F32]:
    # In mirrored images the right camera is the left one, so the same matcher serves both.
    return _sgm(left, right, count, options), _mirrored(_sgm(_mirrored(right), _mirrored(left), count, options))


def _finish(reference: U8, other: U8, raw: F32, raw_other: F32, options: SgmOptions) -> F32:
    """Check disparities against the other image's, remove speckles and refine; ``reference`` is the left image."""
    kept = _without_speckles(_consistent(raw, raw_other, options.consistency_px), options)
    return refine_disparity(reference, other, kept, iterations=options.refine_iterations)


def _finish_mirrored(left: U8, right: U8, raw_left: F32, raw_right: F32, options: SgmOptions) -> F32:
    """``_finish`` for the right image as the reference."""
    raws = _mirrored(raw_right), _mirrored(raw_left)
    return _mirrored(_finish(_mirrored(right), _mirrored(left), *raws, options))


def disparity_range(left: U8, right: U8, rig: StereoRig, options: SgmOptions) -> int:
    """Number of disparities to search, a multiple of 16, from the options or from grey images (H, W)."""
    width = left.shape[1]
    if options.num_disparities is not None:
        largest = float(options.num_disparities)
    elif options.nearest_depth is not None:
        largest = float(rig.disparity(options.nearest_depth))
    else:
        largest = _largest_disparity(left, right, options)
    return 16 * math.ceil(min(max(largest, 1.0), width) / 16)


def _largest_disparity(left: U8, right: U8, options: SgmOptions, seen: Sequence[Mask] | None = None) -> float:
    """Estimate the largest disparity at reduced size. With masks ``seen`` (H, W), only pixels are used that both
    images show, also if infinitely far: others match black areas, at wrong, large disparities."""
    small = (max(left.shape[1] // _COARSE, 1), max(left.shape[0] // _COARSE, 1))
    a, b = (cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in (left, right))
    count = 16 * math.ceil(small[0] / 2 / 16)
    found = _consistent(*_match_both(a, b, count, options), options.consistency_px)
    if seen is not None:
        here, there = (cv2.resize(np.float32(each), small, interpolation=cv2.INTER_AREA) == 1.0 for each in seen)
        partner = np.maximum(np.rint(np.arange(small[0]) - np.nan_to_num(found)).astype(np.int64), 0)
        both = here & there & np.take_along_axis(there, partner, axis=1)
        coarse = replace(options, speckle_window=options.speckle_window // _COARSE)
        found = _without_speckles(np.where(both, found, np.float32(np.nan)), coarse)
    found = found[np.isfinite(found)]
    if found.size == 0:
        return 16.0
    return _COARSE * (float(np.quantile(found, _RANGE_QUANTILE)) * _RANGE_MARGIN + 1.0)


def _sgm(reference: U8, other: U8, count: int, options: SgmOptions) -> F32:
    """Raw disparity (H, W) of ``reference`` as the left image, NaN where there is none."""
    # SGBM does not match the first ``count`` columns, so add as many as padding.
    a, b = (cv2.copyMakeBorder(image, 0, 0, count, 0, cv2.BORDER_REPLICATE) for image in (reference, other))
    area = options.block_size**2
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=options.block_size,
        P1=options.p1 * area,
        P2=options.p2 * area,
        disp12MaxDiff=-1,
        preFilterCap=options.prefilter_cap,
        uniquenessRatio=options.uniqueness_percent,
        speckleWindowSize=0,
        speckleRange=0,
        mode=_MODES[options.mode],
    )
    disparity = np.asarray(matcher.compute(a, b)[:, count:], dtype=np.float32) / np.float32(_FRACTION)
    # Matches beyond the other image's border are matches to padding.
    columns = np.arange(disparity.shape[1], dtype=np.float32)
    return np.where(
        (disparity >= options.least_disparity) & (columns - disparity >= 0.0), disparity, np.float32(np.nan)
    )


def _consistent(reference: F32, other: F32, tolerance: float) -> F32:
    """``reference`` (as the left image) where the partner's disparity in ``other`` agrees to the tolerance, px."""
    columns = np.arange(reference.shape[1])
    partner = np.rint(columns - np.nan_to_num(reference)).astype(np.int64)
    back = np.take_along_axis(other, np.clip(partner, 0, reference.shape[1] - 1), axis=1)
    return np.where(np.abs(reference - back) <= tolerance, reference, np.float32(np.nan))


def _without_speckles(disparity: F32, options: SgmOptions) -> F32:
    if options.speckle_window == 0:
        return disparity
    fixed = np.where(np.isnan(disparity), -_FRACTION, disparity * _FRACTION).astype(np.int16)
    cv2.filterSpeckles(fixed, -_FRACTION, options.speckle_window, options.speckle_range * _FRACTION)
    return np.where(fixed >= 0, disparity, np.float32(np.nan))


def _mirrored(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def fill_holes(disparity: F32) -> F32:
    """Disparity (H, W) with its holes filled along the rows by the farther of the two neighbours.

    Surfaces that are hidden from one camera lie behind the hiding ones, so the smaller disparity is the better
    guess. Rows without any value stay unknown.
    """
    return np.fmin(*known_beside(disparity))


def known_beside(values: F32) -> tuple[F32, F32]:
    """Nearest finite value (H, W) at or left of each pixel, and at or right of it; NaN where there is none."""
    left, right = np.empty_like(values), np.empty_like(values)
    _fill_beside(values, left, right)
    return left, right


@compiled(error_model="numpy")
def _fill_beside(values: F32, left: F32, right: F32) -> None:
    height, width = values.shape
    for y in range(height):
        before, after = np.float32(np.nan), np.float32(np.nan)
        for x in range(width):
            before = values[y, x] if abs(values[y, x]) < np.inf else before
            left[y, x] = before
        for x in range(width - 1, -1, -1):
            after = values[y, x] if abs(values[y, x]) < np.inf else after
            right[y, x] = after


def seen_by_other(depth: NDArray[Any], other_depth: NDArray[Any], rig: StereoRig, side: Side) -> NDArray[np.bool_]:
    """Pixels (H, W) whose point is visible in the other camera too, from the true depth of both, metres.

    A point is visible if it lies inside the other image and the disparity there is the same up to a pixel, so that
    nothing nearer hides it. This holds for a rolling shutter too if both cameras read a row at the same time; with
    a lens, the difference between the times is negligible at this tolerance.
    """
    sign, there_side = (1.0, "right") if side == "left" else (-1.0, "left")
    other_camera = rig.eye(there_side)
    disparity = np.nan_to_num(rig.disparity(body_depth(depth, rig, side)))
    other = np.nan_to_num(rig.disparity(body_depth(other_depth, rig, there_side)))
    row, column = np.indices(depth.shape)
    ideal = rig.eye(side).ideal_pixels(np.stack([column, row], axis=-1))
    partner = other_camera.lens_pixels(np.stack([ideal[..., 0] - sign * disparity, ideal[..., 1]], axis=-1))
    x, y = np.moveaxis(np.rint(np.nan_to_num(partner, nan=-1.0)).astype(np.int64), -1, 0)
    height, width = other_depth.shape
    inside = (disparity > 0.0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    there = other[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return inside & (np.abs(there - disparity) <= 1.0)


def depth_metrics(
    estimate: NDArray[Any], truth: NDArray[Any], rig: StereoRig, part: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Errors of a depth map (H, W), metres, over the surface pixels of ``truth`` (finite and positive).

    ``part`` (H, W) restricts them to some of these pixels. ``coverage`` is the share of surface pixels with an
    estimate (finite and positive), over which the errors are computed: ``median_m`` and ``rmse_m`` of the absolute
    depth error, ``over_2m`` the share above 2 m (the paper's figure), ``bad_1px`` .. ``bad_3px`` the share above
    that disparity error. ``on_sky`` is the share of pixels without a surface, in any part, that have an estimate.
    Values without pixels are NaN. Raises ValueError if the shapes differ.
    """
    if estimate.shape != truth.shape:
        raise ValueError(f"estimate must have the shape of truth, {truth.shape}, got {estimate.shape}")
    surface, given = (np.isfinite(depth) & (depth > 0.0) for depth in (truth, estimate))
    sky = ~surface
    if part is not None:
        surface &= part
    known = surface & given
    depth, true_depth = estimate[known].astype(np.float64), truth[known].astype(np.float64)
    error = np.abs(depth - true_depth)
    shift = np.abs(rig.disparity(depth) - rig.disparity(true_depth))
    some = error.size > 0
    return {
        "median_m": float(np.median(error)) if some else math.nan,
        "rmse_m": float(np.sqrt(np.mean(error * error))) if some else math.nan,
        "over_2m": float(np.mean(error > 2.0)) if some else math.nan,
        **{f"bad_{n}px": float(np.mean(shift > n)) if some else math.nan for n in (1, 2, 3)},
        "on_sky": float(np.mean(given[sky])) if np.any(sky) else math.nan,
        "coverage": int(np.count_nonzero(known)) / max(int(np.count_nonzero(surface)), 1),
    }


_SMOOTH_LEVELS = 2.0
"""Largest standard deviation of 3 x 3 pixels of sky, grey levels."""
_LEAST_SHARE = 0.002
"""Smallest area of sky as a share of the image."""
_FAR_QUANTILE = 0.4
"""Quantile of all disparities that the surroundings of sky must not exceed."""
_RIM = 7
_REDDER = 6.0
"""Largest difference of the mean red and the mean blue of sky, levels."""


def sky_mask(image: NDArray[Any], disparity: NDArray[np.float32]) -> Mask:
    """Pixels (H, W) that look like sky in ``image`` (H, W[, 3] RGB), uint8 or uint16.

    ``disparity`` (H, W), px, NaN where unknown.
    """
    grey = grey_u8(image).astype(np.float32)
    mean = cv2.blur(grey, (3, 3))
    deviation = np.sqrt(np.maximum(cv2.blur(grey * grey, (3, 3)) - mean * mean, 0.0))
    smooth = (deviation <= _SMOOTH_LEVELS).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(smooth, connectivity=4)
    sky = np.zeros(grey.shape, dtype=np.bool_)
    known = np.isfinite(disparity)
    if not np.any(known):
        return sky
    far = float(np.quantile(disparity[known], _FAR_QUANTILE))
    brightness = float(np.median(grey))
    for label in range(1, count):
        if stats[label, cv2.CC_STAT_TOP] > 0 or stats[label, cv2.CC_STAT_AREA] < _LEAST_SHARE * grey.size:
            continue
        area = labels == label
        if float(np.mean(grey[area])) >= brightness and _is_blue(image, area) and _is_far(area, disparity, far):
            sky |= area
    # Windows of 3 x 3 pixels at an edge are not smooth, so add the missing pixel along the sky's border.
    return cv2.dilate(sky.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _is_blue(image: NDArray[Any], area: Mask) -> bool:
    if image.ndim == 2 or image.shape[2] == 1:
        return True
    levels = 1.0 if image.dtype == np.uint8 else 257.0
    red, blue = (float(np.mean(image[..., channel][area])) / levels for channel in (0, 2))
    return red - blue <= _REDDER


def _is_far(area: Mask, disparity: NDArray[np.float32], far: float) -> bool:
    """Whether most surroundings of the area are far; an area with unknown surroundings may be sky."""
    grown = cv2.dilate(area.astype(np.uint8), np.ones((2 * _RIM + 1, 2 * _RIM + 1), np.uint8)) > 0
    rim = disparity[grown & ~area]
    rim = rim[np.isfinite(rim)]
    return rim.size == 0 or float(np.quantile(rim, 0.25)) <= far


def timed_depth(
    depth: F32, rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int
) -> F32:
    """Convert depth (H, W), metres, of a rig at rest to depth of a moving rig at each line's time.

    A pixel and its disparity give the point's pixel in the other camera; with a lens, that is on another line,
    which is read at another time. The result is the depth at which the other camera, at its pose of that time,
    shows the point in that column. Unknown (0) and infinite depth stays; points behind a camera become infinite.
    """
    pair = _pair({each: _eye(rig, shutter, motion, each, frame) for each in SIDES}, rig.ideal, side)
    own = np.ones(depth.shape, np.float32) if rig.aligned else own_depths(rig, side)
    out, other = depth.copy(), "right" if side == "left" else "left"
    # Linear map from a line of this camera to the line of the other camera that is read at the same time.
    (a, b), (c, d) = (shutter.line_time(np.array([0.0, 1.0]), frame, each) for each in (side, other))
    same = (0.0, 0.0) if c == d else (float((a - c) / (d - c)), float((b - a) / (d - c)))
    _fill_timed(depth, own, pixel_rays(rig, side), pair, same, out)
    return out


_ROUNDS, _SETTLED, _STILL_PX = 4, 0.02, 0.5
"""Most rounds of matching at reduced size; they end if the resampling of less than this share of the pixels
changed by more than the third value, px. Delayed cameras take two or three rounds, opposite scans all."""
_SMALL, _LEAST_SIDE = 4, 60
"""Reduction of the size, and smallest side of a reduced image, px. The last round is at full size."""
_STEPS, _SAME_LINE = 6, 0.03
"""Most iterations for the line of a point, each of which multiplies the error by the motion, px, during one line;
change of the line at which they end: places are exact to that share of the motion, px, during one line."""
_ONE_SURFACE_PX = 1.0
"""Results are not interpolated between neighbours whose displacement differs by more than this, px."""
_ORDINARY = 1 / 32
"""Typical disparity, as a share of the width of the level image."""
_SMOOTH = 5
"""Window of the median filter on inverse depth, px, before images are resampled by it."""


class _Eye(NamedTuple):
    """One camera of the rig for compiled loops, and the poses of its lines, in the body's axes."""

    turn: FloatArray
    """(3, 3) from rays to homogeneous pixels of the camera itself without its lens."""
    lens: FloatArray
    """(14,) ``Optics.lens``; for a camera without a lens, one without distortion."""
    lines: FloatArray
    """(lines, 12) rotation and translation of each line."""
    columns: bool
    size: tuple[int, int]
    """Width and height."""


class _Pair(NamedTuple):
    """The camera whose disparities are estimated, the other one, and their level (rectified) images."""

    eye: _Eye
    other: _Eye
    level: tuple[float, float, float, float]
    """fx, fy, cx, cy."""
    shift: float
    """Disparity, px, from the other level image to the camera's own, for an inverse depth of 1 / m."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Slope of the level images' row 0 in the body's axes, and the increase of the slope per row."""


def moving_disparities(
    entry: MatcherEntry,
    images: Mapping[Side, NDArray[np.uint8]],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    frame: int,
) -> tuple[F32, F32]:
    """Disparities (H, W) on the pixels of both cameras, ideal px, NaN where unknown; by any matcher and scan.

    A disparity is the one that the other camera would have shown at the time of the pixel: ``rig.depth`` converts
    it to depth along the body's z from the camera at the time of the pixel's line. ``images`` are (H, W[, 3]).

    As the rig moves between both times, epipolar lines have the direction of another baseline, and the level
    images are tilted accordingly. The remaining displacement depends on depth: that of the left image is estimated
    in rounds at a quarter of the size and then at full size; the estimate for the right image starts from it.

    Raises:
        RsbenchError: see ``find_disparities``.
    """
    eyes = {side: _eye(rig, shutter, motion, side, frame) for side in SIDES}
    level, gain = replace(rig.ideal, camera=widened(rig)), rig.camera.fx * rig.baseline
    tilt, own, shown = _tilt(_pair(eyes, level, "left"), level), dict[Side, U8](), dict[Side, Mask]()
    level, tilt, pad = _heightened(level, tilt)
    for side in SIDES:
        places = np.full((level.camera.height, level.camera.width, 2), np.nan, np.float32)
        _fill_places(_pair(eyes, level, side, tilt), places)
        own[side], shown[side] = resample(images[side], places), np.isfinite(places[..., 0])
    rho = _first_guess(entry, own["left"], images["right"], level, _pair(eyes, level, "left", tilt))
    found = list[F32]()
    for side, other in (SIDES, SIDES[::-1]):
        pair = _pair(eyes, level, side, tilt)
        ends, rays = _ends(pair, rho)
        seen = resample(images[other], ends)
        if side == "left":  # the disparities of the right image are the same ones
            masks = shown[side], np.isfinite(ends[..., 0])
            entry = replace(entry, component=entry.component.limited(own[side], seen, level, masks))
        here = _of_one(entry, own[side], seen, level, side)
        disparity = np.full_like(here, np.nan)
        _fill_disparities(here, rays, pair, disparity)
        rho = _without_holes(disparity / np.float32(gain))
        found.append(between_pixels(disparity, _untilted(level_pixels(rig, side), pair, pad)))
    return found[0], found[1]


def _tilt(pair: _Pair, level: StereoRig) -> tuple[float, float]:
    """``_Pair.tilt``: slopes of epipolar lines between infinity and a typical disparity."""
    camera = level.camera.resized(level.camera.width // _SMALL, level.camera.height // _SMALL)
    small = pair._replace(level=(camera.fx, camera.fy, camera.cx, camera.cy), shift=camera.fx * level.baseline)
    step = max(round(camera.width * _ORDINARY), 1)
    far = np.zeros((camera.height, camera.width), np.float32)
    (_, there), (_, near) = _ends(small, far), _ends(small, far + np.float32(step / small.shift))
    with np.errstate(invalid="ignore", divide="ignore"):
        along, across = np.moveaxis(near[:, :-step] - there[:, step:], -1, 0)
        slopes = across / along
    known = np.isfinite(slopes).sum(axis=1) > slopes.shape[1] // 4
    if np.count_nonzero(known) < 2:
        return 0.0, 0.0
    rows = ((np.arange(camera.height) + 0.5) * (level.camera.height / camera.height) - 0.5)[known]
    steeper, first = np.polyfit(rows, np.nanmedian(slopes[known], axis=1), 1)
    return float(first), float(steeper)


def _heightened(level: StereoRig, tilt: tuple[float, float]) -> tuple[StereoRig, tuple[float, float], int]:
    """The level images with rows added above and below, so that nothing is cut off; their tilt; the number."""
    camera = level.camera
    x = max(camera.cx, camera.width - 1 - camera.cx) / camera.fx
    steepest = max(abs(tilt[0]), abs(tilt[0] + tilt[1] * (camera.height - 1)))
    pad = min(math.ceil(steepest * x * camera.fy), camera.height // 4)
    taller = replace(camera, height=camera.height + 2 * pad, cy=camera.cy + pad)
    return replace(level, camera=taller), (tilt[0] - tilt[1] * pad, tilt[1]), pad


def _untilted(places: FloatArray, pair: _Pair, pad: int) -> FloatArray:
    """Pixels (H, W, 2) of the tilted level image for those of the image without tilt and without ``pad`` rows."""
    (fx, fy, cx, _), (first, steeper) = pair.level, pair.tilt
    x, out = (places[..., 0] - cx) / fx, places.copy()
    out[..., 1] = (places[..., 1] + pad - fy * first * x) / (1.0 + fy * steeper * x)
    return out


def _eye(rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int) -> _Eye:
    poses, camera = rig.eye_from_world(motion, shutter.line_times(frame, side), side), rig.sensor(side)
    lines = np.concatenate([poses.R.reshape(-1, 9), poses.t], axis=1)
    return _Eye(*camera_of_body(rig, side), lines, shutter.axis(side) == 0, (camera.width, camera.height))


def _pair(
    eyes: Mapping[Side, _Eye], level: StereoRig, side: Side, tilt: tuple[float, float] = (0.0, 0.0)
) -> _Pair:
    camera, gain = level.camera, level.camera.fx * level.baseline
    numbers = camera.fx, camera.fy, camera.cx, camera.cy
    if side == "left":
        return _Pair(eyes["left"], eyes["right"], numbers, gain, tilt)
    return _Pair(eyes["right"], eyes["left"], numbers, -gain, tilt)


def _first_guess(entry: MatcherEntry, own: U8, there: U8, level: StereoRig, pair: _Pair) -> F32:
    """Estimate inverse depth (H, W), 1 / m, on the right level image in rounds at a reduced size.

    Args:
        own: left level image (H, W[, 3]).
        there: the right camera's image.
    """
    size = level.camera.width, level.camera.height
    shrink = max(min(_SMALL, min(size) // _LEAST_SIDE), 1)
    width, height = size[0] // shrink, size[1] // shrink
    level, down = replace(level, camera=level.camera.resized(width, height)), size[1] / height
    tilt = pair.tilt[0] + pair.tilt[1] * 0.5 * (down - 1.0), pair.tilt[1] * down
    pair = _pair({"left": pair.eye, "right": pair.other}, level, "left", tilt)
    taken = max(pair.other.size[0] // shrink, 1), max(pair.other.size[1] // shrink, 1)
    scale = np.divide(taken, pair.other.size).astype(np.float32)
    small, there = (
        np.asarray(cv2.resize(image, to, interpolation=cv2.INTER_AREA))
        for image, to in ((own, (width, height)), (there, taken))
    )
    rho, before = np.zeros((height, width), np.float32), None
    for _ in range(_ROUNDS):
        ends, rays = _ends(pair, rho)
        ends = (ends + np.float32(0.5)) * scale - np.float32(0.5)
        if before is not None and np.mean(np.abs(ends - before).max(axis=-1) > _STILL_PX) < _SETTLED:
            break
        before = ends
        right = find_disparities(entry, small, resample(there, ends), level)[1]
        rho = np.full_like(right, np.nan)
        _fill_inverse_depths(right, rays, pair, rho)
        rho = _without_holes(rho)
    return np.asarray(cv2.resize(rho, size, interpolation=cv2.INTER_LINEAR))


def _of_one(entry: MatcherEntry, own: U8, seen: U8, level: StereoRig, side: Side) -> F32:
    """Disparity (H, W) on one level image; the built-in matcher computes only this one, to save time."""
    left, right = (own, seen) if side == "left" else (seen, own)
    if isinstance(entry.component, SgmMatcher):
        return stereo_disparity(left, right, level, side, entry.component)
    return find_disparities(entry, left, right, level)[SIDES.index(side)]


def _ends(pair: _Pair, rho: F32) -> tuple[F32, F32]:
    """For each pixel of the other level image: its pixel in the other image at the time when that is read.

    Returns pixels (H, W, 2) of the other image, NaN outside it, and x / z, y / z (H, W, 2) of the rays. The level
    image is that at the times of the partner pixels in the own camera; ``rho`` is (H, W), 1 / m.
    """
    ends, rays = (np.full((*rho.shape, 2), np.nan, np.float32) for _ in range(2))
    _fill_ends(rho, pair, ends, rays)
    return ends, rays


def _without_holes(rho: F32) -> F32:
    """Inverse depth (H, W) with holes filled by the farther neighbour in the row, and median-filtered."""
    filled = fill_holes(rho)
    anywhere = np.nanmedian(filled) if np.any(np.isfinite(filled)) else 0.0
    filled = np.where(np.isfinite(filled), filled, np.float32(anywhere)).astype(np.float32)
    return np.asarray(cv2.medianBlur(filled, _SMOOTH))


@compiled(error_model="numpy", inline="always")
def _level_ray(pair: _Pair, column: float, row: int) -> tuple[float, float]:
    """x / z, y / z of a pixel of the level images."""
    x = (column - pair.level[2]) / pair.level[0]
    return x, (row - pair.level[3]) / pair.level[1] + (pair.tilt[0] + pair.tilt[1] * row) * x


@compiled(error_model="numpy")
def _fill_places(pair: _Pair, places: F32) -> None:
    """Fill the pixels (H, W, 2) of the own camera for those of its level image; NaN outside the image."""
    eye = pair.eye
    for row in range(places.shape[0]):
        for column in range(places.shape[1]):
            x, y = _level_ray(pair, column, row)
            u, v = seen_at(eye.turn, eye.lens, x, y, 1.0)
            if -0.5 <= u <= eye.size[0] - 0.5 and -0.5 <= v <= eye.size[1] - 0.5:
                places[row, column, 0], places[row, column, 1] = u, v


@compiled(error_model="numpy", inline="always")
def _line(eye: _Eye, along: float) -> tuple[int, float]:
    """The line before a position, and the weight of the next one for linear interpolation of poses.

    Its error is an eighth of the squared rotation between two lines, 1e-10 for a fast one.
    """
    last = len(eye.lines) - 1
    at = min(max(along, -last), 2.0 * last) if along == along else 0.0
    below = min(max(int(np.floor(at)), 0), last - 1)
    return below, at - below


@compiled(error_model="numpy", inline="always")
def _pose(lines: FloatArray, below: int, s: float, k: int) -> Vector:
    """Components 3 k to 3 k + 2 of a pose between lines."""
    a, b, c = lines[below, 3 * k], lines[below, 3 * k + 1], lines[below, 3 * k + 2]
    return (
        a + s * (lines[below + 1, 3 * k] - a),
        b + s * (lines[below + 1, 3 * k + 1] - b),
        c + s * (lines[below + 1, 3 * k + 2] - c),
    )


@compiled(error_model="numpy")
def _fill_ends(rho: F32, pair: _Pair, ends: F32, rays: F32) -> None:
    eye, other = pair.eye, pair.other
    width, height = other.size
    for row in range(rho.shape[0]):
        shift = 0.0
        for column in range(rho.shape[1]):
            far = rho[row, column]
            x, y = _level_ray(pair, column + pair.shift * far, row)
            u, v = seen_at(eye.turn, eye.lens, x, y, 1.0)
            if not abs(u + v) < np.inf:
                continue
            below, s = _line(eye, u if eye.columns else v)
            a, b = _pose(eye.lines, below, s, 0), _pose(eye.lines, below, s, 1)
            c, t = _pose(eye.lines, below, s, 2), _pose(eye.lines, below, s, 3)
            p, q, r = x - far * t[0], y - far * t[1], 1.0 - far * t[2]
            X = a[0] * p + b[0] * q + c[0] * r
            Y = a[1] * p + b[1] * q + c[1] * r
            Z = a[2] * p + b[2] * q + c[2] * r
            p, q = _level_ray(pair, column, row)
            u, v = seen_at(other.turn, other.lens, p, q, 1.0)
            start = u if other.columns else v
            before = start + shift
            for _ in range(_STEPS):
                below, s = _line(other, before)
                a, b = _pose(other.lines, below, s, 0), _pose(other.lines, below, s, 1)
                c, t = _pose(other.lines, below, s, 2), _pose(other.lines, below, s, 3)
                p = a[0] * X + a[1] * Y + a[2] * Z + far * t[0]
                q = b[0] * X + b[1] * Y + b[2] * Z + far * t[1]
                r = c[0] * X + c[1] * Y + c[2] * Z + far * t[2]
                u, v = seen_at(other.turn, other.lens, p, q, r)
                along = u if other.columns else v
                if abs(along - before) < _SAME_LINE:
                    break
                before = along
            shift = before - start if abs(before - start) < np.inf else 0.0  # about that of the next pixel
            rays[row, column, 0], rays[row, column, 1] = p / r, q / r
            if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                ends[row, column, 0], ends[row, column, 1] = u, v


@compiled(error_model="numpy", inline="always")
def _inverse_depth(pair: _Pair, x: float, y: float, p: float, q: float) -> float:
    """``_rho`` if both cameras show these rays, else NaN."""
    eye, other = pair.eye, pair.other
    u, v = seen_at(other.turn, other.lens, p, q, 1.0)
    if not (-0.5 <= u <= other.size[0] - 0.5 and -0.5 <= v <= other.size[1] - 0.5):
        return np.nan
    there = u if other.columns else v
    u, v = seen_at(eye.turn, eye.lens, x, y, 1.0)
    if not abs(u + v) < np.inf:
        return np.nan
    return _rho(pair, x, y, p, u if eye.columns else v, there)


@compiled(error_model="numpy", inline="always")
def _rho(pair: _Pair, x: float, y: float, p: float, here_line: float, there_line: float) -> float:
    """Inverse depth, 1 / m, on the ray (x, y, 1) of the point with x / z = p in the other camera; NaN: none.

    Only the column is used, as for disparities, since the row depends on the guess by which images were resampled.
    """
    eye, other = pair.eye, pair.other
    below, s = _line(other, there_line)
    d, e = _pose(other.lines, below, s, 0), _pose(other.lines, below, s, 2)
    there = _pose(other.lines, below, s, 3)
    below, s = _line(eye, here_line)
    a, b = _pose(eye.lines, below, s, 0), _pose(eye.lines, below, s, 1)
    c, t = _pose(eye.lines, below, s, 2), _pose(eye.lines, below, s, 3)
    # In the world's axes: the ray and the vector from the own camera's centre.
    X, far_x = a[0] * x + b[0] * y + c[0], a[0] * t[0] + b[0] * t[1] + c[0] * t[2]
    Y, far_y = a[1] * x + b[1] * y + c[1], a[1] * t[0] + b[1] * t[1] + c[1] * t[2]
    Z, far_z = a[2] * x + b[2] * y + c[2], a[2] * t[0] + b[2] * t[1] + c[2] * t[2]
    ray_x, ray_z = d[0] * X + d[1] * Y + d[2] * Z, e[0] * X + e[1] * Y + e[2] * Z
    step_x = there[0] - (d[0] * far_x + d[1] * far_y + d[2] * far_z)
    step_z = there[2] - (e[0] * far_x + e[1] * far_y + e[2] * far_z)
    rho = (ray_x - p * ray_z) / (p * step_z - step_x)
    return rho if 0.0 <= rho < np.inf and ray_z + rho * step_z > 0.0 else np.nan


@compiled(error_model="numpy")
def _fill_timed(depth: F32, own: F32, rays: FloatArray, pair: _Pair, same: tuple[float, float], out: F32) -> None:
    """``timed_depth``; ``same``: the other camera's line read with line 0 of this one, and more per line."""
    eye, other = pair.eye, pair.other
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            if not (0.0 < depth[row, column] < np.inf):
                continue
            x, y = rays[row, column, 0], rays[row, column, 1]
            p = x - pair.shift / pair.level[0] * own[row, column] / depth[row, column]
            u, v = seen_at(other.turn, other.lens, p, y, 1.0)
            line, there = float(column if eye.columns else row), u if other.columns else v
            if not abs(there) < np.inf:
                there = same[0] + same[1] * line  # the lens does not show it: use the time of the pixel itself
            rho = _rho(pair, x, y, p, line, there)
            out[row, column] = own[row, column] / rho if rho > 0.0 else np.inf


@compiled(error_model="numpy")
def _fill_inverse_depths(disparity: F32, rays: F32, pair: _Pair, rho: F32) -> None:
    """Fill inverse depths (H, W) on the other level image from its disparities."""
    sign = 1.0 if pair.shift > 0.0 else -1.0
    for row in range(rho.shape[0]):
        for column in range(rho.shape[1]):
            x, y = _level_ray(pair, column + sign * disparity[row, column], row)
            rho[row, column] = _inverse_depth(pair, x, y, rays[row, column, 0], rays[row, column, 1])


@compiled(error_model="numpy")
def _fill_disparities(matched: F32, rays: F32, pair: _Pair, disparity: F32) -> None:
    """Fill disparities on the own level image from those ``matched`` with the resampled other image."""
    fx, fy = pair.level[0], pair.level[1]
    sign, gain, last = (1.0 if pair.shift > 0.0 else -1.0), abs(pair.shift), matched.shape[1] - 1
    for row in range(matched.shape[0]):
        for column in range(matched.shape[1]):
            at = column - sign * matched[row, column]
            if not (-0.5 <= at <= last + 0.5):
                continue
            i = min(max(int(np.floor(at)), 0), last - 1)
            s = at - i
            # The displacement of the level ray by the motion varies little within one surface.
            (x, y), (x2, y2) = _level_ray(pair, i, row), _level_ray(pair, i + 1, row)
            p, q = rays[row, i, 0] - x, rays[row, i, 1] - y
            along, across = rays[row, i + 1, 0] - x2 - p, rays[row, i + 1, 1] - y2 - q
            one = abs(along) * fx <= _ONE_SURFACE_PX and abs(across) * fy <= _ONE_SURFACE_PX
            s = s if one else np.floor(s + 0.5)
            if s != 0.0:
                p, q = p + s * along, q + s * across
            (x, y), (x2, y2) = _level_ray(pair, column, row), _level_ray(pair, at, row)
            found = _inverse_depth(pair, x, y, x2 + p, y2 + q)
            disparity[row, column] = gain * found
