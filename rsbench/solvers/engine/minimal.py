"""Minimal samples of tracks, many in one call: what a search spends its time on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel
from rsbench.solvers.engine.packed import Packed
from rsbench.solvers.engine.track_kernels import track_terms

_DAMPING = 1e-4


def solve_triples(packed: Packed, samples: NDArray[np.int64], iterations: int = 4) -> FloatArray:
    """Parameters (b, 6) of samples (b, k) of k >= 3 tracks; NaN where the step is not determined.

    Damped Gauss-Newton from no motion at all, whose first step is the linear stereo pose-from-points solution.
    A step that does not lower the cost is not taken and the damping grows.
    """
    out = np.zeros((len(samples), 6))
    _descend(packed.tracks, samples, packed.law, packed.focal, packed.h, packed.baseline, iterations, out)
    return out


@compiled
def _descend(
    tracks: FloatArray,
    samples: NDArray[np.int64],
    kernel: MotionKernel,
    focal: FloatArray,
    h: float,
    baseline: float,
    iterations: int,
    out: FloatArray,
) -> None:
    size = samples.shape[1]
    want = size > 0  # a literal True would compile all of track_terms once more
    squares = np.zeros(size)
    H, gradient, theta, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6), np.zeros(6)
    trial_H, trial_gradient = np.zeros((6, 6)), np.zeros(6)
    for s in range(len(samples)):
        chosen = tracks[samples[s]]
        theta[:], H[:], gradient[:], damping = 0.0, 0.0, 0.0, _DAMPING
        track_terms(theta, kernel, chosen, focal, h, baseline, squares, H, gradient, want)
        cost = squares.sum()
        for _ in range(iterations):
            if not damped_step(H, gradient, damping, step):
                theta[:] = np.nan
                break
            trial = theta + step
            trial_H[:], trial_gradient[:] = 0.0, 0.0
            track_terms(trial, kernel, chosen, focal, h, baseline, squares, trial_H, trial_gradient, want)
            if squares.sum() <= cost:
                cost = squares.sum()
                theta, H, trial_H, gradient, trial_gradient = trial, trial_H, H, trial_gradient, gradient
                damping *= 0.1
            else:
                damping *= 10.0
        # Copying by elements, and swapping above: the error of a copy between slices takes a second to compile.
        for k in range(6):
            out[s, k] = theta[k]


@compiled
def damped_step(H: FloatArray, gradient: FloatArray, damping: float, step: FloatArray) -> bool:
    """Fill step (6,) with -(H + damping diag H)^-1 gradient, by Cholesky; False when H is singular."""
    n = len(step)
    L = np.zeros((n, n))
    for j in range(n):
        if not H[j, j] > 0.0:
            return False
        pivot = H[j, j] * (1.0 + damping)
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot > 1e-14 * H[j, j]:
            return False
        L[j, j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            value = H[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / L[j, j]
    for i in range(n):
        value = -gradient[i]
        for k in range(i):
            value -= L[i, k] * step[k]
        step[i] = value / L[i, i]
    for m in range(n):
        i = n - 1 - m
        value = step[i]
        for k in range(i + 1, n):
            value -= L[k, i] * step[k]
        step[i] = value / L[i, i]
    return True
