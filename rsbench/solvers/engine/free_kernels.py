"""Compiled inner loops of one camera with free velocities in both frames.

The readable NumPy forms are in ``engine.free_velocities``, each named where it is; the tests hold both together.
"""

from __future__ import annotations

import math

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.vectors import (
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


@compiled
def free_terms(
    R: FloatArray, vectors: FloatArray, rows: FloatArray, focal: FloatArray, residuals: FloatArray, J: FloatArray
) -> None:
    """Sampson errors, px, and what makes J^T times them the gradient of half their squares.

    NumPy: ``free_velocities.sampson``, ``free_velocities.sampson_jacobian``.

    Args:
        R: (3, 3); vectors: (5, 3) t, v0, v1, w0, w1.
        rows: (n, 6) ray 0 (x, y), ray 1 (x, y), s0, s1; focal: (2,) fx, fy in pixels.
        residuals: (n,), filled.
        J: (n, 18), filled, by ``FreeMotion.moved``; of no rows to leave it out.
    """
    A0, A1, S, P = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for m in range(len(rows)):
        x, y = (rows[m, 0], rows[m, 1], 1.0), (rows[m, 2], rows[m, 3], 1.0)
        s0, s1 = rows[m, 4], rows[m, 5]
        value, q = _constraint(R, vectors, x, y, s0, s1, focal, A0, A1, P)
        qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
        norm = math.sqrt(qq) if qq > 0.0 else 1.0
        residuals[m] = value / norm if qq > 0.0 else 0.0
        if len(J) == 0:
            continue
        step = value / (norm * norm)
        x = (x[0] - step * q[0] / focal[0], x[1] - step * q[1] / focal[1], 1.0)
        y = (y[0] - step * q[2] / focal[0], y[1] - step * q[3] / focal[1], 1.0)
        s0, s1 = s0 - step * q[1] / focal[1], s1 - step * q[3] / focal[1]
        _derivatives(R, vectors, x, y, s0, s1, A0, A1, S, P, J[m])
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
def _between(
    R: FloatArray, vectors: FloatArray, s0: float, s1: float, A0: FloatArray, A1: FloatArray, P: FloatArray
) -> tuple[Vector, Vector]:
    """T and R(s0, s1) v0; P is filled with R(s0, s1), A0 and A1 with the rotations of the frames."""
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
    R: FloatArray,
    vectors: FloatArray,
    x: Vector,
    y: Vector,
    s0: float,
    s1: float,
    focal: FloatArray,
    A0: FloatArray,
    A1: FloatArray,
    P: FloatArray,
) -> tuple[float, tuple[float, float, float, float]]:
    """y^T [T]x R x and its derivatives by the pixels; NumPy: ``free_velocities.constraint``."""
    T, Rv0 = _between(R, vectors, s0, s1, A0, A1, P)
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
def _derivatives(
    R: FloatArray,
    vectors: FloatArray,
    x: Vector,
    y: Vector,
    s0: float,
    s1: float,
    A0: FloatArray,
    A1: FloatArray,
    S: FloatArray,
    P: FloatArray,
    J: FloatArray,
) -> None:
    """Derivatives (18,) of the constraint by turn, t, v0, v1, w0 and w1."""
    T, Rv0 = _between(R, vectors, s0, s1, A0, A1, P)
    p = apply(P, x)
    n = cross(p, y)
    turned = plus(plus(times(dot(T, p), y), -dot(y, p), T), -s0, cross(Rv0, n))  # by a turn left of R(s0, s1)
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
    """How many points lie in front of both cameras; NumPy: ``free_velocities.in_front_of_both``."""
    A0, A1, P, t = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), _row(vectors, 0)
    count = 0
    for m in range(len(rows)):
        y = (rows[m, 2], rows[m, 3], 1.0)
        T, _ = _between(R, vectors, rows[m, 4], rows[m, 5], A0, A1, P)
        p = apply(P, (rows[m, 0], rows[m, 1], 1.0))
        if dot(T, t) < 0.0:
            T = times(-1.0, T)
        pp, yy, py, pT, yT = dot(p, p), dot(y, y), dot(p, y), dot(p, T), dot(y, T)
        if pp * yy - py * py > 1e-15 * pp * yy and py * yT > yy * pT and pp * yT > py * pT:
            count += 1
    return count


@compiled
def free_from_row(R: FloatArray, vectors: FloatArray, s: float, out_R: FloatArray, out: FloatArray) -> None:
    """``free_velocities.from_row``: the motion with s = 0 at another row, filled."""
    A0, A1 = np.zeros((3, 3)), np.zeros((3, 3))
    v0, v1, w0, w1 = _row(vectors, 1), _row(vectors, 2), _row(vectors, 3), _row(vectors, 4)
    t, Rv0 = _between(R, vectors, s, s, A0, A1, out_R)
    # Frame 0 began at (exp(s w0), s v0); its camera is the world now.
    v0, v1 = plus(v0, -s, cross(w0, v0)), plus(v1, -s, cross(w1, Rv0))
    for k in range(3):
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k] = t[k], v0[k], v1[k], w0[k], w1[k]
