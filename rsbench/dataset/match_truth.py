"""Matching the frames of a sequence, and what is true of the matches.

The true partner of a keypoint is where the other picture sees the surface that the ray through the keypoint meets,
at the time of the keypoint's own row. The ray is traced there, between pixels too: no depth map is interpolated.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

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
from rsbench.dataset.matches import MATCHED, LabelledMatches, MatchClass, Matching
from rsbench.dataset.views import FAR
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.frame_matches import find_matches_of_rig
from rsbench.pipeline.isolated_parts import Isolation
from rsbench.vision.feature_matcher import FeatureEntry, load_features

_TRACK_HALF = {"left": [0, 1, 4, 5], "right": [2, 3, 6, 7], "stereo_0": [0, 1, 2, 3], "stereo_1": [4, 5, 6, 7]}


def at(view: View, first: int) -> View:
    """A view of ``MATCHED`` where the first of the two frames is ``first``."""
    return view[0], first + view[1]


class Meets(Protocol):
    """Rays through a scene, as ``renderers.segments.SceneRays``."""

    def blocked(self, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]: ...
    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray: ...


def matcher_record(matching: Matching) -> dict[str, Any]:
    """Content of matcher.json: who matches, and the versions with which the same pictures match alike.

    Raises:
        RsbenchError: the feature matcher does not exist.
    """
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
    levels = {(side, frame): images[side, first + frame] for side, frame in VIEWS}
    with Isolation() as isolation:
        options = isolation.chain(CorrectionOptions(features=entry))
        return find_matches_of_rig(levels, geometry.rig, geometry.shutter.scanning, options)


def make_matches(
    geometry: Geometry, first: int, images: Images, matching: Matching, rays: Meets
) -> LabelledMatches:
    """The labelled matches of frame ``first`` and the next, by their images (H, W, 3).

    Raises:
        RsbenchError: the feature matcher does not exist, or another package's failed.
    """
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


def labelled(geometry: Geometry, first: int, matches: Arranged, bound_px: float, rays: Meets) -> LabelledMatches:
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
    geometry: Geometry, source: View, target: View, pixels: FloatArray, bound_px: float, rays: Meets
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
    return world.t, transform(world, geometry.rig.camera.unproject(pixels))


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
