"""Rigid transforms as pairs ``R`` (..., 3, 3), ``t`` (..., 3), meaning ``x_in_b = R @ x_in_a + t``."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rsbench.core.so3 import FloatArray


class Pose(NamedTuple):
    """A transform ``target_from_source``: rotation (..., 3, 3) and translation (..., 3) in metres."""

    R: FloatArray
    t: FloatArray


def transform(pose: Pose, x: FloatArray) -> FloatArray:
    """Points (..., 3) moved by ``pose``; batch axes of both broadcast."""
    return (pose.R @ x[..., None])[..., 0] + pose.t


def inverse(pose: Pose) -> Pose:
    """``source_from_target`` of ``target_from_source``."""
    Rt = np.swapaxes(pose.R, -1, -2)
    return Pose(Rt, -(Rt @ pose.t[..., None])[..., 0])


def compose(c_from_b: Pose, b_from_a: Pose) -> Pose:
    """``c_from_a``."""
    return Pose(c_from_b.R @ b_from_a.R, transform(c_from_b, b_from_a.t))
