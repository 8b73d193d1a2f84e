"""The stereo rig: two cameras fixed to one body, each with its own size, intrinsics, lens and orientation.

The body's axes are those of the rectified pair: x from the left to the right centre of projection, z the mean
viewing direction made orthogonal to x, y = z x x. A camera then differs from that of a rectified pair by a
rotation alone, and whatever is derived for rectified pairs (the paper's equations, disparity, epipolar lines)
holds for any rig in *ideal* pixels: those of ``StereoRig.camera`` without a lens, looking along the body's axes
from the centre of a camera. In an ideal rig both cameras are that camera.

Two kinds of axes occur. ``cam_from_world`` and ``sensor`` are in a camera's own axes; files, renderers and
depth (z in the camera of the line) use them. ``eye`` and ``eye_from_world`` are in the body's axes at the same
centre; solvers, matching and disparities use them. In an ideal rig both are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import arguments, so3
from rsbench.core.camera import PinholeCamera, inverse_2x2
from rsbench.core.motion import Motion
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
View = tuple[Side, int]
"""Side and frame, from 0."""
FRAMES = (0, 1)
"""The frames of a pair; every estimate is of one pair."""
_ALIGNED_RAD = 1e-9
"""Rotations below this move no pixel by more than rounding: the camera counts as aligned."""
_TOGETHER = 0.04
"""Readout times between the ends of a match below which it is looked for, and its depth found, on one row."""
_NEAR = 0.125
"""Disparity of near things, in widths of the image."""
_LEAST_FORWARD = 0.05
"""Least share of the mean viewing direction that is orthogonal to the baseline."""


def views_of(frames: int) -> tuple[View, ...]:
    """Both cameras at so many times, the left one first."""
    return tuple(product(SIDES, range(frames)))


VIEWS = views_of(len(FRAMES))


@dataclass(frozen=True, kw_only=True)
class RigCamera:
    """One camera of a rig that is not ideal."""

    camera: PinholeCamera
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector (rad) from the body's axes to the camera's: ``x_in_cam = exp([rotation]x) x``."""

    def __post_init__(self) -> None:
        arguments.check_type("camera", self.camera, PinholeCamera)
        w = arguments.vector("rotation", self.rotation)
        object.__setattr__(self, "rotation", tuple(map(float, w)))

    @cached_property
    def R(self) -> FloatArray:
        """Rotation matrix (3, 3) from the body's axes to the camera's."""
        return so3.exp(np.array(self.rotation))


@dataclass(frozen=True)
class AlignedCamera:
    """A camera of a rig as seen in the body's axes: ``PinholeCamera``'s methods, for rays along those axes.

    Pixels are the sensor's. Ideal pixels are those of the rig's ideal camera, which looks along the body's axes.
    """

    own: RigCamera
    ideal: PinholeCamera
    """The rig's ideal camera; focal lengths and principal point of ideal pixels."""
    is_ideal = False

    @property
    def width(self) -> int:
        """Columns of the sensor."""
        return self.own.camera.width

    @property
    def height(self) -> int:
        """Rows of the sensor."""
        return self.own.camera.height

    def project(self, x_in_eye: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the body's axes; NaN where the camera does not see them."""
        return self.own.camera.project(np.asarray(x_in_eye, dtype=np.float64) @ self.own.R.T)

    def velocity(self, x_in_eye: ArrayLike, rates: ArrayLike) -> FloatArray:
        """Velocities (..., 2) of the pixels of points (..., 3) that move by ``rates`` (..., 3)."""
        R = self.own.R.T
        return self.own.camera.velocity(np.asarray(x_in_eye) @ R, np.asarray(rates) @ R)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Rays (..., 3) with z = 1 in the body's axes; NaN where there is none."""
        rays = self.own.camera.unproject(pixels) @ self.own.R
        return np.asarray(rays / np.where(rays[..., 2:] > 0.0, rays[..., 2:], np.nan))

    def ideal_pixels(self, pixels: ArrayLike) -> FloatArray:
        """Ideal pixels (..., 2) of pixels (..., 2); NaN where there is none."""
        return self.ideal.project(self.unproject(pixels))

    def lens_pixels(self, ideal_pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of ideal pixels (..., 2); NaN where the camera does not look there."""
        return self.project(self.ideal.unproject(ideal_pixels))

    def ideal_by_pixel(self, pixels: ArrayLike) -> FloatArray:
        """Derivative (..., 2, 2) of ``ideal_pixels`` at pixels (..., 2)."""
        rays = self.unproject(pixels)
        e = np.eye(3)
        by_ideal = [
            self.velocity(rays, np.broadcast_to(e[k] / f, rays.shape))
            for k, f in enumerate((self.ideal.fx, self.ideal.fy))
        ]
        return inverse_2x2(np.stack(by_ideal, axis=-1))

    def contains(self, pixels: ArrayLike) -> np.ndarray:
        """Whether pixels (..., 2) lie inside the image area, half a pixel beyond the outermost centres."""
        return self.own.camera.contains(pixels)

    def pixel_grid(self) -> FloatArray:
        """Centres of all pixels, (height, width, 2)."""
        return self.own.camera.pixel_grid()


@dataclass(frozen=True, kw_only=True)
class StereoRig:
    """A stereo pair that moves about the centre of its baseline.

    ``StereoRig(camera=, baseline=)`` is the ideal rig, two equal cameras in perfect alignment; ``of_cameras``
    makes any other from what a calibration gives, and ``of_one`` that of one camera.
    """

    camera: PinholeCamera
    """Both cameras of the ideal rig; of any other the ideal camera that ideal pixels belong to, without a lens."""
    baseline: float
    """Full distance between the two cameras, metres (the paper's 2b)."""
    origin: Literal["middle", "left", "right"] = "middle"
    """The point whose motion is described: the body's, in the middle of the baseline, or one camera's centre."""
    left: RigCamera | None = None
    """None in the ideal rig, as is ``right``."""
    right: RigCamera | None = None
    sides: tuple[Side, ...] = field(default=SIDES, repr=False)
    """The cameras that there are: both, or in a rig ``of_one`` the left one."""

    def __post_init__(self) -> None:
        arguments.check_type("camera", self.camera, PinholeCamera)
        arguments.check_positive("baseline", self.baseline, arguments.LARGEST_M, "metres")
        arguments.check_one_of("origin", self.origin, ("middle", "left", "right"))
        if (self.left is None) != (self.right is None):
            raise ValueError("left and right must both be given, or neither: the ideal rig has neither")
        for side in SIDES:
            if self.left is not None:
                arguments.check_type(side, getattr(self, side), RigCamera)
        if self.left is not None and self.camera.lens is not None:
            raise ValueError("camera must have no lens where left and right are given: theirs are their own")
        arguments.keep_plain(self)

    @classmethod
    def of_one(cls, camera: PinholeCamera) -> StereoRig:
        """One camera, whose centre is the body's: lengths have no unit, so the baseline stands for any."""
        return cls(camera=camera, baseline=1.0, origin="left", sides=("left",))

    @classmethod
    def of_cameras(
        cls, left: PinholeCamera, right: PinholeCamera, rotation: ArrayLike, translation: ArrayLike
    ) -> StereoRig:
        """The rig of two calibrated cameras; the ideal one where they are equal and aligned but for rounding.

        Args:
            left: intrinsics of the left camera.
            right: those of the right one.
            rotation: R (3, 3) of ``X_right = R X_left + t``, as OpenCV's stereoCalibrate and Kalibr's T_cn_cnm1.
            translation: t (3,), metres.

        Raises:
            ValueError: R is no rotation, t is zero, or both cameras look along the line between them.
        """
        R, t = np.asarray(rotation, dtype=np.float64), arguments.vector("translation", translation)
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0.0:
            raise ValueError("rotation must be a rotation matrix (3, 3)")
        u, _, vt = np.linalg.svd(R)  # printed matrices have a few digits: the nearest rotation
        R = u @ vt
        baseline = float(np.linalg.norm(t))
        if not baseline > 0.0:
            raise ValueError("translation must not be 0: both cameras would be at one place")
        x = -(R.T @ t) / baseline
        forward = np.array([0.0, 0.0, 1.0]) + R[2]
        z = forward - (forward @ x) * x
        if not np.linalg.norm(z) > _LEAST_FORWARD:
            raise ValueError("the cameras look along the line between them, or away from each other")
        z /= np.linalg.norm(z)
        to_body = np.stack([x, np.cross(z, x), z])  # body_from_left
        turns = so3.log(np.stack([to_body.T, R @ to_body.T]))
        first, second = (
            RigCamera(camera=each, rotation=tuple(turn)) for each, turn in zip((left, right), turns, strict=True)
        )
        return cls.of_body(first, second, baseline)

    @classmethod
    def of_body(cls, left: RigCamera, right: RigCamera, baseline: float) -> StereoRig:
        """The rig of cameras ``baseline`` metres apart along the body's x; the ideal one where they are alike."""
        turned = max(map(abs, (*left.rotation, *right.rotation)))
        if left.camera == right.camera and turned < _ALIGNED_RAD:
            return cls(camera=left.camera, baseline=baseline)
        return cls(camera=_ideal_camera(left, right), baseline=baseline, left=left, right=right)

    @property
    def metric(self) -> bool:
        """Whether lengths are metres; one camera does not show them."""
        return len(self.sides) > 1

    @property
    def aligned(self) -> bool:
        """Whether the cameras are equal and look along the body's axes: the ideal rig, with a lens or without."""
        return self.left is None

    @property
    def rectified(self) -> bool:
        """Whether a pixel of the sensor is an ideal one: a match of both cameras is on one row."""
        return self.left is None and self.camera.lens is None

    def own(self, side: Side) -> RigCamera:
        """A camera with its rotation."""
        return (self.left if side == "left" else self.right) or RigCamera(camera=self.camera)

    def sensor(self, side: Side) -> PinholeCamera:
        """A camera in its own axes."""
        return self.camera if self.left is None else self.own(side).camera

    def eye(self, side: Side) -> PinholeCamera | AlignedCamera:
        """A camera in the body's axes; in the ideal rig the camera itself."""
        return self.camera if self.left is None else AlignedCamera(self.own(side), self.camera)

    def offset(self, side: Side) -> FloatArray:
        """``x_in_eye = x_in_body + offset`` (3,): the camera stands at minus the offset, in the body's axes."""
        place = {"left": self.baseline / 2, "middle": 0.0, "right": -self.baseline / 2}
        return np.array([place[side] - place[self.origin], 0.0, 0.0])

    @property
    def right_from_left(self) -> Pose:
        """``X_right = R X_left + t``, in the cameras' own axes: what calibrations give."""
        (left, right), t = (self.own(side).R for side in SIDES), np.array([-self.baseline, 0.0, 0.0])
        return Pose(right @ left.T, right @ t)

    @property
    def ideal(self) -> StereoRig:
        """The rectified rig that sees the same in ideal pixels: equal aligned cameras without a lens."""
        return self if self.rectified else replace(self, camera=self.camera.ideal, left=None, right=None)

    def about(self, origin: Literal["middle", "left", "right"]) -> StereoRig:
        """The same rig whose body is another point of it."""
        return replace(self, origin=origin)

    def cam_from_world(self, motion: Motion, tau: ArrayLike, side: Side) -> Pose:
        """Camera pose (..., 3, 3), (..., 3) at times ``tau`` (...), in the camera's own axes."""
        R, t = self.eye_from_world(motion, tau, side)
        if self.left is None:
            return Pose(R, t)
        turn = self.own(side).R
        return Pose(turn @ R, t @ turn.T)

    def eye_from_world(self, motion: Motion, tau: ArrayLike, side: Side) -> Pose:
        """The same in the body's axes."""
        R, t = motion.body_from_world(tau)
        return Pose(R, t + self.offset(side))

    def own_depth(self, side: Side, pixels: ArrayLike) -> FloatArray:
        """Factors (...) from depth along the body's z, as ``depth`` gives it, to z in the camera's own axes."""
        if self.left is None:
            return np.ones(np.shape(pixels)[:-1])
        return np.asarray(self.eye(side).unproject(pixels) @ self.own(side).R[2])

    def rows_together(self, scanning: Scanning, readout_ratio: float | None = None) -> bool:
        """Whether both ends of a match are read at one time, or nearly: an ideal row of both within a 25th.

        Of an ideal rig what ``scanning`` says, for its lens bends rows of both cameras alike. A ratio that is not
        known may be 1: the slower the cameras read, the farther apart are two rows.
        """
        if self.left is None or not scanning.rows_together:
            return scanning.rows_together
        ratio = 1.0 if readout_ratio is None else readout_ratio
        shutter, camera = self.shutter_of(scanning, ratio), self.camera
        x, y = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9))
        ends = np.stack([x, y], axis=-1)
        first = shutter.pixel_time(self.eye("left").lens_pixels(ends), 0, "left")
        near = ends - [_NEAR * camera.width, 0.0]
        lag = [
            np.abs(shutter.pixel_time(self.eye("right").lens_pixels(each), 0, "right") - first)
            for each in (ends, near)
        ]
        return bool(np.any(np.isfinite(lag)) and np.nanmax(lag) < _TOGETHER)

    def right_by_left(self) -> FloatArray:
        """Affine map (2, 2) from pixels around the left image's centre to those of the right one, far away."""
        left, right = (self.eye(side) for side in SIDES)
        centre = np.array([(left.width - 1) / 2, (left.height - 1) / 2])
        there = right.lens_pixels(left.ideal_pixels(centre))
        return np.asarray(inverse_2x2(right.ideal_by_pixel(there)) @ left.ideal_by_pixel(centre))

    def shutter_of(self, scanning: Scanning, readout_ratio: float) -> RollingShutter:
        """The shutter of these cameras, whose sizes may differ."""
        left, right = self.sensor("left"), self.sensor("right")
        same = (left.width, left.height) == (right.width, right.height)
        return scanning.shutter_of(
            left.width, left.height, readout_ratio, None if same else (right.width, right.height)
        )

    def depth(self, disparity: ArrayLike) -> FloatArray:
        """Depth along the body's z (metres) of ``disparity = x_left - x_right`` (ideal px); NaN unless positive.

        Exact for a rolling shutter too where both cameras read a point at one time: the pair of a row is then an
        ordinary rectified pair.
        """
        disparity = np.asarray(disparity, dtype=np.float64)
        return self.camera.fx * self.baseline / np.where(disparity > 0.0, disparity, np.nan)

    def disparity(self, depth: ArrayLike) -> FloatArray:
        """Disparity (ideal px) of depth along the body's z (metres); NaN where the depth is not positive."""
        depth = np.asarray(depth, dtype=np.float64)
        return self.camera.fx * self.baseline / np.where(depth > 0.0, depth, np.nan)


def _ideal_camera(left: RigCamera, right: RigCamera) -> PinholeCamera:
    """The ideal camera of a rig: mean focal length, centred on what both cameras see, of the left one's size.

    Where the baseline is vertical in the images, their rows are columns of the rectified pair: width and height
    are exchanged.
    """
    pair = (left, right)
    focal = float(np.mean([f for each in pair for f in each.camera.central_focal]))
    turned = abs(left.R[1, 0]) > abs(left.R[0, 0])  # the body's x in the left camera: nearer to its y axis
    width, height = left.camera.width, left.camera.height
    width, height = (height, width) if turned else (width, height)
    middles = []
    for each in pair:
        ray = each.camera.unproject([(each.camera.width - 1) / 2, (each.camera.height - 1) / 2]) @ each.R
        middles.append(ray[:2] / ray[2])
    x, y = (float(v) for v in np.mean(middles, axis=0))
    if not (math.isfinite(x) and math.isfinite(y) and max(abs(x), abs(y)) < 2.0):
        raise ValueError("the cameras see nothing in common: their viewing directions differ too much")
    cx, cy = (width - 1) / 2 - focal * x, (height - 1) / 2 - focal * y
    return PinholeCamera(width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy)
