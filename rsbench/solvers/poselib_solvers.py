"""Global-shutter solvers of PoseLib: five points of the left camera, all pairs of the rig, pose from points.

V. Larsson et al., PoseLib. It minimises the Sampson or the reprojection error without robust loss here: a robust
loop around it throws outliers out, the same for every solver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, final

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.base import MatchSet, MotionEstimate, Solver
from rsbench.solvers.eight_point import decompose_essential, eight_point
from rsbench.solvers.packed import temporal_pairs

_BUNDLE = {"loss_type": "TRIVIAL", "max_iterations": 100, "gradient_tol": 1e-14, "step_tol": 1e-14}
_MISSING = "poselib is not installed: there is no wheel for this platform"
_NOT_FINITE = "poselib returned no finite pose"


def _poselib() -> Any:
    """The module, or None where it has no wheel."""
    try:
        import poselib
    except ImportError:
        return None
    return poselib


def _camera(camera: PinholeCamera) -> dict[str, Any]:
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }


def _pose(poselib: Any, R: FloatArray, t: FloatArray) -> Any:
    pose = poselib.CameraPose()
    pose.R, pose.t = R, t
    return pose


def _extrinsics(poselib: Any, rig: StereoRig) -> list[Any]:
    return [_pose(poselib, np.eye(3), rig.offset(side)) for side in SIDES]


def _estimate(pose: Any, metric: bool) -> MotionEstimate:
    R, t = np.array(pose.R), np.array(pose.t)
    if not (np.all(np.isfinite(R)) and np.all(np.isfinite(t))):
        return MotionEstimate.failed(_NOT_FINITE)
    if not metric:
        t = t / max(float(np.linalg.norm(t)), 1e-300)
    reason = "" if metric else "the length of d is not determined by one camera"
    return MotionEstimate(w=so3.log(R), d=t, success=True, metric=metric, reason=reason)


def _left_start(matches: FloatArray, rig: StereoRig) -> tuple[FloatArray, FloatArray] | None:
    """(w, unit t) of the left camera by the eight-point algorithm."""
    if len(matches) < 8:
        return None
    x0, x1 = rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])
    E = eight_point(x0, x1)
    if E is None:
        return None
    pose, _ = decompose_essential(E, x0, x1)
    return so3.log(pose.R), pose.t


def five_point_motions(matches: FloatArray, rig: StereoRig) -> list[MotionEstimate]:
    """Motions of the camera of matches (5, 4): PoseLib's five-point solver, points in front."""
    poselib = _poselib()
    if poselib is None or len(matches) < 5:
        return []
    rays = [rig.camera.unproject(matches[:5, k : k + 2]) for k in (0, 2)]
    unit = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    motions = [_estimate(pose, metric=False) for pose in poselib.relpose_5pt(*unit)]
    return [motion for motion in motions if motion.success]


@final
@dataclass(frozen=True, kw_only=True)
class PoselibMonoSolver(Solver):
    """Left camera only: five-point proposals, then the Sampson error of all matches."""

    name = "gs-poselib"
    needs = frozenset[MatchSet]({"left"})
    minimum: ClassVar[Mapping[MatchSet, int]] = MappingProxyType({"left": 8})
    metric = False
    motion_model = "linear"
    shutter = "global"
    reference_point = "left"
    reference = "PoseLib; Nister: An efficient solution to the five-point relative pose problem, PAMI 2004"
    assumes = "global shutter; translation"

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches = temporal_pairs(correspondences, "left")
        if len(matches) < self.minimum["left"]:
            return MotionEstimate.failed(f"{len(matches)} left matches, need {self.minimum['left']}")
        start = _left_start(matches, rig)
        if start is None:
            return MotionEstimate.failed(
                "the matches fit more than one essential matrix: degenerate scene or motion"
            )
        return self.improve(MotionEstimate(w=start[0], d=start[1], success=True), correspondences, rig, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return five_point_motions(temporal_pairs(sample, "left"), rig)

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        poselib = _poselib()
        if poselib is None:
            return MotionEstimate.failed(_MISSING)
        matches, camera = temporal_pairs(correspondences, "left"), _camera(rig.camera)
        start = _pose(poselib, so3.exp(motion.w), motion.d)
        options = {**_BUNDLE, "max_iterations": 10} if quick else _BUNDLE
        pose, _ = poselib.refine_relative_pose(matches[:, :2], matches[:, 2:], start, camera, camera, options)
        return _estimate(pose, metric=False)


@final
@dataclass(frozen=True, kw_only=True)
class PoselibStereoSolver(Solver):
    """Left and right pairs of the rig as one generalised camera."""

    name = "gs-poselib-stereo"
    needs = frozenset[MatchSet]({"left", "right"})
    minimum: ClassVar[Mapping[MatchSet, int]] = MappingProxyType({"left": 8, "right": 8})
    metric = True
    motion_model = "linear"
    shutter = "global"
    reference_point = "body"
    reference = "PoseLib, generalised relative pose of left-left and right-right matches"
    assumes = "global shutter; translation; rotation that moves the baseline, for the scale"

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        for side in SIDES:
            count = len(temporal_pairs(correspondences, side))
            if count < self.minimum[side]:
                return MotionEstimate.failed(f"{count} {side} matches, need {self.minimum[side]}")
        start = _left_start(temporal_pairs(correspondences, "left"), rig)
        if start is None:
            return MotionEstimate.failed(
                "the matches fit more than one essential matrix: degenerate scene or motion"
            )
        motion = MotionEstimate(w=start[0], d=0.5 * rig.baseline * start[1], success=True)
        return self.improve(motion, correspondences, rig, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        length = 0.5 * rig.baseline
        return [
            MotionEstimate(w=motion.w, d=length * motion.d, success=True)
            for motion in five_point_motions(temporal_pairs(sample, "left"), rig)
        ]

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        poselib = _poselib()
        if poselib is None:
            return MotionEstimate.failed(_MISSING)
        pairs = []
        for k, side in enumerate(SIDES):
            matches = temporal_pairs(correspondences, side)
            pair = poselib.PairwiseMatches()
            pair.cam_id1, pair.cam_id2 = k, k
            pair.x1, pair.x2 = matches[:, :2], matches[:, 2:]
            pairs.append(pair)
        extrinsics, cameras = _extrinsics(poselib, rig), [_camera(rig.camera)] * 2
        start = _pose(poselib, so3.exp(motion.w), motion.d)
        options = {**_BUNDLE, "max_iterations": 10} if quick else _BUNDLE
        pose, _ = poselib.refine_generalized_relative_pose(
            pairs, start, extrinsics, cameras, extrinsics, cameras, options
        )
        return _estimate(pose, metric=True)


@final
@dataclass(frozen=True, kw_only=True)
class PoselibPnpSolver(Solver):
    """Points from the disparities of frame 0, then the pose of frame 1's stereo pair from them."""

    name = "gs-stereo-pnp"
    needs = frozenset[MatchSet]({"tracks"})
    minimum: ClassVar[Mapping[MatchSet, int]] = MappingProxyType({"tracks": 4})
    metric = True
    motion_model = "linear"
    shutter = "global"
    reference_point = "body"
    reference = "PoseLib, generalised absolute pose; Persson, Nordberg: Lambda Twist, ECCV 2018"
    assumes = "global shutter; depth of frame 0 without noise"

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        usable = _with_depth(correspondences.tracks)
        if len(usable) < self.minimum["tracks"]:
            return MotionEstimate.failed(
                f"{len(usable)} tracks with positive disparity, need {self.minimum['tracks']}"
            )
        # A frame's motion is small: no motion at all is as good a start as a minimal solver's.
        still = MotionEstimate(w=np.zeros(3), d=np.zeros(3), success=True)
        return self.improve(still, correspondences, rig, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"tracks": 3}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        poselib, tracks = _poselib(), _with_depth(sample.tracks)
        if poselib is None or len(tracks) < 3:
            return []
        rays = rig.camera.unproject(tracks[:3, 4:6])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        # Points in the body; the left camera of frame 1 sees them at R x + d + offset.
        poses = poselib.p3p(rays, _points(tracks[:3], rig))
        return [_shifted(pose, rig.offset("left")) for pose in poses if np.all(np.isfinite(pose.t))]

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        poselib, tracks = _poselib(), _with_depth(correspondences.tracks)
        if poselib is None:
            return MotionEstimate.failed(_MISSING)
        points = _points(tracks, rig)
        start = _pose(poselib, so3.exp(motion.w), motion.d)
        options = {**_BUNDLE, "max_iterations": 10} if quick else _BUNDLE
        pose, _ = poselib.refine_generalized_absolute_pose(
            [tracks[:, 4:6], tracks[:, 6:8]],
            [points, points],
            start,
            _extrinsics(poselib, rig),
            [_camera(rig.camera)] * 2,
            options,
        )
        return _estimate(pose, metric=True)


def _with_depth(tracks: FloatArray) -> FloatArray:
    """Tracks with a positive disparity in frame 0."""
    return tracks[tracks[:, 0] - tracks[:, 2] > 0.0]


def _points(tracks: FloatArray, rig: StereoRig) -> FloatArray:
    """Points (n, 3) in the body of frame 0."""
    depth = rig.depth(tracks[:, 0] - tracks[:, 2])
    return depth[:, None] * rig.camera.unproject(tracks[:, :2]) - rig.offset("left")


def _shifted(pose: Any, offset: FloatArray) -> MotionEstimate:
    return MotionEstimate(w=so3.log(np.array(pose.R)), d=np.array(pose.t) - offset, success=True, metric=True)
