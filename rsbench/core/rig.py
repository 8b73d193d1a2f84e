"""The stereo rig: two equal cameras, rows aligned with the baseline, read at the same times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import arguments
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
View = tuple[Side, int]
"""Side and frame, from 0."""
FRAMES = (0, 1)
"""The frames of a pair; every estimate is of one pair."""


def views_of(frames: int) -> tuple[View, ...]:
    """Both cameras at so many times, the left one first."""
    return tuple(product(SIDES, range(frames)))


VIEWS = views_of(len(FRAMES))


@dataclass(frozen=True, kw_only=True)
class StereoRig:
    """A rectified stereo pair that moves about the centre of its baseline."""

    camera: PinholeCamera
    baseline: float
    """Full distance between the two cameras, metres (the paper's 2b)."""
    origin: Literal["middle", "left", "right"] = "middle"
    """The point whose motion is described: the body's, in the middle of the baseline, or one camera's centre."""

    def __post_init__(self) -> None:
        arguments.check_type("camera", self.camera, PinholeCamera)
        arguments.check_positive("baseline", self.baseline, arguments.LARGEST_M, "metres")
        arguments.check_one_of("origin", self.origin, ("middle", "left", "right"))
        arguments.keep_plain(self)

    def offset(self, side: Side) -> FloatArray:
        """``x_in_cam = x_in_body + offset`` (3,): the camera stands at minus the offset."""
        place = {"left": self.baseline / 2, "middle": 0.0, "right": -self.baseline / 2}
        return np.array([place[side] - place[self.origin], 0.0, 0.0])

    @property
    def ideal(self) -> StereoRig:
        """The same rig with cameras without a lens."""
        return self if self.camera.lens is None else replace(self, camera=self.camera.ideal)

    def about(self, origin: Literal["middle", "left", "right"]) -> StereoRig:
        """The same rig whose body is another point of it."""
        return replace(self, origin=origin)

    def cam_from_world(self, motion: Motion, tau: ArrayLike, side: Side) -> Pose:
        """Camera pose (..., 3, 3), (..., 3) at times ``tau`` (...)."""
        R, t = motion.body_from_world(tau)
        return Pose(R, t + self.offset(side))

    def depth(self, disparity: ArrayLike) -> FloatArray:
        """Depth z (metres) of ``disparity = x_left - x_right`` (ideal px); NaN where it is not positive.

        Exact for a rolling shutter too: both cameras read the same row at the same time, so the pair of a row
        is an ordinary rectified pair.
        """
        disparity = np.asarray(disparity, dtype=np.float64)
        return self.camera.fx * self.baseline / np.where(disparity > 0.0, disparity, np.nan)

    def disparity(self, depth: ArrayLike) -> FloatArray:
        """Disparity (ideal px) of depth z (metres); NaN where the depth is not positive."""
        depth = np.asarray(depth, dtype=np.float64)
        return self.camera.fx * self.baseline / np.where(depth > 0.0, depth, np.nan)
