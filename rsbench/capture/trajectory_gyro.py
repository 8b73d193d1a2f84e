"""Gyroscope samples in the fit of a trajectory, and the estimation of the gyroscope's errors.

A sample measures the angular rate of the spline at its time, with white noise. Nothing is integrated, so gaps and
slow sampling do no harm. A constant bias, the offset of its clock, and errors of its axes and scales are unknowns
in addition to the control poses: 13 columns that border the band matrix. Then the noise variance is estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rsbench.capture.trajectory_spline import (
    Curve,
    NotDefiniteError,
    add_blocks,
    band_inner,
    band_inverse,
    band_solve,
    blank_views,
    fill_views,
)
from rsbench.core import so3
from rsbench.core.so3 import FloatArray

_APART = 1 / 16
"""Samples are averaged over this time, frame periods: a filter in the sensor correlates the noise of closer ones,
and a mean over an eighth of a period would attenuate the shake of a hand."""
_MOMENT = 1e-3
"""Half of the time step, frame periods, of the difference that gives the spline's rate."""
_BIAS = 1e-2
"""Prior standard deviation of the bias, rad per frame period: 0.3 rad/s at 30 Hz."""
_SHIFT, FARTHEST = 0.2, 0.5
"""Prior standard deviation of the shift of its clock, frame periods, and the largest shift: a quarter of the
period of the fastest shakes of a hand."""
_MISALIGNMENT, _MOST_MISALIGNMENT = 0.02, 0.3
"""Prior standard deviation of errors of axes and scales, rad and relative, and their largest plausible value."""
ERRORS = 13
_EXPECTED = np.array([_BIAS] * 3 + [_SHIFT] + [_MISALIGNMENT] * 9)
_LEAST_VARIANCE = 1e-12
"""Smallest noise variance, rad^2 per frame period: far below that of any gyroscope, and above rounding."""
_LEAST_RESIDUALS = 2.0
"""Effective number of residuals, after those that the spline follows, above which their variance is estimated."""
_UNLIKE, _NOISY = 0.3, 3.0
"""A gyroscope contradicts the matches if the root mean square of its errors exceeds this share of the variation of
its rates and this multiple of its noise."""


class GyroSteps(NamedTuple):
    """n rotations that a gyroscope measured, in the order of time."""

    start: FloatArray
    """(n,) frame periods."""
    end: FloatArray
    turn: FloatArray
    """(n, 3) rotation vectors of the body at the end, relative to the body at the start; including the bias."""
    worth: FloatArray
    """(n,) frame periods that each sample represents: its rate has the noise of a rotation over that time."""

    def between(self, first: float, last: float) -> GyroSteps:
        """The rotations within the times ``first`` to ``last``."""
        begun, ended = np.searchsorted(self.start, first), np.searchsorted(self.end, last, side="right")
        return GyroSteps(*(each[begun:ended] for each in self))

    def begun_before(self, time: float) -> GyroSteps:
        """The rotations that start before a time."""
        return GyroSteps(*(each[: np.searchsorted(self.start, time)] for each in self))


class Drift(NamedTuple):
    """Errors of a gyroscope."""

    errors: FloatArray
    """(13,) bias of the rates in the convention of ``Correspondences.gyro``, rad per frame period (3); shift of
    the clock, i.e. frame periods by which its times are early (1); matrix of axes and scales, minus 1 (9)."""
    variance: float
    """Variance of the white noise of its rotation over a frame period about each axis, rad^2."""

    @property
    def bias(self) -> FloatArray:
        """(3,) rad per frame period."""
        return self.errors[:3]

    @property
    def shift(self) -> float:
        """Frame periods by which its times are early."""
        return float(self.errors[3])

    @property
    def misalignment(self) -> FloatArray:
        """(3, 3) deviation of the matrix of axes and scales from the identity."""
        return self.errors[4:].reshape(3, 3)

    def moved(self, step: FloatArray) -> Drift:
        """The errors after a step (13,), with the shift clipped to its limits."""
        errors = self.errors + step
        errors[3] = np.clip(errors[3], -FARTHEST, FARTHEST)
        return self._replace(errors=errors)


@dataclass(frozen=True, kw_only=True, eq=False)
class GyroFound:
    """Errors of a gyroscope, as estimated from a sequence."""

    bias: FloatArray
    """(3,) bias of its samples, rad per frame period."""
    shift: float
    """Frame periods by which its times are early."""
    matrix: FloatArray
    """(3, 3) matrix that multiplies its rates: the identity plus errors of axes and scales."""
    noise: float
    """Standard deviation of its rotation over a period about each axis, rad, including unmodelled motion."""
    used: bool
    """False: its samples contradict the matches (other times, signs or axes) and were not used."""

    @classmethod
    def of(cls, drift: Drift, *, used: bool = True) -> GyroFound:
        noise = float(np.sqrt(drift.variance))
        matrix = np.eye(3) + drift.misalignment
        return cls(bias=drift.bias, shift=drift.shift, matrix=matrix, noise=noise, used=used)


class Border(NamedTuple):
    """The parts of the normal equations that involve m unknowns besides the control poses, as a gyroscope's errors
    (13)."""

    mixed: FloatArray
    """(6 controls, m)."""
    corner: FloatArray
    """(m, m)."""
    slope: FloatArray
    """(m,) gradient."""


class Sensed(NamedTuple):
    """Sum of squared residuals of the samples for a variance of 1, and half its derivatives."""

    squares: float
    gradient: FloatArray
    """(6 controls,)."""
    band: FloatArray
    """(6 controls, width)."""
    border: Border
    count: int
    """Number of scalar residuals."""


def gyro_steps(samples: FloatArray) -> GyroSteps:
    """Convert samples (n, 4) tau, w, in any order, to short rotations; close samples are averaged."""
    samples = samples[np.argsort(samples[:, 0], kind="stable")]
    first = np.flatnonzero(np.diff(np.floor(samples[:, 0] / _APART), prepend=-np.inf))
    if len(first) < 2:
        return GyroSteps(np.zeros(0), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    count = np.diff(first, append=len(samples))
    means = np.add.reduceat(samples, first) / count[:, None]
    worth = count * (samples[-1, 0] - samples[0, 0]) / (len(samples) - 1)
    return GyroSteps(means[:, 0] - _MOMENT, means[:, 0] + _MOMENT, 2.0 * _MOMENT * means[:, 1:], worth)


def sensed(curve: Curve, steps: GyroSteps, drift: Drift, width: int) -> Sensed:
    """Residuals of steps for a spline, with derivatives in a band of a width (at least 30: five control poses)."""
    count, controls, length = len(steps.start), len(curve.p), steps.end - steps.start
    views = blank_views(2 * count)
    fill_views(curve, np.concatenate([steps.start, steps.end]) + drift.shift, views)
    R, turn, index = views.R.reshape(2, count, 3, 3), views.turn.reshape(2, count, 4, 3, 3), views.index
    turned = R[1] @ np.swapaxes(R[0], 1, 2)
    wanted = steps.turn + steps.turn @ drift.misalignment.T - length[:, None] * drift.bias
    off = turned @ np.swapaxes(so3.exp(wanted), 1, 2)
    errors, root = so3.log(off), (steps.worth**0.5 / length)[:, None]
    # Derivative by a rotation of the body at the end, whitened.
    by_end = np.linalg.inv(so3.left_jacobian(errors)) * root[..., None]
    faster = views.spin[count:] - (turned @ views.spin[:count, :, None])[..., 0]
    against = by_end @ off @ so3.left_jacobian(wanted)
    by_matrix = -(against[..., None] * steps.turn[:, None, None, :]).reshape(count, 3, 9)
    by_drift = np.concatenate([against * length[:, None, None], by_end @ faster[..., None], by_matrix], axis=2)
    errors = root * errors
    size = 4 + int(np.max(index[count:] - index[:count], initial=0))
    first = np.minimum(index[:count], controls - size)
    by, rows = np.zeros((count, size, 3, 3)), np.arange(count)[:, None]
    by[rows, (index[:count] - first)[:, None] + np.arange(4)] -= (by_end @ turned)[:, None] @ turn[0]
    by[rows, (index[count:] - first)[:, None] + np.arange(4)] += by_end[:, None] @ turn[1]
    gradient, band = np.zeros(6 * controls), np.zeros((6 * controls, width))
    mixed = np.zeros((controls, 6, ERRORS))
    add_blocks(gradient, band, by, errors, first, 0)
    np.add.at(mixed[:, :3], first[:, None] + np.arange(size), np.swapaxes(by, 2, 3) @ by_drift[:, None])
    corner, slope = np.einsum("kmi,kmj->ij", by_drift, by_drift), np.einsum("kmi,km->i", by_drift, errors)
    border = Border(mixed.reshape(-1, ERRORS), corner, slope)
    return Sensed(float(np.sum(errors**2)), gradient, band, border, errors.size)


def first_drift(curve: Curve, steps: GyroSteps) -> Drift:
    """Start values: errors of 0, and the variance of the residuals for a spline."""
    found = sensed(curve, steps, Drift(np.zeros(ERRORS), 1.0), 6 * max(len(curve.p), 5))
    return Drift(np.zeros(ERRORS), max(found.squares / max(found.count, 1), _LEAST_VARIANCE))


def border_of(found: Sensed, drift: Drift, begins: bool) -> tuple[float, Border]:
    """Cost of the samples, and the border; with ``begins``, the prior of the gyroscope's errors is added."""
    border = Border(*(each / drift.variance for each in found.border))
    cost = 0.5 * found.squares / drift.variance
    if begins:
        expected = _EXPECTED**-2
        cost += 0.5 * float(expected @ drift.errors**2)
        known = border.corner + np.diag(expected), border.slope + expected * drift.errors
        border = Border(border.mixed, *known)
    return cost, border


class Eliminated(NamedTuple):
    """The result of eliminating the control poses from the normal equations of a gyroscope's errors."""

    follows: FloatArray
    """(6 controls, 13) minus the derivative of the fitted control poses by the gyroscope's errors."""
    covariance: FloatArray
    """(13, 13) covariance of the gyroscope's errors."""
    log_determinant: float
    """Log-determinant of all normal equations minus that of the control poses alone."""


def eliminated(lower: FloatArray, border: Border) -> Eliminated:
    """Eliminate the control poses, whose normal matrix has the factor ``lower``. Raises NotDefiniteError."""
    follows = band_solve(lower, border.mixed)
    left = border.corner - border.mixed.T @ follows
    try:
        root = np.linalg.cholesky(0.5 * (left + left.T))
    except np.linalg.LinAlgError as error:
        raise NotDefiniteError(str(error)) from None
    inverse = np.linalg.inv(root)
    return Eliminated(follows, inverse.T @ inverse, 2.0 * float(np.sum(np.log(np.diagonal(root)))))


def bordered_step(lower: FloatArray, gradient: FloatArray, border: Border) -> tuple[FloatArray, FloatArray]:
    """Newton's step of control poses (6 controls,) and a gyroscope's errors (13,). Raises NotDefiniteError."""
    alone, rest = band_solve(lower, gradient), eliminated(lower, border)
    step = -rest.covariance @ (border.slope - border.mixed.T @ alone)
    return -alone - rest.follows @ step, step


def bordered_inverse(lower: FloatArray, border: Border | None) -> FloatArray:
    """Covariance of control poses, in its band, including the uncertainty of a gyroscope's errors."""
    inverse = band_inverse(lower)
    if border is None:
        return inverse
    rest = eliminated(lower, border)
    spread = rest.follows @ rest.covariance
    for i in range(inverse.shape[1]):
        inverse[: len(lower) - i, i] += np.sum(spread[: len(lower) - i] * rest.follows[i:], axis=1)
    return inverse


def learned(
    found: Sensed, drift: Drift, lower: FloatArray, inverse: FloatArray, border: Border
) -> tuple[float, float, Drift]:
    """Re-estimate the noise variance by evidence.

    Returns the number of parameters that the samples determine, the number of residuals beyond these, and the
    errors with the new variance.

    Args:
        lower: factor of the normal matrix of control poses alone.
        inverse: see ``bordered_inverse``.
    """
    rest = eliminated(lower, border)
    tied = band_inner(inverse, found.band) + np.sum(rest.covariance * found.border.corner)
    tied -= 2.0 * np.sum((rest.follows @ rest.covariance) * found.border.mixed)
    used = float(tied) / drift.variance
    left = found.count - used
    if left <= _LEAST_RESIDUALS:
        return used, 1e-3, drift
    return used, left, drift._replace(variance=max(found.squares / left, _LEAST_VARIANCE))


def contradicts(steps: GyroSteps, drift: Drift) -> bool:
    """Whether a gyroscope contradicts the matches, as with another clock or other axes.

    Its residuals are a large part of its rates and exceed its noise, or clock, axes or scales are implausible.
    """
    if len(steps.start) < 3 or drift.variance <= _LEAST_VARIANCE:
        return False
    rates = steps.turn / (steps.end - steps.start)[:, None]
    errors = drift.variance * float(np.mean(1.0 / steps.worth))
    varied = float(np.mean(np.var(rates, axis=0)))
    noise = float(np.mean(np.diff(rates, n=2, axis=0) ** 2)) / 6.0  # second differences remove slow rotations
    far = abs(drift.shift) >= FARTHEST or float(np.max(np.abs(drift.misalignment))) > _MOST_MISALIGNMENT
    return far or errors > max(_UNLIKE**2 * varied, _NOISY**2 * noise)
