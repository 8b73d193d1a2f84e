"""Compiled inner loop of four-view tracks: the first-order form of a rolling-shutter bundle adjustment.

Both cameras read a row at the same time, so a stereo pair is an ordinary rectified pair. In the camera halfway
between both, ``m = (x, y, disparity)`` with x = (xl + xr)/2, y = (yl + yr)/2 holds all that the pair says about
the point; its three parts have independent noise of variance (1/2, 1/2, 2). What is left, yl - yr, is
independent of m and of the motion. The body's motion then predicts m of frame 1 from m of frame 0:

    p = R ray(x0, y0) + rho0 T,   rho0 = disparity0 / (fx baseline) = 1 / z0
    x1 = fx p_x / p_z + cx,  y1 = fy p_y / p_z + cy,  disparity1 = disparity0 / p_z

Whitened with the noise of both frames (multi-constraint Sampson error), these three equations are the reprojection
error of the best point, to first order. They stay regular without motion and for points at infinity. Their NumPy
form is ``rsbench.core.epipolar.rs_stereo_transfer``.
"""

from __future__ import annotations

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel
from rsbench.solvers.engine.kernels import BEHIND, NEAREST
from rsbench.solvers.engine.timed_tracks import timed_track_terms
from rsbench.solvers.engine.vectors import (
    Vector,
    apply,
    apply_transposed,
    cross,
    dot,
    plus,
    times,
)

_VARIANCE = (0.5, 0.5, 2.0)


@compiled
def _invert_symmetric(S: FloatArray, out: FloatArray) -> None:
    """Inverse of a symmetric positive definite (3, 3) matrix by cofactors."""
    c00 = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    c01 = S[0, 2] * S[1, 2] - S[0, 1] * S[2, 2]
    c02 = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    det = S[0, 0] * c00 + S[0, 1] * c01 + S[0, 2] * c02
    out[0, 0], out[0, 1], out[0, 2] = c00 / det, c01 / det, c02 / det
    out[1, 1] = (S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2]) / det
    out[1, 2] = (S[0, 1] * S[0, 2] - S[0, 0] * S[1, 2]) / det
    out[2, 2] = (S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]


@compiled
def _predict(p: Vector, disparity: float, focal: FloatArray, by_p: FloatArray) -> Vector:
    """Prediction, relative to the principal point; fills its derivative by_p (3, 3) by p."""
    iz = 1.0 / p[2]
    m = (focal[0] * p[0] * iz, focal[1] * p[1] * iz, disparity * iz)
    by_p[0, 0], by_p[1, 1] = focal[0] * iz, focal[1] * iz
    by_p[0, 2], by_p[1, 2], by_p[2, 2] = -m[0] * iz, -m[1] * iz, -m[2] * iz
    return m


@compiled
def track_terms(
    theta: FloatArray,
    kernel: MotionKernel,
    tracks: FloatArray,
    focal: FloatArray,
    h: float,
    baseline: float,
    squares: FloatArray,
    H: FloatArray,
    gradient: FloatArray,
    want: bool,
) -> None:
    """Squared whitened errors of tracks, and the normal equations of half their sum.

    Tracks (n, 4, 9), whose four ends have times of their own, are those of ``timed_tracks``.

    Args:
        theta: (6,) w and v.
        tracks: (n, 8) ray 0 (x, y) and disparity 0; x, y relative to the principal point and disparity of
            frame 1, px; tau0, tau1. All of the camera halfway between both.
        focal: (2,) fx, fy in pixels; h: frame periods per row; baseline: metres.
        squares: (n,) filled, px^2: chi-squared with 3 degrees of freedom at a noise of 1 px.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    if tracks.ndim == 3:  # known when compiled: only what is called is
        timed_track_terms(theta, kernel, tracks, focal, baseline, squares, H, gradient, want)
        return
    R, A, by_p, S, W = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    D0, D1, T_w, T_v = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    C, WC = np.zeros((3, 6)), np.zeros((3, 6))
    for k in range(len(tracks)):
        x, disparity, tau0, tau1 = (tracks[k, 0], tracks[k, 1], 1.0), tracks[k, 2], tracks[k, 6], tracks[k, 7]
        rho = disparity / (focal[0] * baseline)
        T, rate0, rate1, spin0, spin1 = kernel.move(theta, tau0, tau1, R, A)
        turned = apply(R, x)
        p = plus(turned, rho, T)
        if p[2] <= NEAREST:
            squares[k] = BEHIND
            continue
        m = _predict(p, disparity, focal, by_p)
        c = (tracks[k, 3] - m[0], tracks[k, 4] - m[1], tracks[k, 5] - m[2])
        rate0 = plus(times(rho, rate0), 1.0, cross(spin0, turned))
        rate1 = plus(times(rho, rate1), 1.0, cross(spin1, turned))
        _track_gradients(R, T, rate0, rate1, p[2], by_p, focal, h, baseline, D0, D1)
        _whitening(D0, D1, S, W)
        lam = apply(W, c)
        squares[k] = dot(c, lam)
        if not want:
            continue
        step = apply_variance(apply_transposed(D0, lam))
        x, disparity = (x[0] - step[0] / focal[0], x[1] - step[1] / focal[1], 1.0), disparity - step[2]
        kernel.translation_jacobian(theta, tau0, tau1, R, A, T_w, T_v)
        if _track_jacobian(x, disparity, R, A, T, T_w, T_v, focal, baseline, by_p, C):
            _add_normal(C, WC, W, lam, H, gradient)


@compiled
def apply_variance(a: Vector) -> Vector:
    return (_VARIANCE[0] * a[0], _VARIANCE[1] * a[1], _VARIANCE[2] * a[2])


@compiled
def _whitening(D0: FloatArray, D1: FloatArray, S: FloatArray, W: FloatArray) -> None:
    """Fill the covariance S (3, 3) of the three equations and its inverse W."""
    for i in range(3):
        for j in range(i, 3):
            S[i, j] = 0.0
            for n in range(3):
                S[i, j] += _VARIANCE[n] * (D0[i, n] * D0[j, n] + D1[i, n] * D1[j, n])
            S[j, i] = S[i, j]
    _invert_symmetric(S, W)


@compiled
def _track_gradients(
    R: FloatArray,
    T: Vector,
    rate0: Vector,
    rate1: Vector,
    depth: float,
    by_p: FloatArray,
    focal: FloatArray,
    h: float,
    baseline: float,
    D0: FloatArray,
    D1: FloatArray,
) -> None:
    """Derivatives (3, 3) of the three equations by m of frame 0 and of frame 1; rates are p's by the times."""
    by_x = (R[0, 0] / focal[0], R[1, 0] / focal[0], R[2, 0] / focal[0])
    by_y = (
        R[0, 1] / focal[1] + h * rate0[0],
        R[1, 1] / focal[1] + h * rate0[1],
        R[2, 1] / focal[1] + h * rate0[2],
    )
    columns = (apply(by_p, by_x), apply(by_p, by_y), apply(by_p, times(1.0 / (focal[0] * baseline), T)))
    shift = apply(by_p, rate1)
    for i in range(3):
        for j in range(3):
            D0[i, j] = -columns[j][i]
            D1[i, j] = 0.0
        D1[i, i] = 1.0
    for i in range(3):
        D1[i, 1] -= h * shift[i]
    D0[2, 2] -= 1.0 / depth


@compiled
def _track_jacobian(
    x: Vector,
    disparity: float,
    R: FloatArray,
    A: FloatArray,
    T: Vector,
    T_w: FloatArray,
    T_v: FloatArray,
    focal: FloatArray,
    baseline: float,
    by_p: FloatArray,
    C: FloatArray,
) -> bool:
    """Fill the derivative C (3, 6) of the three equations by theta; False when the point is behind the camera."""
    rho = disparity / (focal[0] * baseline)
    turned = apply(R, x)
    p = plus(turned, rho, T)
    if p[2] <= NEAREST:
        return False
    _predict(p, disparity, focal, by_p)
    for j in range(3):
        by_w = plus(cross((A[0, j], A[1, j], A[2, j]), turned), rho, (T_w[0, j], T_w[1, j], T_w[2, j]))
        column_w = apply(by_p, by_w)
        column_v = apply(by_p, (rho * T_v[0, j], rho * T_v[1, j], rho * T_v[2, j]))
        for i in range(3):
            C[i, j], C[i, 3 + j] = -column_w[i], -column_v[i]
    return True


@compiled
def _add_normal(
    C: FloatArray, WC: FloatArray, W: FloatArray, lam: Vector, H: FloatArray, gradient: FloatArray
) -> None:
    """H += C^T W C, gradient += C^T lam."""
    for j in range(6):
        column = (C[0, j], C[1, j], C[2, j])
        gradient[j] += dot(column, lam)
        whitened = apply(W, column)
        WC[0, j], WC[1, j], WC[2, j] = whitened
    for i in range(6):
        for j in range(6):
            H[i, j] += C[0, i] * WC[0, j] + C[1, i] * WC[1, j] + C[2, i] * WC[2, j]
