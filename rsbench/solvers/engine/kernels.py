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

import numpy as np

from rsbench.compiled import compiled
from rsbench.core.so3 import FloatArray

Vector = tuple[float, float, float]

BEHIND = 1e12
"""Squared error, px^2, of a track that the motion puts behind the camera; no descent step ever accepts it."""


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
def _fill_rotation(phi: Vector, identity: float, skew: float, outer: float, out: FloatArray) -> None:
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


@compiled
def move(
    theta: FloatArray, twist: bool, tau0: float, tau1: float, R: FloatArray, A: FloatArray
) -> tuple[Vector, Vector, Vector]:
    """Motion of the body from tau0 to tau1: fills R and A (dR = [A dw]x R); T, dT/dtau0 and dT/dtau1."""
    a = tau1 - tau0
    w, v = (theta[0], theta[1], theta[2]), (theta[3], theta[4], theta[5])
    phi = times(a, w)
    s = dot(phi, phi)
    c0, c1, c2, _, _ = _coefficients(s)
    _fill_rotation(phi, 1.0 - c1 * s, c0, c1, R)
    _fill_rotation(phi, a * (1.0 - c2 * s), a * c1, a * c2, A)
    Rv = apply(R, v)
    if twist:
        return apply(A, v), times(-1.0, Rv), Rv
    turn = cross(w, Rv)
    return plus(times(tau1, v), -tau0, Rv), plus(times(-1.0, Rv), tau0, turn), plus(v, -tau0, turn)


@compiled
def translation_jacobian(
    theta: FloatArray,
    twist: bool,
    tau0: float,
    tau1: float,
    R: FloatArray,
    A: FloatArray,
    T_w: FloatArray,
    T_v: FloatArray,
) -> None:
    """Fill T_w = dT/dw and T_v = dT/dv, both (3, 3)."""
    v = (theta[3], theta[4], theta[5])
    if twist:
        a = tau1 - tau0
        _twist_by_w(a, times(a, (theta[0], theta[1], theta[2])), v, T_w)
        T_v[:] = A
        return
    Rv = apply(R, v)
    for j in range(3):
        column = cross((A[0, j], A[1, j], A[2, j]), Rv)
        for i in range(3):
            T_w[i, j] = -tau0 * column[i]
            T_v[i, j] = -tau0 * R[i, j]
        T_v[j, j] += tau1


@compiled
def _twist_by_w(a: float, phi: Vector, v: Vector, T_w: FloatArray) -> None:
    """dT/dw of T = a (v + b phi x v + c phi x (phi x v)), phi = a w."""
    _, b, c, db, dc = _coefficients(dot(phi, phi))
    once = cross(phi, v)
    along = plus(times(db, once), dc, cross(phi, once))
    pv = dot(phi, v)
    _fill_rotation(v, a * a * c * pv, -a * a * b, 0.0, T_w)
    for i in range(3):
        for j in range(3):
            T_w[i, j] += a * a * (c * (phi[i] * v[j] - 2 * v[i] * phi[j]) + along[i] * phi[j])


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
    R, A, T_w, T_v, J = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(6)
    w = (theta[0], theta[1], theta[2])
    for m in range(len(pairs)):
        x, y, offset = (pairs[m, 0], pairs[m, 1], 1.0), (pairs[m, 2], pairs[m, 3], 1.0), pairs[m, 6]
        tau0, tau1 = pairs[m, 4], pairs[m, 5]
        T, rate0, rate1 = move(theta, twist, tau0, tau1, R, A)
        Ro = (R[0, 0] * offset, R[1, 0] * offset, R[2, 0] * offset)
        T, turn = plus((T[0] + offset, T[1], T[2]), -1.0, Ro), cross(w, Ro)
        value, q = _pair_gradient(w, x, y, R, T, plus(rate0, 1.0, turn), plus(rate1, -1.0, turn), focal, h)
        qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
        residuals[m] = value / math.sqrt(qq) if qq > 0.0 else _displacement(apply(R, x), y, focal)
        if not want or qq <= 0.0:
            continue
        step = value / qq
        x = (x[0] - step * q[0] / focal[0], x[1] - step * q[1] / focal[1], 1.0)
        y = (y[0] - step * q[2] / focal[0], y[1] - step * q[3] / focal[1], 1.0)
        _pair_jacobian(
            theta, twist, x, y, tau0 - h * step * q[1], tau1 - h * step * q[3], offset, R, A, T_w, T_v, J
        )
        for i in range(6):
            gradient[i] += J[i] / math.sqrt(qq) * residuals[m]
            for j in range(6):
                H[i, j] += J[i] * J[j] / qq


@compiled
def _displacement(p: Vector, y: Vector, focal: FloatArray) -> float:
    """Error (px) of a pair where the camera only turns: its constraint vanishes, and would let anything pass."""
    if p[2] <= 0.0:
        return math.sqrt(BEHIND)
    return math.hypot(focal[0] * (y[0] - p[0] / p[2]), focal[1] * (y[1] - p[1] / p[2])) / math.sqrt(2.0)


@compiled
def _pair_gradient(
    w: Vector,
    x: Vector,
    y: Vector,
    R: FloatArray,
    T: Vector,
    rate0: Vector,
    rate1: Vector,
    focal: FloatArray,
    h: float,
) -> tuple[float, tuple[float, float, float, float]]:
    """Value of y^T [T]x R x, and its derivative by the four pixel coordinates; rates are T's by the times."""
    p = apply(R, x)
    n = cross(p, y)
    line, back = cross(T, p), apply_transposed(R, cross(y, T))
    spin = dot(w, y) * dot(T, p) - dot(w, T) * dot(y, p)
    by_y0 = back[1] / focal[1] + h * (dot(rate0, n) - spin)
    by_y1 = line[1] / focal[1] + h * (dot(rate1, n) + spin)
    return dot(T, n), (back[0] / focal[0], by_y0, line[0] / focal[0], by_y1)


@compiled
def _pair_jacobian(
    theta: FloatArray,
    twist: bool,
    x: Vector,
    y: Vector,
    tau0: float,
    tau1: float,
    offset: float,
    R: FloatArray,
    A: FloatArray,
    T_w: FloatArray,
    T_v: FloatArray,
    J: FloatArray,
) -> None:
    """Derivative (6,) of y^T [T]x R x by theta; R, A, T_w, T_v are work space."""
    T, _, _ = move(theta, twist, tau0, tau1, R, A)
    translation_jacobian(theta, twist, tau0, tau1, R, A, T_w, T_v)
    Ro = (R[0, 0] * offset, R[1, 0] * offset, R[2, 0] * offset)
    T = plus((T[0] + offset, T[1], T[2]), -1.0, Ro)
    p = apply(R, x)
    n = cross(p, y)
    turned = plus(plus(times(dot(T, p), y), -dot(y, p), T), -1.0, cross(Ro, n))
    by_w = plus(apply_transposed(A, turned), 1.0, apply_transposed(T_w, n))
    by_v = apply_transposed(T_v, n)
    for j in range(3):
        J[j], J[3 + j] = by_w[j], by_v[j]


@compiled
def count_in_front(theta: FloatArray, twist: bool, pairs: FloatArray) -> int:
    """How many pairs (n, 7) have both closest points in front of their cameras; parallel rays do not."""
    R, A = np.zeros((3, 3)), np.zeros((3, 3))
    count = 0
    for m in range(len(pairs)):
        y, offset = (pairs[m, 2], pairs[m, 3], 1.0), pairs[m, 6]
        T, _, _ = move(theta, twist, pairs[m, 4], pairs[m, 5], R, A)
        T = plus((T[0] + offset, T[1], T[2]), -offset, (R[0, 0], R[1, 0], R[2, 0]))
        p = apply(R, (pairs[m, 0], pairs[m, 1], 1.0))
        pp, yy, py, pT, yT = dot(p, p), dot(y, y), dot(p, y), dot(p, T), dot(y, T)
        if pp * yy - py * py > 1e-15 * pp * yy and py * yT > yy * pT and pp * yT > py * pT:
            count += 1
    return count
