"""Ranking of capture hypotheses by the matches of one window (two frame times).

A point that moves by v_y rows per frame period appears dt v_y rows apart in two cameras that see it dt frame
periods apart. ``find_lag`` therefore estimates the time difference of the cameras from the row differences of
left-right matches, by least squares. ``find_start`` removes it from the matches, which are then nearly those of
synchronous cameras, and finds the motion by a robust search. ``window_evidence`` fits every hypothesis from there
and returns the log-likelihood of each as a function of the readout ratio.
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
"""Shutters under which the motion is searched for, the same for both cameras; those between them are near one."""
_LAG_SAMPLES, _LAG_ROUNDS = 400, 6
_NOISE_PX, _TIME_SIGMA = 0.5, 0.5
"""Expected noise of a row difference, px, and prior standard deviation of a lag, frame periods."""
_LEAST_PX, _GRID = 0.1, 9
_LONGEST_LEAP = 0.75
"""Longest accepted displacement, as a share of the width or height; below 1 / 1.2, see ``without_leaps``."""
_BEND, _FAR = 0.1, 40.0
"""Model error of a lag, frame periods, and the squared normalised difference beyond which scans contradict it."""


class Lag(NamedTuple):
    """Readout time of the left camera minus that of the right one, frame periods, linear in the left image."""

    line: FloatArray
    """(3,) constant, slope per width, slope per height of the left image."""
    H: FloatArray
    """(3, 3) inverse covariance of ``line``."""
    right: FloatArray = np.eye(3)
    """(3, 3) maps (1, x / width, y / height) of a distant point from the left image to the right one."""

    def at(self, pixels: FloatArray, rig: StereoRig, side: Side = "left") -> FloatArray:
        """(n,) lag at pixels (n, 2) of a camera."""
        line = self.line if side == "left" else np.linalg.solve(self.right.T, self.line)
        return np.asarray(_columns(pixels, rig, side) @ line)


def find_lag(tracks: FloatArray, rig: StereoRig) -> Lag:
    """Robust estimate of the lag from tracks (n, 8) with outliers; 0 where nothing moves across the rows."""
    prior, right = np.eye(3) / _TIME_SIGMA**2, _right_columns(rig)
    if len(tracks) < 3:
        return Lag(np.zeros(3), prior, right)
    places = [_columns(tracks[:, k : k + 2], rig) for k in (0, 4)]
    if not rig.aligned:
        tracks = without_lens(Correspondences(tracks=tracks), rig).tracks
    moved = 0.5 * (tracks[:, 5] - tracks[:, 1] + tracks[:, 7] - tracks[:, 3])
    A = np.concatenate([moved[:, None] * each for each in places])
    e = np.concatenate([tracks[:, 1] - tracks[:, 3], tracks[:, 5] - tracks[:, 7]])
    line, H = _least_median_lag(A, e), prior
    for _ in range(_LAG_ROUNDS):
        left = e - A @ line
        scale = max(1.4826 * float(np.median(np.abs(left))), _LEAST_PX)
        weights = 1.0 / (1.0 + (left / (2.0 * scale)) ** 2) ** 2 / scale**2
        H = (A * weights[:, None]).T @ A + prior
        line = np.asarray(np.linalg.solve(H, A.T @ (weights * e)), dtype=np.float64)
    return Lag(line, H, right)


def _least_median_lag(A: FloatArray, e: FloatArray) -> FloatArray:
    """Least median of errors among lags (3,) fitted to random samples of four row differences, and no lag."""
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
    """``Lag.right`` for a rig, by least squares over a grid of directions."""
    if rig.aligned:
        return np.eye(3)
    camera = rig.camera
    x, y = np.meshgrid(np.linspace(0.0, camera.width - 1, _GRID), np.linspace(0.0, camera.height - 1, _GRID))
    grid = np.stack([x.ravel(), y.ravel()], axis=-1)
    left, right = (_columns(rig.eye(side).lens_pixels(grid), rig, side) for side in SIDES)
    seen = np.all(np.isfinite(left) & np.isfinite(right), axis=1)
    return np.asarray(np.linalg.lstsq(left[seen], right[seen], rcond=None)[0].T, dtype=np.float64)


def _in_ideal(scan: Scan, rig: StereoRig) -> Scan:
    """The side of the ideal image that corresponds to the side at which the left camera begins to read."""
    if rig.aligned:
        return scan
    eye, rate = rig.eye("left"), rig.shutter_of(Scanning(scan=scan), 1.0).rate("left")
    middle = np.array([(eye.width - 1) / 2, (eye.height - 1) / 2])
    slope = rate @ inverse_2x2(eye.ideal_by_pixel(middle))
    sides: tuple[tuple[Scan, Scan], ...] = (("left", "right"), ("top", "bottom"))
    axis = int(np.argmax(np.abs(slope)))
    return sides[axis][int(slope[axis] < 0.0)]


def without_lag(matches: Correspondences, lag: Lag, rig: StereoRig) -> Correspondences:
    """The matches, ideal px, with the right camera's points moved to the left one's times, to first order.

    They are ideal pixels because a moved point may lie where the lens's image has no ray.
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
    """The matches without pairs whose displacement exceeds ``_LONGEST_LEAP`` of the image, which are wrong.

    Two points that lie 1 / ratio of the image apart in successive frames are read at the same time. No motion
    lies between them, so a wrong match has no error there: one such pair kept a ratio of 0.8 at 1.17.
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
    """The motion that explains most matches under any shutter of ``COARSE`` (None if none does), and the lag.

    Matches are undistorted beforehand, which makes their times slightly wrong, as any of these shutters does. If
    the shutter is known and differs between the cameras or the rig is not aligned, it alone is used.
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
    """The shutters of ``COARSE`` that are possible; all of them if the cameras may read differently."""
    starts = {scans.left for scans in known.scans}
    possible = [(scan, ratio) for scan, ratio in COARSE if ("global" if ratio == 0.0 else scan) in starts]
    if not all(scans.together for scans in known.scans) or not possible:
        possible = list(COARSE)
    return possible if known.ratio is None else [(s, known.ratio if r else 0.0) for s, r in possible]


def first_shutter(scans: Scans, lag: Lag) -> FloatArray:
    """Readout ratio and delay (2,) with which the scans fit a lag best; a ratio of 0.5 if both read alike."""
    bend = _lag_of_unit_ratio(scans, lag)
    if scans.together:
        ratio = 0.5 if scans.rolls else 0.0
        return np.array([ratio, ratio * bend[0] - lag.line[0]])
    A = np.column_stack([bend, [-1.0, 0.0, 0.0]])
    ratio, delay = np.linalg.solve(A.T @ lag.H @ A + 1e-9 * np.eye(2), A.T @ lag.H @ lag.line)
    return np.array([np.clip(ratio, 0.1, 1.0), np.clip(delay, -0.9, 0.9)])


def largest_ratio(scans: Scans, lag: Lag) -> float:
    """The largest readout ratio at which the scans agree with a lag; 0: there is none; 1: both read alike.

    The lag is a first-order model: optical flow that changes during the readout shifts it by some hundredths.
    """
    if scans.together:
        return 1.0
    bend = _lag_of_unit_ratio(scans, lag)
    H = np.linalg.inv(np.linalg.inv(lag.H) + _BEND**2 * np.eye(3))
    constant = np.array([1.0, 0.0, 0.0])
    for ratio in np.arange(1.1, 0.0, -0.05):
        off = lag.line - ratio * bend
        off = off - constant * (constant @ H @ off) / H[0, 0]  # with the best delay
        if float(off @ H @ off) <= _FAR:
            return float(min(ratio, 1.0))
    return 0.0


def _lag_of_unit_ratio(scans: Scans, lag: Lag) -> FloatArray:
    """(3,) ``Lag.line`` of the scans for a readout ratio of 1 and no delay."""
    return np.asarray(line_of(scans, "left") - line_of(scans, "right") @ lag.right)


_SCREENED = 160
"""Number of measurements by which most scans are excluded."""
_CLOSE = 30.0
"""A hypothesis is excluded if its log-likelihood is lower than the best one's by more than this."""
_LIKELY = 12.0
"""The same threshold after the last fits, for matches with independent errors."""
_LARGEST_SCALE, _FIRST_NU = 10.0, 4.0
"""Largest error scale, px, and degrees of freedom before the distribution of the errors is estimated."""
_SCALE_ROUNDS, _STEADY = 10, 0.9
"""Most rounds in which the error scale is estimated anew, and the factor on it above which the rounds stop."""
_ROUGH_FACTOR = 5.0
"""Factor on ``_CLOSE`` before a hypothesis is fitted at the error scale of the best one."""
_ROUGHLY = 1e-2
"""Decrease of the cost, divided by the squared scale, at which fits for the screening stop."""
_OUTLIER_SCALES = 10.0
"""Errors above this many scales mark a wrong match, as in ``packed.HeavyTailed``."""
_TILES = (6, 4)
"""Columns and rows of image tiles; the errors of matches in one tile may be correlated."""
_FIRST_REACH, _MOST_REACH, _LEAST_REACH = 0.02, 0.05, 0.001
"""Step of the ratio for second differences of the cost: its start, maximum and minimum; about two deviations."""
_SLOPE_ROUNDS = 5
_SMALL_RATIO, _FAR_BETTER = 0.3, 0.5
"""A readout ratio close to a global shutter's; quotient of error scales below which one fit is far better."""
_WIDE = 1.0
"""Prior standard deviation of a ratio."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Peak:
    """Profile log-likelihood of the ratio near its maximum: value - information (ratio - at)^2 / 2."""

    value: float
    at: float
    """The ratio at the maximum of the parabola; it may lie outside 0 to 1."""
    information: float
    """Inverse variance of the ratio; 0 if the ratio is known, as for global shutters."""
    fit: CaptureFit
    """The fit at the best ratio; its standard deviations are conditional on that ratio."""
    trade: FloatArray
    """(23,) derivative of the fitted motion and unknowns by the ratio; zeros if the ratio is known."""

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
        if ends[0] > 0.0:  # use the lower tail, where the difference of the two loses no digits
            ends = -ends[::-1]
        low, high = scipy.special.log_ndtr(ends)
        mass = high + np.log1p(-np.exp(min(low - high, -1e-12)))
        width = 0.5 * np.log(2.0 * np.pi) + np.log(self.sigma)
        return self.value + float(width + mass - np.log(1.0 - LEAST_RATIO))


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowEvidence:
    """The likelihood of each hypothesis given the matches of two frame times, without excluded hypotheses."""

    peaks: Mapping[Hypothesis, Peak]
    lost: float
    """The log-likelihood of excluded hypotheses is lower than the best one's by at least this."""
    used: int
    """Number of measurements that are not outliers."""
    total: int
    """Number of measurements."""
    noise_px: float
    dispersion: float
    """Factor on all variances for correlated errors of neighbouring matches, and for rows that disagree."""
    contradicted: bool
    """Whether no motion model fits all rows, so that any ratio may fit best."""

    @property
    def of_any_ratio(self) -> WindowEvidence:
        """The evidence without its information about the ratio."""
        peaks = {key: replace(p, information=min(p.information, _WIDE**-2.0)) for key, p in self.peaks.items()}
        return replace(self, peaks=peaks)


def window_evidence(
    matches: Correspondences, rig: StereoRig, known: Known, motion: tuple[FloatArray, FloatArray], lag: Lag
) -> WindowEvidence | None:
    """Fit all hypotheses to matches with outliers, starting at a motion near the true one.

    A subset of the matches excludes most scans, under the first motion model. None if there are too few matches.
    """
    first = TimedMatches(matches, rig, known.models[0], known.right_share)
    comparison = _Comparison({model: first.under(model) for model in known.models}, known)
    fits = comparison.of_known_shutter(motion) if known.shutter_known else comparison.screened(motion, lag)
    screened = comparison.fits_of_each_model(fits)
    sharpened = None if screened is None else comparison.refitted_to_all(*screened)
    if sharpened is None:
        return None
    full, near = sharpened
    top = _Profile(comparison.cost(full, near[0].hypothesis), near[0])
    tailed = comparison.tailed(full, top.best)
    if top.varies:
        rows = tailed.by_rows(top.best.theta)
        dispersion = _dispersion(top, first.pixels[full.chosen])
        dispersion *= 1.0 if rows is None else rows.dispersion(dispersion)
    else:
        rows, stated = None, tailed.stated(top.best.theta)
        dispersion = 1.0 if stated is None else stated.shared
    near = _close_to_best(near, full.scale, _LIKELY * dispersion)
    profiles = [top, *(_Profile(comparison.cost(full, fit.hypothesis), fit) for fit in near[1:])]
    reference, unit = min(profile.best.cost for profile in profiles), full.scale**2 * dispersion
    return WindowEvidence(
        peaks={profile.best.hypothesis: profile.peak(reference, unit) for profile in profiles},
        lost=_LIKELY,
        used=int(np.count_nonzero(full.chosen)),
        total=first.count,
        noise_px=full.scale,
        dispersion=dispersion,
        contradicted=rows is not None and rows.contradict,
    )


@dataclass(frozen=True)
class _Comparison:
    """The matches of a window for each motion model, and what is known about the capture."""

    timed: Mapping[str, TimedMatches]
    known: Known

    @property
    def first(self) -> TimedMatches:
        """The matches for the first motion model."""
        return self.timed[self.known.models[0]]

    @property
    def subset(self) -> BoolArray:
        """Mask (count,) of about ``_SCREENED`` evenly spaced measurements."""
        count = self.first.count
        return np.asarray(np.arange(count) % max(count // _SCREENED, 1) == 0)

    def cost(self, likelihood: Likelihood, hypothesis: Hypothesis) -> CaptureCost:
        return CaptureCost(
            self.timed[hypothesis.motion_model], hypothesis, likelihood, self.known.prior(hypothesis)
        )

    def rough_cost(self, hypothesis: Hypothesis, scale: float) -> CaptureCost:
        """The cost over ``subset``, before the distribution of the errors is estimated."""
        return self.cost(Likelihood(nu=_FIRST_NU, scale=scale, chosen=self.subset), hypothesis)

    def screened(self, motion: tuple[FloatArray, FloatArray], lag: Lag) -> list[CaptureFit]:
        """Fits of the scans that the measurements in ``subset`` do not exclude, under the first motion model."""
        known, model = self.known, self.known.models[0]
        start = known.start(Hypothesis(scans=GLOBAL, motion_model=""), 0.0, 0.0)
        theta, found = self.first.packed(GLOBAL, start).theta(*motion), dict[Scans, tuple[CaptureFit, float]]()
        for scans in sorted(known.scans, key=lambda each: (each != GLOBAL, not each.together)):
            if _is_excluded(scans, lag, found):
                continue
            hypothesis = Hypothesis(scans=scans, motion_model=model, delayed=known.delays[-1])
            starts = [(theta, known.start(hypothesis, *first_shutter(scans, lag)))]
            if GLOBAL in found:  # any scans with a small ratio are nearly a global shutter
                still = found[GLOBAL][0]
                starts.append((still.theta, known.start(hypothesis, LEAST_RATIO, float(still.unknowns[DELAY]))))
            fits = (self.fit_at_own_scale(hypothesis, start) for start in starts)
            found[scans] = min(fits, key=lambda each: each[1])
        return self.judged(list(found.values()))[0]

    def of_known_shutter(self, motion: tuple[FloatArray, FloatArray]) -> list[CaptureFit]:
        """The single fit in place of ``screened`` when the shutter is known and only motion models compete."""
        scans = self.known.scans[0]
        hypothesis = Hypothesis(scans=scans, motion_model=self.known.models[0])
        start = self.known.start(hypothesis, 0.0, 0.0)
        theta = self.first.packed(scans, start).theta(*motion)
        return [fit_capture(self.rough_cost(hypothesis, _LARGEST_SCALE), theta, start, iterations=1)]

    def fits_of_each_model(self, fits: Sequence[CaptureFit]) -> tuple[list[CaptureFit], Likelihood] | None:
        """Fits of every motion model with the scans of the given fits, and the best fit's error distribution.

        Each is fitted at its own error scale: at the far smaller scale of another model it would not move.
        """
        found = list[tuple[CaptureFit, float]]()
        for fit, model in product(fits, self.known.models):
            hypothesis = replace(fit.hypothesis, motion_model=model)
            starts = (self.start_from(fit, hypothesis, k) for k in hypothesis.accelerations)
            refitted = (self.fit_at_own_scale(hypothesis, start) for start in starts)
            found.append(min(refitted, key=lambda each: (each[1], each[0].cost)))
        fits, likelihood = self.judged(found)
        return None if likelihood is None else (fits, likelihood)

    def judged(self, found: Sequence[tuple[CaptureFit, float]]) -> tuple[list[CaptureFit], Likelihood | None]:
        """The fits (with error scales, px) close to the best under its error distribution; that distribution."""
        best, scale = min(found, key=lambda each: (each[1], each[0].cost), default=(None, 0.0))
        likelihood = None if best is None else self.distribution(self.subset, best, scale)
        if likelihood is None:
            return [], None
        costs = [self.cost(likelihood, fit.hypothesis)(fit.theta, fit.unknowns) for fit, _ in found]
        fits = [replace(fit, cost=cost) for (fit, _), cost in zip(found, costs, strict=True)]
        return _close_to_best(fits, likelihood.scale, _ROUGH_FACTOR * _CLOSE), likelihood

    def start_from(self, fit: CaptureFit, hypothesis: Hypothesis, k: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Start values of a hypothesis from a fit with the same scans; acceleration ``k`` if the models differ."""
        model, own = hypothesis.motion_model, fit.hypothesis.motion_model
        unknowns = self.known.start(hypothesis, *fit.unknowns[[RATIO, DELAY]])
        unknowns[CALIBRATION] = fit.unknowns[CALIBRATION]
        unknowns[ACCELERATION] = fit.unknowns[ACCELERATION] if model == own else k
        motion = self.timed[own].kernel(fit.unknowns).motion(fit.theta)
        return self.timed[model].kernel(unknowns).theta(*motion), unknowns

    def fit_at_own_scale(
        self, hypothesis: Hypothesis, start: tuple[FloatArray, FloatArray]
    ) -> tuple[CaptureFit, float]:
        """Fit a hypothesis at the scale of its own errors, which falls as the fit improves; and that scale, px.

        A scale far below the errors of a wrong ratio would give the most informative matches the least weight.
        """
        scale, fit = min(self.rough_cost(hypothesis, _LARGEST_SCALE).typical_error(*start), _LARGEST_SCALE), None
        for _ in range(_SCALE_ROUNDS):
            cost = self.rough_cost(hypothesis, scale)
            fit = fit_capture(cost, *start, iterations=6, still=_ROUGHLY)
            start = (fit.theta, fit.unknowns)
            last, scale = scale, min(scale, cost.typical_error(*start))
            if scale > _STEADY * last:
                break
        assert fit is not None
        return fit, scale

    def fitted(self, likelihood: Likelihood, fits: Sequence[CaptureFit]) -> list[CaptureFit]:
        """Refit each hypothesis, with and without a delay of the right camera, from the best of the given fits.

        A fit stops early if it cannot come near the best one.
        """
        out, fits = list[CaptureFit](), sorted(fits, key=lambda fit: fit.cost)
        pairs = dict.fromkeys((fit.hypothesis.scans, fit.hypothesis.motion_model) for fit in fits)
        for (scans, model), delayed in product(pairs, self.known.delays):
            hypothesis = Hypothesis(scans=scans, motion_model=model, delayed=delayed)
            candidates = [f for f in fits if (f.hypothesis.scans, f.hypothesis.motion_model) == (scans, model)]
            start = self.start_from(candidates[0], hypothesis)
            far = min((fit.cost for fit in out), default=np.inf) + _CLOSE * likelihood.scale**2
            cost = self.cost(likelihood, hypothesis)
            out.append(fit_capture(cost, *start, iterations=8, still=_ROUGHLY, hopeless=far))
        return out

    def refitted_to_all(
        self, fits: list[CaptureFit], likelihood: Likelihood
    ) -> tuple[Likelihood, list[CaptureFit]] | None:
        """Refit to all matches under the error distribution of the best fit; that distribution, and sorted fits.

        The error scale falls while the best fit improves or is replaced; fits are excluded only after that.
        """
        scale, everything = likelihood.scale, np.ones(self.first.count, dtype=np.bool_)
        for _ in range(_SCALE_ROUNDS):
            full = self.distribution(everything, min(fits, key=lambda fit: fit.cost), scale)
            if full is None:
                return None
            fits = self.fitted(full, fits)
            if full.scale > _STEADY * scale:
                break
            scale = full.scale
        return full, _close_to_best(fits, full.scale)

    def tailed(self, likelihood: Likelihood, fit: CaptureFit) -> HeavyTailed:
        """The measurements as read for a fit, with the distribution of their errors."""
        read = self.timed[fit.hypothesis.motion_model].read(fit.hypothesis.scans, likelihood.chosen)
        trust = np.ones(read.count) if likelihood.trust is None else likelihood.trust
        packed = vars(read.packed(fit.unknowns))
        return HeavyTailed(**packed, nu=likelihood.nu, scale=likelihood.scale, trust=trust)

    def distribution(self, among: BoolArray, fit: CaptureFit, scale: float) -> Likelihood | None:
        """The error distribution of the matches in ``among`` under one fit, without outliers; None: too few."""
        read = self.timed[fit.hypothesis.motion_model].read(fit.hypothesis.scans, among)
        packed = read.packed(fit.unknowns)
        found = heavy_tailed(packed, fit.theta, scale)
        if found is None:
            return None
        freedom = np.repeat([1.0, 5.0], [len(packed.pairs), len(packed.tracks)])
        chosen = among.copy()
        chosen[among] = each_term(packed, fit.theta).squares / freedom <= (_OUTLIER_SCALES * found.scale) ** 2
        return Likelihood(nu=found.nu, scale=max(found.scale, LEAST_SCALE_PX), chosen=chosen, trust=found.trust)


def _is_excluded(scans: Scans, lag: Lag, found: Mapping[Scans, tuple[CaptureFit, float]]) -> bool:
    """Whether the lag excludes the scans, at all ratios or at all but small ones.

    In the second case they resemble the global shutter and are excluded if other scans fit far better than it.
    """
    most = largest_ratio(scans, lag)
    if most <= 0.0 or most > _SMALL_RATIO or GLOBAL not in found:
        return most <= 0.0
    return min(each for _, each in found.values()) < _FAR_BETTER * found[GLOBAL][1]


def _close_to_best(fits: Sequence[CaptureFit], scale: float, far: float = _CLOSE) -> list[CaptureFit]:
    """The fits whose log-likelihood is at most ``far`` below the best one's, sorted from the best."""
    fits = sorted(fits, key=lambda fit: fit.cost)
    return [fit for fit in fits if fit.cost - fits[0].cost <= far * scale**2]


class _Profile:
    """The cost of a hypothesis near its minimum as a function of the ratio, with all else fitted (its profile)."""

    def __init__(self, cost: CaptureCost, start: CaptureFit) -> None:
        self._cost, self.scale = cost, cost.likelihood.scale
        self.varies = RATIO in cost.free
        free = fit_capture(cost, start.theta, start.unknowns)
        # Fit once more, as the neighbouring ratios are: a less converged centre would bias the curvature.
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
        """Fit a parabola to the costs at the best ratio and at one ratio on either side of it."""
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
        """The peak relative to a reference cost, with ``unit`` px^2 as the variance of the errors."""
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


def _dispersion(slope: _Profile, pixels: FloatArray) -> float:
    """Quotient of the ratio's variance and its variance under independent errors, at least 1.

    Errors are summed over image tiles whose columns and rows have about equally many of the points (n, 2).
    """
    tiles = np.zeros(len(pixels), dtype=np.int64)
    for axis, count in enumerate(_TILES):
        edges = np.quantile(pixels[:, axis], np.arange(1, count) / count)
        tiles = tiles * count + np.searchsorted(edges, pixels[:, axis])
    scores, used = slope.scores(), len(np.unique(tiles))
    together = np.bincount(tiles, weights=scores - np.mean(scores))
    variance = float(np.sum(together**2)) * used / max(used - 1, 1) / slope.curvature
    return max(variance / slope.scale**2, 1.0) * variance_factor(used - 1.0, 1)
