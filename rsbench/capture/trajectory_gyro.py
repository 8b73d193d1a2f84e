"""A gyroscope beside the matches of a sequence: how fast it turns at its moments, and what it errs by.

A sample is a measurement of the spline's rate at its time, of white noise, so that nothing is integrated: neither
gaps nor slow sampling matter. A bias that stays and the noise's variance are found with the spline: the bias is an
unknown beside the control poses, a border of three columns beside the band.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_poses import blank_views, fill_views
from rsbench.capture.trajectory_prior import add_blocks
from rsbench.capture.trajectory_spline import Curve
from rsbench.core import so3
from rsbench.core.correspondences import BoolArray
from rsbench.core.so3 import FloatArray

_APART = 1 / 16
"""Frame periods: samples that are closer are taken together. A filter in the sensor makes their noise alike, and
the mean over an eighth of a period blunts what a hand shakes."""
_MOMENT = 1e-3
"""Half of the time over which the spline's turn is taken for its rate: far above rounding, far below a knot."""
_BIAS = 1e-2
"""Standard deviation of the bias, rad per frame period, before anything is seen: 0.3 rad/s at 30 Hz."""
_LEAST_VARIANCE = 1e-12
"""rad^2 per frame period: far below that of any gyroscope, and above rounding."""
_TELLING = 2.0
"""Errors beside those that the spline follows, at least, to say how large they are."""
_UNLIKE, _NOISY = 0.3, 3.0
"""Root mean square of a gyroscope's errors, over that of how its rates vary and over that of its own noise, from
which on both it contradicts the matches."""


class GyroSteps(NamedTuple):
    """Turns that a gyroscope measured, n of them in the order of time."""

    start: FloatArray
    """(n,) frame periods."""
    end: FloatArray
    turn: FloatArray
    """(n, 3) rotation vectors of the body at the end, seen from the body at the start; bias and all."""
    worth: FloatArray
    """(n,) frame periods that one speaks for: its rates have the noise of a turn over so long."""

    def between(self, first: float, last: float) -> GyroSteps:
        """Those that start at a time or later, and end at another or earlier."""
        return self._of((self.start >= first) & (self.end <= last))

    def begun_before(self, time: float) -> GyroSteps:
        """Those that start before a time: all others of them do so then or later."""
        return self._of(self.start < time)

    def _of(self, chosen: BoolArray) -> GyroSteps:
        return GyroSteps(*(each[chosen] for each in self))


class Drift(NamedTuple):
    """What a gyroscope errs by."""

    bias: FloatArray
    """(3,) of its rates in the convention of ``Correspondences.gyro``, rad per frame period."""
    variance: float
    """Of the white noise of its turn over a frame period, about each axis, rad^2."""


class Border(NamedTuple):
    """Normal equations of the bias beside those of the control poses."""

    mixed: FloatArray
    """(6 controls, 3)."""
    corner: FloatArray
    """(3, 3)."""
    slope: FloatArray
    """(3,) gradient."""


class Sensed(NamedTuple):
    """Sum of squared errors of steps, whitened but for the variance, and half its derivatives."""

    squares: float
    gradient: FloatArray
    """(6 controls,)."""
    band: FloatArray
    """(6 controls, width)."""
    border: Border
    count: int
    """Scalar errors."""


def gyro_steps(samples: FloatArray) -> GyroSteps:
    """Turns within a moment around samples (n, 4) tau, w, in any order; close ones are taken together."""
    samples = samples[np.argsort(samples[:, 0], kind="stable")]
    first = np.flatnonzero(np.diff(np.floor(samples[:, 0] / _APART), prepend=-np.inf))
    if len(first) < 2:
        return GyroSteps(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    count = np.diff(first, append=len(samples))
    means = np.add.reduceat(samples, first) / count[:, None]
    worth = count * (samples[-1, 0] - samples[0, 0]) / (len(samples) - 1)
    return GyroSteps(means[:, 0] - _MOMENT, means[:, 0] + _MOMENT, 2.0 * _MOMENT * means[:, 1:], worth)


def sensed(curve: Curve, steps: GyroSteps, bias: FloatArray, width: int) -> Sensed:
    """Errors of steps within a spline, and their derivatives in a band of a width."""
    count, controls, length = len(steps.start), len(curve.p), steps.end - steps.start
    views = blank_views(2 * count)
    fill_views(curve, np.concatenate([steps.start, steps.end]), views)
    R, turn, index = views.R.reshape(2, count, 3, 3), views.turn.reshape(2, count, 4, 3, 3), views.index
    turned, wanted = R[1] @ np.swapaxes(R[0], 1, 2), steps.turn - length[:, None] * bias
    off = turned @ np.swapaxes(so3.exp(wanted), 1, 2)
    errors, root = so3.log(off), (steps.worth**0.5 / length)[:, None]
    # By a turn of the body at the end, and whitened.
    by_end = np.linalg.inv(so3.left_jacobian(errors)) * root[..., None]
    by_bias = by_end @ off @ so3.left_jacobian(wanted) * length[:, None, None]
    errors = root * errors
    size = 4 + int(np.max(index[count:] - index[:count], initial=0))
    first = np.minimum(index[:count], controls - size)
    by, rows = np.zeros((count, size, 3, 3)), np.arange(count)[:, None]
    by[rows, (index[:count] - first)[:, None] + np.arange(4)] -= (by_end @ turned)[:, None] @ turn[0]
    by[rows, (index[count:] - first)[:, None] + np.arange(4)] += by_end[:, None] @ turn[1]
    gradient, band, mixed = np.zeros(6 * controls), np.zeros((6 * controls, width)), np.zeros((controls, 6, 3))
    add_blocks(gradient, band, by, errors, first, 0)
    np.add.at(mixed[:, :3], first[:, None] + np.arange(size), np.swapaxes(by, 2, 3) @ by_bias[:, None])
    corner, slope = np.einsum("kmi,kmj->ij", by_bias, by_bias), np.einsum("kmi,km->i", by_bias, errors)
    border = Border(mixed.reshape(-1, 3), corner, slope)
    return Sensed(float(np.sum(errors**2)), gradient, band, border, errors.size)


def first_drift(curve: Curve, steps: GyroSteps) -> Drift:
    """No bias, and the noise that steps have about a spline."""
    found = sensed(curve, steps, np.zeros(3), 6 * len(curve.p))
    return Drift(np.zeros(3), max(found.squares / max(found.count, 1), _LEAST_VARIANCE))


def border_of(found: Sensed, drift: Drift, begins: bool) -> tuple[float, Border]:
    """Cost of errors, and what they say of the bias; at the beginning of a sequence, that it is small too."""
    border = Border(*(each / drift.variance for each in found.border))
    cost = 0.5 * found.squares / drift.variance
    if begins:
        cost += 0.5 * float(drift.bias @ drift.bias) / _BIAS**2
        known = border.corner + np.eye(3) / _BIAS**2, border.slope + drift.bias / _BIAS**2
        border = Border(border.mixed, *known)
    return cost, border


class Eliminated(NamedTuple):
    """The bias, left out of normal equations whose factor is known."""

    follows: FloatArray
    """(6 controls, 3) how the control poses move against the bias."""
    covariance: FloatArray
    """(3, 3) of the bias."""
    log_determinant: float
    """What it adds to that of the control poses alone."""


def eliminated(lower: FloatArray, border: Border) -> Eliminated:
    """Raises NotDefiniteError."""
    follows = banded.solve(lower, border.mixed)
    left = border.corner - border.mixed.T @ follows
    try:
        root = np.linalg.cholesky(0.5 * (left + left.T))
    except np.linalg.LinAlgError as error:
        raise banded.NotDefiniteError(str(error)) from None
    inverse = np.linalg.inv(root)
    return Eliminated(follows, inverse.T @ inverse, 2.0 * float(np.sum(np.log(np.diagonal(root)))))


def bordered_step(lower: FloatArray, gradient: FloatArray, border: Border) -> tuple[FloatArray, FloatArray]:
    """Newton's step of control poses (6 controls,) and bias (3,). Raises NotDefiniteError."""
    alone, bias = banded.solve(lower, gradient), eliminated(lower, border)
    step = -bias.covariance @ (border.slope - border.mixed.T @ alone)
    return -alone - bias.follows @ step, step


def bordered_inverse(lower: FloatArray, border: Border | None) -> FloatArray:
    """Covariance of control poses, in its band, with a bias that is not known beside them."""
    inverse = banded.inverse_band(lower)
    if border is None:
        return inverse
    bias = eliminated(lower, border)
    spread = bias.follows @ bias.covariance
    for i in range(inverse.shape[1]):
        inverse[: len(lower) - i, i] += np.sum(spread[: len(lower) - i] * bias.follows[i:], axis=1)
    return inverse


def learned(
    found: Sensed, drift: Drift, lower: FloatArray, inverse: FloatArray, border: Border
) -> tuple[float, float, Drift]:
    """Parameters that steps determine, errors that are left beside them, and the variance of more evidence.

    Args:
        lower: factor of the normal matrix of control poses alone.
        inverse: see ``bordered_inverse``.
    """
    bias = eliminated(lower, border)
    tied = banded.inner(inverse, found.band) + np.sum(bias.covariance * found.border.corner)
    tied -= 2.0 * np.sum((bias.follows @ bias.covariance) * found.border.mixed)
    used = float(tied) / drift.variance
    left = found.count - used
    if left <= _TELLING:
        return used, 1e-3, drift
    return used, left, drift._replace(variance=max(found.squares / left, _LEAST_VARIANCE))


def contradicts(steps: GyroSteps, drift: Drift) -> bool:
    """Whether a gyroscope errs by much of what it measures, and by more than its noise: of another clock."""
    if len(steps.start) < 3:
        return False
    rates = steps.turn / (steps.end - steps.start)[:, None]
    errors = drift.variance * float(np.mean(1.0 / steps.worth))
    varied = float(np.mean(np.var(rates, axis=0)))
    noise = float(np.mean(np.diff(rates, n=2, axis=0) ** 2)) / 6.0  # slow turns hardly show in second differences
    return errors > max(_UNLIKE**2 * varied, _NOISY**2 * noise)
