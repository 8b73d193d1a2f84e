"""A moving rig as one object (cameras, shutter and motion), and rigid moving objects in the scene.

The frame of an object coincides with the world at time 0: a point of the object is at ``X`` then, and at
``world_from_object(tau) X`` later. In this frame the object stands still and the rig moves by ``RelativeMotion``.
Everything that holds for static points (rows that see them, depth, flow) therefore holds for points of the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import arguments, so3
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig, View
from rsbench.core.se3 import Pose, compose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray


class MovingRig(Protocol):
    """Cameras, how they read their rows, and how they move."""

    @property
    def rig(self) -> StereoRig: ...
    @property
    def shutter(self) -> RollingShutter: ...
    @property
    def motion(self) -> Motion: ...


class Geometry(MovingRig, Protocol):
    """A moving rig and the moving objects in its scene; a ``Sequence`` is one."""

    @property
    def frames(self) -> int: ...
    @property
    def objects(self) -> tuple[MovingObject, ...]: ...


class FixedGeometry(NamedTuple):
    """A ``Geometry`` given by its parts, without a sequence."""

    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    frames: int = len(FRAMES)
    objects: tuple[MovingObject, ...] = ()
    """Moving objects, in the order of their numbers, which start at 1."""


@dataclass(frozen=True, eq=False)
class MovingObject:
    """A rigid body that its motion rotates about a pivot, R(tau), and translates, t(tau)."""

    pivot: FloatArray
    """(3,) metres, world frame at time 0."""
    motion: Motion
    """Motion of the object: ``X(tau) = pivot + R(tau) (X - pivot) + t(tau)``."""

    def world_from_object(self, tau: ArrayLike) -> Pose:
        """Return the pose (..., 3, 3), (..., 3) at times (...); it is the identity at 0."""
        R, t = self.motion.body_from_world(tau)
        return Pose(R, t + self.pivot - R @ self.pivot)

    def velocity(self, tau: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the velocities of ``world_from_object``, as ``Motion.velocity`` does."""
        R, _ = self.motion.body_from_world(tau)
        w_rate, t_rate = self.motion.velocity(tau)
        return w_rate, t_rate - so3.cross(w_rate, R @ self.pivot)

    def from_time(self, start: float, body: Pose) -> MovingObject:
        """Return the same object with time 0 at ``start`` and, as world frame, the rig's ``body`` at that time."""
        motion = TurnedMotion(self.motion.from_time(start), body.R)
        return MovingObject(body.R @ self.pivot + body.t, motion)


def poses_of(objects: Sequence[MovingObject], tau: ArrayLike) -> Pose | None:
    """Return ``world_from_object`` of all objects at times (...): (objects, ..., 3, 3), (objects, ..., 3); or
    None.

    It is None if there are no objects.
    """
    if not objects:
        return None
    poses = [each.world_from_object(tau) for each in objects]
    return Pose(np.stack([each.R for each in poses]), np.stack([each.t for each in poses]))


@final
@dataclass(frozen=True, eq=False, init=False)
class TurnedMotion(Motion):
    """A motion expressed in rotated axes: R(tau) and t(tau) become ``A R A^T`` and ``A t``."""

    name: ClassVar[str] = "turned"
    motion: Motion
    axes: FloatArray
    """The rotation A (3, 3) from the axes of ``motion`` to the new axes."""

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
    """The rig's motion relative to a moving object: ``body_from_object``."""

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


_IMAGE_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16))


def check_times(readout_ratio: float | None, target_row: float, rig: StereoRig) -> None:
    """Raise ValueError unless the readout ratio (None: unknown) and the row of an image are in range."""
    if readout_ratio is not None:
        arguments.check_number("readout_ratio", readout_ratio, 0.0, 1.0)
    arguments.check_number("target_row", target_row, 0.0, rig.camera.height - 1.0)


UNALIGNED = "the rig's cameras differ or look in different directions"
"""Reason given by components that support only the ideal rig."""


def check_ideal(rig: StereoRig, what: str) -> None:
    """Raise RsbenchError if the cameras have a lens or are not aligned, which ``what`` does not support."""
    if not rig.aligned:
        raise RsbenchError(f"{UNALIGNED}: {what} takes two equal cameras in perfect alignment")
    if rig.camera.lens is not None:
        raise RsbenchError(
            f"camera.lens = {rig.camera.lens.model!r}: {what} takes images without distortion; undistort first"
        )


def check_plain(rig: StereoRig, shutter: RollingShutter, what: str) -> None:
    """Raise RsbenchError unless the rig is ideal and reads rows from the top at the same times, for ``what``."""
    check_ideal(rig, what)
    if not shutter.plain:
        s = shutter.scanning
        raise RsbenchError(
            f"scan = {s.scan!r}, right_scan = {s.right_scan!r}, right_delay = {s.right_delay}"
            + (f", right_readout_ratio = {s.right_readout_ratio}" if s.right_readout_ratio is not None else "")
            + f": {what} takes rows from the top, read by both cameras at once"
        )


def check_cameras_of(cameras: str, rig: StereoRig, shutter: RollingShutter, what: str) -> None:
    """Raise RsbenchError for a rig outside the declared support ``cameras`` (ideal, any, rig) of a component."""
    if cameras == "ideal":
        check_plain(rig, shutter, what)
    elif cameras == "any" and not rig.aligned:
        raise RsbenchError(f"{UNALIGNED}: {what} takes two equal cameras in perfect alignment")


def check_view(side: str, frame: int) -> None:
    """Raise ValueError unless the side exists and the frame is a plausible number."""
    arguments.check_one_of("side", side, SIDES)
    arguments.check_whole("frame", frame, 0, arguments.LARGEST_SIZE)


def check_motion(rig: StereoRig, motion: Motion) -> None:
    """Raise ValueError unless ``rig`` is a rig and ``motion`` a motion."""
    arguments.check_type("rig", rig, StereoRig)
    arguments.check_type("motion", motion, Motion)


def check_moving_rig(rig: StereoRig, shutter: RollingShutter, motion: Motion) -> None:
    """Raise ValueError if an argument has the wrong type, or the shutter and the cameras differ in size."""
    check_rows(rig, shutter)
    check_motion(rig, motion)


def check_rows(rig: StereoRig, shutter: RollingShutter) -> None:
    """Raise ValueError unless the shutter has as many rows, or columns, as each camera."""
    arguments.check_type("rig", rig, StereoRig)
    arguments.check_type("shutter", shutter, RollingShutter)
    for side in SIDES:
        camera, axis = rig.sensor(side), shutter.axis(side)
        size, name = (camera.width, camera.height)[axis], ("columns", "rows")[axis]
        if shutter.lines(side) != size:
            field = "right_size" if shutter.right_size and side == "right" else ("width", "height")[axis]
            raise ValueError(
                f"shutter.{field} = {shutter.lines(side)}: must be that of the {side} camera, {size} {name}"
            )


def four_images(images: Sequence[NDArray[Any]], rig: StereoRig | None = None) -> dict[View, NDArray[Any]]:
    """Return the images left 0, right 0, left 1, right 1 as a mapping from side and frame.

    Raises:
        ValueError: there are not four, or they are not uint8 or uint16, differ in shape or type, or do not have
            the size of the rig's cameras.
    """
    if len(arguments.items("images", images)) != 4:
        raise ValueError(f"images: got {len(images)}; four are needed: left 0, right 0, left 1, right 1")
    views: dict[View, NDArray[Any]] = {}
    for (side, frame), image in zip(((s, f) for f in FRAMES for s in SIDES), images, strict=True):
        views[side, frame] = check_image(f"image {side} {frame}", image, rig, side)
    first = views["left", 0]
    for (side, frame), image in views.items():
        shape = first.shape if rig is None else (*views[side, 0].shape[:2], *first.shape[2:])
        if image.shape != shape or image.dtype != first.dtype:
            what = f"{image.dtype} {image.shape}, but image left 0 is {first.dtype} {first.shape}"
            raise ValueError(f"image {side} {frame}: is {what}; all must be alike")
    return views


def check_image(name: str, image: NDArray[Any], rig: StereoRig | None, side: Side = "left") -> NDArray[Any]:
    """Return the image; ValueError unless it is (H, W) or (H, W, 3), uint8 or uint16, of the camera's size."""
    if not isinstance(image, np.ndarray) or image.dtype not in _IMAGE_TYPES:
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{name}: must be an array of uint8 or uint16, got {kind}")
    if image.size == 0:
        raise ValueError(f"{name}: must have pixels, got shape {image.shape}")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[2] == 3):
        raise ValueError(f"{name}: must have shape (H, W) or (H, W, 3), got {image.shape}")
    camera = None if rig is None else rig.sensor(side)
    if camera is not None and image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]} x {image.shape[0]}"
        what = "rig's cameras" if rig is not None and rig.aligned else f"rig's {side} camera"
        raise ValueError(f"{name}: is {size} pixels, the {what} {camera.width} x {camera.height}")
    return image
