"""The pictures of a sequence: their names, poses and times, and projection between them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core.geometry import FixedGeometry, Geometry, RelativeMotion
from rsbench.core.projection import back_project, rs_project_near
from rsbench.core.rig import FRAMES, SIDES, Side
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.layout import SHUTTERS, Shutter, exposed_file, gloss_file, moving_file, picture_file

_NEAREST = 32
FAR = 1e7
"""Where the sky is looked for, metres: no motion of a rig moves it by a hundredth of a pixel."""


def seen_from(geometry: Geometry, number: int) -> FixedGeometry:
    """How the rig moves seen from an object, in whose frame the object's points stand still; 0: from the world."""
    motion = RelativeMotion(geometry.motion, geometry.objects[number - 1]) if number else geometry.motion
    return FixedGeometry(geometry.rig, geometry.shutter, motion, geometry.frames)


class ImageView(NamedTuple):
    """One camera at one time, through a rolling shutter or a global one."""

    shutter: Shutter
    side: Side
    frame: int
    row: int = 0
    """Of a global shutter: the row whose pose it has, counted as they are read."""

    @property
    def image(self) -> str:
        """File below the folder of the sequence, as ``depth`` is."""
        return picture_file(*self)

    @property
    def depth(self) -> str:
        return picture_file(*self, depth=True)

    @property
    def labels(self) -> str:
        """Of what moves by itself, where anything does."""
        return moving_file(*self)

    @property
    def gloss(self) -> str:
        """Of glossy surfaces, where any is."""
        return gloss_file(*self)

    @property
    def exposed(self) -> str:
        """Of a global shutter as the sensor exposes it, where the dataset has that."""
        return exposed_file(*self[1:])

    @property
    def other_shutter(self) -> ImageView:
        return self._replace(shutter="gs" if self.shutter == "rs" else "rs")

    @property
    def other_side(self) -> ImageView:
        return self._replace(side="right" if self.side == "left" else "left")

    def next_frame(self, frames: int) -> ImageView:
        """At the next time, of so many; of the last one, at the time before."""
        return self._replace(frame=self.frame + (1 if self.frame < frames - 1 else -1))

    @property
    def frame_before(self) -> ImageView:
        return self._replace(frame=self.frame - 1)

    def partners(self) -> Iterator[ImageView]:
        """Those that see most of the same: of the other shutter, the other camera, the time after and before.

        The last two need not be there.
        """
        after = self._replace(frame=self.frame + 1)
        yield from (self.other_shutter, self.other_side, after, self.frame_before)


Times = tuple[int, int]
"""Numbers of two successive frames."""


def image_views(times: Iterable[int]) -> tuple[ImageView, ...]:
    """All pictures of these frames, but for twins of later rows."""
    return tuple(ImageView(*each) for each in product(SHUTTERS, SIDES, times))


def view_pairs(times: Times) -> tuple[tuple[ImageView, ImageView], ...]:
    """Each view of two frames against its three partners."""
    both = image_views(times)
    return tuple((source, target) for source in both for target in source.partners() if target in both)


def nearby_views(view: ImageView, frames: int) -> list[ImageView]:
    """Other views of a sequence of so many frames, the nearest in time first; of long ones not all."""
    times = sorted(range(frames), key=lambda frame: abs(frame - view.frame))[:_NEAREST]
    return [each for time in times for each in image_views((time,)) if each != view]


IMAGE_VIEWS, VIEW_PAIRS = image_views(FRAMES), view_pairs(FRAMES)
"""Of a sequence of two frames."""


class Seen(NamedTuple):
    """Where and when a view sees points (...); NaN where it does not."""

    pixels: FloatArray
    """(..., 2) px."""
    depth: FloatArray
    """(...) z in the camera of that time, metres."""
    tau: FloatArray
    """(...) frame periods."""


def points_of(geometry: Geometry, view: ImageView, pixels: FloatArray, depth: FloatArray) -> FloatArray:
    """World points (..., 3) that a view sees at pixels (..., 2) with depth (...)."""
    rig, shutter, motion = geometry.rig, geometry.shutter, geometry.motion
    if view.shutter == "gs":
        x_in_cam = depth[..., None] * rig.camera.unproject(pixels)
        return transform(inverse(_pose(geometry, view)), x_in_cam)
    return back_project(rig, shutter, motion, view.side, view.frame, pixels, depth)


def seen_by(geometry: Geometry, view: ImageView, X: FloatArray, rows: ArrayLike) -> Seen:
    """Where a view sees world points (..., 3); ``rows`` (...) are guesses, of columns where it reads those."""
    rig, shutter, motion = geometry.rig, geometry.shutter, geometry.motion
    if view.shutter == "rs":
        found = rs_project_near(rig, shutter, motion, view.side, view.frame, X, rows)
        return Seen(found.pixels, found.depth, found.tau)
    x_in_cam = transform(_pose(geometry, view), X)
    pixels = rig.camera.project(x_in_cam)
    outside = ~rig.camera.contains(pixels)
    pixels[outside] = np.nan
    tau = np.broadcast_to(_time(geometry, view), outside.shape)
    return Seen(pixels, np.where(outside, np.nan, x_in_cam[..., 2]), np.where(outside, np.nan, tau))


def times_at(geometry: Geometry, view: ImageView, pixels: FloatArray) -> FloatArray:
    """Times (...) at which a view sees pixels (..., 2), frame periods; the frame's own for NaN."""
    if view.shutter == "gs":
        return np.broadcast_to(_time(geometry, view), pixels.shape[:-1])
    tau = geometry.shutter.pixel_time(pixels, view.frame, view.side)
    return np.where(np.isnan(tau), float(view.frame), tau)


def _time(geometry: Geometry, view: ImageView) -> FloatArray:
    return geometry.shutter.time_after(view.row, view.frame, view.side)


def _pose(geometry: Geometry, view: ImageView) -> Pose:
    return geometry.rig.cam_from_world(geometry.motion, _time(geometry, view), view.side)


def image_seed(seed: int, sequence: str, side: Side, frame: int) -> int:
    """Independent noise per image; rolling- and global-shutter twins share it, so that row 0 is the same."""
    text = f"{seed}/{sequence}/{side}/{frame}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")
