"""The motion of a rig's body between two times whose capture is known, from their matches.

A solver's answer under the motion model that the matches prefer, or a spline in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, OFFSET, RefusedFramesError, recalibrated
from rsbench.capture.hypotheses import Known, scans_of
from rsbench.capture.model_choice import AUTO, ModelChoice, choose_model, spline_choice, spread_by_unknowns
from rsbench.capture.shutter_decision import LEAST_BACKWARDS, NoMotionError, reversed_scans, scans_by_laws
from rsbench.capture.trajectory_gyro import GyroFound
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_estimate import CERTAIN, Capture, conclude, examine
from rsbench.capture.two_frame_spline import dispersion_of_rows, log_odds_of_opposite, two_frame_spline
from rsbench.components.motion_models import load_kernel, make_motion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_capture import BACKWARDS, KnownCapture, models_asked
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import MotionEstimate, SolverEntry, SolverSpec
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver


def body_motion(estimate: MotionEstimate, spec: SolverSpec, rig: StereoRig) -> Motion | str:
    """The body's motion in metres that an estimate stands for, or the reason why it stands for none.

    A left camera's translation t becomes the body's: d = t - o + R o, with o the left camera's offset. The pose
    after one period is then exact. Between the rows a constant twist of the camera is one of the body too; a
    camera that moves linearly has a body that does so up to |w|^2 |o| / 8.

    Args:
        estimate: a solver's answer.
        spec: what that solver declares: the point whose translation d is, and the motion model.
        rig: where the left camera is.
    """
    if not estimate.success:
        return estimate.reason
    if not estimate.metric:
        whose = "the left camera's " if spec.reference_point == "left" else ""
        return f"the length of d is not known in metres, only {whose}direction of translation"
    d = estimate.d
    if spec.reference_point == "left":
        offset = rig.offset("left")
        d = d - offset + so3.exp(estimate.w) @ offset
    return make_motion(spec.motion_model, estimate.w, d, spec.motion_parameters)


SHAKES = (
    "cannot tell the readout ratio: the rig shakes as no motion model does, which two frames do not tell from a "
    "readout. Give readout_ratio in the rig's card, or four frames and more"
)
_BEYOND_DOUBT = 23.0
"""Logarithm of odds between splines: 7, as of a probability of 0.999, did tracks count 0.15 and not a half."""
_MOMENTS = 33
"""Of a frame period, at which poses are compared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMotion:
    """The motion of the rig's body, and the solver's answer that it comes from."""

    motion: Motion
    """Of the model that the solver assumes, or that the matches prefer to it; metres."""
    robust: RobustEstimate
    """As the solver gave it: about its own reference point."""
    solver: str
    """Name of the solver's entry."""
    reference_point: str
    """The point whose translation ``robust.estimate.d`` is."""
    calibration: tuple[float, ...] = NO_ERRORS
    """What was taken from the matches before, see ``calibration.TERMS``."""
    choice: ModelChoice | None = None
    """How the motion model was chosen; None when it is the solver's."""
    gyro: GyroFound | None = None
    """What was found of a gyroscope; None: there is none."""

    @property
    def unevenness(self) -> tuple[float, float]:
        """How far the body is off an even motion through its poses at 0 and 1: root mean square over them.

        Radians, and metres of the middle of the rig: none of a rig that coasts, much of one that shakes.
        """
        tau = np.linspace(0.0, 1.0, _MOMENTS)
        (R, t), w = self.motion.body_from_world(tau), self.motion.w
        places = -(np.swapaxes(R, 1, 2) @ t[..., None])[..., 0]
        turns = so3.log(R @ np.swapaxes(so3.exp(tau[:, None] * w), 1, 2))
        shifts = places - tau[:, None] * places[-1]
        turned, shifted = (float(np.sqrt(np.mean(np.sum(each**2, axis=1)))) for each in (turns, shifts))
        return turned, shifted

    @property
    def disparity_offset(self) -> float:
        """px that were taken from the disparities."""
        return self.calibration[OFFSET]


def find_motion(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    rng: np.random.Generator | None = None,
    compared: Capture | None = None,
    splines: bool = True,
) -> FoundMotion:
    """The body's motion by the solver of the options; ``rng`` draws RANSAC's samples, by default from the seed.

    With a motion model in the options the matches decide which is used, see ``under_model``. Another package's
    solver answers from a process of its own, within the time limit of its card.

    Raises:
        RsbenchError: the solver cannot take the motion model of the options.
        NoMotionError: the solver found none, failed, or found only the direction of the translation.
    """
    entry, choice, given = options.solver, None, Matched(matches, rig, shutter)
    rng, requested = np.random.default_rng(options.seed) if rng is None else rng, options.motion_model

    def solve(entry: SolverEntry) -> RobustEstimate:
        return _solved(entry, *given, options, rng)

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
    """Matches of two times, and the cameras that took them."""

    matches: Correspondences
    rig: StereoRig
    shutter: RollingShutter


class UnderModel(NamedTuple):
    """The answer of a solver under the motion model that matches prefer, or that is requested."""

    robust: RobustEstimate
    entry: SolverEntry
    choice: ModelChoice | None
    """None where nothing could be concluded: it is the solver's own model."""
    motion: Motion | str
    """Of the body, metres; or why there is none."""


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
    """The answer of a solver under a motion model: that of ``chosen_model``, or of an estimate of more than it.

    Args:
        requested: ``auto`` or a name; with ``auto`` a spline may be used, if ``splines`` may be.
        entry: of a solver that ``takes_models``.
        solve: gives the answer of a solver.
        compared: the models on these matches, where more than the motion was estimated; else they are compared.
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
        found = scaled(found, dispersion_of_rows(*given, motion))
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
    """An answer of a solver that ``takes_models``, or in its place a spline, where the matches ask for it."""
    found = two_frame_spline(matches, rig, shutter, law, seed)
    if found is None or found.probability < CERTAIN:
        return scaled(robust, dispersion_of_rows(matches, rig, shutter, law)), choice, law
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
    """With what unknowns add to the covariance."""
    known = robust.estimate.covariance
    return (
        robust if known is None else replace(robust, estimate=replace(robust.estimate, covariance=known + spread))
    )


def scaled(robust: RobustEstimate, factor: float) -> RobustEstimate:
    """With a covariance of so many times the variance."""
    known = robust.estimate.covariance
    return robust if known is None else widened(robust, (factor - 1.0) * known)


def _solved(
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
    """The motion model that matches prefer, of a shutter that is known; None where nothing can be concluded.

    Args:
        requested: ``auto`` or a name.
        start: a motion near theirs, of any model.
    """
    known = Known().with_shutter(shutter)
    capture = conclude([examine(matches, rig, known, robust, seed, start)])
    if requested not in (AUTO, *capture.peaks):  # one that the matches exclude, or another package's
        alone = conclude([examine(matches, rig, replace(known, models=(requested,)), robust, seed, start)])
        models, peaks = {**capture.models, requested: 0.0}, {**capture.peaks, **alone.peaks}
        capture = replace(capture, models=models, peaks=peaks)
    return choose_model(capture, requested)


def takes_models(entry: SolverEntry) -> bool:
    """Whether a solver can assume any motion model."""
    solver = entry.solver
    return isinstance(solver, RefinedSolver) and solver.shutter == "rolling" and not solver.one_camera


def check_model(requested: str, entry: SolverEntry) -> None:
    """Raises RsbenchError when there is no such model to ask for, or the solver cannot take another one."""
    if requested != AUTO:
        load_kernel(requested)
    if not takes_models(entry):
        spec = entry.solver.spec
        known_to = f"solver {entry.name!r} knows only {spec.motion_model} motion and a {spec.shutter} shutter"
        known_to += "" if spec.metric else ", without a length"
        raise RsbenchError(f"--motion-model {requested}: {known_to}; take rs-stereo-refined")


def model_to_use(requested: str | None, entry: SolverEntry) -> str | None:
    """The one that is requested; else ``auto`` where the solver takes it. RsbenchError as of ``check_model``."""
    if requested is None:
        return AUTO if takes_models(entry) else None
    check_model(requested, entry)
    return requested


def entry_of(entry: SolverEntry, choice: ModelChoice) -> SolverEntry:
    """A refined solver with another motion model."""
    solver = entry.solver
    assert isinstance(solver, RefinedSolver)
    if choice.used == solver.motion_model and not choice.parameters:
        return entry
    return replace(
        entry, component=replace(solver, motion_model=choice.used, motion_parameters=dict(choice.parameters))
    )


def motion_of(estimate: MotionEstimate, entry: SolverEntry, rig: StereoRig) -> Motion:
    """The body's motion, metres, that a solver's answer means, in the model that the solver assumes.

    Raises:
        NoMotionError: the answer is a failure, or has no length.
    """
    motion = body_motion(estimate, entry.solver.spec, rig)
    if isinstance(motion, Motion):
        return motion
    if not estimate.success:
        raise NoMotionError(f"solver {entry.name!r} found no motion: {motion}")
    if entry.solver.spec.metric:
        raise NoMotionError(f"solver {entry.name!r}: {motion}: more matches must be seen by both cameras")
    raise NoMotionError(f"solver {entry.name!r}: {motion}; a correction needs metres, as rs-stereo-refined finds")


def solve_frames(
    matches: Correspondences, known: KnownCapture, options: CorrectionOptions, *, in_order: bool = False
) -> FoundMotion:
    """The motion between two times whose capture is known.

    Args:
        matches, known: as ``know_four`` and ``know_matches`` return them.
        in_order: whether the frames are known to be in the order of time, and the shutter not from them alone.

    Raises:
        RefusedFramesError: time runs backwards in the frames.
        NoMotionError: no motion explains the matches.
    """
    rig, shutter, errors = known.rig, known.shutter, known.calibration
    at_rest = recalibrated(matches, rig, errors)
    found = find_motion(at_rest, rig, shutter, options, compared=known.models)
    if known.capture is None and not in_order and _runs_backwards(at_rest, rig, found, shutter, options):
        raise RefusedFramesError(BACKWARDS)
    if known.capture is not None and not in_order and isinstance(found.motion, ContinuousMotion):
        raise NoMotionError(SHAKES)
    return replace(found, calibration=errors)


def _runs_backwards(
    matches: Correspondences,
    rig: StereoRig,
    found: FoundMotion,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> bool:
    """Whether time runs backwards in the frames: their lines then seem to be read from the opposite side.

    The laws must find the opposite scan beyond doubt, and near the given ratio: where no law fits they find any
    ratio. For a shaken rig splines under both scans decide, unless the laws find the given shutter.
    """
    if shutter.readout_ratio < LEAST_BACKWARDS or not shutter.plain:
        return False
    shakes, opposite = isinstance(found.motion, ContinuousMotion), reversed_scans(scans_of(shutter))
    if shakes:
        other = replace(shutter, scan=opposite.left, right_scan=opposite.right)  # pyrefly: ignore
        if log_odds_of_opposite(matches, rig, shutter, other, found.motion, options.seed) <= _BEYOND_DOUBT:
            return False
    models, start = models_asked(options.motion_model), None if shakes else found.motion
    scans = scans_by_laws(matches, rig, shutter, models, options.robust, options.seed, start)
    return scans != scans_of(shutter) if shakes else scans == opposite
