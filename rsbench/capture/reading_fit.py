"""How well one reading of the cameras explains matches: motion, readout ratio and delay of the largest likelihood.

The six parameters of the motion and those of the shutter are found together by Newton's method. The motion's part
of the equations is compiled; the shutter's, of which there are two, is differences of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.capture.scan_reading import Reading, TimedMatches
from rsbench.core.correspondences import BoolArray
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.heavy_tails import HeavyTailed

LEAST_RATIO = 0.05
"""Readout ratios below this are taken for a global shutter's."""
BEYOND_RATIO = 1.2
"""No ratio is beyond 1, but the top of what noise makes of one near 1 may be."""
DELAY_SIGMA = 0.3
"""Frame periods by which a right camera is late or early: what is expected before the matches are seen."""
_MAX_TRANSLATION_M = 50.0
_DIFFERENCE = 0.002
"""A time that moves points by a fraction of their noise, far above rounding."""
_LEAST, _MOST = np.array([LEAST_RATIO, -1.0]), np.array([BEYOND_RATIO, 1.0])
"""Of ratio and delay."""
_LONGEST_STEP = 0.4
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-8, 1e6
"""A motion makes up for most of a wrong ratio: more damping than this would hold the ratio where it is."""
_MOTION = 6
_MEDIAN, _LEAST_SCALE_PX = 0.6, 0.02
"""Median of squared normal errors, one or five together; and what exact matches are taken for."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Likelihood:
    """Which measurements count, and the distribution of their errors (``heavy_tails``)."""

    nu: float
    scale: float
    """px."""
    chosen: BoolArray
    """(n + m,) of the pairs and tracks."""
    trust: FloatArray | None = None
    """Weights of the chosen ones; None: 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadingFit:
    """The best parameters under one reading."""

    reading: Reading
    theta: FloatArray
    """(6,) of the motion."""
    shutter: FloatArray
    """(2,) readout ratio, 0 of a global reading, and delay."""
    cost: float
    """Negative logarithm of likelihood and prior, times the squared scale, px^2."""
    delay_sigma: float
    """Standard deviation of the delay at this ratio."""


class ReadingCost:
    """The cost of one reading as a function of motion and shutter."""

    def __init__(self, matches: TimedMatches, reading: Reading, likelihood: Likelihood) -> None:
        self.reading, self.likelihood = reading, likelihood
        self._matches = matches.subset(likelihood.chosen)
        self._prior = (likelihood.scale / DELAY_SIGMA) ** 2
        count = self._matches.count
        self._trust = np.ones(count) if likelihood.trust is None else likelihood.trust

    def tailed(self, shutter: FloatArray) -> HeavyTailed:
        """The measurements at some shutter."""
        packed = self._matches.packed(self.reading, *shutter)
        return HeavyTailed(**vars(packed), nu=self.likelihood.nu, scale=self.likelihood.scale, trust=self._trust)

    def each(self, theta: FloatArray, shutter: FloatArray) -> FloatArray:
        """(n,) what each measurement adds."""
        tailed = self.tailed(shutter)
        squares = np.concatenate([tailed.pair_residuals(theta) ** 2, tailed.track_squares(theta)])
        factor = 0.5 * tailed.scale**2 * tailed.trust * (tailed.nu + tailed.freedom)
        return np.asarray(factor * np.log1p(squares / (tailed.nu * tailed.scale**2)))

    def typical_error(self, theta: FloatArray, shutter: FloatArray) -> float:
        """Scale of the errors, px, that their median shows: up to half of them may be wrong."""
        tailed = self.tailed(shutter)
        squares = np.concatenate([tailed.pair_residuals(theta) ** 2, tailed.track_squares(theta)])
        return max(float(np.sqrt(np.median(squares / tailed.freedom) / _MEDIAN)), _LEAST_SCALE_PX)

    def __call__(self, theta: FloatArray, shutter: FloatArray) -> float:
        return float(np.sum(self.each(theta, shutter))) + 0.5 * self._prior * float(shutter[1]) ** 2

    def local(self, theta: FloatArray, shutter: FloatArray, free: list[int]) -> tuple[FloatArray, FloatArray]:
        """Gradient and Hessian by theta and the free ones of the shutter, these by differences."""
        at, by_theta, H_theta = self.tailed(shutter).normal_equations(theta)
        size = _MOTION + len(free)
        gradient, H, ahead = np.zeros(size), np.zeros((size, size)), 0.0
        gradient[:_MOTION], H[:_MOTION, :_MOTION] = by_theta, H_theta
        for k, j in enumerate(free, start=_MOTION):
            step = _DIFFERENCE * (np.arange(2) == j)
            above, g_above, _ = self.tailed(shutter + step).normal_equations(theta)
            below = float(np.sum(self.each(theta, shutter - step)))
            gradient[k] = (above - below) / (2.0 * _DIFFERENCE)
            H[k, k] = (above - 2.0 * at + below) / _DIFFERENCE**2
            H[:_MOTION, k] = H[k, :_MOTION] = (g_above - by_theta) / _DIFFERENCE
            ahead += above - at
        if len(free) == 2:
            both = float(np.sum(self.each(theta, shutter + _DIFFERENCE)))
            H[-1, -2] = H[-2, -1] = (both - at - ahead) / _DIFFERENCE**2
        gradient[-1] += self._prior * shutter[1]
        H[-1, -1] += self._prior
        return gradient, H


def fit_reading(
    cost: ReadingCost,
    theta: FloatArray,
    shutter: FloatArray,
    *,
    iterations: int = 20,
    still: float = 1e-4,
    hold_ratio: bool = False,
) -> ReadingFit:
    """Newton's method, damped, from a start (6,), (2,).

    Args:
        still: decrease of the cost, in squared scales of the errors, at which to stop.
        hold_ratio: whether the ratio stays as it is.
    """
    rolls = cost.reading.rolls
    free = [0, 1] if rolls and not hold_ratio else [1]
    shutter = _within(shutter * (1.0 if rolls else (0.0, 1.0)), free)
    now, damping = cost(theta, shutter), _LEAST_DAMPING
    gradient, H = cost.local(theta, shutter, free)
    for _ in range(iterations):
        before = now
        while damping < _LARGEST_DAMPING:
            moved = _stepped(gradient, H, theta, shutter, free, damping)
            trial = cost(*moved)
            if trial <= now:
                (theta, shutter), now = moved, trial
                damping = max(0.1 * damping, _LEAST_DAMPING)
                break
            damping *= 10.0
        if before - now < still * cost.likelihood.scale**2:
            break
        gradient, H = cost.local(theta, shutter, free)
    return ReadingFit(
        reading=cost.reading,
        theta=theta,
        shutter=shutter,
        cost=now,
        delay_sigma=cost.likelihood.scale * float(np.sqrt(max(np.linalg.pinv(H, hermitian=True)[-1, -1], 0.0))),
    )


def _stepped(
    gradient: FloatArray, H: FloatArray, theta: FloatArray, shutter: FloatArray, free: list[int], damping: float
) -> tuple[FloatArray, FloatArray]:
    """Where a damped Newton step leads; a shutter at its limit stays there."""
    moves = np.ones(len(gradient), dtype=np.bool_)
    for k, j in enumerate(free, start=_MOTION):
        outwards = -gradient[k]
        moves[k] = not (
            (shutter[j] <= _LEAST[j] and outwards < 0.0) or (shutter[j] >= _MOST[j] and outwards > 0.0)
        )
    A, g = H[np.ix_(moves, moves)], gradient[moves]
    size = np.sqrt(np.maximum(np.abs(np.diagonal(A)), 1e-12 * np.abs(A).max()) + 1e-300)
    values, vectors = np.linalg.eigh(A / np.outer(size, size))
    values = np.maximum(np.abs(values), 1e-9) + damping  # downhill, whatever the curvature
    step = np.zeros(len(gradient))
    step[moves] = -(vectors @ ((vectors.T @ (g / size)) / values)) / size
    theta, shutter = theta + step[:_MOTION], shutter.copy()
    shutter[free] += np.clip(step[_MOTION:], -_LONGEST_STEP, _LONGEST_STEP)
    length = float(np.linalg.norm(theta[3:]))
    theta[3:] *= min(1.0, _MAX_TRANSLATION_M / max(length, _MAX_TRANSLATION_M))
    return theta, _within(shutter, free)


def _within(shutter: FloatArray, free: list[int]) -> FloatArray:
    """With those that are free within their limits."""
    out = shutter.copy()
    out[free] = np.clip(shutter[free], _LEAST[free], _MOST[free])
    return out
