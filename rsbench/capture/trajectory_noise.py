"""How tracks err: tails and scale of largest likelihood, and which tracks are right."""

from __future__ import annotations

import numpy as np
import scipy

from rsbench.capture.trajectory_kernels import Tails
from rsbench.core.so3 import FloatArray

_TAILS = (3.0, 5.0, 10.0, 30.0)
"""Degrees of freedom to choose from, as in ``heavy_tails``."""
REACH = 10.0
"""Errors, in scales, beyond which a track is wrong."""
LEAST_SCALE_PX = 1e-3


def observed(squares: FloatArray, freedom: FloatArray, tails: Tails, used: float) -> tuple[Tails, FloatArray]:
    """Distribution of errors, and which tracks (n,) are right, 1 or 0.

    Args:
        used: degrees of freedom that the trajectory has taken.
    """
    scale = tails.scale
    near = squares <= freedom * (REACH * scale) ** 2
    if not np.any(near):
        return tails, np.ones(len(squares))
    q, p = squares[near], freedom[near]
    left = max(float(np.sum(p)) - used, 0.1 * float(np.sum(p)))
    found = [Tails(nu, _scale(q, p, nu, scale, left)) for nu in _TAILS]
    best = max(found, key=lambda each: _likelihood(q, p, each))
    return best, (squares <= freedom * (REACH * best.scale) ** 2).astype(np.float64)


def _scale(q: FloatArray, p: FloatArray, nu: float, scale: float, left: float) -> float:
    """Of the largest likelihood (parameter-expanded EM, see ``heavy_tails``)."""
    count = len(p) + (float(np.sum(p)) - left) / nu
    for _ in range(50):
        weights = (nu + p) / (nu + q / scale**2)
        last, scale = scale, max(float(np.sqrt(weights @ q / left * count / np.sum(weights))), LEAST_SCALE_PX)
        if abs(scale - last) <= 1e-4 * scale:
            break
    return scale


def _likelihood(q: FloatArray, p: FloatArray, tails: Tails) -> float:
    """Logarithm, without terms that are the same for all."""
    nu, scale = tails
    gammaln = scipy.special.gammaln
    norm = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(nu * scale**2)
    return float(np.sum(norm - 0.5 * (nu + p) * np.log1p(q / (nu * scale**2))))
