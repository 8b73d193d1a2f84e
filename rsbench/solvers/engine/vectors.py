"""Compiled vector algebra: vectors as tuples, which need no memory, rotations as (3, 3) arrays.

The readable NumPy forms are in ``rsbench.core.so3``.
"""

from __future__ import annotations

import math

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray

Vector = tuple[float, float, float]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def plus(a: Vector, scale: float, b: Vector) -> Vector:
    """a + scale b."""
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


@compiled
def times(scale: float, a: Vector) -> Vector:
    return (scale * a[0], scale * a[1], scale * a[2])


@compiled
def apply(R: FloatArray, a: Vector) -> Vector:
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@compiled
def apply_transposed(R: FloatArray, a: Vector) -> Vector:
    return (
        R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
        R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
        R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2],
    )


@compiled
def coefficients(s: float) -> tuple[float, float, float, float, float]:
    """sin t/t, b = (1 - cos t)/t^2, c = (t - sin t)/t^3 of s = t^2, then b'/t and c'/t."""
    if s < 1e-2:  # the closed forms cancel
        a = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
        b = 0.5 - s / 24 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90)))
        c = 1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72 * (1 - s / 110)))
        db = -1 / 12 + s / 180 * (1 - s * 3 / 112 * (1 - s / 67.5))
        dc = -1 / 60 + s / 1260 * (1 - s / 48 * (1 - s / 82.5))
        return a, b, c, db, dc
    t = math.sqrt(s)
    a = math.sin(t) / t
    b = 2 * math.sin(t / 2) ** 2 / s
    c = (1 - a) / s
    return a, b, c, (a - 2 * b) / s, (b - 3 * c) / s


@compiled
def fill_rotation(phi: Vector, identity: float, skew: float, outer: float, out: FloatArray) -> None:
    """out = identity I + skew [phi]x + outer phi phi^T."""
    for i in range(3):
        for j in range(i, 3):
            out[i, j] = outer * phi[i] * phi[j]
            out[j, i] = out[i, j]
        out[i, i] += identity
    out[0, 1] -= skew * phi[2]
    out[1, 0] += skew * phi[2]
    out[0, 2] += skew * phi[1]
    out[2, 0] -= skew * phi[1]
    out[1, 2] -= skew * phi[0]
    out[2, 1] += skew * phi[0]
