"""PoseLib on the left camera: five points, then the Sampson error of all its matches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, SolverSpec
from rsbench.solvers.engine.poselib_adapter import PoselibSolver, five_point_motions, left_start, poselib_camera


@final
@dataclass(frozen=True, kw_only=True)
class PoselibMonoSolver(PoselibSolver):
    """Left camera only: five-point proposals, then the Sampson error of all matches."""

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

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches = temporal_pairs(correspondences, "left")
        short = self.spec.shortage({"left": len(matches)})
        if short is not None:
            return short
        start = left_start(matches, rig)
        return self.improve(start, correspondences, rig, shutter) if start.success else start

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return five_point_motions(temporal_pairs(sample, "left"), rig)

    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        matches, camera = temporal_pairs(correspondences, "left"), poselib_camera(rig.camera)
        pose, _ = poselib.refine_relative_pose(matches[:, :2], matches[:, 2:], start, camera, camera, options)
        return pose
