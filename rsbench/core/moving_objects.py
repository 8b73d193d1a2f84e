"""Rigid objects that move by themselves, and how a rig moves as seen from one of them.

The frame of an object is the world as it is at time 0: a point of the object is at ``X`` then, and at
``world_from_object(tau) X`` later. Seen from this frame the object stands still and the rig moves otherwise, as
``RelativeMotion`` says; so all that is known of points that stand still - rows that see them, depth, flow - holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose, compose
from rsbench.core.so3 import FloatArray


@dataclass(frozen=True, eq=False)
class MovingObject:
    """A rigid body: R(tau), t(tau) of its motion turn it about its pivot and shift it."""

    pivot: FloatArray
    """(3,) metres, world frame at time 0."""
    motion: Motion
    """Not of the rig: ``X(tau) = pivot + R(tau) (X - pivot) + t(tau)``."""

    def world_from_object(self, tau: ArrayLike) -> Pose:
        """Pose (..., 3, 3), (..., 3) at times (...); the identity at 0."""
        R, t = self.motion.body_from_world(tau)
        return Pose(R, t + self.pivot - R @ self.pivot)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Of ``world_from_object``, as ``Motion.velocity``."""
        R, _ = self.motion.body_from_world(tau)
        w_rate, t_rate = self.motion.velocity(tau)
        return w_rate, t_rate - so3.cross(w_rate, R @ self.pivot)

    def from_time(self, start: float, body: Pose) -> MovingObject:
        """The same seen from a later time, which is its time 0, in the world that is the rig's ``body`` then."""
        motion = TurnedMotion(self.motion.from_time(start), body.R)
        return MovingObject(body.R @ self.pivot + body.t, motion)


def poses_of(objects: Sequence[MovingObject], tau: ArrayLike) -> Pose | None:
    """``world_from_object`` (objects, ..., 3, 3), (objects, ..., 3) at times (...); None where there are none."""
    if not objects:
        return None
    poses = [each.world_from_object(tau) for each in objects]
    return Pose(np.stack([each.R for each in poses]), np.stack([each.t for each in poses]))


@final
@dataclass(frozen=True, eq=False, init=False)
class TurnedMotion(Motion):
    """Another motion told in turned axes: R(tau) and t(tau) become ``A R A^T`` and ``A t``."""

    name: ClassVar[str] = "turned"
    motion: Motion
    axes: FloatArray
    """A (3, 3): turned from the axes of ``motion``."""

    def __init__(self, motion: Motion, axes: FloatArray) -> None:
        super().__init__(axes @ motion.w, axes @ motion.d)
        object.__setattr__(self, "motion", motion)
        object.__setattr__(self, "axes", axes)

    def body_from_world(self, tau: ArrayLike) -> Pose:
        R, t = self.motion.body_from_world(tau)
        return Pose(self.axes @ R @ self.axes.T, t @ self.axes.T)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        w_rate, t_rate = self.motion.velocity(tau)
        return w_rate @ self.axes.T, t_rate @ self.axes.T


@final
@dataclass(frozen=True, eq=False, init=False)
class RelativeMotion(Motion):
    """The rig's motion seen from a moving object: ``body_from_object``."""

    name: ClassVar[str] = "relative"
    rig: Motion
    body: MovingObject

    def __init__(self, rig: Motion, body: MovingObject) -> None:
        object.__setattr__(self, "rig", rig)
        object.__setattr__(self, "body", body)
        end = self.body_from_world(1.0)
        super().__init__(so3.log(end.R), end.t)

    def body_from_world(self, tau: ArrayLike) -> Pose:
        return compose(self.rig.body_from_world(tau), self.body.world_from_object(tau))

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        R, _ = self.rig.body_from_world(tau)
        w_rate, t_rate = self.rig.velocity(tau)
        own_w, own_t = self.body.velocity(tau)
        _, place = self.body.world_from_object(tau)
        turned = (R @ own_w[..., None])[..., 0]
        carried = (R @ own_t[..., None])[..., 0]
        return w_rate + turned, t_rate + so3.cross(w_rate, (R @ place[..., None])[..., 0]) + carried
