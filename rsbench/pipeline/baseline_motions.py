"""Motions under simpler assumptions (global shutter, one camera alone), from the same matches and robust loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, final

import numpy as np
from numpy.typing import NDArray

from rsbench.components.motion_models import LinearMotion, make_motion
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import SIDES, Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_depth import Images
from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.solvers.zhuang import ZhuangSolver
from rsbench.vision.correction import WarpOptions
from rsbench.vision.corrector import CorrectionProblem, Corrector, CorrectorSpec
from rsbench.vision.correctors import FusionCorrector
from rsbench.vision.flow import dense_flow, monocular_depth
from rsbench.vision.fusion import Fused


def global_shutter_motion(
    matches: Correspondences, rig: StereoRig, options: RobustOptions, rng: np.random.Generator
) -> Motion | None:
    """Metric motion of the rig from all matches as if the shutter were global; None if none is found.

    The solver is the maximum-likelihood solver for rolling shutters with a readout ratio of 0.
    """
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=0.0)
    # Rolling-shutter matches have errors of pixels under a global-shutter motion, so enlarge the threshold.
    loose = replace(options, threshold_px=4.0 * options.threshold_px)
    estimate = estimate_motion(matches, rig, shutter, RefinedSolver(), loose, rng).estimate
    return LinearMotion(estimate.w, estimate.d) if estimate.success else None


def monocular_motion(
    inliers: Correspondences, rig: StereoRig, shutter: RollingShutter, side: Side, start: Motion
) -> Motion | None:
    """Constant-velocity motion of one camera alone, about its own centre (``rig.about(side)``); None: no motion.

    It is the maximum of the likelihood of one side's temporal matches, without outliers, near the rig's motion
    ``start``: the best that one camera can achieve, without the risk of a wrong local minimum. The translation has
    length 1, as its scale is unknown. Depth computed with it has the same unit, so a correction needs no scale.
    """
    d = translation_of_offset(start.w, start.d, rig.offset(side))
    pairs = Correspondences(**{side: temporal_pairs(inliers, side)})
    first = MotionEstimate(w=start.w, d=_unit(d), success=True)
    estimate = RefinedSolver(use_tracks=False).improve(first, pairs, rig.about(side), shutter)
    if not estimate.success or not np.any(estimate.d):
        return None
    return LinearMotion(estimate.w, _unit(estimate.d))


def solved_alone(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    side: Side,
    solver: Solver,
    options: RobustOptions,
    rng: np.random.Generator,
    model: str = LinearMotion.name,
) -> Motion | None:
    """Motion of one camera about its own centre from its temporal matches, by a solver for the left camera.

    It follows ``model``, with the parameters that the solver found, and its translation has length 1; None if the
    solver finds none. Right matches are passed as left ones, since the cameras are equal.
    """
    pairs = Correspondences(left=temporal_pairs(matches, side))
    estimate = estimate_motion(pairs, rig, shutter, solver, options, rng).estimate
    if not estimate.success or not np.any(estimate.d):
        return None
    return make_motion(model, estimate.w, _unit(estimate.d), estimate.motion_parameters)


def _unit(d: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(d))
    return d / length if length > 0.0 else np.array([0.0, 0.0, 1.0])


def kept_matches(matches: Correspondences, robust: RobustEstimate) -> Correspondences:
    """The temporal matches and tracks that are inliers of a robust estimate."""
    return Correspondences(
        left=matches.left[robust.inliers["left"]],
        right=matches.right[robust.inliers["right"]],
        tracks=matches.tracks[robust.inliers["tracks"]],
    )


# Correction with one camera alone: its own motion, up to scale, and depth from its own flow in the same unit.


def depth_alone(
    images: Images, rig: StereoRig, shutter: RollingShutter, motion: Motion, view: View
) -> NDArray[np.float32]:
    """Depth (H, W) of a frame from its flow to the camera's other frame, in the unit of the camera's motion.

    ``rig`` has its body at that camera.
    """
    side, frame = view
    flow = dense_flow(images[view], images[side, 1 - frame])
    return monocular_depth(flow, rig, shutter, motion, side, frame)


@final
@dataclass(frozen=True, kw_only=True)
class ZhuangCorrector(Corrector):
    """Warp each frame by the motion from its camera's matches and by depth from its camera's flow.

    The motion is that of the paper's solver in our robust loop. Depth is triangulated from the flow with the
    readout times of both ends, while the paper uses differential flow; both agree to first order.
    """

    acceleration: Literal["none", "constant"] = "none"
    """Acceleration model of ``ZhuangSolver``."""
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
        """The motion of one camera about its own centre, with d of length 1, from its matches; None: no motion."""
        solver = ZhuangSolver(acceleration=self.acceleration)
        rng = np.random.default_rng([self.seed, SIDES.index(side)])
        return solved_alone(matches, rig, shutter, side, solver, self.robust, rng, solver.spec.motion_model)

    def _moved(self, problem: CorrectionProblem, view: View, motion: Motion | None) -> CorrectionProblem | None:
        """The problem of one frame with the camera's own motion and depth; None without a motion."""
        if motion is None:
            return None
        rig = problem.rig.about(view[0])
        depth = depth_alone(problem.images, rig, problem.shutter, motion, view)
        return replace(problem, rig=rig, motion=motion, depth={view: depth}, guess=None, disparity_offset=0.0)
