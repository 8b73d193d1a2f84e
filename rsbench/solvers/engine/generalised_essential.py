"""Coefficients of the generalised essential matrices of Dai et al., and their derivatives, compiled.

What they are is said in ``rsbench.solvers.dai``. They are linear in R, in (t, v0, v1), and of first degree in w0
and in w1, so that a derivative is the same form with a unit vector in the place of an unknown.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.free_velocities import FreeMotion


@functools.cache
def places(degree: int) -> NDArray[np.int64]:
    """(m, m), m = 2 degree + 3: which coefficient a product of monomials has, frame 1 first; -1 of none.

    The products of both frames' highest ones do not occur.
    """
    m = 2 * degree + 3
    highest = np.zeros(m, dtype=np.bool_)
    highest[[degree, m - 1]] = True
    occur = ~np.outer(highest, highest)
    out = np.full((m, m), -1, dtype=np.int64)
    out[occur] = np.arange(np.count_nonzero(occur))
    return out


def coefficients(motion: FreeMotion, degree: int) -> FloatArray:
    """The (21,) or (45,) coefficients of a motion."""
    return with_derivatives(motion, degree)[0]


def with_derivatives(motion: FreeMotion, degree: int) -> tuple[FloatArray, FloatArray]:
    """The (21,) or (45,) coefficients, and what they change by with ``FreeMotion.moved``, (18, 21) or (18, 45)."""
    place = places(degree)
    out, by = np.zeros(np.max(place) + 1), np.zeros((18, np.max(place) + 1))
    fill_coefficients(motion.R, np.stack(motion[1:]), place, out, by)
    return out, by


@compiled
def fill_coefficients(
    R: FloatArray, vectors: FloatArray, place: NDArray[np.int64], out: FloatArray, by: FloatArray
) -> None:
    """``with_derivatives`` of a motion, vectors (5, 3) t, v0, v1, w0, w1; into zeros, place is ``places``."""
    degree = (len(place) - 3) // 2
    t, v0, v1, w0, w1 = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    Q, zero, unit = np.zeros((2, 2, 3, 3)), np.zeros(3), np.zeros(3)
    _turned(R, w0, w1, 1.0, 1.0, 1.0, degree, Q)
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
        _turned(other, w0, w1, 1.0, 1.0, 1.0, degree, Q)
        _form(Q, t, v0, v1, degree, place, by[k])
        if degree == 2:
            _turned(R, unit, w1, 0.0, 1.0, 0.0, degree, Q)
            _form(Q, t, v0, v1, degree, place, by[12 + k])
            _turned(R, w0, unit, 0.0, 0.0, 1.0, degree, Q)
            _form(Q, t, v0, v1, degree, place, by[15 + k])
        unit[k] = 0.0


@compiled
def _turned(
    R: FloatArray, w0: FloatArray, w1: FloatArray, still: float, by0: float, by1: float, degree: int, Q: FloatArray
) -> None:
    """Q[a, b]: what (I + s1 [w1]x) R (I - s0 [w0]x) has by s1^a s0^b, the terms without w0 and w1 times ``still``.

    ``by0`` and ``by1`` are factors of those with w0 alone and with w1 alone.
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
    """Coefficients of [t + s1 v1]x Q - Q [s0 v0]x, added."""
    for a in range(degree):
        for b in range(degree):
            for i in range(3):
                i1, i2 = (i + 1) % 3, (i + 2) % 3
                for j in range(3):
                    j1, j2 = (j + 1) % 3, (j + 2) % 3
                    q1, q2 = Q[a, b, i1, j], Q[a, b, i2, j]
                    _add(out, place, degree, i, j, a, b, t[i1] * q2 - t[i2] * q1)
                    _add(out, place, degree, i, j, a + 1, b, v1[i1] * q2 - v1[i2] * q1)
                    turned = Q[a, b, i, j1] * v0[j2] - Q[a, b, i, j2] * v0[j1]
                    _add(out, place, degree, i, j, a, b + 1, -turned)


@compiled
def _add(
    out: FloatArray, place: NDArray[np.int64], degree: int, i: int, j: int, a: int, b: int, value: float
) -> None:
    """To the coefficient of entry i of frame 1 times s1^a and entry j of frame 0 times s0^b."""
    row = a if i == 0 else degree + (2 if i == 1 else 1) + a
    column = b if j == 0 else degree + (2 if j == 1 else 1) + b
    out[place[row, column]] += value
