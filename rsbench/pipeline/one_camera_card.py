"""The card of a camera whose frames are corrected alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from rsbench.components.cards import SHUTTER_KEY, parse_card, read_toml, with_shutter
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import Scan
from rsbench.pipeline.footage import CameraCard

DEFAULT_FOCAL = 1.0
"""Focal length in widths of the image where nothing is said: a horizontal field of view of 53 degrees."""
_WIDEST_DEG = 170.0


@dataclass(frozen=True, kw_only=True)
class OneCameraCard:
    """What is known of a camera whose frames are corrected alone; the size comes from the images."""

    SHORTHANDS: ClassVar = SHUTTER_KEY

    readout_ratio: float | None = None
    """Readout time over frame period, 0 to 1. Absent: found from the frames, or the command says why not."""
    frame_period_s: float | None = None
    """Seconds from one frame to the next, beside ``shutter`` where it is not that of its mode. A video of another
    frame rate is told apart."""
    scan: Scan | None = None
    """Side of the image at which the readout begins. Absent: found with the readout ratio, or ``top`` where that
    is given."""
    fov_deg: float | None = None
    """Horizontal field of view, degrees, in place of ``camera``. Absent both: the focal length is found from the
    frames, or is that of the width of the image where they cannot tell."""
    camera: CameraCard | None = None
    """Intrinsics."""

    def __post_init__(self) -> None:
        if self.readout_ratio is not None and not 0.0 <= self.readout_ratio <= 1.0:
            raise ValueError(f"readout_ratio = {self.readout_ratio}: must lie in [0, 1]")
        if self.frame_period_s is not None and not self.frame_period_s > 0.0:
            raise ValueError(f"frame_period_s = {self.frame_period_s}: must be positive")
        if self.fov_deg is not None and not 0.0 < self.fov_deg <= _WIDEST_DEG:
            raise ValueError(f"fov_deg = {self.fov_deg}: must lie in (0, {_WIDEST_DEG:g}]")
        if self.fov_deg is not None and self.camera is not None:
            raise ValueError("fov_deg: leave it out beside [camera], which says the focal length")
        if self.camera is not None and self.camera.lens is not None:
            raise ValueError("camera.lens: leave it out; undistort frames of one camera first")
        if self.camera is not None and self.camera.sigma:
            raise ValueError("camera.focal_sigma, k1_sigma: leave them out; of one camera neither is found")

    @property
    def focal_unknown(self) -> bool:
        """Whether nothing is said of the focal length."""
        return self.camera is None and self.fov_deg is None

    def camera_of(self, width: int, height: int) -> PinholeCamera:
        """The camera of images of this size; of ``DEFAULT_FOCAL`` where nothing is said."""
        if self.camera is not None:
            c = self.camera
            return PinholeCamera(width=width, height=height, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy)
        if self.fov_deg is not None:
            focal = 0.5 * width / math.tan(math.radians(0.5 * self.fov_deg))
            return PinholeCamera.centred(width, height, focal)
        return PinholeCamera.centred(width, height, DEFAULT_FOCAL * width)


def read_one_camera(path: Path) -> OneCameraCard:
    """Card: ``readout_ratio`` or ``shutter``, ``scan``; ``[camera]`` (fx, fy, cx, cy), ``fov_deg``, or neither.

    Raises:
        RsbenchError: one line with the file, the field, the value and what is allowed.
    """
    table = read_toml(path)
    return parse_card(OneCameraCard, with_shutter(table, str(path)), str(path))
