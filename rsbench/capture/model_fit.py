"""Any motion model fitted to matches with outliers: its best parameters, and how likely the matches are under it.

Every model is fitted to the same matches. Errors follow one Student-t distribution, so that an outlier says almost
nothing and no match has to be thrown away by a model that might be the wrong one (K. Lange, R. Little, J. Taylor,
Robust statistical modeling using the t distribution, JASA 1989).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, unlinked_pairs
from rsbench.core.epipolar import rs_sampson_error, rs_stereo_transfer
from rsbench.core.motion import AcceleratedMotion, LinearMotion, Motion, TwistMotion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import Pose, adjoint_apply, compose, exp, log
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import PRESETS, SplineMotion, blending, least_poses

ACCELERATION_SIGMA = 0.2
"""Standard deviation of k that is expected of motions that accelerate."""
_MOTION_SIGMA = np.array([1.0, 1.0, 1.0, 50.0, 50.0, 50.0])
"""Of w (rad) and d (m): says nothing, but keeps what matches leave open finite."""
_TAILS = 4.0
"""Degrees of freedom of the Student-t distribution."""
_VARIANCE = (0.5, 0.5, 2.0)
"""Of x, y and disparity of a stereo match, when a pixel coordinate has 1."""
_FAR_PX = 1e3
"""Error of a match that a motion puts behind the cameras."""
_STEP = 1e-6
_LEAST_SCALE_PX = 1e-3
"""Exact data have no noise, and any error would be infinitely unlikely."""
_SERIES = 12
"""Terms of a power series in a turn of less than two radians or so."""
_ROUNDS, _STEPS, _HALVINGS = 8, 10, 6
_STILL = 1e-4
"""Squared length of a step, in standard deviations, that is none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A motion model with free parameters phi = (w, d, own)."""

    name: str
    """Of the motion model."""
    sigma: FloatArray
    """Standard deviations (k,) that are expected of its own parameters; their mean is 0."""
    make: Callable[[FloatArray], Motion]
    """The motion of phi (6 + k,); ValueError where there is none."""
    label: str = ""
    """Which of several candidates of one model."""

    @property
    def precision(self) -> FloatArray:
        """Of the prior (6 + k,)."""
        return np.asarray(np.concatenate([_MOTION_SIGMA, self.sigma]) ** -2.0)


def _shaken(preset: str) -> Candidate:
    shake = PRESETS[preset]

    def make(phi: FloatArray) -> Motion:
        return SplineMotion(phi[:3], phi[3:6], interval=shake.interval, shake=phi[6:].reshape(-1, 6))

    sigma = np.tile([*np.deg2rad(shake.rotation_deg), *shake.translation], least_poses(shake.interval))
    return Candidate(name="spline", sigma=sigma, make=make, label=preset)


CANDIDATES = (
    Candidate(name="linear", sigma=np.zeros(0), make=lambda phi: LinearMotion(phi[:3], phi[3:])),
    Candidate(name="twist", sigma=np.zeros(0), make=lambda phi: TwistMotion(phi[:3], phi[3:])),
    Candidate(
        name="accelerated",
        sigma=np.array([ACCELERATION_SIGMA]),
        make=lambda phi: AcceleratedMotion(phi[:3], phi[3:6], float(phi[6])),
    ),
    *(_shaken(preset) for preset in PRESETS),
)


class _Tabulated(Motion):
    """A motion at given times only, each computed once; nudged, its pose there is exp(twist) P(tau)."""

    name = "tabulated"

    def __init__(self, motion: Motion, times: FloatArray) -> None:
        super().__init__(motion.w, motion.d)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "pose", motion.body_from_world(times))
        object.__setattr__(self, "rates", motion.velocity(times))

    times: FloatArray
    """(t,), sorted."""
    pose: Pose
    rates: tuple[FloatArray, FloatArray]

    def nudged(self, twists: FloatArray) -> _Tabulated:
        """With twists (t, 6); their effect on the velocity is left out."""
        other = copy.copy(self)
        object.__setattr__(other, "pose", compose(exp(twists), self.pose))
        return other

    def body_from_world(self, tau: ArrayLike) -> Pose:
        at = np.searchsorted(self.times, tau)
        return Pose(self.pose.R[at], self.pose.t[at])

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        at = np.searchsorted(self.times, tau)
        return self.rates[0][at], self.rates[1][at]


class Errors:
    """Whitened errors of all matches under any motion: 3 of each track, 1 of each pair that no track repeats.

    Tracks are whitened at one motion for all models: by their own, likelihoods would not compare.
    """

    def __init__(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, reference: Motion
    ) -> None:
        self.rig, self.shutter = rig, shutter
        ends = (correspondences.tracks[:, :4], correspondences.tracks[:, 4:])
        stereo = [np.column_stack([0.5 * (end[:, :2] + end[:, 2:]), end[:, 0] - end[:, 2]]) for end in ends]
        seen = np.all(np.isfinite(rs_stereo_transfer(rig, shutter, reference, *stereo)), axis=1)
        self._stereo = (stereo[0][seen], stereo[1][seen])
        pairs = {side: getattr(correspondences, side) for side in SIDES}
        self._pairs = {side: pairs[side][unlinked_pairs(correspondences, side)] for side in SIDES}
        self._roots = self._whitening(reference)
        count = sum(len(matches) for matches in self._pairs.values())
        self.sizes = np.repeat([3, 1], [len(self._stereo[0]), count])
        """Errors of each match."""
        parts = [(self._stereo[0][:, :2], self._stereo[1][:, :2])]
        parts += [(matches[:, :2], matches[:, 2:]) for matches in self._pairs.values()]
        self.pixels = np.concatenate([first for first, _ in parts])
        """(m, 2) of each match in frame 0."""
        rows = [np.concatenate([part[frame][:, 1] for part in parts]) for frame in (0, 1)]
        times = [np.repeat(shutter.row_time(rows[frame], frame), self.sizes) for frame in (0, 1)]
        self.times = (times[0], times[1])
        """Row times (n,) of each error in both frames."""
        self._table = np.unique(times)

    def _whitening(self, reference: Motion) -> FloatArray:
        """Inverse roots (n, 3, 3) of the covariances of the tracks' errors at a noise of 1 px."""
        S, step = np.zeros((len(self._stereo[0]), 3, 3)), 1e-3
        for k, variance in enumerate(_VARIANCE):
            for shift in np.eye(2)[:, :, None] * (step * np.eye(3)[k]):
                above, below = (
                    rs_stereo_transfer(
                        self.rig,
                        self.shutter,
                        reference,
                        self._stereo[0] + s * shift[0],
                        self._stereo[1] + s * shift[1],
                    )
                    for s in (1.0, -1.0)
                )
                slope = (above - below) / (2.0 * step)
                S += variance * slope[:, :, None] * slope[:, None, :]
        return np.asarray(np.linalg.inv(np.linalg.cholesky(S)), np.float64)

    def __call__(self, motion: Motion) -> FloatArray:
        """Errors (n,), px."""
        return self._of(_Tabulated(motion, self._table))

    def _of(self, motion: _Tabulated) -> FloatArray:
        tracks = rs_stereo_transfer(self.rig, self.shutter, motion, *self._stereo)
        whitened = (self._roots @ tracks[:, :, None]).ravel()
        pairs = [
            rs_sampson_error(self.rig, self.shutter, motion, side, matches)
            for side, matches in self._pairs.items()
            if len(matches)  # none cost as much time as a few hundred
        ]
        errors = np.concatenate([whitened, *pairs])
        return np.where(np.isfinite(errors), errors, _FAR_PX)

    def squares(self, errors: FloatArray) -> FloatArray:
        """Squared errors (m,) of the matches."""
        return np.asarray(np.add.reduceat(errors**2, np.cumsum(self.sizes) - self.sizes))

    def by_nudge(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Derivatives (n, 6) of the errors by left twists of the pose at the time of either row."""
        table, (tau0, tau1) = _Tabulated(motion, self._table), self.times
        at, whole, slope = self._of(table), np.zeros((len(tau0), 6)), np.zeros((len(tau0), 6))
        for j in range(6):  # two families of twists, constant and growing with time, tell the rows apart
            e = np.tile(_STEP * np.eye(6)[j], (len(self._table), 1))
            whole[:, j] = (self._of(table.nudged(e)) - at) / _STEP
            slope[:, j] = (self._of(table.nudged(self._table[:, None] * e)) - at) / _STEP
        second = (slope - tau0[:, None] * whole) / (tau1 - tau0)[:, None]
        return whole - second, second


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFit:
    """The most probable parameters of a candidate at one scale of the errors."""

    candidate: Candidate
    phi: FloatArray
    errors: Errors
    values: FloatArray
    """Errors (n,) at phi."""
    jacobian: FloatArray
    """Derivative (n, 6 + k) of the errors by phi."""
    scale_px: float

    @cached_property
    def motion(self) -> Motion:
        return self.candidate.make(self.phi)

    @cached_property
    def weights(self) -> FloatArray:
        """Of the matches (m,)."""
        return _weights(self.errors.squares(self.values), self.errors.sizes, self.scale_px)

    @cached_property
    def curvature(self) -> FloatArray:
        """Of the matches' negative log-likelihood (6 + k, 6 + k), without the prior.

        That of the weights alone is too large: they fall where an error grows. Both on average over directions.
        """
        sizes, w = self.errors.sizes, self.weights
        share = self.bend / float(np.sum(sizes * w))
        each = share * np.repeat(w, sizes)
        return np.asarray((self.jacobian.T * each) @ self.jacobian / self.scale_px**2)

    @cached_property
    def bend(self) -> float:
        """Sum over all errors of the second derivative of the loss, in units of the scale."""
        squares, variance = self.errors.squares(self.values), self.scale_px**2
        lost = 2.0 * squares / (_TAILS * variance + squares)
        return float(np.sum(self.weights * (self.errors.sizes - lost)))

    def covariance(self, dispersion: float) -> FloatArray:
        """Of phi; ``dispersion``: see ``dispersion``."""
        curvature = self.curvature / dispersion + np.diag(self.candidate.precision)
        return np.asarray(np.linalg.inv(curvature), np.float64)

    def log_evidence(self, dispersion: float) -> float:
        """Of the matches under this model, up to a constant that all models share: Laplace's approximation."""
        sigma = np.concatenate([_MOTION_SIGMA, self.candidate.sigma])
        H = np.outer(sigma, sigma) * self.curvature / dispersion + np.eye(len(sigma))
        loss = _loss(self.errors.squares(self.values), self.errors.sizes, self.scale_px)
        return -loss / dispersion - 0.5 * float(np.sum((self.phi / sigma) ** 2) + np.linalg.slogdet(H)[1])


def fit_model(errors: Errors, candidate: Candidate, start: FloatArray, scale_px: float | None = None) -> ModelFit:
    """Maximum of likelihood times prior.

    Args:
        start: phi (6 + k,).
        scale_px: of the errors; None has it fitted.
    """
    phi, values = start, errors(candidate.make(start))
    scale = _first_scale(errors, values) if scale_px is None else scale_px
    for _ in range(_ROUNDS):
        before, J = phi, _jacobian(errors, candidate, phi, values)
        for _ in range(_STEPS):
            squares = errors.squares(values)
            each = np.repeat(_weights(squares, errors.sizes, scale), errors.sizes)
            data = np.asarray((J.T * each) @ J)
            if scale_px is None:
                H = data / scale**2 + np.diag(candidate.precision)
                used = float(np.trace(np.linalg.solve(H, data))) / scale**2
                freedom = max(len(values) - used, 0.2 * len(values))
                scale = max(float(np.sqrt(each @ values**2 / freedom)), _LEAST_SCALE_PX)
            H = data / scale**2 + np.diag(candidate.precision)
            downhill = -(J.T @ (each * values)) / scale**2 - candidate.precision * phi
            step = np.asarray(np.linalg.solve(H, downhill), dtype=np.float64)
            moved = _descend(errors, candidate, phi, squares, step, scale)
            if moved is None:
                break
            phi, values = moved
            if step @ H @ step < _STILL:
                break
        if (phi - before) @ H @ (phi - before) < _STILL:
            break
    return ModelFit(candidate=candidate, phi=phi, errors=errors, values=values, jacobian=J, scale_px=scale)


def _descend(
    errors: Errors, candidate: Candidate, phi: FloatArray, squares: FloatArray, step: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray] | None:
    """Where a step, halved as often as needed, leads down: phi and its errors."""
    P = candidate.precision
    now = _loss(squares, errors.sizes, scale) + 0.5 * float(np.sum(P * phi**2))
    for halving in range(_HALVINGS):
        trial = phi + 0.5**halving * step
        try:
            values = errors(candidate.make(trial))
        except ValueError:  # no such motion
            continue
        if _loss(errors.squares(values), errors.sizes, scale) + 0.5 * float(np.sum(P * trial**2)) < now:
            return trial, values
    return None


def _jacobian(errors: Errors, candidate: Candidate, phi: FloatArray, values: FloatArray) -> FloatArray:
    """Derivative (n, 6 + k) of the errors by phi: differences, but for a spline, which has too many parameters."""
    motion = candidate.make(phi)
    if isinstance(motion, SplineMotion):
        return _spline_jacobian(errors, motion)
    J = np.zeros((len(values), len(phi)))
    for k in range(len(phi)):
        shift = _STEP * (np.arange(len(phi)) == k)
        J[:, k] = (errors(candidate.make(phi + shift)) - values) / _STEP
    return J


def _spline_jacobian(errors: Errors, motion: SplineMotion) -> FloatArray:
    """Derivative (n, 6 + 6 poses) of the errors by w, d and the twists of the control poses.

    To first order in the shake and in the turn within an interval: it leads the descent and gives the covariance,
    while the errors themselves are exact. A pose moves by the sum of the twists that blend there; what the pose
    after one period would move by is taken back through the path below the shake, for w and d stay.
    """
    first, second = errors.by_nudge(motion)
    after, count = Pose(so3.exp(motion.w), motion.d), len(motion.shake)
    by_end = _along(first, errors.times[0], after) + _along(second, errors.times[1], after)
    blend0, blend1 = (blending(tau, motion.interval, count) for tau in errors.times)
    start, end = blending(np.array([0.0, 1.0]), motion.interval, count)
    adjoint = adjoint_apply(after, np.eye(6)).T
    by_shake = blend0[:, :, None] * first[:, None] + blend1[:, :, None] * second[:, None]
    by_shake -= end[:, None] * by_end[:, None] - start[:, None] * (by_end @ adjoint)[:, None]
    turn = np.eye(6)  # twist of the pose after one period by (w, d)
    turn[:3, :3] = so3.left_jacobian(motion.w)
    turn[3:, :3] = so3.hat(motion.d) @ turn[:3, :3]
    return np.concatenate([by_end @ turn, by_shake.reshape(len(by_shake), 6 * count)], axis=1)


def _along(by_pose: FloatArray, tau: FloatArray, after: Pose) -> FloatArray:
    """Derivative (n, 6) by the twist of the pose after one period, from that by the pose's at tau (n,).

    On the path exp(tau xi) the pose moves by tau J(tau ad) J(ad)^-1 of that twist, J(A) = sum of A^k / (k + 1)!.
    """
    xi = log(after)
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = so3.hat(xi[:3])
    ad[3:, :3] = so3.hat(xi[3:])
    power, whole, out = np.eye(6), np.zeros((6, 6)), np.zeros_like(by_pose)
    for k in range(_SERIES):
        whole += power / factorial(k + 1)
        out += (tau ** (k + 1) / factorial(k + 1))[:, None] * (by_pose @ power)
        power = ad @ power
    return np.asarray(np.linalg.solve(whole.T, out.T).T, np.float64)


def dispersion(fit: ModelFit, cell_px: float) -> float:
    """Factor by which the scores of the matches vary more than the curvature of their likelihood says.

    1 for independent errors of the assumed distribution, about 0.93 for independent normal ones; matches nearer to
    each other than ``cell_px`` may err together.

    R. Chandler, S. Bate, Inference for clustered data using the independence loglikelihood, Biometrika 2007.
    """
    errors, sizes, variance = fit.errors, fit.errors.sizes, fit.scale_px**2
    squares, w = errors.squares(fit.values), fit.weights
    varied = float(np.sum(w**2 * squares)) / variance
    each = np.repeat(w, sizes)
    rows = fit.jacobian[:, :6] * (each * fit.values)[:, None] / variance
    scores = np.add.reduceat(rows, np.cumsum(sizes) - sizes, axis=0)
    H = fit.curvature[:6, :6] + np.diag(_MOTION_SIGMA**-2.0)
    scores = np.linalg.solve(np.linalg.cholesky(H), scores.T).T
    cells = np.unique(np.floor(errors.pixels / cell_px), axis=0, return_inverse=True)[1].ravel()
    together = np.zeros((int(cells.max()) + 1, 6))
    np.add.at(together, cells, scores)
    alone = float(np.sum(scores**2))
    clustered = float(np.sum(together**2)) / alone if alone > 0.0 else 1.0
    return varied / fit.bend * max(clustered, 1.0)


def _first_scale(errors: Errors, values: FloatArray) -> float:
    """From the median: up to half of the matches may be wrong."""
    return max(float(np.sqrt(np.median(errors.squares(values) / errors.sizes) / 0.6)), _LEAST_SCALE_PX)


def _weights(squares: FloatArray, sizes: FloatArray, scale: float) -> FloatArray:
    return np.asarray((_TAILS + sizes) / (_TAILS + squares / scale**2))


def _loss(squares: FloatArray, sizes: FloatArray, scale: float) -> float:
    """Negative log-likelihood, up to a constant."""
    tails = 0.5 * (_TAILS + sizes) * np.log1p(squares / (_TAILS * scale**2))
    return float(np.sum(tails) + np.sum(sizes) * np.log(scale))
