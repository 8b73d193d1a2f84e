"""Motion through given poses: cubic splines through them, at their own times.

Positions and unit quaternions (of one sign along the way) are interpolated together, component by component, by
the cubic spline that is twice continuously differentiable (C. de Boor, A Practical Guide to Splines, 1978;
not-a-knot condition at both ends), and the quaternion is then made a unit one. Poses are hit to rounding; between
them the spline of a path f with step h errs by about 5/384 h^4 max |f''''| (C. Hall, W. Meyer, J. Approx. Theory
1976). Turning or moving the frame of all poses turns or moves the path, and no more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import given, so3
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray

LARGEST_TURN_DEG = 90.0
"""Between two poses: beyond, nobody can tell how the rig got there."""
_SAME = 1e-9
"""Largest difference of w and d that are still those of given poses."""
_UNIT = 1e-6
"""Quaternions may be longer or shorter than 1 by this much: rounding in a file."""


@final
@dataclass(frozen=True, eq=False, init=False)
class TrajectoryMotion(Motion):
    """Through poses of the body, seen from the body at time 0. Beyond the first and the last the speed stays."""

    name: ClassVar[str] = "trajectory"
    poses: FloatArray
    """(n, 8) time in frame periods, position x, y, z in metres and quaternion x, y, z, w of the body in a frame
    that stands still: world_from_body."""

    def __init__(self, w: ArrayLike, d: ArrayLike, poses: ArrayLike) -> None:
        """From poses whose ``endpoint`` is w and d.

        Raises:
            ValueError: not such rows, times that do not grow or do not reach from 0 to 1, a turn of more than
                ``LARGEST_TURN_DEG`` from one pose to the next, or another w or d.
        """
        super().__init__(w, d)
        rows = _checked(poses)
        rows.setflags(write=False)
        object.__setattr__(self, "poses", rows)
        R, t = self.body_from_world(1.0)
        if np.max(np.abs(np.concatenate([so3.log(R) - self.w, t - self.d]))) > _SAME:
            raise ValueError("w and d of a trajectory are those of its poses, and were given otherwise")

    @cached_property
    def _path(self) -> _Path:
        return _Path.through(self.poses)

    @cached_property
    def _start(self) -> Pose:
        return self._path.at(0.0).world_from_body

    def body_from_world(self, tau: ArrayLike) -> Pose:
        return compose(inverse(self._path.at(tau).world_from_body), self._start)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        place, turn, speed, *_ = self._path.at(tau)
        body = inverse(place)
        t = compose(body, self._start).t
        return -turn, -so3.cross(turn, t) - (body.R @ speed[..., None])[..., 0]

    def accelerations(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        place, turn, speed, turn_change, speed_change = self._path.at(tau)
        body = inverse(place)
        t, (_, t_rate) = compose(body, self._start).t, self.velocity(tau)
        v, v_change = ((body.R @ each[..., None])[..., 0] for each in (speed, speed_change))
        return -turn_change, so3.cross(turn, v) - v_change - so3.cross(turn_change, t) - so3.cross(turn, t_rate)

    @property
    def lasts(self) -> float:
        return float(self.poses[-1, 0])

    @property
    def parameters(self) -> dict[str, Any]:
        return {"poses": self.poses.tolist()}

    @classmethod
    def endpoint(cls, parameters: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        if "poses" not in parameters:
            raise ValueError("poses are required: (time, x, y, z, qx, qy, qz, qw) of the body")
        path = _Path.through(_checked(parameters["poses"]))
        R, t = compose(inverse(path.at(1.0).world_from_body), path.at(0.0).world_from_body)
        return so3.log(R), t


class Moving(NamedTuple):
    """Where the body is and how it moves."""

    world_from_body: Pose
    turn: FloatArray
    """(..., 3) rotation rate in the body's own axes, rad per unit of time."""
    speed: FloatArray
    """(..., 3) in the axes of the world, metres per unit of time."""
    turn_change: FloatArray
    """(..., 3) derivative of ``turn``."""
    speed_change: FloatArray
    """(..., 3) derivative of ``speed``."""


class _Path(NamedTuple):
    """The spline of positions and quaternions (7), from the first time to the last."""

    spline: Any
    first: float
    last: float

    @classmethod
    def through(cls, poses: FloatArray) -> _Path:
        from scipy.interpolate import CubicSpline

        quaternions = _one_sign(poses[:, 4:] / np.linalg.norm(poses[:, 4:], axis=1, keepdims=True))
        values = np.concatenate([poses[:, 1:4], quaternions], axis=1)
        return cls(CubicSpline(poses[:, 0], values), float(poses[0, 0]), float(poses[-1, 0]))

    def at(self, tau: ArrayLike) -> Moving:
        """At times (...); before the first pose and after the last at the velocity that it has there."""
        tau = np.asarray(tau, dtype=np.float64)
        within = np.clip(tau, self.first, self.last)
        beyond = (tau - within)[..., None]
        still = (beyond == 0.0).astype(np.float64)
        place, rate, change = self.spline(within), self.spline(within, 1), still * self.spline(within, 2)
        x, y, z, w = np.moveaxis(place[..., 3:], -1, 0)
        v, dv, dw = place[..., 3:6], rate[..., 3:6], rate[..., 6:]
        square = np.sum(place[..., 3:] ** 2, axis=-1, keepdims=True)
        # 2 q* q' of a quaternion q, whose length has no part in it.
        turn = 2.0 * (w[..., None] * dv - dw * v - so3.cross(v, dv)) / square
        ddv, ddw = change[..., 3:6], change[..., 6:]
        growth = 2.0 * np.sum(place[..., 3:] * rate[..., 3:], axis=-1, keepdims=True) / square
        turn_change = 2.0 * (w[..., None] * ddv - ddw * v - so3.cross(v, ddv)) / square - still * growth * turn
        R = so3.from_quaternion(np.stack([w, x, y, z], axis=-1)) @ so3.exp(beyond * turn)
        moved = Pose(R, place[..., :3] + beyond * rate[..., :3])
        return Moving(moved, turn, rate[..., :3], turn_change, change[..., :3])


def world_from_body(poses: ArrayLike, tau: ArrayLike) -> Pose:
    """Pose (..., 3, 3), (..., 3) at times (...) of the spline through poses (n, 8) as ``TrajectoryMotion`` has.

    Raises:
        ValueError: rows that can be no path.
    """
    return _Path.through(_checked(poses, spans=False)).at(tau).world_from_body


def turns_deg(quaternions: FloatArray) -> FloatArray:
    """Angles (n - 1,) from one of unit quaternions (n, 4) to the next, degrees."""
    cosine = np.abs(np.sum(quaternions[1:] * quaternions[:-1], axis=1))
    return np.asarray(np.rad2deg(2.0 * np.arccos(np.minimum(cosine, 1.0))))


def _one_sign(quaternions: FloatArray) -> FloatArray:
    """The same rotations, each quaternion on the side of the one before."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    signs = np.concatenate([[1.0], np.where(flips, -1.0, 1.0)])
    return np.asarray(quaternions * np.cumprod(signs)[:, None])


def _checked(value: ArrayLike, spans: bool = True) -> FloatArray:
    rows = given.real_array("poses", value)
    if rows.ndim != 2 or rows.shape[1] != 8 or len(rows) < 2 or not np.all(np.abs(rows) <= given.LARGEST):
        raise ValueError("poses must be two or more rows of 8 finite numbers: time, x, y, z, qx, qy, qz, qw")
    if np.any(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0) > _UNIT):
        raise ValueError("poses: a quaternion is not of length 1")
    if np.any(np.diff(rows[:, 0]) <= 0.0):
        raise ValueError("poses: each time must be later than the one before")
    if spans and not rows[0, 0] <= 0.0 < 1.0 <= rows[-1, 0]:
        raise ValueError(f"poses must reach from time 0 to 1, they are from {rows[0, 0]:g} to {rows[-1, 0]:g}")
    if np.max(turns_deg(rows[:, 4:])) > LARGEST_TURN_DEG:
        raise ValueError(f"poses: more than {LARGEST_TURN_DEG:g} degrees from one to the next")
    return rows
