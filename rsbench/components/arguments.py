"""Checks of the arguments of public functions: one line with the argument, its value and what may be."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import given
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, StereoRig, View
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_LONGEST_PATH = 4096
_IMAGE_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16))


def check_times(readout_ratio: float | None, target_row: float, rig: StereoRig) -> None:
    """Raises ValueError unless the ratio (None: unknown) and the row of an image are in their ranges."""
    if readout_ratio is not None:
        given.check_number("readout_ratio", readout_ratio, 0.0, 1.0)
    given.check_number("target_row", target_row, 0.0, rig.camera.height - 1.0)


def gyro_samples(samples: ArrayLike | None) -> FloatArray | None:
    """Samples (n, 4) as ``Correspondences`` has them; raises ValueError as it does."""
    return None if samples is None else Correspondences(gyro=given.real_array("gyro", samples)).gyro


def check_ranges(component: object, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Raises ValueError unless the numbers of these names lie from the first to the second; None may be."""
    for name, (least, most) in ranges.items():
        value = getattr(component, name)
        if value is not None and not least <= value <= most:
            raise ValueError(f"{name} = {value!r}: must lie in [{least:g}, {most:g}]")


def check_ideal(rig: StereoRig, what: str) -> None:
    """Raises RsbenchError where cameras have a lens, which ``what`` does not take."""
    if rig.camera.lens is not None:
        raise RsbenchError(
            f"camera.lens = {rig.camera.lens.model!r}: {what} takes images without distortion; undistort first"
        )


def check_plain(rig: StereoRig, shutter: RollingShutter, what: str) -> None:
    """Raises RsbenchError for cameras with a lens or another scan, which ``what`` does not take."""
    check_ideal(rig, what)
    if not shutter.plain:
        s = shutter.scanning
        raise RsbenchError(
            f"scan = {s.scan!r}, right_scan = {s.right_scan!r}, right_delay = {s.right_delay}: {what} takes rows "
            "from the top, read by both cameras at once"
        )


def check_view(side: str, frame: int) -> None:
    """Raises ValueError unless there is such a side, and may be such a frame."""
    given.check_one_of("side", side, SIDES)
    given.check_whole("frame", frame, 0, given.LARGEST_SIZE)


def check_motion(rig: StereoRig, motion: Motion) -> None:
    """Raises ValueError unless they are what they are called."""
    given.check_type("rig", rig, StereoRig)
    given.check_type("motion", motion, Motion)


def check_moving_rig(rig: StereoRig, shutter: RollingShutter, motion: Motion) -> None:
    """Raises ValueError unless they are what they are called, and the shutter is of the rig's cameras."""
    check_rows(rig, shutter)
    check_motion(rig, motion)


def check_rows(rig: StereoRig, shutter: RollingShutter) -> None:
    """Raises ValueError unless the shutter reads as many rows and columns as the cameras have."""
    given.check_type("rig", rig, StereoRig)
    given.check_type("shutter", shutter, RollingShutter)
    if shutter.width not in (None, rig.camera.width):
        raise ValueError(
            f"shutter.width = {shutter.width}: must be that of the camera, {rig.camera.width} columns"
        )
    if shutter.height != rig.camera.height:
        raise ValueError(
            f"shutter.height = {shutter.height}: must be that of the camera, {rig.camera.height} rows"
        )


def world_points(points: ArrayLike) -> FloatArray:
    """Points (..., 3) as float64; raises ValueError on another shape, and on numbers that no scene has."""
    array = given.real_array("points", points)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"points: must have shape (..., 3), got {array.shape}")
    far = np.abs(array) > given.LARGEST_M  # NaN is no point, and seen by nobody
    if np.any(far):
        raise ValueError(f"points: must lie within {given.LARGEST_M:g} m, got {array[far][0]:g}")
    return array


def four_images(images: Sequence[NDArray[Any]], rig: StereoRig | None = None) -> dict[View, NDArray[Any]]:
    """Images left 0, right 0, left 1, right 1 by side and frame.

    Raises:
        ValueError: not four, not uint8 or uint16, not alike, or not of the size of the rig's cameras.
    """
    if len(items("images", images)) != 4:
        raise ValueError(f"images: got {len(images)}; four are needed: left 0, right 0, left 1, right 1")
    views: dict[View, NDArray[Any]] = {}
    for (side, frame), image in zip(((s, f) for f in FRAMES for s in SIDES), images, strict=True):
        views[side, frame] = check_image(f"image {side} {frame}", image, rig)
    first = views["left", 0]
    for (side, frame), image in views.items():
        if image.shape != first.shape or image.dtype != first.dtype:
            what = f"{image.dtype} {image.shape}, but image left 0 is {first.dtype} {first.shape}"
            raise ValueError(f"image {side} {frame}: is {what}; all must be alike")
    return views


def check_image(name: str, image: NDArray[Any], rig: StereoRig | None) -> NDArray[Any]:
    """The image; raises ValueError unless it is (H, W) or (H, W, 3), uint8 or uint16, of the cameras' size."""
    if not isinstance(image, np.ndarray) or image.dtype not in _IMAGE_TYPES:
        kind = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        raise ValueError(f"{name}: must be an array of uint8 or uint16, got {kind}")
    if image.size == 0:
        raise ValueError(f"{name}: must have pixels, got shape {image.shape}")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[2] == 3):
        raise ValueError(f"{name}: must have shape (H, W) or (H, W, 3), got {image.shape}")
    if rig is not None and image.shape[:2] != (rig.camera.height, rig.camera.width):
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"{name}: is {size} pixels, the rig's cameras {rig.camera.width} x {rig.camera.height}")
    return image


def items(name: str, value: Any) -> Any:
    """What has a length and can be indexed; raises ValueError on anything else, a text included."""
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if not listed and not (isinstance(value, np.ndarray) and value.ndim > 0):
        raise ValueError(f"{name}: must be a list, got {given.shown(value)}")
    return value


def path(name: str, value: Any) -> Path:
    """A path; raises ValueError on what is none, or is longer than a system takes."""
    return Path(name_or_path(name, value))


def name_or_path(name: str, value: Any) -> str | Path:
    """The name of a component or the path of its card; raises ValueError on what is neither."""
    text = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(text, str) or "\0" in text or not 0 < len(text) <= _LONGEST_PATH:
        raise ValueError(f"{name} = {given.shown(value)}: must be a name or a path")
    return value if isinstance(value, str | Path) else text


def names(name: str, value: Any) -> tuple[str, ...]:
    """One name or many; raises ValueError on anything else."""
    found = (value,) if isinstance(value, str) else value
    if not isinstance(found, Iterable) or isinstance(found, Mapping):
        raise ValueError(f"{name}: must be names, got {given.shown(value)}")
    return tuple(str(name_or_path(name, each)) for each in found)
