"""Rigs of two calibrated cameras as tables: ``[left]``, ``[right]``, ``[right_from_left]`` of rig.toml and cards.

A card in ``cards/rigs/`` is such a rig under a name, with its source.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from rsbench.components.cards import SHUTTER_KEY, card_path, parse_card, read_toml, with_shutter
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import StatedShutter
from rsbench.core.so3 import FloatArray

Size = tuple[int, int]
_OF_IMAGE = ("width", "height", "fx", "fy", "cx", "cy")
_MOST = 4.0
"""Largest ``rig_scale``."""
Vector = tuple[float, float, float]
_DIGITS = 1e-2
"""Share by which printed line delays may exceed a frame period."""
_READOUT_KEYS = {
    **SHUTTER_KEY,
    "readout_ratio": "Readout time over frame period of this camera, 0 to 1.",
    "line_delay_s": "Seconds from a line to the next, in place of ``readout_ratio``; needs the size and "
    "``frame_period_s``.",
    "scan": "Side of the image at which the readout of this camera begins.",
    "delay_s": "Seconds by which this camera reads later than the other one.",
}
"""Shorthands of ``CameraTable`` that ``with_readouts`` replaces."""


@dataclass(frozen=True, kw_only=True)
class CameraTable:
    """One camera of a rig; the centre of the top-left pixel is (0, 0)."""

    SHORTHANDS: ClassVar = _READOUT_KEYS

    width: int | None = None
    """Width of the images, pixels. Absent: that of the frames."""
    height: int | None = None
    """Height of the images, pixels. Absent: that of the frames."""
    fx: float
    """Focal length across, pixels."""
    fy: float
    """Focal length down, pixels."""
    cx: float
    """Column of the principal point, pixels."""
    cy: float
    """Row of the principal point, pixels."""
    lens: Lens | None = None
    """Distortion of the lens. Absent: images without distortion."""

    @property
    def size(self) -> Size | None:
        """(width, height); None where the frames decide."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    def camera(self, size: Size | None = None) -> PinholeCamera:
        """The camera, of images of this size (width, height).

        Raises:
            ValueError: no size or two, or a lens that cannot be one of such images.
        """
        width, height = size or (self.width, self.height)
        if width is None or height is None:
            raise ValueError("width and height are required")
        if (self.width or width, self.height or height) != (width, height):
            raise ValueError(
                f"width, height = {self.width}, {self.height}: the frames are {width} x {height}; give the "
                "calibration of that size, or rsbench rig --resize where frames were scaled, not cropped"
            )
        return PinholeCamera(
            width=width, height=height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy, lens=self.lens
        )


@dataclass(frozen=True, kw_only=True)
class RightFromLeft:
    """``X_right = R X_left + t``, as OpenCV's stereoCalibrate and Kalibr's T_cn_cnm1 have it.

    R is one of ``rotation``, ``quaternion_wxyz`` and ``rotation_deg``; without any the cameras look the same way.
    """

    translation: Vector
    """t, metres."""
    rotation: tuple[Vector, Vector, Vector] | None = None
    """R, row by row."""
    quaternion_wxyz: tuple[float, float, float, float] | None = None
    """R as a quaternion, the real part first."""
    rotation_deg: Vector | None = None
    """R as three angles, degrees: R = Rz Ry Rx of (x, y, z)."""

    def __post_init__(self) -> None:
        named = [name for name in ("rotation", "quaternion_wxyz", "rotation_deg") if getattr(self, name)]
        if len(named) > 1:
            raise ValueError(f"{named[0]} and {named[1]} exclude each other")
        if self.quaternion_wxyz is not None and abs(np.linalg.norm(self.quaternion_wxyz) - 1.0) > 1e-3:
            raise ValueError(f"quaternion_wxyz = {list(self.quaternion_wxyz)}: must have the length 1")

        R, t = self.R, np.array(self.translation)
        place = -(R.T @ t)
        if place[0] - t[0] < -np.linalg.norm(t):  # of at most twice that: each sees the other on its wrong side
            raise ValueError(
                f"the right camera would stand {abs(place[0]):.4g} m to the left of the left one: exchange the "
                "cameras and their frames, or invert the transform, which is X_right = R X_left + t"
            )

    @property
    def R(self) -> FloatArray:
        """Rotation matrix (3, 3), as given."""
        if self.rotation is not None:
            return np.array(self.rotation)
        if self.quaternion_wxyz is not None:
            w, *v = np.array(self.quaternion_wxyz) / np.linalg.norm(self.quaternion_wxyz)
            V = so3.hat(v)
            return np.eye(3) + 2.0 * (w * V + V @ V)
        turns = np.deg2rad(self.rotation_deg or (0.0, 0.0, 0.0))
        about_x, about_y, about_z = so3.exp(np.diag(turns))
        return about_z @ about_y @ about_x


def rig_of_tables(
    left: CameraTable,
    right: CameraTable,
    right_from_left: RightFromLeft,
    sizes: Mapping[Side, Size] | None = None,
) -> StereoRig:
    """Make the rig from its tables; ``sizes`` gives (width, height) of the frames, if known.

    Raises:
        ValueError: one line with the table and the problem.
    """
    cameras = []
    for side, table in zip(SIDES, (left, right), strict=True):
        try:
            cameras.append(table.camera(None if sizes is None else sizes[side]))
        except ValueError as error:
            raise ValueError(f"{side}: {error}") from error
    try:
        return StereoRig.of_cameras(cameras[0], cameras[1], right_from_left.R, right_from_left.translation)
    except ValueError as error:
        raise ValueError(f"right_from_left: {error}") from error


def with_readouts(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Convert readout keys of ``[left]`` and ``[right]`` in a rig's table to those of ``StatedShutter``.

    ``readout_ratio``, ``shutter`` and ``scan`` of the rig apply to both cameras, unless a camera has its own
    value. The difference of the cameras' ``delay_s``, right minus left, becomes ``right_delay``, in frame periods.

    Raises:
        RsbenchError: one line with ``where``, the key and the problem.
    """
    made = with_shutter(table, where)
    cameras = {side: dict(made[side]) for side in SIDES if isinstance(made.get(side), dict)}
    if len(cameras) < len(SIDES):
        return made
    for side, camera in cameras.items():
        if "shutter" in camera:
            period = {key: made[key] for key in ("frame_period_s",) if key in made}
            cameras[side] = with_shutter(camera | period, f"{where}: {side}")
            made["frame_period_s"] = cameras[side].pop("frame_period_s")
        if "line_delay_s" in cameras[side]:
            cameras[side]["readout_ratio"] = _ratio_of_lines(cameras[side], made, f"{where}: {side}")
    for key in ("readout_ratio", "scan"):
        both = made.pop(key, None)
        left = cameras["left"].pop(key, both)
        right = cameras["right"].pop(key, made.pop(f"right_{key}", both))
        made |= {} if left is None else {key: left}
        made |= {} if right in (left, None) else {f"right_{key}": right}
    delays = [camera.pop("delay_s", 0.0) for camera in cameras.values()]
    if any(delays):
        period = made.get("frame_period_s")
        if "right_delay" in made or not isinstance(period, int | float) or not period > 0.0:
            raise RsbenchError(f"{where}: delay_s: needs frame_period_s, and excludes right_delay")
        if not all(isinstance(delay, int | float) for delay in delays):
            raise RsbenchError(f"{where}: delay_s = {delays}: must be seconds")
        made["right_delay"] = (delays[1] - delays[0]) / period
    return made | cameras


def _ratio_of_lines(camera: dict[str, Any], rig: Mapping[str, Any], where: str) -> float:
    """Return the readout ratio from ``line_delay_s``, removing it from the table; may raise RsbenchError."""
    delay, period = camera.pop("line_delay_s"), rig.get("frame_period_s")
    count = camera.get("height" if camera.get("scan", rig.get("scan")) in (None, "top", "bottom") else "width")
    numbers = [each for each in (delay, period, count) if isinstance(each, int | float)]
    if "readout_ratio" in camera or len(numbers) < 3:
        raise RsbenchError(
            f"{where}: line_delay_s: needs width, height and frame_period_s; readout_ratio and shutter exclude it"
        )
    delay, period, count = numbers
    ratio = delay * count / period if period > 0.0 else math.inf
    if not 0.0 <= ratio <= 1.0 + _DIGITS:
        raise RsbenchError(
            f"{where}: line_delay_s = {delay}: {count} lines would take {ratio:.4g} frame periods, and 1 is most"
        )
    return round(min(ratio, 1.0), 12)  # rounded, so that rounding errors do not make two cameras differ


@dataclass(frozen=True, kw_only=True)
class RigTables(StatedShutter):
    """A calibrated rig: a card in ``cards/rigs/``, or the table ``rig`` of a dataset card."""

    SHORTHANDS: ClassVar = SHUTTER_KEY

    description: str = ""
    """Cameras and mode, for ``rsbench list rigs``."""
    source: str = ""
    """Where the calibration comes from."""
    left: CameraTable
    """The left camera."""
    right: CameraTable
    """The right camera; above or below the left one in a vertical rig."""
    right_from_left: RightFromLeft
    """Position and orientation of the right camera relative to the left one."""
    frame_period_s: float | None = None
    """Seconds from one frame to the next, if known for the rig."""

    def __post_init__(self) -> None:
        self.rig()

    def rig(self) -> StereoRig:
        """Make the rig; may raise ValueError, see ``rig_of_tables``."""
        return rig_of_tables(self.left, self.right, self.right_from_left)


def read_rig_table(name_or_path: str) -> dict[str, Any]:
    """Read the tables of a rig card, given by name or path, in the form that ``RigTables`` takes.

    Raises:
        RsbenchError: the card does not exist or is invalid.
    """
    path = card_path("rigs", name_or_path)
    table = with_readouts(read_toml(path), str(path))
    parse_card(RigTables, table, str(path))
    return table


def load_rig(name_or_path: str) -> RigTables:
    """Load a rig card by name or path; may raise RsbenchError, see ``read_rig_table``."""
    return parse_card(RigTables, read_rig_table(name_or_path), str(card_path("rigs", name_or_path)))


RIG_KEY = {
    "left": "The left camera of a rig whose cameras differ, with ``right`` and ``right_from_left``, in place of "
    "``rig``.",
    "right": "The right camera.",
    "right_from_left": "Where the right camera is, and how it is turned.",
    "rig_scale": "Size of the images over that of the calibration: 0.5 for half as many columns and rows of the "
    "same rig.",
}
"""Shorthands of tables in which ``with_rig`` replaces these keys."""


def with_rig(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace the rig in a table of a card, given by name or by tables, by a table ``rig`` for ``RigTables``.

    Raises:
        RsbenchError: both are given, the rig card does not exist, there is a scale without a rig, or see
            ``with_readouts``.
    """
    made = {key: value for key, value in table.items() if key not in RIG_KEY}
    own = {key: table[key] for key in RIG_KEY if key in table}
    scale = own.pop("rig_scale", None)
    if own:
        if "rig" in made:
            raise RsbenchError(f"{where}: rig and {next(iter(own))} exclude each other; leave one out")
        made["rig"] = own
    rig = made.get("rig")
    if isinstance(rig, str):
        made["rig"] = read_rig_table(rig)
    elif isinstance(rig, dict):
        period = {key: made[key] for key in ("frame_period_s",) if key in made}
        made["rig"] = with_readouts(period | rig, where)
    if scale is not None:
        known = isinstance(made.get("rig"), dict) and isinstance(scale, int | float)
        if not known or not 0.0 < scale <= _MOST:
            raise RsbenchError(
                f"{where}: rig_scale = {scale}: must be above 0 and at most {_MOST:g}, beside a rig"
            )
        made["rig"] = made["rig"] | {side: resized(made["rig"].get(side), scale) for side in SIDES}
    return made


def resized(camera: Any, scale: float) -> Any:
    """Return a camera's table for scaled images, whose size is rounded; return anything else unchanged.

    The outer borders of the image are kept: a pixel at x moves to (x + 1/2) s - 1/2.
    """
    if not isinstance(camera, dict) or any(not isinstance(camera.get(key), int | float) for key in _OF_IMAGE):
        return camera
    made = dict(camera)
    for size, focal, centre in (("width", "fx", "cx"), ("height", "fy", "cy")):
        made[size] = max(1, round(scale * camera[size]))
        s = made[size] / camera[size]
        made |= {focal: s * camera[focal], centre: s * (camera[centre] + 0.5) - 0.5}
    return made


def tables_of(rig: StereoRig) -> dict[str, Any]:
    """Return the tables ``left``, ``right`` and ``right_from_left`` of a rig, for rig.toml and manifests."""
    R, t = rig.right_from_left
    return {
        **{side: camera_record(rig.sensor(side)) for side in SIDES},
        "right_from_left": {"rotation": R.tolist(), "translation": t.tolist()},
    }


def camera_record(camera: PinholeCamera) -> dict[str, Any]:
    """Return a camera for JSON: size and intrinsics, px, and its lens if it has one."""
    own: dict[str, Any] = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return own if camera.lens is None else own | {"lens": camera.lens.record()}
