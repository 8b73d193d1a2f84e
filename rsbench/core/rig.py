"""The stereo rig: two cameras fixed to one body, each with its own size, intrinsics, lens and orientation.

The body's axes are those of the rectified pair: x points from the left to the right centre of projection, z is the
mean viewing direction made orthogonal to x, and y = z x x. Apart from lens and intrinsics, a camera then differs
from one of a rectified pair only by a rotation. Everything derived for rectified pairs (the paper's equations,
disparity, epipolar lines) holds for any rig in *ideal* pixels. These belong to ``StereoRig.camera`` without a
lens, placed at the centre of either camera and aligned with the body's axes. In an ideal rig both cameras equal
this camera.

There are two kinds of axes. ``cam_from_world`` and ``sensor`` use a camera's own axes, as do files, renderers and
depth (z in the camera at the time of the line). ``eye`` and ``eye_from_world`` use the body's axes at the camera's
centre, as do solvers, matching and disparities. In an ideal rig both are the same.
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
"""The frames of a pair; every estimate is for one pair."""
_ALIGNED_RAD = 1e-9
"""A camera counts as aligned if its rotation is smaller; it then moves no pixel by more than rounding errors."""
_TOGETHER = 0.04
"""Largest time between the two ends of a left-right match, frame periods, to count as read at once."""
_NEAR = 0.125
"""Disparity of near objects, in image widths."""
_LEAST_FORWARD = 0.05
"""Smallest length of the component of the summed viewing directions that is orthogonal to the baseline."""


def views_of(frames: int) -> tuple[View, ...]:
    """Return all views of both cameras in this number of frames, those of the left camera first."""
    return tuple(product(SIDES, range(frames)))


VIEWS = views_of(len(FRAMES))


@dataclass(frozen=True, kw_only=True)
class RigCamera:
    """One camera of a general (not ideal) rig."""

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
    """A camera of a rig with the methods of ``PinholeCamera``, but with points and rays in the body's axes.

    Pixels are those of the sensor. Ideal pixels are those of the rig's ideal camera, which is aligned with the
    body.
    """

    own: RigCamera
    ideal: PinholeCamera
    """The rig's ideal camera, with the focal lengths and principal point of ideal pixels."""
    is_ideal = False

    @property
    def width(self) -> int:
        """Number of columns of the sensor."""
        return self.own.camera.width

    @property
    def height(self) -> int:
        """Number of rows of the sensor."""
        return self.own.camera.height

    def project(self, x_in_eye: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the body's axes; NaN where the camera does not see them."""
        return self.own.camera.project(np.asarray(x_in_eye, dtype=np.float64) @ self.own.R.T)

    def velocity(self, x_in_eye: ArrayLike, rates: ArrayLike) -> FloatArray:
        """Velocities (..., 2) of the pixels of points (..., 3) that move by ``rates`` (..., 3)."""
        R = self.own.R.T
        return self.own.camera.velocity(np.asarray(x_in_eye) @ R, np.asarray(rates) @ R)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Return rays (..., 3) of pixels (..., 2), with z = 1 in the body's axes; NaN where undefined."""
        rays = self.own.camera.unproject(pixels) @ self.own.R
        return np.asarray(rays / np.where(rays[..., 2:] > 0.0, rays[..., 2:], np.nan))

    def ideal_pixels(self, pixels: ArrayLike) -> FloatArray:
        """Convert pixels (..., 2) to ideal pixels (..., 2); NaN where undefined."""
        return self.ideal.project(self.unproject(pixels))

    def lens_pixels(self, ideal_pixels: ArrayLike) -> FloatArray:
        """Convert ideal pixels (..., 2) to pixels (..., 2); NaN outside the camera's view."""
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

    ``StereoRig(camera=, baseline=)`` is the ideal rig of two equal, perfectly aligned cameras. ``of_cameras``
    makes a rig from a stereo calibration, and ``of_one`` makes one with a single camera.
    """

    camera: PinholeCamera
    """The camera on both sides of the ideal rig; in other rigs, the camera of ideal pixels, without a lens."""
    baseline: float
    """Full distance between the two cameras, metres (the paper's 2b)."""
    origin: Literal["middle", "left", "right"] = "middle"
    """The body's origin, whose motion is described: the middle of the baseline, or one camera's centre."""
    left: RigCamera | None = None
    """The left camera; None in the ideal rig, as is ``right``."""
    right: RigCamera | None = None
    sides: tuple[Side, ...] = field(default=SIDES, repr=False)
    """The existing cameras: both, or only the left one in a rig made by ``of_one``."""

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
        """Make a rig of one camera, at the body's origin; lengths have no unit, and the baseline is arbitrary."""
        return cls(camera=camera, baseline=1.0, origin="left", sides=("left",))

    @classmethod
    def of_cameras(
        cls, left: PinholeCamera, right: PinholeCamera, rotation: ArrayLike, translation: ArrayLike
    ) -> StereoRig:
        """Make a rig of two calibrated cameras; it is the ideal rig if they are equal and aligned.

        Args:
            left: left camera with its intrinsics.
            right: right camera.
            rotation: R (3, 3) in ``X_right = R X_left + t``, as in OpenCV's stereoCalibrate and Kalibr's
                T_cn_cnm1.
            translation: t (3,), metres.

        Raises:
            ValueError: R is not a rotation, t is zero, or both cameras look along the baseline or in opposite
                directions.
        """
        R, t = np.asarray(rotation, dtype=np.float64), arguments.vector("translation", translation)
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0.0:
            raise ValueError("rotation must be a rotation matrix (3, 3)")
        u, _, vt = np.linalg.svd(R)  # use the nearest rotation, as printed matrices are rounded
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
        """Make a rig of cameras ``baseline`` metres apart along x; the ideal rig if they are equal and aligned."""
        turned = max(map(abs, (*left.rotation, *right.rotation)))
        if left.camera == right.camera and turned < _ALIGNED_RAD:
            return cls(camera=left.camera, baseline=baseline)
        return cls(camera=_ideal_camera(left, right), baseline=baseline, left=left, right=right)

    @property
    def metric(self) -> bool:
        """Whether lengths are in metres; a single camera does not determine them."""
        return len(self.sides) > 1

    @property
    def aligned(self) -> bool:
        """Whether this is the ideal rig: equal cameras aligned with the body's axes, with or without a lens."""
        return self.left is None

    @property
    def rectified(self) -> bool:
        """Whether sensor pixels are ideal pixels, so that left-right matches lie on one row."""
        return self.left is None and self.camera.lens is None

    def own(self, side: Side) -> RigCamera:
        """Return a camera with its rotation."""
        return (self.left if side == "left" else self.right) or RigCamera(camera=self.camera)

    def sensor(self, side: Side) -> PinholeCamera:
        """Return a camera in its own axes."""
        return self.camera if self.left is None else self.own(side).camera

    def eye(self, side: Side) -> PinholeCamera | AlignedCamera:
        """Return a camera in the body's axes; in the ideal rig, this is the camera itself."""
        return self.camera if self.left is None else AlignedCamera(self.own(side), self.camera)

    def offset(self, side: Side) -> FloatArray:
        """Return the offset (3,) in ``x_in_eye = x_in_body + offset``; the camera is at minus the offset."""
        place = {"left": self.baseline / 2, "middle": 0.0, "right": -self.baseline / 2}
        return np.array([place[side] - place[self.origin], 0.0, 0.0])

    @property
    def right_from_left(self) -> Pose:
        """R and t in ``X_right = R X_left + t``, in the cameras' own axes, as stereo calibrations give them."""
        (left, right), t = (self.own(side).R for side in SIDES), np.array([-self.baseline, 0.0, 0.0])
        return Pose(right @ left.T, right @ t)

    @property
    def ideal(self) -> StereoRig:
        """The corresponding rectified rig, whose pixels are ideal: equal aligned cameras without a lens."""
        return self if self.rectified else replace(self, camera=self.camera.ideal, left=None, right=None)

    def about(self, origin: Literal["middle", "left", "right"]) -> StereoRig:
        """Return the same rig with another point as the body's origin."""
        return replace(self, origin=origin)

    def cam_from_world(self, motion: Motion, tau: ArrayLike, side: Side) -> Pose:
        """Return the camera pose (..., 3, 3), (..., 3) at times ``tau`` (...), in the camera's own axes."""
        R, t = self.eye_from_world(motion, tau, side)
        if self.left is None:
            return Pose(R, t)
        turn = self.own(side).R
        return Pose(turn @ R, t @ turn.T)

    def eye_from_world(self, motion: Motion, tau: ArrayLike, side: Side) -> Pose:
        """Return the camera pose as ``cam_from_world``, but in the body's axes."""
        R, t = motion.body_from_world(tau)
        return Pose(R, t + self.offset(side))

    def own_depth(self, side: Side, pixels: ArrayLike) -> FloatArray:
        """Return factors (...) that convert depth along the body's z to z in the camera's own axes."""
        if self.left is None:
            return np.ones(np.shape(pixels)[:-1])
        return np.asarray(self.eye(side).unproject(pixels) @ self.own(side).R[2])

    def rows_together(self, scanning: Scanning, readout_ratio: float | None = None) -> bool:
        """Return whether both cameras read an ideal row at nearly the same time, within 0.04 frame periods.

        For an ideal rig this depends on ``scanning`` alone, because its lens bends the rows of both cameras
        equally.
        An unknown readout ratio is assumed to be 1, the worst case: times differ more, the slower the readout.
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
        """Return the linear map (2, 2) from left to right image for distant points near the left centre."""
        left, right = (self.eye(side) for side in SIDES)
        centre = np.array([(left.width - 1) / 2, (left.height - 1) / 2])
        there = right.lens_pixels(left.ideal_pixels(centre))
        return np.asarray(inverse_2x2(right.ideal_by_pixel(there)) @ left.ideal_by_pixel(centre))

    def shutter_of(self, scanning: Scanning, readout_ratio: float) -> RollingShutter:
        """Return the shutter for these cameras, whose sizes may differ."""
        left, right = self.sensor("left"), self.sensor("right")
        same = (left.width, left.height) == (right.width, right.height)
        return scanning.shutter_of(
            left.width, left.height, readout_ratio, None if same else (right.width, right.height)
        )

    def depth(self, disparity: ArrayLike) -> FloatArray:
        """Return depth along the body's z (metres) for ``disparity = x_left - x_right`` (ideal px); NaN unless >
        0.

        This is exact for a rolling shutter too if both cameras read a point at the same time, because the two
        images of a row are then an ordinary rectified pair.
        """
        disparity = np.asarray(disparity, dtype=np.float64)
        return self.camera.fx * self.baseline / np.where(disparity > 0.0, disparity, np.nan)

    def disparity(self, depth: ArrayLike) -> FloatArray:
        """Return the disparity (ideal px) for depth along the body's z (metres); NaN unless it is positive."""
        depth = np.asarray(depth, dtype=np.float64)
        return self.camera.fx * self.baseline / np.where(depth > 0.0, depth, np.nan)


def _ideal_camera(left: RigCamera, right: RigCamera) -> PinholeCamera:
    """Return the ideal camera of a rig: mean focal length, centred on the common view, size of the left camera.

    If the baseline is vertical in the images, their rows become columns of the rectified pair, so that width and
    height are exchanged.
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
