"""Motion from matches with outliers: any solver inside one and the same robust loop."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi2

from rsbench.core.correspondences import Correspondences, track_pairs, unlinked_pairs
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.robust.ransac import BoolArray, IntArray, RansacOptions, ransac
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver
from rsbench.solvers.engine.packed import Packed, pack

_TRACK_FREEDOM = 5
_SIGMAS = 2.5
_SECOND_TRY = 3.0
"""Factor on the threshold when nothing was found."""
_ADAPTATIONS, _FIXED_POINT_STEPS = 2, 8


@dataclass(frozen=True, kw_only=True)
class RobustOptions:
    """The robust loop, equal for every solver."""

    threshold_px: float = 1.25
    """Largest Sampson error of an inlier: 2.5 standard deviations of a match's noise of 0.5 px."""
    adapt_threshold: bool = True
    """Whether the threshold then follows the noise that the inliers show, between a fifth and four times it."""
    confidence: float = 0.999
    min_iterations: int = 10
    max_iterations: int = 1000
    lo_steps: int = 3
    final_steps: int = 3

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


@dataclass(frozen=True, kw_only=True)
class MatchCount:
    """How many matches there were for the solver, and how many of them its motion explains."""

    inliers: int
    matches: int


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
) -> RobustEstimate:
    """Robust motion from matches with outliers.

    A rolling-shutter solver's inliers have a small exact rolling-shutter Sampson error, a global-shutter one's a
    small ordinary one (of the camera that it describes). A track's error counts all it says about the motion,
    scaled so that one threshold rejects as many good tracks as good pairs. Too few matches or no consensus is a
    failed estimate with the reason.
    """
    start = time.perf_counter()
    iterations = 0
    for problem, threshold in _attempts(correspondences, rig, shutter, solver, options):
        report = ransac(problem, replace(options, threshold_px=threshold).ransac(), rng)
        iterations += report.iterations
        if report.model is not None:
            estimate, inliers, threshold = _conclude(problem, report.model, report.inliers, threshold, options)
            break
        estimate, inliers = MotionEstimate.failed(report.reason), report.inliers
    return RobustEstimate(
        estimate=estimate,
        inliers=problem.masks(inliers),
        counts=problem.counts(inliers),
        iterations=iterations,
        seconds=time.perf_counter() - start,
        threshold_px=threshold,
    )


def _attempts(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    solver: Solver,
    options: RobustOptions,
) -> Iterator[tuple[_RobustProblem, float]]:
    """Problems and thresholds to try until one gives a motion."""
    problem = _RobustProblem(correspondences, rig, shutter, solver)
    yield problem, options.threshold_px
    if problem.linked and len(problem.packed.pairs) > len(problem.packed.tracks):
        # Left-right matches that are mostly wrong: those over time may still be right.
        yield _RobustProblem(correspondences, rig, shutter, solver, linked=False), options.threshold_px
    if options.adapt_threshold and problem.enough:
        # Noise far above the threshold scatters the inliers of any model.
        yield problem, _SECOND_TRY * options.threshold_px


def _conclude(
    problem: _RobustProblem,
    model: MotionEstimate,
    inliers: BoolArray,
    threshold: float,
    options: RobustOptions,
) -> tuple[MotionEstimate, BoolArray, float]:
    """The solver on all inliers, the matches that this motion explains, and the threshold for them."""
    if options.adapt_threshold:
        least, most = 0.2 * options.threshold_px, 4.0 * options.threshold_px
        for _ in range(_ADAPTATIONS):
            model = problem.refine(model, inliers) or model
            threshold = float(np.clip(problem.noise_threshold(model, threshold), least, most))
            inliers = np.abs(problem.residuals(model)) <= threshold
    final = problem.conclude(model, inliers)
    explained = np.abs(problem.residuals(final)) <= threshold
    if np.count_nonzero(explained) < 0.5 * np.count_nonzero(inliers):
        # A solver that more matches make worse: what the search found stands.
        return model, inliers, threshold
    return final, explained, threshold


class _RobustProblem:
    """Correspondences and a solver as the estimator of the robust loop.

    The data are the left pairs, the right pairs, and the tracks that the solver uses as such.
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
        pairs = Correspondences(left=correspondences.left, right=correspondences.right)
        sizes = solver.sample_sizes(correspondences if linked else pairs)
        self.linked = sizes.get("tracks", 0) > 0
        self.data = self._data()
        self.packed = self._packed()
        self._sizes = (sizes.get("left", 0), sizes.get("right", 0), sizes.get("tracks", 0))

    def _data(self) -> Correspondences:
        """Each measurement once: tracks as tracks or as pairs, and the pairs that no track repeats."""
        given, needs = self.given, self.solver.spec.needs
        pairs = {}
        for side in SIDES:
            own = getattr(given, side)[unlinked_pairs(given, side)]
            halves = track_pairs(given.tracks, side)
            pairs[side] = own if self.linked else np.concatenate([own, halves])
            if side not in needs:
                pairs[side] = pairs[side][:0]
        tracks = given.tracks if self.linked else given.tracks[:0]
        return Correspondences(left=pairs["left"], right=pairs["right"], tracks=tracks)

    def _packed(self) -> Packed:
        """The data under the shutter that the solver believes in, about the point whose motion it gives."""
        shutter = self.shutter
        if self.solver.spec.shutter == "global":
            shutter = RollingShutter(height=shutter.height, readout_ratio=0.0)
        packed = pack(self.data, self.rig, shutter, self.solver.spec.motion_model)
        if self.solver.spec.reference_point == "left":
            packed.pairs[:, 6] = 0.0
        return packed

    @property
    def num_data(self) -> tuple[int, ...]:
        return len(self.data.left), len(self.data.right), len(self.data.tracks)

    @property
    def sample_size(self) -> tuple[int, ...]:
        return self._sizes

    def generate(self, samples: IntArray) -> Iterable[list[MotionEstimate]]:
        return self.solver.propose_all([self._subset(sample) for sample in samples], self.rig, self.shutter)

    def residuals(self, model: MotionEstimate) -> FloatArray:
        theta = self.packed.theta(model.w, model.d)
        tracks = np.sqrt(self.packed.track_squares(theta)) * _track_scale()
        return np.concatenate([self.packed.pair_residuals(theta), tracks])

    @property
    def enough(self) -> bool:
        """Whether there is more than a minimal sample."""
        return all(count >= size for count, size in zip(self.num_data, self.sample_size, strict=True))

    def noise_threshold(self, model: MotionEstimate, threshold: float) -> float:
        """Threshold at 2.5 standard deviations of the noise that the residuals below it show.

        A fixed point of: noise from the residuals below the threshold (a truncated distribution), threshold from
        the noise. Outliers are spread too thinly to disturb it.
        """
        squares = self.residuals(model) ** 2
        moments = np.repeat([_moment(1), _moment(1), _moment(_TRACK_FREEDOM)], self.num_data)
        for _ in range(_FIXED_POINT_STEPS):
            below = squares <= threshold**2
            if not np.any(below):
                break
            threshold = _SIGMAS * float(np.sqrt(np.sum(squares[below]) / np.sum(moments[below])))
        return threshold

    def refine(self, model: MotionEstimate, inliers: BoolArray) -> MotionEstimate | None:
        subset = self._subset(np.flatnonzero(inliers))
        estimate = self.solver.improve(model, subset, self.rig, self.shutter, quick=True)
        return estimate if estimate.success else None

    def conclude(self, model: MotionEstimate, inliers: BoolArray) -> MotionEstimate:
        """The solver on all inliers; the model itself when the solver fails there."""
        subset = self._subset(np.flatnonzero(inliers))
        estimate = self.solver.improve(model, subset, self.rig, self.shutter)
        return estimate if estimate.success else model

    def _subset(self, indices: IntArray) -> Correspondences:
        left, right, _ = self.num_data
        return Correspondences(
            left=self.data.left[indices[indices < left]],
            right=self.data.right[indices[(indices >= left) & (indices < left + right)] - left],
            tracks=self.data.tracks[indices[indices >= left + right] - left - right],
        )

    def counts(self, inliers: BoolArray) -> dict[MatchSet, MatchCount]:
        """Inliers and matches of each group of data."""
        names: tuple[MatchSet, ...] = ("left", "right", "tracks")
        parts = np.split(inliers, np.cumsum(self.num_data)[:-1])
        return {
            name: MatchCount(inliers=int(np.count_nonzero(part)), matches=len(part))
            for name, part in zip(names, parts, strict=True)
        }

    def masks(self, inliers: BoolArray) -> dict[MatchSet, BoolArray]:
        """Inliers over the sets as they were given."""
        split = np.split(inliers, np.cumsum(self.num_data)[:-1])
        data = {"left": self.data.left, "right": self.data.right}
        good: dict[str, set[bytes]] = {}
        for side, mask in zip(SIDES, split, strict=False):
            halves = track_pairs(self.data.tracks, side)[split[2]]
            good[side] = _keys(data[side][mask]) | _keys(halves)
        out: dict[MatchSet, BoolArray] = {side: _found(getattr(self.given, side), good[side]) for side in SIDES}
        out["tracks"] = split[2]
        if not self.linked:
            sides = [side for side in SIDES if side in self.solver.spec.needs]
            halves_good = [_found(track_pairs(self.given.tracks, side), good[side]) for side in sides]
            out["tracks"] = (
                np.all(halves_good, axis=0) if sides else np.zeros(len(self.given.tracks), dtype=np.bool_)
            )
        return out


def _keys(rows: FloatArray) -> set[bytes]:
    return {row.tobytes() for row in np.ascontiguousarray(rows)}


def _found(rows: FloatArray, keys: set[bytes]) -> BoolArray:
    return np.array([row.tobytes() in keys for row in np.ascontiguousarray(rows)], dtype=np.bool_)


@functools.cache
def _quantile(freedom: int) -> float:
    """Of chi-squared, with the probability that a normal variable lies within 2.5 standard deviations."""
    return float(chi2.ppf(chi2.cdf(_SIGMAS**2, 1), freedom))


@functools.cache
def _track_scale() -> float:
    """Factor that gives the root of a track's squared error the quantile of a pair's error at 2.5 sigma."""
    return _SIGMAS / float(np.sqrt(_quantile(_TRACK_FREEDOM)))


@functools.cache
def _moment(freedom: int) -> float:
    """Mean square of a scaled residual below its threshold, at a noise of 1 px."""
    quantile = _quantile(freedom)
    truncated = freedom * chi2.cdf(quantile, freedom + 2) / chi2.cdf(quantile, freedom)
    return float(truncated) * _SIGMAS**2 / quantile
