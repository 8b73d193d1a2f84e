"""Inertial sensors: motion from gyroscope samples, and ideal measurements of gyroscope and accelerometer.

The sensor stands at the body's origin with the body's axes: x right, y down, z forward.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray


@final
@dataclass(frozen=True, eq=False, init=False)
class GyroMotion(Motion):
    """Motion with the rotation integrated from samples (n, 4) of a gyroscope, and t(tau) = tau d."""

    name: ClassVar[str] = "gyro"
    samples: FloatArray
    nodes: FloatArray
    """(n, 3, 3) rotations from the first sample to each sample."""
    origin: FloatArray
    """(3, 3) inverse of the rotation from the first sample to time 0."""

    def __init__(self, samples: FloatArray, d: ArrayLike) -> None:
        samples = samples[np.lexsort(samples.T[::-1])]
        tau, rates = samples[:, 0], samples[:, 1:]
        steps = np.diff(tau)[:, None] * 0.5 * (rates[1:] + rates[:-1])
        nodes = np.stack([np.eye(3), *so3.exp(steps)])
        for k in range(1, len(nodes)):
            nodes[k] = nodes[k] @ nodes[k - 1]
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "origin", self._turned(np.zeros(())).T)
        super().__init__(so3.log(self._turned(np.ones(())) @ self.origin), d)

    def _turned(self, tau: FloatArray) -> FloatArray:
        """Return rotations (..., 3, 3) since the first sample; rates are linear between samples, else constant."""
        times, rates = self.samples[:, 0], self.samples[:, 1:]
        k = np.clip(np.searchsorted(times, tau, side="right") - 1, 0, len(times) - 2)
        s = (tau - times[k])[..., None]
        inside = np.clip(s, 0.0, (times[k + 1] - times[k])[..., None])
        slope = (rates[k + 1] - rates[k]) / np.maximum(times[k + 1] - times[k], 1e-300)[..., None]
        angle = inside * rates[k] + 0.5 * inside**2 * slope + (s - inside) * (rates[k] + inside * slope)
        return np.asarray(so3.exp(angle) @ self.nodes[k])

    def body_from_world(self, tau: ArrayLike) -> Pose:
        tau = np.asarray(tau, dtype=np.float64)
        return Pose(self._turned(tau) @ self.origin, tau[..., None] * self.d)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        tau, times = np.asarray(tau, dtype=np.float64), self.samples[:, 0]
        rates = [np.interp(tau, times, self.samples[:, axis]) for axis in (1, 2, 3)]
        return np.stack(rates, axis=-1), np.broadcast_to(self.d, (*tau.shape, 3))

    def along(self, d: FloatArray) -> GyroMotion:
        """Return the motion with the same rotation and another translation."""
        other = copy.copy(self)
        object.__setattr__(other, "d", d)
        return other


STANDARD_GRAVITY = 9.80665
"""m/s^2 (3rd CGPM, 1901)."""


class Inertial(NamedTuple):
    """Measurements of ideal sensors, (..., 3) in the axes of the body."""

    turn: FloatArray
    """Angular velocity of the body, rad/s."""
    force: FloatArray
    """Specific force, i.e. acceleration minus gravity, m/s^2; at rest it points up."""


def inertial(motion: Motion, tau: ArrayLike, frame_period_s: float, gravity: ArrayLike) -> Inertial:
    """Return ideal measurements at times ``tau`` (...), frame periods.

    With u = t' - w' x t, the velocity of the body's origin in the world is p' = -R^T u, and its acceleration is
    p'' = R^T (w' x u - u'). ``Motion`` maps points from the world to the body, so the body's angular velocity is
    -w'.

    Args:
        motion: motion of the body.
        tau: times (...).
        frame_period_s: duration of a frame period, seconds.
        gravity: (3,) acceleration of free fall in the world frame, m/s^2.
    """
    R, t = motion.body_from_world(tau)
    w, speed = motion.velocity(tau)
    turn_change, speed_change = motion.accelerations(tau)
    u = speed - so3.cross(w, t)
    u_change = speed_change - so3.cross(turn_change, t) - so3.cross(w, speed)
    acceleration = (so3.cross(w, u) - u_change) / frame_period_s**2
    return Inertial(-w / frame_period_s, acceleration - R @ np.asarray(gravity, dtype=np.float64))
