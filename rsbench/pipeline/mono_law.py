"""Which law of motion one camera followed, from its matches: ``inertial`` unless they ask for another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rsbench.capture.calibration import NO_ERRORS
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.model_choice import motion_at
from rsbench.capture.shutter_decision import known_of
from rsbench.capture.two_frame_estimate import CERTAIN, conclude, examine
from rsbench.components.motion_models import AcceleratedMotion, InertialMotion
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.motion import Motion
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate, RobustOptions
from rsbench.solvers.refined import RefinedSolver

_CLEARLY_LESS = 0.9
"""Of the error of the best law of constant speed, that is left where one that accelerates is believed. It has a
number more, which takes up what dense flow and a focal length err by."""
_LARGEST_PX = 1.25
"""Errors count up to here."""
_REACH = 3.0
"""Deviations up to which a match is right."""


def asked_for(
    found: RobustEstimate,
    matches: FloatArray,
    rig: StereoRig,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int = 0,
) -> tuple[RobustEstimate, Motion]:
    """The motion by the law that the matches ask for, and its estimate; that of ``found`` without such a one.

    Args:
        found: under ``inertial``, a success; it stays where no other law is clearly more probable.
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        rig: its body is where the camera is, the left one.
        shutter: of the camera.
        options: RANSAC of the search.
        seed: of the search.
    """
    inertial = InertialMotion(found.estimate.w, found.estimate.d)
    given = Correspondences(left=matches)
    known_shutter = KnownInputs(
        readout_ratio=shutter.readout_ratio, scanning=shutter.scanning, calibration=NO_ERRORS
    )
    known = known_of(given, rig, known_shutter)
    capture = conclude([examine(given, rig, known, options, seed, inertial)])
    laws = [name for name in capture.models if name in capture.peaks]
    if not laws or laws[0] == inertial.name or capture.models.get(inertial.name, 0.0) > 1.0 - CERTAIN:
        return found, inertial
    law = motion_at(capture.peaks[laws[0]])
    if law.name == AcceleratedMotion.name:
        steady = [motion_at(capture.peaks[name]) for name in laws[1:] if name != inertial.name]
        best = min([inertial, *steady], key=lambda each: error_px(each, matches, rig, shutter))
        if error_px(law, matches, rig, shutter) > _CLEARLY_LESS * error_px(best, matches, rig, shutter):
            law = best
    return (found, inertial) if law is inertial else _settled(found, law, matches, rig, shutter, capture.noise_px)


def _settled(
    found: RobustEstimate,
    law: Motion,
    matches: FloatArray,
    rig: StereoRig,
    shutter: RollingShutter,
    noise_px: float,
) -> tuple[RobustEstimate, Motion]:
    """The maximum of likelihood next to a motion by a law, with points before the camera."""
    right = np.abs(rs_sampson_error(rig, shutter, law, "left", matches)) <= _REACH * noise_px
    solver = RefinedSolver(motion_model=law.name, motion_parameters=dict(law.parameters), one_camera=True)
    near = MotionEstimate(w=law.w, d=law.d, success=True)
    estimate = solver.improve(near, Correspondences(left=matches[right]), rig, shutter)
    count = MatchCount(inliers=int(np.count_nonzero(right)), matches=len(matches))
    if not (estimate.success and np.any(estimate.d)):
        return found, InertialMotion(found.estimate.w, found.estimate.d)
    told = replace(
        found,
        estimate=estimate,
        inliers={**found.inliers, "left": right},
        counts={"left": count},
        motion_model=law.name,
    )
    return told, law.with_endpoint(estimate.w, estimate.d)


def error_px(
    motion: Motion, matches: FloatArray, rig: StereoRig, shutter: RollingShutter, side: Side = "left"
) -> float:
    """Root mean square Sampson error, px, of matches (n, 4) with outliers: each counts up to ``_LARGEST_PX``."""
    errors = np.abs(rs_sampson_error(rig, shutter, motion, side, matches))
    return float(np.sqrt(np.mean(np.fmin(errors, _LARGEST_PX) ** 2)))
