"""Global-shutter solvers of PoseLib: five points of the left camera, all pairs of the rig, pose from points.

V. Larsson et al., PoseLib. Here PoseLib minimises the Sampson or the reprojection error without a robust loss,
because rsbench's robust loop, the same for every solver, rejects outliers. Only ``P3pSolver`` uses PoseLib's own
loop: points are triangulated from the stereo pair of frame 0, the pose follows from their left images in frame 1
by LO-RANSAC (M. Persson, K. Nordberg, Lambda Twist P3P, ECCV 2018), and is refined by least squares of the
inliers' reprojection errors in both cameras.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np

from rsbench.core import so3
from rsbench.core.arguments import check_number, check_whole
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import (
    FRAME_1,
    BoolArray,
    Correspondences,
    stereo_points,
    temporal_pairs,
    with_depth,
)
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.essential_matrix import DEGENERATE, decompose_essential, eight_point, rays_of

_BUNDLE = {"loss_type": "TRIVIAL", "max_iterations": 100, "gradient_tol": 1e-14, "step_tol": 1e-14}
MISSING = "poselib is not installed: there is no wheel for this platform"
_NOT_FINITE = "poselib returned no finite pose"


class PoselibSolver(Solver):
    """Base class of solvers whose final estimate is a refinement by PoseLib."""

    @abstractmethod
    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        """Return the pose refined by PoseLib from a starting pose; both are PoseLib's ``CameraPose``."""

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        poselib = poselib_module()
        if poselib is None:
            return MotionEstimate.failed(MISSING)
        start = poselib_pose(poselib, so3.exp(motion.w), motion.d)
        options = {**_BUNDLE, "max_iterations": 10} if quick else _BUNDLE
        return estimate_of(self.refined(poselib, start, correspondences, rig, options), self.spec.metric)


def poselib_module() -> Any:
    """Return the module ``poselib``, or None if it is not installed (there is no wheel for some platforms)."""
    try:
        import poselib
    except ImportError:
        return None
    return poselib


def poselib_camera(camera: PinholeCamera) -> dict[str, Any]:
    """Return the camera in PoseLib's format; ValueError for a lens, as PoseLib gets ideal pixels."""
    if camera.lens is not None:
        raise ValueError("PoseLib is given matches without a lens")
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }


def poselib_pose(poselib: Any, R: FloatArray, t: FloatArray) -> Any:
    pose = poselib.CameraPose()
    pose.R, pose.t = R, t
    return pose


def rig_extrinsics(poselib: Any, rig: StereoRig, sides: Iterable[Side] = SIDES) -> list[Any]:
    return [poselib_pose(poselib, np.eye(3), rig.offset(side)) for side in sides]


def estimate_of(pose: Any, metric: bool) -> MotionEstimate:
    R, t = np.array(pose.R), np.array(pose.t)
    if not (np.all(np.isfinite(R)) and np.all(np.isfinite(t))):
        return MotionEstimate.failed(_NOT_FINITE)
    if not metric:
        return MotionEstimate.of_one_camera(so3.log(R), t / max(float(np.linalg.norm(t)), 1e-300))
    return MotionEstimate(w=so3.log(R), d=t, success=True, metric=True)


def five_point_motions(matches: FloatArray, rig: StereoRig) -> list[MotionEstimate]:
    """Return motions of the left camera from matches (5, 4), by PoseLib's five-point solver with cheirality."""
    poselib = poselib_module()
    if poselib is None:
        return [MotionEstimate.failed(MISSING)]
    if len(matches) < 5:
        return []
    unit = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays_of(matches[:5], rig)]
    motions = [estimate_of(pose, metric=False) for pose in poselib.relpose_5pt(*unit)]
    return [motion for motion in motions if motion.success]


@dataclass(frozen=True, kw_only=True)
class PoselibPairsSolver(PoselibSolver):
    """Solver that refines the left camera's motion; |d| starts at 1, or at half a baseline if it is estimated."""

    def _length(self, rig: StereoRig) -> float:
        return 0.5 * rig.baseline if self.spec.metric else 1.0

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        if short := self.spec.shortage({side: len(temporal_pairs(correspondences, side)) for side in SIDES}):
            return short
        x0, x1 = rays_of(temporal_pairs(correspondences, "left"), rig)
        E = eight_point(x0, x1)
        if E is None:
            return MotionEstimate.failed(DEGENERATE)
        pose, _ = decompose_essential(E, x0, x1)
        start = MotionEstimate(w=so3.log(pose.R), d=self._length(rig) * pose.t, success=True)
        return self.improve(start, correspondences, rig, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        motions = five_point_motions(temporal_pairs(sample, "left"), rig)
        return [replace(motion, d=self._length(rig) * motion.d) for motion in motions]


@final
@dataclass(frozen=True, kw_only=True)
class PoselibMonoSolver(PoselibPairsSolver):
    """Left camera only: five-point samples, then least squares of the Sampson errors of all matches."""

    spec = SolverSpec(
        needs=frozenset({"left"}),
        minimum={"left": 8},
        metric=False,
        motion_model="linear",
        shutter="global",
        reference_point="left",
        reference="PoseLib; Nister: An efficient solution to the five-point relative pose problem, PAMI 2004",
        assumes="global shutter; translation",
    )

    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        matches, camera = temporal_pairs(correspondences, "left"), poselib_camera(rig.camera)
        pose, _ = poselib.refine_relative_pose(matches[:, :2], matches[:, 2:], start, camera, camera, options)
        return pose


@final
@dataclass(frozen=True, kw_only=True)
class PoselibStereoSolver(PoselibPairsSolver):
    """Left and right pairs of the rig as one generalised camera."""

    spec = SolverSpec(
        needs=frozenset({"left", "right"}),
        minimum={"left": 8, "right": 8},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="PoseLib, generalised relative pose of left-left and right-right matches",
        assumes="global shutter; translation; rotation that moves the baseline, for the scale",
    )

    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        pairs = []
        for k, side in enumerate(SIDES):
            matches = temporal_pairs(correspondences, side)
            pair = poselib.PairwiseMatches()
            pair.cam_id1, pair.cam_id2 = k, k
            pair.x1, pair.x2 = matches[:, :2], matches[:, 2:]
            pairs.append(pair)
        extrinsics, cameras = rig_extrinsics(poselib, rig), [poselib_camera(rig.camera)] * 2
        pose, _ = poselib.refine_generalized_relative_pose(
            pairs, start, extrinsics, cameras, extrinsics, cameras, options
        )
        return pose


@final
@dataclass(frozen=True, kw_only=True)
class PoselibPnpSolver(PoselibSolver):
    """Points from the disparities of frame 0, then the absolute pose of the stereo pair of frame 1."""

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": 4},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="PoseLib, generalised absolute pose; Persson, Nordberg: Lambda Twist, ECCV 2018",
        assumes="global shutter; depth of frame 0 without noise",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        if short := shortage_of_depth(with_depth(correspondences.tracks), self.spec.minimum["tracks"]):
            return short
        # The motion in one frame is small: zero motion is as good a start as a minimal solver's result.
        still = MotionEstimate(w=np.zeros(3), d=np.zeros(3), success=True)
        return self.improve(still, correspondences, rig, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"tracks": 3}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        poselib, tracks = poselib_module(), with_depth(sample.tracks)
        if poselib is None:
            return [MotionEstimate.failed(MISSING)]
        if len(tracks) < 3:
            return []
        rays = rig.camera.unproject(tracks[:3, 4:6])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        # The points x are in the body; in the left camera of frame 1 they are at R x + d + offset.
        poses = poselib.p3p(rays, stereo_points(tracks[:3], rig))
        motions = [(so3.log(np.array(p.R)), np.array(p.t) - rig.offset("left")) for p in poses]
        return [MotionEstimate(w=w, d=d, success=True, metric=True) for w, d in motions if np.all(np.isfinite(d))]

    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        tracks = with_depth(correspondences.tracks)
        everywhere = dict.fromkeys(SIDES, np.ones(len(tracks), dtype=np.bool_))
        return pose_of_points(poselib, start, tracks, everywhere, rig, options)


def pose_of_points(
    poselib: Any,
    start: Any,
    tracks: FloatArray,
    used: Mapping[Side, BoolArray],
    rig: StereoRig,
    options: dict[str, Any],
) -> Any:
    """Return PoseLib's pose of the body from points of tracks (n, 8) and their masked pixels in frame 1."""
    points = stereo_points(tracks, rig)
    pose, _ = poselib.refine_generalized_absolute_pose(
        [tracks[mask, FRAME_1[side]] for side, mask in used.items()],
        [points[mask] for mask in used.values()],
        start,
        rig_extrinsics(poselib, rig, used),
        [poselib_camera(rig.camera)] * len(used),
        options,
    )
    return pose


def shortage_of_depth(tracks: FloatArray, least: int) -> MotionEstimate | None:
    """Return a failed estimate if too few tracks have depth, else None."""
    if len(tracks) >= least:
        return None
    return MotionEstimate.failed(f"{len(tracks)} tracks with positive disparity, need {least}")


_LEAST = 10
"""Smallest number of samples, as in rsbench's own robust loop."""


@final
@dataclass(frozen=True, kw_only=True)
class P3pSolver(Solver):
    """PoseLib's robust absolute pose; its card has ``robust = "own"``."""

    cameras_used: Literal["left", "both"] = "both"
    """Cameras whose pixels in frame 1 are used in the final estimate; the search uses only the left camera's."""
    threshold_px: float = 4.0
    """Largest reprojection error of an inlier; allows for noise of pixels and points and a rolling shutter."""
    confidence: float = 0.999
    """Required probability that RANSAC draws a sample without outliers, 0 to 1."""
    max_iterations: int = 1000
    """Largest number of RANSAC samples."""

    def __post_init__(self) -> None:
        check_number("threshold_px", self.threshold_px, 0.0)
        check_number("confidence", self.confidence, 0.0, 1.0)
        check_whole("max_iterations", self.max_iterations, 1)

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": 4},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="Persson, Nordberg: Lambda Twist, ECCV 2018; PoseLib, estimate_absolute_pose",
        assumes="global shutter; depth of frame 0 without noise",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        poselib, tracks = poselib_module(), with_depth(correspondences.tracks)
        if poselib is None:
            return MotionEstimate.failed(MISSING)
        if short := shortage_of_depth(tracks, self.spec.minimum["tracks"]):
            return short
        options = {
            "max_reproj_error": self.threshold_px,
            "success_prob": self.confidence,
            "min_iterations": _LEAST,
            "max_iterations": self.max_iterations,
        }
        offset = rig.offset("left")
        points, camera = stereo_points(tracks, rig) + offset, poselib_camera(rig.camera)
        pose, found = poselib.estimate_absolute_pose(tracks[:, 4:6], points, camera, options, _BUNDLE)
        if found["num_inliers"] < self.spec.minimum["tracks"]:
            return MotionEstimate.failed(f"no consensus: {found['num_inliers']} points fit one pose")
        R = np.array(pose.R)
        start = poselib_pose(poselib, R, np.array(pose.t) + R @ offset - offset)
        sides: tuple[Side, ...] = SIDES if self.cameras_used == "both" else ("left",)
        body = stereo_points(tracks, rig)
        near = {side: self._near(start, body, tracks[:, FRAME_1[side]], rig, side) for side in sides}
        return estimate_of(pose_of_points(poselib, start, tracks, near, rig, _BUNDLE), self.spec.metric)

    def _near(self, pose: Any, points: FloatArray, pixels: FloatArray, rig: StereoRig, side: Side) -> BoolArray:
        """Return the mask (n,) of pixels in frame 1 whose reprojection error is below the threshold."""
        seen = points @ np.array(pose.R).T + np.array(pose.t) + rig.offset(side)
        front = seen[:, 2] > 0.0
        error = np.linalg.norm(rig.camera.project(np.where(front[:, None], seen, 1.0)) - pixels, axis=1)
        return front & (error <= self.threshold_px)
