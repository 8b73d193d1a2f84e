"""The answer to a problem, as ``rsbench solve --json`` prints it: docs/reference/problem-format.md."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Literal

import numpy as np

from rsbench.capture.settle import ModelChoice
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.track_building import join_stereo
from rsbench.pipeline.body_motion import body_motion
from rsbench.pipeline.frame_motion import chosen_model, entry_of, takes_models, widened
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.registry import SolverEntry
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
    """Answer to a problem, ready for JSON; a failure has null for every motion, and the reason.

    Args:
        motion_model: ``auto`` or a model to use instead of the solver's; None: the solver's.

    Raises:
        RsbenchError: there is no such motion model, or the solver can take no other than its own.
    """
    joined, spec, choice = join_stereo(problem.correspondences), entry.solver.spec, None
    given = (joined.correspondences, problem.rig, problem.shutter, options, np.random.default_rng(seed))
    result = runner.robust(entry, *given)
    if motion_model is not None and takes_models(entry):
        entry, result, choice = _under_model(motion_model, entry, result, runner, given, seed)
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
        "motion_model": spec.motion_model if choice is None else choice.used,
        **({} if motion_model is None else {"model_choice": None if choice is None else choice.record()}),
        "shutter": spec.shutter,
        "assumes": spec.assumes,
        "inliers": result.inlier_count,
        "matches": result.match_count,
        "stereo_alone": joined.alone,
        "threshold_px": result.threshold_px,
        "iterations": result.iterations,
        "seconds": result.seconds,
        **_extras(problem, result, extras),
    }


Given = tuple[Correspondences, StereoRig, RollingShutter, RobustOptions, np.random.Generator]


def _under_model(
    asked: str, entry: SolverEntry, result: RobustEstimate, runner: SolverRunner, given: Given, seed: int
) -> tuple[SolverEntry, RobustEstimate, ModelChoice | None]:
    """The answer under the motion model that the matches prefer, or that is asked for."""
    matches, rig, shutter, options, _ = given
    start = body_motion(result.estimate, entry.solver.spec, rig)
    choice = (
        chosen_model(asked, start, matches, rig, shutter, options, seed) if isinstance(start, Motion) else None
    )
    other = entry if choice is None else entry_of(entry, choice)
    result = result if other is entry else runner.robust(other, *given)
    return other, result if choice is None else widened(result, choice.spread), choice


def _extras(problem: Problem, result: RobustEstimate, extras: Collection[Extra]) -> Answer:
    estimate, out = result.estimate, Answer()
    if "covariance" in extras:
        out["covariance"] = None if estimate.covariance is None else estimate.covariance.tolist()
    if "noise" in extras:
        out["noise_px"] = estimate.noise_px
    if "inliers" in extras:
        # Tracks that were joined come after those of the file; their ends are in the file's pairs.
        tracks = len(problem.correspondences.tracks)
        out["inlier_indices"] = {
            str(name): np.flatnonzero(mask[:tracks] if name == "tracks" else mask).tolist()
            for name, mask in result.inliers.items()
        }
    return out
