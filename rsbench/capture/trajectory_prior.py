"""How hands, heads and vehicles shake: a Gaussian prior of a trajectory.

Accelerations, about each axis and along it, are stationary noise that forgets within a time (R. Singer, Estimating
optimal tracking filter performance for manned maneuvering targets, IEEE Trans. AES 1970): as second differences d
of the control poses, (1 - rho L)^m d is white, L the step back by a knot and rho = exp(-interval / memory). White
accelerations, whose memory is 0, would let a rig tremble at any rate; jerk that is white lets it run away.
T. Barfoot, C. Tong, S. Sarkka, Batch continuous-time trajectory estimation as exactly sparse Gaussian process
regression, RSS 2014, for such priors of trajectories.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_poses import blank_views, fill_views
from rsbench.capture.trajectory_spline import Curve
from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray

_WIDEST = (1.0, 10.0)
"""Rates, radians and metres per frame period, that are expected before anything is seen."""


class Prior(NamedTuple):
    """Accelerations that are expected."""

    memory: float
    """Frame periods after which they are forgotten."""
    smooth: int
    """m: 1 or 2; the power of fast shaking falls with its rate to the power of -4 - 2 m."""
    rotation: float
    """Variance of angular accelerations about each axis, rad^2 per frame period^4."""
    position: float
    """Variance of accelerations along each axis, m^2 per frame period^4."""


class Roughness(NamedTuple):
    """Sums of squared accelerations, whitened; over the variances of a prior, twice its cost."""

    squares: FloatArray
    """(2,) of rotations and of positions."""
    gradients: FloatArray
    """(2, 6 controls) of half the squares."""
    bands: FloatArray
    """(2, 6 controls, width) Gauss-Newton matrices of half the squares, see ``trajectory_kernels.add_tracks``."""
    count: int
    """Accelerations of either kind, scalar."""
    log_density: float
    """Logarithm of the density of control poses of one axis, at unit variances and but for constants."""


def whitening(interval: float, memory: float, smooth: int) -> list[FloatArray]:
    """Weights of successive second differences, for accelerations of unit variance.

    One row for each of the first ``smooth`` differences, which know less of what was before, and one for all
    later ones.
    """
    rho = float(np.exp(-interval / memory)) if memory > 0.0 else 0.0
    unit = interval**-2
    if smooth == 1:
        rows = [np.array([1.0]), np.array([-rho, 1.0]) / np.sqrt(1.0 - rho**2)]
    else:
        r = 2.0 * rho / (1.0 + rho**2)
        late = np.array([rho**2, -2.0 * rho, 1.0]) * np.sqrt((1.0 + rho**2) / (1.0 - rho**2) ** 3)
        rows = [np.array([1.0]), np.array([-r, 1.0]) / np.sqrt(1.0 - r**2), late]
    return [unit * row for row in rows]


def roughness(
    curve: Curve, memory: float, smooth: int, width: int, begins: bool = True, until: int | None = None
) -> Roughness:
    """Of a spline, in bands of a width (at least 6 (smooth + 3)).

    Args:
        begins: whether nothing is known of accelerations before the first control pose; without it, differences
            that need them are left out.
        until: number of a control pose; only differences that begin before it.
    """
    n, steps = len(curve.p), (curve.steps, np.diff(curve.p, axis=0))
    gradients, bands = np.zeros((2, 6 * n)), np.zeros((2, 6 * n, width))
    squares, log_density, total = np.zeros(2), -float(np.log(curve.interval)), 0
    for number, row in enumerate(whitening(curve.interval, memory, smooth)):
        late = number == smooth
        if not late and not begins:
            continue
        count = max(min(n - 2 - smooth, n if until is None else until), 0) if late else 1
        log_density += count * float(np.log(row[-1]))
        total += 3 * count
        weights = -np.diff(np.concatenate([[0.0], row, [0.0]]))
        by = np.zeros((2, count, len(weights) + 1, 3, 3))
        for j, c in enumerate(weights):
            left = curve.inverse_left[j : j + count]
            by[0, :, j + 1] += c * left
            by[0, :, j] -= c * np.swapaxes(left, 1, 2)
            by[1, :, j + 1] += c * np.eye(3)
            by[1, :, j] -= c * np.eye(3)
        for kind in range(2):
            errors = np.asarray(sum(c * steps[kind][j : j + count] for j, c in enumerate(weights)))
            add_blocks(gradients[kind], bands[kind], by[kind], errors, np.arange(count), 3 * kind)
            squares[kind] += np.sum(errors**2)
    return Roughness(squares, gradients, bands, total, log_density)


def log_prior(curve: Curve, prior: Prior, rough: Roughness) -> float:
    """Logarithm of the density of a prior at its mode, but for constants that are the same for any knots.

    All second differences, one rate and one pose are as good as the control poses: the matrix between them has the
    determinant 1.
    """
    sizes = 0.5 * rough.count * float(np.log(prior.rotation) + np.log(prior.position))
    return 6.0 * rough.log_density - sizes


def add_blocks(
    gradient: FloatArray,
    band: FloatArray,
    by: FloatArray,
    errors: FloatArray,
    first: NDArray[np.int64],
    part: int,
) -> None:
    """Add normal equations of errors (n, m) whose derivatives (n, k, m, 3) are by k successive control poses.

    Args:
        first: (n,) number of the first of these poses.
        part: 0 or 3: rotations or positions.
    """
    by, errors = np.ascontiguousarray(by), np.ascontiguousarray(errors)
    _add_blocks(gradient, band, by, errors, first, part)


@compiled
def _add_blocks(
    gradient: FloatArray,
    band: FloatArray,
    by: FloatArray,
    errors: FloatArray,
    first: NDArray[np.int64],
    part: int,
) -> None:
    count, controls, size, _ = by.shape
    for k in range(count):
        for a in range(3 * controls):
            row, i = 6 * (first[k] + a // 3) + part + a % 3, a % 3
            for m in range(size):
                gradient[row] += by[k, a // 3, m, i] * errors[k, m]
            for b in range(a + 1):
                column, j, total = 6 * (first[k] + b // 3) + part + b % 3, b % 3, 0.0
                for m in range(size):
                    total += by[k, a // 3, m, i] * by[k, b // 3, m, j]
                band[column, row - column] += total


def anchors(curve: Curve, width: int, precision: float) -> FloatArray:
    """Band (6 controls, width) of what a roughness leaves free: the pose at time 0, and a rate.

    They are the same for any knots. ``precision`` is that of the pose at time 0.
    """
    n = len(curve.p)
    band, views = np.zeros((6 * n, width)), blank_views(1)
    fill_views(curve, np.zeros(1), views)
    first, nothing, unused = views.index, np.zeros((1, 3)), np.zeros(6 * n)
    root = np.sqrt(precision)
    add_blocks(unused, band, root * views.turn, nothing, first, 0)
    add_blocks(unused, band, root * views.share[..., None, None] * np.eye(3), nothing, first, 3)
    middle = np.array([(n - 2) // 2])
    for kind in range(2):
        by = np.array([-1.0, 1.0])[None, :, None, None] / curve.interval / _WIDEST[kind] * np.eye(3)
        add_blocks(unused, band, by, nothing, middle, 3 * kind)
    return band
