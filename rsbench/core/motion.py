"""Motion models: the pose of the rig's body at time tau (frame periods), relative to the body at time 0.

All models have the parameters ``w`` and ``d``: the pose after one frame period is R = exp([w]x), t = d. The same
ground truth therefore scores every model. The models differ in their interpolation. If data and solver assume
different models, the loss of accuracy is as large as that of ignoring the rolling shutter, so a dataset names its
model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Self, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import arguments, so3
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray

_STEP = 1e-3
"""Step of the numerical derivative of the velocity, frame periods, for models without exact accelerations."""


@dataclass(frozen=True, eq=False, init=False)
class Motion(ABC):
    """Rigid motion of the body (the centre of the baseline).

    A model is a frozen dataclass derived from this class, constructed as ``Model(w, d, **parameters)``. Its fields
    are its own parameters. These have defaults, so that name, w and d suffice to construct it.
    """

    w: FloatArray
    """Rotation vector of one frame period, radians."""
    d: FloatArray
    """Translation of one frame period, metres: ``X_body = exp([w]x) X_world + d`` at tau = 1."""

    name: ClassVar[str]

    def __init__(self, w: ArrayLike, d: ArrayLike) -> None:
        object.__setattr__(self, "w", arguments.vector("motion w", w))
        object.__setattr__(self, "d", arguments.vector("motion d", d))

    @abstractmethod
    def body_from_world(self, tau: ArrayLike) -> Pose:
        """Return the pose (..., 3, 3), (..., 3) at times ``tau`` (...): the identity at 0, (exp([w]x), d) at 1."""

    @abstractmethod
    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return ``(w', t')``, (..., 3) each, with dR/dtau = [w']x R and dt/dtau = t'."""

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return angular and linear acceleration, (..., 3) each, the derivatives of ``velocity``.

        This default uses fourth-order central differences, whose error is 3e-14 (the fourth power of the step over
        30) times the fifth derivative of the velocity. rsbench's own models override it with exact derivatives.
        """
        tau = np.asarray(tau, dtype=np.float64)
        weights = {-2.0: 1.0, -1.0: -8.0, 1.0: 8.0, 2.0: -1.0}
        parts = [(weight, self.velocity(tau + k * _STEP)) for k, weight in weights.items()]
        w, t = (sum(weight * rates[k] for weight, rates in parts) / (12.0 * _STEP) for k in (0, 1))
        return np.asarray(w), np.asarray(t)

    @property
    def parameters(self) -> dict[str, Any]:
        """The model's parameters other than w and d, for JSON: ``type(m)(m.w, m.d, **m.parameters)`` equals m."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in ("w", "d")}

    def with_endpoint(self, w: ArrayLike, d: ArrayLike) -> Self:
        """Return a motion of the same model with the same parameters and another pose after one period."""
        return type(self)(w, d, **self.parameters)

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        """Return upper bounds of |w'| and |t'| from ``first`` to ``last``; None if they are not known."""
        return None

    def from_time(self, start: float) -> Motion:
        """Return the same motion relative to the body at time ``start``, which becomes time 0."""
        return self if start == 0.0 else LaterMotion.of(self, start)

    @property
    def lasts(self) -> float:
        """Time until which the model describes the motion, frame periods; the velocity is constant after it."""
        return float("inf")

    @classmethod
    def lasting(cls, parameters: Mapping[str, Any], periods: float) -> dict[str, Any]:
        """Return the parameters, with additions that make the motion last this number of periods."""
        return dict(parameters)

    @classmethod
    def endpoint(cls, parameters: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        """Return ``(w, d)`` if the parameters determine them; None if they are free, as in most models.

        Raises:
            ValueError: the parameters are invalid.
        """
        return None

    @classmethod
    def drawn(cls, parameters: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
        """Return the parameters, with draws for those random by default; ``rng`` has no other use."""
        return dict(parameters)


@final
@dataclass(frozen=True, eq=False, init=False)
class LaterMotion(Motion):
    """Another motion, starting at a later time, such as that of a pair of frames in the middle of a sequence."""

    name: ClassVar[str] = "later"
    motion: Motion
    start: float
    """Time of ``motion``, frame periods, that is time 0 of this motion."""

    def __init__(self, w: ArrayLike, d: ArrayLike, motion: Motion, start: float) -> None:
        super().__init__(w, d)
        object.__setattr__(self, "motion", motion)
        object.__setattr__(self, "start", start)

    @classmethod
    def of(cls, motion: Motion, start: float) -> LaterMotion:
        """Make the motion, with w and d of the period that begins at ``start``."""
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
        """Return the contribution (..., 3) of the new world's origin to the body's translation."""
        R, _ = self.motion.body_from_world(np.asarray(tau) + self.start)
        return R @ self._world.t

    def fastest(self, first: float, last: float) -> tuple[float, float] | None:
        found = self.motion.fastest(first + self.start, last + self.start)
        return None if found is None else (found[0], found[1] + found[0] * float(np.linalg.norm(self._world.t)))
