"""Correction with one camera alone: its own motion, up to scale, and depth from its own flow in the same unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.baseline_motions import solved_alone
from rsbench.pipeline.frame_depth import Images
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.zhuang import ZhuangSolver
from rsbench.vision.correction import WarpOptions
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.correctors import FusionCorrector
from rsbench.vision.flow import dense_flow, monocular_depth
from rsbench.vision.fusion import Fused


def depth_alone(
    images: Images, rig: StereoRig, shutter: RollingShutter, motion: Motion, view: View
) -> NDArray[np.float32]:
    """Depth (H, W) of a frame from its flow to the other one of its camera, in the unit of that camera's motion.

    ``rig`` has its body where that camera is.
    """
    side, frame = view
    flow = dense_flow(images[view], images[side, 1 - frame])
    return monocular_depth(flow, rig, shutter, motion, side, frame)


@final
@dataclass(frozen=True, kw_only=True)
class ZhuangCorrector(Corrector):
    """Each frame warped by the motion that its camera's matches tell, and by the depth of its camera's flow.

    The motion is that of the paper's solver in our robust loop. Depth is triangulated, each end of the flow at the
    time of its own row, where the paper reads it from the differential flow: the same to first order.
    """

    acceleration: Literal["none", "constant"] = "none"
    """As of ``ZhuangSolver``."""
    robust: RobustOptions = field(default_factory=RobustOptions)
    """RANSAC of the motion."""
    seed: int = 0
    """Seed of the random samples."""
    warp: WarpOptions = field(default_factory=WarpOptions)
    """How pixels are taken from the source image."""

    spec = CorrectorSpec(
        needs={"matches"},
        reference="Zhuang, Cheong, Lee: Rolling-Shutter-Aware Differential SfM and Image Rectification, ICCV 2017",
        assumes="one camera, two frames: constant velocity, or acceleration; small motion with a translation; a "
        "scene that stands still and is not planar",
    )

    def correct(self, problem: CorrectionProblem, views: Sequence[View]) -> dict[View, Fused]:
        return self.correct_rows(problem, views, (problem.target_row,))[0]

    def correct_rows(
        self, problem: CorrectionProblem, views: Sequence[View], rows: Sequence[float]
    ) -> list[dict[View, Fused]]:
        if problem.matches is None:
            raise ValueError("the matches are not known: 'matches' must be among the needs of the corrector")
        known = problem.matches, problem.rig, problem.shutter
        motions = {side: self.motion(*known, side) for side in dict(views)}
        moved = {view: self._moved(problem, view, motions[view[0]]) for view in views}
        single = FusionCorrector(use_other_views=False, guess_depth=False, moving=False, warp=self.warp)

        def corrected(view: View, row: float) -> Fused:
            one = moved[view]
            if one is None:
                return Fused.failed(
                    problem.images[view], f"no motion of the {view[0]} camera explains its matches"
                )
            return single.correct(replace(one, target_row=row), [view])[view]

        return [{view: corrected(view, row) for view in views} for row in rows]

    def motion(
        self, matches: Correspondences, rig: StereoRig, shutter: RollingShutter, side: Side
    ) -> Motion | None:
        """Of one camera about its own centre, d of length 1, from its matches over time; None for none."""
        solver = ZhuangSolver(acceleration=self.acceleration)
        rng = np.random.default_rng([self.seed, SIDES.index(side)])
        return solved_alone(matches, rig, shutter, side, solver, self.robust, rng, solver.spec.motion_model)

    def _moved(self, problem: CorrectionProblem, view: View, motion: Motion | None) -> CorrectionProblem | None:
        """That of one frame whose motion and depth are known; None without a motion."""
        if motion is None:
            return None
        rig = problem.rig.about(view[0])
        depth = depth_alone(problem.images, rig, problem.shutter, motion, view)
        return replace(problem, rig=rig, motion=motion, depth={view: depth}, guess=None, disparity_offset=0.0)
