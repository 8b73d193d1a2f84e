"""Compiled inner loops: exact rolling-shutter residuals and their normal equations.

The readable NumPy forms of the same quantities are in ``rsbench.core.epipolar``; the tests hold both together.

Parameters are ``theta = (w, v)``: v is the translation d of the paper's motion, or the linear part of a constant
twist. Between the times tau0 and tau1 the body moves by R = exp(a [w]x), a = tau1 - tau0, and

    paper  T = tau1 v - tau0 R v            (eq. 6, without its linearisation)
    twist  T = a J(a w) v

A Sampson cost needs the derivative of its own weights, or it shrinks v towards the zero where every constraint
vanishes. Taking the constraint's derivative at the corrected measurement gives just that gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numba import njit

from rsbench.core.so3 import FloatArray

F = TypeVar("F", bound=Callable[..., object])

BEHIND = 1e12
"""Squared error, px^2, of a track that the motion puts behind the camera; no descent step ever accepts it."""


def compiled(function: F) -> F:
    """Compile once per machine."""
    out: F = njit(cache=True)(function)
    return out


@compiled
def _cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@compiled
def _dot(a: FloatArray, b: FloatArray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _apply(R: FloatArray, a: FloatArray, out: FloatArray) -> None:
    for i in range(3):
        out[i] = R[i, 0] * a[0] + R[i, 1] * a[1] + R[i, 2] * a[2]


@compiled
def _apply_transposed(R: FloatArray, a: FloatArray, out: FloatArray) -> None:
    for i in range(3):
        out[i] = R[0, i] * a[0] + R[1, i] * a[1] + R[2, i] * a[2]


@compiled
def _coefficients(s: float) -> tuple[float, float, float, float, float]:
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
def _skew_add(a: FloatArray, scale: float, out: FloatArray) -> None:
    """out += scale [a]x."""
    out[0, 1] -= scale * a[2]
    out[1, 0] += scale * a[2]
    out[0, 2] += scale * a[1]
    out[2, 0] -= scale * a[1]
    out[1, 2] -= scale * a[0]
    out[2, 1] += scale * a[0]


@compiled
def _rotate(phi: FloatArray, R: FloatArray, J: FloatArray) -> None:
    """Fill R = exp([phi]x) and its left Jacobian."""
    s = _dot(phi, phi)
    c0, c1, c2, _, _ = _coefficients(s)
    for i in range(3):
        for j in range(3):
            R[i, j] = c1 * phi[i] * phi[j]
            J[i, j] = c2 * phi[i] * phi[j]
        R[i, i] += 1 - c1 * s
        J[i, i] += 1 - c2 * s
    _skew_add(phi, c0, R)
    _skew_add(phi, c1, J)


@compiled
def move(
    theta: FloatArray,
    twist: bool,
    tau0: float,
    tau1: float,
    R: FloatArray,
    A: FloatArray,
    T: FloatArray,
    T_w: FloatArray,
    T_v: FloatArray,
    T_rate: FloatArray,
) -> None:
    """Fill the motion of the body from tau0 to tau1 and its derivatives.

    dR = [A dw]x R, T_w = dT/dw, T_v = dT/dv, all (3, 3); T_rate (2, 3) = dT/dtau0, dT/dtau1.
    """
    a = tau1 - tau0
    w, v = theta[:3], theta[3:]
    phi, Rv, turn = a * w, np.zeros(3), np.zeros(3)
    _rotate(phi, R, A)
    for i in range(3):
        for j in range(3):
            A[i, j] *= a
    _apply(R, v, Rv)
    if twist:
        _apply(A, v, T)
        _twist_by_w(a, phi, v, T_w)
        for i in range(3):
            T_rate[0, i], T_rate[1, i] = -Rv[i], Rv[i]
            for j in range(3):
                T_v[i, j] = A[i, j]
        return
    _cross(w, Rv, turn)
    for j in range(3):
        T[j] = tau1 * v[j] - tau0 * Rv[j]
        T_rate[0, j] = -Rv[j] + tau0 * turn[j]
        T_rate[1, j] = v[j] - tau0 * turn[j]
        T_w[0, j] = -tau0 * (A[1, j] * Rv[2] - A[2, j] * Rv[1])
        T_w[1, j] = -tau0 * (A[2, j] * Rv[0] - A[0, j] * Rv[2])
        T_w[2, j] = -tau0 * (A[0, j] * Rv[1] - A[1, j] * Rv[0])
        for i in range(3):
            T_v[i, j] = -tau0 * R[i, j]
        T_v[j, j] += tau1


@compiled
def _twist_by_w(a: float, phi: FloatArray, v: FloatArray, T_w: FloatArray) -> None:
    """dT/dw of T = a (v + b phi x v + c phi x (phi x v)), phi = a w."""
    _, b, c, db, dc = _coefficients(_dot(phi, phi))
    once, twice = np.zeros(3), np.zeros(3)
    _cross(phi, v, once)
    _cross(phi, once, twice)
    pv = _dot(phi, v)
    for i in range(3):
        for j in range(3):
            T_w[i, j] = c * (phi[i] * v[j] - 2 * v[i] * phi[j]) + (db * once[i] + dc * twice[i]) * phi[j]
        T_w[i, i] += c * pv
    _skew_add(v, -b, T_w)
    for i in range(3):
        for j in range(3):
            T_w[i, j] *= a * a


@compiled
def pair_terms(
    theta: FloatArray,
    twist: bool,
    pairs: FloatArray,
    focal: FloatArray,
    h: float,
    residuals: FloatArray,
    H: FloatArray,
    gradient: FloatArray,
    want: bool,
) -> None:
    """Sampson residuals of left or right pairs, and the normal equations of half their sum of squares.

    Args:
        theta: (6,) w and v.
        pairs: (n, 7) ray 0 (x, y), ray 1 (x, y), tau0, tau1, x of the camera's offset from the body in metres.
        focal: (2,) fx, fy in pixels; h: frame periods per row.
        residuals: (n,) filled, in pixels.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    R, A, T_w, T_v = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    T, T_rate, x, y, Ro, J = np.zeros(3), np.zeros((2, 3)), np.ones(3), np.ones(3), np.zeros(3), np.zeros(6)
    q = np.zeros(4)
    for m in range(len(pairs)):
        x[0], x[1], y[0], y[1] = pairs[m, 0], pairs[m, 1], pairs[m, 2], pairs[m, 3]
        move(theta, twist, pairs[m, 4], pairs[m, 5], R, A, T, T_w, T_v, T_rate)
        offset = pairs[m, 6]
        for i in range(3):
            Ro[i] = R[i, 0] * offset
            T[i] -= Ro[i]
        T[0] += offset
        value = _pair_gradient(theta, x, y, R, T, T_rate, Ro, focal, h, q)
        qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
        residuals[m] = value / math.sqrt(qq) if qq > 0.0 else 0.0
        if not want or qq <= 0.0:
            continue
        step = value / qq
        for i in range(2):
            x[i] -= step * q[i] / focal[i]
            y[i] -= step * q[2 + i] / focal[i]
        _pair_jacobian(x, y, R, A, T, T_w, T_v, Ro, J)
        for i in range(6):
            gradient[i] += J[i] / math.sqrt(qq) * residuals[m]
            for j in range(6):
                H[i, j] += J[i] * J[j] / qq


@compiled
def _pair_gradient(
    theta: FloatArray,
    x: FloatArray,
    y: FloatArray,
    R: FloatArray,
    T: FloatArray,
    T_rate: FloatArray,
    Ro: FloatArray,
    focal: FloatArray,
    h: float,
    q: FloatArray,
) -> float:
    """Value of y^T [T]x R x; its derivative by the four pixel coordinates goes to q."""
    w = theta[:3]
    p, n, G, line, back, turn = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    _apply(R, x, p)
    _cross(p, y, n)
    _cross(T, p, line)
    _cross(y, T, G)
    _apply_transposed(R, G, back)
    _cross(w, Ro, turn)
    Tp, yp = _dot(T, p), _dot(y, p)
    spin = 0.0
    for i in range(3):
        spin += w[i] * (y[i] * Tp - T[i] * yp)
    rate0 = _dot(T_rate[0], n) + _dot(turn, n) - spin
    rate1 = _dot(T_rate[1], n) - _dot(turn, n) + spin
    q[0], q[1] = back[0] / focal[0], back[1] / focal[1] + h * rate0
    q[2], q[3] = line[0] / focal[0], line[1] / focal[1] + h * rate1
    return _dot(T, n)


@compiled
def _pair_jacobian(
    x: FloatArray,
    y: FloatArray,
    R: FloatArray,
    A: FloatArray,
    T: FloatArray,
    T_w: FloatArray,
    T_v: FloatArray,
    Ro: FloatArray,
    J: FloatArray,
) -> None:
    """Derivative (6,) of y^T [T]x R x by theta; T includes the camera's offset, T_w only the body's motion."""
    p, n, turn = np.zeros(3), np.zeros(3), np.zeros(3)
    _apply(R, x, p)
    _cross(p, y, n)
    _cross(Ro, n, turn)
    Tp, yp = _dot(T, p), _dot(y, p)
    for j in range(3):
        J[j], J[3 + j] = 0.0, 0.0
        for i in range(3):
            J[j] += A[i, j] * (y[i] * Tp - T[i] * yp - turn[i]) + T_w[i, j] * n[i]
            J[3 + j] += T_v[i, j] * n[i]


@compiled
def count_in_front(theta: FloatArray, twist: bool, pairs: FloatArray) -> int:
    """How many pairs (n, 7) have both closest points in front of their cameras; parallel rays do not."""
    R, A, T_w, T_v = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    T, T_rate, x, y, p = np.zeros(3), np.zeros((2, 3)), np.ones(3), np.ones(3), np.zeros(3)
    count = 0
    for m in range(len(pairs)):
        x[0], x[1], y[0], y[1] = pairs[m, 0], pairs[m, 1], pairs[m, 2], pairs[m, 3]
        move(theta, twist, pairs[m, 4], pairs[m, 5], R, A, T, T_w, T_v, T_rate)
        for i in range(3):
            T[i] -= R[i, 0] * pairs[m, 6]
        T[0] += pairs[m, 6]
        _apply(R, x, p)
        pp, yy, py, pT, yT = _dot(p, p), _dot(y, y), _dot(p, y), _dot(p, T), _dot(y, T)
        if pp * yy - py * py > 1e-15 * pp * yy and py * yT > yy * pT and pp * yT > py * pT:
            count += 1
    return count
