"""Robust motion estimation from matches with outliers, with the same loop for all solvers."""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from typing import Literal, NamedTuple

import numpy as np
import scipy

from rsbench.components.motion_models import load_kernel
from rsbench.core.correspondences import (
    BoolArray,
    Correspondences,
    join_stereo,
    repeated,
    track_pairs,
    unlinked_pairs,
    without_lens,
)
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import SENSORS, MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.packed import TRACK_FREEDOM, Packed, pack, pack_pairs
from rsbench.solvers.engine.ransac import IntArray, RansacOptions, SearchOptions, msac_score, ransac

SIGMAS = 2.5
"""Error of a match, in standard deviations of the noise, above which it is an outlier."""
_NEAR = 8.0
"""Largest error, in thresholds, of matches that are given to a solver that weights them itself."""
_FIXED_POINT_STEPS = 8
_GROUPS: tuple[MatchSet, ...] = ("left", "right", "tracks")


@dataclass(frozen=True, kw_only=True)
class MatchCount:
    """Number of matches that the solver used, and number of inliers among them."""

    inliers: int
    matches: int


class RobustProblem:
    """Motion estimation as a RANSAC problem; data are left pairs, right pairs, and tracks if the solver uses them.

    Each measurement occurs once. For a solver that needs left-right matches, a track is a match over time with a
    left-right match at both ends; these are sampled together.
    """

    def __init__(
        self,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        solver: Solver,
        linked: bool = True,
    ) -> None:
        self.given, self.rig, self.shutter, self.solver = correspondences, rig, shutter, solver
        self.spec = solver.spec
        self._stereo = "stereo" in self.spec.needs
        self.reasons: Counter[str] = Counter()
        """Number of samples on which the solver failed, by reason."""
        self.sample_size, self.linked = self._plan(linked)
        self._affine = "affine" in self.spec.needs
        self._unlinked = {side: unlinked_pairs(correspondences, side) for side in SIDES}
        if self._affine:  # tracks have no affine frames: such a solver gets only the left matches
            self._unlinked["left"] = np.full(len(correspondences.left), len(correspondences.affine) > 0)
        self.data = self._data()
        self.packed = self._packed()

    def _plan(self, linked: bool) -> tuple[tuple[int, int, int], bool]:
        """Return the number of data of each group in a sample, and whether tracks are used as tracks."""
        given = self.given
        if not self._stereo:
            pairs = Correspondences(left=given.left, right=given.right)
            sizes = self.solver.sample_sizes(given if linked else pairs)
            left, right, tracks = (sizes.get(name, 0) for name in _GROUPS)
            return (left, right, tracks), tracks > 0
        sizes = self.solver.sample_sizes(self._handed(given.left, given.right, given.tracks))
        left, right, tracks = (sizes.get(name, 0) for name in _GROUPS)
        least = max(sizes.get("stereo", 0), tracks)
        if len(given.tracks) >= max(least, left, right):
            return (0, 0, max(least, left, right)), True
        return (max(left - least, 0), max(right - least, 0), least), True

    def _data(self) -> Correspondences:
        """Return each measurement once: tracks (or the pairs in them), and pairs that are not part of a track."""
        given = self.given
        pairs = {}
        for side in SIDES:
            own = getattr(given, side)[self._unlinked[side]]
            halves = track_pairs(given.tracks, side)[: 0 if self.linked or self._affine else None]
            pairs[side] = np.concatenate([own, halves])
            if side not in self.spec.needs:
                pairs[side] = pairs[side][:0]
        tracks = given.tracks if self.linked else given.tracks[:0]
        affine = given.affine[: None if self._affine else 0]
        return Correspondences(**pairs, tracks=tracks, affine=affine)

    def _packed(self) -> Packed:
        """Pack the data with the shutter and the reference point that the solver assumes."""
        data, rig, shutter = self.data, self.rig, self.shutter
        model, own = self.spec.motion_model, self.spec.motion_parameters
        if self.spec.shutter == "global":
            shutter = shutter.at_once()
        if self.spec.reference_point == "body":
            return pack(data, rig, shutter, model, motion_parameters=own)
        # Errors of tracks need the motion of the body. The left camera's motion is scored on its own pairs only.
        rig = rig.about("left")
        alone = Correspondences(left=data.left, right=data.right)
        packed = pack(alone, rig, shutter, model, motion_parameters=own)
        halves = pack_pairs(track_pairs(data.tracks, "left"), "left", rig, shutter)
        return replace(packed, pairs=np.concatenate([packed.pairs, halves]))

    @property
    def num_data(self) -> tuple[int, ...]:
        return len(self.data.left), len(self.data.right), len(self.data.tracks)

    def generate(self, samples: IntArray) -> Iterator[list[MotionEstimate]]:
        subsets = [self._subset(sample) for sample in samples]
        for models in self.solver.propose_all(subsets, self.rig, self.shutter):
            found = [model for model in models if model.success]
            if not found:
                self.reasons.update({model.reason for model in models})
            yield found

    def residuals(self, model: MotionEstimate) -> FloatArray:
        packed = self.packed
        if model.motion_parameters:
            own = {**self.spec.motion_parameters, **model.motion_parameters}
            packed = replace(packed, kernel=load_kernel(self.spec.motion_model, own))
        theta = packed.theta(model.w, model.d)
        squares = packed.track_squares(theta)
        squares = np.where(squares >= 0.0, squares, np.inf)  # overflow for a point next to the plane z = 0
        return np.concatenate([packed.pair_residuals(theta), np.sqrt(squares) * _track_scale()])

    @property
    def shortage(self) -> str:
        """Message about the matches missing for a minimal sample; empty if there are enough."""
        names = dict(zip(_GROUPS, ("left matches", "right matches", "tracks"), strict=True))
        if self._affine:
            names["left"] = "left matches with affine frames"
        if self._stereo:
            names["tracks"] = "matches over time with left-right matches at both ends"
        groups = zip(_GROUPS, self.num_data, self.sample_size, strict=True)
        short = [
            f"too few {names[name]}: {count}, a sample needs {size}"
            for name, count, size in groups
            if count < size
        ]
        return "; ".join(short)

    def failure(self, reason: str) -> str:
        """Return the reason of a failure, with the most frequent failure of the solver on samples."""
        most_often = "".join(f"; most frequent failure: {text}" for text, _ in self.reasons.most_common(1))
        return f"{self.shortage or reason}{most_often}"

    def noise_threshold(self, model: MotionEstimate, threshold: float) -> float:
        """Return the threshold that is 2.5 standard deviations of the noise, estimated from residuals below it.

        Fixed-point iteration alternates between the noise, from the residuals below the threshold (a truncated
        distribution), and the threshold, from the noise. Outliers are too sparse to affect it.
        """
        squares = self.residuals(model) ** 2
        tracks = len(self.packed.tracks)
        moments = np.repeat([_moment(1), _moment(TRACK_FREEDOM)], [len(squares) - tracks, tracks])
        for _ in range(_FIXED_POINT_STEPS):
            below = squares <= threshold**2
            if not np.any(below):
                break
            threshold = SIGMAS * float(np.sqrt(np.sum(squares[below]) / np.sum(moments[below])))
        return threshold

    def refine(self, model: MotionEstimate, inliers: BoolArray) -> MotionEstimate | None:
        subset = self._subset(np.flatnonzero(inliers))
        estimate = self.solver.improve(model, subset, self.rig, self.shutter, quick=True)
        return estimate if estimate.success else None

    def weigh(self, model: MotionEstimate, threshold: float) -> MotionEstimate | None:
        """Return the motion from all matches near a model if the solver weights matches itself, else None."""
        near = np.flatnonzero(np.abs(self.residuals(model)) <= _NEAR * threshold)
        found = self.solver.weigh(model, self._subset(near), self.rig, self.shutter, threshold / SIGMAS)
        return found if found is not None and found.success else None

    def conclude(self, model: MotionEstimate, inliers: BoolArray) -> MotionEstimate:
        """Run the solver on all inliers; return the given model if the solver fails."""
        subset = self._subset(np.flatnonzero(inliers))
        estimate = self.solver.improve(model, subset, self.rig, self.shutter)
        return estimate if estimate.success else model

    def on_all(self) -> MotionEstimate:
        """Run the solver on all matches."""
        data = self.data
        everything = self._handed(data.left, data.right, data.tracks) if self._stereo else self.given
        return self.solver.estimate(everything, self.rig, self.shutter)

    def _subset(self, indices: IntArray) -> Correspondences:
        left, right, _ = self.num_data
        first = indices[indices < left]
        return self._handed(
            self.data.left[first],
            self.data.right[indices[(indices >= left) & (indices < left + right)] - left],
            self.data.tracks[indices[indices >= left + right] - left - right],
            self.data.affine[first] if self._affine else None,
        )

    def _handed(
        self, left: FloatArray, right: FloatArray, tracks: FloatArray, affine: FloatArray | None = None
    ) -> Correspondences:
        """Return matches in the form that the solver needs.

        If it needs left-right matches, tracks are split into left-right matches and matches over time.
        """
        if not self._stereo:
            frames = {} if affine is None else {"affine": affine}
            return Correspondences(left=left, right=right, tracks=tracks, **frames, **self._sensed)
        needs, halves = self.spec.needs, {side: track_pairs(tracks, side) for side in SIDES}
        return Correspondences(
            left=np.concatenate([halves["left"], left]) if "left" in needs else left,
            right=np.concatenate([halves["right"], right]) if "right" in needs else right,
            stereo_0=tracks[:, :4],
            stereo_1=tracks[:, 4:],
            tracks=tracks if "tracks" in needs else tracks[:0],
            **self._sensed,
        )

    @property
    def _sensed(self) -> dict[str, FloatArray]:
        """All samples of other sensors."""
        return {name: getattr(self.given, name) for name in SENSORS}

    def counts(self, inliers: BoolArray) -> dict[MatchSet, MatchCount]:
        """Return the number of inliers and matches in each group of data."""
        parts = np.split(inliers, np.cumsum(self.num_data)[:-1])
        return {
            name: MatchCount(inliers=int(np.count_nonzero(part)), matches=len(part))
            for name, part in zip(_GROUPS, parts, strict=True)
        }

    def masks(self, inliers: BoolArray) -> dict[MatchSet, BoolArray]:
        """Return inlier masks over the given sets; a match in a track is an inlier if the track is."""
        *pairs, tracks = np.split(inliers, np.cumsum(self.num_data)[:-1])
        out: dict[MatchSet, BoolArray] = {}
        as_pairs = np.ones(len(self.given.tracks), dtype=np.bool_)
        for side, mask in zip(SIDES, pairs, strict=True):
            own = self._unlinked[side]
            out[side] = np.zeros(len(own), dtype=np.bool_)
            halves = tracks
            if side in self.spec.needs:
                out[side][own] = mask[: np.count_nonzero(own)]
                halves = tracks if self.linked else mask[np.count_nonzero(own) :]
                if self._affine:
                    halves = np.zeros(len(self.given.tracks), dtype=np.bool_)
                as_pairs &= self.linked | halves
            elif not self.linked:
                continue
            good = track_pairs(self.given.tracks[halves], side)
            out[side][~own] = repeated(getattr(self.given, side)[~own], good)
        out["tracks"] = tracks if self.linked else as_pairs & bool(self.spec.needs & set(SIDES))
        return out


@functools.cache
def quantile(freedom: int) -> float:
    """Return the chi-squared quantile at the probability that a normal variable is within 2.5 sigma."""
    return float(2.0 * scipy.special.gammaincinv(0.5 * freedom, float(scipy.special.chdtr(1, SIGMAS**2))))


@functools.cache
def _track_scale() -> float:
    """Return the factor on the root of a track's squared error that makes one threshold fit tracks and pairs.

    After scaling, the same proportion of tracks and of pairs lies within 2.5 sigma.
    """
    return SIGMAS / float(np.sqrt(quantile(TRACK_FREEDOM)))


@functools.cache
def truncated(freedom: int) -> float:
    """Return the mean of a chi-squared variable truncated at ``quantile``."""
    chdtr = scipy.special.chdtr
    return float(freedom * chdtr(freedom + 2, quantile(freedom)) / chdtr(freedom, quantile(freedom)))


def _moment(freedom: int) -> float:
    """Return the mean square of a scaled residual below its threshold, for a noise of 1 px."""
    return truncated(freedom) * SIGMAS**2 / quantile(freedom)


SECOND_TRY = 3.0
"""Factor on the threshold in a second attempt after a search without result."""
_ADAPTATIONS = 2
_WORSE = 1.5
"""Largest ratio of the MSAC cost of the refined motion to that of the search's result (at least 1), both at the
adapted threshold; above it, the search's result is kept. On rendered frames, more accurate motions cost up to 1.3
times as much; refits of solvers that are sensitive to noise cost 1.7 times as much and more."""


@dataclass(frozen=True, kw_only=True)
class RobustOptions(SearchOptions):
    """Options of the robust loop, which are the same for every solver."""

    threshold_px: float = 1.25
    """Largest Sampson error of an inlier: 2.5 standard deviations of a match's noise of 0.5 px."""
    adapt_threshold: bool = True
    """Whether the threshold is then adapted to the inliers' noise, to between 0.2 and 4 times ``threshold_px``."""

    def ransac(self) -> RansacOptions:
        """Return the options of the search, which checks their values."""
        same = {each.name: getattr(self, each.name) for each in fields(SearchOptions)}
        return RansacOptions(threshold=self.threshold_px, **same)

    def __post_init__(self) -> None:
        self.ransac()


@dataclass(frozen=True, kw_only=True, eq=False)
class RobustEstimate:
    """A motion and its inliers."""

    estimate: MotionEstimate
    inliers: dict[MatchSet, BoolArray] = field(default_factory=dict)
    """Masks over ``left``, ``right`` and ``tracks``; all False after a failure. A point that is in several sets
    counts in each of these masks, but only once in ``counts``."""
    counts: dict[MatchSet, MatchCount] = field(default_factory=dict)
    """Counts of the matches that the solver uses, each counted once: ``tracks``, and under ``left`` and ``right``
    the pairs that are not part of a track. For a solver that uses only pairs, a track counts as a left and a right
    pair."""
    iterations: int
    seconds: float
    threshold_px: float
    """Threshold below which matches are inliers."""
    reference_point: Literal["body", "left"] = "body"
    """The point of the rig whose translation is estimated, from the solver's spec."""
    motion_model: str = ""
    """The selected motion model; empty for the one that the solver assumes."""

    @property
    def inlier_count(self) -> int:
        """Number of inliers, each counted once; at most ``match_count``."""
        return sum(count.inliers for count in self.counts.values())

    @property
    def match_count(self) -> int:
        """Number of matches that the solver used, each counted once."""
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
    """Estimate the motion robustly from matches with outliers.

    Inliers are matches with a small Sampson error: the exact rolling-shutter error for a rolling-shutter solver,
    the ordinary one for a global-shutter solver (both for the camera or body whose motion it estimates). A track's
    error uses all four of its pixels and is scaled so that one threshold rejects the same proportion of true
    tracks and true pairs. If there are too few matches, no consensus, or cameras that the solver does not support,
    the estimate is a failed one with the reason.

    A global-shutter solver is given the matches as an ideal rig would see them, unless it supports any rig.

    Left-right matches are used as parts of tracks; if no tracks are given, left-right matches and matches over
    time are joined to tracks (``join_stereo``).

    Args:
        loop: ``ransac``, or ``own`` for a solver that rejects outliers itself (``robust`` in its card). It is then
            called once with all matches; the inliers are those of its motion.
    """
    given, note = correspondences, ""
    if len(given.tracks) == 0 and len(given.stereo_0) + len(given.stereo_1) > 0:
        joined = join_stereo(given)
        given, note = joined.correspondences, joined.note
    start = time.perf_counter()
    try:
        given, rig, shutter = inputs_of(solver.spec, given, rig, shutter)
    except ValueError as error:
        return _refused(correspondences, str(error), solver, options)
    task = _Task(given, rig, shutter, solver, options)
    found = task.by_solver() if loop == "own" else task.by_ransac(rng)
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


def inputs_of(
    spec: SolverSpec, matches: Correspondences, rig: StereoRig, shutter: RollingShutter
) -> tuple[Correspondences, StereoRig, RollingShutter]:
    """Return the matches and cameras that a solver is given, see ``SolverSpec.cameras``.

    Raises:
        ValueError: it does not support the cameras, or a match lies at a pixel for which the lens has no ray.
    """
    ideal = without_lens(matches, rig)
    if refusal := spec.refusal(rig, shutter):
        raise ValueError(refusal)
    if spec.shutter != "global":
        return matches, rig, shutter
    if spec.cameras == "rig" and not rig.aligned:
        return matches, rig, shutter.at_once()
    return ideal, rig.ideal, shutter if shutter.plain else shutter.at_once()


def _refused(
    correspondences: Correspondences, reason: str, solver: Solver, options: RobustOptions
) -> RobustEstimate:
    """Return a failed estimate for a solver that was not run."""
    return RobustEstimate(
        estimate=MotionEstimate.failed(reason),
        inliers={name: np.zeros(len(getattr(correspondences, name)), dtype=np.bool_) for name in _GROUPS},
        iterations=0,
        seconds=0.0,
        threshold_px=options.threshold_px,
        reference_point=solver.spec.reference_point,
    )


class _Found(NamedTuple):
    """A motion and its inliers among the data of a problem."""

    problem: RobustProblem
    estimate: MotionEstimate
    inliers: BoolArray
    threshold_px: float
    iterations: int


class _Task(NamedTuple):
    """Input of the robust loop: matches, cameras, solver and options."""

    matches: Correspondences
    rig: StereoRig
    shutter: RollingShutter
    solver: Solver
    options: RobustOptions

    def by_ransac(self, rng: np.random.Generator) -> _Found:
        """Estimate the motion by RANSAC with the solver."""
        failed, iterations, options = None, 0, self.options
        for problem, threshold in self._attempts():
            report = ransac(problem, replace(options, threshold_px=threshold).ransac(), rng)
            iterations += report.iterations
            if report.model is not None:
                concluded = _conclude(problem, report.model, report.inliers, threshold, options)
                return _Found(problem, *concluded, iterations)
            reason = problem.failure(report.reason)
            failed = _Found(problem, MotionEstimate.failed(reason), report.inliers, threshold, iterations)
        assert failed is not None, "one attempt is always made"
        return failed

    def by_solver(self) -> _Found:
        """Estimate the motion by the solver alone, which rejects outliers itself."""
        problem, threshold = RobustProblem(*self[:4]), self.options.threshold_px
        estimate = problem.on_all()
        if not estimate.success:
            return _Found(problem, estimate, np.zeros(sum(problem.num_data), dtype=np.bool_), threshold, 0)
        if self.options.adapt_threshold:
            threshold = _adapted(problem, estimate, threshold, self.options)
        return _Found(problem, estimate, np.abs(problem.residuals(estimate)) <= threshold, threshold, 0)

    def _attempts(self) -> Iterator[tuple[RobustProblem, float]]:
        """Yield problems and thresholds to try until one gives a motion."""
        problem, threshold = RobustProblem(*self[:4]), self.options.threshold_px
        yield problem, threshold
        if problem.linked and len(problem.packed.pairs) > len(problem.packed.tracks):
            # Even if most left-right matches are outliers, matches over time may be inliers.
            yield RobustProblem(*self[:4], linked=False), threshold
        if self.options.adapt_threshold and not problem.shortage:
            # If the noise is far above the threshold, even the right model has few inliers.
            yield problem, SECOND_TRY * threshold


def _conclude(
    problem: RobustProblem,
    model: MotionEstimate,
    inliers: BoolArray,
    threshold: float,
    options: RobustOptions,
) -> tuple[MotionEstimate, BoolArray, float]:
    """Return the final motion, from all matches near the model or from its inliers, with its inliers and
    threshold."""
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
        # If the solver fits worse with more matches, the result of the search is kept.
        return found
    return final, np.abs(problem.residuals(final)) <= threshold, threshold


def _cost(problem: RobustProblem, model: MotionEstimate, threshold: float) -> float:
    """Return the MSAC cost, which the search minimises."""
    errors = np.abs(problem.residuals(model))
    return msac_score(np.where(np.isnan(errors), np.inf, errors), threshold)


def _adapted(problem: RobustProblem, model: MotionEstimate, threshold: float, options: RobustOptions) -> float:
    """Adapt the threshold to the noise of a model's inliers, to between 0.2 and 4 times the requested one."""
    least, most = 0.2 * options.threshold_px, 4.0 * options.threshold_px
    return float(np.clip(problem.noise_threshold(model, threshold), least, most))
