"""Hypotheses compared on the matches of one window: the error that each leaves, and how sharply.

Where the comparison starts: a point that moves by v_y rows per frame period lies dt v_y rows apart in two cameras
that see it dt apart. So the row differences of left-right matches show, by least squares, how the times of the two
cameras differ (``find_lag``). With that removed, the matches are nearly those of cameras that read together, and a
robust search finds the motion (``find_start``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from rsbench.capture.hypotheses import (
    ACCELERATION,
    BEYOND_RATIO,
    CALIBRATION,
    DELAY,
    GLOBAL,
    LEAST_RATIO,
    LEAST_SCALE_PX,
    RATIO,
    CaptureCost,
    CaptureFit,
    Hypothesis,
    Known,
    Likelihood,
    Scans,
    TimedMatches,
    fit_capture,
    line_of,
)
from rsbench.core.correspondences import BoolArray, Correspondences, without_lens
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import each_term, heavy_tailed
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

COARSE: tuple[tuple[Scan, float], ...] = (
    ("top", 0.0),
    ("top", 0.5),
    ("bottom", 0.5),
    ("left", 0.5),
    ("right", 0.5),
)
"""Shutters of cameras that read together, under which a motion is looked for: between them points err little."""
_LAG_SAMPLES, _LAG_ROUNDS = 400, 6
_NOISE_PX, _TIME_SIGMA = 0.5, 0.5
"""Expected noise of a row difference, and expected size of a difference of times, frame periods."""
_LEAST_PX = 0.1
_LONGEST_LEAP = 0.75
"""Of the image's width or height, over a frame period: far from the reciprocal of the largest ratio, 1 / 1.2."""
_BEND, _FAR = 0.1, 40.0
"""Error of a lag, frame periods, and squared deviations beyond which scans disagree with it."""


class Lag(NamedTuple):
    """Time of the left camera less that of the right one at one place, frame periods."""

    line: FloatArray
    """(3,) constant, per image width, per image height."""
    H: FloatArray
    """(3, 3) how well the matches determine it: inverse covariance."""

    def at(self, pixels: FloatArray, rig: StereoRig) -> FloatArray:
        """(n,) at pixels (n, 2)."""
        return _columns(pixels, rig) @ self.line


def find_lag(tracks: FloatArray, rig: StereoRig) -> Lag:
    """From tracks (n, 8) with outliers; 0 where nothing moves across the rows."""
    prior = np.eye(3) / _TIME_SIGMA**2
    if len(tracks) < 3:
        return Lag(np.zeros(3), prior)
    moved = 0.5 * (tracks[:, 5] - tracks[:, 1] + tracks[:, 7] - tracks[:, 3])
    A = np.concatenate([moved[:, None] * _columns(tracks[:, k : k + 2], rig) for k in (0, 4)])
    e = np.concatenate([tracks[:, 1] - tracks[:, 3], tracks[:, 5] - tracks[:, 7]])
    line, H = _sampled(A, e), prior
    for _ in range(_LAG_ROUNDS):
        left = e - A @ line
        scale = max(1.4826 * float(np.median(np.abs(left))), _LEAST_PX)
        weights = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2) ** 2 / scale**2
        H = (A * weights[:, None]).T @ A + prior
        line = np.asarray(np.linalg.solve(H, A.T @ (weights * e)), dtype=np.float64)
    return Lag(line, H)


def _sampled(A: FloatArray, e: FloatArray) -> FloatArray:
    """The line of the smallest median error, of those through three row differences and of none."""
    rng = np.random.default_rng(0)
    chosen = rng.integers(0, len(e), (_LAG_SAMPLES, 4))
    ridge = (_NOISE_PX / _TIME_SIGMA) ** 2 * np.eye(3)
    normal = np.swapaxes(A[chosen], 1, 2) @ A[chosen] + ridge
    lines = np.linalg.solve(normal, np.swapaxes(A[chosen], 1, 2) @ e[chosen][..., None])[..., 0]
    lines = np.concatenate([np.zeros((1, 3)), np.clip(lines, -2.0, 2.0)])
    errors = np.median(np.abs(e[:, None] - A @ lines.T), axis=0)
    return np.asarray(lines[np.argmin(errors)])


def _columns(pixels: FloatArray, rig: StereoRig) -> FloatArray:
    size = np.array([rig.camera.width, rig.camera.height])
    return np.column_stack([np.ones(len(pixels)), pixels / size])


def with_lag_taken(matches: Correspondences, lag: Lag, rig: StereoRig) -> Correspondences:
    """The ideal matches as the right camera would have had them at the left one's times, to first order.

    In ideal pixels, for a lens shows no ray at some of the pixels that a lag may lead to.
    """
    ideal = without_lens(matches, rig.camera)
    tracks, right = ideal.tracks.copy(), ideal.right.copy()
    moved = tracks[:, 6:8] - tracks[:, 2:4]
    tracks[:, 2:4] += lag.at(matches.tracks[:, 0:2], rig)[:, None] * moved
    tracks[:, 6:8] += lag.at(matches.tracks[:, 4:6], rig)[:, None] * moved
    moved = right[:, 2:4] - right[:, 0:2]
    right[:, 0:2] += lag.at(matches.right[:, 0:2], rig)[:, None] * moved
    right[:, 2:4] += lag.at(matches.right[:, 2:4], rig)[:, None] * moved
    return Correspondences(left=ideal.left, right=right, tracks=tracks)


def without_leaps(matches: Correspondences, rig: StereoRig) -> Correspondences:
    """The matches but for pairs that leap over most of the image, which are wrong.

    The ends of a pair that lie a share 1 / ratio of the image apart are read at one time: between them is no
    motion, and no error, whatever was matched. One such pair held a ratio of 0.8 at 1.17.
    """
    longest = _LONGEST_LEAP * np.array([rig.camera.width, rig.camera.height])
    left, right = (
        pairs[np.all(np.abs(pairs[:, 2:] - pairs[:, :2]) <= longest, axis=1)]
        for pairs in (matches.left, matches.right)
    )
    return Correspondences(left=left, right=right, tracks=matches.tracks)


def find_start(
    matches: Correspondences, rig: StereoRig, known: Known, options: RobustOptions, seed: int
) -> tuple[RobustEstimate | None, Lag]:
    """The motion that explains most matches, of those under ``COARSE``; None when there is none.

    A lens is taken from the matches beforehand: their times are then a little off, as they are under any of these.
    """
    lag = find_lag(matches.tracks, rig)
    taken = with_lag_taken(matches, lag, rig)
    rig, camera, found = rig.ideal, rig.camera, list[RobustEstimate]()
    for scan, ratio in _coarse(known):
        shutter = RollingShutter(height=camera.height, width=camera.width, readout_ratio=ratio, scan=scan)
        with np.errstate(invalid="ignore", over="ignore"):
            result = estimate_motion(taken, rig, shutter, RefinedSolver(), options, np.random.default_rng(seed))
        if result.estimate.success:
            found.append(result)
    best = max(found, key=lambda each: (each.inlier_count / each.threshold_px, each.inlier_count), default=None)
    return best, lag


def _coarse(known: Known) -> list[tuple[Scan, float]]:
    """Those of ``COARSE`` that are possible; where cameras read apart, all."""
    starts = {scans.left for scans in known.scans}
    possible = [(scan, ratio) for scan, ratio in COARSE if ("global" if ratio == 0.0 else scan) in starts]
    if not all(scans.together for scans in known.scans) or not possible:
        possible = list(COARSE)
    known_ratio = known.ratio
    return possible if known_ratio is None else [(s, known_ratio if r else 0.0) for s, r in possible]


def first_shutter(scans: Scans, lag: Lag) -> FloatArray:
    """Ratio and delay (2,) of a scans that fit a lag best; a ratio of 0.5 where the cameras read alike."""
    if scans.together:
        return np.array([0.5 if scans.rolls else 0.0, -lag.line[0]])
    A = np.column_stack([_columns_of_lag(scans), [-1.0, 0.0, 0.0]])
    ratio, delay = np.linalg.solve(A.T @ lag.H @ A + 1e-9 * np.eye(2), A.T @ lag.H @ lag.line)
    return np.array([np.clip(ratio, 0.1, 1.0), np.clip(delay, -0.9, 0.9)])


def largest_ratio(scans: Scans, lag: Lag) -> float:
    """The largest readout ratio at which scans agree with a lag; 0: none does; 1: the cameras read alike.

    A lag is of first order: flow that changes while it is read bends it by some hundredths.
    """
    if scans.together:
        return 1.0
    bend = _columns_of_lag(scans)
    H = np.linalg.inv(np.linalg.inv(lag.H) + _BEND**2 * np.eye(3))
    constant = np.array([1.0, 0.0, 0.0])
    for ratio in np.arange(1.1, 0.0, -0.05):
        off = lag.line - ratio * bend
        off = off - constant * (constant @ H @ off) / H[0, 0]  # the delay that fits best
        if float(off @ H @ off) <= _FAR:
            return float(min(ratio, 1.0))
    return 0.0


def _columns_of_lag(scans: Scans) -> FloatArray:
    """(3,) lag per readout ratio."""
    return line_of(scans, "left") - line_of(scans, "right")


_SCREENED = 160
"""Measurements by which most scans are put aside."""
_CLOSE = 30.0
"""Differences of the logarithm of the likelihood beyond which a hypothesis is put aside after that."""
_LIKELY = 12.0
"""The same, beyond which one is left out in the end: of matches whose errors are independent."""
_MOST_SCALE, _FIRST_NU = 10.0, 4.0
"""Scale of the errors, px, at most, and their tails, before their distribution is found."""
_FALLS, _STEADY = 10, 0.9
_UNSETTLED = 5.0
"""Times as far off as that a hypothesis may be before it is fitted at the scale of the best one."""
_ROUGHLY = 1e-2
"""Of the squared scale: a decrease of the cost at which the screening stops."""
_REACH = 10.0
"""As in ``heavy_tails``."""
_TILES = (6, 4)
"""Columns and rows of tiles in which matches may err together."""
_FIRST_REACH, _MOST_REACH, _LEAST_REACH = 0.02, 0.05, 0.001
"""Differences of the ratio by which the sharpness of a maximum is measured: about two deviations."""
_SLOPE_ROUNDS = 5
_SMALL_RATIO, _FAR_BETTER = 0.3, 0.5
"""Readout ratio that is nearly none, and errors over those of another fit that are far smaller."""
_WIDE = 1.0
"""Standard deviation of a ratio of which the matches say nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Peak:
    """Log-likelihood of a ratio, all else fitted: value - information (ratio - at)^2 / 2."""

    value: float
    at: float
    """Where the parabola has its top, which may lie outside of what is possible."""
    information: float
    """0 of a ratio that is known, as of global shutters."""
    fit: CaptureFit
    """At the best ratio; its deviations are those at that ratio."""
    trade: FloatArray
    """(23,) derivative of motion and unknowns by the ratio, all else fitted; zeros where the ratio is known."""

    @property
    def sigma(self) -> float:
        """Standard deviation of the ratio."""
        return float(self.information**-0.5) if self.information > 0.0 else 0.0

    @property
    def log_evidence(self) -> float:
        """Integral over ratios from ``LEAST_RATIO`` to 1, uniform before; the value where the ratio is known."""
        if self.information == 0.0:
            return self.value
        ends = (np.array([LEAST_RATIO, 1.0]) - self.at) / self.sigma
        if ends[0] > 0.0:  # so that neither logarithm is that of nearly 1
            ends = -ends[::-1]
        low, high = scipy.special.log_ndtr(ends)
        mass = high + np.log1p(-np.exp(min(low - high, -1e-12)))
        width = 0.5 * np.log(2.0 * np.pi) + np.log(self.sigma)
        return self.value + float(width + mass - np.log(1.0 - LEAST_RATIO))


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowEvidence:
    """What the matches of two times say of the hypotheses; those that are not here are out of the question."""

    peaks: Mapping[Hypothesis, Peak]
    lost: float
    """Log-likelihood, below the best one's, of those."""
    used: int
    """Measurements that count: not so far off that they must be wrong."""
    of: int
    noise_px: float
    dispersion: float
    """Factor on all variances, for matches of one part of the image that err together."""


def window_evidence(
    matches: Correspondences,
    rig: StereoRig,
    known: Known,
    motion: tuple[FloatArray, FloatArray],
    lag: Lag,
) -> WindowEvidence | None:
    """All hypotheses, on matches with outliers, from a motion near the right one.

    Most scans are put aside by some of the matches, under the first motion model. None for too few matches.
    """
    first = TimedMatches(matches, rig, known.models[0])
    timed = {model: first.under(model) for model in known.models}
    screened = (_of_models if known.shutter_known else _screened)(timed, known, motion, lag)
    if screened is None:
        return None
    fits, likelihood = screened
    sharpened = _sharpened(timed, known, fits, likelihood.scale)
    if sharpened is None:
        return None
    full, near = sharpened
    sharp = _Slope(_cost(timed, full, known, near[0].hypothesis), near[0])
    dispersion = _dispersion(sharp, first.pixels[full.chosen]) if sharp.varies else 1.0
    near = _near(near, full.scale, _LIKELY * dispersion)
    slopes = [sharp, *(_Slope(_cost(timed, full, known, fit.hypothesis), fit) for fit in near[1:])]
    sharp = min(slopes, key=lambda slope: slope.best.cost)
    reference, unit = sharp.best.cost, full.scale**2 * dispersion
    return WindowEvidence(
        peaks={slope.best.hypothesis: slope.peak(reference, unit) for slope in slopes},
        lost=_LIKELY,
        used=int(np.count_nonzero(full.chosen)),
        of=first.count,
        noise_px=full.scale,
        dispersion=dispersion,
    )


def _screened(
    timed: Mapping[str, TimedMatches], known: Known, motion: tuple[FloatArray, FloatArray], lag: Lag
) -> tuple[list[CaptureFit], Likelihood] | None:
    """What some of the matches allow, and the distribution of their errors: first scans, then motion models."""
    first = timed[known.models[0]]
    some = _some(first.count, _SCREENED)
    theta = first.packed(GLOBAL, known.start(Hypothesis(scans=GLOBAL, motion_model=""), 0.0, 0.0)).theta(*motion)
    found = dict[Scans, tuple[CaptureFit, float]]()
    for scans in sorted(known.scans, key=lambda each: (each != GLOBAL, not each.together)):
        if _is_excluded(scans, lag, found):
            continue
        hypothesis = Hypothesis(scans=scans, motion_model=known.models[0], delayed=known.delays[-1])
        starts = [(theta, known.start(hypothesis, *first_shutter(scans, lag)))]
        if GLOBAL in found:  # which any scans with a small ratio nearly are
            still = found[GLOBAL][0]
            starts.append((still.theta, known.start(hypothesis, LEAST_RATIO, float(still.unknowns[DELAY]))))
        fits = (_settled(first, some, hypothesis, known, start) for start in starts)
        found[scans] = min(fits, key=lambda each: each[1])
    scale = min(each for _, each in found.values())
    best = min((fit for fit, each in found.values() if each == scale), key=lambda fit: fit.cost)
    likelihood = _distribution(first, some, best, scale)
    if likelihood is None:
        return None
    judged = [_judged(timed, likelihood, known, fit) for fit, _ in found.values()]
    near = _near(judged, likelihood.scale, _UNSETTLED * _CLOSE)
    return _of_each_model(timed, some, known, near)


def _of_models(
    timed: Mapping[str, TimedMatches], known: Known, motion: tuple[FloatArray, FloatArray], lag: Lag
) -> tuple[list[CaptureFit], Likelihood] | None:
    """What ``_screened`` is where the shutter is known and motion models alone compete."""
    first, scans = timed[known.models[0]], known.scans[0]
    hypothesis = Hypothesis(scans=scans, motion_model=known.models[0])
    start = known.start(hypothesis, 0.0, 0.0)
    theta, some = first.packed(scans, start).theta(*motion), _some(first.count, _SCREENED)
    wide = Likelihood(nu=_FIRST_NU, scale=_MOST_SCALE, chosen=some)
    cost = CaptureCost(first, hypothesis, wide, known.prior(hypothesis))
    return _of_each_model(timed, some, known, [fit_capture(cost, theta, start, iterations=1)])


def _of_each_model(
    timed: Mapping[str, TimedMatches], some: BoolArray, known: Known, fits: Sequence[CaptureFit]
) -> tuple[list[CaptureFit], Likelihood] | None:
    """The fits of the first motion model, and those of the others on the same scans; and the errors of the best.

    Each is fitted at the scale of its own errors: at the scale of another model's, far smaller, it would not move.
    """
    found = list[tuple[CaptureFit, float]]()
    for fit, model in product(fits, known.models):
        hypothesis = replace(fit.hypothesis, motion_model=model)
        starts = (_start_from(timed, known, fit, hypothesis, k) for k in hypothesis.accelerations)
        settled = (_settled(timed[model], some, hypothesis, known, start) for start in starts)
        found.append(min(settled, key=lambda each: (each[1], each[0].cost)))
    best, scale = min(found, key=lambda each: (each[1], each[0].cost))
    likelihood = _distribution(timed[best.hypothesis.motion_model], some, best, scale)
    if likelihood is None:
        return None
    judged = [_judged(timed, likelihood, known, fit) for fit, _ in found]
    return _near(judged, likelihood.scale, _UNSETTLED * _CLOSE), likelihood


def _start_from(
    timed: Mapping[str, TimedMatches], known: Known, fit: CaptureFit, hypothesis: Hypothesis, k: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Where the fit of a hypothesis starts: at another one's of the same scans; ``k``: of another model's."""
    model = hypothesis.motion_model
    unknowns = known.start(hypothesis, *fit.unknowns[[RATIO, DELAY]])
    unknowns[CALIBRATION] = fit.unknowns[CALIBRATION]
    unknowns[ACCELERATION] = fit.unknowns[ACCELERATION] if model == fit.hypothesis.motion_model else k
    motion = timed[fit.hypothesis.motion_model].kernel(fit.unknowns).motion(fit.theta)
    return timed[model].kernel(unknowns).theta(*motion), unknowns


def _some(count: int, wanted: int) -> BoolArray:
    """About as many, evenly chosen."""
    return np.asarray(np.arange(count) % max(count // wanted, 1) == 0)


def _is_excluded(scans: Scans, lag: Lag, found: Mapping[Scans, tuple[CaptureFit, float]]) -> bool:
    """Whether the rows of left-right matches exclude scans, at all or but for ratios that are nearly none.

    Those are excluded with the global shutter, where cameras that read alike fit far better.
    """
    most = largest_ratio(scans, lag)
    if most <= 0.0 or most > _SMALL_RATIO or GLOBAL not in found:
        return most <= 0.0
    return min(each for _, each in found.values()) < _FAR_BETTER * found[GLOBAL][1]


def _settled(
    timed: TimedMatches,
    some: BoolArray,
    hypothesis: Hypothesis,
    known: Known,
    start: tuple[FloatArray, FloatArray],
) -> tuple[CaptureFit, float]:
    """A hypothesis at the scale of its own errors, which falls as it is fitted better; and that scale, px.

    At a scale far below the errors that a wrong ratio leaves, matches would count the less the more they tell.
    """
    prior = known.prior(hypothesis)
    cost = CaptureCost(timed, hypothesis, Likelihood(nu=_FIRST_NU, scale=_MOST_SCALE, chosen=some), prior)
    scale = min(cost.typical_error(*start), _MOST_SCALE)
    fit = None
    for _ in range(_FALLS):
        cost = CaptureCost(timed, hypothesis, Likelihood(nu=_FIRST_NU, scale=scale, chosen=some), prior)
        fit = fit_capture(cost, *start, iterations=6, still=_ROUGHLY)
        start = (fit.theta, fit.unknowns)
        last, scale = scale, min(scale, cost.typical_error(*start))
        if scale > _STEADY * last:
            break
    assert fit is not None
    return fit, scale


def _cost(
    timed: Mapping[str, TimedMatches], likelihood: Likelihood, known: Known, hypothesis: Hypothesis
) -> CaptureCost:
    return CaptureCost(timed[hypothesis.motion_model], hypothesis, likelihood, known.prior(hypothesis))


def _judged(
    timed: Mapping[str, TimedMatches], likelihood: Likelihood, known: Known, fit: CaptureFit
) -> CaptureFit:
    """A fit with its cost under a common distribution of the errors."""
    return replace(fit, cost=_cost(timed, likelihood, known, fit.hypothesis)(fit.theta, fit.unknowns))


def _near(fits: Sequence[CaptureFit], scale: float, far: float = _CLOSE) -> list[CaptureFit]:
    """Those whose log-likelihood is not far below the best one's, the best first."""
    fits = sorted(fits, key=lambda fit: fit.cost)
    return [fit for fit in fits if fit.cost - fits[0].cost <= far * scale**2]


def _fitted(
    timed: Mapping[str, TimedMatches],
    known: Known,
    likelihood: Likelihood,
    fits: Sequence[CaptureFit],
    delays: Sequence[bool],
) -> list[CaptureFit]:
    """The fits again, with and without a late right camera, from the nearest fit; the best of them first.

    Those that cannot come near the best one are given up on the way.
    """
    out, fits = list[CaptureFit](), sorted(fits, key=lambda fit: fit.cost)
    pairs = dict.fromkeys((fit.hypothesis.scans, fit.hypothesis.motion_model) for fit in fits)
    for (scans, model), delayed in product(pairs, delays):
        hypothesis = Hypothesis(scans=scans, motion_model=model, delayed=delayed)
        of_pair = [f for f in fits if (f.hypothesis.scans, f.hypothesis.motion_model) == (scans, model)]
        start = _start_from(timed, known, min(of_pair, key=lambda fit: fit.cost), hypothesis)
        cost = _cost(timed, likelihood, known, hypothesis)
        far = min((fit.cost for fit in out), default=np.inf) + _CLOSE * likelihood.scale**2
        out.append(fit_capture(cost, *start, iterations=8, still=_ROUGHLY, hopeless=far))
    return out


def _sharpened(
    timed: Mapping[str, TimedMatches], known: Known, fits: list[CaptureFit], scale: float
) -> tuple[Likelihood, list[CaptureFit]] | None:
    """The fits on all matches, the best first, under the distribution of the best one's errors.

    Its scale falls as the best one is fitted better, or another one becomes the best; none is put aside before.
    """
    everything = np.ones(timed[known.models[0]].count, dtype=np.bool_)
    for _ in range(_FALLS):
        best = min(fits, key=lambda fit: fit.cost)
        full = _distribution(timed[best.hypothesis.motion_model], everything, best, scale)
        if full is None:
            return None
        fits = _fitted(timed, known, full, fits, known.delays)
        if full.scale > _STEADY * scale:
            break
        scale = full.scale
    return full, _near(fits, full.scale)


def _distribution(timed: TimedMatches, among: BoolArray, fit: CaptureFit, scale: float) -> Likelihood | None:
    """Of the errors under one fit, of the chosen matches that are not wrong."""
    packed = timed.subset(among).packed(fit.hypothesis.scans, fit.unknowns)
    found = heavy_tailed(packed, fit.theta, scale)
    if found is None:
        return None
    freedom = np.repeat([1.0, 5.0], [len(packed.pairs), len(packed.tracks)])
    chosen = among.copy()
    chosen[among] = each_term(packed, fit.theta).squares / freedom <= (_REACH * found.scale) ** 2
    return Likelihood(nu=found.nu, scale=max(found.scale, LEAST_SCALE_PX), chosen=chosen, trust=found.trust)


class _Slope:
    """The cost of a hypothesis about its minimum, as a function of the ratio, all else fitted to each."""

    def __init__(self, cost: CaptureCost, start: CaptureFit) -> None:
        self._cost, self.scale = cost, cost.likelihood.scale
        self.varies = RATIO in cost.free
        free = fit_capture(cost, start.theta, start.unknowns)
        # Once more as those beside it are found, or a start that is less settled than they looks like a valley.
        self.best = fit_capture(cost, free.theta, free.unknowns, hold_ratio=True)
        self.least, self.at, self.curvature = self.best.cost, float(self.best.unknowns[RATIO]), 0.0
        self._beside: tuple[CaptureFit, CaptureFit] = (self.best, self.best)
        reach = _FIRST_REACH
        for _ in range(_SLOPE_ROUNDS if self.varies else 0):
            self._measure(reach)
            sigma = cost.likelihood.scale / np.sqrt(max(self.curvature, 1e-12))
            away = float(np.clip(self.at, LEAST_RATIO, BEYOND_RATIO)) - self.best.unknowns[RATIO]
            fits = 0.5 * reach <= 2.0 * sigma <= 2.0 * reach or reach in (_LEAST_REACH, _MOST_REACH)
            if fits and abs(away) <= reach:
                break
            if abs(away) > reach:
                self.best = self._held(self.best.unknowns[RATIO] + away)
            reach = float(np.clip(2.0 * sigma, _LEAST_REACH, _MOST_REACH))

    def _measure(self, reach: float) -> None:
        """Top and curvature of the parabola through three ratios, the best one and one on either side of it."""
        ratio = float(self.best.unknowns[RATIO])
        below, above = self._beside = (self._held(ratio - reach), self._held(ratio + reach))
        slope = (above.cost - below.cost) / (2.0 * reach)
        curvature = (above.cost - 2.0 * self.best.cost + below.cost) / reach**2
        self.curvature = max(float(curvature), 1e-9)
        away = float(np.clip(-slope / self.curvature, -_WIDE, _WIDE)) if curvature > 0.0 else 0.0
        self.at = ratio + away
        self.least = self.best.cost - 0.5 * self.curvature * away**2

    def _held(self, ratio: float) -> CaptureFit:
        unknowns = self.best.unknowns.copy()
        unknowns[RATIO] = ratio
        return fit_capture(self._cost, self.best.theta, unknowns, hold_ratio=True)

    def peak(self, reference: float, unit: float) -> Peak:
        """In units of the errors' variance, px^2."""
        spread = float(np.sqrt(unit)) / self.scale
        others = sum(k != RATIO for k in self._cost.free)
        low, high = (np.concatenate([fit.theta, fit.unknowns]) for fit in self._beside)
        apart = float(high[6 + RATIO] - low[6 + RATIO])
        return Peak(
            value=(reference - self.least) / unit + self.best.occam + others * float(np.log(spread)),
            at=self.at,
            information=self.curvature / unit + 1.0 / _WIDE**2 if self.varies else 0.0,
            fit=replace(self.best, sigma=self.best.sigma * spread, spread=self.best.spread * spread**2),
            trade=(high - low) / apart if apart > 0.0 else np.zeros_like(high),
        )

    def scores(self) -> FloatArray:
        """(n,) derivative of each measurement's cost by the ratio."""
        low, high = self._beside
        costs = [self._cost.each(fit.theta, fit.unknowns) for fit in (low, high)]
        return (costs[1] - costs[0]) / float(high.unknowns[RATIO] - low.unknowns[RATIO])


def _dispersion(slope: _Slope, pixels: FloatArray) -> float:
    """How many times the variance of the ratio is what independent errors would give; at least 1."""
    tiles, scores = _tiles(pixels), slope.scores()
    used = np.unique(tiles)
    together = np.bincount(tiles, weights=scores - np.mean(scores))
    variance = float(np.sum(together**2)) * len(used) / max(len(used) - 1, 1) / slope.curvature
    return max(variance / slope.scale**2, 1.0)


def _tiles(points: FloatArray) -> NDArray[np.int64]:
    """Number (n,) of the tile of the image that a point (n, 2) lies in: about as many points in every column."""
    tile = np.zeros(len(points), dtype=np.int64)
    for axis, count in enumerate(_TILES):
        edges = np.quantile(points[:, axis], np.arange(1, count) / count)
        tile = tile * count + np.searchsorted(edges, points[:, axis])
    return tile
