"""The interfaces of stereo matchers, and loading by name.

A ``StereoMatcher`` returns the disparity of a rectified pair, a ``MotionMatcher`` the depth of four images.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from rsbench.components import plugins
from rsbench.components.compiled import compiled
from rsbench.components.plugins import Entry, Kind, RunOptions
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import check_cameras_of, check_ideal
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.images import resample
from rsbench.vision.reprojection import distort, ideal_pixels_of, lens_table

_WIDEST = 2.0
"""Largest size of the level image, in sizes of the ideal image: farther out, the other camera gives no depth."""
_LARGEST, _SPARE, _CUT = 0.25, 0.12, 0.25
"""Shares of the ideal image's size: largest disparity for which the level image shows all that both cameras see;
margin around that, as the cameras may read it at different times; most that is cut off at each side."""
_ONE_SURFACE_PX = 1.0
"""Largest difference of neighbouring disparities between which is interpolated."""

F32 = NDArray[np.float32]
Cameras = Literal["ideal", "any", "rig"]


class StereoMatcher(ABC):
    """Dense disparity of the two images of one time; a frozen dataclass, whose fields a card may set."""

    @abstractmethod
    def disparities(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the disparity ``x_left - x_right`` (H, W), px, of the left and of the right image's pixels.

        Images are (H, W) or (H, W, 3) RGB. NaN is unknown; 0, and negative values due to noise, are infinitely
        far. A rolling-shutter pair is rectified too, as both cameras read a row at the same time. ``rig`` gives
        focal length and baseline to a matcher that limits its search.
        """

    def limited(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig, seen: Sequence[NDArray[np.bool_]]
    ) -> StereoMatcher:
        """Return this matcher with its search limited to the disparities of this pair; by default unchanged.

        Args:
            seen: for each image, a mask (H, W) of the pixels that its camera sees; others are black.
        """
        return self


class MotionMatcher(StereoMatcher):
    """Dense depth of all four images of two frames, by a motion that is known; a frozen dataclass likewise."""

    @property
    def cameras(self) -> Cameras:
        """Supported cameras, ``ideal`` (default), ``any`` or ``rig``, see ``CorrectorSpec``; no others."""
        return "ideal"

    @abstractmethod
    def depths(
        self, images: Mapping[View, NDArray[np.uint8]], rig: StereoRig, shutter: RollingShutter, motion: Motion
    ) -> Mapping[View, NDArray[Any]]:
        """Return the depth (H, W), metres, of each image, in the camera at the time of each line.

        Images are (H, W) or (H, W, 3) RGB, by side and frame. NaN is unknown, inf infinitely far. ``motion`` is
        that of the body over one frame period, in metres.
        """

    def depths_of(
        self,
        images: Mapping[View, NDArray[np.uint8]],
        rig: StereoRig,
        shutter: RollingShutter,
        motion: Motion,
        views: Sequence[View],
    ) -> dict[View, NDArray[Any]]:
        """Return the ``depths`` of some of the images.

        Override it if that is faster than computing all. It is not called for matchers of other packages, which
        run in separate processes.
        """
        found = self.depths(images, rig, shutter, motion)
        return {view: found[view] for view in views}

    @final
    def disparities(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Raise NotImplementedError, as one pair does not suffice."""
        raise NotImplementedError("needs four images and a motion")


MatcherEntry = Entry[StereoMatcher, RunOptions]
STEREO_MATCHERS: Kind[StereoMatcher, RunOptions] = Kind(
    singular="matcher", cards="matchers", base=StereoMatcher, options=RunOptions
)


def load_matcher(name_or_path: str | Path) -> MatcherEntry:
    """Load a stereo matcher by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: the matcher does not exist, two have this name, or its card or class is wrong.
    """
    return plugins.load_entry(STEREO_MATCHERS, name_or_path)


def find_disparities(
    entry: MatcherEntry, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
) -> tuple[F32, F32]:
    """Match a pair and check the result: two arrays (H, W), float32, finite or NaN.

    Raises:
        RsbenchError: the rig is not ideal, the matcher needs a motion or failed, or the result is wrong.
    """
    where = f"{STEREO_MATCHERS.singular} {entry.name!r}"
    check_ideal(rig, where)
    refuse_motion(entry, "one pair of images has none")
    with plugins.blame(STEREO_MATCHERS, entry):
        answer = entry.component.disparities(left, right, rig)
    if not isinstance(answer, tuple) or len(answer) != len(SIDES):
        raise RsbenchError(f"{where}: must return two arrays, left and right, got {type(answer).__name__}")
    first, second = (
        _checked(disparity, left.shape[:2], f"{where}: {side} disparity")
        for side, disparity in zip(SIDES, answer, strict=True)
    )
    return first, second


def needs_motion(entry: MatcherEntry) -> bool:
    """Whether the matcher needs a motion: use ``find_depths`` if so, else ``find_disparities``."""
    return isinstance(entry.component, MotionMatcher)


def refuse_motion(entry: MatcherEntry, why: str) -> None:
    """Raise RsbenchError if the matcher needs a motion; ``why`` is the reason why none is known."""
    if needs_motion(entry):
        raise RsbenchError(
            f"{STEREO_MATCHERS.singular} {entry.name!r}: needs the rig's motion, and {why}; "
            "take another, such as sgm"
        )


def find_depths(
    entry: MatcherEntry,
    images: Mapping[View, NDArray[np.uint8]],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    views: Sequence[View] | None = None,
) -> dict[View, F32]:
    """Find depth by a matcher that needs a motion, and check it: (H, W) float32, metres, positive, inf or NaN.

    ``views`` selects the images whose depth is returned; None: all.

    Raises:
        RsbenchError: the cameras are not supported, another package's matcher failed, or the result is wrong.
    """
    where, matcher = f"{STEREO_MATCHERS.singular} {entry.name!r}", entry.component
    assert isinstance(matcher, MotionMatcher)
    check_cameras_of(matcher.cameras, rig, shutter, where)
    with plugins.blame(STEREO_MATCHERS, entry):
        if views is None:
            answer = matcher.depths(images, rig, shutter, motion)
        else:
            answer = matcher.depths_of(images, rig, shutter, motion, views)
    wanted = images if views is None else views
    if not isinstance(answer, Mapping) or set(answer) != set(wanted):
        raise RsbenchError(f"{where}: must return the depth of each image, by {', '.join(map(str, wanted))}")
    return {view: _checked_depth(answer[view], images[view].shape[:2], f"{where}: {view}") for view in wanted}


def _checked_depth(depth: object, size: tuple[int, ...], where: str) -> F32:
    found = _floating(depth, size, where)
    if np.any(found <= 0.0):  # NaN is unknown
        raise RsbenchError(f"{where}: depth must be above 0 or NaN, got {np.nanmin(found)}")
    return found


def _floating(values: object, size: tuple[int, ...], where: str) -> F32:
    if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, np.floating):
        kind = values.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise RsbenchError(f"{where}: must be an array of floating point numbers, got {kind}")
    if values.shape != size:
        raise RsbenchError(f"{where}: must have the image's shape {size}, got {values.shape}")
    return np.asarray(values, dtype=np.float32)


def _checked(disparity: object, size: tuple[int, ...], where: str) -> F32:
    found = _floating(disparity, size, where)
    infinite = np.isinf(found)
    if np.any(infinite):
        raise RsbenchError(f"{where}: {np.count_nonzero(infinite)} values are infinite; NaN is unknown")
    known = found[~np.isnan(found)]
    if known.size and np.median(known) < 0.0:
        raise RsbenchError(f"{where}: is mostly below 0, such as {known.min()}; disparity is x_left - x_right")
    return found


def sensor_disparities(
    entry: MatcherEntry, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
) -> tuple[F32, F32]:
    """Call ``find_disparities`` for any cameras; disparities (H, W) are in ideal px, on the images' own pixels.

    The matcher gets a pair without distortion, of the size of ``widened``. Its disparities are interpolated at the
    pixels of the images; a disparity whose other end lies outside the other image is dropped.

    Raises:
        RsbenchError: see ``find_disparities``.
    """
    if rig.rectified:
        return find_disparities(entry, left, right, rig)
    level, places = replace(rig.ideal, camera=widened(rig)), [level_places(rig, side) for side in SIDES]
    levels = [resample(image, each) for image, each in zip((left, right), places, strict=True)]
    seen = [np.isfinite(each[..., 0]) for each in places]
    entry = replace(entry, component=entry.component.limited(levels[0], levels[1], level, seen))
    both = find_disparities(entry, levels[0], levels[1], level)
    first, second = (
        _with_partner(between_pixels(found, level_pixels(rig, side)), rig, side)
        for side, found in zip(SIDES, both, strict=True)
    )
    return first, second


def widened(rig: StereoRig) -> PinholeCamera:
    """Return the rig's ideal camera with an image large enough for all that both cameras see up to ``_LARGEST``.

    This limit of the disparity is increased for cameras that converge, by the disparity at the point where their
    axes meet. If the cameras are equal and aligned, the image contains all that they see.
    """
    return rig.camera if rig.rectified else _widened(rig)


@lru_cache(maxsize=4)
def _widened(rig: StereoRig) -> PinholeCamera:
    ideal = rig.camera.ideal
    if rig.aligned:
        grid = ideal.project(pixel_rays(rig, "left"))
        return _around(ideal, np.nanmin(grid, axis=(0, 1)), np.nanmax(grid, axis=(0, 1)), 0.0)
    lows, highs = list[FloatArray](), list[FloatArray]()
    for side in SIDES:
        rays = pixel_rays(rig, side)
        rim = np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1], rays[::8, ::8].reshape(-1, 3)])
        pixels = ideal.project(rim)
        lows.append(np.nanmin(pixels, axis=0))
        highs.append(np.nanmax(pixels, axis=0))
    (left, right), (left_end, right_end) = lows, highs
    size, apart = np.array([ideal.width, ideal.height]), 0.5 * (left + left_end - right - right_end)
    largest, spare = np.array([_LARGEST * ideal.width + max(apart[0], 0.0), 0.0]), _SPARE * size
    low = np.minimum(np.maximum(left, right), np.maximum(right, left - largest))
    high = np.maximum(np.minimum(left_end, right_end + largest), np.minimum(right_end, left_end))
    low, high = (
        np.maximum(low - spare, np.minimum(left, right)),
        np.minimum(high + spare, np.maximum(left_end, right_end)),
    )
    return _around(ideal, low, high, _CUT)


@lru_cache(maxsize=2 * len(SIDES))
def pixel_rays(rig: StereoRig, side: Side) -> FloatArray:
    """(H, W, 3) rays of all pixels of a camera, in the body's axes; the array is read-only."""
    camera = rig.sensor(side)
    if camera.lens is None:
        rays = rig.eye(side).unproject(camera.pixel_grid())
    else:  # its ideal pixels are cached
        rays = camera.ideal.unproject(ideal_pixels_of(camera)) @ rig.own(side).R
        rays = rays / np.where(rays[..., 2:] > 0.0, rays[..., 2:], np.nan)
    rays.setflags(write=False)
    return rays


@lru_cache(maxsize=2 * len(SIDES))
def level_pixels(rig: StereoRig, side: Side) -> FloatArray:
    """(H, W, 2) positions of all pixels of a camera in the level image, which is that of ``widened``."""
    shift = np.array([widened(rig).cx - rig.camera.cx, widened(rig).cy - rig.camera.cy])
    return rig.camera.ideal.project(pixel_rays(rig, side)) + shift


@lru_cache(maxsize=2 * len(SIDES))
def level_places(rig: StereoRig, side: Side) -> F32:
    """(h, w, 2) positions of all pixels of the level image in a camera's image; NaN outside."""
    wide = widened(rig)
    return _places(wide.unproject(wide.pixel_grid()), rig, side)


def camera_of_body(rig: StereoRig, side: Side) -> tuple[FloatArray, FloatArray]:
    """Matrix (3, 3) from rays in the body's axes to homogeneous ideal pixels of a camera, and ``lens_table`` (14,)
    of its lens, or of a lens without distortion."""
    camera = rig.sensor(side)
    return camera.ideal.K @ rig.own(side).R, lens_table(camera, camera.lens or Lens(model="brown-conrady"))


def _places(rays: FloatArray, rig: StereoRig, side: Side) -> F32:
    """Project rays (h, w, 3) in the body's axes to pixels (h, w, 2) of a camera; NaN outside its image."""
    places, camera = np.full((*rays.shape[:2], 2), np.nan, np.float32), rig.sensor(side)
    _fill_places(rays, *camera_of_body(rig, side), camera.width, camera.height, places)
    return places


@compiled(error_model="numpy", inline="always")
def seen_at(m: FloatArray, lens: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Project a point in the body's axes to a pixel, by the results of ``camera_of_body``; NaN if not visible."""
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
    s = 1.0 / depth if depth > 0.0 else np.nan
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) * s
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) * s
    return distort(lens, u, v)


@compiled(error_model="numpy")
def _fill_places(
    rays: FloatArray, turn: FloatArray, lens: FloatArray, width: int, height: int, places: F32
) -> None:
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            u, v = seen_at(turn, lens, rays[row, column, 0], rays[row, column, 1], rays[row, column, 2])
            if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                places[row, column, 0], places[row, column, 1] = u, v


@lru_cache(maxsize=4)
def own_depths(rig: StereoRig, side: Side) -> F32:
    """``StereoRig.own_depth`` (H, W) for all pixels of a camera."""
    return np.asarray(pixel_rays(rig, side) @ rig.own(side).R[2]).astype(np.float32)


def body_depth(depth: F32, rig: StereoRig, side: Side) -> F32:
    """Convert depth (H, W) along the camera's own axis to depth along the body's z axis."""
    return depth if rig.aligned else depth / own_depths(rig, side)


def _around(ideal: PinholeCamera, low: FloatArray, high: FloatArray, cut: float) -> PinholeCamera:
    """Extend or crop the ideal camera's image by whole pixels to those from ``low`` (2,) to ``high``. It becomes
    at most ``_WIDEST`` times as large, and at most the share ``cut`` is removed at each side."""
    size = np.array([ideal.width, ideal.height])
    least, spare = -np.floor(cut * size), np.floor((_WIDEST - 1.0) * 0.5 * size)
    low = np.clip(np.ceil(-low), least, spare).astype(int)
    high = np.clip(np.ceil(high - (size - 1)), least, spare).astype(int)
    width, height = (size + low + high).tolist()
    return replace(ideal, width=width, height=height, cx=ideal.cx + low[0], cy=ideal.cy + low[1])


def between_pixels(disparity: F32, places: FloatArray) -> F32:
    """Sample a disparity (H, W), px, at positions (..., 2): bilinear on one surface, else the nearest pixel."""
    out = np.full((1, places.size // 2), np.nan, np.float32)
    _fill_between(disparity, places.reshape(1, -1, 2), out)
    return out.reshape(places.shape[:-1])


@compiled(error_model="numpy")
def _fill_between(disparity: F32, places: FloatArray, out: F32) -> None:
    height, width = disparity.shape
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            u, v = places[row, column, 0], places[row, column, 1]
            if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                continue
            x, y = min(max(int(np.floor(u)), 0), width - 2), min(max(int(np.floor(v)), 0), height - 2)
            s, t = u - x, v - y
            a, b, c, d = disparity[y, x], disparity[y, x + 1], disparity[y + 1, x], disparity[y + 1, x + 1]
            if max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) <= _ONE_SURFACE_PX and a + b + c + d < np.inf:
                upper, lower = a + s * (b - a), c + s * (d - c)
                out[row, column] = upper + t * (lower - upper)
            elif t < 0.5:
                out[row, column] = a if s < 0.5 else b
            else:
                out[row, column] = c if s < 0.5 else d


def _with_partner(disparity: F32, rig: StereoRig, side: Side) -> F32:
    """Set disparities (H, W) to NaN if their corresponding pixel is outside the other camera's image."""
    sign, other = (1.0, SIDES[1]) if side == "left" else (-1.0, SIDES[0])
    rays = pixel_rays(rig, side).copy()
    rays[..., 0] -= sign / rig.camera.fx * disparity
    return np.where(np.isfinite(_places(rays, rig, other)[..., 0]), disparity, np.float32(np.nan))
