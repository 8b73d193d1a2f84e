"""The spline of a trajectory: its poses and their derivatives, its prior, and banded matrices.

The trajectory is a cubic B-spline of control poses: cumulative on SO(3) for rotations, in the world for positions.

    R(u) = exp(b3 O[i+2]) exp(b2 O[i+1]) exp(b1 O[i]) C[i],   O[k] = log(C[k+1] C[k]^T)
    p(u) = p[i] + b1 (p[i+1] - p[i]) + b2 (p[i+2] - p[i+1]) + b3 (p[i+3] - p[i+2])

with C body_from_world and the b of ``core.spline_motion``. Unlike on SE(3), rotations do not affect positions, so
a body without forces moves straight in the world while it rotates. The derivatives follow C. Sommer, V. Usenko, D.
Schubert, N. Demmel, D. Cremers, Efficient derivative computation for cumulative B-splines on Lie groups, CVPR
2020.

The prior models the shake of hands, heads and vehicles: accelerations about and along each axis are stationary
noise with a correlation time, ``memory`` (R. Singer, Estimating optimal tracking filter performance for manned
maneuvering targets, IEEE Trans. AES 1970). With d the second differences of the control poses, (1 - rho L)^m d is
white, where L shifts back by one knot and rho = exp(-interval / memory). White accelerations (memory 0) would
allow tremor at any frequency; white jerk would let the rig drift away. For such priors see T. Barfoot, C. Tong, S.
Sarkka, Batch continuous-time trajectory estimation as exactly sparse Gaussian process regression, RSS 2014.

Banded symmetric matrices are stored by columns: entry (j, i) of a band (n, width) is element (j + i, j) of the
matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import Vector, coefficients, dot, plus, times
from rsbench.core import so3
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray


class NotDefiniteError(ValueError):
    """Raised for a matrix without a Cholesky factor."""


def band_factor(band: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a band matrix, as a band.

    Raises:
        NotDefiniteError: there is none.
    """
    try:
        lower = scipy.linalg.cholesky_banded(band.T, lower=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise NotDefiniteError(str(error)) from None
    return np.ascontiguousarray(lower.T)


def band_solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Solution (n, ...) for a right-hand side (n, ...), with the factor ``lower`` of the matrix."""
    return np.asarray(scipy.linalg.cho_solve_banded((lower.T, True), right, check_finite=False))


def band_log_determinant(lower: FloatArray) -> float:
    """Log-determinant of the matrix with the factor ``lower``."""
    return 2.0 * float(np.sum(np.log(lower[:, 0])))


def band_inner(a: FloatArray, b: FloatArray) -> float:
    """Trace of the product of two bands."""
    return float(np.sum(a[:, 0] * b[:, 0]) + 2.0 * np.sum(a[:, 1:] * b[:, 1:]))


def band_form(band: FloatArray, x: FloatArray) -> float:
    """x^T B x of a band matrix B and a vector x (n,)."""
    n = len(x)
    parts = [x[i:] @ (band[: n - i, i] * x[: n - i]) for i in range(min(n, band.shape[1]))]
    return float(2.0 * np.sum(parts) - parts[0])


@compiled
def band_inverse(lower: FloatArray) -> FloatArray:
    """The elements of the inverse that lie in the band of the factor.

    K. Takahashi, J. Fagan, M. Chen, Formation of a sparse bus impedance matrix, PICA 1973: columns are computed
    from the last to the first, each from the later ones.
    """
    n, width = lower.shape
    out, square, column = np.zeros((n, width)), np.zeros((width, width)), np.zeros(width)
    for j in range(n - 1, -1, -1):
        count = min(width, n - j)
        pivot = lower[j, 0]
        # square: the inverse's part of the rows and columns j + 1 .. j + count - 1
        for a in range(1, count):
            for b in range(a, count):
                square[a, b] = square[b, a] = out[j + a, b - a]
        diagonal = 1.0 / (pivot * pivot)
        for a in range(1, count):
            total = 0.0
            for b in range(1, count):
                total += square[a, b] * lower[j, b]
            column[a] = -total / pivot
        for a in range(1, count):
            out[j, a] = column[a]
            diagonal -= lower[j, a] * column[a] / pivot
        out[j, 0] = diagonal
    return out


_ORDER = 4
"""Number of control poses that a pose depends on."""
_SAME = 1e-9


class Curve(NamedTuple):
    """The spline in the form that compiled functions take; the first interval begins at time ``first``."""

    first: float
    interval: float
    """Frame periods between two control poses."""
    R: FloatArray
    """(n, 3, 3) body_from_world of the control poses."""
    p: FloatArray
    """(n, 3) positions of the body in the world, metres."""
    steps: FloatArray
    """(n - 1, 3) rotation vectors O between control poses, radians."""
    inverse_left: FloatArray
    """(n - 1, 3, 3) inverse left Jacobians of the steps; their transposes are the right ones."""

    @property
    def last(self) -> float:
        """End of the last interval, frame periods."""
        return self.first + (len(self.p) - 3) * self.interval


def make_curve(first: float, interval: float, R: FloatArray, p: FloatArray) -> Curve:
    """The spline of control poses with rotations R (n, 3, 3) and positions p (n, 3)."""
    # Repeated products drift off SO(3), so take one Newton step to the nearest rotation.
    R = np.ascontiguousarray(1.5 * R - 0.5 * R @ np.swapaxes(R, 1, 2) @ R)
    steps, inverse_left = np.zeros((len(R) - 1, 3)), np.zeros((len(R) - 1, 3, 3))
    if not _fill_steps(R, steps, inverse_left):
        steps[:] = so3.log(R[1:] @ np.swapaxes(R[:-1], 1, 2))
        inverse_left[:] = np.linalg.inv(so3.left_jacobian(steps))
    return Curve(float(first), float(interval), R, np.ascontiguousarray(p, dtype=np.float64), steps, inverse_left)


def moved(curve: Curve, step: FloatArray) -> Curve:
    """The spline after a step (n, 6): control poses are rotated by exp of the first three values and shifted."""
    step = step.reshape(-1, 6)
    R = _turned(curve.R, np.ascontiguousarray(step[:, :3]))
    return make_curve(curve.first, curve.interval, R, curve.p + step[:, 3:])


def from_pose_at(curve: Curve, tau: float) -> Curve:
    """The same trajectory relative to the body at time ``tau``."""
    if curve.first <= tau <= curve.last:
        views = blank_views(1)
        fill_view(curve, tau, views, 0)
        R, p = views.R[0], views.p[0]
    else:
        (R, t), _, _ = evaluate(curve, tau)
        p = -R.T @ t
    return curve._replace(R=curve.R @ R.T, p=(curve.p - p) @ R.T)  # the steps between control poses stay


def part(curve: Curve, first: float, last: float, zero: float) -> Curve:
    """The intervals that contain times ``first`` to ``last``, with times counted from ``zero``."""
    low = int(np.clip(np.floor((first - curve.first) / curve.interval + 1e-9), 0, len(curve.p) - _ORDER))
    high = int(np.clip(np.ceil((last - curve.first) / curve.interval - 1e-9), low + 1, len(curve.p) - _ORDER + 1))
    chosen = slice(low, high + _ORDER - 1)
    return make_curve(curve.first + low * curve.interval - zero, curve.interval, curve.R[chosen], curve.p[chosen])


def span_of(length: float, shutter: RollingShutter) -> tuple[float, float]:
    """Times of the first line of a frame and the last one of another, ``length`` later; the first is at most 0."""
    ends = [shutter.start(frame, side) for frame in (0.0, length) for side in SIDES]
    return min(0.0, float(np.min(ends))), float(np.max(ends)) + shutter.readout_ratio


def control_count(first: float, last: float, interval: float) -> int:
    """Number of control poses of a spline from one time to another."""
    return max(int(np.ceil((last - first) / interval - 1e-9)), 1) + _ORDER - 1


def evaluate(curve: Curve, tau: ArrayLike) -> tuple[Pose, FloatArray, FloatArray]:
    """body_from_world at times (...), w' (..., 3) with dR/dtau = [w']x R, and the velocity (..., 3) of p.

    The motion is extrapolated with constant rates before the first interval and after the last.
    """
    tau = np.asarray(tau, dtype=np.float64)
    inside = np.clip(tau, curve.first, curve.last)
    place = (inside - curve.first) / curve.interval
    i = np.clip(np.floor(place), 0, len(curve.p) - _ORDER).astype(np.int64)
    u = np.clip(place - i, 0.0, 1.0)
    b = (5 + u * (3 + u * (u - 3))) / 6, (1 + u * (3 + u * (3 - 2 * u))) / 6, u**3 / 6
    rates = (0.5 + u * (0.5 * u - 1), 0.5 + u * (1 - u), 0.5 * u * u)
    R, p, spin, speed = curve.R[i], curve.p[i], np.zeros((*tau.shape, 3)), np.zeros((*tau.shape, 3))
    for j in range(3):
        step, rate = curve.steps[i + j], (rates[j] / curve.interval)[..., None]
        factor, along = so3.exp(b[j][..., None] * step), curve.p[i + j + 1] - curve.p[i + j]
        R, spin = factor @ R, (factor @ spin[..., None])[..., 0] + rate * step
        p, speed = p + b[j][..., None] * along, speed + rate * along
    beyond = (tau - inside)[..., None]
    R, p = so3.exp(beyond * spin) @ R, p + beyond * speed
    return Pose(R, -(R @ p[..., None])[..., 0]), spin, speed


@final
@dataclass(frozen=True, eq=False, init=False)
class ContinuousMotion(Motion):
    """The trajectory of a rig over many frames, relative to the body at time 0."""

    name: ClassVar[str] = "continuous"
    first: float
    """Start of the first interval, frame periods."""
    interval: float
    """Frame periods between two control poses."""
    controls: FloatArray
    """(n, 6) rotation vectors of body_from_world, radians, and positions of the body in the world, metres."""

    def __init__(self, w: ArrayLike, d: ArrayLike, first: float, interval: float, controls: ArrayLike) -> None:
        """Create the motion from control poses; w and d must equal their ``endpoint``.

        Raises:
            ValueError: the controls are not rows of 6 finite numbers, or have another w or d.
        """
        super().__init__(w, d)
        rows = np.array(controls, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != 6 or len(rows) < _ORDER or not np.all(np.isfinite(rows)):
            raise ValueError(f"controls must be at least {_ORDER} rows of 6 finite numbers")
        if not (np.isfinite(first) and np.isfinite(interval) and interval > 0.0):
            raise ValueError(f"interval must be positive and first finite, got {interval} and {first}")
        rows.setflags(write=False)
        for name, value in (("first", float(first)), ("interval", float(interval)), ("controls", rows)):
            object.__setattr__(self, name, value)
        R, t = self.body_from_world(1.0)
        if np.max(np.abs(np.concatenate([so3.log(R) - self.w, t - self.d]))) > _SAME:
            raise ValueError("w and d of a continuous motion must be those of its controls")

    @classmethod
    def of(cls, curve: Curve) -> ContinuousMotion:
        """The motion of a spline relative to its body at time 0."""
        curve = from_pose_at(curve, 0.0)
        own = {
            "first": curve.first,
            "interval": curve.interval,
            "controls": np.concatenate([so3.log(curve.R), curve.p], axis=1),
        }
        return cls(*cls.endpoint(own), **own)

    @cached_property
    def curve(self) -> Curve:
        """The spline."""
        return make_curve(self.first, self.interval, so3.exp(self.controls[:, :3]), self.controls[:, 3:])

    def body_from_world(self, tau: ArrayLike) -> Pose:
        return evaluate(self.curve, tau)[0]

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        (R, t), spin, speed = evaluate(self.curve, tau)
        return spin, so3.cross(spin, t) - (R @ speed[..., None])[..., 0]

    def seen(self, axes: FloatArray, scale: float = 1.0) -> ContinuousMotion:
        """The motion in other axes (3, 3), which may be mirrored, with lengths multiplied by ``scale``."""
        turns, places = self.controls[:, :3], self.controls[:, 3:]
        rows = np.concatenate([np.linalg.det(axes) * turns @ axes.T, scale * places @ axes.T], axis=1)
        own = {"first": self.first, "interval": self.interval, "controls": rows}
        return ContinuousMotion(*self.endpoint(own), **own)

    @property
    def parameters(self) -> dict[str, Any]:
        return {"first": self.first, "interval": self.interval, "controls": self.controls.tolist()}

    @property
    def lasts(self) -> float:
        return self.curve.last

    @classmethod
    def endpoint(cls, parameters: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
        rows = np.asarray(parameters["controls"], dtype=np.float64)
        curve = make_curve(parameters["first"], parameters["interval"], so3.exp(rows[:, :3]), rows[:, 3:])
        (R, t), _, _ = evaluate(curve, 1.0)
        return so3.log(R), t


class Views(NamedTuple):
    """Poses at n times, with derivatives."""

    index: NDArray[np.int64]
    """(n,) the first of the four control poses that a pose depends on."""
    R: FloatArray
    """(n, 3, 3) body_from_world."""
    p: FloatArray
    """(n, 3) position in the world, metres."""
    spin: FloatArray
    """(n, 3) dR/dtau = [spin]x R."""
    speed: FloatArray
    """(n, 3) dp/dtau."""
    turn: FloatArray
    """(n, 4, 3, 3) derivative of the body's rotation by that of each control pose, about the axes of each."""
    share: FloatArray
    """(n, 4) derivative of p by the position of each control pose."""


@compiled(error_model="numpy")
def blank_views(count: int) -> Views:
    """Work arrays for a number of poses."""
    return Views(
        np.zeros(count, dtype=np.int64),
        np.zeros((count, 3, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
        np.zeros((count, 4, 3, 3)),
        np.zeros((count, 4)),
    )


@compiled(error_model="numpy")
def fill_views(curve: Curve, taus: FloatArray, views: Views) -> None:
    """Compute the poses at times (n,)."""
    for k in range(len(taus)):
        fill_view(curve, taus[k], views, k)


@compiled(error_model="numpy")
def fill_view(curve: Curve, tau: float, views: Views, k: int) -> None:
    """Compute the pose at one time and store it at index ``k``."""
    count = len(curve.p)
    place = (tau - curve.first) / curve.interval
    i = min(max(math.floor(place), 0), count - 4)
    u = place - i
    b = ((5 + u * (3 + u * (u - 3))) / 6, (1 + u * (3 + u * (3 - 2 * u))) / 6, u * u * u / 6)
    rates = (0.5 + u * (0.5 * u - 1), 0.5 + u * (1 - u), 0.5 * u * u)
    views.index[k] = i
    views.share[k, 0], views.share[k, 1] = 1 - b[0], b[0] - b[1]
    views.share[k, 2], views.share[k, 3] = b[1] - b[2], b[2]
    p, speed = _row(curve.p, i), (0.0, 0.0, 0.0)
    for j in range(3):
        along = plus(_row(curve.p, i + j + 1), -1.0, _row(curve.p, i + j))
        p, speed = plus(p, b[j], along), plus(speed, rates[j] / curve.interval, along)
    _set(views.p, k, p)
    _set(views.speed, k, speed)
    _fill_turn(curve, i, b, rates, views, k)


Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""Rows of a 3 x 3 matrix one after the other: the compiler keeps them in registers."""


@compiled(error_model="numpy")
def _fill_turn(curve: Curve, i: int, b: Vector, rates: Vector, views: Views, k: int) -> None:
    """Compute rotation, angular rate and derivatives, from the last factor of R to the first."""
    before, spin = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
    later = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for j in range(2, -1, -1):
        step, inverse = _row(curve.steps, i + j), _matrix(curve.inverse_left, i + j)
        x, y, z = step
        along = (
            before[0] * x + before[1] * y + before[2] * z,
            before[3] * x + before[4] * y + before[5] * z,
            before[6] * x + before[7] * y + before[8] * z,
        )
        spin = plus(spin, rates[j] / curve.interval, along)
        phi = times(b[j], step)
        square = dot(phi, phi)
        one, half, sixth, _, _ = coefficients(square)
        jacobian = _multiply(before, _rotation(phi, one, half, sixth))
        _set_matrix(views.turn, k, j + 1, later, b[j], _multiply(jacobian, inverse))
        later = _scaled(-b[j], _multiply(jacobian, _transposed(inverse)))
        before = _multiply(before, _rotation(phi, 1.0 - half * square, one, half))
    _set_matrix(views.turn, k, 0, later, 1.0, before)
    _fill_matrix(views.R, k, _multiply(before, _matrix(curve.R, i)))
    _set(views.spin, k, spin)


@compiled(error_model="numpy")
def _rotation(phi: Vector, identity: float, skew: float, outer: float) -> Matrix:
    """identity I + skew [phi]x + outer phi phi^T."""
    x, y, z = phi
    xy, xz, yz = outer * x * y, outer * x * z, outer * y * z
    return (
        *(outer * x * x + identity, xy - skew * z, xz + skew * y),
        *(xy + skew * z, outer * y * y + identity, yz - skew * x),
        *(xz - skew * y, yz + skew * x, outer * z * z + identity),
    )


_NEARLY_HALF_A_TURN = math.pi - 0.1
"""Angle, radians, from which the axis is no longer well determined by R - R^T."""


@compiled(error_model="numpy")
def _fill_steps(R: FloatArray, steps: FloatArray, inverse_left: FloatArray) -> bool:
    """Fill the steps between rotations R (n, 3, 3), and their inverse left Jacobians; False: one is too large."""
    for k in range(len(steps)):
        M = _multiply(_matrix(R, k + 1), _transposed(_matrix(R, k)))
        axis = (0.5 * (M[7] - M[5]), 0.5 * (M[2] - M[6]), 0.5 * (M[3] - M[1]))
        sine = math.sqrt(dot(axis, axis))
        angle = math.atan2(sine, 0.5 * (M[0] + M[4] + M[8] - 1.0))
        if not angle < _NEARLY_HALF_A_TURN:
            return False
        phi = times(angle / sine if sine > 1e-8 else 1.0, axis)
        s = dot(phi, phi)
        if s < 1e-2:  # the closed form suffers from cancellation
            outer = 1 / 12 + s / 720 * (1 + s / 42 * (1 + s / 40))
        else:
            one, half, _, _, _ = coefficients(s)
            outer = (1.0 - 0.5 * one / half) / s
        _set(steps, k, phi)
        _fill_matrix(inverse_left, k, _rotation(phi, 1.0 - outer * s, -0.5, outer))
    return True


@compiled(error_model="numpy")
def _turned(R: FloatArray, w: FloatArray) -> FloatArray:
    """exp(w) R for rotation vectors w (n, 3) and rotations R (n, 3, 3)."""
    out = np.zeros_like(R)
    for k in range(len(R)):
        phi = _row(w, k)
        s = dot(phi, phi)
        one, half, _, _, _ = coefficients(s)
        _fill_matrix(out, k, _multiply(_rotation(phi, 1.0 - half * s, one, half), _matrix(R, k)))
    return out


@compiled(error_model="numpy")
def _multiply(a: Matrix, b: Matrix) -> Matrix:
    return (
        a[0] * b[0] + a[1] * b[3] + a[2] * b[6],
        a[0] * b[1] + a[1] * b[4] + a[2] * b[7],
        a[0] * b[2] + a[1] * b[5] + a[2] * b[8],
        a[3] * b[0] + a[4] * b[3] + a[5] * b[6],
        a[3] * b[1] + a[4] * b[4] + a[5] * b[7],
        a[3] * b[2] + a[4] * b[5] + a[5] * b[8],
        a[6] * b[0] + a[7] * b[3] + a[8] * b[6],
        a[6] * b[1] + a[7] * b[4] + a[8] * b[7],
        a[6] * b[2] + a[7] * b[5] + a[8] * b[8],
    )


@compiled(error_model="numpy")
def _transposed(a: Matrix) -> Matrix:
    return a[0], a[3], a[6], a[1], a[4], a[7], a[2], a[5], a[8]


@compiled(error_model="numpy")
def _scaled(factor: float, a: Matrix) -> Matrix:
    return (
        *(factor * a[0], factor * a[1], factor * a[2]),
        *(factor * a[3], factor * a[4], factor * a[5]),
        *(factor * a[6], factor * a[7], factor * a[8]),
    )


@compiled(error_model="numpy")
def _matrix(matrices: FloatArray, i: int) -> Matrix:
    """Number ``i`` of matrices (n, 3, 3)."""
    return (
        *(matrices[i, 0, 0], matrices[i, 0, 1], matrices[i, 0, 2]),
        *(matrices[i, 1, 0], matrices[i, 1, 1], matrices[i, 1, 2]),
        *(matrices[i, 2, 0], matrices[i, 2, 1], matrices[i, 2, 2]),
    )


@compiled(error_model="numpy")
def _fill_matrix(out: FloatArray, k: int, a: Matrix) -> None:
    """Fill number ``k`` of matrices (n, 3, 3)."""
    for m in range(3):
        for n in range(3):
            out[k, m, n] = a[3 * m + n]


@compiled(error_model="numpy")
def _set_matrix(out: FloatArray, k: int, j: int, a: Matrix, factor: float, b: Matrix) -> None:
    """Set a matrix of (n, 4, 3, 3) to a + factor b."""
    for m in range(3):
        for n in range(3):
            out[k, j, m, n] = a[3 * m + n] + factor * b[3 * m + n]


@compiled(error_model="numpy")
def _row(rows: FloatArray, i: int) -> Vector:
    return (rows[i, 0], rows[i, 1], rows[i, 2])


@compiled(error_model="numpy")
def _set(rows: FloatArray, i: int, value: Vector) -> None:
    rows[i, 0], rows[i, 1], rows[i, 2] = value


_WIDEST = (1.0, 10.0)
"""Prior standard deviation of rates, radians and metres per frame period."""


class Prior(NamedTuple):
    """Prior on accelerations."""

    memory: float
    """Correlation time, frame periods."""
    smooth: int
    """m, 1 or 2: the power of fast shakes falls with their frequency to the power of -4 - 2 m."""
    rotation: float
    """Variance of angular accelerations about each axis, rad^2 per frame period^4."""
    position: float
    """Variance of accelerations along each axis, m^2 per frame period^4."""


NO_PRIOR = Prior(1.0, 1, np.inf, np.inf)


class Roughness(NamedTuple):
    """Sums of squared whitened accelerations; divided by the prior's variances, they are twice its cost."""

    squares: FloatArray
    """(2,) sums for rotations and for positions."""
    gradients: FloatArray
    """(2, 6 controls) gradients of half the squares."""
    bands: FloatArray
    """(2, 6 controls, width) Gauss-Newton matrices of half the squares, see ``trajectory_tracks.add_tracks``."""
    count: int
    """Number of scalar accelerations of each kind."""
    log_density: float
    """Logarithm of the prior density of one axis at its mode, for a variance of 1, up to constants."""


def whitening(interval: float, memory: float, smooth: int) -> list[FloatArray]:
    """Weights of successive second differences that whiten accelerations of unit variance.

    The first ``smooth`` differences have fewer before them and own rows; all later ones share one.
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
    """The roughness of a spline, in bands of a width (at least 6 (smooth + 3)).

    Args:
        begins: whether the spline begins here; otherwise the first ``smooth`` differences are left out.
        until: only differences that begin before the control pose of this number are used.
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
        _add_differences(weights, count, *steps, curve.inverse_left, squares, gradients, bands)
    return Roughness(squares, gradients, bands, total, log_density)


@compiled
def _add_differences(
    weights: FloatArray,
    count: int,
    turns: FloatArray,
    shifts: FloatArray,
    inverse_left: FloatArray,
    squares: FloatArray,
    gradients: FloatArray,
    bands: FloatArray,
) -> None:
    """Add ``count`` weighted sums of successive steps, (n, 3) ``turns`` and ``shifts``, to a ``Roughness``."""
    by, errors = np.zeros((2, len(weights) + 1, 3, 3)), np.zeros((2, 3))
    for k in range(count):
        by[:], errors[:] = 0.0, 0.0
        for j in range(len(weights)):
            c = weights[j]
            for a in range(3):
                errors[0, a] += c * turns[k + j, a]
                errors[1, a] += c * shifts[k + j, a]
                by[1, j + 1, a, a] += c
                by[1, j, a, a] -= c
                for b in range(3):
                    by[0, j + 1, a, b] += c * inverse_left[k + j, a, b]
                    by[0, j, a, b] -= c * inverse_left[k + j, b, a]
        for kind in range(2):
            _add_block(gradients[kind], bands[kind], by[kind], errors[kind], k, 3 * kind)
            for a in range(3):
                squares[kind] += errors[kind, a] ** 2


def log_prior(curve: Curve, prior: Prior, rough: Roughness) -> float:
    """Logarithm of the density of a prior at its mode, up to constants that do not depend on the knots.

    Second differences, one rate and one pose are related to the control poses by a matrix of determinant 1.
    """
    sizes = 0.5 * rough.count * float(np.log(prior.rotation) + np.log(prior.position))
    return 6.0 * rough.log_density - sizes


def add_blocks(
    gradient: FloatArray, band: FloatArray, by: FloatArray, errors: FloatArray, first: NDArray[np.int64], part: int
) -> None:
    """Add normal equations of errors (n, m) with derivatives (n, k, m, 3) by k successive control poses.

    Args:
        first: (n,) index of the first of these poses.
        part: 0 for rotations, 3 for positions.
    """
    _add_blocks(gradient, band, np.ascontiguousarray(by), np.ascontiguousarray(errors), first, part)


@compiled
def _add_blocks(
    gradient: FloatArray, band: FloatArray, by: FloatArray, errors: FloatArray, first: NDArray[np.int64], part: int
) -> None:
    for k in range(len(by)):
        _add_block(gradient, band, by[k], errors[k], first[k], part)


@compiled
def _add_block(
    gradient: FloatArray, band: FloatArray, by: FloatArray, errors: FloatArray, first: int, part: int
) -> None:
    """``add_blocks`` for one error (m,) with derivatives (k, m, 3)."""
    controls, size, _ = by.shape
    for a in range(3 * controls):
        row, i = 6 * (first + a // 3) + part + a % 3, a % 3
        for m in range(size):
            gradient[row] += by[a // 3, m, i] * errors[m]
        for b in range(a + 1):
            column, j, total = 6 * (first + b // 3) + part + b % 3, b % 3, 0.0
            for m in range(size):
                total += by[a // 3, m, i] * by[b // 3, m, j]
            band[column, row - column] += total


def anchors(curve: Curve, width: int, precision: float) -> FloatArray:
    """Band (6 controls, width) that fixes what ``roughness`` does not: the pose at time 0, and one rate.

    It is the same for all knots. ``precision`` is that of the pose at time 0.
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


_SAMPLES, _STEPS = 4, 4


def approximated(
    body_from_world: Callable[[FloatArray], Pose], span: tuple[float, float], interval: float
) -> Curve:
    """The least-squares spline approximation of a motion during a span of time."""
    count = control_count(*span, interval)
    R, t = body_from_world(np.asarray(span[0] + interval * (np.arange(count) - 1.0), dtype=np.float64))
    curve = make_curve(span[0], interval, R, _positions(R, t))
    shares = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    taus = [span[0] + interval * (np.arange(count - 3) + share) for share in shares]
    wanted = [body_from_world(each) for each in taus]
    first = np.arange(count - 3)
    for _ in range(_STEPS):
        gradient, band = np.zeros(6 * count), np.zeros((6 * count, 24))
        band[:, 0] = 1e-9
        views = blank_views(count - 3)
        for each, (R, t) in zip(taus, wanted, strict=True):
            fill_views(curve, each, views)
            turned = so3.log(R @ np.swapaxes(views.R, 1, 2))
            add_blocks(gradient, band, views.turn, turned, first, 0)
            by = views.share[..., None, None] * np.eye(3)
            add_blocks(gradient, band, by, _positions(R, t) - views.p, first, 3)
        curve = moved(curve, band_solve(band_factor(band), gradient))
    return curve


def _positions(R: FloatArray, t: FloatArray) -> FloatArray:
    """(n, 3) positions of the body in the world."""
    return -(np.swapaxes(R, 1, 2) @ t[..., None])[..., 0]


def pose_covariance(curve: Curve, inverse: FloatArray, taus: FloatArray) -> FloatArray:
    """Covariance (n, 6, 6) of poses at times (n,): rotations of the body, radians, and its positions, metres.

    Args:
        inverse: inverse of the normal matrix, within its band.
    """
    views, by = _derivatives(curve, taus)
    return np.asarray(by @ _block(inverse, views, views) @ np.swapaxes(by, 1, 2))


def covariance_between(curve: Curve, inverse: FloatArray, start: float, taus: FloatArray) -> FloatArray:
    """Covariance (n, 6, 6) of poses at times (n,) relative to the pose at time ``start``.

    Raises:
        ValueError: a time is so far from ``start`` that the band does not contain their covariance.
    """
    one, by_one = _derivatives(curve, np.full(len(taus), start))
    other, by = _derivatives(curve, taus)
    if 6 * (np.max(np.abs(other.index - one.index), initial=0) + 4) > inverse.shape[1]:
        raise ValueError(f"times that far from {start:g} have no covariance with it in the band")
    # R' = R R_s^T rotates by dR - R' dR_s; q = R_s (p - p_s) moves by R_s (dp - dp_s) + dR_s x q.
    R, R_s = other.R, one.R
    relative = R @ np.swapaxes(R_s, 1, 2)
    q = (R_s @ (other.p - one.p)[..., None])[..., 0]
    A, B = np.zeros((len(taus), 6, 6)), np.zeros((len(taus), 6, 6))
    A[:, :3, :3], A[:, 3:, 3:] = np.eye(3), R_s
    B[:, :3, :3], B[:, 3:, :3], B[:, 3:, 3:] = -relative, -so3.hat(q), -R_s
    by, by_one = A @ by, B @ by_one
    cross = by @ _block(inverse, other, one) @ np.swapaxes(by_one, 1, 2)
    own = by @ _block(inverse, other, other) @ np.swapaxes(by, 1, 2)
    first = by_one @ _block(inverse, one, one) @ np.swapaxes(by_one, 1, 2)
    return np.asarray(own + first + cross + np.swapaxes(cross, 1, 2))


def _derivatives(curve: Curve, taus: FloatArray) -> tuple[Views, FloatArray]:
    """Poses at times (n,) and their derivatives (n, 6, 24) by the control poses that they depend on."""
    taus = np.clip(np.asarray(taus, dtype=np.float64), curve.first, curve.last)
    views = blank_views(len(taus))
    fill_views(curve, taus, views)
    by = np.zeros((len(taus), 6, 4, 6))
    by[:, :3, :, :3] = np.swapaxes(views.turn, 1, 2)
    by[:, 3:, :, 3:] = views.share[:, None, :, None] * np.eye(3)[:, None, :]
    return views, by.reshape(len(taus), 6, 24)


def _block(inverse: FloatArray, a: Views, b: Views) -> FloatArray:
    """(n, 24, 24) covariances between the control poses of two sets of poses."""
    rows, columns = (6 * views.index[:, None] + np.arange(24) for views in (a, b))
    low = np.minimum(rows[:, :, None], columns[:, None])
    high = np.maximum(rows[:, :, None], columns[:, None])
    return inverse[low, high - low]


def motion_from(curve: Curve, start: float) -> Pose:
    """The motion (R, t) during one frame period, relative to the body at its start."""
    (R, t), _, _ = evaluate(curve, np.array([start, start + 1.0]))
    turn = R[1] @ R[0].T
    return Pose(turn, t[1] - turn @ t[0])


def motion_covariance(curve: Curve, inverse: FloatArray, start: float) -> FloatArray | None:
    """Covariance (6, 6) of w and d of the motion during one frame period, relative to the body at its start."""
    R, t = motion_from(curve, start)
    # A rotation of the body about its own axes changes w by J^-1 of it; t = -R p depends on it and on p.
    by = np.zeros((6, 6))
    by[:3, :3] = np.linalg.inv(so3.left_jacobian(so3.log(R)))
    by[3:, :3], by[3:, 3:] = -so3.hat(t), -R
    try:
        between = covariance_between(curve, inverse, start, np.array([start + 1.0]))[0]
    except ValueError:  # the band is too narrow
        return None
    return np.asarray(by @ between @ by.T)
