"""Straight edges of a stereo rig over two frames: OpenCV's LSD, SIFT descriptors along them, mutual check, loops.

LSD runs at the scale of the image: at OpenCV's default, 0.8, it reports every segment an eighth of a pixel too far
left and up (measured 0.118, 0.126 px; 0.002, 0.001 px at scale 1). Positions then follow this package's
convention, centre of the top-left pixel (0, 0). LSD directs a segment by
which of its sides is brighter, and so are matches.

R. Grompone von Gioi, J. Jakubowicz, J.-M. Morel, G. Randall, LSD: a Line Segment Detector, IPOL 2012.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_ranges
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray
from rsbench.vision.feature_matcher import FeatureMatcher
from rsbench.vision.features import ROW_TOLERANCE_PX, Indices, MatchOptions, close_loops, match_stereo_frames
from rsbench.vision.images import grey_u8

_BLUR_PX = 0.75
"""Standard deviation of a blur, as LSD applies at its default scale: otherwise the stairs of a slanted edge become
segments."""
_RANGES = {
    "max_lines": (1, 2000),
    "min_length": (4.0, 1e6),
    "spacing": (1.0, 1e6),
    "patch": (1.0, 1e3),
    "ratio": (1e-6, 1.0),
    "max_distance": (1e-6, 1e6),
    "max_turn_deg": (0.0, 180.0),
    "search": (1e-6, 1e6),
    "min_overlap": (0.0, 1.0),
    "min_slope_deg": (0.0, 90.0),
}


@dataclass(frozen=True, kw_only=True)
class LineOptions:
    """Options of lines and matches; distances between descriptors are SIFT's, 0 to about 720."""

    max_lines: int = 500
    """Number of segments kept per image, the longest ones."""
    min_length: float = 25.0
    """Least length of a segment, px."""
    spacing: float = 10.0
    """Distance between the descriptors along a segment, px."""
    patch: float = 6.0
    """Size of a descriptor's keypoint, px: the descriptor covers about three times as much on either side."""
    ratio: float = 0.9
    """Largest ratio of the best to the second-best distance."""
    max_distance: float = 300.0
    """Largest distance of a match: the mean, over a segment's descriptors, of the distance to the nearest one of
    the other segment."""
    max_turn_deg: float = 20.0
    """Largest angle between the two segments of a match."""
    search: float = 0.2
    """Largest distance of the midpoints of a match over time, as a share of the image's width."""
    min_overlap: float = 0.5
    """Least share of the rows of the shorter segment that both segments of a left-right match cover."""
    min_slope_deg: float = 10.0
    """Least angle to the rows: segments with a smaller one have no depth and are left out."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)


@final
@dataclass(frozen=True, kw_only=True)
class SiftLineMatcher(MatchOptions, FeatureMatcher):
    """SIFT features, and straight lines with the defaults of ``LineOptions``."""

    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        four = images["left", 0], images["right", 0], images["left", 1], images["right", 1]
        return replace(match_stereo_frames(*four, self), lines=match_lines(*four))


@dataclass(frozen=True, kw_only=True, eq=False)
class Segments:
    """Segments of one image, sorted from the longest."""

    ends: FloatArray
    """(n, 4) xa, ya, xb, yb, px."""
    descriptors: NDArray[np.float32]
    """(m, 128) descriptors of points along them."""
    first: Indices
    """(n,) index of the first descriptor of each segment."""


def detect_lines(image: NDArray[Any], options: LineOptions | None = None) -> FloatArray:
    """Ends (n, 4) xa, ya, xb, yb, px, of the segments of an image (H, W[, 3]), uint8 or uint16, sorted from the
    longest. Raises ValueError for images of other shapes and types."""
    options = options or LineOptions()
    grey = cv2.GaussianBlur(grey_u8(image), (0, 0), _BLUR_PX)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, scale=1.0).detect(grey)[0]
    ends = np.zeros((0, 4)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 4)
    along = ends[:, 2:] - ends[:, :2]
    length = np.hypot(along[:, 0], along[:, 1])
    steep = np.abs(along[:, 1]) >= np.sin(np.radians(options.min_slope_deg)) * length
    ends, length = (rows[steep & (length >= options.min_length)] for rows in (ends, length))
    return ends[np.lexsort((*ends.T, -length))[: options.max_lines]]


def describe_lines(image: NDArray[Any], ends: FloatArray, options: LineOptions | None = None) -> Segments:
    """SIFT descriptors, oriented along the segment, of points along each of the segments (n, 4) of an image."""
    options = options or LineOptions()
    points, first = list[cv2.KeyPoint](), list[int]()
    for xa, ya, xb, yb in ends:
        length, angle = np.hypot(xb - xa, yb - ya), np.degrees(np.arctan2(yb - ya, xb - xa)) % 360.0
        first.append(len(points))
        for t in (np.arange(max(1, round(length / options.spacing))) + 0.5) * options.spacing / length:
            # SIFT returns the given points in the same order, without dropping any.
            points.append(cv2.KeyPoint(xa + t * (xb - xa), ya + t * (yb - ya), options.patch, angle))
    descriptors = np.zeros((0, 128), dtype=np.float32)
    if points:
        kept, found = cv2.SIFT.create(enable_precise_upscale=True).compute(grey_u8(image), points)
        assert len(kept) == len(points), "SIFT describes every point that it is given"
        descriptors = np.asarray(found, dtype=np.float32)
    return Segments(ends=ends, descriptors=descriptors, first=np.array(first, dtype=np.int64))


def distances(a: Segments, b: Segments) -> FloatArray:
    """Distances (n, m) of segments: for each of the two, the mean over its descriptors of the distance to the
    nearest of the other; the larger of both means."""
    if not (len(a.ends) and len(b.ends)):
        return np.zeros((len(a.ends), len(b.ends)))
    squares = np.sum(a.descriptors**2, axis=1)[:, None] + np.sum(b.descriptors**2, axis=1)
    apart = np.sqrt(np.maximum(squares - 2.0 * a.descriptors @ b.descriptors.T, 0.0))
    means = []
    for table, one, other in ((apart, a, b), (apart.T, b, a)):
        nearest = np.minimum.reduceat(table, other.first, axis=1)
        counts = np.diff([*one.first, len(one.descriptors)])
        means.append(np.add.reduceat(nearest, one.first, axis=0) / counts[:, None])
    return np.maximum(means[0], means[1].T).astype(np.float64)


def match_segments(a: Segments, b: Segments, allowed: BoolArray, options: LineOptions | None = None) -> Indices:
    """Mutual nearest segments (k, 2) among the ``allowed`` (n, m), each clearly nearer than its second-nearest."""
    options = options or LineOptions()
    if not allowed.size:
        return np.zeros((0, 2), dtype=np.int64)
    apart = np.where(allowed, distances(a, b), np.inf)
    best, back, rows = np.argmin(apart, axis=1), np.argmin(apart, axis=0), np.arange(len(apart))
    nearest = apart[rows, best]
    others = apart.copy()
    others[rows, best] = np.inf
    clear = nearest <= options.ratio * np.min(others, axis=1)
    good = (nearest <= options.max_distance) & clear & (back[best] == rows)
    return np.stack([rows[good], best[good]], axis=1)


def match_lines(
    left_0: NDArray[Any],
    right_0: NDArray[Any],
    left_1: NDArray[Any],
    right_1: NDArray[Any],
    options: LineOptions | None = None,
) -> FloatArray:
    """Lines (n, 16) of ``Correspondences`` in the four images (H, W[, 3]) of a rig over two frames.

    Their four matches close the loop L0-R0-R1-L1-L0. There may be none. Raises ValueError when the images differ
    in size or are of another type.
    """
    options = options or LineOptions()
    images = {"left_0": left_0, "right_0": right_0, "left_1": left_1, "right_1": right_1}
    for name, image in images.items():
        if image.shape[:2] != left_0.shape[:2]:
            raise ValueError(f"{name} must have the size of left_0, {left_0.shape[:2]}, got {image.shape[:2]}")
    l0, r0, l1, r1 = (describe_lines(i, detect_lines(i, options), options) for i in images.values())
    reach = options.search * left_0.shape[1]
    left, right = (
        match_segments(a, b, near(a.ends, b.ends, reach, options), options) for a, b in ((l0, l1), (r0, r1))
    )
    stereo = [match_segments(a, b, beside(a.ends, b.ends, options), options) for a, b in ((l0, r0), (l1, r1))]
    loops = close_loops(left, right, *stereo)
    return np.concatenate([s.ends[k] for s, k in zip((l0, r0, l1, r1), loops.T, strict=True)], axis=1)


def near(a: FloatArray, b: FloatArray, reach: float, options: LineOptions) -> BoolArray:
    """Mask (n, m) of the segments (n, 4), (m, 4) that may be one line at two times."""
    middles = [0.5 * (ends[:, :2] + ends[:, 2:]) for ends in (a, b)]
    apart = middles[1] - middles[0][:, None]
    return np.asarray((np.hypot(apart[..., 0], apart[..., 1]) <= reach) & _alike(a, b, options))


def beside(a: FloatArray, b: FloatArray, options: LineOptions) -> BoolArray:
    """Mask (n, m) of the segments (n, 4) and (m, 4) that may be one line in the left and the right image."""
    low, high = (np.sort(ends[:, 1::2], axis=1).T for ends in (a, b))
    top, bottom = np.maximum(low[0][:, None], high[0]), np.minimum(low[1][:, None], high[1])
    shorter = np.minimum((low[1] - low[0])[:, None], high[1] - high[0])
    enough = bottom - top >= np.maximum(options.min_overlap * shorter, ROW_TOLERANCE_PX)
    positive = [_column(a[:, None], row) > _column(b[None], row) for row in (top, bottom)]
    return np.asarray(enough & positive[0] & positive[1] & _alike(a, b, options))


def _column(ends: FloatArray, row: FloatArray) -> FloatArray:
    """x where lines (..., 4) cross rows (...)."""
    return np.asarray(
        ends[..., 0] + (row - ends[..., 1]) * (ends[..., 2] - ends[..., 0]) / (ends[..., 3] - ends[..., 1])
    )


def _alike(a: FloatArray, b: FloatArray, options: LineOptions) -> BoolArray:
    """Mask (n, m) of the segments with similar directions and the same brighter side."""
    direction = [(ends[:, 2] - ends[:, 0]) + 1j * (ends[:, 3] - ends[:, 1]) for ends in (a, b)]
    turn = np.angle(direction[1] / direction[0][:, None])
    return np.asarray(np.abs(turn) <= np.radians(options.max_turn_deg))
