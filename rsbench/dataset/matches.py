"""The channel ``matches``: what a feature matcher finds in two successive frames, labelled by the truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences, repeated
from rsbench.core.geometry import Geometry
from rsbench.core.projection import ProjectionStatus, rs_project, rs_project_near
from rsbench.core.rig import VIEWS, View
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.core.version import __version__
from rsbench.dataset.tracks import ArrayFile
from rsbench.dataset.views import FAR

if TYPE_CHECKING:
    from rsbench.pipeline.frame_depth import Images
    from rsbench.vision.feature_matcher import FeatureEntry

MATCHED: dict[str, tuple[View, View]] = {
    "left": (("left", 0), ("left", 1)),
    "right": (("right", 0), ("right", 1)),
    "stereo_0": (("left", 0), ("right", 0)),
    "stereo_1": (("left", 1), ("right", 1)),
}
"""The pairs of pictures that a stereo solver uses of two successive frames, by their names in ``Correspondences``:
from which to which. Their order numbers them."""


class MatchClass(IntEnum):
    """What is true of a match."""

    UNSOLVED = 0
    """The row that sees the point could not be found."""
    RIGHT = 1
    """The other picture sees the point within ``Matching.bound_px`` of the second keypoint."""
    OCCLUDED = 2
    """The point is in view, but something nearer hides it: the match cannot be right."""
    OUT_OF_VIEW = 3
    """The point is beside the other picture or behind its camera."""
    NO_SURFACE = 4
    """The first keypoint sees the sky; what is true of it is true of its direction."""
    WRONG = 5
    """The other picture sees the point elsewhere."""


@dataclass(frozen=True, kw_only=True)
class Matching:
    """Who matches, and how near a right match is."""

    features: str = "sift"
    """Name of a feature matcher, or the path of its card."""
    bound_px: float = 3.0
    """Largest distance of the second keypoint from the true place in a match that counts as right."""

    def __post_init__(self) -> None:
        if not 0.0 < self.bound_px < np.inf:
            raise ValueError(f"bound_px = {self.bound_px}: must be a positive number of pixels")


class PairLabels(NamedTuple):
    """The matches of one pair of frames: see ``LabelledMatches``."""

    pixels: FloatArray
    depth: FloatArray
    truth: FloatArray
    error: FloatArray
    classes: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledMatches(ArrayFile):
    """Matches (n), those of each pair of frames together, in the order of ``MATCHED``; tracks come first.

    Raises:
        ValueError: arrays of other shapes or types, or of values that cannot be.
    """

    sets: NDArray[np.uint8]
    """(n,) number of the pair of frames."""
    tracks: NDArray[np.int32]
    """(n,) number of the track through all four frames that the match is a part of; -1: of none."""
    pixels: FloatArray
    """(n, 2, 2) px of both keypoints, as the matcher gives them."""
    depth: FloatArray
    """(n,) z of what the first keypoint sees, in the camera of its own time, metres; 0 = no surface."""
    truth: FloatArray
    """(n, 2) px where the other picture sees that at its own time, hidden or not; NaN where it does not."""
    error: FloatArray
    """(n,) distance of the second keypoint from it, px; NaN likewise."""
    classes: NDArray[np.uint8]
    """(n,) of ``MatchClass``."""

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
        """The matches of one pair of frames."""
        own = self.sets == number
        return PairLabels(*(getattr(self, name)[own] for name in PairLabels._fields))

    def correspondences(self, keep: NDArray[np.bool_] | None = None) -> Correspondences:
        """What a solver is given: all matches, or those of a mask (n,) and the tracks of which all parts are."""
        kept = np.ones(len(self.sets), dtype=np.bool_) if keep is None else keep
        rows = {name: self.pixels[(self.sets == k) & kept].reshape(-1, 4) for k, name in enumerate(MATCHED)}
        whole = (np.bincount(self.tracks[kept & (self.tracks >= 0)]) == len(MATCHED)).nonzero()[0]
        at = [self.pixels[(self.sets == k) & (self.tracks >= 0)][whole] for k in (2, 3)]
        return Correspondences(**rows, tracks=np.concatenate(at, axis=1).reshape(-1, 8))


_TRACK_HALF = {"left": [0, 1, 4, 5], "right": [2, 3, 6, 7], "stereo_0": [0, 1, 2, 3], "stereo_1": [4, 5, 6, 7]}


def at(view: View, first: int) -> View:
    """A view of ``MATCHED`` where the first of the two frames is ``first``."""
    return view[0], first + view[1]


class MatchRays(Protocol):
    """Rays through a scene that does not move: ``renderers.segments.SceneRays`` is one."""

    def blocked(self, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]: ...
    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray: ...


def matcher_record(matching: Matching) -> dict[str, Any]:
    """Content of matcher.json: who matches, and the versions with which the same pictures match alike.

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
    """What ``evaluate`` and ``correct`` match in two frames; another package's matcher runs in a child process.

    Raises:
        RsbenchError: that failed, see ``find_correspondences``.
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
    """The labelled matches of frame ``first`` and the next, by their images (H, W, 3).

    Raises:
        RsbenchError: the feature matcher does not exist, or another package's failed.
    """
    from rsbench.vision.feature_matcher import load_features

    found = matched_frames(geometry, first, images, load_features(matching.features))
    return labelled(geometry, first, arranged(found), matching.bound_px, rays)


class Arranged(NamedTuple):
    """Correspondences as the channel has them: see ``LabelledMatches``."""

    sets: NDArray[np.uint8]
    tracks: NDArray[np.int32]
    pixels: FloatArray


def arranged(found: Correspondences) -> Arranged:
    """The matches of each pair of frames, those of tracks first and once."""
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
    """Label matches by the truth."""
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
    """Depth (n,), true places (n, 2) and classes (n,) of matches (n, 2, 2)."""
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
    """(n,) of ``MatchClass``; the arguments (n, ...) are those of ``LabelledMatches``, and what is hidden."""
    with np.errstate(invalid="ignore"):
        right = np.linalg.norm(pixels[:, 1] - truth, axis=1) <= bound_px
    cases = [depth == 0.0, unsolved, np.isnan(truth[:, 0]), hidden, right]
    kinds = ("NO_SURFACE", "UNSOLVED", "OUT_OF_VIEW", "OCCLUDED", "RIGHT")
    return np.select(cases, [MatchClass[kind] for kind in kinds], MatchClass.WRONG).astype(np.uint8)


def looks(geometry: Geometry, view: View, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eyes (n, 3) and points (n, 3) at depth 1 of pixels (n, 2), between lines too; world frame, metres."""
    side, frame = view
    tau = geometry.shutter.pixel_time(pixels, frame, side)
    world = inverse(geometry.rig.cam_from_world(geometry.motion, tau, side))
    return world.t, transform(world, geometry.rig.sensor(side).unproject(pixels))


def seen_near(
    geometry: Geometry, view: View, points: FloatArray, near: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Pixels (n, 2) and times (n,) at which a frame sees points (n, 3), NaN for none, and what is not known.

    Of a point that the readout passes twice, that which a search from pixels ``near`` (n, 2) finds.
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
