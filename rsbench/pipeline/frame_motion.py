"""Estimate the motion of a rig's body between two frame times with a known shutter and calibration.

The motion is a solver's answer under the motion model that the matches support most, or a spline in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rsbench.capture.calibration import RefusedFramesError, recalibrated
from rsbench.capture.hypotheses import MODELS, Known, scans_of
from rsbench.capture.model_choice import (
    AUTO,
    ModelChoice,
    choose_model,
    compared_models,
    spline_choice,
    spread_by_unknowns,
)
from rsbench.capture.rig_calibration import spread_of_motion
from rsbench.capture.shutter_decision import LEAST_BACKWARDS, NoMotionError, reversed_scans, scans_by_laws
from rsbench.capture.trajectory_gyro import GyroFound
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_estimate import CERTAIN, Capture, conclude, examine
from rsbench.capture.two_frame_spline import Departure, departure, log_odds_of_opposite, two_frame_spline
from rsbench.components.motion_models import load_kernel, make_motion, model_name
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_capture import BACKWARDS, KnownCapture
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import MotionEstimate, SolverEntry, SolverSpec
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

if TYPE_CHECKING:
    from rsbench.pipeline.frame_depth import CorrectionOptions


def body_motion(estimate: MotionEstimate, spec: SolverSpec, rig: StereoRig) -> Motion | str:
    """Convert a solver's estimate to the body's motion in metres, or return the reason why this is impossible.

    A left camera's translation t becomes the body's: d = t - o + R o, with o the left camera's offset. The pose
    after one period is then exact. At times between, a constant twist of the camera is a constant twist of the
    body too; under the linear model of the camera, the body deviates from linear motion by up to |w|^2 |o| / 8.

    Args:
        estimate: the solver's answer.
        spec: the solver's specification: the point whose translation d is, and the motion model.
        rig: the rig, for the offset of the left camera.
    """
    if not estimate.success:
        return estimate.reason
    if not estimate.metric:
        whose = "the left camera's " if spec.reference_point == "left" else ""
        return f"the length of d is not known in metres, only the direction of {whose}translation"
    d = estimate.d
    if spec.reference_point == "left":
        offset = rig.offset("left")
        d = d - offset + so3.exp(estimate.w) @ offset
    return make_motion(spec.motion_model, estimate.w, d, spec.motion_parameters)


SHAKES = (
    "cannot tell the readout ratio: the rig shakes, and two frames do not distinguish a shake that no model "
    "describes from a readout. Give readout_ratio in the rig's card, or four frames or more"
)
_CERTAIN_LOG_ODDS = 23.0
"""Log-odds threshold for choosing one spline over another: 7, i.e. a probability of 0.999, if each track had
weight 0.15 instead of 0.5."""
_MOMENTS = 33
"""Number of times in a frame period at which poses are compared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMotion:
    """The motion of the rig's body, and the solver's answer from which it was computed."""

    motion: Motion
    """The body's motion, metres, under the solver's motion model or the one that was chosen."""
    robust: RobustEstimate
    """The solver's answer, about the solver's reference point."""
    solver: str
    """Name of the solver's entry."""
    reference_point: str
    """The point whose translation ``robust.estimate.d`` is."""
    choice: ModelChoice | None = None
    """How the motion model was chosen; None if it is the solver's."""
    gyro: GyroFound | None = None
    """Estimated errors of a gyroscope; None: there is none."""

    @property
    def unevenness(self) -> tuple[float, float]:
        """Root mean square deviation from a uniform motion through the poses at times 0 and 1.

        Returns radians, and metres of the middle of the rig: near 0 for uniform motion, large for a shaking rig.
        """
        tau = np.linspace(0.0, 1.0, _MOMENTS)
        (R, t), w = self.motion.body_from_world(tau), self.motion.w
        places = -(np.swapaxes(R, 1, 2) @ t[..., None])[..., 0]
        turns = so3.log(R @ np.swapaxes(so3.exp(tau[:, None] * w), 1, 2))
        shifts = places - tau[:, None] * places[-1]
        turned, shifted = (float(np.sqrt(np.mean(np.sum(each**2, axis=1)))) for each in (turns, shifts))
        return turned, shifted


def find_motion(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    rng: np.random.Generator | None = None,
    compared: Capture | None = None,
    splines: bool = True,
) -> FoundMotion:
    """Estimate the body's motion with the solver of the options; ``rng`` is for RANSAC, by default from the seed.

    With a motion model in the options, the model is selected by ``under_model``. The solver of another package
    runs in a separate process with the time limit of its card.

    Raises:
        RsbenchError: the solver does not support the motion model of the options.
        NoMotionError: the solver failed, found no motion, or only the direction of the translation.
    """
    entry, choice, given = options.solver, None, Matched(matches, rig, shutter)
    rng, requested = np.random.default_rng(options.seed) if rng is None else rng, options.motion_model

    def solve(entry: SolverEntry) -> RobustEstimate:
        return _solver_answer(entry, *given, options, rng)

    if requested is not None:
        robust, entry, choice, law = under_model(
            requested, entry, solve, given, options.robust, options.seed, compared, splines
        )
    else:
        robust = solve(entry)
        if compared is not None and compared.motion_model in compared.peaks:
            robust = widened(robust, spread_by_unknowns(compared.peaks[compared.motion_model]))
        law = body_motion(robust.estimate, entry.solver.spec, rig)
    motion = law if isinstance(law, Motion) else motion_of(robust.estimate, entry, rig)
    point = entry.solver.spec.reference_point
    return FoundMotion(motion=motion, robust=robust, solver=entry.name, reference_point=point, choice=choice)


class Matched(NamedTuple):
    """Matches of two frame times with their rig and shutter."""

    matches: Correspondences
    rig: StereoRig
    shutter: RollingShutter


class UnderModel(NamedTuple):
    """The answer of a solver under the motion model that matches support most, or that is requested."""

    robust: RobustEstimate
    entry: SolverEntry
    choice: ModelChoice | None
    """None if no model could be chosen, and the solver's own model was used."""
    motion: Motion | str
    """Motion of the body, metres; or why there is none."""


def under_model(
    requested: str,
    entry: SolverEntry,
    solve: Callable[[SolverEntry], RobustEstimate],
    given: Matched,
    robust: RobustOptions,
    seed: int,
    compared: Capture | None = None,
    splines: bool = True,
) -> UnderModel:
    """Solve under the requested or selected motion model, or replace the answer by a spline.

    Args:
        requested: ``auto`` or the name of a model; with ``auto`` and ``splines``, a spline may be used.
        entry: entry of a solver that ``takes_models``.
        solve: returns the answer of a solver.
        compared: comparison of the models from an estimate that included the shutter; None: compare them here.
    """
    choice = None if compared is None else choose_model(compared, requested)
    entry = entry if choice is None else entry_of(entry, choice)
    found = solve(entry)
    motion = body_motion(found.estimate, entry.solver.spec, given.rig)
    if choice is None and isinstance(motion, Motion):
        choice = chosen_model(requested, motion, *given, robust, seed)
        other = entry if choice is None else entry_of(entry, choice)
        if other is not entry:
            entry, found = other, solve(other)
    if choice is not None:
        found = widened(found, choice.spread)
    motion = body_motion(found.estimate, entry.solver.spec, given.rig)
    if splines and requested == AUTO and isinstance(motion, Motion):
        found, choice, motion = or_spline(found, choice, motion, *given, seed)
    elif isinstance(motion, Motion):
        found = departed(found, departure(*given, motion))
    return UnderModel(found, entry, choice, motion)


def or_spline(
    robust: RobustEstimate,
    choice: ModelChoice | None,
    law: Motion,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    seed: int,
) -> tuple[RobustEstimate, ModelChoice | None, Motion]:
    """The given answer of a solver under ``law``, or a spline in its place if the matches clearly support one."""
    found = two_frame_spline(matches, rig, shutter, law, seed)
    if found is None or found.probability < CERTAIN:
        return departed(robust, departure(matches, rig, shutter, law)), choice, law
    motion = found.motion
    estimate = replace(
        robust.estimate, w=motion.w, d=motion.d, noise_px=found.noise_px, covariance=found.covariance
    )
    count = MatchCount(inliers=int(np.count_nonzero(found.inliers)), matches=len(found.inliers))
    robust = replace(
        robust,
        estimate=estimate,
        inliers={**robust.inliers, "tracks": found.inliers},
        counts={**robust.counts, "tracks": count},
    )
    return robust, spline_choice(choice, motion, law, found.probability, found.unique), motion


def widened(robust: RobustEstimate, spread: FloatArray) -> RobustEstimate:
    """The estimate with ``spread`` (6, 6) added to its covariance."""
    return departed(robust, Departure(covariance=spread))


def departed(robust: RobustEstimate, by: Departure) -> RobustEstimate:
    """The estimate with a covariance that includes departures from the motion model."""
    known = robust.estimate.covariance
    return robust if known is None else replace(robust, estimate=replace(robust.estimate, covariance=by.of(known)))


def _solver_answer(
    entry: SolverEntry,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    rng: np.random.Generator,
) -> RobustEstimate:
    if entry.built_in:
        return estimate_motion(matches, rig, shutter, entry.solver, options.robust, rng, entry.options.robust)
    with SolverRunner() as runner:
        return runner.robust(entry, matches, rig, shutter, options.robust, rng)


def chosen_model(
    requested: str,
    start: Motion,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    robust: RobustOptions,
    seed: int,
) -> ModelChoice | None:
    """Choose the motion model by the matches, for a known shutter; None if no model fits.

    Args:
        requested: ``auto`` or the name of a model.
        start: a motion near the true one, of any model.
    """
    known = Known().with_shutter(shutter)
    capture = conclude([examine(matches, rig, known, robust, seed, start)])
    if requested not in (AUTO, *capture.peaks):  # the matches exclude it, or it is from another package
        alone = conclude([examine(matches, rig, replace(known, models=(requested,)), robust, seed, start)])
        models, peaks = {**capture.models, requested: 0.0}, {**capture.peaks, **alone.peaks}
        capture = replace(capture, models=models, peaks=peaks)
    return choose_model(capture, requested)


def takes_models(entry: SolverEntry) -> bool:
    """Whether a solver can assume any motion model."""
    solver = entry.solver
    return isinstance(solver, RefinedSolver) and solver.shutter == "rolling" and not solver.one_camera


def check_model(requested: str, entry: SolverEntry) -> None:
    """Raise RsbenchError if there is no such motion model, or the solver has a fixed one."""
    if requested != AUTO:
        load_kernel(requested)
    if not takes_models(entry):
        spec = entry.solver.spec
        limits = f"solver {entry.name!r} supports only {spec.motion_model} motion and a {spec.shutter} shutter"
        limits += "" if spec.metric else ", without scale"
        raise RsbenchError(f"--motion-model {requested}: {limits}; use --solver rs-stereo-refined")


def model_to_use(requested: str | None, entry: SolverEntry) -> str | None:
    """The requested motion model, by default ``auto`` if supported. Raises as ``check_model`` does."""
    if requested is None:
        return AUTO if takes_models(entry) else None
    check_model(requested, entry)
    return requested


def entry_of(entry: SolverEntry, choice: ModelChoice) -> SolverEntry:
    """The entry of a refined solver with the chosen motion model."""
    solver = entry.solver
    assert isinstance(solver, RefinedSolver)
    if choice.used == solver.motion_model and not choice.parameters:
        return entry
    return replace(
        entry, component=replace(solver, motion_model=choice.used, motion_parameters=dict(choice.parameters))
    )


def motion_of(estimate: MotionEstimate, entry: SolverEntry, rig: StereoRig) -> Motion:
    """The body's motion, metres, for a solver's answer, under the solver's motion model.

    Raises:
        NoMotionError: the solver failed, or its translation has no scale.
    """
    motion = body_motion(estimate, entry.solver.spec, rig)
    if isinstance(motion, Motion):
        return motion
    if not estimate.success:
        raise NoMotionError(f"solver {entry.name!r} found no motion: {motion}")
    if entry.solver.spec.metric:
        raise NoMotionError(f"solver {entry.name!r}: {motion}: more matches must be seen by both cameras")
    raise NoMotionError(f"solver {entry.name!r}: {motion}; a correction needs metres: use rs-stereo-refined")


def solve_frames(known: KnownCapture, options: CorrectionOptions, *, in_order: bool = False) -> FoundMotion:
    """Estimate the motion between two frame times with a known shutter and calibration.

    Args:
        known: result of ``know_four`` or ``know_matches``, with matches.
        in_order: whether the frames are known to be in temporal order, and the shutter is not from them alone.

    Raises:
        RefusedFramesError: the frames are in reverse order.
        NoMotionError: no motion explains the matches.
    """
    rig, shutter = known.rig, known.shutter
    corrected = recalibrated(known.matches or Correspondences(), rig, known.calibration)
    found = find_motion(corrected, rig, shutter, options, compared=known.models)
    if known.capture is None and not in_order and _runs_backwards(corrected, rig, found, shutter, options):
        raise RefusedFramesError(BACKWARDS)
    if known.capture is not None and not in_order and isinstance(found.motion, ContinuousMotion):
        raise NoMotionError(SHAKES)
    if known.rig_found is not None and found.robust.estimate.covariance is not None:
        estimate = found.robust.estimate
        model = model_name(type(found.motion))
        model = model if model in MODELS else "linear"  # of a spline
        noise = estimate.noise_px or 0.0
        spread = spread_of_motion(known.rig_found, corrected, estimate.w, estimate.d, noise, model)
        found = replace(found, robust=widened(found.robust, spread))
    return found


def _runs_backwards(
    matches: Correspondences,
    rig: StereoRig,
    found: FoundMotion,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> bool:
    """Whether the frames are in reverse order: their lines then seem to be read from the opposite side.

    Motion models must give the opposite scan with certainty and a ratio near the given one, as an arbitrary ratio
    results if none fits. For a shaking rig, splines under both scans decide, unless models confirm the given scan.
    """
    if shutter.readout_ratio < LEAST_BACKWARDS or not shutter.plain:
        return False
    shakes, opposite = isinstance(found.motion, ContinuousMotion), reversed_scans(scans_of(shutter))
    if shakes:
        other = replace(shutter, scan=opposite.left, right_scan=opposite.right)  # pyrefly: ignore
        if log_odds_of_opposite(matches, rig, shutter, other, found.motion, options.seed) <= _CERTAIN_LOG_ODDS:
            return False
    models, start = compared_models(options.motion_model), None if shakes else found.motion
    scans = scans_by_laws(matches, rig, shutter, models, options.robust, options.seed, start, not shakes)
    return scans != scans_of(shutter) if shakes else scans == opposite
