"""Levenberg-Marquardt for six parameters (w, v), and for other problems that compute their own damped steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from rsbench.core.so3 import FloatArray

Place = TypeVar("Place")
Evaluate = Callable[[FloatArray], tuple[float, FloatArray, FloatArray]]
_LARGEST_DAMPING = 1e10
_FLAT = 1e-10
"""Relative decrease of the cost at which to stop, about sqrt(n 1e-10) standard deviations from the minimum."""


class Minimum(NamedTuple):
    """The result of a minimisation."""

    theta: FloatArray
    cost: float
    H: FloatArray
    """Gauss-Newton Hessian by theta at the minimum."""


def levenberg_marquardt(
    evaluate: Evaluate,
    theta: FloatArray,
    iterations: int,
    limit: float,
    inverse_length: bool = False,
    tolerance: float = 1e-12,
) -> Minimum:
    """Minimise ``evaluate(theta) -> (cost, gradient, Hessian)``.

    Args:
        theta: (6,) start.
        iterations: largest number of evaluations.
        limit: largest length of v; without it, an unobservable scale would diverge.
        inverse_length: parametrise v by its direction and 1 / |v|, which stays positive. Pairs depend on the
            length of v only through baseline / |v|, in which the cost is nearly quadratic.
        tolerance: relative change of the parameters at which to stop.
    """
    theta = _clamped(theta, limit)
    cost, gradient, H = evaluate(theta)
    damping = 1e-4
    for _ in range(iterations):
        trial = _trial(theta, gradient, H, damping, limit, inverse_length)
        if not np.all(np.isfinite(trial)):
            break
        trial_cost, trial_gradient, trial_H = evaluate(trial)
        moved = np.abs(trial - theta)
        length = 1e-3 + float(np.linalg.norm(theta[3:]))
        small = bool(np.all(moved[:3] <= tolerance) and np.all(moved[3:] <= tolerance * length))
        if trial_cost <= cost:
            flat = cost - trial_cost <= _FLAT * cost
            theta, cost, gradient, H = trial, trial_cost, trial_gradient, trial_H
            damping = max(damping * 0.1, 1e-12)
            if small or flat:
                break
        else:
            damping *= 10.0
            if small or damping > _LARGEST_DAMPING:
                break
    return Minimum(theta, cost, H)


def _trial(
    theta: FloatArray, gradient: FloatArray, H: FloatArray, damping: float, limit: float, inverse_length: bool
) -> FloatArray:
    """Return the parameters after a damped step."""
    length = float(np.linalg.norm(theta[3:]))
    if not inverse_length or length == 0.0:
        return _clamped(theta + _damped_step(H, gradient, damping), limit)
    Q, M = _chart(theta[3:], length)
    gradient, H = M.T @ gradient, M.T @ H @ M
    free = np.ones(6, dtype=np.bool_)
    free[3] = length < 0.999 * limit or gradient[3] < 0.0
    step = np.zeros(6)
    step[free] = _damped_step(H[np.ix_(free, free)], gradient[free], damping)
    direction = Q @ np.array([1.0, step[4], step[5]])
    inverse = max(1.0 / length + step[3], 1.0 / limit)
    return np.concatenate([theta[:3] + step[:3], direction / (np.linalg.norm(direction) * inverse)])


def _damped_step(H: FloatArray, gradient: FloatArray, damping: float) -> FloatArray:
    diagonal = np.diagonal(H)
    scale = np.sqrt(np.maximum(diagonal, 1e-12 * np.max(diagonal)) + 1e-300)
    A = H / np.outer(scale, scale)
    A[np.diag_indices(len(A))] += damping
    return -np.linalg.solve(A, gradient / scale) / scale


def _chart(v: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Return axes (3, 3) along and across v, and derivatives (6, 6) of (w, v) by w, 1 / |v| and two angles."""
    # The Householder reflection that maps the first axis to v / |v|, up to sign.
    sign = 1.0 if v[0] >= 0.0 else -1.0
    h = v / length
    h[0] += sign
    Q = -sign * (np.eye(3) - (2.0 / (h @ h)) * np.outer(h, h))
    M = np.eye(6)
    M[3:, 3:] = Q * np.array([-(length**2), length, length])
    return Q, M


def _clamped(theta: FloatArray, limit: float) -> FloatArray:
    length = float(np.linalg.norm(theta[3:]))
    if not length > limit:
        return theta
    return np.concatenate([theta[:3], theta[3:] * (limit / length)])


class Problem(Protocol[Place]):
    """Interface to a cost function; a ``Place`` holds parameters and the cost with its derivatives at them."""

    def stepped(self, here: Place, damping: float, /) -> Place | None:
        """Return the place after a damped step; None if its cost is not lower."""

    def settled(self, before: Place, after: Place, /) -> bool:
        """Return whether the descent has converged with this step."""


class Damping(NamedTuple):
    """Limits of the damping, which is multiplied by ten after a rejected step and divided by ten otherwise."""

    least: float
    first: float
    """Smallest damping after a rejected step."""
    largest: float
    """The descent ends if no step with less damping than this is accepted."""
    dropped: float = 0.0
    """A damping up to this becomes ``least`` after an accepted step."""


def descend(problem: Problem[Place], here: Place, steps: int, damping: Damping) -> Place:
    """Minimise from a starting place with at most ``steps`` accepted steps."""
    now = damping.least
    for _ in range(steps):
        there = None
        while there is None and now < damping.largest:
            there = problem.stepped(here, now)
            if there is None:
                now = max(10.0 * now, damping.first)
        if there is None:
            break
        before, here = here, there
        now = max(0.1 * now, damping.least) if now > damping.dropped else damping.least
        if problem.settled(before, here):
            break
    return here
