"""What each measurement adds to the normal equations: for weights, leverages and covariances of the errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.kernel_type import MotionKernel
from rsbench.solvers.engine.kernels import pair_terms
from rsbench.solvers.engine.packed import Packed
from rsbench.solvers.engine.track_kernels import track_terms


class Each(NamedTuple):
    """The pairs and then the tracks of a problem, n in all, at one motion."""

    squares: FloatArray
    """(n,) squared whitened errors, px^2."""
    gradients: FloatArray
    """(n, 6) of half the square."""
    hessians: FloatArray
    """(n, 6, 6) of Gauss and Newton."""


def each_term(packed: Packed, theta: FloatArray) -> Each:
    """What ``Packed.normal_equations`` sums up, and with the row checks of the tracks in their squares."""
    pairs, count = len(packed.pairs), len(packed.pairs) + len(packed.tracks)
    squares, g, H = np.zeros(count), np.zeros((count, 6)), np.zeros((count, 6, 6))
    _each_pair(theta, packed.law, packed.pairs, packed.focal, packed.h, squares[:pairs], H[:pairs], g[:pairs])
    squares[:pairs] **= 2
    _each_track(
        theta,
        packed.law,
        packed.tracks,
        packed.focal,
        packed.h,
        packed.baseline,
        squares[pairs:],
        H[pairs:],
        g[pairs:],
    )
    squares[pairs:] += packed.row_checks
    return Each(squares, g, H)


@compiled
def _each_pair(
    theta: FloatArray,
    kernel: MotionKernel,
    pairs: FloatArray,
    focal: FloatArray,
    h: float,
    residuals: FloatArray,
    H: FloatArray,
    gradients: FloatArray,
) -> None:
    want = len(pairs) > 0  # a literal True would compile all of pair_terms once more
    for k in range(len(pairs)):
        pair_terms(theta, kernel, pairs[k : k + 1], focal, h, residuals[k : k + 1], H[k], gradients[k], want)


@compiled
def _each_track(
    theta: FloatArray,
    kernel: MotionKernel,
    tracks: FloatArray,
    focal: FloatArray,
    h: float,
    baseline: float,
    squares: FloatArray,
    H: FloatArray,
    gradients: FloatArray,
) -> None:
    want = len(tracks) > 0
    for k in range(len(tracks)):
        track_terms(
            theta,
            kernel,
            tracks[k : k + 1],
            focal,
            h,
            baseline,
            squares[k : k + 1],
            H[k],
            gradients[k],
            want,
        )
