"""PoseLib: points from the disparities of frame 0, pose of frame 1 from points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, SolverSpec
from rsbench.solvers.engine.poselib_adapter import (
    MISSING,
    PoselibSolver,
    poselib_camera,
    poselib_module,
    rig_extrinsics,
)
from rsbench.solvers.engine.stereo_points import stereo_points, with_depth


@final
@dataclass(frozen=True, kw_only=True)
class PoselibPnpSolver(PoselibSolver):
    """Points from the disparities of frame 0, then the pose of frame 1's stereo pair from them."""

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
        usable = with_depth(correspondences.tracks)
        if len(usable) < self.spec.minimum["tracks"]:
            return MotionEstimate.failed(
                f"{len(usable)} tracks with positive disparity, need {self.spec.minimum['tracks']}"
            )
        # A frame's motion is small: no motion at all is as good a start as a minimal solver's.
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
        # Points in the body; the left camera of frame 1 sees them at R x + d + offset.
        poses = poselib.p3p(rays, stereo_points(tracks[:3], rig))
        return [_shifted(pose, rig.offset("left")) for pose in poses if np.all(np.isfinite(pose.t))]

    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        tracks = with_depth(correspondences.tracks)
        points = stereo_points(tracks, rig)
        pose, _ = poselib.refine_generalized_absolute_pose(
            [tracks[:, 4:6], tracks[:, 6:8]],
            [points, points],
            start,
            rig_extrinsics(poselib, rig),
            [poselib_camera(rig.camera)] * 2,
            options,
        )
        return pose


def _shifted(pose: Any, offset: FloatArray) -> MotionEstimate:
    return MotionEstimate(w=so3.log(np.array(pose.R)), d=np.array(pose.t) - offset, success=True, metric=True)
