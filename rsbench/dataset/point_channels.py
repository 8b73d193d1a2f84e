"""The channels of points: ``tracks``, ``affine`` and ``matches``.

``tracks`` are surface points and their pixels in each frame, ``affine`` are local affine maps between these
pixels, and ``matches`` are the matches of a feature matcher in two successive frames, labelled with ground truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray

from rsbench.components.seeds import generator
from rsbench.core.camera import inverse_2x2
from rsbench.core.correspondences import Correspondences, repeated
from rsbench.core.errors import naming
from rsbench.core.geometry import Geometry
from rsbench.core.projection import (
    ProjectionStatus,
    back_project,
    pixel_moves,
    plane_basis,
    rs_project,
    rs_project_near,
)
from rsbench.core.rig import SIDES, VIEWS, View
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.core.version import __version__
from rsbench.dataset.views import FAR, PixelClass, Rays
from rsbench.storage.files import save_arrays
from rsbench.storage.untrusted_files import load_arrays

if TYPE_CHECKING:
    from rsbench.pipeline.frame_depth import Images
    from rsbench.vision.feature_matcher import FeatureEntry

IN_ALL = 2048
"""Number of points drawn from all frames together, the same number from each."""


def track_views(frames: int) -> tuple[View, ...]:
    """Return left 0, right 0, left 1, right 1, ...: the order of frames in the arrays and ``Sequence.images``."""
    return tuple((side, frame) for frame in range(frames) for side in SIDES)


def _source_type(views: int) -> np.dtype[Any]:
    """Return the smallest integer type for frame numbers."""
    return np.min_scalar_type(views - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class ArrayFile:
    """Base of dataclasses whose arrays are stored in an npz file under the names of the fields."""

    def check_arrays(self, wanted: Mapping[str, tuple[tuple[int, ...], DTypeLike]]) -> None:
        """Raise ValueError if an array does not have the shape and type that ``wanted`` gives for its name."""
        for name, (shape, kind) in wanted.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype != kind:
                raise ValueError(
                    f"{name} is {value.dtype} of shape {value.shape}: {np.dtype(kind)} of {shape} is needed"
                )

    def save(self, path: Path) -> None:
        """Write the arrays to an npz file."""
        save_arrays(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the arrays from an npz file; raise RsbenchError as ``load_arrays`` does, or for invalid arrays."""
        with naming(path, TypeError, ValueError):
            return cls(**load_arrays(path))


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks(ArrayFile):
    """Surface points (n) and their pixels and visibility in all frames (v), in the order of ``track_views``.

    Raises:
        ValueError: an array has the wrong shape or type, or points, sources or classes are invalid.
    """

    points: FloatArray
    """(n, 3) world frame, metres."""
    sources: NDArray[np.unsignedinteger[Any]]
    """(n,) number of the frame from whose pixels the point was drawn."""
    pixels: FloatArray
    """(n, v, 2) sub-pixel coordinates, px; NaN if the point does not project into the frame."""
    tau: FloatArray
    """(n, v) times of these pixels, frame periods; NaN like ``pixels``."""
    classes: NDArray[np.uint8]
    """(n, v) values of ``PixelClass``: VISIBLE, OCCLUDED (the pixel is known), OUT_OF_VIEW or UNSOLVED."""

    def __post_init__(self) -> None:
        n, f8 = len(self.points), np.float64
        v = self.tau.shape[1] if self.tau.ndim == 2 and self.tau.shape[1] else 4
        seen = {"pixels": ((n, v, 2), f8), "tau": ((n, v), f8), "classes": ((n, v), np.uint8)}
        self.check_arrays({"points": ((n, 3), f8), "sources": ((n,), _source_type(v)), **seen})
        if not np.all(np.isfinite(self.points)) or np.any(self.sources >= v):
            raise ValueError(f"points must be finite, and sources 0 to {v - 1}")
        if np.any(self.classes > PixelClass.OUT_OF_VIEW):
            raise ValueError(f"classes holds {np.max(self.classes)}: a point is of class 0 to 3")


def make_tracks(
    geometry: Geometry,
    depths: Mapping[View, NDArray[np.float32]],
    blocked: Callable[[FloatArray, FloatArray], NDArray[np.bool_]],
    seed: str,
) -> Tracks:
    """Draw pixels with a surface, ``IN_ALL`` from all frames together, and project their points to all frames.

    Args:
        geometry: geometry of the sequence.
        depths: depth map (H, W) of each rolling-shutter frame, metres, 0 = no surface.
        blocked: returns which points are occluded from eyes, like ``views.Blocked`` but without times.
        seed: seed of the draw.
    """
    views = track_views(geometry.frames)
    count = max(1, IN_ALL // len(views))
    drawn = [_drawn(geometry, view, depths[view], f"{seed}/tracks/{view[0]}_{view[1]}", count) for view in views]
    points = np.concatenate([X for X, _ in drawn])
    sources = np.repeat(np.arange(len(drawn), dtype=_source_type(len(views))), [len(X) for X, _ in drawn])
    seen = [look_for(geometry, view, points, blocked) for view in views]
    pixels, tau, classes = (np.stack(each, axis=1) for each in zip(*seen, strict=True))
    # If a frame sees a point twice, the first row is used, but in the source frame the drawn pixel itself.
    for k, (view, (_, grid)) in enumerate(zip(views, drawn, strict=True)):
        own = sources == k
        pixels[own, k], classes[own, k] = grid, PixelClass.VISIBLE
        tau[own, k] = geometry.shutter.pixel_time(grid, view[1], view[0])
    return Tracks(points=points, sources=sources, pixels=pixels, tau=tau, classes=classes)


def _drawn(
    geometry: Geometry, view: View, depth: NDArray[np.float32], seed: str, count: int
) -> tuple[FloatArray, FloatArray]:
    """Draw pixels (n, 2) with a surface, and return the world points (n, 3) seen there and the pixels."""
    chosen = np.sort(generator(seed).permutation(np.flatnonzero(depth))[:count])
    y, x = np.divmod(chosen, depth.shape[1])
    pixels = np.column_stack([x, y]).astype(np.float64)
    return points_at(geometry, view, pixels, depth), pixels


def points_at(geometry: Geometry, view: View, pixels: FloatArray, depth: NDArray[np.float32]) -> FloatArray:
    """Return the world points (n, 3) seen at integer pixels (n, 2) of a frame."""
    z = depth[pixels[:, 1].astype(np.int64), pixels[:, 0].astype(np.int64)]
    return back_project(geometry.rig, geometry.shutter, geometry.motion, *view, pixels, z)


def look_for(
    geometry: Geometry,
    view: View,
    points: FloatArray,
    blocked: Callable[[FloatArray, FloatArray], NDArray[np.bool_]],
) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
    """Return pixels (n, 2), times (n,) and classes (n,) of points (n, 3) in a frame."""
    side, frame = view
    found = rs_project(geometry.rig, geometry.shutter, geometry.motion, side, frame, points)
    inside = np.isfinite(found.tau)
    eyes = inverse(geometry.rig.cam_from_world(geometry.motion, found.tau[inside], side)).t
    lost = found.status == ProjectionStatus.NOT_CONVERGED
    classes = np.where(lost, PixelClass.UNSOLVED, PixelClass.OUT_OF_VIEW).astype(np.uint8)
    hidden = blocked(eyes, points[inside]) if np.any(inside) else np.zeros(0, dtype=np.bool_)
    classes[inside] = np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE)
    return found.pixels, found.tau, classes


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineFrames(ArrayFile):
    """Affine frames of the points (n) of ``tracks``.

    Raises:
        ValueError: an array has the wrong shape or type, or normals are not finite.
    """

    jacobians: FloatArray
    """(n, v, 2, 2) derivative of the pixel in each frame (rows x, y) by the pixel in the source (columns x, y),
    for the tangent plane at the point; identity in the source, NaN if the point does not project into the
    frame."""
    normals: FloatArray
    """(n, 3) unit normal of that plane, towards the source, world frame; 0 if the ray passed between triangles."""

    def __post_init__(self) -> None:
        n, views = len(self.normals), self.jacobians.shape[1:2]
        self.check_arrays({"jacobians": ((n, *views, 2, 2), np.float64), "normals": ((n, 3), np.float64)})
        if not np.all(np.isfinite(self.normals)):
            raise ValueError("normals must be finite")

    def between(self, one: int, other: int) -> FloatArray:
        """Return the derivative (n, 2, 2) of the pixel in frame number ``other`` by that in frame ``one``."""
        return self.jacobians[:, other] @ inverse_2x2(self.jacobians[:, one])


def make_affine(geometry: Geometry, tracks: Tracks, rays: Rays) -> AffineFrames:
    """Compute the affine frames of tracks on the surfaces hit by the rays through their source pixels."""
    normals = np.zeros_like(tracks.points)
    for k, (side, _) in enumerate(track_views(geometry.frames)):
        own = tracks.sources == k
        if np.any(own):
            eyes = inverse(geometry.rig.cam_from_world(geometry.motion, tracks.tau[own, k], side)).t
            normals[own] = rays.surfaces(eyes, tracks.points[own]).normals
    return AffineFrames(jacobians=jacobians_of(geometry, tracks, normals), normals=normals)


def jacobians_of(geometry: Geometry, tracks: Tracks, normals: FloatArray) -> FloatArray:
    """Compute ``AffineFrames.jacobians`` (n, v, 2, 2) of tracks on planes with these normals (n, 3)."""
    along = plane_basis(normals)
    views = enumerate(track_views(geometry.frames))
    moves = [_moves(geometry, view, tracks, k, along) for k, view in views]
    by_plane = np.stack(moves, axis=1)
    source = by_plane[np.arange(len(normals)), tracks.sources]
    jacobians = by_plane @ inverse_2x2(source)[:, None]
    jacobians[np.arange(len(normals)), tracks.sources] = np.eye(2)
    jacobians[np.all(normals == 0.0, axis=1)] = np.nan
    return jacobians


def _moves(geometry: Geometry, view: View, tracks: Tracks, k: int, along: FloatArray) -> FloatArray:
    """Return the derivative (n, 2, 2) of a frame's pixels by steps of the points along directions (n, 3, 2)."""
    tau = np.where(np.isnan(tracks.tau[:, k]), 0.0, tracks.tau[:, k])
    moves = pixel_moves(geometry.rig, geometry.shutter, geometry.motion, view[0], tau, tracks.points, along)
    return np.where(np.isnan(tracks.tau[:, k])[:, None, None], np.nan, moves)


MATCHED: dict[str, tuple[View, View]] = {
    "left": (("left", 0), ("left", 1)),
    "right": (("right", 0), ("right", 1)),
    "stereo_0": (("left", 0), ("right", 0)),
    "stereo_1": (("left", 1), ("right", 1)),
}
"""The pairs of images, first and second, that a stereo solver uses from two successive frames, by their names in
``Correspondences``. The numbers of the pairs follow this order."""


class MatchClass(IntEnum):
    """Ground-truth class of a match."""

    UNSOLVED = 0
    """The search for the row that sees the point did not converge."""
    RIGHT = 1
    """The match is an inlier: the true pixel is within ``Matching.bound_px`` of the second keypoint."""
    OCCLUDED = 2
    """The point is in view but occluded in the second image, so the match is an outlier."""
    OUT_OF_VIEW = 3
    """The point lies outside the second image or behind its camera."""
    NO_SURFACE = 4
    """The first keypoint shows the sky; its true pixel is that of a far point in the same direction."""
    WRONG = 5
    """The match is an outlier: the point is visible elsewhere in the second image."""


@dataclass(frozen=True, kw_only=True)
class Matching:
    """The feature matcher and its inlier threshold."""

    features: str = "sift"
    """Name of a feature matcher, or the path of its card."""
    bound_px: float = 3.0
    """Inlier threshold: largest distance of the second keypoint from its true pixel."""

    def __post_init__(self) -> None:
        if not 0.0 < self.bound_px < np.inf:
            raise ValueError(f"bound_px = {self.bound_px}: must be a positive number of pixels")


class PairLabels(NamedTuple):
    """The matches of one pair of images; for the fields see ``LabelledMatches``."""

    pixels: FloatArray
    depth: FloatArray
    truth: FloatArray
    error: FloatArray
    classes: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledMatches(ArrayFile):
    """Matches (n), grouped by pair of images in the order of ``MATCHED``; in each group, tracks come first.

    Raises:
        ValueError: an array has the wrong shape or type, or invalid values.
    """

    sets: NDArray[np.uint8]
    """(n,) number of the pair of images."""
    tracks: NDArray[np.int32]
    """(n,) number of the track through all four images to which the match belongs; -1: none."""
    pixels: FloatArray
    """(n, 2, 2) both keypoints from the matcher, px."""
    depth: FloatArray
    """(n,) depth z at the first keypoint, in the camera frame at the keypoint's time, metres; 0 = no surface."""
    truth: FloatArray
    """(n, 2) true pixel in the second image at its own time, px, also if occluded; NaN if out of view."""
    error: FloatArray
    """(n,) distance of the second keypoint from the true pixel, px; NaN like ``truth``."""
    classes: NDArray[np.uint8]
    """(n,) values of ``MatchClass``."""

    def __post_init__(self) -> None:
        n, f8 = len(self.sets), np.float64
        found = {"sets": ((n,), np.uint8), "tracks": ((n,), np.int32), "pixels": ((n, 2, 2), f8)}
        truth = {"depth": ((n,), f8), "truth": ((n, 2), f8), "error": ((n,), f8), "classes": ((n,), np.uint8)}
        self.check_arrays(found | truth)
        if np.any(np.diff(self.sets.astype(int)) < 0) or np.any(self.sets >= len(MATCHED)):
            raise ValueError(f"sets must grow from 0 to {len(MATCHED) - 1} at most")
        if not np.all(np.isfinite(self.pixels)) or not np.all(np.isfinite(self.depth) & (self.depth >= 0.0)):
            raise ValueError("pixels must be finite, and depth not negative")
        if np.any(self.classes > max(MatchClass)):
            raise ValueError(f"classes holds {np.max(self.classes)}: a match is of class 0 to {max(MatchClass)}")
        numbers = [self.tracks[(self.sets == k) & (self.tracks >= 0)] for k in range(len(MATCHED))]
        if any(not np.array_equal(each, np.arange(len(numbers[0]))) for each in numbers):
            raise ValueError("tracks must be numbered 0, 1, ... in each pair of frames, as many in each")

    def of_pair(self, number: int) -> PairLabels:
        """Return the matches of one pair of images."""
        own = self.sets == number
        return PairLabels(*(getattr(self, name)[own] for name in PairLabels._fields))

    def correspondences(self, keep: NDArray[np.bool_] | None = None) -> Correspondences:
        """Return the input of a solver: all matches, or those in a mask (n,) and the tracks completely in it."""
        kept = np.ones(len(self.sets), dtype=np.bool_) if keep is None else keep
        rows = {name: self.pixels[(self.sets == k) & kept].reshape(-1, 4) for k, name in enumerate(MATCHED)}
        whole = (np.bincount(self.tracks[kept & (self.tracks >= 0)]) == len(MATCHED)).nonzero()[0]
        at = [self.pixels[(self.sets == k) & (self.tracks >= 0)][whole] for k in (2, 3)]
        return Correspondences(**rows, tracks=np.concatenate(at, axis=1).reshape(-1, 8))


_TRACK_HALF = {"left": [0, 1, 4, 5], "right": [2, 3, 6, 7], "stereo_0": [0, 1, 2, 3], "stereo_1": [4, 5, 6, 7]}


def at(view: View, first: int) -> View:
    """Convert a view of ``MATCHED``, with frame 0 or 1, to a view of frame ``first`` or the next."""
    return view[0], first + view[1]


class MatchRays(Protocol):
    """Ray casting in a static scene, as ``renderers.visibility.SceneRays`` implements it."""

    def blocked(self, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]: ...
    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray: ...


def matcher_record(matching: Matching) -> dict[str, Any]:
    """Return the content of matcher.json: the feature matcher, and the versions on which its matches depend.

    Raises:
        RsbenchError: the feature matcher does not exist.
    """
    from rsbench.vision.feature_matcher import load_features

    entry = load_features(matching.features)
    component = entry.component
    parameters = asdict(component) if entry.built_in else entry.parameters  # pyrefly: ignore[bad-argument-type]
    return {
        **asdict(matching),
        "class": f"{type(component).__module__}:{type(component).__qualname__}",
        "parameters": parameters,
        "versions": {"rsbench": __version__, "opencv": str(cv2.__version__)},
    }


def matched_frames(geometry: Geometry, first: int, images: Images, entry: FeatureEntry) -> Correspondences:
    """Match two frames as ``evaluate`` and ``correct`` do; another package's matcher runs in a child process.

    Raises:
        RsbenchError: the matcher failed, see ``find_correspondences``.
    """
    from rsbench.pipeline.frame_capture import find_matches_of_rig
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.pipeline.isolated_chain import Isolation

    levels = {(side, frame): images[side, first + frame] for side, frame in VIEWS}
    with Isolation() as isolation:
        options = isolation.chain(CorrectionOptions(features=entry))
        return find_matches_of_rig(levels, geometry.rig, geometry.shutter.scanning, options)


def make_matches(
    geometry: Geometry, first: int, images: Images, matching: Matching, rays: MatchRays
) -> LabelledMatches:
    """Match the images (H, W, 3) of frame ``first`` and the next, and label the matches.

    Raises:
        RsbenchError: the feature matcher does not exist, or another package's failed.
    """
    from rsbench.vision.feature_matcher import load_features

    found = matched_frames(geometry, first, images, load_features(matching.features))
    return labelled(geometry, first, arranged(found), matching.bound_px, rays)


class Arranged(NamedTuple):
    """Correspondences in the order of ``LabelledMatches``, which describes the fields."""

    sets: NDArray[np.uint8]
    tracks: NDArray[np.int32]
    pixels: FloatArray


def arranged(found: Correspondences) -> Arranged:
    """Group matches by pair of images; matches of tracks come first and are not repeated."""
    parts = []
    for number, name in enumerate(MATCHED):
        linked, own = found.tracks[:, _TRACK_HALF[name]], getattr(found, name)
        rows = np.concatenate([linked, own[~repeated(own, linked)]])
        tracks = np.where(np.arange(len(rows)) < len(linked), np.arange(len(rows)), -1)
        parts.append((np.full(len(rows), number, np.uint8), tracks.astype(np.int32), rows.reshape(-1, 2, 2)))
    return Arranged(*map(np.concatenate, zip(*parts, strict=True)))


def labelled(
    geometry: Geometry, first: int, matches: Arranged, bound_px: float, rays: MatchRays
) -> LabelledMatches:
    """Label matches with their true pixels, errors and classes."""
    parts = []
    for number, views in enumerate(MATCHED.values()):
        source, target = (at(view, first) for view in views)
        pixels = matches.pixels[matches.sets == number]
        parts.append(_truth_of(geometry, source, target, pixels, bound_px, rays))
    depth, truth, classes = map(np.concatenate, zip(*parts, strict=True))
    error = np.linalg.norm(matches.pixels[:, 1] - truth, axis=1)
    return LabelledMatches(**matches._asdict(), depth=depth, truth=truth, error=error, classes=classes)


def _truth_of(
    geometry: Geometry, source: View, target: View, pixels: FloatArray, bound_px: float, rays: MatchRays
) -> tuple[FloatArray, FloatArray, NDArray[np.uint8]]:
    """Return depth (n,), true pixels (n, 2) and classes (n,) of matches (n, 2, 2)."""
    if len(pixels) == 0:
        return np.zeros(0), np.zeros((0, 2)), np.zeros(0, dtype=np.uint8)
    eyes, ahead = looks(geometry, source, pixels[:, 0])
    met = rays.share(eyes, ahead)
    points = eyes + np.minimum(met, FAR)[:, None] * (ahead - eyes)
    truth, tau, unsolved = seen_near(geometry, target, points, pixels[:, 1])
    inside = np.isfinite(tau)
    hidden = np.zeros(len(points), dtype=np.bool_)
    if np.any(inside):
        side = target[0]
        places = inverse(geometry.rig.cam_from_world(geometry.motion, tau[inside], side)).t
        hidden[inside] = rays.blocked(places, points[inside])
    depth = np.where(np.isfinite(met), met, 0.0)
    return depth, truth, classes_of(pixels, depth, truth, hidden, unsolved, bound_px)


def classes_of(
    pixels: FloatArray,
    depth: FloatArray,
    truth: FloatArray,
    hidden: NDArray[np.bool_],
    unsolved: NDArray[np.bool_],
    bound_px: float,
) -> NDArray[np.uint8]:
    """Return values (n,) of ``MatchClass``; ``hidden`` marks occlusion, for the rest see ``LabelledMatches``."""
    with np.errstate(invalid="ignore"):
        right = np.linalg.norm(pixels[:, 1] - truth, axis=1) <= bound_px
    cases = [depth == 0.0, unsolved, np.isnan(truth[:, 0]), hidden, right]
    kinds = ("NO_SURFACE", "UNSOLVED", "OUT_OF_VIEW", "OCCLUDED", "RIGHT")
    return np.select(cases, [MatchClass[kind] for kind in kinds], MatchClass.WRONG).astype(np.uint8)


def looks(geometry: Geometry, view: View, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return camera centres (n, 3) and points (n, 3) at depth 1 of sub-pixels (n, 2); world frame, metres."""
    side, frame = view
    tau = geometry.shutter.pixel_time(pixels, frame, side)
    world = inverse(geometry.rig.cam_from_world(geometry.motion, tau, side))
    return world.t, transform(world, geometry.rig.sensor(side).unproject(pixels))


def seen_near(
    geometry: Geometry, view: View, points: FloatArray, near: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return pixels (n, 2) and times (n,) of points (n, 3) in a frame, NaN for none, and a mask of unsolved ones.

    If the readout sees a point twice, the result is the pixel that a search from the pixel ``near`` (n, 2) finds.
    """
    args = geometry.rig, geometry.shutter, geometry.motion, *view
    found = rs_project_near(*args, points, near[:, geometry.shutter.axis(view[0])])
    pixels, tau = found.pixels.copy(), found.tau.copy()
    lost = found.status != ProjectionStatus.SEEN
    again = rs_project(*args, points[lost])
    pixels[lost], tau[lost] = again.pixels, again.tau
    unsolved = np.zeros(len(points), dtype=np.bool_)
    unsolved[lost] = again.status == ProjectionStatus.NOT_CONVERGED
    return pixels, tau, unsolved
