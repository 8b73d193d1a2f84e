"""Dense disparity of the rig's two images: semi-global matching, left-right check, sub-pixel refinement.

The rig reads the same row of both cameras at the same time, so the pair of a rolling-shutter frame is rectified
like a global-shutter one, and ``disparity = x_left - x_right`` needs no knowledge of the motion.

Hirschmueller, "Stereo processing by semi-global matching and mutual information", PAMI 2008 (OpenCV's StereoSGBM).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_ranges
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.vision.disparity_refinement import refine_disparity
from rsbench.vision.half_size import guided_upsample, halved
from rsbench.vision.images import grey_u8
from rsbench.vision.stereo_matcher import StereoMatcher

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
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
"""Beyond them the matcher overflows, or takes minutes for an image."""
_FRACTION = 16.0  # StereoSGBM counts sixteenths of a pixel
_COARSE = 4
_RANGE_MARGIN = 1.1
_RANGE_QUANTILE = 0.999


@dataclass(frozen=True, kw_only=True)
class SgmOptions:
    """Parameters of StereoSGBM and of the steps after it."""

    num_disparities: int | None = None
    """Disparities searched, from 0; None derives them from ``nearest_depth``."""
    least_disparity: float = 0.5
    """Smaller disparities are unknown: hardly told from infinity, and what the matcher says without texture."""
    nearest_depth: float | None = None
    """Metres; None finds the range in the images, by matching them at a quarter of the size."""
    block_size: int = 5
    """Side of the matched window, pixels, odd."""
    p1: int = 8
    """Penalty of a disparity step of 1, times block_size squared."""
    p2: int = 32
    """Penalty of larger steps, times block_size squared."""
    mode: Literal["sgbm", "hh", "3way", "hh4"] = "3way"
    """Paths along which OpenCV sums costs: ``sgbm`` 5, ``hh`` 8, ``3way`` 3, ``hh4`` 4."""
    uniqueness_percent: int = 5
    """Per cent by which the best cost must be below the second-best."""
    prefilter_cap: int = 31
    """Largest horizontal derivative before matching, grey levels."""
    speckle_window: int = 100
    """Connected pieces of at most this many pixels are dropped; 0 keeps all."""
    speckle_range: int = 2
    """Largest difference of disparity inside a connected piece, px."""
    consistency_px: float = 1.0
    """Largest difference between a pixel's disparity and that of its partner in the other image."""
    refine_iterations: int = 2
    """Rounds of least squares on the images, see ``refine_disparity``; 0 keeps SGM's own interpolation."""
    half: bool = False
    """Match at half the size; borders of depth are then put where the image has its own."""

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


def stereo_disparity(
    left: NDArray[Any],
    right: NDArray[Any],
    rig: StereoRig,
    side: Side = "left",
    options: SgmOptions | None = None,
) -> F32:
    """Disparity (H, W), px, on the pixels of one image; NaN where it is unknown. ``rig.depth`` makes it metres.

    Images (H, W[, 3]) are uint8 or uint16. Unknown are pixels without a consistent partner, which includes the
    band that the other camera does not see. Raises ValueError when the images do not fit each other or the rig.
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
    # Seen in a mirror the right camera is the left one: the same matcher serves both.
    return _sgm(left, right, count, options), _mirrored(_sgm(_mirrored(right), _mirrored(left), count, options))


def _finish(reference: U8, other: U8, raw: F32, raw_other: F32, options: SgmOptions) -> F32:
    """Checked against the other image's disparities, speckles dropped, refined; ``reference`` is the left."""
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


def _largest_disparity(left: U8, right: U8, options: SgmOptions) -> float:
    small = (max(left.shape[1] // _COARSE, 1), max(left.shape[0] // _COARSE, 1))
    a, b = (cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in (left, right))
    count = 16 * math.ceil(small[0] / 2 / 16)
    found = _consistent(*_match_both(a, b, count, options), options.consistency_px)
    found = found[np.isfinite(found)]
    if found.size == 0:
        return 16.0
    return _COARSE * (float(np.quantile(found, _RANGE_QUANTILE)) * _RANGE_MARGIN + 1.0)


def _sgm(reference: U8, other: U8, count: int, options: SgmOptions) -> F32:
    """Raw disparity (H, W) of ``reference`` as the left image, NaN where there is none."""
    # SGBM leaves the first ``count`` columns out: it gets them as padding instead.
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
    # Beyond the other image's border there is only padding to match.
    columns = np.arange(disparity.shape[1], dtype=np.float32)
    return np.where(
        (disparity >= options.least_disparity) & (columns - disparity >= 0.0), disparity, np.float32(np.nan)
    )


def _consistent(reference: F32, other: F32, tolerance: float) -> F32:
    """``reference`` (as the left image) where the partner in ``other`` points back within the tolerance, px."""
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

    What one camera does not see lies behind what hides it, so the smaller disparity is the better guess; it stays
    a guess. Rows without any value stay unknown.
    """
    return np.fmin(*known_beside(disparity))


def known_beside(values: F32) -> tuple[F32, F32]:
    """Of each pixel (H, W) the nearest finite value at it or to its left, and to its right; NaN where none is."""
    height, width = values.shape
    known = np.isfinite(values)
    columns = np.broadcast_to(np.arange(width), (height, width))
    before = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], axis=1)[:, ::-1]
    left = np.where(before >= 0, np.take_along_axis(values, np.maximum(before, 0), axis=1), np.nan)
    right = np.where(after < width, np.take_along_axis(values, np.minimum(after, width - 1), axis=1), np.nan)
    return left, right


def seen_by_other(depth: NDArray[Any], other_depth: NDArray[Any], rig: StereoRig, side: Side) -> NDArray[np.bool_]:
    """Pixels (H, W) whose point the other camera sees too, from the true depth of both, metres.

    It does when its own disparity at that place is the same to a pixel: nothing nearer hides the point, which lies
    inside the picture. A rolling shutter changes nothing where both cameras read a row at the same time; with a
    lens the two times are so near that the difference is lost in that pixel.
    """
    camera, sign = rig.camera, 1.0 if side == "left" else -1.0
    disparity, other = (np.nan_to_num(rig.disparity(z)) for z in (depth, other_depth))
    row, column = np.indices(depth.shape)
    ideal = camera.ideal_pixels(np.stack([column, row], axis=-1))
    partner = camera.lens_pixels(np.stack([ideal[..., 0] - sign * disparity, ideal[..., 1]], axis=-1))
    x, y = np.moveaxis(np.rint(np.nan_to_num(partner, nan=-1.0)).astype(np.int64), -1, 0)
    height, width = depth.shape
    inside = (disparity > 0.0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    there = other[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return inside & (np.abs(there - disparity) <= 1.0)


def depth_metrics(
    estimate: NDArray[Any], truth: NDArray[Any], rig: StereoRig, part: NDArray[np.bool_] | None = None
) -> dict[str, float]:
    """Errors of a depth map (H, W), metres, over the surface pixels of ``truth`` (finite and positive).

    ``part`` (H, W) restricts it to some of them.
    ``coverage`` is the share of surface pixels with an estimate (finite and positive); the errors are over these:
    ``median_m`` and ``rmse_m`` of the absolute depth error, ``over_2m`` the share beyond 2 m (the paper's figure),
    ``bad_1px`` .. ``bad_3px`` the share beyond that disparity error. ``on_sky`` is the share of all pixels without
    a surface, in any part, that have an estimate: depth that was invented. NaN where no pixel counts. Raises
    ValueError when the shapes differ.
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
