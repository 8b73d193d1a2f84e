"""Compiled inner loops for one camera with independent velocities in both frames; see ``solvers.free_velocities``.

A motion consists of R (3, 3) and vectors (5, 3) with rows t, v0, v1, w0, w1. The 11 or 17 unknowns of a descent
are a rotation that multiplies R from the left, two steps of t on the unit sphere, changes of v1 - R v0 and of (v1
+ R v0) / 2 and, if there are 17, the same for w0 and w1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import (
    Vector,
    apply,
    apply_transposed,
    coefficients,
    cross,
    dot,
    fill_rotation,
    plus,
    times,
)
from rsbench.core.so3 import FloatArray

Match = tuple[Vector, Vector, float, float]
"""Rays of frames 0 and 1, z = 1, and their times s0, s1."""
Target = tuple[FloatArray, FloatArray, float, FloatArray, NDArray[np.int64]]
"""Data of the cost of a descent: rows (n, 6), focal (2,) and slowness for ``_sampson``, then F and ``places`` for
``_misfit``, which is minimised if F is not empty."""


@compiled
def free_terms(
    R: FloatArray, vectors: FloatArray, rows: FloatArray, focal: FloatArray, residuals: FloatArray, J: FloatArray
) -> None:
    """Fill Sampson errors, px, and J such that J^T times the errors is the gradient of half their squares.

    The error is the constraint y^T [T]x R x divided by the norm of its derivative by the pixels. J is evaluated at
    the corrected measurement: see ``residuals``.

    Args:
        R: (3, 3); vectors: (5, 3) t, v0, v1, w0, w1.
        rows: (n, 6) ray 0 (x, y), ray 1 (x, y), s0, s1; focal: (2,) fx, fy in pixels.
        residuals: (n,), filled.
        J: (n, 18), filled with derivatives by the step of ``FreeMotion.moved``; if it has no rows, it is not
            computed.
    """
    work = np.zeros((4, 3, 3))
    for m in range(len(rows)):
        x, y = (rows[m, 0], rows[m, 1], 1.0), (rows[m, 2], rows[m, 3], 1.0)
        s0, s1 = rows[m, 4], rows[m, 5]
        value, q = _constraint(R, vectors, (x, y, s0, s1), focal, work)
        qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
        norm = math.sqrt(qq) if qq > 0.0 else 1.0
        residuals[m] = value / norm if qq > 0.0 else 0.0
        if len(J) == 0:
            continue
        step = value / (norm * norm)
        x = (x[0] - step * q[0] / focal[0], x[1] - step * q[1] / focal[1], 1.0)
        y = (y[0] - step * q[2] / focal[0], y[1] - step * q[3] / focal[1], 1.0)
        s0, s1 = s0 - step * q[1] / focal[1], s1 - step * q[3] / focal[1]
        _derivatives(R, vectors, (x, y, s0, s1), work, J[m])
        for k in range(18):
            J[m, k] /= norm


@compiled
def _row(vectors: FloatArray, k: int) -> Vector:
    return (vectors[k, 0], vectors[k, 1], vectors[k, 2])


@compiled
def exponential(phi: Vector, out: FloatArray) -> None:
    a, b, _, _, _ = coefficients(dot(phi, phi))
    fill_rotation(phi, 1.0 - b * dot(phi, phi), a, b, out)


@compiled
def _left_jacobian(phi: Vector, out: FloatArray) -> None:
    a, b, c, _, _ = coefficients(dot(phi, phi))
    fill_rotation(phi, a, b, c, out)


@compiled
def _between(R: FloatArray, vectors: FloatArray, s0: float, s1: float, work: FloatArray) -> tuple[Vector, Vector]:
    """Return T and R(s0, s1) v0; fill ``work`` with exp(-s0 w0), exp(s1 w1) and R(s0, s1)."""
    A0, A1, P = work[0], work[1], work[2]
    v0, v1 = _row(vectors, 1), _row(vectors, 2)
    exponential(times(-s0, _row(vectors, 3)), A0)
    exponential(times(s1, _row(vectors, 4)), A1)
    for i in range(3):
        B = (
            A1[i, 0] * R[0, 0] + A1[i, 1] * R[1, 0] + A1[i, 2] * R[2, 0],
            A1[i, 0] * R[0, 1] + A1[i, 1] * R[1, 1] + A1[i, 2] * R[2, 1],
            A1[i, 0] * R[0, 2] + A1[i, 1] * R[1, 2] + A1[i, 2] * R[2, 2],
        )
        for j in range(3):
            P[i, j] = B[0] * A0[0, j] + B[1] * A0[1, j] + B[2] * A0[2, j]
    Rv0 = apply(P, v0)
    return plus(plus(_row(vectors, 0), s1, v1), -s0, Rv0), Rv0


@compiled
def _constraint(
    R: FloatArray, vectors: FloatArray, match: Match, focal: FloatArray, work: FloatArray
) -> tuple[float, tuple[float, float, float, float]]:
    """Return y^T [T]x R x and its derivatives by x0, y0, x1, y1; a change of row changes the pose too."""
    (x, y, s0, s1), A1, P = match, work[1], work[2]
    T, Rv0 = _between(R, vectors, s0, s1, work)
    v1, w1 = _row(vectors, 2), _row(vectors, 4)
    p = apply(P, x)
    n = cross(p, y)
    line, back = cross(T, p), apply_transposed(P, cross(y, T))
    spin0 = times(-1.0, apply(A1, apply(R, _row(vectors, 3))))
    rate0 = plus(times(-1.0, Rv0), -s0, cross(spin0, Rv0))
    rate1 = plus(v1, -s0, cross(w1, Rv0))
    turn0 = dot(spin0, y) * dot(T, p) - dot(spin0, T) * dot(y, p)
    turn1 = dot(w1, y) * dot(T, p) - dot(w1, T) * dot(y, p)
    return dot(T, n), (
        back[0] / focal[0],
        (back[1] + dot(rate0, n) + turn0) / focal[1],
        line[0] / focal[0],
        (line[1] + dot(rate1, n) + turn1) / focal[1],
    )


@compiled
def _derivatives(R: FloatArray, vectors: FloatArray, match: Match, work: FloatArray, J: FloatArray) -> None:
    """Fill J (18,) with derivatives of the constraint by a rotation from the left, t, v0, v1, w0 and w1."""
    (x, y, s0, s1), A1, P, S = match, work[1], work[2], work[3]
    T, Rv0 = _between(R, vectors, s0, s1, work)
    p = apply(P, x)
    n = cross(p, y)
    turned = plus(plus(times(dot(T, p), y), -dot(y, p), T), -s0, cross(Rv0, n))  # by a rotation left of R(s0, s1)
    by_R = apply_transposed(A1, turned)
    _left_jacobian(times(-s0, _row(vectors, 3)), S)
    by_w0 = apply_transposed(S, apply_transposed(R, by_R))
    _left_jacobian(times(s1, _row(vectors, 4)), S)
    by_w1 = apply_transposed(S, turned)
    by_v0 = apply_transposed(P, n)
    for k in range(3):
        J[k], J[3 + k], J[6 + k], J[9 + k] = by_R[k], n[k], -s0 * by_v0[k], s1 * n[k]
        J[12 + k], J[15 + k] = -s0 * by_w0[k], s1 * by_w1[k]


@compiled
def free_in_front(R: FloatArray, vectors: FloatArray, rows: FloatArray) -> int:
    """Count the points in front of both cameras, with the sign of T chosen so that T . t >= 0."""
    work, t = np.zeros((3, 3, 3)), _row(vectors, 0)
    count = 0
    for m in range(len(rows)):
        y = (rows[m, 2], rows[m, 3], 1.0)
        T, _ = _between(R, vectors, rows[m, 4], rows[m, 5], work)
        p = apply(work[2], (rows[m, 0], rows[m, 1], 1.0))
        if dot(T, t) < 0.0:
            T = times(-1.0, T)
        pp, yy, py, pT, yT = dot(p, p), dot(y, y), dot(p, y), dot(p, T), dot(y, T)
        if pp * yy - py * py > 1e-15 * pp * yy and py * yT > yy * pT and pp * yT > py * pT:
            count += 1
    return count


@compiled
def free_from_row(R: FloatArray, vectors: FloatArray, s: float, out_R: FloatArray, out: FloatArray) -> None:
    """Fill the same motion with s = 0 at another row, as ``free_velocities.from_row``."""
    work = np.zeros((3, 3, 3))
    v0, v1, w0, w1 = _row(vectors, 1), _row(vectors, 2), _row(vectors, 3), _row(vectors, 4)
    t, Rv0 = _between(R, vectors, s, s, work)
    _copy(work[2], out_R)
    # The camera of frame 0 at time s, (exp(s w0), s v0), becomes the new reference.
    v0, v1 = plus(v0, -s, cross(w0, v0)), plus(v1, -s, cross(w1, Rv0))
    for k in range(3):
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k] = t[k], v0[k], v1[k], w0[k], w1[k]


@compiled
def fill_coefficients(
    R: FloatArray, vectors: FloatArray, place: NDArray[np.int64], out: FloatArray, by: FloatArray
) -> None:
    """Fill the ``coefficients`` of a motion and their derivatives.

    Args:
        vectors: (5, 3) t, v0, v1, w0, w1; place: the index array ``places``.
        out, by: (21,) or (45,) coefficients and derivatives (18, 21 or 45), both zero before the call.
    """
    degree = (len(place) - 3) // 2
    t, v0, v1, w0, w1 = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    Q, zero, unit = np.zeros((2, 2, 3, 3)), np.zeros(3), np.zeros(3)
    _turned_products(R, w0, w1, 1.0, 1.0, 1.0, degree, Q)
    _form(Q, t, v0, v1, degree, place, out)
    for k in range(3):
        unit[k] = 1.0
        _form(Q, unit, zero, zero, degree, place, by[3 + k])
        _form(Q, zero, unit, zero, degree, place, by[6 + k])
        _form(Q, zero, zero, unit, degree, place, by[9 + k])
        unit[k] = 0.0
    for k in range(3):
        unit[k] = 1.0
        other = np.zeros((3, 3))
        for j in range(3):  # [e_k]x R
            other[(k + 1) % 3, j], other[(k + 2) % 3, j] = -R[(k + 2) % 3, j], R[(k + 1) % 3, j]
        _turned_products(other, w0, w1, 1.0, 1.0, 1.0, degree, Q)
        _form(Q, t, v0, v1, degree, place, by[k])
        if degree == 2:
            _turned_products(R, unit, w1, 0.0, 1.0, 0.0, degree, Q)
            _form(Q, t, v0, v1, degree, place, by[12 + k])
            _turned_products(R, w0, unit, 0.0, 0.0, 1.0, degree, Q)
            _form(Q, t, v0, v1, degree, place, by[15 + k])
        unit[k] = 0.0


@compiled
def _turned_products(
    R: FloatArray, w0: FloatArray, w1: FloatArray, still: float, by0: float, by1: float, degree: int, Q: FloatArray
) -> None:
    """Fill Q[a, b] with the coefficient of s1^a s0^b in (I + s1 [w1]x) R (I - s0 [w0]x).

    ``still``, ``by0`` and ``by1`` multiply the term R, the term with w0 alone and the term with w1 alone.
    """
    Q[:] = 0.0
    for i in range(3):
        for j in range(3):
            Q[0, 0, i, j] = still * R[i, j]
    if degree == 1:
        return
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            Q[0, 1, j, i] = by0 * (R[j, b] * w0[a] - R[j, a] * w0[b])
            Q[1, 0, i, j] = by1 * (w1[a] * R[b, j] - w1[b] * R[a, j])
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            left_c = w1[a] * R[b, c] - w1[b] * R[a, c]
            left_d = w1[a] * R[b, d] - w1[b] * R[a, d]
            Q[1, 1, i, j] = left_d * w0[c] - left_c * w0[d]


@compiled
def _form(
    Q: FloatArray,
    t: FloatArray,
    v0: FloatArray,
    v1: FloatArray,
    degree: int,
    place: NDArray[np.int64],
    out: FloatArray,
) -> None:
    """Add the coefficients of [t + s1 v1]x Q - Q [s0 v0]x to ``out``."""
    for a in range(degree):
        for b in range(degree):
            for i in range(3):
                i1, i2 = (i + 1) % 3, (i + 2) % 3
                for j in range(3):
                    j1, j2 = (j + 1) % 3, (j + 2) % 3
                    q1, q2 = Q[a, b, i1, j], Q[a, b, i2, j]
                    _add_coefficient(out, place, degree, i, j, a, b, t[i1] * q2 - t[i2] * q1)
                    _add_coefficient(out, place, degree, i, j, a + 1, b, v1[i1] * q2 - v1[i2] * q1)
                    turned = Q[a, b, i, j1] * v0[j2] - Q[a, b, i, j2] * v0[j1]
                    _add_coefficient(out, place, degree, i, j, a, b + 1, -turned)


@compiled
def _add_coefficient(
    out: FloatArray, place: NDArray[np.int64], degree: int, i: int, j: int, a: int, b: int, value: float
) -> None:
    """Add to the coefficient of (ray 1)_i s1^a (ray 0)_j s0^b."""
    row = a if i == 0 else degree + (2 if i == 1 else 1) + a
    column = b if j == 0 else degree + (2 if j == 1 else 1) + b
    out[place[row, column]] += value


_FLAT = 1e-9
"""Relative decrease of the cost at which to stop, about sqrt(n 1e-9) standard deviations from the minimum."""
_LARGEST_DAMPING = 1e8


@compiled
def descend(R: FloatArray, vectors: FloatArray, unknowns: int, most: int, exact: float, target: Target) -> float:
    """Minimise the cost of ``target`` by Levenberg-Marquardt, changing R and vectors in place; return the final
    cost.

    Args:
        unknowns: 17, or 11 without rotation within the frames.
        most: largest number of steps tried; exact: cost at which to stop.
    """
    trial_R, trial = np.zeros((3, 3)), np.zeros((5, 3))
    H, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    there_H, there_gradient, step = np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.zeros(unknowns)
    _unit_length(vectors)
    cost = _evaluate(R, vectors, target, H, gradient)
    damping = 1e-3
    for _ in range(most):
        if cost <= exact or damping > _LARGEST_DAMPING:
            break
        if _damped_step(H, gradient, damping, step):
            _move(R, vectors, step, trial_R, trial)
            trial_cost = _evaluate(trial_R, trial, target, there_H, there_gradient)
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
def _evaluate(R: FloatArray, vectors: FloatArray, target: Target, H: FloatArray, gradient: FloatArray) -> float:
    """Return the cost; fill H and gradient."""
    for i in range(len(H)):
        gradient[i] = 0.0
        for j in range(len(H)):
            H[i, j] = 0.0
    if len(target[3]) > 0:
        cost = _misfit(R, vectors, target, H, gradient)
    else:
        cost = _sampson(R, vectors, target, H, gradient)
    for i in range(len(H)):
        for j in range(i):
            H[i, j] = H[j, i]
    return cost if cost < np.inf else np.inf


@compiled
def _add(J: FloatArray, r: float, H: FloatArray, gradient: FloatArray) -> None:
    """Add one residual r to the upper half of the normal equations."""
    for i in range(len(H)):
        gradient[i] += J[i] * r
        for j in range(i, len(H)):
            H[i, j] += J[i] * J[j]


@compiled
def _sampson(R: FloatArray, vectors: FloatArray, target: Target, H: FloatArray, gradient: FloatArray) -> float:
    """Return C (1 + slowness (|v0|^2 + |v1|^2)), where C is the sum of squared Sampson errors, px^2."""
    rows, focal, slowness, _, _ = target
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
def _misfit(R: FloatArray, vectors: FloatArray, target: Target, H: FloatArray, gradient: FloatArray) -> float:
    """Return the squared component, orthogonal to the unit vector F, of the motion's unit coefficients."""
    F, place = target[3], target[4]
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
    """Return two unit vectors orthogonal to t, which has unit length, and to each other."""
    t = (vectors[0, 0], vectors[0, 1], vectors[0, 2])
    axis = (1.0, 0.0, 0.0) if abs(t[0]) < 0.7 else (0.0, 1.0, 0.0)
    first = cross(t, axis)
    first = times(1.0 / max(math.sqrt(dot(first, first)), 1e-300), first)
    return first, cross(t, first)


@compiled
def _by_unknowns(J: FloatArray, R: FloatArray, across: tuple[Vector, Vector], out: FloatArray) -> None:
    """Fill derivatives (17,) by the unknowns from derivatives (18,) by the step of ``FreeMotion.moved``."""
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
    """Fill the motion after a step of the unknowns."""
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
    """Divide t, v0 and v1 by |t|."""
    t = (vectors[0, 0], vectors[0, 1], vectors[0, 2])
    length = max(math.sqrt(dot(t, t)), 1e-300)
    for i in range(3):
        for k in range(3):
            vectors[i, k] /= length


@compiled
def _damped_step(H: FloatArray, gradient: FloatArray, damping: float, step: FloatArray) -> bool:
    """Solve (H + damping diag H) step = -gradient by scaled Cholesky; False if not positive definite."""
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


_PROPOSAL_UNKNOWNS = 11


@compiled
def free_proposal(
    Rs: FloatArray,
    vectors: FloatArray,
    F: FloatArray,
    place: NDArray[np.int64],
    rows: FloatArray,
    focal: FloatArray,
    first: float,
    slowness: float,
    most: tuple[int, int],
    R: FloatArray,
    out: FloatArray,
) -> None:
    """Fill R (3, 3) and out (5, 3), the motion of a sample for a camera that does not rotate within a frame.

    Args:
        Rs, vectors: (2, 3, 3), (2, 5, 3) two starts, each refined in place towards the unit coefficients (21,) F.
        rows: (n, 6) with s = 0 at the principal point's row.
        first: s of the first row, at which the filled motion has s = 0.
        slowness: see ``_sampson``.
        most: largest number of steps of each descent towards F, and of the final one on Sampson errors, which
            starts with zero velocities; 0 leaves it out.
    """
    near_R, near = np.zeros((4, 3, 3)), np.zeros((4, 5, 3))
    for k in range(2):
        descend(Rs[k], vectors[k], _PROPOSAL_UNKNOWNS, most[0], 1e-28, (rows[:0], focal, 0.0, F, place))
        _with_twin(Rs[k], vectors[k], near_R[2 * k : 2 * k + 2], near[2 * k : 2 * k + 2])
    best = _most_likely(near_R, near, rows, focal)
    free_from_row(near_R[best], near[best], first, R, out)
    moved = rows.copy()
    for m in range(len(rows)):
        moved[m, 4] -= first
        moved[m, 5] -= first
    if most[1] > 0:
        for i in range(1, 3):
            for j in range(3):
                out[i, j] = 0.0
        descend(R, out, _PROPOSAL_UNKNOWNS, most[1], 0.0, (moved, focal, slowness, F[:0], place))
    if free_in_front(R, -out, moved) > free_in_front(R, out, moved):
        for i in range(3):
            for j in range(3):
                out[i, j] = -out[i, j]


@compiled
def _with_twin(R: FloatArray, vectors: FloatArray, out_R: FloatArray, out: FloatArray) -> None:
    """Fill a motion and its ``FreeMotion.twin``, which is rotated by 180 degrees about t."""
    for i in range(3):
        for j in range(3):
            out_R[0, i, j], out_R[1, i, j] = R[i, j], -R[i, j]
            for k in range(3):
                out_R[1, i, j] += 2.0 * vectors[0, i] * vectors[0, k] * R[k, j]
    for i in range(5):
        for j in range(3):
            out[0, i, j] = vectors[i, j]
            out[1, i, j] = vectors[i, j]


@compiled
def _most_likely(Rs: FloatArray, vectors: FloatArray, rows: FloatArray, focal: FloatArray) -> int:
    """Return the index of the motion with the least Sampson error among those with enough points in front.

    At least half as many points as for the best motion must lie in front of the cameras.
    """
    n = len(Rs)
    front, r, J = np.zeros(n, dtype=np.int64), np.zeros(len(rows)), np.zeros((0, 18))
    for k in range(n):
        front[k] = max(free_in_front(Rs[k], vectors[k], rows), free_in_front(Rs[k], -vectors[k], rows))
    best, least = 0, np.inf
    for k in range(n):
        if 2 * front[k] < np.max(front):
            continue
        free_terms(Rs[k], vectors[k], rows, focal, r, J)
        total = np.sum(r * r)
        if total < least:
            best, least = k, total
    return best
