"""Compiled inner loop of four-view tracks: the first-order form of a rolling-shutter bundle adjustment.

Both cameras read a row at the same time, so a stereo pair is an ordinary rectified pair. In the camera halfway
between both, ``m = (x, y, disparity)`` with x = (xl + xr)/2, y = (yl + yr)/2 holds all that the pair says about
the point; its three parts have independent noise of variance (1/2, 1/2, 2). What is left, yl - yr, is
independent of m and of the motion. The body's motion then predicts m of frame 1 from m of frame 0:

    p = R ray(x0, y0) + rho0 T,   rho0 = disparity0 / (fx baseline) = 1 / z0
    x1 = fx p_x / p_z + cx,  y1 = fy p_y / p_z + cy,  disparity1 = disparity0 / p_z

Whitened with the noise of both frames (multi-constraint Sampson error), these three equations are the reprojection
error of the best point, to first order. They stay regular without motion and for points at infinity.
"""

from __future__ import annotations

import numpy as np

from rsbench.core.so3 import FloatArray
from rsbench.solvers.kernels import BEHIND, _apply, compiled, move

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
def _project_rates(
    R: FloatArray, p: FloatArray, disparity: float, focal: FloatArray, by_p: FloatArray, m: FloatArray
) -> None:
    """Fill the prediction m (3,), relative to the principal point, and its derivative by_p (3, 3) by p."""
    iz = 1.0 / p[2]
    m[0], m[1], m[2] = focal[0] * p[0] * iz, focal[1] * p[1] * iz, disparity * iz
    by_p[0, 0], by_p[1, 1] = focal[0] * iz, focal[1] * iz
    for i in range(3):
        by_p[i, 2] = -m[i] * iz


@compiled
def track_terms(
    theta: FloatArray,
    twist: bool,
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

    Args:
        theta: (6,) w and v.
        tracks: (n, 8) ray 0 (x, y) and disparity 0; x, y relative to the principal point and disparity of
            frame 1, px; tau0, tau1. All of the camera halfway between both.
        focal: (2,) fx, fy in pixels; h: frame periods per row; baseline: metres.
        squares: (n,) filled, px^2: chi-squared with 3 degrees of freedom at a noise of 1 px.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    R, A, T_w, T_v = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    T, T_rate, x, p, c = np.zeros(3), np.zeros((2, 3)), np.ones(3), np.zeros(3), np.zeros(3)
    by_p, D0, D1, S, W = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    m, lam = np.zeros(3), np.zeros(3)
    for k in range(len(tracks)):
        x[0], x[1] = tracks[k, 0], tracks[k, 1]
        disparity = tracks[k, 2]
        rho = disparity / (focal[0] * baseline)
        move(theta, twist, tracks[k, 6], tracks[k, 7], R, A, T, T_w, T_v, T_rate)
        _apply(R, x, p)
        for i in range(3):
            p[i] += rho * T[i]
        if p[2] <= 1e-6:
            squares[k] = BEHIND
            continue
        _project_rates(R, p, disparity, focal, by_p, m)
        for i in range(3):
            c[i] = tracks[k, 3 + i] - m[i]
        _track_gradients(theta, R, T, T_rate, x, rho, p, by_p, focal, h, baseline, D0, D1)
        for i in range(3):
            for j in range(3):
                S[i, j] = 0.0
                for n in range(3):
                    S[i, j] += _VARIANCE[n] * (D0[i, n] * D0[j, n] + D1[i, n] * D1[j, n])
        _invert_symmetric(S, W)
        _apply(W, c, lam)
        squares[k] = c[0] * lam[0] + c[1] * lam[1] + c[2] * lam[2]
        if want:
            _track_normal(R, A, T, T_w, T_v, x, disparity, D0, W, lam, focal, baseline, H, gradient)


@compiled
def _track_gradients(
    theta: FloatArray,
    R: FloatArray,
    T: FloatArray,
    T_rate: FloatArray,
    x: FloatArray,
    rho: float,
    p: FloatArray,
    by_p: FloatArray,
    focal: FloatArray,
    h: float,
    baseline: float,
    D0: FloatArray,
    D1: FloatArray,
) -> None:
    """Derivatives (3, 3) of the three equations by m of frame 0 and of frame 1, row times included."""
    rate0, rate1, p0 = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    for i in range(3):
        j, n = (i + 1) % 3, (i + 2) % 3
        turn = theta[j] * (p[n] - rho * T[n]) - theta[n] * (p[j] - rho * T[j])
        rate0[i] = rho * T_rate[0, i] - turn
        rate1[i] = rho * T_rate[1, i] + turn
        p0[i, 0] = R[i, 0] / focal[0]
        p0[i, 1] = R[i, 1] / focal[1] + h * rate0[i]
        p0[i, 2] = T[i] / (focal[0] * baseline)
    for i in range(3):
        shift = 0.0
        for j in range(3):
            D0[i, j] = -(by_p[i, 0] * p0[0, j] + by_p[i, 1] * p0[1, j] + by_p[i, 2] * p0[2, j])
            D1[i, j] = 1.0 if i == j else 0.0
            shift += by_p[i, j] * rate1[j]
        D1[i, 1] -= h * shift
    D0[2, 2] -= 1.0 / p[2]


@compiled
def _track_normal(
    R: FloatArray,
    A: FloatArray,
    T: FloatArray,
    T_w: FloatArray,
    T_v: FloatArray,
    x: FloatArray,
    disparity: float,
    D0: FloatArray,
    W: FloatArray,
    lam: FloatArray,
    focal: FloatArray,
    baseline: float,
    H: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add a track's normal equations, differentiated at its corrected measurement."""
    step = np.zeros(3)
    for j in range(3):
        step[j] = _VARIANCE[j] * (D0[0, j] * lam[0] + D0[1, j] * lam[1] + D0[2, j] * lam[2])
    x[0] -= step[0] / focal[0]
    x[1] -= step[1] / focal[1]
    disparity -= step[2]
    rho = disparity / (focal[0] * baseline)
    turned, p, m, by_p = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    _apply(R, x, turned)
    for i in range(3):
        p[i] = turned[i] + rho * T[i]
    if p[2] <= 1e-6:
        return
    _project_rates(R, p, disparity, focal, by_p, m)
    C, WC = np.zeros((3, 6)), np.zeros((3, 6))
    for j in range(3):
        for i in range(3):
            k, n = (i + 1) % 3, (i + 2) % 3
            by_w = A[k, j] * turned[n] - A[n, j] * turned[k] + rho * T_w[i, j]
            for row in range(3):
                C[row, j] -= by_p[row, i] * by_w
                C[row, 3 + j] -= by_p[row, i] * rho * T_v[i, j]
    for j in range(6):
        for i in range(3):
            WC[i, j] = W[i, 0] * C[0, j] + W[i, 1] * C[1, j] + W[i, 2] * C[2, j]
            gradient[j] += C[i, j] * lam[i]
    for i in range(6):
        for j in range(6):
            H[i, j] += C[0, i] * WC[0, j] + C[1, i] * WC[1, j] + C[2, i] * WC[2, j]
