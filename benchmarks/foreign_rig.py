"""Rigs of any two cameras for ``foreign_frames.py``, and the files that describe them: no code of rsbench.

A calibration says ``X_right = R X_left + t``. The body's axes are those of the rectified pair: x from the left to
the right centre of projection, z the mean of both viewing directions made orthogonal to x; its origin is the
middle between both centres. Lenses are OpenCV's: k1, k2, p1, p2, k3, and k1 to k4 of a fisheye.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from foreign_motion import Array, Law
from foreign_world import Image
from scipy.spatial.transform import Rotation

SIDES = ("left", "right")
FRAME_SECONDS = 1 / 30
BROWN, KANNALA = "brown-conrady", "kannala-brandt"
NAMES = {BROWN: ("k1", "k2", "p1", "p2", "k3"), KANNALA: ("k1", "k2", "k3", "k4")}
_STEPS = 25
"""Of Newton's method, at most."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Intrinsics, pixels, and how lines are read."""

    width: int = 640
    height: int = 480
    fx: float = 520.0
    fy: float = 520.0
    shift: tuple[float, float] = (0.0, 0.0)
    """Of the principal point from the middle of the image."""
    lens: str = BROWN
    coefficients: tuple[float, ...] = ()
    """In the order of ``NAMES``; none of a camera without distortion."""
    ratio: float = 0.8
    """Readout time over frame period."""
    scan: str = "top"
    """Where reading begins."""
    delay: float = 0.0
    """Frame periods by which the first line is late."""

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point."""
        return (self.width - 1) / 2 + self.shift[0], (self.height - 1) / 2 + self.shift[1]

    @property
    def focal(self) -> float:
        return float(np.sqrt(self.fx * self.fy))

    @property
    def rows(self) -> bool:
        """Whether rows are read, not columns."""
        return self.scan in ("top", "bottom")

    def times(self, frame: int) -> Array:
        """Times (lines,) of the lines from the top or the left."""
        lines = self.height if self.rows else self.width
        order = np.arange(lines) if self.scan in ("top", "left") else np.arange(lines)[::-1]
        return self.start(frame) + self.ratio * order / lines

    def start(self, frame: int) -> Array:
        """The time (1,) of the first line."""
        return np.array([frame + self.delay])


@dataclass(frozen=True)
class Rays:
    """Of the samples of an image: x / z (rows or 1, columns) and y / z (rows, columns or 1); NaN where none is."""

    x: Image
    y: Image
    blur: Image | float = 0.0
    """Levels of detail by which a sample covers more than one in the middle."""


@lru_cache(maxsize=4)
def rays(camera: Camera, samples: int) -> Rays:
    """Of ``samples`` by ``samples`` points of every pixel, spread evenly over it."""
    column, row = (
        ((np.arange(size * samples) + 0.5) / samples - 0.5 - middle) / focal
        for size, middle, focal in zip(
            (camera.width, camera.height), camera.centre, (camera.fx, camera.fy), strict=True
        )
    )
    x, y = column[None, :], row[:, None]
    if not any(camera.coefficients):
        return Rays(x.astype(np.float32), y.astype(np.float32))
    undistort = _undistort_brown if camera.lens == BROWN else _undistort_kannala
    x, y = np.broadcast_arrays(x, y)
    x, y = undistort(x, y, padded(camera))
    (x_by_row, x_by_column), (y_by_row, y_by_column) = np.gradient(x), np.gradient(y)
    area = np.abs(x_by_column * y_by_row - x_by_row * y_by_column) * camera.fx * camera.fy * samples**2
    blur = 0.5 * np.log2(np.maximum(area, 1e-12))
    return Rays(x.astype(np.float32), y.astype(np.float32), blur.astype(np.float32))


def padded(camera: Camera) -> Array:
    """All coefficients of the lens, in the order of ``NAMES``."""
    return np.array([*camera.coefficients, *[0.0] * (len(NAMES[camera.lens]) - len(camera.coefficients))])


def _undistort_brown(u: Array, v: Array, k: Array) -> tuple[Array, Array]:
    """Newton's method for both coordinates, from the distorted ones; NaN where it ends elsewhere."""
    k1, k2, p1, p2, k3 = k
    x, y = u.copy(), v.copy()
    for _ in range(_STEPS):
        s = x * x + y * y
        gain = 1.0 + s * (k1 + s * (k2 + s * k3))
        slope = 2.0 * (k1 + s * (2.0 * k2 + s * 3.0 * k3))
        a = x * gain + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) - u
        b = y * gain + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y - v
        if max(np.max(np.abs(a)), np.max(np.abs(b))) < 1e-13:
            break
        a_x = gain + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        b_y = gain + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        both = slope * x * y + 2.0 * (p1 * x + p2 * y)
        determinant = a_x * b_y - both * both
        x, y = x - (b_y * a - both * b) / determinant, y - (a_x * b - both * a) / determinant
    found = (np.abs(a) < 1e-9) & (np.abs(b) < 1e-9)
    return np.where(found, x, np.nan), np.where(found, y, np.nan)


def _undistort_kannala(u: Array, v: Array, k: Array) -> tuple[Array, Array]:
    """Newton's method for the angle from the axis; NaN from 85 deg on."""
    radius = np.hypot(u, v)
    angle = radius.copy()
    for _ in range(_STEPS):
        s = angle * angle
        bent = angle * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
        slope = 1.0 + s * (3.0 * k[0] + s * (5.0 * k[1] + s * (7.0 * k[2] + s * 9.0 * k[3])))
        angle = angle - (bent - radius) / slope
    gain = np.where(angle < np.radians(85.0), np.tan(angle), np.nan) / np.maximum(radius, 1e-12)
    return u * gain, v * gain


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Two cameras fixed to each other."""

    left: Camera
    right: Camera
    R: Array = field(default_factory=lambda: np.eye(3))
    """(3, 3) of ``X_right = R X_left + t``."""
    t: Array = field(default_factory=lambda: np.array([-0.2, 0.0, 0.0]))
    """(3,), metres."""

    def camera(self, side: str) -> Camera:
        return self.left if side == "left" else self.right

    @property
    def baseline(self) -> float:
        return float(np.linalg.norm(self.t))

    @property
    def aligned(self) -> bool:
        """Whether the cameras are equal, but for how they read, and see along the body's axes."""
        left, right = ((c.width, c.height, c.fx, c.fy, c.centre, c.lens, c.coefficients) for c in self._pair)
        return left == right and np.array_equal(self.R, np.eye(3)) and not np.any(self.t[1:])

    @property
    def _pair(self) -> tuple[Camera, Camera]:
        return self.left, self.right

    def body_from_left(self) -> Array:
        """Rows (3, 3) are the body's axes in the left camera."""
        across = -self.R.T @ self.t / self.baseline
        forward = np.array([0.0, 0.0, 1.0]) + self.R[2]
        forward = forward - (forward @ across) * across
        forward = forward / np.linalg.norm(forward)
        return np.stack([across, np.cross(forward, across), forward])

    def poses(self, law: Law, side: str, tau: Array) -> tuple[Array, Array]:
        """``X_camera = R X_world + t`` (n, 3, 3), (n, 3) of a camera in its own axes."""
        turn = self.body_from_left().T
        turn = turn if side == "left" else self.R @ turn
        R, t = law.body(tau)
        return turn @ R, (t + np.array([0.5 if side == "left" else -0.5, 0.0, 0.0]) * self.baseline) @ turn.T


def equal(
    *,
    ratio: float,
    scans: tuple[str, str] = ("top", "top"),
    k1: float = 0.0,
    width: int = 640,
    height: int = 480,
    focal: float = 520.0,
) -> Rig:
    """Two equal cameras in perfect alignment."""
    left, right = (
        Camera(width=width, height=height, fx=focal, fy=focal, coefficients=(k1,), ratio=ratio, scan=scan)
        for scan in scans
    )
    return Rig(left=left, right=right)


def loosened(rig: Rig, rng: np.random.Generator) -> Rig:
    """The rig as a loose calibration has it: off by 0.2 deg, 0.1 deg of the baseline's direction, and 0.5 %."""
    turn, lean = (Rotation.from_rotvec(np.radians(rng.normal(0.0, s, 3))).as_matrix() for s in (0.2, 0.1))
    left, right = (
        replace(c, fx=c.fx * longer, fy=c.fy * longer)
        for c, longer in zip(rig._pair, np.exp(rng.normal(0.0, 0.005, 2)), strict=True)
    )
    return Rig(left=left, right=right, R=turn @ rig.R, t=lean @ rig.t)


def turned(x: float, y: float, z: float) -> Array:
    """Rz Ry Rx of angles in degrees."""
    return np.asarray(Rotation.from_euler("xyz", [x, y, z], degrees=True).as_matrix())


def short_card(rig: Rig, told: bool) -> str:
    """An aligned rig as ``rsbench correct --rig`` takes it."""
    c = rig.left
    shutter = f'readout_ratio = {c.ratio}\nscan = "{c.scan}"\nright_scan = "{rig.right.scan}"\n'
    return f"baseline = {rig.baseline}\n{shutter if told else ''}[camera]\n{_intrinsics(c)}"


def card(rig: Rig, told: bool) -> str:
    """Any rig as ``rsbench correct --rig`` takes it."""
    period = f"frame_period_s = {FRAME_SECONDS}\n" if told else ""
    cameras = "".join(
        f"[{side}]\n{_intrinsics(rig.camera(side))}{_reading(rig.camera(side)) if told else ''}" for side in SIDES
    )
    rotation = ", ".join(_list(row) for row in rig.R)
    return f"{period}{cameras}[right_from_left]\nrotation = [{rotation}]\ntranslation = {_list(rig.t)}\n"


def _reading(camera: Camera) -> str:
    late = f"delay_s = {camera.delay * FRAME_SECONDS}\n" if camera.delay else ""
    return f'readout_ratio = {camera.ratio}\nscan = "{camera.scan}"\n{late}'


def _intrinsics(c: Camera) -> str:
    named = ", ".join(f"{name} = {value}" for name, value in zip(NAMES[c.lens], padded(c), strict=True) if value)
    lens = f'lens = {{ model = "{c.lens}", {named} }}\n' if named else ""
    return f"fx = {c.fx}\nfy = {c.fy}\ncx = {c.centre[0]}\ncy = {c.centre[1]}\n{lens}"


def _list(values: Sequence[float] | Array) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def camchain(rig: Rig) -> str:
    """Any rig as Kalibr writes it, with what its rolling-shutter tool and the one with an IMU add."""
    text, late = "", any(rig.camera(side).delay for side in SIDES)
    for number, side in enumerate(SIDES):
        c = rig.camera(side)
        model, k = ("radtan", padded(c)[:4]) if c.lens == BROWN else ("equidistant", padded(c))
        assert c.lens == KANNALA or not padded(c)[4], "Kalibr has no k3"
        text += f"cam{number}:\n"
        if side == "right":
            matrix = np.vstack([np.column_stack([rig.R, rig.t]), [0.0, 0.0, 0.0, 1.0]])
            text += "  T_cn_cnm1:\n" + "".join(f"  - {_list(row)}\n" for row in matrix)
        text += f"  cam_overlaps: [{1 - number}]\n  camera_model: pinhole\n  distortion_coeffs: {_list(k)}\n"
        text += f"  distortion_model: {model}\n  intrinsics: {_list([c.fx, c.fy, *c.centre])}\n"
        text += f"  line_delay: {c.ratio * FRAME_SECONDS / (c.height if c.rows else c.width)}\n"
        text += f"  timeshift_cam_imu: {c.delay * FRAME_SECONDS}\n" if late else ""
        text += f"  resolution: [{c.width}, {c.height}]\n  rostopic: /{side}/image_raw\n"
    return text
