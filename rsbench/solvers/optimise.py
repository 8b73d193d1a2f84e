"""Levenberg-Marquardt on six parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rsbench.core.so3 import FloatArray

Evaluate = Callable[[FloatArray], tuple[float, FloatArray, FloatArray]]


class Minimum(NamedTuple):
    """Where a descent ended."""

    theta: FloatArray
    cost: float
    H: FloatArray
    """Gauss-Newton Hessian at the end."""


def levenberg_marquardt(
    evaluate: Evaluate,
    theta: FloatArray,
    iterations: int,
    limit: float,
    tolerance: float = 1e-12,
) -> Minimum:
    """Minimise ``evaluate(theta) -> (cost, gradient, Hessian)``.

    Args:
        theta: (6,) start.
        iterations: most evaluations.
        limit: largest length of theta[3:]: without it, an unobservable scale runs to infinity.
        tolerance: relative change at which to stop.
    """
    theta = _clamped(theta, limit)
    cost, gradient, H = evaluate(theta)
    damping = 1e-4
    for _ in range(iterations):
        diagonal = np.diagonal(H)
        scale = np.sqrt(np.maximum(diagonal, 1e-12 * np.max(diagonal)) + 1e-300)
        A = H / np.outer(scale, scale)
        A[np.diag_indices(6)] += damping
        step = -np.linalg.solve(A, gradient / scale) / scale
        trial = _clamped(theta + step, limit)
        if not np.all(np.isfinite(trial)):
            break
        trial_cost, trial_gradient, trial_H = evaluate(trial)
        moved = np.abs(trial - theta)
        small = np.all(moved[:3] <= tolerance) and np.all(
            moved[3:] <= tolerance * (1e-3 + np.linalg.norm(theta[3:]))
        )
        if trial_cost <= cost:
            flat = cost - trial_cost <= tolerance * cost
            theta, cost, gradient, H = trial, trial_cost, trial_gradient, trial_H
            damping = max(damping * 0.1, 1e-12)
            if small or flat:
                break
        else:
            damping *= 10.0
            if small or damping > 1e10:
                break
    return Minimum(theta, cost, H)


def _clamped(theta: FloatArray, limit: float) -> FloatArray:
    length = float(np.linalg.norm(theta[3:]))
    if not length > limit:
        return theta
    return np.concatenate([theta[:3], theta[3:] * (limit / length)])
