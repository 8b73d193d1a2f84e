"""Motion and shutter of largest likelihood under one hypothesis of how the cameras read and how the rig moves.

The six parameters of the motion and the unknowns of the capture are found together by Newton's method, from
compiled equations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsbench.capture.calibration_errors import STRETCHING
from rsbench.capture.hypotheses import ACCELERATION, CALIBRATION, LEAST_RATIO, RATIO, UNKNOWNS, Hypothesis
from rsbench.capture.scans import TimedMatches
from rsbench.core.correspondences import BoolArray
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.any_law import any_law
from rsbench.solvers.engine.capture_terms import add_pairs, add_tracks
from rsbench.solvers.engine.heavy_tails import HeavyTailed

BEYOND_RATIO = 1.2
"""No ratio is beyond 1, but the top of what noise makes of one near 1 may be."""
_MAX_TRANSLATION_M = 50.0
_LEAST = np.array([LEAST_RATIO, -1.0, -0.45, *10 * [-50.0], *3 * [-2.0], -0.4])
_MOST = np.array([BEYOND_RATIO, 1.0, 3.0, *10 * [50.0], *3 * [2.0], 0.4])
_LONGEST_STEP = np.array([0.4, 0.4, 0.3, 2.0, *9 * [20.0], *3 * [0.2], 0.1])
_LEAST_DAMPING, _LARGEST_DAMPING = 1e-8, 1e6
"""A motion makes up for most of a wrong ratio: more damping than this would hold the ratio where it is."""
_MOTION = 6
_STRETCHING = tuple(CALIBRATION.start + term for term in STRETCHING)
_STEP = 1e-7
_OVER = 5.0
"""Times Newton's prediction that a cost may fall, at most."""
_MEDIAN, LEAST_SCALE_PX = 0.6, 0.005
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
class CaptureFit:
    """The best parameters under one hypothesis."""

    hypothesis: Hypothesis
    theta: FloatArray
    """(6,) of the motion."""
    unknowns: FloatArray
    """(17,)."""
    cost: float
    """Negative logarithm of likelihood and prior, times the squared scale, px^2."""
    sigma: FloatArray
    """(17,) standard deviations of the unknowns; the ratio's is 0 where it was held."""
    spread: FloatArray
    """(6, 6) what not knowing them, but for a ratio that was held, adds to the covariance of theta."""
    occam: float
    """Logarithm of the volume of the posterior of the unknowns beside the ratio over that of their prior."""


class CaptureCost:
    """The cost of one hypothesis as a function of the motion and the unknowns.

    Args:
        prior: (17,) standard deviations of the unknowns about 0; 0 holds an unknown where it starts, and infinity
            says nothing of it.
    """

    def __init__(
        self, matches: TimedMatches, hypothesis: Hypothesis, likelihood: Likelihood, prior: FloatArray
    ) -> None:
        self.hypothesis, self.likelihood, self.prior = hypothesis, likelihood, prior
        self._matches = matches.read(hypothesis.scans, likelihood.chosen)
        self.free = [k for k in range(UNKNOWNS) if prior[k] > 0.0]
        self._weight = np.zeros(UNKNOWNS)
        self._weight[self.free] = (likelihood.scale / prior[self.free]) ** 2
        count = self._matches.count
        self._trust = np.ones(count) if likelihood.trust is None else likelihood.trust

    def tailed(self, unknowns: FloatArray) -> HeavyTailed:
        """The measurements at some unknowns (17,)."""
        packed = self._matches.packed(unknowns)
        return HeavyTailed(**vars(packed), nu=self.likelihood.nu, scale=self.likelihood.scale, trust=self._trust)

    def each(self, theta: FloatArray, unknowns: FloatArray) -> FloatArray:
        """(n,) what each measurement adds."""
        tailed = self.tailed(unknowns)
        squares = _squares(tailed, theta)
        factor = 0.5 * tailed.scale**2 * tailed.trust * (tailed.nu + tailed.freedom)
        return np.asarray(factor * np.log1p(squares / (tailed.nu * tailed.scale**2)))

    def typical_error(self, theta: FloatArray, unknowns: FloatArray) -> float:
        """Scale of the errors, px, that their median shows: up to half of them may be wrong."""
        tailed = self.tailed(unknowns)
        squares = _squares(tailed, theta)
        return max(float(np.sqrt(np.median(squares / tailed.freedom) / _MEDIAN)), LEAST_SCALE_PX)

    def __call__(self, theta: FloatArray, unknowns: FloatArray) -> float:
        return float(np.sum(self.each(theta, unknowns))) + 0.5 * float(self._weight @ unknowns**2)

    def local(
        self, theta: FloatArray, unknowns: FloatArray, free: list[int]
    ) -> tuple[float, FloatArray, FloatArray]:
        """The cost, its gradient and its Hessian by theta and the free unknowns."""
        packed, size = self._matches.packed(unknowns), _MOTION + len(free)
        by = self._matches.derivatives(packed, float(unknowns[ACCELERATION]), free)
        tails, trust = np.array([self.likelihood.nu, self.likelihood.scale]), self._trust
        gradient, H, n = np.zeros(size), np.zeros((size, size)), len(packed.pairs)
        at, focal, baseline = (theta, any_law(packed.kernel)), packed.focal, packed.baseline
        cost = add_pairs(*at, packed.pairs, by[0], focal, tails, trust[:n], gradient, H)
        cost += add_tracks(*at, packed.tracks, by[1], focal, baseline, tails, trust[n:], gradient, H)
        for unknown in set(_STRETCHING) & set(free):  # by which the same errors of rays are more pixels, too
            ahead = float(np.sum(self.each(theta, unknowns + _STEP * np.eye(UNKNOWNS)[unknown])))
            gradient[_MOTION + free.index(unknown)] = (ahead - cost) / _STEP  # finds it to half a step
        gradient[_MOTION:] += self._weight[free] * unknowns[free]
        H[range(_MOTION, size), range(_MOTION, size)] += self._weight[free]
        return cost + 0.5 * float(self._weight @ unknowns**2), gradient, H


def _squares(tailed: HeavyTailed, theta: FloatArray) -> FloatArray:
    return np.concatenate([tailed.pair_residuals(theta) ** 2, tailed.track_squares(theta)])


def fit_capture(
    cost: CaptureCost,
    theta: FloatArray,
    unknowns: FloatArray,
    *,
    iterations: int = 20,
    still: float = 1e-4,
    hold_ratio: bool = False,
    hopeless: float = np.inf,
) -> CaptureFit:
    """Newton's method, damped, from a start (6,), (17,).

    Args:
        still: decrease of the cost, in squared scales of the errors, at which to stop.
        hold_ratio: whether the ratio stays as it is.
        hopeless: cost that must come within reach, or it is given up: then the cost is above this.
    """
    free = [k for k in cost.free if k != RATIO or not hold_ratio]
    unknowns = _within(unknowns, free)
    damping = _LEAST_DAMPING
    now, gradient, H = cost.local(theta, unknowns, free)
    for _ in range(iterations):
        before, newton = now, _Newton(gradient, H, unknowns, free)
        if now - _OVER * newton.gain > hopeless:
            break
        while damping < _LARGEST_DAMPING:
            moved = newton.stepped(theta, damping)
            trial = cost.local(*moved, free)
            if trial[0] <= now:
                (theta, unknowns), (now, gradient, H) = moved, trial
                damping = max(0.1 * damping, _LEAST_DAMPING)
                break
            damping = max(10.0 * damping, 1e-4)
        if before - now < still * cost.likelihood.scale**2:
            break
    sigma = np.zeros(UNKNOWNS)
    whole = cost.likelihood.scale**2 * np.linalg.pinv(H, hermitian=True)
    covariance, shared = whole[_MOTION:, _MOTION:], whole[:_MOTION, _MOTION:]
    sigma[free] = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    others = [k for k, j in enumerate(free) if j != RATIO]
    values = np.linalg.eigvalsh(covariance[np.ix_(others, others)]) if others else np.zeros(0)
    volume = 0.5 * float(np.sum(np.log(np.maximum(values, 1e-30))))
    return CaptureFit(
        hypothesis=cost.hypothesis,
        theta=theta,
        unknowns=unknowns,
        cost=now,
        sigma=sigma,
        spread=shared @ np.linalg.pinv(covariance, hermitian=True) @ shared.T,
        occam=volume - float(np.sum(np.log(cost.prior[[free[k] for k in others]]))),
    )


class _Newton:
    """Newton's step from one place; an unknown at its limit stays there."""

    def __init__(self, gradient: FloatArray, H: FloatArray, unknowns: FloatArray, free: list[int]) -> None:
        self._moves = np.ones(len(gradient), dtype=np.bool_)
        for k, j in enumerate(free, start=_MOTION):
            outwards = -gradient[k]
            self._moves[k] = not (
                (unknowns[j] <= _LEAST[j] and outwards < 0.0) or (unknowns[j] >= _MOST[j] and outwards > 0.0)
            )
        A, g = H[np.ix_(self._moves, self._moves)], gradient[self._moves]
        self._size = np.sqrt(np.maximum(np.abs(np.diagonal(A)), 1e-12 * np.abs(A).max()) + 1e-300)
        values, self._vectors = np.linalg.eigh(A / np.outer(self._size, self._size))
        self._values = np.maximum(np.abs(values), 1e-9)  # downhill, whatever the curvature
        self._slopes = self._vectors.T @ (g / self._size)
        self._unknowns, self._free = unknowns, free

    @property
    def gain(self) -> float:
        """By how much the cost would fall, if it were as here everywhere."""
        return 0.5 * float(np.sum(self._slopes**2 / self._values))

    def stepped(self, theta: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Where a damped step leads."""
        step = np.zeros(len(self._moves))
        step[self._moves] = -(self._vectors @ (self._slopes / (self._values + damping))) / self._size
        theta, unknowns, free = theta + step[:_MOTION], self._unknowns.copy(), self._free
        unknowns[free] += np.clip(step[_MOTION:], -_LONGEST_STEP[free], _LONGEST_STEP[free])
        length = float(np.linalg.norm(theta[3:]))
        theta[3:] *= min(1.0, _MAX_TRANSLATION_M / max(length, _MAX_TRANSLATION_M))
        return theta, _within(unknowns, free)


def _within(unknowns: FloatArray, free: list[int]) -> FloatArray:
    """With those that are free within their limits."""
    out = unknowns.copy()
    out[free] = np.clip(unknowns[free], _LEAST[free], _MOST[free])
    return out
