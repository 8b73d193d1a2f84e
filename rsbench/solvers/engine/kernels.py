"""Compiled inner loops: exact rolling-shutter residuals of pairs and their normal equations.

The readable NumPy forms of the same quantities are in ``rsbench.core.epipolar``, each named where it is; the tests
hold both together. Parameters are ``theta = (w, v)``; the motion model is a ``MotionKernel``.

A Sampson cost needs the derivative of its own weights, or it shrinks v towards the zero where every constraint
vanishes. Taking the constraint's derivative at the corrected measurement gives just that gradient.
"""

from __future__ import annotations

import math

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel
from rsbench.solvers.engine.vectors import (
    Vector,
    apply,
    apply_transposed,
    cross,
    dot,
    plus,
    times,
)

Matrix = tuple[float, float, float, float]
BEHIND = 1e12
"""Squared error, px^2, of a track that the motion puts behind the camera; no descent step ever accepts it."""
NEAREST = 1e-6
"""Least ratio of a track's depths in frame 1 and frame 0."""


@compiled
def pair_terms(
    theta: FloatArray,
    kernel: MotionKernel,
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
        pairs: (n, 7) ray 0 (x, y), ray 1 (x, y), tau0, tau1, x of the camera's offset from the body in metres; or
            (n, 17) with what ``at_pixels`` names, where the lens or the scan make it differ.
        focal: (2,) fx, fy in pixels; h: frame periods per row, of pairs (n, 7).
        residuals: (n,) filled, in pixels.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    R, A, T_w, T_v, J = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(6)
    for m in range(len(pairs)):
        x, y, offset = (pairs[m, 0], pairs[m, 1], 1.0), (pairs[m, 2], pairs[m, 3], 1.0), pairs[m, 6]
        tau0, tau1 = pairs[m, 4], pairs[m, 5]
        T, rate0, rate1, spin0, spin1 = kernel.move(theta, tau0, tau1, R, A)
        Ro = (R[0, 0] * offset, R[1, 0] * offset, R[2, 0] * offset)
        T = plus((T[0] + offset, T[1], T[2]), -1.0, Ro)
        rate0, rate1 = plus(rate0, -1.0, cross(spin0, Ro)), plus(rate1, -1.0, cross(spin1, Ro))
        L0, L1, slope = at_pixels(pairs, m, h)
        value, q = pair_gradient(x, y, R, T, rate0, rate1, spin0, spin1, focal, L0, L1, slope)
        qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
        residuals[m] = value / math.sqrt(qq) if qq > 0.0 else displacement(apply(R, x), y, focal)
        if not want or qq <= 0.0:
            continue
        step = value / qq
        x, y = shifted(x, L0, step * q[0], step * q[1], focal), shifted(y, L1, step * q[2], step * q[3], focal)
        tau0 -= slope[1] * step * q[1] + slope[0] * step * q[0]
        tau1 -= slope[1] * step * q[3] + slope[0] * step * q[2]
        pair_jacobian(theta, kernel, x, y, tau0, tau1, offset, R, A, T_w, T_v, J)
        for i in range(6):
            gradient[i] += J[i] / math.sqrt(qq) * residuals[m]
            for j in range(6):
                H[i, j] += J[i] * J[j] / qq


@compiled
def at_pixels(pairs: FloatArray, m: int, h: float) -> tuple[Matrix, Matrix, tuple[float, float]]:
    """Derivatives of both ideal pixels by the pixels (2 x 2, rows first), and of tau by the pixel."""
    if pairs.shape[1] == 7:
        return (1.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.0), (0.0, h)
    return (
        (pairs[m, 7], pairs[m, 8], pairs[m, 9], pairs[m, 10]),
        (pairs[m, 11], pairs[m, 12], pairs[m, 13], pairs[m, 14]),
        (pairs[m, 15], pairs[m, 16]),
    )


@compiled
def shifted(ray: Vector, L: Matrix, dx: float, dy: float, focal: FloatArray) -> Vector:
    """The ray of a pixel that is (dx, dy) less."""
    return (ray[0] - (L[0] * dx + L[1] * dy) / focal[0], ray[1] - (L[2] * dx + L[3] * dy) / focal[1], 1.0)


@compiled
def displacement(p: Vector, y: Vector, focal: FloatArray) -> float:
    """Error (px) of a pair where the camera only turns: its constraint vanishes, and would let anything pass."""
    if p[2] <= 0.0:
        return math.sqrt(BEHIND)
    return math.hypot(focal[0] * (y[0] - p[0] / p[2]), focal[1] * (y[1] - p[1] / p[2])) / math.sqrt(2.0)


@compiled
def pair_gradient(
    x: Vector,
    y: Vector,
    R: FloatArray,
    T: Vector,
    rate0: Vector,
    rate1: Vector,
    spin0: Vector,
    spin1: Vector,
    focal: FloatArray,
    L0: Matrix,
    L1: Matrix,
    slope: tuple[float, float],
) -> tuple[float, Matrix]:
    """Value of y^T [T]x R x, and its derivative by the four pixel coordinates; NumPy: ``epipolar.rs_constraint``.

    The paper's (7) before its linearisation: E = [T]x R of (6). The rates are T's by the two times, the spins R's.
    """
    p = apply(R, x)
    n = cross(p, y)
    line, back = cross(T, p), apply_transposed(R, cross(y, T))
    turn0 = dot(spin0, y) * dot(T, p) - dot(spin0, T) * dot(y, p)
    turn1 = dot(spin1, y) * dot(T, p) - dot(spin1, T) * dot(y, p)
    time0, time1 = dot(rate0, n) + turn0, dot(rate1, n) + turn1
    bx, by, lx, ly = back[0] / focal[0], back[1] / focal[1], line[0] / focal[0], line[1] / focal[1]
    by_x0, by_y0 = L0[0] * bx + L0[2] * by + slope[0] * time0, L0[1] * bx + L0[3] * by + slope[1] * time0
    by_x1, by_y1 = L1[0] * lx + L1[2] * ly + slope[0] * time1, L1[1] * lx + L1[3] * ly + slope[1] * time1
    return dot(T, n), (by_x0, by_y0, by_x1, by_y1)


@compiled
def pair_jacobian(
    theta: FloatArray,
    kernel: MotionKernel,
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
    T, _, _, _, _ = kernel.move(theta, tau0, tau1, R, A)
    kernel.translation_jacobian(theta, tau0, tau1, R, A, T_w, T_v)
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
def count_in_front(theta: FloatArray, kernel: MotionKernel, pairs: FloatArray) -> int:
    """How many pairs (n, 7 or 17) have both closest points in front of their cameras; parallel rays do not."""
    R, A = np.zeros((3, 3)), np.zeros((3, 3))
    count = 0
    for m in range(len(pairs)):
        y, offset = (pairs[m, 2], pairs[m, 3], 1.0), pairs[m, 6]
        T, _, _, _, _ = kernel.move(theta, pairs[m, 4], pairs[m, 5], R, A)
        T = plus((T[0] + offset, T[1], T[2]), -offset, (R[0, 0], R[1, 0], R[2, 0]))
        p = apply(R, (pairs[m, 0], pairs[m, 1], 1.0))
        pp, yy, py, pT, yT = dot(p, p), dot(y, y), dot(p, y), dot(p, T), dot(y, T)
        if pp * yy - py * py > 1e-15 * pp * yy and py * yT > yy * pT and pp * yT > py * pT:
            count += 1
    return count
