"""Errors with heavier tails than normal ones: weights by the multivariate t, and a covariance that holds.

Features found in noisy images err by some tenths of a pixel, and one in a hundred by more than a pixel. Under a t
distribution of nu degrees of freedom and scale s a measurement of p residuals and squared error q has the weight

    w = (nu + p) / (nu + q / s^2),

so that one far off counts for little, with no threshold. s and nu are those of the largest likelihood. K. Lange,
R. Little, J. Taylor, Robust statistical modeling using the t distribution, JASA 1989.

The weight cannot see a wrong match that bends the motion until its own residual vanishes. What shows it is its
leverage, its share of all that the measurements say (6 in sum); a bounded one keeps the residual visible (Mallows
weights; P. Huber, Robust Statistics, 1981, 7.2: leverages up to 0.2 are safe).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads scipy.special with its first use: as long as all else that a solver needs

from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import Packed, inverse_definite
from rsbench.solvers.engine.per_measurement import Each, each_term

_FEWEST = 30
"""Measurements, five for each parameter: the scatter of fewer says little about their distribution."""
_TAILS = (3.0, 5.0, 10.0, 30.0)
"""Degrees of freedom to choose from: SIFT under photon noise has about 3; 30 is as good as normal."""
_REACH = 10.0
"""Errors, in scales, beyond which a match is wrong: its weight would be below 0.04."""
_SAFE_LEVERAGE, _TIMES_THE_MEAN = 0.2, 3.0
_LEVERAGE_STEPS = 4
_SCALE_STEPS, _SCALE_FLAT = 50, 1e-4
_ONE_SIGMA = 0.5 * (1.0 + math.erf(1.0 / math.sqrt(2.0)))
_LEAST_SLOPE = 0.1
_LEAST_SCALE_PX = 1e-9
_TRACK_FREEDOM, _PAIR_FREEDOM, _PARAMETERS = 5, 1, 6


@dataclass(frozen=True, kw_only=True, eq=False)
class HeavyTailed(Packed):
    """Measurements of one problem, as ``Packed``, with the distribution of their errors."""

    nu: float
    scale: float
    """s, px."""
    trust: FloatArray
    """(n + m,) Mallows weights of the pairs and of the tracks, at most 1."""

    @property
    def freedom(self) -> FloatArray:
        """(n + m,) residuals of each measurement, p."""
        return _freedom(self)

    def weights(self, squares: FloatArray) -> FloatArray:
        """(n + m,) of the measurements in a step that minimises their squared errors."""
        return self.trust * (self.nu + self.freedom) / (self.nu + squares / self.scale**2)

    def slopes(self, squares: FloatArray) -> FloatArray:
        """(n + m,) derivative of weight times residual, on average over the directions of the p residuals."""
        bend = 2.0 * squares / self.freedom / (self.nu * self.scale**2 + squares)
        return self.weights(squares) * (1.0 - bend)

    def normal_equations(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Negative logarithm of the likelihood times s^2, px^2, its gradient (6,) and its Hessian (6, 6).

        Measurements so far off that their part of the Hessian is negative count there by a tenth of their weight.
        """
        each = each_term(self, theta)
        costs = 0.5 * self.trust * (self.nu + self.freedom) * np.log1p(each.squares / (self.nu * self.scale**2))
        weights = self.weights(each.squares)
        gradient = weights @ each.gradients
        H = np.tensordot(np.maximum(self.slopes(each.squares), _LEAST_SLOPE * weights), each.hessians, 1)
        return self.scale**2 * float(np.sum(costs)), gradient, self.held(theta, H)

    def pair_costs(self, theta: FloatArray) -> FloatArray:
        """Twice what each of the pairs (n,) adds to the cost, px^2."""
        squares = self.pair_residuals(theta) ** 2
        trust = self.trust[: len(squares)] * (self.nu + _PAIR_FREEDOM)
        return trust * self.scale**2 * np.log1p(squares / (self.nu * self.scale**2))

    def noise_variance(self, cost: float) -> float:
        """Of a coordinate, px^2, without tails: as of a normal error, two in three are below its root."""
        return (self.scale * float(scipy.special.stdtrit(self.nu, _ONE_SIGMA))) ** 2

    def covariance(self, theta: FloatArray, cost: float, H: FloatArray) -> FloatArray | None:
        """Covariance (6, 6) of theta at the minimum, whatever the distribution of the errors; None for none.

        A^-1 B A^-1 with A the Hessian of the cost and B the sum of g g^T, where g is one measurement's share of
        the gradient (P. Huber, Proc. Fifth Berkeley Symposium, 1967; H. White, Econometrica 1980) divided by
        1 - leverage, for the part of its error that the motion has followed (HC3: J. MacKinnon, H. White,
        J. Econometrics 1985). A track is one measurement: errors that its keypoints share are counted together.
        """
        each = each_term(self, theta)
        weights = self.weights(each.squares)
        bend = 2.0 * weights / (self.nu * self.scale**2 + each.squares)
        A = np.tensordot(weights, each.hessians, 1) - (bend[:, None] * each.gradients).T @ each.gradients
        inverse = inverse_definite(self.held(theta, A))
        if inverse is None:
            return None
        kept = 1.0 - np.minimum(_leverages(self, theta, each, weights), 0.5)
        shares = (weights / kept)[:, None] * each.gradients @ inverse
        return np.asarray(shares.T @ shares)


def heavy_tailed(packed: Packed, theta: FloatArray, scale: float) -> HeavyTailed | None:
    """The distribution that the errors of a motion near the right one show; None of fewer than 30 measurements.

    Args:
        scale: px, of the first guess: measurements beyond 10 of them are wrong.
    """
    each = each_term(packed, theta)
    freedom = _freedom(packed)
    means = each.squares / freedom
    for _ in range(2):
        near = means <= (_REACH * scale) ** 2
        if np.count_nonzero(near) < _FEWEST:
            return None
        nu, scale = _distribution(each.squares[near], freedom[near], scale)
    near = means <= (_REACH * scale) ** 2
    tailed = HeavyTailed(**vars(packed.only(near)), nu=nu, scale=scale, trust=np.ones(np.count_nonzero(near)))
    each = Each(*(part[near] for part in each))
    return replace(tailed, trust=_bounded(tailed, theta, each, tailed.weights(each.squares)))


def _distribution(squares: FloatArray, p: FloatArray, scale: float) -> tuple[float, float]:
    """nu and s of the largest likelihood."""
    found = [(nu, _scale(squares, p, nu, scale)) for nu in _TAILS]
    return max(found, key=lambda tails: _likelihood(squares, p, *tails))


def _freedom(packed: Packed) -> FloatArray:
    return np.repeat([float(_PAIR_FREEDOM), float(_TRACK_FREEDOM)], [len(packed.pairs), len(packed.tracks)])


def _scale(squares: FloatArray, p: FloatArray, nu: float, scale: float) -> float:
    """Of the largest likelihood; the motion has taken six degrees of freedom.

    By the parameter-expanded EM algorithm, in half the steps of the plain one: the mean that weights have in the
    end is known, and a step divides by the one they have (C. Liu, D. Rubin, Y. Wu, Biometrika 1998).
    """
    freedom = max(float(np.sum(p)) - _PARAMETERS, 1.0)
    count = len(p) + (float(np.sum(p)) - freedom) / nu
    for _ in range(_SCALE_STEPS):
        weights = (nu + p) / (nu + squares / scale**2)
        last, scale = scale, float(np.sqrt(weights @ squares / freedom * count / np.sum(weights)))
        scale = max(scale, _LEAST_SCALE_PX)
        if abs(scale - last) <= _SCALE_FLAT * scale:
            break
    return scale


def _likelihood(squares: FloatArray, p: FloatArray, nu: float, scale: float) -> float:
    """Logarithm, without terms that are the same for all nu and scales."""
    gammaln = scipy.special.gammaln
    norm = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(nu * scale**2)
    return float(np.sum(norm - 0.5 * (nu + p) * np.log1p(squares / (nu * scale**2))))


def _leverages(packed: Packed, theta: FloatArray, each: Each, weights: FloatArray) -> FloatArray:
    """(n,) traces of H^-1 H_i: each one's share of the sum H of the H_i; in sum 6, or 5 of one camera."""
    inverse = inverse_definite(packed.held(theta, np.tensordot(weights, each.hessians, 1)))
    if inverse is None:
        return np.zeros(len(weights))
    return weights * (each.hessians.reshape(-1, _PARAMETERS**2) @ inverse.ravel())


def _bounded(packed: Packed, theta: FloatArray, each: Each, weights: FloatArray) -> FloatArray:
    """Factors (n,) up to 1 that bring every leverage to 0.2, or to three times the mean where data are few."""
    bound = min(max(_SAFE_LEVERAGE, _TIMES_THE_MEAN * _PARAMETERS / max(len(weights), 1)), 0.9)
    factors = np.ones(len(weights))
    for _ in range(_LEVERAGE_STEPS):
        share = np.minimum(_leverages(packed, theta, each, factors * weights), 0.999)
        high = share > bound
        if not np.any(high):
            break
        # One measurement against all others: its odds are in proportion to its weight.
        factors[high] *= bound / (1.0 - bound) * (1.0 - share[high]) / share[high]
    return factors
