"""The matches of a sequence as tracks, their reprojection errors, and the distribution of these errors.

A track is a set of observations ("ends") of one point: pixels, each with its camera and readout time. The point,
(x, y, 1) / rho in the camera of the first observation, is estimated by a few Gauss-Newton steps and eliminated
from the normal equations (Schur complement; B. Triggs et al., Bundle Adjustment, 2000), in compiled functions. An
error of a pixel also changes its readout time; the weight W of an observation accounts for that. Tracks are
weighted as under a multivariate t distribution (``solvers.engine.packed.HeavyTailed``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_gyro import Border, GyroSteps
from rsbench.capture.trajectory_spline import Curve, Views, blank_views, fill_view
from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import Vector, apply, apply_transposed, cross, plus, times
from rsbench.core.correspondences import BoolArray, Correspondences, nearest_within, unlinked_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import tiles
from rsbench.solvers.engine.packed import t_distribution

IntArray = NDArray[np.int64]
ENOUGH = 400
"""With this many tracks in a window, its pairs are ignored: they add little and take most of the time."""
LONGEST = 5
"""Most frames of a track: longer ones would couple more control poses for little gain."""
REACH = 10.0
"""A track with an error of more scales than this is an outlier."""
LEAST_SCALE_PX = 1e-3
BEHIND = 1e12
"""Squared error, px^2, of a track whose point lies behind a camera."""
_NEAREST = 1e-3
"""Least depth of the point at an observation, relative to that at the first one."""
_TILES, _FEWEST_IN_TILE = (4, 4), 8
"""Columns and rows of image tiles, each with its own noise, and the average number of tracks that this needs."""
_LEAST_SQUARE, _LEAST_SHARE = LEAST_SCALE_PX**2, 1e-2
"""Least median of squared errors, px^2, and least median in a tile divided by that of all."""
_POINT_STEPS = 2
"""Gauss-Newton steps for the point: an error of 1 px becomes 1e-3 px after one and 1e-9 px after two."""
_ROUGH_RHO = 3.0
"""Prior standard deviation of inverse depths, 1/m, for tracks that do not determine theirs."""
_UNCERTAIN = 0.3
"""Error, px, that an inverse depth of one such deviation contributes to the cost."""
END = 10
"""Number of values per observation."""
SHARED = 4
"""Number of unknowns that all observations share: readout ratio, logarithm of the focal length, principal point
(2), px."""


class Tails(NamedTuple):
    """Student t distribution of errors."""

    nu: float
    """Degrees of freedom."""
    scale: float
    """px."""


def blank_shared(controls: int, wanted: bool) -> Border:
    """Equations of 0 of the ``SHARED`` unknowns, or of none, for a spline with this number of control poses."""
    count = SHARED if wanted else 0
    return Border(np.zeros((6 * controls, count)), np.zeros((count, count)), np.zeros(count))


class Scratch(NamedTuple):
    """Work arrays for one track of n observations."""

    views: Views
    G: FloatArray
    """(n, 3, 3) rotation from the camera of the first observation."""
    b: FloatArray
    """(n, 3) derivative of the point by rho."""
    W: FloatArray
    """(n, 2, 2) maps errors in ideal pixels to errors in measured pixels."""
    e: FloatArray
    """(n, 2) errors, px."""
    D: FloatArray
    """(n, 2, 3) derivatives of the errors by x, y, rho."""
    point: FloatArray
    """(3,) x, y, rho."""
    left: FloatArray
    """(3,) gradient by x, y, rho; 0 up to rounding at the best point."""
    P: FloatArray
    """(n, 3) the point, in units of its depth at the first observation."""
    N: FloatArray
    """(3, 3) normal matrix of the point."""
    L: FloatArray
    """(3, 3) Cholesky factor of N."""
    work: FloatArray
    block: FloatArray
    """(2, 24) derivatives of one observation by four control poses."""
    Q: FloatArray
    """(3, m) mixed part of the normal matrix."""
    H: FloatArray
    """(m, m) upper half of the normal matrix of the control poses that the track depends on."""
    g: FloatArray
    """(m,) gradient."""
    v: FloatArray
    """(n, 2) velocity of the ideal pixel, px per frame period."""
    E: FloatArray
    """(2, SHARED) derivatives of one observation by the shared unknowns."""
    S: Border
    """Equations of one track that involve these unknowns."""
    T: FloatArray
    """(3, SHARED) mixed part of the point and these unknowns."""


@compiled(error_model="numpy")
def _scratch(ends: int, size: int, shared: int) -> Scratch:
    return Scratch(
        blank_views(ends),
        np.zeros((ends, 3, 3)),
        np.zeros((ends, 3)),
        np.zeros((ends, 2, 2)),
        np.zeros((ends, 2)),
        np.zeros((ends, 2, 3)),
        np.zeros(3),
        np.zeros(3),
        np.zeros((ends, 3)),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
        np.zeros((2, 3, 3)),
        np.zeros((2, 24)),
        np.zeros((3, size)),
        np.zeros((size, size)),
        np.zeros(size),
        np.zeros((ends, 2)),
        np.zeros((2, SHARED)),
        Border(np.zeros((size, shared)), np.zeros((shared, shared)), np.zeros(shared)),
        np.zeros((3, SHARED)),
    )


@compiled(error_model="numpy")
def add_tracks(
    curve: Curve,
    ends: FloatArray,
    starts: NDArray[np.int64],
    focal: FloatArray,
    tails: Tails,
    trust: FloatArray,
    squares: FloatArray,
    band: FloatArray,
    gradient: FloatArray,
    shared: Border,
    by_ratio: FloatArray,
    want: bool,
) -> float:
    """Negative log-likelihood of tracks, and their weighted normal equations.

    Args:
        ends: (e, 10) observations: ray (x, y), tau, derivative of the ideal pixel by the pixel (2 x 2, rows
            first), derivative of tau by the pixel (2), x of the camera's offset from the body.
        starts: (n + 1,) index of each track's first observation, and e.
        trust: (n,) weights of the tracks; for a weight of 0, only ``squares`` is computed.
        squares: (n,) output, px^2: chi-squared with 2 observations - 3 degrees of freedom at a noise of 1 px.
        band: (6 controls, width) lower half of the normal matrix, by columns from the diagonal on; equations are
            added to it, to gradient (6 controls,) and to ``shared`` if ``want``.
        by_ratio: (e, 3) see ``TimedTracks``; not used if ``shared`` has no columns.
    """
    most = 0
    for k in range(len(starts) - 1):
        most = max(most, starts[k + 1] - starts[k])
    # Without int(), it would be compiled for the literal 0 as well.
    scratch = _scratch(int(most), band.shape[1], len(shared.slope))
    total = 0.0
    for k in range(len(starts) - 1):
        track = ends[starts[k] : starts[k + 1]]
        squares[k] = _explain(curve, track, focal, scratch)
        if trust[k] == 0.0:
            continue
        freedom = 2.0 * len(track) - 3.0
        spread = tails.nu * tails.scale * tails.scale
        total += 0.5 * trust[k] * (tails.nu + freedom) * math.log1p(squares[k] / spread)
        if want and squares[k] < BEHIND:
            weight = trust[k] * (tails.nu + freedom) / (spread + squares[k])
            _add_track(track, focal, scratch, weight, band, gradient, shared, by_ratio[starts[k] : starts[k + 1]])
    return total


@compiled(error_model="numpy")
def inverse_depths(curve: Curve, ends: FloatArray, starts: NDArray[np.int64], focal: FloatArray) -> FloatArray:
    """(n,) inverse depth of each track's point at its first observation; arguments: ``add_tracks``."""
    most = 0
    for k in range(len(starts) - 1):
        most = max(most, starts[k + 1] - starts[k])
    scratch, out = _scratch(int(most), 1, 0), np.zeros(len(starts) - 1)
    for k in range(len(out)):
        _explain(curve, ends[starts[k] : starts[k + 1]], focal, scratch)
        out[k] = scratch.point[2]
    return out


@compiled(error_model="numpy")
def _explain(curve: Curve, track: FloatArray, focal: FloatArray, s: Scratch) -> float:
    """Estimate the point of a track; returns the squared error, px^2."""
    count = len(track)
    for n in range(count):
        fill_view(curve, track[n, 2], s.views, n)
    point, metric = _first_point(track, s), _sees_disparity(track)
    for step in range(_POINT_STEPS + 1):
        if step > 0:
            point = plus(point, -1.0, _solve(s.L, (s.left[0], s.left[1], s.left[2])))
        if metric and point[2] < 0.0:
            point = (point[0], point[1], 0.0)
        if not _linearise(track, focal, point, s, step == 0):
            return BEHIND
        if metric and point[2] == 0.0 and s.left[2] > 0.0:
            _fix_at_infinity(s, count)
    s.point[0], s.point[1], s.point[2] = point
    total = _ridge() * point[2] * point[2]
    for n in range(count):
        total += s.e[n, 0] * s.e[n, 0] + s.e[n, 1] * s.e[n, 1]
    return total


@compiled(error_model="numpy")
def _sees_disparity(track: FloatArray) -> bool:
    """Whether both cameras observe the point. The scale, and with it the sign of rho, is then not free."""
    other = 0  # np.any would load a module of Numba in each command
    for n in range(len(track)):
        if track[n, 9] != track[0, 9]:
            other += 1
    return other > 0


@compiled(error_model="numpy")
def _fix_at_infinity(s: Scratch, count: int) -> None:
    """Take rho out of the equations of a point that fits best beyond infinity: its rho stays 0."""
    s.D[:count, :, 2] = 0.0
    s.left[2], s.N[2, 0], s.N[2, 1], s.N[2, 2] = 0.0, 0.0, 0.0, 1.0
    _factor(s.N, s.L)


@compiled(error_model="numpy")
def _ridge() -> float:
    return (_UNCERTAIN / _ROUGH_RHO) ** 2


@compiled(error_model="numpy")
def _first_point(track: FloatArray, s: Scratch) -> Vector:
    """The point on the first observation's ray at the inverse depth that fits all others; fills G and b."""
    v, x = s.views, (track[0, 0], track[0, 1], 1.0)
    R, p = v.R[0], (v.p[0, 0], v.p[0, 1], v.p[0, 2])
    centre = plus(p, -1.0, apply_transposed(R, (track[0, 9], 0.0, 0.0)))
    above, below = 0.0, _ridge() / 1e4
    for n in range(len(track)):
        for i in range(3):
            for j in range(3):
                s.G[n, i, j] = v.R[n, i, 0] * R[j, 0] + v.R[n, i, 1] * R[j, 1] + v.R[n, i, 2] * R[j, 2]
        b = plus(
            apply(v.R[n], plus(centre, -1.0, (v.p[n, 0], v.p[n, 1], v.p[n, 2]))), track[n, 9], (1.0, 0.0, 0.0)
        )
        s.b[n, 0], s.b[n, 1], s.b[n, 2] = b
        a = apply(s.G[n], x)
        for i in range(2):
            factor = b[i] - track[n, i] * b[2]
            above += factor * (track[n, i] * a[2] - a[i])
            below += factor * factor
    return x[0], x[1], above / below


@compiled(error_model="numpy")
def _linearise(track: FloatArray, focal: FloatArray, point: Vector, s: Scratch, weigh: bool) -> bool:
    """Fill errors, their derivatives by the point and the factor of its normal matrix; False: behind a camera.

    With ``weigh``, W is filled too.
    """
    rho, v = point[2], s.views
    s.N[:, :] = 0.0
    s.N[2, 2] = _ridge()
    s.left[0], s.left[1], s.left[2] = 0.0, 0.0, _ridge() * rho
    for n in range(len(track)):
        b = (s.b[n, 0], s.b[n, 1], s.b[n, 2])
        P = plus(apply(s.G[n], (point[0], point[1], 1.0)), rho, b)
        if not P[2] > _NEAREST:
            return False
        s.P[n, 0], s.P[n, 1], s.P[n, 2] = P
        if weigh:
            body = plus(P, -rho * track[n, 9], (1.0, 0.0, 0.0))
            along = apply(v.R[n], (v.speed[n, 0], v.speed[n, 1], v.speed[n, 2]))
            rate = plus(cross((v.spin[n, 0], v.spin[n, 1], v.spin[n, 2]), body), -rho, along)
            s.v[n, 0], s.v[n, 1] = _flow(P, rate, focal)
            _fill_weight(track[n], (s.v[n, 0], s.v[n, 1]), s.W[n])
        W = s.W[n]
        e = (focal[0] * (track[n, 0] - P[0] / P[2]), focal[1] * (track[n, 1] - P[1] / P[2]))
        s.e[n, 0], s.e[n, 1] = W[0, 0] * e[0] + W[0, 1] * e[1], W[1, 0] * e[0] + W[1, 1] * e[1]
        for j in range(3):
            q = b if j == 2 else (s.G[n, 0, j], s.G[n, 1, j], s.G[n, 2, j])
            d = _flow(P, q, focal)
            s.D[n, 0, j], s.D[n, 1, j] = -W[0, 0] * d[0] - W[0, 1] * d[1], -W[1, 0] * d[0] - W[1, 1] * d[1]
        for i in range(3):
            s.left[i] += s.D[n, 0, i] * s.e[n, 0] + s.D[n, 1, i] * s.e[n, 1]
            for j in range(i + 1):
                s.N[i, j] += s.D[n, 0, i] * s.D[n, 0, j] + s.D[n, 1, i] * s.D[n, 1, j]
    return _factor(s.N, s.L)


@compiled(error_model="numpy")
def _flow(P: Vector, rate: Vector, focal: FloatArray) -> tuple[float, float]:
    """Velocity of the ideal pixel of a point P that moves by ``rate``."""
    return (
        focal[0] * (rate[0] - P[0] / P[2] * rate[2]) / P[2],
        focal[1] * (rate[1] - P[1] / P[2] * rate[2]) / P[2],
    )


@compiled(error_model="numpy")
def _fill_weight(end: FloatArray, flow: tuple[float, float], W: FloatArray) -> None:
    """W = (L - v s^T)^-1, where L = d ideal pixel / d pixel, v the predicted velocity and s = d tau / d pixel."""
    a, b = end[3] - flow[0] * end[7], end[4] - flow[0] * end[8]
    c, d = end[5] - flow[1] * end[7], end[6] - flow[1] * end[8]
    det = a * d - b * c
    if not abs(det) > 1e-3:  # the image moves as fast as the readout
        a, b, c, d, det = 1.0, 0.0, 0.0, 1.0, 1.0
    W[0, 0], W[0, 1], W[1, 0], W[1, 1] = d / det, -b / det, -c / det, a / det


@compiled(error_model="numpy")
def _factor(N: FloatArray, L: FloatArray) -> bool:
    """Fill the lower Cholesky factor (3, 3) of N; False: the observations do not determine the point."""
    for i in range(3):
        for j in range(i + 1):
            total = N[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 1e-14 * N[i, i]:
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@compiled(error_model="numpy")
def _solve(L: FloatArray, g: Vector) -> Vector:
    """N^-1 g."""
    a = _forward(L, g)
    z = a[2] / L[2, 2]
    y = (a[1] - L[2, 1] * z) / L[1, 1]
    return (a[0] - L[1, 0] * y - L[2, 0] * z) / L[0, 0], y, z


@compiled(error_model="numpy")
def _forward(L: FloatArray, g: Vector) -> Vector:
    """L^-1 g."""
    x = g[0] / L[0, 0]
    y = (g[1] - L[1, 0] * x) / L[1, 1]
    return x, y, (g[2] - L[2, 0] * x - L[2, 1] * y) / L[2, 2]


@compiled(error_model="numpy")
def _add_track(
    track: FloatArray,
    focal: FloatArray,
    s: Scratch,
    weight: float,
    band: FloatArray,
    gradient: FloatArray,
    shared: Border,
    by_ratio: FloatArray,
) -> None:
    """Add the normal equations with the point eliminated: H = Dc^T Dc - Q N^-1 Q^T with Q = Dc^T Dp."""
    low, high = s.views.index[0], s.views.index[0]
    for n in range(len(track)):
        low, high = min(low, s.views.index[n]), max(high, s.views.index[n])
    size = 6 * (high - low + 4)
    H, Q, g = s.H, s.Q, s.g
    g[:size] = 0.0
    Q[:, :size] = 0.0
    H[:size, :size] = 0.0
    _clear(s, size)
    for n in range(len(track)):
        _fill_block(track[n], n, focal, s)
        first = 6 * (s.views.index[n] - low)
        for i in range(24):
            a, b = s.block[0, i], s.block[1, i]
            g[first + i] += a * s.e[n, 0] + b * s.e[n, 1]
            for j in range(3):
                Q[j, first + i] += a * s.D[n, 0, j] + b * s.D[n, 1, j]
            row, c, d = H[first + i, first:], s.block[0], s.block[1]
            for j in range(i, 24):
                row[j] += a * c[j] + b * d[j]
        if len(shared.slope) > 0:
            _add_shared(track[n], by_ratio[n], n, first, focal, s)
    _reduce(s, size, weight, 6 * low, band, gradient)
    if len(shared.slope) > 0:
        _reduce_shared(s, size, weight, 6 * low, shared)


@compiled(error_model="numpy")
def _clear(s: Scratch, size: int) -> None:
    s.S.mixed[:size] = 0.0
    s.S.corner[:] = 0.0
    s.S.slope[:] = 0.0
    s.T[:] = 0.0


@compiled(error_model="numpy")
def _add_shared(end: FloatArray, by_ratio: FloatArray, n: int, first: int, focal: FloatArray, s: Scratch) -> None:
    """Add the equations of one observation that involve the shared unknowns.

    The derivative by the ratio is that of the readout time at the best pixel, which is ``e`` from the measured
    one: W depends on the ratio as well.
    """
    W, P, E = s.W[n], s.P[n], s.E
    later = by_ratio[0] - by_ratio[1] * s.e[n, 0] - by_ratio[2] * s.e[n, 1]
    x, y = focal[0] * P[0] / P[2], focal[1] * P[1] / P[2]
    for i in range(2):
        E[i, 0] = -(W[i, 0] * s.v[n, 0] + W[i, 1] * s.v[n, 1]) * later
        E[i, 1] = -(W[i, 0] * x + W[i, 1] * y)
        E[i, 2], E[i, 3] = -W[i, 0], -W[i, 1]
    for j in range(SHARED):
        a, b = E[0, j], E[1, j]
        s.S.slope[j] += a * s.e[n, 0] + b * s.e[n, 1]
        for i in range(3):
            s.T[i, j] += a * s.D[n, 0, i] + b * s.D[n, 1, i]
        for i in range(SHARED):
            s.S.corner[i, j] += a * E[0, i] + b * E[1, i]
        for i in range(24):
            s.S.mixed[first + i, j] += a * s.block[0, i] + b * s.block[1, i]


@compiled(error_model="numpy")
def _reduce_shared(s: Scratch, size: int, weight: float, first: int, shared: Border) -> None:
    """Eliminate the point from the equations of a track and the shared unknowns; ``_reduce`` comes before."""
    best = _forward(s.L, (s.left[0], s.left[1], s.left[2]))
    for j in range(SHARED):
        s.T[0, j], s.T[1, j], s.T[2, j] = _forward(s.L, (s.T[0, j], s.T[1, j], s.T[2, j]))
    for j in range(SHARED):
        a, b, c = s.T[0, j], s.T[1, j], s.T[2, j]
        shared.slope[j] += weight * (s.S.slope[j] - a * best[0] - b * best[1] - c * best[2])
        for i in range(SHARED):
            shared.corner[i, j] += weight * (s.S.corner[i, j] - s.T[0, i] * a - s.T[1, i] * b - s.T[2, i] * c)
        for i in range(size):
            left = s.Q[0, i] * a + s.Q[1, i] * b + s.Q[2, i] * c
            shared.mixed[first + i, j] += weight * (s.S.mixed[i, j] - left)


@compiled(error_model="numpy")
def _fill_block(end: FloatArray, n: int, focal: FloatArray, s: Scratch) -> None:
    """Fill the derivatives of an observation's errors by its four control poses."""
    v, W, P, rho = s.views, s.W[n], (s.P[n, 0], s.P[n, 1], s.P[n, 2]), s.point[2]
    body = plus(P, -rho * end[9], (1.0, 0.0, 0.0))
    by_pose = s.work[0], s.work[1]
    for axis in range(3):
        unit = (1.0 if axis == 0 else 0.0, 1.0 if axis == 1 else 0.0, 1.0 if axis == 2 else 0.0)
        along = (v.R[n, 0, axis], v.R[n, 1, axis], v.R[n, 2, axis])
        turned, shifted = _flow(P, cross(unit, body), focal), _flow(P, times(-rho, along), focal)
        for i in range(2):
            by_pose[0][i, axis] = -W[i, 0] * turned[0] - W[i, 1] * turned[1]
            by_pose[1][i, axis] = -W[i, 0] * shifted[0] - W[i, 1] * shifted[1]
    for j in range(4):
        for i in range(2):
            row = (by_pose[0][i, 0], by_pose[0][i, 1], by_pose[0][i, 2])
            chained = apply_transposed(v.turn[n, j], row)
            for k in range(3):
                s.block[i, 6 * j + k] = chained[k]
                s.block[i, 6 * j + 3 + k] = by_pose[1][i, k] * v.share[n, j]


@compiled(error_model="numpy")
def _reduce(s: Scratch, size: int, weight: float, first: int, band: FloatArray, gradient: FloatArray) -> None:
    """Eliminate the point and add the weighted equations (size) to the band from unknown ``first`` on."""
    L, x, y, z = s.L, s.Q[0], s.Q[1], s.Q[2]
    for i in range(size):  # ``_forward``, in loops that the compiler can vectorise
        x[i] = x[i] / L[0, 0]
    for i in range(size):
        y[i] = (y[i] - L[1, 0] * x[i]) / L[1, 1]
    for i in range(size):
        z[i] = (z[i] - L[2, 0] * x[i] - L[2, 1] * y[i]) / L[2, 2]
    best = _forward(L, (s.left[0], s.left[1], s.left[2]))
    for j in range(size):
        a, b, c = x[j], y[j], z[j]
        gradient[first + j] += weight * (s.g[j] - a * best[0] - b * best[1] - c * best[2])
        row, out = s.H[j, j:], band[first + j]
        xs, ys, zs = x[j:], y[j:], z[j:]
        for i in range(size - j):
            out[i] += weight * (row[i] - xs[i] * a - ys[i] * b - zs[i] * c)


def observed(squares: FloatArray, freedom: FloatArray, tails: Tails, used: float) -> tuple[Tails, FloatArray]:
    """Maximum-likelihood distribution of the errors, and 1 for inlier tracks, 0 for outliers (n,).

    Args:
        used: number of degrees of freedom that the fit of the trajectory takes away.
    """
    near = squares <= freedom * (REACH * tails.scale) ** 2
    if not np.any(near):
        return tails, np.ones(len(squares))
    q, p = squares[near], freedom[near]
    left = max(float(np.sum(p)) - used, 0.1 * float(np.sum(p)))
    best = Tails(*t_distribution(q, p, tails.scale, left, LEAST_SCALE_PX))
    return best, (squares <= freedom * (REACH * best.scale) ** 2).astype(np.float64)


def noise_by_tile(tracks: TimedTracks, squares: FloatArray) -> FloatArray:
    """(n,) noise of each track's part of the image relative to that of all tracks, from squared errors (n,), px^2.

    Texture and blur differ between parts of an image. A part may also have a motion of its own, as a dashboard:
    one trajectory explains much of it, so that its errors are larger than others but are not outliers.
    """
    each, most = squares / tracks.freedom, int(np.prod(_TILES))
    noise = np.ones(len(tracks))
    if len(tracks) >= _FEWEST_IN_TILE * most:
        groups = tiles(tracks.ends[tracks.starts[:-1], :2], _TILES)
        typical = max(float(np.median(each)), _LEAST_SQUARE)
        for tile in range(most):
            noise[groups == tile] = np.median(each[groups == tile]) / typical
    return np.sqrt(np.maximum(noise, _LEAST_SHARE))


@dataclass(frozen=True, kw_only=True, eq=False)
class Past:
    """Marginalised matches of earlier windows: a quadratic cost of the first control poses of a spline."""

    R: FloatArray
    """(k, 3, 3) rotations of the control poses at which the cost was expanded."""
    p: FloatArray
    """(k, 3) positions of these control poses."""
    gradient: FloatArray
    """(6 k,), followed by the gyroscope's errors if there is one."""
    H: FloatArray
    """(6 k, 6 k), extended likewise."""
    errors: FloatArray | None = None
    """(m,) errors of the gyroscope at which the cost was expanded."""

    def without_gyro(self) -> Past:
        """The cost of the control poses alone, with the gyroscope's errors eliminated."""
        if self.errors is None:
            return self
        k = 6 * len(self.p)
        solved = np.linalg.solve(self.H[k:, k:], np.column_stack([self.H[k:, :k], self.gradient[k:]]))
        H = self.H[:k, :k] - self.H[:k, k:] @ solved[:, :-1]
        gradient = self.gradient[:k] - self.H[:k, k:] @ solved[:, -1]
        return Past(R=self.R, p=self.p, gradient=gradient, H=0.5 * (H + H.T))


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedTracks:
    """Tracks in the form that ``add_tracks`` takes."""

    ends: FloatArray
    """(e, 10) observations."""
    starts: IntArray
    """(n + 1,) index of each track's first observation, and e."""
    members: tuple[IntArray, ...]
    """For each window, the track index (m,) of its tracks, then of its left and right pairs outside tracks."""
    focal: FloatArray
    """(2,) fx, fy, px."""
    past: Past | None = None
    """Marginalised earlier windows; None: the spline begins here, and the world is the body at time 0."""
    share: float = 1.0
    """Weight of a track relative to the prior: less than 1 if errors of neighbouring tracks are correlated."""
    gyro: GyroSteps | None = None
    """Rotations measured by a gyroscope during the spline; None: there is none."""
    by_ratio: FloatArray | None = None
    """(e, 3) derivative of tau by the readout ratio, and its derivatives by the pixel (2), for equations of the
    ``SHARED`` unknowns; None: these are given."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def freedom(self) -> FloatArray:
        """(n,) degrees of freedom of each track's error."""
        return 2.0 * np.diff(self.starts) - 3.0

    def with_noise(self, noise: FloatArray) -> TimedTracks:
        """The tracks with errors in units of their noise (n,), relative to a common one, instead of pixels."""
        ends = self.ends.copy()
        factors, by_ratio = np.repeat(noise, np.diff(self.starts))[:, None], self.by_ratio
        ends[:, 3:9] *= factors
        if by_ratio is not None:
            by_ratio = np.hstack([by_ratio[:, :1], factors * by_ratio[:, 1:]])
        return replace(self, ends=ends, by_ratio=by_ratio)

    def only(self, chosen: BoolArray) -> TimedTracks:
        """The tracks that a mask (n,) selects, without ``members``."""
        lengths = np.diff(self.starts)
        seen = np.repeat(chosen, lengths)
        return replace(
            self,
            ends=self.ends[seen],
            starts=np.concatenate([[0], np.cumsum(lengths[chosen])]),
            members=(),
            by_ratio=None if self.by_ratio is None else self.by_ratio[seen],
        )

    @cached_property
    def span(self) -> tuple[FloatArray, FloatArray]:
        """Times (n,) of the earliest and the latest observation of each track."""
        taus = self.ends[:, 2]
        return np.minimum.reduceat(taus, self.starts[:-1]), np.maximum.reduceat(taus, self.starts[:-1])


def thinned(windows: Sequence[Correspondences], count: int) -> list[Correspondences]:
    """About ``count`` tracks per window, all matches if there are fewer; or pairs for one camera."""
    if is_of_one_camera(windows):
        return [Correspondences(left=each.left[:: max(len(each.left) // count, 1)]) for each in windows]
    few = [Correspondences(tracks=each.tracks[:: max(len(each.tracks) // count, 1)]) for each in windows]
    return [some if len(some.tracks) >= count else each for some, each in zip(few, windows, strict=True)]


def thinned_chains(windows: Sequence[Correspondences], count: int) -> list[Correspondences]:
    """About ``count`` pairs of one camera per window, chosen as whole chains through successive windows."""
    pairs = [each.left for each in windows]
    numbers, chains = _track_numbers(pairs, [np.ones(len(each), dtype=np.bool_) for each in pairs], 0)
    every = max(sum(map(len, pairs)) // max(count * len(pairs), 1), 1)
    kept = np.random.default_rng(0).permutation(chains) % every == 0
    return [Correspondences(left=each[kept[own]]) for each, own in zip(pairs, numbers, strict=True)]


def is_of_one_camera(windows: Sequence[Correspondences]) -> bool:
    """Whether the windows have matches of the left camera only."""
    return not any(len(each.tracks) or len(each.right) for each in windows)


def informative(window: Correspondences) -> Correspondences:
    """The matches of a window that are used: only its tracks if there are ``ENOUGH``, otherwise all."""
    return Correspondences(tracks=window.tracks) if len(window.tracks) >= ENOUGH else window


def pack_windows(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    right: Sequence[FloatArray] | None = None,
    first: int = 0,
    past: Past | None = None,
    share: float = 1.0,
    times: FloatArray | None = None,
) -> TimedTracks:
    """Pack the tracks of windows, and their pairs outside tracks; window k has the frames k and k + 1.

    Args:
        right: for each window, which of its members (m,) are inliers (not 0): inliers that share a pixel in a
            frame are joined to one track; None: none are joined.
        first: number of the first window.
        past, share: see ``TimedTracks``.
        times: (n + 1,) times of the frames' first lines, frame periods; None: ``first``, ``first + 1``, ...
    """
    times = np.arange(first, first + len(windows) + 1.0) if times is None else times
    members = [np.zeros(0, dtype=np.int64) for _ in windows]
    ends, owners = list[FloatArray](), list[IntArray]()
    count = offset = 0
    for sides in (SIDES, SIDES[:1], SIDES[1:]):
        if len(sides) == 2:
            pixels = [window.tracks for window in windows]
        else:  # pairs that are not part of a track
            pixels = [getattr(window, sides[0])[unlinked_pairs(window, sides[0])] for window in windows]
        known = [np.zeros(len(rows), dtype=np.bool_) for rows in pixels]
        if right is not None:
            known = [right[k][len(members[k]) :][: len(rows)] != 0.0 for k, rows in enumerate(pixels)]
        numbers, count = _track_numbers(pixels, known, offset)
        for k, own in enumerate(numbers):
            new = own >= 0 if k == 0 else ~np.isin(own, numbers[k - 1])
            for frame, chosen in ((0, new), (1, np.ones(len(own), dtype=np.bool_))):
                for i, side in enumerate(sides):
                    place = 2 * (frame * len(sides) + i)
                    ends.append(
                        pack_ends(pixels[k][chosen, place : place + 2], times[k + frame], side, rig, shutter)
                    )
                    owners.append(own[chosen])
            members[k] = np.concatenate([members[k], own])
        offset = count
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return TimedTracks(
        ends=np.ascontiguousarray(np.concatenate(ends)[order]),
        starts=np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))]).astype(np.int64),
        members=tuple(members),
        focal=np.array([rig.camera.fx, rig.camera.fy]),
        past=past,
        share=share,
    )


def _track_numbers(
    pixels: Sequence[FloatArray], right: Sequence[BoolArray], first: int
) -> tuple[list[IntArray], int]:
    """For each window the track numbers (n,) of its rows, counted from ``first``, and the next free number.

    An inlier row continues an inlier track of the previous window that ends where the row begins, if that track
    has fewer than ``LONGEST`` frames.
    """
    out, count = list[IntArray](), first
    numbers = lengths = np.zeros(0, dtype=np.int64)
    ends = pixels[0][:0, : pixels[0].shape[1] // 2]
    for rows, known in zip(pixels, right, strict=True):
        half = rows.shape[1] // 2
        open_ = np.flatnonzero(lengths < LONGEST)
        matched = _nearest_ends(rows[:, :half], ends[open_], known)
        continues = matched >= 0
        own, length = np.zeros(len(rows), dtype=np.int64), np.full(len(rows), 2, dtype=np.int64)
        before = open_[matched[continues]]
        own[continues], length[continues] = numbers[before], lengths[before] + 1
        fresh = len(rows) - len(before)
        own[~continues] = count + np.arange(fresh)
        count += fresh
        out.append(own)
        numbers, lengths, ends = own[known], length[known], rows[known, half:]
    return out, count


def _nearest_ends(begins: FloatArray, ends: FloatArray, known: BoolArray) -> IntArray:
    """For each of ``begins`` (n, c) the index of the nearest of ``ends`` (m, c), used once; -1: none is near."""
    out = -np.ones(len(begins), dtype=np.int64)
    distance, nearest = (part[:, 0] for part in nearest_within(begins, ends))
    order = np.argsort(distance, kind="stable")
    order = order[np.isfinite(distance[order]) & known[order]]
    _, firsts = np.unique(nearest[order], return_index=True)
    out[order[firsts]] = nearest[order[firsts]]
    return out


def pack_ends(pixels: FloatArray, frame: float, side: Side, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Observations (n, 10) for pixels (n, 2) of one image whose first line is read at time ``frame``."""
    out = np.zeros((len(pixels), END))
    eye = rig.eye(side)
    out[:, :2], out[:, 2] = eye.unproject(pixels)[:, :2], shutter.pixel_time(pixels, frame, side)
    out[:, 3:7], out[:, 7:9] = eye.ideal_by_pixel(pixels).reshape(-1, 4), shutter.rate(side)
    out[:, 9] = rig.offset(side)[0]
    return out
