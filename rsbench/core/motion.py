"""Motion models: where the rig's body is at time tau (frame periods); the body is the world at time 0.

All models share the parameters ``w`` and ``d``: the pose after one frame period is R = exp([w]x), t = d, so one
ground truth scores every model. They differ in how they interpolate, which costs as much accuracy as the
rolling shutter itself when data and solver disagree: a dataset names its model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray


def _vector(value: ArrayLike, name: str) -> FloatArray:
    v = np.array(value, dtype=np.float64)
    if v.shape != (3,) or not np.all(np.isfinite(v)):
        raise ValueError(f"motion {name} must be 3 finite numbers, got {value!r}")
    v.setflags(write=False)
    return v


@dataclass(frozen=True, eq=False, init=False)
class Motion(ABC):
    """Rigid motion of the body (the centre of the baseline)."""

    w: FloatArray
    """Rotation vector of one frame period, radians."""
    d: FloatArray
    """Translation of one frame period, metres: ``X_body = exp([w]x) X_world + d`` at tau = 1."""

    name: ClassVar[str]

    def __init__(self, w: ArrayLike, d: ArrayLike) -> None:
        object.__setattr__(self, "w", _vector(w, "w"))
        object.__setattr__(self, "d", _vector(d, "d"))

    @abstractmethod
    def body_from_world(self, tau: ArrayLike) -> Pose:
        """Pose (..., 3, 3), (..., 3) at times ``tau`` (...)."""

    @abstractmethod
    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """``(w', t')`` (..., 3) with dR/dtau = [w']x R and dt/dtau = t'."""


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


MOTION_MODELS: dict[str, type[LinearMotion] | type[TwistMotion]] = {
    model.name: model for model in (LinearMotion, TwistMotion)
}
