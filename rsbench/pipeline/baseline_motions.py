"""Motions as simpler assumptions find them, on the same matches and in the same robust loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsbench.components.motion_models import LinearMotion, make_motion
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver


def global_shutter_motion(
    matches: Correspondences, rig: StereoRig, options: RobustOptions, rng: np.random.Generator
) -> Motion | None:
    """Metric motion of the rig from all matches as if the shutter were global; None when there is none.

    The same maximum-likelihood solver as for the rolling shutter, with a readout ratio of 0.
    """
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=0.0)
    # Rolling-shutter matches miss a global-shutter motion by pixels: the threshold must let them in.
    loose = replace(options, threshold_px=4.0 * options.threshold_px)
    estimate = estimate_motion(matches, rig, shutter, RefinedSolver(), loose, rng).estimate
    return LinearMotion(estimate.w, estimate.d) if estimate.success else None


def monocular_motion(
    inliers: Correspondences, rig: StereoRig, shutter: RollingShutter, side: Side, start: Motion
) -> Motion | None:
    """Constant-velocity motion of one camera alone, about its own centre (``rig.about(side)``); None for none.

    Maximum likelihood on the matches over time of one side, which must be free of outliers, descending from the
    rig's motion ``start``: the most that one camera can know, spared the false minima that its own search may end
    in. The translation has length 1: one camera does not know it. A depth map made with it has the same unit, so
    the correction does not need to.
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
    """Motion of one camera about its own centre by a solver of the left camera, from its matches over time.

    It follows ``model``, with the parameters that the solver found. The translation has length 1; None when the
    solver finds none. Right matches are handed over as left ones: the cameras are equal.
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
    """The temporal matches and tracks that a robust estimate kept."""
    return Correspondences(
        left=matches.left[robust.inliers["left"]],
        right=matches.right[robust.inliers["right"]],
        tracks=matches.tracks[robust.inliers["tracks"]],
    )
