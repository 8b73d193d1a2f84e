"""Rigid transforms as pairs ``R`` (..., 3, 3), ``t`` (..., 3), meaning ``x_in_b = R @ x_in_a + t``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.so3 import FloatArray


class Pose(NamedTuple):
    """A transform ``target_from_source``: rotation (..., 3, 3) and translation (..., 3) in metres."""

    R: FloatArray
    t: FloatArray


def transform(pose: Pose, x: FloatArray) -> FloatArray:
    """Points (..., 3) moved by ``pose``; batch axes of both broadcast."""
    return (pose.R @ x[..., None])[..., 0] + pose.t


def inverse(pose: Pose) -> Pose:
    """Return the inverse transform, ``source_from_target`` for ``target_from_source``."""
    Rt = np.swapaxes(pose.R, -1, -2)
    return Pose(Rt, -(Rt @ pose.t[..., None])[..., 0])


def compose(c_from_b: Pose, b_from_a: Pose) -> Pose:
    """Return the product of two transforms, ``c_from_a`` for ``c_from_b`` and ``b_from_a``."""
    return Pose(c_from_b.R @ b_from_a.R, transform(c_from_b, b_from_a.t))


def exp(xi: ArrayLike) -> Pose:
    """Transform (..., 3, 3), (..., 3) of the twist ``xi`` = (w, v) (..., 6): R = exp([w]x), t = J(w) v."""
    xi = np.asarray(xi, dtype=np.float64)
    w, v = xi[..., :3], xi[..., 3:]
    return Pose(so3.exp(w), (so3.left_jacobian(w) @ v[..., None])[..., 0])


def log(pose: Pose) -> FloatArray:
    """Twist (..., 6) of a transform with a rotation below 180 degrees."""
    w = so3.log(pose.R)
    v = np.linalg.solve(so3.left_jacobian(w), pose.t[..., None])[..., 0]
    return np.concatenate([w, v], axis=-1, dtype=np.float64)


def adjoint_apply(pose: Pose, xi: FloatArray) -> FloatArray:
    """Transform a twist (..., 6) by the adjoint of ``pose``: exp(Ad xi) = pose exp(xi) pose^-1."""
    w = (pose.R @ xi[..., :3, None])[..., 0]
    v = (pose.R @ xi[..., 3:, None])[..., 0]
    return np.concatenate([w, v + so3.cross(pose.t, w)], axis=-1)


def bracket(a: FloatArray, b: FloatArray) -> FloatArray:
    """Lie bracket (..., 6) of twists: the rate of change of ``b`` in a frame that moves with twist ``a``."""
    w, v = a[..., :3], a[..., 3:]
    return np.concatenate([so3.cross(w, b[..., :3]), so3.cross(w, b[..., 3:]) + so3.cross(v, b[..., :3])], axis=-1)
