"""Compiled inner loops: exact rolling-shutter residuals of pairs and tracks, and their normal equations.

Parameters are ``theta = (w, v)``; the motion model is a ``MotionKernel``. The readable NumPy forms are in
``rsbench.core.epipolar``, named in each function; the tests compare both.

The error of a pair is its Sampson error. The gradient of its square must include the derivative of the weights,
or a descent shrinks v towards zero, where every constraint vanishes. Evaluating the constraint's derivative by the
motion at the corrected measurement gives exactly this gradient.

For tracks whose rows both cameras read at the same time, the error is a first-order form of rolling-shutter bundle
adjustment, since each stereo pair is then an ordinary rectified pair. In a camera halfway between both, ``m = (x,
y, disparity)`` with x = (xl + xr)/2, y = (yl + yr)/2 contains all information of the pair on the point; its three
components have independent noise of variance (1/2, 1/2, 2). The remaining measurement, yl - yr, is independent of
m and of the motion. The body's motion then predicts m of frame 1 from m of frame 0:

    p = R ray(x0, y0) + rho0 T,   rho0 = disparity0 / (fx baseline) = 1 / z0
    x1 = fx p_x / p_z + cx,  y1 = fy p_y / p_z + cy,  disparity1 = disparity0 / p_z

Whitened with the noise of both frames (multi-constraint Sampson error), the residuals of these three equations
are, to first order, the reprojection error of the best 3D point. They stay regular at zero motion and for points
at infinity.

In timed tracks, each of the four ends has its own time. Both cameras read a point at different times if a lens
bends the rows, if they scan differently or if the right camera is delayed. The error is the reprojection error of
the best 3D point: each track has a point (x, y, 1) / rho in the left camera at the time of its first end, which is
found by a few Gauss-Newton steps and eliminated from the normal equations (Schur complement; Triggs et al., Bundle
Adjustment, 2000). The noise of an end includes that a shifted pixel is also read at another time.

``add_pairs`` and ``add_tracks`` give the normal equations by the motion and by further unknowns of the capture,
such as readout ratio, delay and lens. Such an unknown changes the position and the time of the ends of a match.
Given the derivatives of each end's ray and time, one pass over the measurements gives the equations of all
unknowns. Here the errors are heavy-tailed (``packed.HeavyTailed``).
"""

from __future__ import annotations

import math

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import (
    MotionKernel,
    Moved,
    Vector,
    apply,
    apply_transposed,
    cross,
    dot,
    plus,
    times,
)
from rsbench.core.so3 import FloatArray

Matrix = tuple[float, float, float, float]
BEHIND = 1e12
"""Squared error, px^2, of a track whose point the motion puts behind the camera; descents reject such steps."""
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
    """Compute Sampson residuals of left or right pairs, and the normal equations of half their sum of squares.

    Args:
        theta: (6,) w and v.
        pairs: (n, 7) ray 0 (x, y), ray 1 (x, y), tau0, tau1, x of the camera's offset from the body in metres; or
            (n, 17) with the derivatives of ``at_pixels`` too, if the rig is not rectified or rows have other
            times.
        focal: (2,) fx, fy in pixels; h: frame periods per row, used for pairs (n, 7) only.
        residuals: (n,) filled, in pixels.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    R, A, T_w, T_v, J = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(6)
    for m in range(len(pairs)):
        x, y, offset = (pairs[m, 0], pairs[m, 1], 1.0), (pairs[m, 2], pairs[m, 3], 1.0), pairs[m, 6]
        tau0, tau1 = pairs[m, 4], pairs[m, 5]
        L0, L1, slope = at_pixels(pairs, m, h)
        moved = _camera_move(theta, kernel, tau0, tau1, offset, R, A)
        value, q = pair_gradient(x, y, R, moved, focal, L0, L1, slope)
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
    """Return the derivatives of both ideal pixels by the pixels (2 x 2, row by row), and of tau by the pixel."""
    if pairs.shape[1] == 7:
        return (1.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.0), (0.0, h)
    return (
        (pairs[m, 7], pairs[m, 8], pairs[m, 9], pairs[m, 10]),
        (pairs[m, 11], pairs[m, 12], pairs[m, 13], pairs[m, 14]),
        (pairs[m, 15], pairs[m, 16]),
    )


@compiled
def shifted(ray: Vector, L: Matrix, dx: float, dy: float, focal: FloatArray) -> Vector:
    """Return the ray of the pixel shifted by (-dx, -dy)."""
    return (ray[0] - (L[0] * dx + L[1] * dy) / focal[0], ray[1] - (L[2] * dx + L[3] * dy) / focal[1], 1.0)


@compiled
def displacement(p: Vector, y: Vector, focal: FloatArray) -> float:
    """Return the error (px) of a pair without translation, for which the constraint always vanishes.

    It is the distance of the match from the rotated point, divided by sqrt(2).
    """
    if p[2] <= 0.0:
        return math.sqrt(BEHIND)
    return math.hypot(focal[0] * (y[0] - p[0] / p[2]), focal[1] * (y[1] - p[1] / p[2])) / math.sqrt(2.0)


@compiled(inline="always")  # a call would cost as much as its work
def _camera_move(
    theta: FloatArray, kernel: MotionKernel, tau0: float, tau1: float, offset: float, R: FloatArray, A: FloatArray
) -> Moved:
    """Return ``kernel.move`` for a camera in which x is larger than in the body by ``offset``."""
    T, rate0, rate1, spin0, spin1 = kernel.move(theta, tau0, tau1, R, A)
    Ro = times(offset, _of(R, 0))
    T = plus((T[0] + offset, T[1], T[2]), -1.0, Ro)
    return T, plus(rate0, -1.0, cross(spin0, Ro)), plus(rate1, -1.0, cross(spin1, Ro)), spin0, spin1


@compiled
def pair_gradient(
    x: Vector,
    y: Vector,
    R: FloatArray,
    moved: Moved,
    focal: FloatArray,
    L0: Matrix,
    L1: Matrix,
    slope: tuple[float, float],
) -> tuple[float, Matrix]:
    """Return y^T [T]x R x and its derivative by the four pixel coordinates; NumPy: ``epipolar.rs_constraint``.

    This is the paper's (7) before linearisation, with E = [T]x R from (6). In ``moved``, the rates are the
    derivatives of T by the two times, the spins those of R.
    """
    T, rate0, rate1, spin0, spin1 = moved
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
    """Fill J (6,) with the derivative of y^T [T]x R x by theta; R, A, T_w, T_v are work space."""
    T, _, _, _, _ = kernel.move(theta, tau0, tau1, R, A)
    kernel.translation_jacobian(theta, tau0, tau1, R, A, T_w, T_v)
    Ro = times(offset, _of(R, 0))
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
    """Count pairs (n, 7 or 17) whose rays come closest in front of both cameras; parallel rays do not count."""
    R, A = np.zeros((3, 3)), np.zeros((3, 3))
    count = 0
    for m in range(len(pairs)):
        y, offset = (pairs[m, 2], pairs[m, 3], 1.0), pairs[m, 6]
        T, _, _, _, _ = kernel.move(theta, pairs[m, 4], pairs[m, 5], R, A)
        T = plus((T[0] + offset, T[1], T[2]), -offset, _of(R, 0))
        p = apply(R, (pairs[m, 0], pairs[m, 1], 1.0))
        pp, yy, py, pT, yT = dot(p, p), dot(y, y), dot(p, y), dot(p, T), dot(y, T)
        if pp * yy - py * py > 1e-15 * pp * yy and py * yT > yy * pT and pp * yT > py * pT:
            count += 1
    return count


_POINT_STEPS = 2
"""Gauss-Newton steps to the best point: an error of 1 px becomes 1e-3 px after one step and 1e-9 after two."""


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
    """Compute tracks' squared reprojection errors at their best points, and the normal equations of half their
    sum.

    Args:
        theta: (6,) w and v.
        tracks: (n, 4, 9) ends left 0, right 0, left 1, right 1: ray (x, y), tau, derivative of the ideal pixel by
            the pixel (2 x 2, row by row), derivative of tau by the pixel (2).
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
        squares[k] = _product(e, e)
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
    """Fill errors and derivatives of one track at its best point; False if no point in front is determined.

    Args:
        ends: (4, 9) ends of the track.
        e, D, W: see ``_linearise``; N, inverse: (3, 3) normal matrix of the point, and its inverse.
        work: (6, 3, 3); the last two hold the pixels' velocities, see ``_linearise``.
    """
    point = _first_point(theta, kernel, ends, baseline, work)
    for step in range(_POINT_STEPS + 1):
        if step > 0:
            g = (_product(D[:, 0], e), _product(D[:, 1], e), _product(D[:, 2], e))
            point = plus(point, -1.0, apply(inverse, g))
        # The weights are those at the first point. A literal True would compile _linearise once more.
        seen = _linearise(theta, kernel, ends, focal, baseline, point, e, D, W, work, step == 0)
        if not seen:
            return False
        for i in range(3):
            for j in range(3):
                N[i, j] = _product(D[:, i], D[:, j])
        if not _invert(N, inverse):
            return False
    return True


@compiled
def _first_point(
    theta: FloatArray, kernel: MotionKernel, ends: FloatArray, baseline: float, work: FloatArray
) -> Vector:
    """Triangulate the stereo pair of frame 0: return x, y and inverse depth rho, NaN if undetermined."""
    R, A = work[0], work[1]
    x, half = (ends[0, 0], ends[0, 1], 1.0), 0.5 * baseline
    T, _, _, _, _ = kernel.move(theta, ends[0, 2], ends[1, 2], R, A)
    a = apply(R, x)
    b = plus((T[0] - half, T[1], T[2]), -half, _of(R, 0))
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

    If ``weigh``, W (4, 2, 2) is filled too; it maps errors in ideal pixels to errors of unit noise. ``work[4]``
    and ``work[5]`` get the derivatives of the predicted pixels (x and y in the first two rows; columns: right 0,
    left 1, right 1) by the time of the first end and by their own time. The prediction of the first end does not
    move.
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
        if weigh and not _fill_weight(ends[i], vx, vy, W[i]):
            return False
        whiten(W[i], focal[0] * (ends[i, 0] - u), focal[1] * (ends[i, 1] - v), i, e)
        by_rho = plus(plus(T, 1.0, (offset, 0.0, 0.0)), -half, _of(R, 0))
        for j in range(9):
            if j < 2:
                q = _of(R, j)
            elif j == 2:
                q = by_rho
            elif j < 6:
                q = plus(cross(_of(A, j - 3), turned), rho, _of(T_w, j - 3))
            else:
                q = times(rho, _of(T_v, j - 6))
            gx, gy = -focal[0] * (q[0] - u * q[2]) / p[2], -focal[1] * (q[1] - v * q[2]) / p[2]
            whiten(W[i], gx, gy, i, D[:, j])
    return True


@compiled
def _fill_velocities(
    first: Vector, p: Vector, vx: float, vy: float, focal: FloatArray, work: FloatArray, column: int
) -> None:
    """Fill a predicted pixel's derivatives by its own time, (vx, vy), and by the first end's time.

    ``first`` is the derivative of the point p by the first end's time.
    """
    work[4, 0, column] = focal[0] * (first[0] - p[0] / p[2] * first[2]) / p[2]
    work[4, 1, column] = focal[1] * (first[1] - p[1] / p[2] * first[2]) / p[2]
    work[5, 0, column], work[5, 1, column] = vx, vy


@compiled
def _of(M: FloatArray, j: int) -> Vector:
    return (M[0, j], M[1, j], M[2, j])


@compiled
def _fill_weight(end: FloatArray, vx: float, vy: float, W: FloatArray) -> bool:
    """Fill W = (L - v s^T)^-1; False if the inverse does not exist.

    A shift of the pixel moves the ideal pixel by L, and the prediction by its velocity v times the derivative s of
    the readout time. The matrix is singular if the prediction moves with the line that is read.
    """
    a, b = end[3] - vx * end[7], end[4] - vx * end[8]
    c, d = end[5] - vy * end[7], end[6] - vy * end[8]
    det = a * d - b * c
    if not abs(det) > 0.0:
        return False
    W[0, 0], W[0, 1], W[1, 0], W[1, 1] = d / det, -b / det, -c / det, a / det
    return True


@compiled
def whiten(W: FloatArray, x: float, y: float, i: int, out: FloatArray) -> None:
    out[2 * i], out[2 * i + 1] = W[0, 0] * x + W[0, 1] * y, W[1, 0] * x + W[1, 1] * y


@compiled
def _invert(S: FloatArray, out: FloatArray) -> bool:
    """Fill the inverse of a symmetric positive definite (3, 3) matrix; False if it is numerically singular."""
    first, second, third = _of(S, 0), _of(S, 1), _of(S, 2)
    rows = (cross(second, third), cross(third, first), cross(first, second))
    det = dot(first, rows[0])
    if not det > 1e-14 * S[0, 0] * S[1, 1] * S[2, 2]:
        return False
    for i in range(3):
        for j in range(3):
            out[i, j] = rows[i][j] / det
    return True


@compiled
def _add_reduced(
    D: FloatArray, e: FloatArray, inverse: FloatArray, Q: FloatArray, H: FloatArray, gradient: FloatArray
) -> None:
    """Add normal equations (6) with the point eliminated: H += Dt^T Dt - Q N^-1 Q^T with Q = Dt^T Dp."""
    g = (_product(D[:, 0], e), _product(D[:, 1], e), _product(D[:, 2], e))
    best = apply(inverse, g)
    for i in range(6):
        for j in range(3):
            Q[i, j] = _product(D[:, 3 + i], D[:, j])
    for i in range(6):
        q = apply(inverse, (Q[i, 0], Q[i, 1], Q[i, 2]))
        gradient[i] += _product(D[:, 3 + i], e) - dot((Q[i, 0], Q[i, 1], Q[i, 2]), best)
        for j in range(6):
            H[i, j] += _product(D[:, 3 + i], D[:, 3 + j]) - dot(q, (Q[j, 0], Q[j, 1], Q[j, 2]))


_VARIANCE = (0.5, 0.5, 2.0)


@compiled
def _predict(p: Vector, disparity: float, focal: FloatArray, by_p: FloatArray) -> Vector:
    """Return the predicted m, relative to the principal point; fill its derivative by_p (3, 3) by p."""
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
    """Compute squared whitened errors of tracks, and the normal equations of half their sum.

    Tracks (n, 4, 9), whose four ends have their own times, are passed to ``timed_track_terms``.

    Args:
        theta: (6,) w and v.
        tracks: (n, 8), in the camera halfway between both: ray (x, y) and disparity (px) of frame 0; x, y relative
            to the principal point and disparity of frame 1, px; tau0, tau1.
        focal: (2,) fx, fy in pixels; h: frame periods per row; baseline: metres.
        squares: (n,) filled, px^2: chi-squared with 3 degrees of freedom at a noise of 1 px.
        H, gradient: (6, 6), (6,), added to when ``want``.
    """
    if tracks.ndim == 3:  # known at compile time, so that only one branch is compiled
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
        if not _whitening(D0, D1, S, W):
            squares[k] = BEHIND
            continue
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
def _whitening(D0: FloatArray, D1: FloatArray, S: FloatArray, W: FloatArray) -> bool:
    """Fill the covariance S (3, 3) of the three equations and its inverse W; False if S is singular."""
    for i in range(3):
        for j in range(i, 3):
            S[i, j] = 0.0
            for n in range(3):
                S[i, j] += _VARIANCE[n] * (D0[i, n] * D0[j, n] + D1[i, n] * D1[j, n])
            S[j, i] = S[i, j]
    return _invert(S, W)


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
    """Fill the derivatives D0, D1 (3, 3) of the three equations by m of frames 0 and 1.

    ``rate0`` and ``rate1`` are the derivatives of p by the two times.
    """
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
        by_w = plus(cross(_of(A, j), turned), rho, _of(T_w, j))
        column_w = apply(by_p, by_w)
        column_v = apply(by_p, times(rho, _of(T_v, j)))
        for i in range(3):
            C[i, j], C[i, 3 + j] = -column_w[i], -column_v[i]
    return True


@compiled
def _add_normal(
    C: FloatArray, WC: FloatArray, W: FloatArray, lam: Vector, H: FloatArray, gradient: FloatArray
) -> None:
    """H += C^T W C, gradient += C^T lam."""
    for j in range(6):
        column = _of(C, j)
        gradient[j] += dot(column, lam)
        whitened = apply(W, column)
        WC[0, j], WC[1, j], WC[2, j] = whitened
    for i in range(6):
        for j in range(6):
            H[i, j] += C[0, i] * WC[0, j] + C[1, i] * WC[1, j] + C[2, i] * WC[2, j]


_LEAST_SLOPE = 0.1
"""Least share of its weight that an outlier has in the Hessian, as in ``packed.HeavyTailed``."""
_MOTION = 6


@compiled
def add_tracks(
    theta: FloatArray,
    kernel: MotionKernel,
    tracks: FloatArray,
    by: FloatArray,
    focal: FloatArray,
    baseline: float,
    tails: FloatArray,
    trust: FloatArray,
    gradient: FloatArray,
    H: FloatArray,
) -> float:
    """Return the negative log-likelihood of tracks times the squared scale, px^2; add to gradient and Hessian.

    Args:
        theta: (6,) parameters of the motion.
        tracks: (n, 4, 9), see ``timed_track_terms``.
        by: (n, 4, k, 3) derivatives of the ends' rays (x, y) and times by k further unknowns.
        focal: (2,), px; baseline: metres.
        tails: (2,) degrees of freedom and scale, px, of the errors' t distribution.
        trust: (n,) factors on the log-likelihoods.
        gradient, H: (6 + k,), (6 + k, 6 + k), added to.
    """
    size = len(gradient)
    e, D, W = np.zeros(8), np.zeros((8, 9)), np.zeros((4, 2, 2))
    N, inverse, work = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((6, 3, 3))
    J, Q, half = np.zeros((8, size)), np.zeros((size, 3)), np.zeros((size, 3))
    cost = 0.0
    for n in range(len(tracks)):
        if not linearise_best(theta, kernel, tracks[n], focal, baseline, e, D, W, N, inverse, work):
            cost += _loss(BEHIND, 5.0, tails, trust[n])
            continue
        square = _product(e, e)
        for i in range(8):
            for j in range(_MOTION):
                J[i, j] = D[i, 3 + j]
        for k in range(size - _MOTION):
            _fill_unknown(by[n, :, k], focal, work, W, J[:, _MOTION + k])
        cost += _loss(square, 5.0, tails, trust[n])
        weight, slope = _weights(square, 5.0, tails, trust[n])
        g = (_product(D[:, 0], e), _product(D[:, 1], e), _product(D[:, 2], e))
        best = apply(inverse, g)
        for i in range(size):
            for j in range(3):
                Q[i, j] = _product(J[:, i], D[:, j])
            q = (Q[i, 0], Q[i, 1], Q[i, 2])
            half[i, 0], half[i, 1], half[i, 2] = apply(inverse, q)
            gradient[i] += weight * (_product(J[:, i], e) - dot(q, best))
            for j in range(i + 1):
                both = _product(J[:, i], J[:, j])
                both -= half[i, 0] * Q[j, 0] + half[i, 1] * Q[j, 1] + half[i, 2] * Q[j, 2]
                H[i, j] += slope * both
                if j < i:
                    H[j, i] += slope * both
    return cost


@compiled
def _fill_unknown(by: FloatArray, focal: FloatArray, work: FloatArray, W: FloatArray, out: FloatArray) -> None:
    """Fill the derivative (8,) of a track's whitened errors by one unknown; ``by`` (4, 3) is that of its ends."""
    for i in range(4):
        x, y = focal[0] * by[i, 0], focal[1] * by[i, 1]
        if i > 0:
            x -= work[4, 0, i - 1] * by[0, 2] + work[5, 0, i - 1] * by[i, 2]
            y -= work[4, 1, i - 1] * by[0, 2] + work[5, 1, i - 1] * by[i, 2]
        whiten(W[i], x, y, i, out)


@compiled
def _product(a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for i in range(8):
        total += a[i] * b[i]
    return total


@compiled
def _loss(square: float, freedom: float, tails: FloatArray, trust: float) -> float:
    variance = tails[1] * tails[1]
    return 0.5 * variance * trust * (tails[0] + freedom) * math.log1p(square / (tails[0] * variance))


@compiled
def _weights(square: float, freedom: float, tails: FloatArray, trust: float) -> tuple[float, float]:
    """Return the weights of a measurement in the gradient and in the Hessian.

    The latter is the second derivative, averaged over directions of the residuals, but at least a tenth of the
    former.
    """
    variance = tails[1] * tails[1]
    weight = trust * (tails[0] + freedom) / (tails[0] + square / variance)
    bend = 2.0 * square / freedom / (tails[0] * variance + square)
    return weight, weight * max(1.0 - bend, _LEAST_SLOPE)


@compiled
def add_pairs(
    theta: FloatArray,
    kernel: MotionKernel,
    pairs: FloatArray,
    by: FloatArray,
    focal: FloatArray,
    tails: FloatArray,
    trust: FloatArray,
    gradient: FloatArray,
    H: FloatArray,
) -> float:
    """Do the same as ``add_tracks`` for pairs (n, 17); ``by`` is (n, 2, k, 3)."""
    size = len(gradient)
    J, work, ends = np.zeros(size), np.zeros((4, 3, 3)), np.zeros(6)
    cost = 0.0
    for n in range(len(pairs)):
        residual, norm = linearise_pair(theta, kernel, pairs[n : n + 1], focal, work, J, ends)
        square = residual * residual
        cost += _loss(square, 1.0, tails, trust[n])
        if norm <= 0.0:
            continue
        for k in range(size - _MOTION):
            J[_MOTION + k] = 0.0
            for i in range(6):
                J[_MOTION + k] += ends[i] * by[n, i // 3, k, i % 3]
        weight, slope = _weights(square, 1.0, tails, trust[n])
        for i in range(size):
            gradient[i] += weight * residual * J[i] / norm
            for j in range(size):
                H[i, j] += slope * J[i] * J[j] / (norm * norm)
    return cost


@compiled
def linearise_pair(
    theta: FloatArray,
    kernel: MotionKernel,
    pairs: FloatArray,
    focal: FloatArray,
    work: FloatArray,
    J: FloatArray,
    ends: FloatArray,
) -> tuple[float, float]:
    """Return the Sampson residual, px, of one pair (1, 17) and the norm of its constraint's derivative by the
    pixels.

    The first 6 elements of J are filled with the derivative of the constraint by the motion, ``ends`` (6,) with
    that by the rays (x, y) and times of both ends. Both are evaluated at the corrected pair, see the top of this
    module. Without translation neither is filled, and the norm is 0.
    """
    R, A, T_w, T_v = work[0], work[1], work[2], work[3]
    x, y, offset = (pairs[0, 0], pairs[0, 1], 1.0), (pairs[0, 2], pairs[0, 3], 1.0), pairs[0, 6]
    tau0, tau1 = pairs[0, 4], pairs[0, 5]
    L0, L1, slope = at_pixels(pairs, 0, 0.0)
    moved = _camera_move(theta, kernel, tau0, tau1, offset, R, A)
    value, q = pair_gradient(x, y, R, moved, focal, L0, L1, slope)
    qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if qq <= 0.0:
        return displacement(apply(R, x), y, focal), 0.0
    step = value / qq
    x, y = shifted(x, L0, step * q[0], step * q[1], focal), shifted(y, L1, step * q[2], step * q[3], focal)
    tau0 -= slope[1] * step * q[1] + slope[0] * step * q[0]
    tau1 -= slope[1] * step * q[3] + slope[0] * step * q[2]
    pair_jacobian(theta, kernel, x, y, tau0, tau1, offset, R, A, T_w, T_v, J)
    T, rate0, rate1, spin0, spin1 = _camera_move(theta, kernel, tau0, tau1, offset, R, A)
    p = apply(R, x)
    n, line, back = cross(p, y), cross(T, p), apply_transposed(R, cross(y, T))
    ends[0], ends[1], ends[3], ends[4] = back[0], back[1], line[0], line[1]
    ends[2] = dot(rate0, n) + dot(spin0, y) * dot(T, p) - dot(spin0, T) * dot(y, p)
    ends[5] = dot(rate1, n) + dot(spin1, y) * dot(T, p) - dot(spin1, T) * dot(y, p)
    return value / math.sqrt(qq), math.sqrt(qq)
