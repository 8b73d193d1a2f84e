"""A cubic B-spline through control poses: rotations cumulative on SO(3), positions of the body in the world.

    R(u) = exp(b3 O[i+2]) exp(b2 O[i+1]) exp(b1 O[i]) C[i],   O[k] = log(C[k+1] C[k]^T)
    p(u) = p[i] + b1 (p[i+1] - p[i]) + b2 (p[i+2] - p[i+1]) + b3 (p[i+3] - p[i+2])

with C body_from_world and the b of ``core.spline_motion``. Rotations and positions do not mix, as they
would on SE(3), so that a body that nothing pushes goes straight in the world while it turns. C. Sommer, V. Usenko,
D. Schubert, N. Demmel, D. Cremers, Efficient derivative computation for cumulative B-splines on Lie groups, CVPR
2020, for the derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_ORDER = 4
"""Control poses that a time feels."""
_SAME = 1e-9


class Curve(NamedTuple):
    """The spline as compiled functions take it; the first interval begins at ``first``."""

    first: float
    interval: float
    """Frame periods between two control poses."""
    R: FloatArray
    """(n, 3, 3) body_from_world of the control poses."""
    p: FloatArray
    """(n, 3) positions of the body in the world, metres."""
    steps: FloatArray
    """(n - 1, 3) O, radians."""
    inverse_left: FloatArray
    """(n - 1, 3, 3) inverse left Jacobians of the steps; their transposes are the right ones."""

    @property
    def last(self) -> float:
        """End of the last interval, frame periods."""
        return self.first + (len(self.p) - 3) * self.interval


def make_curve(first: float, interval: float, R: FloatArray, p: FloatArray) -> Curve:
    """The spline of control poses (n, 3, 3), (n, 3)."""
    # Products of products drift off the rotations, twice as far each time: one step back to the nearest.
    R = 1.5 * R - 0.5 * R @ np.swapaxes(R, 1, 2) @ R
    steps = so3.log(R[1:] @ np.swapaxes(R[:-1], 1, 2))
    inverse_left = np.linalg.inv(so3.left_jacobian(steps))
    contiguous = (np.ascontiguousarray(each, dtype=np.float64) for each in (R, p, steps, inverse_left))
    return Curve(float(first), float(interval), *contiguous)


def moved(curve: Curve, step: FloatArray) -> Curve:
    """Each control pose turned by exp of the first three numbers of its row (n, 6), and shifted by the others."""
    step = step.reshape(-1, 6)
    return make_curve(curve.first, curve.interval, so3.exp(step[:, :3]) @ curve.R, curve.p + step[:, 3:])


def from_pose_at(curve: Curve, tau: float) -> Curve:
    """The same way, seen from the body at a time: it is the world then."""
    (R, t), _, _ = evaluate(curve, tau)
    p = -R.T @ t
    return make_curve(curve.first, curve.interval, curve.R @ R.T, (curve.p - p) @ R.T)


def part(curve: Curve, first: float, last: float, zero: float) -> Curve:
    """Of the intervals that hold times from ``first`` to ``last``; ``zero`` is time 0 there."""
    low = int(np.clip(np.floor((first - curve.first) / curve.interval + 1e-9), 0, len(curve.p) - _ORDER))
    high = int(np.clip(np.ceil((last - curve.first) / curve.interval - 1e-9), low + 1, len(curve.p) - _ORDER + 1))
    chosen = slice(low, high + _ORDER - 1)
    return make_curve(curve.first + low * curve.interval - zero, curve.interval, curve.R[chosen], curve.p[chosen])


def span_of(windows: int, shutter: RollingShutter) -> tuple[float, float]:
    """From the first line to the last one of so many windows, time 0 within."""
    ends = [shutter.start(frame, side) for frame in (0, windows) for side in SIDES]
    return min(0.0, float(np.min(ends))), float(np.max(ends)) + shutter.readout_ratio


def control_count(first: float, last: float, interval: float) -> int:
    """Control poses of a spline that reaches from one time to another."""
    return max(int(np.ceil((last - first) / interval - 1e-9)), 1) + _ORDER - 1


def evaluate(curve: Curve, tau: ArrayLike) -> tuple[Pose, FloatArray, FloatArray]:
    """body_from_world at times (...), w' with dR/dtau = [w']x R, and the velocity (..., 3) of p.

    Before the first interval and after the last, rates stay what they are there.
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
    """The way of a rig over many frames, seen from the body at time 0."""

    name: ClassVar[str] = "continuous"
    first: float
    """Where the first interval begins, frame periods."""
    interval: float
    """Frame periods between two control poses."""
    controls: FloatArray
    """(n, 6) rotation vectors of body_from_world, radians, and positions of the body in the world, metres."""

    def __init__(self, w: ArrayLike, d: ArrayLike, first: float, interval: float, controls: ArrayLike) -> None:
        """From control poses whose ``endpoint`` is w and d.

        Raises:
            ValueError: no such rows, or another w or d.
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
            raise ValueError("w and d of a continuous motion are those of its controls, and were given otherwise")

    @classmethod
    def of(cls, curve: Curve) -> ContinuousMotion:
        """The motion of a spline, seen from its body at time 0."""
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
        """In other axes (3, 3), a mirror's too, and another unit of length, of which the old one is so many."""
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
