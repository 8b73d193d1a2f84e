"""Motion models: where the rig's body is at time tau (frame periods); the body is the world at time 0.

All models share the parameters ``w`` and ``d``: the pose after one frame period is R = exp([w]x), t = d, so one
ground truth scores every model. They differ in how they interpolate, which costs as much accuracy as the
rolling shutter itself when data and solver disagree: a dataset names its model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Self, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import given, so3
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray

_STEP = 1e-3
"""Frame periods between the velocities whose differences are accelerations where a model does not say its own."""


@dataclass(frozen=True, eq=False, init=False)
class Motion(ABC):
    """Rigid motion of the body (the centre of the baseline).

    A model is a frozen dataclass below this one, made as ``Model(w, d, **parameters)``; its fields are its own
    parameters, which have defaults, so that the name, w and d are enough.
    """

    w: FloatArray
    """Rotation vector of one frame period, radians."""
    d: FloatArray
    """Translation of one frame period, metres: ``X_body = exp([w]x) X_world + d`` at tau = 1."""

    name: ClassVar[str]

    def __init__(self, w: ArrayLike, d: ArrayLike) -> None:
        object.__setattr__(self, "w", given.vector("motion w", w))
        object.__setattr__(self, "d", given.vector("motion d", d))

    @abstractmethod
    def body_from_world(self, tau: ArrayLike) -> Pose:
        """Pose (..., 3, 3), (..., 3) at times ``tau`` (...): the identity at 0, (exp([w]x), d) at 1."""

    @abstractmethod
    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """``(w', t')`` (..., 3) with dR/dtau = [w']x R and dt/dtau = t'."""

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Angular and linear acceleration, (..., 3) each: the derivatives of ``velocity``.

        Here by central differences of fourth order, which err by 3e-14 (the fourth power of their step, over 30)
        of the fifth derivative of the velocity; rsbench's own models say theirs exactly.
        """
        tau = np.asarray(tau, dtype=np.float64)
        weights = {-2.0: 1.0, -1.0: -8.0, 1.0: 8.0, 2.0: -1.0}
        parts = [(weight, self.velocity(tau + k * _STEP)) for k, weight in weights.items()]
        w, t = (sum(weight * rates[k] for weight, rates in parts) / (12.0 * _STEP) for k in (0, 1))
        return np.asarray(w), np.asarray(t)

    @property
    def parameters(self) -> dict[str, Any]:
        """What the model has beside w and d, as JSON holds it: ``type(m)(m.w, m.d, **m.parameters)`` is m."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in ("w", "d")}

    def with_endpoint(self, w: ArrayLike, d: ArrayLike) -> Self:
        """The same model with the same parameters and another pose after one period."""
        return type(self)(w, d, **self.parameters)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        """What |w'| and |t'| do not exceed at times from ``first`` to ``last``; None when that is not known."""
        return None

    def from_time(self, start: float) -> Motion:
        """The same way, seen from the body at time ``start``, which is time 0 of the new one."""
        return self if start == 0.0 else LaterMotion.of(self, start)

    @property
    def lasts(self) -> float:
        """Until when the model says how the rig moves, frame periods; it then goes on at the speed that it has."""
        return float("inf")

    @classmethod
    def lasting(cls, parameters: Mapping[str, Any], periods: float) -> dict[str, Any]:
        """The parameters, with those left out that decide how long it ``lasts`` such that it is so long."""
        return dict(parameters)

    @classmethod
    def endpoint(cls, parameters: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        """``(w, d)`` where the parameters alone fix them; None where they are free, as in most models.

        Raises:
            ValueError: such parameters are not possible.
        """
        return None

    @classmethod
    def drawn(cls, parameters: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        """The parameters, with those drawn that are random by default; ``rng`` is used for nothing else."""
        return dict(parameters)


@final
@dataclass(frozen=True, eq=False, init=False)
class LinearMotion(Motion):
    """The paper's model, equations (2)-(5): R(tau) = exp(tau [w]x), t(tau) = tau d."""

    name: ClassVar[str] = "linear"

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        return Pose(so3.exp(tau * self.w), tau * self.d)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        shape = (*np.shape(tau), 3)
        return np.broadcast_to(self.w, shape), np.broadcast_to(self.d, shape)

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        shape = (*np.shape(tau), 3)
        return np.zeros(shape), np.zeros(shape)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        return float(np.linalg.norm(self.w)), float(np.linalg.norm(self.d))


@final
@dataclass(frozen=True, eq=False, init=False)
class TwistMotion(Motion):
    """Constant body twist (a screw): the pose is exp(tau xi) with exp(xi) = (exp([w]x), d)."""

    name: ClassVar[str] = "twist"

    @cached_property
    def v(self) -> FloatArray:
        """Linear part (3,) of the twist, metres per frame period."""
        return np.asarray(np.linalg.solve(so3.left_jacobian(self.w), self.d), dtype=np.float64)

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        return Pose(so3.exp(tau * self.w), tau * (so3.left_jacobian(tau * self.w) @ self.v))

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        R, _ = self.body_from_world(tau)
        return np.broadcast_to(self.w, (*np.shape(tau), 3)), R @ self.v

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        w, speed = self.velocity(tau)
        return np.zeros(speed.shape), so3.cross(w, speed)

    def from_time(self, start: float) -> Motion:
        return self  # a screw looks the same from everywhere on it

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        return float(np.linalg.norm(self.w)), float(np.linalg.norm(self.v))


@final
@dataclass(frozen=True, eq=False, init=False)
class InertialMotion(Motion):
    """A body that nothing pushes: constant velocity in the world and constant rate of turn.

    The body's centre is at tau c in the world, c = -R(1)^T d, so

        R(tau) = exp(tau [w]x),  t(tau) = -tau R(tau) c = tau exp((tau - 1) [w]x) d.
    """

    name: ClassVar[str] = "inertial"

    def _ahead(self, tau: FloatArray) -> FloatArray:
        """-R(tau) c (..., 3): the world's velocity as seen from the body; tau (..., 1)."""
        return so3.exp((tau - 1.0) * self.w) @ self.d

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        return Pose(so3.exp(tau * self.w), tau * self._ahead(tau))

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        ahead = self._ahead(tau)
        return np.broadcast_to(self.w, ahead.shape), ahead + tau * so3.cross(self.w, ahead)

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        tau = np.asarray(tau, dtype=np.float64)[..., None]
        turned = so3.cross(self.w, self._ahead(tau))
        return np.zeros(turned.shape), 2.0 * turned + tau * so3.cross(self.w, turned)

    def from_time(self, start: float) -> Motion:
        return InertialMotion(self.w, so3.exp(start * self.w) @ self.d)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        turn, speed = float(np.linalg.norm(self.w)), float(np.linalg.norm(self.d))
        return turn, speed * (1.0 + max(abs(first), abs(last)) * turn)


@final
@dataclass(frozen=True, eq=False, init=False)
class AcceleratedMotion(Motion):
    """Constant acceleration along the paper's path: R(tau) = exp(beta [w]x), t(tau) = beta d, with

        beta(tau) = (tau + k tau^2 / 2) 2 / (2 + k),   so that beta(1) = 1.

    B. Zhuang, L.-F. Cheong, G. H. Lee, Rolling-Shutter-Aware Differential SfM and Image Rectification, ICCV 2017,
    for the differential model; here the displacement is that of the exact one.
    """

    name: ClassVar[str] = "accelerated"
    acceleration: float = 0.2
    """k, per frame period: the speed grows by k times its value at time 0 in each period; above -1/2, or the rig
    would stop and turn back before time 2, when the last row of frame 1 is read at the latest."""

    def __init__(self, w: ArrayLike, d: ArrayLike, acceleration: float = 0.2) -> None:
        super().__init__(w, d)
        given.check_number("acceleration", acceleration)
        if not acceleration > -0.5:
            raise ValueError(f"acceleration = {acceleration}: must be a number above -0.5")
        object.__setattr__(self, "acceleration", float(acceleration))

    def share(self, tau: ArrayLike) -> FloatArray:
        """beta (...) of the displacement of one period, at times ``tau`` (...)."""
        tau, k = np.asarray(tau, dtype=np.float64), self.acceleration
        return np.asarray((tau + 0.5 * k * tau * tau) * (2.0 / (2.0 + k)))

    def speed(self, tau: ArrayLike) -> FloatArray:
        """Derivative (...) of ``share``."""
        tau, k = np.asarray(tau, dtype=np.float64), self.acceleration
        return np.asarray((1.0 + k * tau) * (2.0 / (2.0 + k)))

    def body_from_world(self, tau: ArrayLike) -> Pose:
        beta = self.share(tau)[..., None]
        return Pose(so3.exp(beta * self.w), beta * self.d)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        speed = self.speed(tau)[..., None]
        return speed * self.w, speed * self.d

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        k, shape = self.acceleration, (*np.shape(tau), 3)
        change = 2.0 * k / (2.0 + k)
        return np.broadcast_to(change * self.w, shape), np.broadcast_to(change * self.d, shape)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        speed = float(np.max(np.abs(self.speed([first, last]))))
        return speed * float(np.linalg.norm(self.w)), speed * float(np.linalg.norm(self.d))


@final
@dataclass(frozen=True, eq=False, init=False)
class LaterMotion(Motion):
    """Another motion from a later time on: what it is for a pair of frames in the middle of a sequence."""

    name: ClassVar[str] = "later"
    motion: Motion
    start: float
    """Time of ``motion`` that is time 0 here, frame periods."""

    def __init__(self, w: ArrayLike, d: ArrayLike, motion: Motion, start: float) -> None:
        super().__init__(w, d)
        object.__setattr__(self, "motion", motion)
        object.__setattr__(self, "start", start)

    @classmethod
    def of(cls, motion: Motion, start: float) -> LaterMotion:
        """With the w and d of the period that begins at ``start``."""
        first, last = (motion.body_from_world(start + period) for period in (0.0, 1.0))
        R, t = compose(last, inverse(first))
        return cls(so3.log(R), t, motion, start)

    @cached_property
    def _world(self) -> Pose:
        return inverse(self.motion.body_from_world(self.start))

    def body_from_world(self, tau: ArrayLike) -> Pose:
        return compose(self.motion.body_from_world(np.asarray(tau) + self.start), self._world)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        w, speed = self.motion.velocity(np.asarray(tau) + self.start)
        return w, speed + so3.cross(w, self._beside(tau))

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        later = np.asarray(tau) + self.start
        (w, _), (turn, change) = self.motion.velocity(later), self.motion.accelerations(later)
        beside = self._beside(tau)
        return turn, change + so3.cross(turn, beside) + so3.cross(w, so3.cross(w, beside))

    def _beside(self, tau: ArrayLike) -> FloatArray:
        """(..., 3) what the new world's origin adds to the body's translation; it turns with the body."""
        R, _ = self.motion.body_from_world(np.asarray(tau) + self.start)
        return R @ self._world.t

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        found = self.motion.fastest(first + self.start, last + self.start)
        return None if found is None else (found[0], found[1] + found[0] * float(np.linalg.norm(self._world.t)))
