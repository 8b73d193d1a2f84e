"""Compiled inner loop of four-view tracks whose four ends have times of their own: a bundle adjustment.

A lens bends rows, so that both cameras read a point at different times; so do other scans and a late right camera.
What ``track_kernels`` puts into three equations is then the reprojection error of the best point: each track has
a point of its own, (x, y, 1) / rho in the left camera at the time of its first end, which few Gauss-Newton steps
find and the normal equations leave out (Schur complement; Triggs et al., Bundle Adjustment, 2000). A pixel that is
shifted is also read at another time, which counts in the noise of an end. Nothing here is linear in the motion or
in the lens but for those last steps.
"""

from __future__ import annotations

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel
from rsbench.solvers.engine.kernels import BEHIND, NEAREST
from rsbench.solvers.engine.vectors import Vector, apply, cross, dot, plus, times

_POINT_STEPS = 2
"""Steps to the best point: an error of 1 px leaves 1e-3 px after one and 1e-9 after two."""


@compiled
def timed_track_terms(
    theta: FloatArray,
    kernel: MotionKernel,
    tracks: FloatArray,
    focal: FloatArray,
    baseline: float,
    squares: FloatArray,
    H: FloatArray,
    gradient: FloatArray,
    want: bool,
) -> None:
    """Squared reprojection errors of the best points of tracks, and the normal equations of half their sum.

    Args:
        theta: (6,) w and v.
        tracks: (n, 4, 9) ends left 0, right 0, left 1, right 1: ray (x, y), tau, derivative of the ideal pixel by
            the pixel (2 x 2, rows first), derivative of tau by the pixel (2).
        focal: (2,) fx, fy in pixels; baseline: metres.
        squares: (n,) filled, px^2: chi-squared with 5 degrees of freedom at a noise of 1 px.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    e, D, W = np.zeros(8), np.zeros((8, 9)), np.zeros((4, 2, 2))
    N, inverse, Q = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((6, 3))
    work = np.zeros((6, 3, 3))
    for k in range(len(tracks)):
        if not linearise_best(theta, kernel, tracks[k], focal, baseline, e, D, W, N, inverse, work):
            squares[k] = BEHIND
            continue
        squares[k] = 0.0
        for i in range(8):
            squares[k] += e[i] * e[i]
        if want:
            _add_reduced(D, e, inverse, Q, H, gradient)


@compiled
def linearise_best(
    theta: FloatArray,
    kernel: MotionKernel,
    ends: FloatArray,
    focal: FloatArray,
    baseline: float,
    e: FloatArray,
    D: FloatArray,
    W: FloatArray,
    N: FloatArray,
    inverse: FloatArray,
    work: FloatArray,
) -> bool:
    """Errors and derivatives of one track at its best point; False when the ends determine none before a camera.

    Args:
        ends: (4, 9) of the track.
        e, D, W: see ``_linearise``; N, inverse: (3, 3) normal matrix of the point, and its inverse.
        work: (6, 3, 3); the last two hold the pixels' velocities, see ``_linearise``.
    """
    point = _first_point(theta, kernel, ends, baseline, work)
    for step in range(_POINT_STEPS + 1):
        if step > 0:
            g = (_column(D, 0, e), _column(D, 1, e), _column(D, 2, e))
            point = plus(point, -1.0, apply(inverse, g))
        # Weighed where it starts. A literal True would compile _linearise once more.
        seen = _linearise(theta, kernel, ends, focal, baseline, point, e, D, W, work, step == 0)
        if not (seen and _fill_inverse(D, N, inverse)):
            return False
    return True


@compiled
def _first_point(
    theta: FloatArray, kernel: MotionKernel, ends: FloatArray, baseline: float, work: FloatArray
) -> Vector:
    """x, y and inverse depth of the point that the stereo pair of frame 0 shows; rho is NaN for none."""
    R, A = work[0], work[1]
    x, half = (ends[0, 0], ends[0, 1], 1.0), 0.5 * baseline
    T, _, _, _, _ = kernel.move(theta, ends[0, 2], ends[1, 2], R, A)
    a = apply(R, x)
    b = plus((T[0] - half, T[1], T[2]), -half, (R[0, 0], R[1, 0], R[2, 0]))
    above = below = 0.0
    for i in range(2):
        factor = b[i] - ends[1, i] * b[2]
        above += factor * (ends[1, i] * a[2] - a[i])
        below += factor * factor
    return x[0], x[1], above / below if below > 0.0 else np.nan


@compiled
def _linearise(
    theta: FloatArray,
    kernel: MotionKernel,
    ends: FloatArray,
    focal: FloatArray,
    baseline: float,
    point: Vector,
    e: FloatArray,
    D: FloatArray,
    W: FloatArray,
    work: FloatArray,
    weigh: bool,
) -> bool:
    """Fill whitened errors e (8,) and their derivative D (8, 9) by the point and theta; False behind a camera.

    ``weigh`` fills W (4, 2, 2) too, which takes errors in ideal pixels to pixels of unit noise. ``work[4:]`` gets
    the derivatives of the predicted pixels of the right camera's frame 0 and of frame 1 (columns) by the time of
    the first end (4) and by their own (5): x and y in the first two rows. That of the first end does not move.
    """
    R, A, T_w, T_v = work[0], work[1], work[2], work[3]
    half, rho = 0.5 * baseline, point[2]
    start = plus((point[0], point[1], 1.0), -rho, (half, 0.0, 0.0))
    for i in range(4):
        offset = half if i % 2 == 0 else -half
        T, rate0, rate, spin0, spin = kernel.move(theta, ends[0, 2], ends[i, 2], R, A)
        kernel.translation_jacobian(theta, ends[0, 2], ends[i, 2], R, A, T_w, T_v)
        turned = apply(R, start)
        p = plus(plus(turned, rho, T), rho, (offset, 0.0, 0.0))
        if not p[2] > NEAREST:
            return False
        u, v = p[0] / p[2], p[1] / p[2]
        moved = plus(times(rho, rate), 1.0, cross(spin, turned))
        vx, vy = focal[0] * (moved[0] - u * moved[2]) / p[2], focal[1] * (moved[1] - v * moved[2]) / p[2]
        if i > 0:
            _fill_velocities(plus(times(rho, rate0), 1.0, cross(spin0, turned)), p, vx, vy, focal, work, i - 1)
        if weigh:
            _fill_weight(ends[i], vx, vy, W[i])
        whiten(W[i], focal[0] * (ends[i, 0] - u), focal[1] * (ends[i, 1] - v), i, e)
        by_rho = plus(plus(T, 1.0, (offset, 0.0, 0.0)), -half, (R[0, 0], R[1, 0], R[2, 0]))
        for j in range(9):
            if j < 2:
                q = (R[0, j], R[1, j], R[2, j])
            elif j == 2:
                q = by_rho
            elif j < 6:
                q = plus(cross((A[0, j - 3], A[1, j - 3], A[2, j - 3]), turned), rho, _of(T_w, j - 3))
            else:
                q = times(rho, _of(T_v, j - 6))
            gx, gy = -focal[0] * (q[0] - u * q[2]) / p[2], -focal[1] * (q[1] - v * q[2]) / p[2]
            whiten(W[i], gx, gy, i, D[:, j])
    return True


@compiled
def _fill_velocities(
    first: Vector, p: Vector, vx: float, vy: float, focal: FloatArray, work: FloatArray, column: int
) -> None:
    """Of a predicted pixel by the time of the first end, whose point moves by ``first``, and by its own."""
    work[4, 0, column] = focal[0] * (first[0] - p[0] / p[2] * first[2]) / p[2]
    work[4, 1, column] = focal[1] * (first[1] - p[1] / p[2] * first[2]) / p[2]
    work[5, 0, column], work[5, 1, column] = vx, vy


@compiled
def _of(M: FloatArray, j: int) -> Vector:
    return (M[0, j], M[1, j], M[2, j])


@compiled
def _fill_weight(end: FloatArray, vx: float, vy: float, W: FloatArray) -> None:
    """W = (L - v s^T)^-1: the ideal pixel moves by L, the prediction by its velocity times the time's slope s."""
    a, b = end[3] - vx * end[7], end[4] - vx * end[8]
    c, d = end[5] - vy * end[7], end[6] - vy * end[8]
    det = a * d - b * c
    W[0, 0], W[0, 1], W[1, 0], W[1, 1] = d / det, -b / det, -c / det, a / det


@compiled
def whiten(W: FloatArray, x: float, y: float, i: int, out: FloatArray) -> None:
    out[2 * i], out[2 * i + 1] = W[0, 0] * x + W[0, 1] * y, W[1, 0] * x + W[1, 1] * y


@compiled
def _column(D: FloatArray, j: int, e: FloatArray) -> float:
    total = 0.0
    for i in range(8):
        total += D[i, j] * e[i]
    return total


@compiled
def _fill_inverse(D: FloatArray, N: FloatArray, out: FloatArray) -> bool:
    """Inverse of the point's normal matrix; False when the ends do not determine the point."""
    for i in range(3):
        for j in range(3):
            N[i, j] = 0.0
            for n in range(8):
                N[i, j] += D[n, i] * D[n, j]
    first, second = (N[0, 0], N[1, 0], N[2, 0]), (N[0, 1], N[1, 1], N[2, 1])
    third = (N[0, 2], N[1, 2], N[2, 2])
    rows = (cross(second, third), cross(third, first), cross(first, second))
    det = dot(first, rows[0])
    if not det > 1e-14 * N[0, 0] * N[1, 1] * N[2, 2]:
        return False
    for i in range(3):
        for j in range(3):
            out[i, j] = rows[i][j] / det
    return True


@compiled
def _add_reduced(
    D: FloatArray, e: FloatArray, inverse: FloatArray, Q: FloatArray, H: FloatArray, gradient: FloatArray
) -> None:
    """Normal equations (6) without the point: H += Dt^T Dt - Q N^-1 Q^T with Q = Dt^T Dp."""
    g = (_column(D, 0, e), _column(D, 1, e), _column(D, 2, e))
    best = apply(inverse, g)
    for i in range(6):
        for j in range(3):
            Q[i, j] = _column(D, 3 + i, D[:, j])
    for i in range(6):
        q = apply(inverse, (Q[i, 0], Q[i, 1], Q[i, 2]))
        gradient[i] += _column(D, 3 + i, e) - dot((Q[i, 0], Q[i, 1], Q[i, 2]), best)
        for j in range(6):
            H[i, j] += _column(D, 3 + i, D[:, 3 + j]) - dot(q, (Q[j, 0], Q[j, 1], Q[j, 2]))
