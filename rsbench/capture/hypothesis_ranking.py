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
from rsbench.core.camera import inverse_2x2
from rsbench.core.correspondences import BoolArray, Correspondences, without_lens
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import variance_factor
from rsbench.solvers.engine.packed import HeavyTailed, each_term, heavy_tailed
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

COARSE: tuple[tuple[Scan, float], ...] = (
    ("top", 0.0),
    ("top", 0.5),
    ("bottom", 0.5),
    ("left", 0.5),
    ("right", 0.5),
)
"""Shutters of cameras that read together, for the search for a motion: errors between them are small."""
_LAG_SAMPLES, _LAG_ROUNDS = 400, 6
_NOISE_PX, _TIME_SIGMA = 0.5, 0.5
"""Expected noise of a row difference, and expected size of a difference of times, frame periods."""
_LEAST_PX, _GRID = 0.1, 9
_LONGEST_LEAP = 0.75
"""Of the image's width or height, over a frame period: far from the reciprocal of the largest ratio, 1 / 1.2."""
_BEND, _FAR = 0.1, 40.0
"""Error of a lag, frame periods, and squared deviations beyond which scans disagree with it."""


class Lag(NamedTuple):
    """Time of the left camera less that of the right one at one place, frame periods."""

    line: FloatArray
    """(3,) constant, per width, per height of the left image."""
    H: FloatArray
    """(3, 3) how well the matches determine it: inverse covariance."""
    right: FloatArray = np.eye(3)
    """(3, 3) constant, share of width, of height in the right image, of those in the left one; far away."""

    def at(self, pixels: FloatArray, rig: StereoRig, side: Side = "left") -> FloatArray:
        """(n,) at pixels (n, 2) of a camera."""
        line = self.line if side == "left" else np.linalg.solve(self.right.T, self.line)
        return np.asarray(_columns(pixels, rig, side) @ line)


def find_lag(tracks: FloatArray, rig: StereoRig) -> Lag:
    """From tracks (n, 8) with outliers; 0 where nothing moves across the rows."""
    prior, right = np.eye(3) / _TIME_SIGMA**2, _right_columns(rig)
    if len(tracks) < 3:
        return Lag(np.zeros(3), prior, right)
    places = [_columns(tracks[:, k : k + 2], rig) for k in (0, 4)]
    if not rig.aligned:
        tracks = without_lens(Correspondences(tracks=tracks), rig).tracks
    moved = 0.5 * (tracks[:, 5] - tracks[:, 1] + tracks[:, 7] - tracks[:, 3])
    A = np.concatenate([moved[:, None] * each for each in places])
    e = np.concatenate([tracks[:, 1] - tracks[:, 3], tracks[:, 5] - tracks[:, 7]])
    line, H = _sampled(A, e), prior
    for _ in range(_LAG_ROUNDS):
        left = e - A @ line
        scale = max(1.4826 * float(np.median(np.abs(left))), _LEAST_PX)
        weights = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2) ** 2 / scale**2
        H = (A * weights[:, None]).T @ A + prior
        line = np.asarray(np.linalg.solve(H, A.T @ (weights * e)), dtype=np.float64)
    return Lag(line, H, right)


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


def _columns(pixels: FloatArray, rig: StereoRig, side: Side = "left") -> FloatArray:
    camera = rig.sensor(side)
    size = np.array([camera.width, camera.height])
    return np.column_stack([np.ones(len(pixels)), pixels / size])


def _right_columns(rig: StereoRig) -> FloatArray:
    """``Lag.right`` of a rig."""
    if rig.aligned:
        return np.eye(3)
    camera = rig.camera
    x, y = np.meshgrid(np.linspace(0.0, camera.width - 1, _GRID), np.linspace(0.0, camera.height - 1, _GRID))
    grid = np.stack([x.ravel(), y.ravel()], axis=-1)
    left, right = (_columns(rig.eye(side).lens_pixels(grid), rig, side) for side in SIDES)
    seen = np.all(np.isfinite(left) & np.isfinite(right), axis=1)
    return np.asarray(np.linalg.lstsq(left[seen], right[seen], rcond=None)[0].T, dtype=np.float64)


def _in_ideal(scan: Scan, rig: StereoRig) -> Scan:
    """The side at which lines of the left camera begin, in the ideal image."""
    if rig.aligned:
        return scan
    eye, rate = rig.eye("left"), rig.shutter_of(Scanning(scan=scan), 1.0).rate("left")
    middle = np.array([(eye.width - 1) / 2, (eye.height - 1) / 2])
    slope = rate @ inverse_2x2(eye.ideal_by_pixel(middle))
    sides: tuple[tuple[Scan, Scan], ...] = (("left", "right"), ("top", "bottom"))
    axis = int(np.argmax(np.abs(slope)))
    return sides[axis][int(slope[axis] < 0.0)]


def without_lag(matches: Correspondences, lag: Lag, rig: StereoRig) -> Correspondences:
    """The ideal matches as the right camera would have had them at the left one's times, to first order.

    In ideal pixels, for a lens shows no ray at some of the pixels that a lag may lead to.
    """
    ideal = without_lens(matches, rig)
    tracks, right = ideal.tracks.copy(), ideal.right.copy()
    moved = tracks[:, 6:8] - tracks[:, 2:4]
    tracks[:, 2:4] += lag.at(matches.tracks[:, 0:2], rig)[:, None] * moved
    tracks[:, 6:8] += lag.at(matches.tracks[:, 4:6], rig)[:, None] * moved
    moved = right[:, 2:4] - right[:, 0:2]
    right[:, 0:2] += lag.at(matches.right[:, 0:2], rig, "right")[:, None] * moved
    right[:, 2:4] += lag.at(matches.right[:, 2:4], rig, "right")[:, None] * moved
    return Correspondences(left=ideal.left, right=right, tracks=tracks)


def without_leaps(matches: Correspondences, rig: StereoRig) -> Correspondences:
    """The matches but for pairs that leap over most of the image, which are wrong.

    Ends of a pair that lie a share 1 / ratio of the image apart are read at one time: between them is no
    motion, and no error, whatever was matched. One such pair kept the estimate of a ratio of 0.8 at 1.17.
    """
    sizes = [np.array([rig.sensor(side).width, rig.sensor(side).height]) for side in SIDES]
    left, right = (
        pairs[np.all(np.abs(pairs[:, 2:] - pairs[:, :2]) <= _LONGEST_LEAP * size, axis=1)]
        for pairs, size in zip((matches.left, matches.right), sizes, strict=True)
    )
    return Correspondences(left=left, right=right, tracks=matches.tracks)


def find_start(
    matches: Correspondences, rig: StereoRig, known: Known, options: RobustOptions, seed: int
) -> tuple[RobustEstimate | None, Lag]:
    """The motion that explains most matches, of those under ``COARSE``; None when there is none.

    Matches are undistorted beforehand: their times are then slightly wrong, as they are under any of these. Where
    cameras that differ have a known shutter, it is that one's.
    """
    lag, found, camera = find_lag(matches.tracks, rig), list[RobustEstimate](), rig.ideal.camera
    given = known.shutter(rig)
    if given is None or (rig.aligned and known.scans[0].together):
        tried = [
            RollingShutter(
                height=camera.height, width=camera.width, readout_ratio=ratio, scan=_in_ideal(scan, rig)
            )
            for scan, ratio in _coarse(known)
        ]
        matches, rig = without_lag(matches, lag, rig), rig.ideal
    else:
        tried = [given]
    for shutter in tried:
        with np.errstate(invalid="ignore", over="ignore"):
            result = estimate_motion(matches, rig, shutter, RefinedSolver(), options, np.random.default_rng(seed))
        if result.estimate.success:
            found.append(result)
    best = max(found, key=lambda each: (each.inlier_count / each.threshold_px, each.inlier_count), default=None)
    return best, lag


def _coarse(known: Known) -> list[tuple[Scan, float]]:
    """Possible ones of ``COARSE``; all of them where the cameras may read differently."""
    starts = {scans.left for scans in known.scans}
    possible = [(scan, ratio) for scan, ratio in COARSE if ("global" if ratio == 0.0 else scan) in starts]
    if not all(scans.together for scans in known.scans) or not possible:
        possible = list(COARSE)
    return possible if known.ratio is None else [(s, known.ratio if r else 0.0) for s, r in possible]


def first_shutter(scans: Scans, lag: Lag) -> FloatArray:
    """Ratio and delay (2,) of scans that fit a lag best; a ratio of 0.5 where the cameras read alike."""
    bend = _columns_of_lag(scans, lag)
    if scans.together:
        ratio = 0.5 if scans.rolls else 0.0
        return np.array([ratio, ratio * bend[0] - lag.line[0]])
    A = np.column_stack([bend, [-1.0, 0.0, 0.0]])
    ratio, delay = np.linalg.solve(A.T @ lag.H @ A + 1e-9 * np.eye(2), A.T @ lag.H @ lag.line)
    return np.array([np.clip(ratio, 0.1, 1.0), np.clip(delay, -0.9, 0.9)])


def largest_ratio(scans: Scans, lag: Lag) -> float:
    """The largest readout ratio at which scans agree with a lag; 0: none does; 1: the cameras read alike.

    A lag is of first order: flow that changes while it is read bends it by some hundredths.
    """
    if scans.together:
        return 1.0
    bend = _columns_of_lag(scans, lag)
    H = np.linalg.inv(np.linalg.inv(lag.H) + _BEND**2 * np.eye(3))
    constant = np.array([1.0, 0.0, 0.0])
    for ratio in np.arange(1.1, 0.0, -0.05):
        off = lag.line - ratio * bend
        off = off - constant * (constant @ H @ off) / H[0, 0]  # the delay that fits best
        if float(off @ H @ off) <= _FAR:
            return float(min(ratio, 1.0))
    return 0.0


def _columns_of_lag(scans: Scans, lag: Lag) -> FloatArray:
    """(3,) lag per readout ratio."""
    return np.asarray(line_of(scans, "left") - line_of(scans, "right") @ lag.right)


_SCREENED = 160
"""Measurements by which most scans are excluded."""
_CLOSE = 30.0
"""Differences of the log-likelihood beyond which a hypothesis is excluded after that."""
_LIKELY = 12.0
"""The same at the end, for matches with independent errors."""
_MOST_SCALE, _FIRST_NU = 10.0, 4.0
"""Largest scale of the errors, px, and their tails, before their distribution is estimated."""
_FALLS, _STEADY = 10, 0.9
_UNSETTLED = 5.0
"""Factor on that difference before a hypothesis is fitted at the scale of the best one."""
_ROUGHLY = 1e-2
"""Decrease of the cost, over the squared scale, at which the screening stops."""
_REACH = 10.0
"""As in ``packed.HeavyTailed``."""
_TILES = (6, 4)
"""Columns and rows of tiles in which matches may have common errors."""
_FIRST_REACH, _MOST_REACH, _LEAST_REACH = 0.02, 0.05, 0.001
"""Differences of the ratio by which the sharpness of a maximum is measured: about two standard deviations."""
_SLOPE_ROUNDS = 5
_SMALL_RATIO, _FAR_BETTER = 0.3, 0.5
"""Readout ratio that is nearly none, and errors over those of another fit that are far smaller."""
_WIDE = 1.0
"""Prior standard deviation of a ratio."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Peak:
    """Log-likelihood of a ratio, all else fitted: value - information (ratio - at)^2 / 2."""

    value: float
    at: float
    """Where the parabola has its top, which may be an impossible ratio."""
    information: float
    """0 for a known ratio, as of global shutters."""
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
        """Log-likelihood integrated over a uniform prior of ratios, ``LEAST_RATIO`` to 1; ``value`` if known."""
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
    """Evidence of the hypotheses in the matches of two times; excluded hypotheses are left out."""

    peaks: Mapping[Hypothesis, Peak]
    lost: float
    """Log-likelihood of the excluded ones below the best one's, at least."""
    used: int
    """Measurements that count: not so far off that they must be wrong."""
    of: int
    noise_px: float
    dispersion: float
    """Factor on all variances, for matches of one part of the image that have common errors, and for rows that
    disagree."""
    contradicted: bool
    """Whether no motion model holds for all rows: then any ratio may fit best."""

    @property
    def of_any_ratio(self) -> WindowEvidence:
        """The evidence without what it says of the ratio."""
        peaks = {key: replace(p, information=min(p.information, _WIDE**-2.0)) for key, p in self.peaks.items()}
        return replace(self, peaks=peaks)


def window_evidence(
    matches: Correspondences, rig: StereoRig, known: Known, motion: tuple[FloatArray, FloatArray], lag: Lag
) -> WindowEvidence | None:
    """All hypotheses, on matches with outliers, from a motion near the right one.

    Most scans are excluded by some of the matches, under the first motion model. None for too few matches.
    """
    first = TimedMatches(matches, rig, known.models[0], known.right_share)
    comparison = _Comparison({model: first.under(model) for model in known.models}, known)
    fits = comparison.of_known_shutter(motion) if known.shutter_known else comparison.screened(motion, lag)
    screened = comparison.of_each_model(fits)
    sharpened = None if screened is None else comparison.sharpened(*screened)
    if sharpened is None:
        return None
    full, near = sharpened
    sharp = _Slope(comparison.cost(full, near[0].hypothesis), near[0])
    tailed = comparison.tailed(full, sharp.best)
    if sharp.varies:
        rows = tailed.by_rows(sharp.best.theta)
        dispersion = _dispersion(sharp, first.pixels[full.chosen])
        dispersion *= 1.0 if rows is None else rows.dispersion(dispersion)
    else:
        rows, stated = None, tailed.stated(sharp.best.theta)
        dispersion = 1.0 if stated is None else stated.shared
    near = _near(near, full.scale, _LIKELY * dispersion)
    slopes = [sharp, *(_Slope(comparison.cost(full, fit.hypothesis), fit) for fit in near[1:])]
    reference, unit = min(slope.best.cost for slope in slopes), full.scale**2 * dispersion
    return WindowEvidence(
        peaks={slope.best.hypothesis: slope.peak(reference, unit) for slope in slopes},
        lost=_LIKELY,
        used=int(np.count_nonzero(full.chosen)),
        of=first.count,
        noise_px=full.scale,
        dispersion=dispersion,
        contradicted=rows is not None and rows.contradict,
    )


@dataclass(frozen=True)
class _Comparison:
    """The matches of a window under each motion model, and what is known of their capture."""

    timed: Mapping[str, TimedMatches]
    known: Known

    @property
    def first(self) -> TimedMatches:
        """Under the first motion model."""
        return self.timed[self.known.models[0]]

    @property
    def some(self) -> BoolArray:
        """About ``_SCREENED`` of the measurements, evenly chosen."""
        count = self.first.count
        return np.asarray(np.arange(count) % max(count // _SCREENED, 1) == 0)

    def cost(self, likelihood: Likelihood, hypothesis: Hypothesis) -> CaptureCost:
        return CaptureCost(
            self.timed[hypothesis.motion_model], hypothesis, likelihood, self.known.prior(hypothesis)
        )

    def rough_cost(self, hypothesis: Hypothesis, scale: float) -> CaptureCost:
        """Of some measurements, before the distribution of their errors is estimated."""
        return self.cost(Likelihood(nu=_FIRST_NU, scale=scale, chosen=self.some), hypothesis)

    def screened(self, motion: tuple[FloatArray, FloatArray], lag: Lag) -> list[CaptureFit]:
        """Fits of the scans that some of the matches allow, under the first motion model."""
        known, model = self.known, self.known.models[0]
        start = known.start(Hypothesis(scans=GLOBAL, motion_model=""), 0.0, 0.0)
        theta, found = self.first.packed(GLOBAL, start).theta(*motion), dict[Scans, tuple[CaptureFit, float]]()
        for scans in sorted(known.scans, key=lambda each: (each != GLOBAL, not each.together)):
            if _is_excluded(scans, lag, found):
                continue
            hypothesis = Hypothesis(scans=scans, motion_model=model, delayed=known.delays[-1])
            starts = [(theta, known.start(hypothesis, *first_shutter(scans, lag)))]
            if GLOBAL in found:  # which any scans with a small ratio nearly are
                still = found[GLOBAL][0]
                starts.append((still.theta, known.start(hypothesis, LEAST_RATIO, float(still.unknowns[DELAY]))))
            fits = (self.settled(hypothesis, start) for start in starts)
            found[scans] = min(fits, key=lambda each: each[1])
        return self.judged(list(found.values()))[0]

    def of_known_shutter(self, motion: tuple[FloatArray, FloatArray]) -> list[CaptureFit]:
        """The one fit in place of ``screened`` where the shutter is known and motion models alone compete."""
        scans = self.known.scans[0]
        hypothesis = Hypothesis(scans=scans, motion_model=self.known.models[0])
        start = self.known.start(hypothesis, 0.0, 0.0)
        theta = self.first.packed(scans, start).theta(*motion)
        return [fit_capture(self.rough_cost(hypothesis, _MOST_SCALE), theta, start, iterations=1)]

    def of_each_model(self, fits: Sequence[CaptureFit]) -> tuple[list[CaptureFit], Likelihood] | None:
        """Fits of every motion model, on the scans of fits of the first one; and the errors of the best.

        Each is fitted at the scale of its own errors: at another model's far smaller scale it would not move.
        """
        found = list[tuple[CaptureFit, float]]()
        for fit, model in product(fits, self.known.models):
            hypothesis = replace(fit.hypothesis, motion_model=model)
            starts = (self.start_from(fit, hypothesis, k) for k in hypothesis.accelerations)
            settled = (self.settled(hypothesis, start) for start in starts)
            found.append(min(settled, key=lambda each: (each[1], each[0].cost)))
        fits, likelihood = self.judged(found)
        return None if likelihood is None else (fits, likelihood)

    def judged(self, found: Sequence[tuple[CaptureFit, float]]) -> tuple[list[CaptureFit], Likelihood | None]:
        """Fits with their scales, px: those near the best one under the distribution of its errors; and this."""
        best, scale = min(found, key=lambda each: (each[1], each[0].cost), default=(None, 0.0))
        likelihood = None if best is None else self.distribution(self.some, best, scale)
        if likelihood is None:
            return [], None
        costs = [self.cost(likelihood, fit.hypothesis)(fit.theta, fit.unknowns) for fit, _ in found]
        fits = [replace(fit, cost=cost) for (fit, _), cost in zip(found, costs, strict=True)]
        return _near(fits, likelihood.scale, _UNSETTLED * _CLOSE), likelihood

    def start_from(self, fit: CaptureFit, hypothesis: Hypothesis, k: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Start of a hypothesis at the fit of another one of the same scans; ``k`` where models differ."""
        model, own = hypothesis.motion_model, fit.hypothesis.motion_model
        unknowns = self.known.start(hypothesis, *fit.unknowns[[RATIO, DELAY]])
        unknowns[CALIBRATION] = fit.unknowns[CALIBRATION]
        unknowns[ACCELERATION] = fit.unknowns[ACCELERATION] if model == own else k
        motion = self.timed[own].kernel(fit.unknowns).motion(fit.theta)
        return self.timed[model].kernel(unknowns).theta(*motion), unknowns

    def settled(self, hypothesis: Hypothesis, start: tuple[FloatArray, FloatArray]) -> tuple[CaptureFit, float]:
        """A hypothesis at the scale of its own errors, which falls as the fit improves; and that scale, px.

        At a scale far below the errors that a wrong ratio leaves, informative matches would count least.
        """
        scale, fit = min(self.rough_cost(hypothesis, _MOST_SCALE).typical_error(*start), _MOST_SCALE), None
        for _ in range(_FALLS):
            cost = self.rough_cost(hypothesis, scale)
            fit = fit_capture(cost, *start, iterations=6, still=_ROUGHLY)
            start = (fit.theta, fit.unknowns)
            last, scale = scale, min(scale, cost.typical_error(*start))
            if scale > _STEADY * last:
                break
        assert fit is not None
        return fit, scale

    def fitted(self, likelihood: Likelihood, fits: Sequence[CaptureFit]) -> list[CaptureFit]:
        """The fits again, with and without a late right camera, from the nearest fit; the best of them first.

        The fit of a hypothesis that cannot come near the best one ends early.
        """
        out, fits = list[CaptureFit](), sorted(fits, key=lambda fit: fit.cost)
        pairs = dict.fromkeys((fit.hypothesis.scans, fit.hypothesis.motion_model) for fit in fits)
        for (scans, model), delayed in product(pairs, self.known.delays):
            hypothesis = Hypothesis(scans=scans, motion_model=model, delayed=delayed)
            of_pair = [f for f in fits if (f.hypothesis.scans, f.hypothesis.motion_model) == (scans, model)]
            start = self.start_from(of_pair[0], hypothesis)
            far = min((fit.cost for fit in out), default=np.inf) + _CLOSE * likelihood.scale**2
            cost = self.cost(likelihood, hypothesis)
            out.append(fit_capture(cost, *start, iterations=8, still=_ROUGHLY, hopeless=far))
        return out

    def sharpened(
        self, fits: list[CaptureFit], likelihood: Likelihood
    ) -> tuple[Likelihood, list[CaptureFit]] | None:
        """The fits on all matches, the best first, under the distribution of the best one's errors.

        Its scale falls as the best one is fitted better, or another one becomes the best; none is excluded before.
        """
        scale, everything = likelihood.scale, np.ones(self.first.count, dtype=np.bool_)
        for _ in range(_FALLS):
            full = self.distribution(everything, min(fits, key=lambda fit: fit.cost), scale)
            if full is None:
                return None
            fits = self.fitted(full, fits)
            if full.scale > _STEADY * scale:
                break
            scale = full.scale
        return full, _near(fits, full.scale)

    def tailed(self, likelihood: Likelihood, fit: CaptureFit) -> HeavyTailed:
        """The measurements as a fit reads them, with the distribution of their errors."""
        read = self.timed[fit.hypothesis.motion_model].read(fit.hypothesis.scans, likelihood.chosen)
        trust = np.ones(read.count) if likelihood.trust is None else likelihood.trust
        packed = vars(read.packed(fit.unknowns))
        return HeavyTailed(**packed, nu=likelihood.nu, scale=likelihood.scale, trust=trust)

    def distribution(self, among: BoolArray, fit: CaptureFit, scale: float) -> Likelihood | None:
        """Of the errors under one fit, of the chosen matches that are not wrong."""
        read = self.timed[fit.hypothesis.motion_model].read(fit.hypothesis.scans, among)
        packed = read.packed(fit.unknowns)
        found = heavy_tailed(packed, fit.theta, scale)
        if found is None:
            return None
        freedom = np.repeat([1.0, 5.0], [len(packed.pairs), len(packed.tracks)])
        chosen = among.copy()
        chosen[among] = each_term(packed, fit.theta).squares / freedom <= (_REACH * found.scale) ** 2
        return Likelihood(nu=found.nu, scale=max(found.scale, LEAST_SCALE_PX), chosen=chosen, trust=found.trust)


def _is_excluded(scans: Scans, lag: Lag, found: Mapping[Scans, tuple[CaptureFit, float]]) -> bool:
    """Whether the rows of left-right matches exclude scans, at all or except for ratios that are nearly none.

    The latter are excluded with the global shutter, where cameras that read alike fit far better.
    """
    most = largest_ratio(scans, lag)
    if most <= 0.0 or most > _SMALL_RATIO or GLOBAL not in found:
        return most <= 0.0
    return min(each for _, each in found.values()) < _FAR_BETTER * found[GLOBAL][1]


def _near(fits: Sequence[CaptureFit], scale: float, far: float = _CLOSE) -> list[CaptureFit]:
    """Those whose log-likelihood is not far below the best one's, the best first."""
    fits = sorted(fits, key=lambda fit: fit.cost)
    return [fit for fit in fits if fit.cost - fits[0].cost <= far * scale**2]


class _Slope:
    """The cost of a hypothesis about its minimum, as a function of the ratio, all else fitted to each."""

    def __init__(self, cost: CaptureCost, start: CaptureFit) -> None:
        self._cost, self.scale = cost, cost.likelihood.scale
        self.varies = RATIO in cost.free
        free = fit_capture(cost, start.theta, start.unknowns)
        # Once more as those beside it are found, or a start that is less settled than they looks like a valley.
        self.best = fit_capture(cost, free.theta, free.unknowns, fix_ratio=True)
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
                self.best = self._at_ratio(self.best.unknowns[RATIO] + away)
            reach = float(np.clip(2.0 * sigma, _LEAST_REACH, _MOST_REACH))

    def _measure(self, reach: float) -> None:
        """Top and curvature of the parabola through three ratios, the best one and one on either side of it."""
        ratio = float(self.best.unknowns[RATIO])
        below, above = self._beside = (self._at_ratio(ratio - reach), self._at_ratio(ratio + reach))
        slope = (above.cost - below.cost) / (2.0 * reach)
        curvature = (above.cost - 2.0 * self.best.cost + below.cost) / reach**2
        self.curvature = max(float(curvature), 1e-9)
        away = float(np.clip(-slope / self.curvature, -_WIDE, _WIDE)) if curvature > 0.0 else 0.0
        self.at = ratio + away
        self.least = self.best.cost - 0.5 * self.curvature * away**2

    def _at_ratio(self, ratio: float) -> CaptureFit:
        unknowns = self.best.unknowns.copy()
        unknowns[RATIO] = ratio
        return fit_capture(self._cost, self.best.theta, unknowns, fix_ratio=True)

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
    """Variance of the ratio over the one that independent errors would give, at least 1.

    By tiles of the image with about as many points (n, 2) in every column.
    """
    tiles = np.zeros(len(pixels), dtype=np.int64)
    for axis, count in enumerate(_TILES):
        edges = np.quantile(pixels[:, axis], np.arange(1, count) / count)
        tiles = tiles * count + np.searchsorted(edges, pixels[:, axis])
    scores, used = slope.scores(), len(np.unique(tiles))
    together = np.bincount(tiles, weights=scores - np.mean(scores))
    variance = float(np.sum(together**2)) * used / max(used - 1, 1) / slope.curvature
    return max(variance / slope.scale**2, 1.0) * variance_factor(used - 1.0, 1)
