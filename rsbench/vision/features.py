"""Sub-pixel point correspondences of a stereo rig over two frames: SIFT, ratio test, mutual check, loops.

SIFT runs with ``enable_precise_upscale``: OpenCV's default enlarges the image by mapping index x to 2x + 0.5 and
so reports every keypoint a quarter of a pixel too far right and down (measured 0.249, 0.244 px; 0.000 with it).
Positions then follow this package's convention, centre of the top-left pixel (0, 0).

Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, final

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_ranges
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray
from rsbench.vision.descriptor_search import best_two
from rsbench.vision.feature_matcher import FeatureMatcher
from rsbench.vision.frame_threads import map_frames
from rsbench.vision.half_size import at_full_size, halved
from rsbench.vision.images import grey_u8
from rsbench.vision.patch_alignment import refine_matches
from rsbench.vision.recent import Recent, content_key

Indices = NDArray[np.int64]
_MOST_FEATURES = 100_000
ROW_TOLERANCE_PX = 1.5
_STILL_PX = 0.01
_DETECTION_BYTES = 300.0
"""Per pixel: the pyramids of twice the size, float32, and of their differences."""
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
    """What counts as a feature and what as a match; distances between descriptors are SIFT's, 0 to about 720."""

    max_features: int = 6000
    """Strongest features kept per image; 0 keeps all, 100 000 at most."""
    contrast_threshold: float = 0.04
    """OpenCV's threshold of SIFT: fainter features are dropped."""
    edge_threshold: float = 10.0
    """OpenCV's threshold of SIFT: features more edge-like than this are dropped."""
    ratio: float = 0.8
    """Best over second-best distance, at most."""
    max_distance: float = 300.0
    """Largest distance of a match; the ratio says nothing where there is only one candidate."""
    search_radius: float | None = None
    """Temporal matches move by at most this many px in x and in y; None searches the whole image."""
    row_tolerance: float | None = ROW_TOLERANCE_PX
    """Left-right matches differ by at most this many rows: both cameras read a row at the same time. None: they do
    not, and a partner may lie anywhere."""
    max_disparity: float | None = None
    """Largest disparity of left-right matches, px; None is the image width."""
    drop_contradicted: bool = True
    """Drop a temporal match when its loop through the other camera ends elsewhere."""
    refine: bool = False
    """Align the ends of matches by the grey levels around them, see ``patch_alignment``."""
    enough_tracks: int = 0
    """Give tracks alone where there are as many as that, which is sooner done; 0 gives all matches."""
    half: bool = False
    """Find features at half the size: sooner, and fewer of them; for ends that are aligned (``refine``)."""
    affine: bool = False
    """Give left matches affine frames: the similarity of the keypoints' sizes and orientations."""

    def __post_init__(self) -> None:
        check_ranges(self, _RANGES)


@final
@dataclass(frozen=True, kw_only=True)
class SiftMatcher(MatchOptions, FeatureMatcher):
    """SIFT features, matched by ``match_stereo_frames``."""

    def match(self, images: Mapping[View, NDArray[np.uint8]]) -> Correspondences:
        return self._matched(images, None)

    def match_with_lens(self, images: Mapping[View, NDArray[np.uint8]], camera: PinholeCamera) -> Correspondences:
        """Features are found in the images as they are: interpolating them would add a tenth to the noise."""
        return self._matched(images, camera)

    def _matched(self, images: Mapping[View, NDArray[np.uint8]], camera: PinholeCamera | None) -> Correspondences:
        four = (images["left", 0], images["right", 0], images["left", 1], images["right", 1])
        matches = match_stereo_frames(*four, self, camera)
        alone = 0 < self.enough_tracks <= len(matches.tracks)
        if alone:
            matches = Correspondences(tracks=matches.tracks)
        if self.refine and not _still(matches):
            matches = refine_matches(images, matches)
        return Correspondences(tracks=matches.tracks) if alone else matches


@dataclass(frozen=True, kw_only=True, eq=False)
class Features:
    """Keypoints of one image, in order of the rows of their places."""

    points: FloatArray
    """(n, 2) px."""
    places: FloatArray
    """(n, 2) px where a camera without the lens sees them."""
    descriptors: NDArray[np.float32]
    """(n, 128), whole numbers from 0 to 255."""
    frames: FloatArray
    """(n, 2) what turns and scales the unit square into the keypoint's, as the first column of that matrix: its
    diameter, px, times the cosine and the sine of its orientation, from x towards y."""


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Where the partner of a keypoint may lie: bounds, px, of partner minus keypoint."""

    dx: tuple[float, float]
    dy: tuple[float, float]


_DETECTED, _PAIRED = Recent[Features](28), Recent[Indices](42)
"""A sequence asks for each image in two windows, and again after its shutter is known: of 12 windows at most."""
_REMEMBERED = 10_000
"""Features of an image, at most, that are kept: 6 MB."""


def forget_features() -> None:
    """Find them again, also in images that were asked for before: so that their time is counted."""
    _DETECTED.clear()
    _PAIRED.clear()


def detect(
    image: NDArray[Any], options: MatchOptions | None = None, camera: PinholeCamera | None = None
) -> Features:
    """SIFT features of an image (H, W) or (H, W, 3), uint8 or uint16; none in an image without texture.

    Args:
        camera: whose lens the image has; None: it has none. Features of which the lens shows no ray are dropped.
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


def _detected(grey: NDArray[np.uint8], options: MatchOptions, camera: PinholeCamera | None) -> Features:
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
    """Mutual nearest neighbours (m, 2), indices into ``a`` and ``b``, each the best of its candidates in the gate.

    The ratio test compares with the second-best candidate in the gate. Points with several orientations give the
    same match several times; it is kept once.
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
    camera: PinholeCamera | None = None,
) -> Correspondences:
    """Correspondences of the four images (H, W[, 3]), uint8 or uint16, of a rig over two frames.

    Of images that have the lens of ``camera``, in their own pixels; the bounds of the options are without it.
    Tracks are points whose four matches close the loop L0-R0-R1-L1-L0. Sets may come out empty. Raises ValueError
    when the images differ in size or are of another type.
    """
    options = options or MatchOptions()
    images = {"left_0": left_0, "right_0": right_0, "left_1": left_1, "right_1": right_1}
    for name, image in images.items():
        if image.shape[:2] != left_0.shape[:2]:
            raise ValueError(f"{name} must have the size of left_0, {left_0.shape[:2]}, got {image.shape[:2]}")
    reach = float(max(left_0.shape)) if options.search_radius is None else options.search_radius
    anywhere = Gate(dx=(-reach, reach), dy=(-reach, reach))
    disparity = float(left_0.shape[1]) if options.max_disparity is None else options.max_disparity
    tolerance = options.row_tolerance
    beside = anywhere
    if tolerance is not None:
        beside = Gate(dx=(-disparity, -np.finfo(np.float64).tiny), dy=(-tolerance, tolerance))
    # OpenCV, the BLAS and the compiled loop let go of the GIL.
    pixels = left_0.shape[0] * left_0.shape[1]
    l0, r0, l1, r1 = map_frames(
        lambda image: detect(image, options, camera), images.values(), pixels, _DETECTION_BYTES
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


def _still(matches: Correspondences) -> bool:
    """Whether nothing moves over time: errors that are all alike would leave solvers no noise to judge by."""
    pairs = matches.left, matches.right, matches.tracks[:, [0, 1, 4, 5]]
    moved = np.concatenate([each[:, 2:] - each[:, :2] for each in pairs])
    return len(moved) == 0 or float(np.median(np.abs(moved))) < _STILL_PX


def _similarities(a: FloatArray, b: FloatArray) -> FloatArray:
    """Affine frames (m, 4) that turn and scale keypoints' frames a (m, 2) into b: quotients of complex numbers.

    What a surface's slant does to its image is not in them.
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
    """The temporal matches that no loop contradicts: open loops are kept, closed ones that end elsewhere go."""
    wanted = _lookup(stereo_1, left[:, 1])
    found = _lookup(right, _lookup(stereo_0, left[:, 0]))
    keep_left = (wanted < 0) | (found < 0) | (wanted == found)
    back_0, back_1 = stereo_0[:, ::-1], stereo_1[:, ::-1]
    wanted = _lookup(back_1, right[:, 1])
    found = _lookup(left, _lookup(back_0, right[:, 0]))
    keep_right = (wanted < 0) | (found < 0) | (wanted == found)
    return left[keep_left], right[keep_right]


def _lookup(pairs: Indices, keys: Indices) -> Indices:
    """Second entries of the pairs whose first entry is the key, -1 where there is none."""
    size = 1 + max(int(pairs[:, 0].max(initial=-1)), int(keys.max(initial=-1)), 0)
    table = np.full(size + 1, -1, dtype=np.int64)
    table[pairs[:, 0]] = pairs[:, 1]
    return table[np.where(keys >= 0, keys, size)]


def _positions(features: tuple[Features, ...], indices: Indices) -> FloatArray:
    return np.concatenate([f.points[i] for f, i in zip(features, indices.T, strict=True)], axis=1)
