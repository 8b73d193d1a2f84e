"""Compiled: poses of a spline at times, and their derivatives by its control poses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_spline import Curve
from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.vectors import Vector, apply, coefficients, dot, fill_rotation, plus, times


class Views(NamedTuple):
    """Poses at n times."""

    index: NDArray[np.int64]
    """(n,) the first of the four control poses that a time feels."""
    R: FloatArray
    """(n, 3, 3) body_from_world."""
    p: FloatArray
    """(n, 3) in the world, metres."""
    spin: FloatArray
    """(n, 3) dR/dtau = [spin]x R."""
    speed: FloatArray
    """(n, 3) dp/dtau."""
    turn: FloatArray
    """(n, 4, 3, 3) how the body turns when a control pose does, each about its own axes."""
    share: FloatArray
    """(n, 4) how p moves when a control pose does."""


@compiled(error_model="numpy")
def blank_views(count: int) -> Views:
    """Room for so many poses."""
    return Views(
        np.zeros(count, dtype=np.int64),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 4, 3, 3)),
        np.zeros((count, 4)),
    )


@compiled(error_model="numpy")
def fill_views(curve: Curve, taus: FloatArray, views: Views) -> None:
    """The poses at times (n,)."""
    work = np.zeros((5, 3, 3))
    for k in range(len(taus)):
        fill_view(curve, taus[k], views, k, work)


@compiled(error_model="numpy")
def fill_view(curve: Curve, tau: float, views: Views, k: int, work: FloatArray) -> None:
    """The pose at one time, as number ``k``; work (5, 3, 3)."""
    count = len(curve.p)
    place = (tau - curve.first) / curve.interval
    i = min(max(math.floor(place), 0), count - 4)
    u = place - i
    b = ((5 + u * (3 + u * (u - 3))) / 6, (1 + u * (3 + u * (3 - 2 * u))) / 6, u * u * u / 6)
    rates = (0.5 + u * (0.5 * u - 1), 0.5 + u * (1 - u), 0.5 * u * u)
    views.index[k] = i
    views.share[k, 0], views.share[k, 1] = 1 - b[0], b[0] - b[1]
    views.share[k, 2], views.share[k, 3] = b[1] - b[2], b[2]
    p, speed = _row(curve.p, i), (0.0, 0.0, 0.0)
    for j in range(3):
        along = plus(_row(curve.p, i + j + 1), -1.0, _row(curve.p, i + j))
        p, speed = plus(p, b[j], along), plus(speed, rates[j] / curve.interval, along)
    _set(views.p, k, p)
    _set(views.speed, k, speed)
    _fill_turn(curve, i, b, rates, views, k, work)


@compiled(error_model="numpy")
def _fill_turn(curve: Curve, i: int, b: Vector, rates: Vector, views: Views, k: int, work: FloatArray) -> None:
    """Rotation, its rate and its derivatives: from the last factor to the first."""
    before, factor, jacobian, product, by_step = work[0], work[1], work[2], work[3], work[4]
    turn, spin = views.turn[k], (0.0, 0.0, 0.0)
    for m in range(3):
        for n in range(3):
            before[m, n], turn[3, m, n] = 1.0 if m == n else 0.0, 0.0
    for j in range(2, -1, -1):
        step, inverse = _row(curve.steps, i + j), curve.inverse_left[i + j]
        spin = plus(spin, rates[j] / curve.interval, apply(before, step))
        phi = times(b[j], step)
        one, half, sixth, _, _ = coefficients(dot(phi, phi))
        fill_rotation(phi, 1.0 - half * dot(phi, phi), one, half, factor)
        fill_rotation(phi, one, half, sixth, jacobian)
        _multiply(before, jacobian, product)
        _multiply(product, inverse, by_step)
        for m in range(3):
            for n in range(3):
                turn[j + 1, m, n] += b[j] * by_step[m, n]
        _multiply_transposed(product, inverse, by_step)
        for m in range(3):
            for n in range(3):
                turn[j, m, n] = -b[j] * by_step[m, n]
        _multiply(before, factor, product)
        before, product = product, before  # to copy one takes seconds to compile, for the error of unlike shapes
    for m in range(3):
        for n in range(3):
            turn[0, m, n] += before[m, n]
    _multiply(before, curve.R[i], views.R[k])
    _set(views.spin, k, spin)


@compiled(error_model="numpy")
def _row(rows: FloatArray, i: int) -> Vector:
    return (rows[i, 0], rows[i, 1], rows[i, 2])


@compiled(error_model="numpy")
def _set(rows: FloatArray, i: int, value: Vector) -> None:
    rows[i, 0], rows[i, 1], rows[i, 2] = value


@compiled(error_model="numpy")
def _multiply(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for m in range(3):
        for n in range(3):
            out[m, n] = a[m, 0] * b[0, n] + a[m, 1] * b[1, n] + a[m, 2] * b[2, n]


@compiled(error_model="numpy")
def _multiply_transposed(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """a b^T."""
    for m in range(3):
        for n in range(3):
            out[m, n] = a[m, 0] * b[n, 0] + a[m, 1] * b[n, 1] + a[m, 2] * b[n, 2]
