"""Motion from matches with outliers: any solver inside one and the same robust loop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from rsbench.core.correspondences import BoolArray, Correspondences, without_lens
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.track_building import join_stereo
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver
from rsbench.solvers.engine.ransac import RansacOptions, msac_score, ransac
from rsbench.solvers.engine.robust_problem import MatchCount, RobustProblem

_SECOND_TRY = 3.0
"""Factor on the threshold when nothing was found."""
_ADAPTATIONS = 2
_WORSE = 1.5
"""Factor on the cost, at the adapted threshold, of what the search found (at least one datum's) beyond which the
end is no improvement. On rendered frames closer inliers cost up to 1.3 times as much, and err less; refits of
solvers that noise upsets cost 1.7 times as much and more."""


@dataclass(frozen=True, kw_only=True)
class RobustOptions:
    """The robust loop, equal for every solver."""

    threshold_px: float = 1.25
    """Largest Sampson error of an inlier: 2.5 standard deviations of a match's noise of 0.5 px."""
    adapt_threshold: bool = True
    """Whether the threshold then follows the noise that the inliers show, between a fifth and four times it."""
    confidence: float = 0.999
    """Probability with which RANSAC shall have seen a sample without outliers, 0 to 1."""
    min_iterations: int = 10
    """Samples that RANSAC draws, at least."""
    max_iterations: int = 1000
    """Samples that RANSAC draws, at most."""
    lo_steps: int = 3
    """Refinements of each new best model, at thresholds that shrink from twice the threshold to it."""
    final_steps: int = 3
    """Refinements at the end, until the inliers stay the same."""

    def ransac(self) -> RansacOptions:
        """As the loop wants it; checks the values."""
        return RansacOptions(
            threshold=self.threshold_px,
            confidence=self.confidence,
            min_iterations=self.min_iterations,
            max_iterations=self.max_iterations,
            lo_steps=self.lo_steps,
            final_steps=self.final_steps,
        )

    def __post_init__(self) -> None:
        self.ransac()


@dataclass(frozen=True, kw_only=True, eq=False)
class RobustEstimate:
    """A motion, and the matches that it explains."""

    estimate: MotionEstimate
    inliers: dict[MatchSet, BoolArray] = field(default_factory=dict)
    """Masks over ``left``, ``right`` and ``tracks``; all False after a failure. Sets may repeat the same points:
    their sum counts those twice, ``counts`` does not."""
    counts: dict[MatchSet, MatchCount] = field(default_factory=dict)
    """Of the matches that the solver works on, each once: ``tracks``, and under ``left`` and ``right`` the pairs
    that no track repeats. For a solver of pairs a track is a left and a right pair, which count there."""
    iterations: int
    seconds: float
    threshold_px: float
    """The threshold that the inliers have passed."""
    reference_point: Literal["body", "left"] = "body"
    """The point of the rig whose translation the estimate gives: that of its solver's spec."""
    motion_model: str = ""
    """The one that was chosen; empty: the one that the solver assumes."""

    @property
    def inlier_count(self) -> int:
        """Matches that the motion explains, each counted once; at most ``match_count``."""
        return sum(count.inliers for count in self.counts.values())

    @property
    def match_count(self) -> int:
        """Matches that the solver had to work on, each counted once."""
        return sum(count.matches for count in self.counts.values())


def estimate_motion(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    solver: Solver,
    options: RobustOptions,
    rng: np.random.Generator,
    loop: Literal["ransac", "own"] = "ransac",
) -> RobustEstimate:
    """Robust motion from matches with outliers.

    A rolling-shutter solver's inliers have a small exact rolling-shutter Sampson error, a global-shutter one's a
    small ordinary one (of the camera that it describes). A track's error counts all it says about the motion,
    scaled so that one threshold rejects as many good tracks as good pairs. Too few matches or no consensus is a
    failed estimate with the reason.

    A global-shutter solver is given the matches as cameras without a lens would have them. One that does not take
    such cameras is a failure with the reason.

    Left-right matches count as parts of tracks; where no tracks are given, those are joined (``join_stereo``).

    Args:
        loop: ``own`` (``robust`` in a solver's card): the solver throws outliers out by itself. It is given all
            matches once; its inliers are those that its motion explains.
    """
    given, note = correspondences, ""
    if len(given.tracks) == 0 and len(given.stereo_0) + len(given.stereo_1) > 0:
        joined = join_stereo(given)
        given, note = joined.correspondences, joined.note
    run = _own if loop == "own" else _search
    start = time.perf_counter()
    try:
        ideal = without_lens(given, rig.camera)
        refusal = solver.spec.refusal(rig, shutter)
    except ValueError as error:
        return _refused(correspondences, str(error), solver, options)
    if refusal:
        return _refused(correspondences, refusal, solver, options)
    if solver.spec.shutter == "global":
        given, rig, shutter = ideal, rig.ideal, shutter if shutter.plain else shutter.at_once()
    found = run(given, rig, shutter, solver, options, rng)
    seconds = time.perf_counter() - start
    problem, estimate = found.problem, found.estimate
    if note:
        estimate = replace(estimate, reason="; ".join(filter(None, [estimate.reason, note])))
    masks = problem.masks(found.inliers)
    return RobustEstimate(
        estimate=estimate,
        inliers={**masks, "tracks": masks["tracks"][: len(correspondences.tracks)]},
        counts=problem.counts(found.inliers),
        iterations=found.iterations,
        seconds=seconds,
        threshold_px=found.threshold_px,
        reference_point=solver.spec.reference_point,
    )


def _refused(
    correspondences: Correspondences, reason: str, solver: Solver, options: RobustOptions
) -> RobustEstimate:
    """The failure of a solver that is not asked."""
    names: tuple[MatchSet, ...] = ("left", "right", "tracks")
    return RobustEstimate(
        estimate=MotionEstimate.failed(reason),
        inliers={name: np.zeros(len(getattr(correspondences, name)), dtype=np.bool_) for name in names},
        iterations=0,
        seconds=0.0,
        threshold_px=options.threshold_px,
        reference_point=solver.spec.reference_point,
    )


class _Found(NamedTuple):
    """A motion of a problem, and which of its data it explains."""

    problem: RobustProblem
    estimate: MotionEstimate
    inliers: BoolArray
    threshold_px: float
    iterations: int


def _search(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    solver: Solver,
    options: RobustOptions,
    rng: np.random.Generator,
) -> _Found:
    """By RANSAC around the solver."""
    failed, iterations = None, 0
    for problem, threshold in _attempts(correspondences, rig, shutter, solver, options):
        report = ransac(problem, replace(options, threshold_px=threshold).ransac(), rng)
        iterations += report.iterations
        if report.model is not None:
            return _Found(
                problem, *_conclude(problem, report.model, report.inliers, threshold, options), iterations
            )
        reason = problem.failure(report.reason)
        failed = _Found(problem, MotionEstimate.failed(reason), report.inliers, threshold, iterations)
    assert failed is not None, "one attempt is always made"
    return failed


def _own(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    solver: Solver,
    options: RobustOptions,
    rng: np.random.Generator,
) -> _Found:
    """By the solver alone."""
    problem, threshold = RobustProblem(correspondences, rig, shutter, solver), options.threshold_px
    estimate = problem.on_all()
    if not estimate.success:
        return _Found(problem, estimate, np.zeros(sum(problem.num_data), dtype=np.bool_), threshold, 0)
    if options.adapt_threshold:
        threshold = _adapted(problem, estimate, threshold, options)
    return _Found(problem, estimate, np.abs(problem.residuals(estimate)) <= threshold, threshold, 0)


def _attempts(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    solver: Solver,
    options: RobustOptions,
) -> Iterator[tuple[RobustProblem, float]]:
    """Problems and thresholds to try until one gives a motion."""
    problem = RobustProblem(correspondences, rig, shutter, solver)
    yield problem, options.threshold_px
    if problem.linked and len(problem.packed.pairs) > len(problem.packed.tracks):
        # Left-right matches that are mostly wrong: those over time may still be right.
        yield RobustProblem(correspondences, rig, shutter, solver, linked=False), options.threshold_px
    if options.adapt_threshold and not problem.shortage:
        # Noise far above the threshold scatters the inliers of any model.
        yield problem, _SECOND_TRY * options.threshold_px


def _conclude(
    problem: RobustProblem,
    model: MotionEstimate,
    inliers: BoolArray,
    threshold: float,
    options: RobustOptions,
) -> tuple[MotionEstimate, BoolArray, float]:
    """The solver on all matches near or on all inliers, those that this motion explains, and their threshold."""
    final = problem.weigh(model, threshold)
    if final is not None:
        if options.adapt_threshold:
            threshold = _adapted(problem, final, threshold, options)
        return final, np.abs(problem.residuals(final)) <= threshold, threshold
    found = model, inliers, threshold
    if options.adapt_threshold:
        for _ in range(_ADAPTATIONS):
            model = problem.refine(model, inliers) or model
            threshold = _adapted(problem, model, threshold, options)
            inliers = np.abs(problem.residuals(model)) <= threshold
    final = problem.conclude(model, inliers)
    knows_less = final.metric and not found[0].metric
    if not knows_less and _cost(problem, final, threshold) > _WORSE * max(
        _cost(problem, found[0], threshold), 1.0
    ):
        # A solver that more matches make worse: what the search found stands.
        return found
    return final, np.abs(problem.residuals(final)) <= threshold, threshold


def _cost(problem: RobustProblem, model: MotionEstimate, threshold: float) -> float:
    """What the search minimises, MSAC."""
    errors = np.abs(problem.residuals(model))
    return msac_score(np.where(np.isnan(errors), np.inf, errors), threshold)


def _adapted(problem: RobustProblem, model: MotionEstimate, threshold: float, options: RobustOptions) -> float:
    """The threshold that fits the noise of a model's inliers, between a fifth and four times the one asked for."""
    least, most = 0.2 * options.threshold_px, 4.0 * options.threshold_px
    return float(np.clip(problem.noise_threshold(model, threshold), least, most))
