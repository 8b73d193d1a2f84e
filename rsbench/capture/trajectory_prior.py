"""How hands, heads and vehicles shake: a Gaussian prior of a trajectory, white acceleration or white jerk.

Its strength is a power spectral density, of rotations and of positions: what the derivative of order 2 or 3 of a
rotation or of a position scatters by, per axis. T. Barfoot, C. Tong, S. Sarkka, Batch continuous-time trajectory
estimation as exactly sparse Gaussian process regression, RSS 2014, for such priors of trajectories.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_poses import blank_views, fill_views
from rsbench.capture.trajectory_spline import Curve
from rsbench.core.so3 import FloatArray

_DIFFERENCES = {2: (-1.0, 1.0), 3: (1.0, -2.0, 1.0)}
"""Of steps between control poses."""
_WIDEST = (1.0, 10.0)
"""Rates, radians and metres per frame period, that are expected before anything is seen."""


class Prior(NamedTuple):
    """White noise of the derivative of order ``order``."""

    order: int
    rotation: float
    """rad^2 per frame period^(2 order - 1)."""
    position: float
    """m^2 per frame period^(2 order - 1)."""


class Roughness(NamedTuple):
    """Sums of squared differences of control poses; with a prior, twice its cost are they over its densities."""

    squares: tuple[float, float]
    """Of rotations and of positions."""
    gradients: FloatArray
    """(2, 6 controls) of half the squares."""
    bands: FloatArray
    """(2, 6 controls, width) Gauss-Newton matrices of half the squares, see ``trajectory_kernels.add_tracks``."""
    count: int
    """Differences of either kind, scalar."""


def roughness(curve: Curve, order: int, width: int) -> Roughness:
    """Of a spline, in bands of a width (at least 6 (order + 1))."""
    scale = curve.interval ** (-(order - 0.5))
    weights = np.array(_DIFFERENCES[order]) * scale
    count, n = len(curve.p) - order, len(curve.p)
    along = np.diff(curve.p, axis=0)
    errors = [sum(c * x[j : j + count] for j, c in enumerate(weights)) for x in (curve.steps, along)]
    by = np.zeros((2, count, order + 1, 3, 3))
    for j, c in enumerate(weights):
        left = curve.inverse_left[j : j + count]
        by[0, :, j + 1] += c * left
        by[0, :, j] -= c * np.swapaxes(left, 1, 2)
        by[1, :, j + 1] += c * np.eye(3)
        by[1, :, j] -= c * np.eye(3)
    gradients, bands = np.zeros((2, 6 * n)), np.zeros((2, 6 * n, width))
    for kind in range(2):
        add_blocks(gradients[kind], bands[kind], by[kind], errors[kind], np.arange(count), 3 * kind)
    squares = float(np.sum(errors[0] ** 2)), float(np.sum(errors[1] ** 2))
    return Roughness(squares, gradients, bands, 3 * count)


def add_blocks(
    gradient: FloatArray, band: FloatArray, by: FloatArray, errors: FloatArray, first: NDArray[np.int64], part: int
) -> None:
    """Add normal equations of errors (n, m) whose derivatives (n, k, m, 3) are by k successive control poses.

    Args:
        first: (n,) number of the first of these poses, each once.
        part: 0 or 3: rotations or positions.
    """
    k = by.shape[1]
    for a in range(k):
        rows = 6 * (first + a) + part
        for i in range(3):
            gradient[rows + i] += np.sum(by[:, a, :, i] * errors, axis=1)
        for b in range(a + 1):
            product = np.swapaxes(by[:, a], 1, 2) @ by[:, b]
            columns = 6 * (first + b) + part
            for i in range(3):
                for j in range(3 if b < a else i + 1):
                    band[columns + j, 6 * (a - b) + i - j] += product[:, i, j]


def anchors(curve: Curve, order: int, width: int, precision: float) -> FloatArray:
    """Band (6 controls, width) of what a roughness leaves free: the first pose, and what is expected of rates.

    They are the same for any knots. ``precision`` is that of the pose at time 0.
    """
    n = len(curve.p)
    band = np.zeros((6 * n, width))
    views = blank_views(1)
    fill_views(curve, np.zeros(1), views)
    first, nothing, unused = views.index, np.zeros((1, 3)), np.zeros(6 * n)
    root = np.sqrt(precision)
    add_blocks(unused, band, root * views.turn, nothing, first, 0)
    add_blocks(unused, band, root * views.share[..., None, None] * np.eye(3), nothing, first, 3)
    middle = np.array([(n - order) // 2])
    for kind in range(2):
        for degree in range(1, order):
            weights = np.diff(np.eye(order + 1), n=degree, axis=0)[0] / curve.interval**degree / _WIDEST[kind]
            by = weights[None, : degree + 1, None, None] * np.eye(3)
            add_blocks(unused, band, by, nothing, middle, 3 * kind)
    return band
