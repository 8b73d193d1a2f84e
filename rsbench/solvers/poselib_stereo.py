"""PoseLib on the rig: generalised relative pose of left and right pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, SolverSpec
from rsbench.solvers.engine.poselib_adapter import (
    PoselibSolver,
    five_point_motions,
    left_start,
    poselib_camera,
    rig_extrinsics,
)


@final
@dataclass(frozen=True, kw_only=True)
class PoselibStereoSolver(PoselibSolver):
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

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        short = self.spec.shortage({side: len(temporal_pairs(correspondences, side)) for side in SIDES})
        if short is not None:
            return short
        start = left_start(temporal_pairs(correspondences, "left"), rig)
        if not start.success:
            return start
        return self.improve(replace(start, d=0.5 * rig.baseline * start.d), correspondences, rig, shutter)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        length = 0.5 * rig.baseline
        return [
            replace(motion, d=length * motion.d)
            for motion in five_point_motions(temporal_pairs(sample, "left"), rig)
        ]

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
