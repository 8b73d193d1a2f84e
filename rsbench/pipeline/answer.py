"""Solve a problem file and build the answer that ``rsbench solve --json`` prints
(docs/reference/problem-format.md)."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal

import numpy as np

from rsbench.capture.calibration import recalibrated
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.shutter_decision import NoMotionError, record_of, shutter_found
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_estimate import Capture
from rsbench.core.correspondences import Correspondences, join_stereo
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.pipeline.frame_capture import capture_of
from rsbench.pipeline.frame_motion import SHAKES, Matched, body_motion, takes_models, under_model
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.base import MotionEstimate, SolverEntry, SolverSpec
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions

Answer = dict[str, Any]
Extra = Literal["covariance", "noise", "inliers"]
EXTRAS: tuple[Extra, ...] = ("covariance", "noise", "inliers")
NO_LENGTH = "none: direction only"


def solve_problem(
    problem: Problem,
    entry: SolverEntry,
    options: RobustOptions,
    runner: SolverRunner,
    seed: int = 0,
    extras: Collection[Extra] = (),
    motion_model: str | None = None,
) -> Answer:
    """The answer to a problem, for JSON; if the solver fails, motions are None and ``reason`` says why.

    Args:
        motion_model: ``auto`` or a model to use instead of the solver's; None: the solver's.

    Raises:
        RsbenchError: there is no such motion model, or the solver has a fixed one.
    """
    joined, spec, choice = join_stereo(problem.correspondences), entry.solver.spec, None
    shutter, capture, doubt = _shutter_of(problem, joined.correspondences, entry, options, seed)
    matches = _recalibrated(joined.correspondences, problem.rig, shutter, capture)
    given, rng = Matched(matches, problem.rig, shutter), np.random.default_rng(seed)

    def solve(entry: SolverEntry) -> RobustEstimate:
        return runner.robust(entry, *given, options, rng)

    if doubt:
        result = _unsolved(doubt, options)
    elif motion_model is not None and takes_models(entry):
        result, entry, choice, motion = under_model(motion_model, entry, solve, given, options, seed, capture)
        if capture is not None and isinstance(motion, ContinuousMotion):
            result, choice = _unsolved(SHAKES, options), None
    else:
        result = solve(entry)
    estimate = result.estimate
    body = body_motion(estimate, spec, problem.rig)
    notes = [estimate.reason] if joined.note in estimate.reason else [estimate.reason, joined.note]
    return {
        "name": problem.name,
        "solver": entry.name,
        "success": estimate.success,
        "reason": "; ".join(filter(None, notes)),
        "w": estimate.w.tolist() if estimate.success else None,
        "d": estimate.d.tolist() if estimate.success else None,
        "d_unit": "m" if estimate.metric else NO_LENGTH,
        "metric": estimate.metric,
        "direction_known": estimate.direction_known,
        "reference_point": spec.reference_point,
        "d_body": None if isinstance(body, str) else body.d.tolist(),
        **({} if problem.rig.aligned else {"cameras": _camera_motions(estimate, spec, body, problem.rig)}),
        "motion_model": spec.motion_model if choice is None else choice.used,
        **({} if motion_model is None else {"model_choice": None if choice is None else choice.record()}),
        "shutter": spec.shutter,
        "readout_ratio": shutter.readout_ratio if _knows_ratio(problem, capture, doubt) else None,
        **({} if capture is None else {"readout": record_of(capture)}),
        "assumes": spec.assumes,
        "inliers": result.inlier_count,
        "matches": result.match_count,
        "stereo_alone": joined.alone,
        "threshold_px": result.threshold_px,
        "iterations": result.iterations,
        "seconds": result.seconds,
        **_extras(problem, result, extras),
    }


def _shutter_of(
    problem: Problem, matches: Correspondences, entry: SolverEntry, options: RobustOptions, seed: int
) -> tuple[RollingShutter, Capture | None, str]:
    """The shutter of a problem, the capture from which it was estimated, and why it cannot be determined."""
    still = problem.rig.shutter_of(Scanning(), 0.0)
    if problem.known_shutter is not None or entry.solver.spec.shutter == "global":
        return problem.known_shutter or still, None, ""
    try:
        capture = capture_of(matches, problem.rig, KnownInputs(scanning=problem.scanning), options, seed)
    except ValueError as error:  # a match where a lens shows no ray
        return still, None, str(error)
    try:
        return shutter_found(capture, problem.rig), capture, ""
    except NoMotionError as error:
        return still, capture, str(error)


def _recalibrated(
    matches: Correspondences, rig: StereoRig, shutter: RollingShutter, capture: Capture | None
) -> Correspondences:
    """The matches corrected for the calibration errors that were estimated with the shutter."""
    if capture is None or not rig.rows_together(shutter.scanning):
        return matches
    return recalibrated(matches, rig, capture.calibration)


def _knows_ratio(problem: Problem, capture: Capture | None, doubt: str) -> bool:
    """Whether a readout ratio was given or estimated; solvers for global shutters estimate none."""
    return not doubt and (problem.known_shutter is not None or capture is not None)


def _unsolved(reason: str, options: RobustOptions) -> RobustEstimate:
    failed = MotionEstimate.failed(reason)
    return RobustEstimate(estimate=failed, iterations=0, seconds=0.0, threshold_px=options.threshold_px)


def _camera_motions(
    estimate: MotionEstimate, spec: SolverSpec, body: Motion | str, rig: StereoRig
) -> dict[str, Any] | None:
    """The motion of each camera in its own axes; without scale, only the left camera's d may be known."""
    if not estimate.success:
        return None
    out = dict[str, Any]()
    for side in SIDES:
        R, d = rig.own(side).R, None
        if not isinstance(body, str):
            d = translation_of_offset(estimate.w, body.d, rig.offset(side))
        elif (spec.reference_point, side) == ("left", "left"):
            d = estimate.d
        out[side] = {"w": (R @ estimate.w).tolist(), "d": None if d is None else (R @ d).tolist()}
    return out


def _extras(problem: Problem, result: RobustEstimate, extras: Collection[Extra]) -> Answer:
    estimate, out = result.estimate, Answer()
    if "covariance" in extras:
        out["covariance"] = None if estimate.covariance is None else estimate.covariance.tolist()
    if "noise" in extras:
        out["noise_px"] = estimate.noise_px
    if "inliers" in extras:
        # Joined tracks come after those of the file; their points belong to pairs of the file.
        tracks = len(problem.correspondences.tracks)
        out["inlier_indices"] = {
            str(name): np.flatnonzero(mask[:tracks] if name == "tracks" else mask).tolist()
            for name, mask in result.inliers.items()
        }
    return out
