"""Compiled normal equations by the motion and by unknowns of the capture: readout ratio, delay, lens and the like.

What an unknown changes is where and when the ends of a match are: ray and time of each have a derivative by it. So
one pass over the measurements gives the equations of all unknowns. Errors have heavy tails (``heavy_tails``).
"""

from __future__ import annotations

import math

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel
from rsbench.solvers.engine.kernels import BEHIND, at_pixels, displacement, pair_gradient, pair_jacobian, shifted
from rsbench.solvers.engine.timed_tracks import linearise_best, whiten
from rsbench.solvers.engine.vectors import apply, apply_transposed, cross, dot, plus

_LEAST_SLOPE = 0.1
"""Of the weight: what a measurement far off counts in the Hessian, at least, as in ``heavy_tails``."""
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
    """Negative log-likelihood of tracks times the squared scale, px^2; its gradient and Hessian are added to.

    Args:
        theta: (6,) of the motion.
        tracks: (n, 4, 9), see ``timed_track_terms``.
        by: (n, 4, k, 3) derivatives of the ends' rays (x, y) and times by k unknowns.
        focal: (2,), px; baseline: metres.
        tails: (2,) degrees of freedom and scale, px, of the errors' t distribution.
        trust: (n,) factors on the log-likelihoods.
        gradient, H: (6 + k,), (6 + k, 6 + k).
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
        square = 0.0
        for i in range(8):
            square += e[i] * e[i]
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
    """Derivative (8,) of a track's whitened errors by one unknown, of which the ends have ``by`` (4, 3)."""
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
    """Of a measurement in the gradient and in the Hessian: its second derivative, averaged over directions."""
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
    """What ``add_tracks`` is, of pairs (n, 17); ``by``: (n, 2, k, 3)."""
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
    """Sampson residual, px, of one pair (1, 17), and the norm of its constraint's derivative by the pixels.

    Fills J (6 and more,) with the derivative of the constraint by the motion, and ``ends`` (6,) with that by ray
    and time of either end, both at the corrected pair, see ``kernels``.
    """
    R, A, T_w, T_v = work[0], work[1], work[2], work[3]
    x, y, offset = (pairs[0, 0], pairs[0, 1], 1.0), (pairs[0, 2], pairs[0, 3], 1.0), pairs[0, 6]
    tau0, tau1 = pairs[0, 4], pairs[0, 5]
    T, rate0, rate1, spin0, spin1 = kernel.move(theta, tau0, tau1, R, A)
    Ro = (R[0, 0] * offset, R[1, 0] * offset, R[2, 0] * offset)
    T = plus((T[0] + offset, T[1], T[2]), -1.0, Ro)
    rate0, rate1 = plus(rate0, -1.0, cross(spin0, Ro)), plus(rate1, -1.0, cross(spin1, Ro))
    L0, L1, slope = at_pixels(pairs, 0, 0.0)
    value, q = pair_gradient(x, y, R, T, rate0, rate1, spin0, spin1, focal, L0, L1, slope)
    qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]
    if qq <= 0.0:
        return displacement(apply(R, x), y, focal), 0.0
    step = value / qq
    x, y = shifted(x, L0, step * q[0], step * q[1], focal), shifted(y, L1, step * q[2], step * q[3], focal)
    tau0 -= slope[1] * step * q[1] + slope[0] * step * q[0]
    tau1 -= slope[1] * step * q[3] + slope[0] * step * q[2]
    pair_jacobian(theta, kernel, x, y, tau0, tau1, offset, R, A, T_w, T_v, J)
    T, rate0, rate1, spin0, spin1 = kernel.move(theta, tau0, tau1, R, A)
    Ro = (R[0, 0] * offset, R[1, 0] * offset, R[2, 0] * offset)
    T = plus((T[0] + offset, T[1], T[2]), -1.0, Ro)
    rate0, rate1 = plus(rate0, -1.0, cross(spin0, Ro)), plus(rate1, -1.0, cross(spin1, Ro))
    p = apply(R, x)
    n, line, back = cross(p, y), cross(T, p), apply_transposed(R, cross(y, T))
    ends[0], ends[1], ends[3], ends[4] = back[0], back[1], line[0], line[1]
    ends[2] = dot(rate0, n) + dot(spin0, y) * dot(T, p) - dot(spin0, T) * dot(y, p)
    ends[5] = dot(rate1, n) + dot(spin1, y) * dot(T, p) - dot(spin1, T) * dot(y, p)
    return value / math.sqrt(qq), math.sqrt(qq)
