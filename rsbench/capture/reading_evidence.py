"""Readings compared on the matches of one window: what each leaves of the errors, and how sharply."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from rsbench.capture.reading_fit import (
    BEYOND_RATIO,
    LEAST_RATIO,
    Likelihood,
    ReadingCost,
    ReadingFit,
    fit_reading,
)
from rsbench.capture.reading_start import Lag, first_shutter
from rsbench.capture.scan_reading import GLOBAL, READINGS, Reading, TimedMatches
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.heavy_tails import heavy_tailed
from rsbench.solvers.engine.per_measurement import each_term

_SCREENED = 160
"""Measurements by which most readings are put aside."""
_CLOSE = 30.0
"""Differences of the logarithm of the likelihood beyond which a reading is put aside after that."""
_MOST_SCALE, _FIRST_NU = 10.0, 4.0
"""Scale of the errors, px, at most, and their tails, before their distribution is found."""
_FALLS, _STEADY = 10, 0.9
_UNSETTLED = 5.0
"""Times as far off as that a reading may be before it is fitted at the scale of the best one."""
_ROUGHLY = 1e-2
"""Of the squared scale: a decrease of the cost at which the screening stops."""
_REACH = 10.0
"""As in ``heavy_tails``."""
_TILES = (6, 4)
"""Columns and rows of tiles in which matches may err together."""
_FIRST_REACH, _MOST_REACH, _LEAST_REACH = 0.02, 0.05, 0.001
"""Differences of the ratio by which the sharpness of a maximum is measured: about two deviations."""
_ROUNDS = 5
_WIDE = 1.0
"""Standard deviation of a ratio of which the matches say nothing."""


@dataclass(frozen=True, kw_only=True)
class Peak:
    """Log-likelihood of a ratio, motion and delay fitted: value - information (ratio - at)^2 / 2."""

    value: float
    at: float
    """Where the parabola has its top, which may lie outside of what is possible; 0 of the global reading."""
    information: float
    """0 of the global reading."""
    delay: float
    delay_sigma: float

    @property
    def sigma(self) -> float:
        """Standard deviation of the ratio."""
        return float(self.information**-0.5) if self.information > 0.0 else 0.0

    @property
    def log_evidence(self) -> float:
        """Integral over ratios from ``LEAST_RATIO`` to 1, uniform before; the value of the global reading."""
        if self.information == 0.0:
            return self.value
        ends = (np.array([LEAST_RATIO, 1.0]) - self.at) / self.sigma
        if ends[0] > 0.0:  # so that neither logarithm is that of nearly 1
            ends = -ends[::-1]
        low, high = scipy.special.log_ndtr(ends)
        mass = high + np.log1p(-np.exp(min(low - high, -1e-12)))
        return self.value + float(
            0.5 * np.log(2.0 * np.pi) + np.log(self.sigma) + mass - np.log(1.0 - LEAST_RATIO)
        )


Hypothesis = tuple[str, Reading]
"""A motion model and a reading."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WindowEvidence:
    """What the matches of two times say of all readings under all motion models."""

    peaks: Mapping[Hypothesis, Peak]
    used: int
    """Measurements that count: not so far off that they must be wrong."""
    of: int
    noise_px: float
    dispersion: float
    """Factor on all variances, for matches of one part of the image that err together."""


def window_evidence(
    matches: Correspondences,
    rig: StereoRig,
    motion_models: Sequence[str],
    motion: tuple[FloatArray, FloatArray],
    lag: Lag,
) -> WindowEvidence | None:
    """All readings under all models, on matches with outliers, from a motion near the right one.

    Most readings are put aside by some of the matches, under the first model. None for too few matches.
    """
    timed = {model: TimedMatches(matches, rig, model) for model in motion_models}
    first = timed[motion_models[0]]
    screened = _screened(first, motion, lag)
    if screened is None:
        return None
    fits, likelihood, lost = screened
    close = {reading: fit for reading, fit in fits.items() if reading not in lost}
    best = min(close.values(), key=lambda fit: fit.cost)
    full = _distribution(first, np.ones(first.count, dtype=np.bool_), best, likelihood.scale)
    if full is None:
        return None
    slopes = {
        (model, reading): _Slope(ReadingCost(timed[model], reading, full), fit)
        for model in motion_models
        for reading, fit in close.items()
    }
    least = min(slope.best.cost for slope in slopes.values())
    rolling = [slope for (_, reading), slope in slopes.items() if reading.rolls]
    sharp = min(rolling, key=lambda slope: slope.best.cost, default=None)
    dispersion = 1.0 if sharp is None else _dispersion(sharp, first.pixels[full.chosen])
    peaks = {key: slope.peak(least, full.scale**2 * dispersion) for key, slope in slopes.items()}
    for model, (reading, value) in product(motion_models, lost.items()):
        at = float(fits[reading].shutter[0])
        peaks[model, reading] = Peak(value=-value, at=at, information=1.0, delay=0.0, delay_sigma=1.0)
    return WindowEvidence(
        peaks=peaks,
        used=int(np.count_nonzero(full.chosen)),
        of=first.count,
        noise_px=full.scale,
        dispersion=dispersion,
    )


def _screened(
    timed: TimedMatches, motion: tuple[FloatArray, FloatArray], lag: Lag
) -> tuple[dict[Reading, ReadingFit], Likelihood, dict[Reading, float]] | None:
    """Every reading on some of the matches, and what those put aside lack (``_far``)."""
    some = np.arange(timed.count) % max(timed.count // _SCREENED, 1) == 0
    theta = timed.packed(GLOBAL, 0.0, 0.0).theta(*motion)
    found = {GLOBAL: _settled(timed, some, _start(GLOBAL, theta, first_shutter(GLOBAL, lag)))}
    still = found[GLOBAL][0]
    for reading in READINGS[1:]:
        starts = [_start(reading, theta, first_shutter(reading, lag)), _start(reading, still.theta, still.shutter)]
        # The second is nearly the global one, which any reading with a small ratio is.
        found[reading] = min((_settled(timed, some, start) for start in starts), key=lambda each: each[1])
    scale = min(each for _, each in found.values())
    best = min((fit for fit, each in found.values() if each == scale), key=lambda fit: fit.cost)
    likelihood = _distribution(timed, some, best, scale)
    if likelihood is None:
        return None
    fits = {
        reading: replace(fit, cost=ReadingCost(timed, reading, likelihood)(fit.theta, fit.shutter))
        for reading, (fit, _) in found.items()
    }
    lost = _far(fits, likelihood.scale, _UNSETTLED * _CLOSE)
    fits |= _again(timed, likelihood, [fit for fit in fits.values() if fit.reading not in lost])
    return fits, likelihood, lost | _far(fits, likelihood.scale, _CLOSE)


def _settled(timed: TimedMatches, some: BoolArray, fit: ReadingFit) -> tuple[ReadingFit, float]:
    """A reading at the scale of its own errors, which falls as it is fitted better; and that scale, px.

    At a scale far below the errors that a wrong ratio leaves, matches would count the less the more they tell.
    """
    cost = ReadingCost(timed, fit.reading, Likelihood(nu=_FIRST_NU, scale=_MOST_SCALE, chosen=some))
    scale = min(cost.typical_error(fit.theta, fit.shutter), _MOST_SCALE)
    for _ in range(_FALLS):
        cost = ReadingCost(timed, fit.reading, Likelihood(nu=_FIRST_NU, scale=scale, chosen=some))
        fit = fit_reading(cost, fit.theta, fit.shutter, iterations=6, still=_ROUGHLY)
        last, scale = scale, min(scale, cost.typical_error(fit.theta, fit.shutter))
        if scale > _STEADY * last:
            break
    return fit, scale


def _far(fits: Mapping[Reading, ReadingFit], scale: float, far: float) -> dict[Reading, float]:
    """Log-likelihood, below the best one's, of the readings that are put aside; never of the global one."""
    least = min(fit.cost for fit in fits.values())
    below = {reading: (fit.cost - least) / scale**2 for reading, fit in fits.items() if reading != GLOBAL}
    return {reading: value for reading, value in below.items() if value > far}


def _start(reading: Reading, theta: FloatArray, shutter: FloatArray) -> ReadingFit:
    return ReadingFit(reading=reading, theta=theta, shutter=shutter, cost=np.inf, delay_sigma=np.inf)


def _again(timed: TimedMatches, likelihood: Likelihood, fits: Iterable[ReadingFit]) -> dict[Reading, ReadingFit]:
    return {
        fit.reading: fit_reading(
            ReadingCost(timed, fit.reading, likelihood), fit.theta, fit.shutter, iterations=8, still=_ROUGHLY
        )
        for fit in fits
    }


def _distribution(timed: TimedMatches, among: BoolArray, fit: ReadingFit, scale: float) -> Likelihood | None:
    """Of the errors under one fit, of the chosen matches that are not wrong."""
    packed = timed.subset(among).packed(fit.reading, *fit.shutter)
    found = heavy_tailed(packed, fit.theta, scale)
    if found is None:
        return None
    freedom = np.repeat([1.0, 5.0], [len(packed.pairs), len(packed.tracks)])
    chosen = among.copy()
    chosen[among] = each_term(packed, fit.theta).squares / freedom <= (_REACH * found.scale) ** 2
    return Likelihood(nu=found.nu, scale=found.scale, chosen=chosen, trust=found.trust)


class _Slope:
    """The cost of a reading about its minimum, as a function of the ratio, motion and delay fitted to each."""

    def __init__(self, cost: ReadingCost, start: ReadingFit) -> None:
        self._cost, self.scale = cost, cost.likelihood.scale
        free = fit_reading(cost, start.theta, start.shutter)
        # Once more as those beside it are found, or a start that is less settled than they looks like a valley.
        self.best = fit_reading(cost, free.theta, free.shutter, hold_ratio=True)
        self.least, self.at, self.curvature = self.best.cost, 0.0, 0.0
        self._beside: tuple[ReadingFit, ReadingFit] = (self.best, self.best)
        if not cost.reading.rolls:
            return
        reach = _FIRST_REACH
        for _ in range(_ROUNDS):
            self._measure(reach)
            sigma = cost.likelihood.scale / np.sqrt(max(self.curvature, 1e-12))
            away = float(np.clip(self.at, LEAST_RATIO, BEYOND_RATIO)) - self.best.shutter[0]
            fits = 0.5 * reach <= 2.0 * sigma <= 2.0 * reach or reach in (_LEAST_REACH, _MOST_REACH)
            if fits and abs(away) <= reach:
                break
            if abs(away) > reach:
                self.best = self._held(self.best.shutter[0] + away)
            reach = float(np.clip(2.0 * sigma, _LEAST_REACH, _MOST_REACH))

    def _measure(self, reach: float) -> None:
        """Top and curvature of the parabola through three ratios, the best one and one on either side of it."""
        ratio = float(self.best.shutter[0])
        below, above = self._beside = (self._held(ratio - reach), self._held(ratio + reach))
        slope = (above.cost - below.cost) / (2.0 * reach)
        curvature = (above.cost - 2.0 * self.best.cost + below.cost) / reach**2
        self.curvature = max(float(curvature), 1e-9)
        away = float(np.clip(-slope / self.curvature, -_WIDE, _WIDE)) if curvature > 0.0 else 0.0
        self.at = ratio + away
        self.least = self.best.cost - 0.5 * self.curvature * away**2

    def _held(self, ratio: float) -> ReadingFit:
        shutter = np.array([ratio, self.best.shutter[1]])
        return fit_reading(self._cost, self.best.theta, shutter, hold_ratio=True)

    def peak(self, reference: float, unit: float) -> Peak:
        """In units of the errors' variance, px^2."""
        information = self.curvature / unit + 1.0 / _WIDE**2 if self._cost.reading.rolls else 0.0
        return Peak(
            value=(reference - self.least) / unit,
            at=self.at,
            information=information,
            delay=float(self.best.shutter[1]),
            delay_sigma=self.best.delay_sigma * float(np.sqrt(unit)) / self._cost.likelihood.scale,
        )

    def scores(self) -> FloatArray:
        """(n,) derivative of each measurement's cost by the ratio."""
        low, high = self._beside
        costs = [self._cost.each(fit.theta, fit.shutter) for fit in (low, high)]
        return (costs[1] - costs[0]) / float(high.shutter[0] - low.shutter[0])


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


def combined(windows: Sequence[WindowEvidence]) -> dict[Hypothesis, Peak]:
    """The peaks of several windows of one rig, multiplied; their scatter counts where they say less."""
    return {key: _product([window.peaks[key] for window in windows]) for key in windows[0].peaks}


def _product(peaks: Sequence[Peak]) -> Peak:
    if len(peaks) == 1:
        return peaks[0]
    at, information, lost = 0.0, 0.0, 0.0
    if peaks[0].information > 0.0:
        weights, places = np.array([peak.information for peak in peaks]), np.array([peak.at for peak in peaks])
        information = float(np.sum(weights))
        at = float(weights @ places) / information
        lost = 0.5 * float(weights @ (places - at) ** 2)
        information /= max(2.0 * lost / (len(peaks) - 1), 1.0)
    precisions = np.array([peak.delay_sigma for peak in peaks]) ** -2.0
    return Peak(
        value=sum(peak.value for peak in peaks) - lost,
        at=at,
        information=information,
        delay=float(precisions @ [peak.delay for peak in peaks] / np.sum(precisions)),
        delay_sigma=float(np.sum(precisions) ** -0.5),
    )
