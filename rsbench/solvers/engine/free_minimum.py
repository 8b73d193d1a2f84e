"""Compiled descents over the unknowns of two frames with free velocities; see ``engine.free_descent``.

A motion is R (3, 3) and vectors (5, 3): t, v0, v1, w0, w1. Its unknowns, 11 or 17, are a turn left of R, two steps
of t on the unit sphere, v1 - R v0 and (v1 + R v0) / 2, and the same of w0 and w1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.free_kernels import exponential, free_terms
from rsbench.solvers.engine.generalised_essential import fill_coefficients
from rsbench.solvers.engine.vectors import Vector, cross, dot, times

_FLAT = 1e-9
"""Relative decrease at which to stop: sqrt(n 1e-9) standard deviations from the end."""
_LARGEST_DAMPING = 1e8


@compiled
def descend(
    R: FloatArray,
    vectors: FloatArray,
    unknowns: int,
    most: int,
    exact: float,
    rows: FloatArray,
    focal: FloatArray,
    slowness: float,
    F: FloatArray,
    place: NDArray[np.int64],
) -> float:
    """Levenberg and Marquardt's descent, in place; what is left of the cost.

    Args:
        most: evaluations; exact: a cost that is as good as 0.
        rows, focal, slowness: of ``_sampson``, when F is empty.
        F, place: of ``_misfit`` otherwise.
    """
    trial_R, trial = np.zeros((3, 3)), np.zeros((5, 3))
    H, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    there_H, there_gradient, step = np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.zeros(unknowns)
    _unit_length(vectors)
    cost = _evaluate(R, vectors, rows, focal, slowness, F, place, H, gradient)
    damping = 1e-3
    for _ in range(most):
        if cost <= exact or damping > _LARGEST_DAMPING:
            break
        if _damped_step(H, gradient, damping, step):
            _move(R, vectors, step, trial_R, trial)
            trial_cost = _evaluate(trial_R, trial, rows, focal, slowness, F, place, there_H, there_gradient)
        else:
            trial_cost = np.inf
        if not trial_cost < cost:
            damping *= 10.0
            continue
        flat = cost - trial_cost <= _FLAT * cost
        _copy(trial_R, R)
        _copy(trial, vectors)
        _copy(there_H, H)
        for k in range(unknowns):
            gradient[k] = there_gradient[k]
        cost, damping = trial_cost, max(0.1 * damping, 1e-14)
        if flat:
            break
    return cost


@compiled
def _copy(source: FloatArray, target: FloatArray) -> None:
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@compiled
def _evaluate(
    R: FloatArray,
    vectors: FloatArray,
    rows: FloatArray,
    focal: FloatArray,
    slowness: float,
    F: FloatArray,
    place: NDArray[np.int64],
    H: FloatArray,
    gradient: FloatArray,
) -> float:
    """The cost; H and gradient are filled."""
    for i in range(len(H)):
        gradient[i] = 0.0
        for j in range(len(H)):
            H[i, j] = 0.0
    if len(F) > 0:
        cost = _misfit(R, vectors, F, place, H, gradient)
    else:
        cost = _sampson(R, vectors, rows, focal, slowness, H, gradient)
    for i in range(len(H)):
        for j in range(i):
            H[i, j] = H[j, i]
    return cost if cost < np.inf else np.inf


@compiled
def _add(J: FloatArray, r: float, H: FloatArray, gradient: FloatArray) -> None:
    """One residual to the upper half of the normal equations."""
    for i in range(len(H)):
        gradient[i] += J[i] * r
        for j in range(i, len(H)):
            H[i, j] += J[i] * J[j]


@compiled
def _sampson(
    R: FloatArray,
    vectors: FloatArray,
    rows: FloatArray,
    focal: FloatArray,
    slowness: float,
    H: FloatArray,
    gradient: FloatArray,
) -> float:
    """C (1 + slowness (|v0|^2 + |v1|^2)), C the sum of squared Sampson errors, px^2, of rows (n, 6)."""
    residuals, J, across, row = np.zeros(len(rows)), np.zeros((len(rows), 18)), _across(vectors), np.zeros(17)
    free_terms(R, vectors, rows, focal, residuals, J)
    squares, fast = 0.0, 1.0
    for m in range(len(rows)):
        _by_unknowns(J[m], R, across, row)
        _add(row, residuals[m], H, gradient)
        squares += residuals[m] ** 2
    for i in range(2):
        for k in range(3):
            fast += slowness * vectors[1 + i, k] ** 2
    for i in range(len(H)):
        gradient[i] *= fast
        for j in range(i, len(H)):
            H[i, j] *= fast
    rate, moved = math.sqrt(slowness * squares), np.zeros(18)
    for i in range(6, 12):
        moved[i] = rate
        _by_unknowns(moved, R, across, row)
        moved[i] = 0.0
        _add(row, rate * vectors[i // 3 - 1, i % 3], H, gradient)
    return squares * fast


@compiled
def _misfit(
    R: FloatArray,
    vectors: FloatArray,
    F: FloatArray,
    place: NDArray[np.int64],
    H: FloatArray,
    gradient: FloatArray,
) -> float:
    """Square of what the unit coefficients of a motion have across the unit vector F."""
    n, across, row = len(F), _across(vectors), np.zeros(18)
    C, by, J = np.zeros(n), np.zeros((18, n)), np.zeros((n, 17))
    fill_coefficients(R, vectors, place, C, by)
    length, along, cost = 1e-300, 0.0, 0.0
    for m in range(n):
        length += C[m] * C[m]
    length = math.sqrt(length)
    for m in range(n):
        C[m] /= length
        along += C[m] * F[m]
        for k in range(18):
            row[k] = by[k, m] / length
        _by_unknowns(row, R, across, J[m])
    for unit in (C, F):
        for k in range(len(H)):
            total = 0.0
            for m in range(n):
                total += J[m, k] * unit[m]
            for m in range(n):
                J[m, k] -= total * unit[m]
    for m in range(n):
        r = C[m] - along * F[m]
        _add(J[m], r, H, gradient)
        cost += r * r
    return cost


@compiled
def _across(vectors: FloatArray) -> tuple[Vector, Vector]:
    """Two unit vectors across t and each other."""
    t = (vectors[0, 0], vectors[0, 1], vectors[0, 2])
    axis = (1.0, 0.0, 0.0) if abs(t[0]) < 0.7 else (0.0, 1.0, 0.0)
    first = cross(t, axis)
    first = times(1.0 / max(math.sqrt(dot(first, first)), 1e-300), first)
    return first, cross(t, first)


@compiled
def _by_unknowns(J: FloatArray, R: FloatArray, across: tuple[Vector, Vector], out: FloatArray) -> None:
    """Derivatives (17,) by the unknowns from those (18,) by ``FreeMotion.moved``."""
    for k in range(3):
        out[k] = J[k]
    for k in range(2):
        out[3 + k] = J[3] * across[k][0] + J[4] * across[k][1] + J[5] * across[k][2]
    for first in (6, 12):
        for k in range(3):
            turned = R[k, 0] * J[first] + R[k, 1] * J[first + 1] + R[k, 2] * J[first + 2]
            out[first - 1 + k] = 0.5 * (J[first + 3 + k] - turned)
            out[first + 2 + k] = J[first + 3 + k] + turned


@compiled
def _move(R: FloatArray, vectors: FloatArray, step: FloatArray, out_R: FloatArray, out: FloatArray) -> None:
    """The motion after a step of the unknowns."""
    across, A = _across(vectors), np.zeros((3, 3))
    for k in range(3):
        out[0, k] = vectors[0, k] + step[3] * across[0][k] + step[4] * across[1][k]
    for row, first in ((1, 5), (3, 11)):
        for k in range(3):
            out[row, k] = vectors[row, k]
            out[row + 1, k] = vectors[row + 1, k]
            if first + 6 > len(step):
                continue
            for j in range(3):
                out[row, k] += R[j, k] * (step[first + 3 + j] - 0.5 * step[first + j])
            out[row + 1, k] += step[first + 3 + k] + 0.5 * step[first + k]
    exponential((step[0], step[1], step[2]), A)
    for i in range(3):
        for j in range(3):
            out_R[i, j] = A[i, 0] * R[0, j] + A[i, 1] * R[1, j] + A[i, 2] * R[2, j]
    _unit_length(out)


@compiled
def _unit_length(vectors: FloatArray) -> None:
    """t to length 1, with the velocities."""
    t = (vectors[0, 0], vectors[0, 1], vectors[0, 2])
    length = max(math.sqrt(dot(t, t)), 1e-300)
    for i in range(3):
        for k in range(3):
            vectors[i, k] /= length


@compiled
def _damped_step(H: FloatArray, gradient: FloatArray, damping: float, step: FloatArray) -> bool:
    """Solve (H + damping diag H) step = -gradient, each unknown in its own unit; False where rounding forbids."""
    n = len(H)
    unit, L = np.zeros(n), np.zeros((n, n))
    for i in range(n):
        unit[i] = 1.0 / math.sqrt(max(H[i, i], 1e-300))
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j] * unit[i] * unit[j] + (damping if i == j else 0.0)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif not total > 0.0:
                return False
            else:
                L[i, i] = math.sqrt(total)
    for i in range(n):
        total = -gradient[i] * unit[i]
        for k in range(i):
            total -= L[i, k] * step[k]
        step[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= L[k, i] * step[k]
        step[i] = total / L[i, i]
    for i in range(n):
        step[i] *= unit[i]
    return True
