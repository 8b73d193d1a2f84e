"""Frames whose lines are read from any side, as frames whose rows are read from the top: mirrored, or turned.

A phone held upright reads columns. A mirror leaves motions motions and times times, so what corrects rows from the
top corrects the others; a rotation's axis turns round in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.mono_correction import FoundOwnMotion
from rsbench.vision.fusion import Fused


@dataclass(frozen=True, kw_only=True, eq=False)
class Turned:
    """A camera that reads rows from the top, and how the frames of the real one become its frames."""

    camera: PinholeCamera
    shutter: RollingShutter
    exchanged: bool
    """Whether x and y are."""
    flipped: bool
    """Whether the lines are in the opposite order after that."""

    def image(self, image: NDArray[Any]) -> NDArray[Any]:
        """A frame (H, W[, 3]) as this camera has it."""
        lines_first = np.swapaxes(image, 0, 1) if self.exchanged else image
        return np.ascontiguousarray(lines_first[::-1] if self.flipped else lines_first)

    def line(self, row: float) -> float:
        """The number of lines read at the time of so many rows; of columns, a like share of the width."""
        return row * (self.camera.height - 1) / (self.camera.width - 1) if self.exchanged else row

    def back(self, fused: Fused) -> Fused:
        """A corrected frame as the real camera has it."""
        image, origin, depth = map(self._image_back, (fused.image, fused.origin, fused.depth))
        return replace(fused, image=image, origin=origin, depth=depth)

    def _image_back(self, image: NDArray[Any]) -> NDArray[Any]:
        lines = image[::-1] if self.flipped else image
        return np.ascontiguousarray(np.swapaxes(lines, 0, 1) if self.exchanged else lines)

    def found(self, found: FoundOwnMotion | None) -> FoundOwnMotion | None:
        """A motion as the real camera makes it."""
        if found is None or found.own.motion is None:
            return found
        motion, P = found.own.motion, self._axes()
        w, d = np.linalg.det(P) * P.T @ motion.w, P.T @ motion.d
        if isinstance(motion, GyroMotion):
            real: Motion = GyroMotion(_axial(motion.samples, P.T), d)
        elif isinstance(motion, ContinuousMotion):
            real = motion.seen(P.T)
        else:
            real = make_motion(motion.name, w, d, motion.parameters)
        return replace(found, own=replace(found.own, motion=real))

    def gyro(self, samples: FloatArray) -> FloatArray:
        """Samples (n, 4) tau, w of a gyroscope as this camera turns."""
        return _axial(samples, self._axes())

    def _axes(self) -> FloatArray:
        """(3, 3) this camera's axes from the real one's."""
        exchange = np.eye(3)[[1, 0, 2]] if self.exchanged else np.eye(3)
        return np.diag([1.0, -1.0 if self.flipped else 1.0, 1.0]) @ exchange


def _axial(samples: FloatArray, P: FloatArray) -> FloatArray:
    """Samples (n, 4) tau, w after a change of axes (3, 3); in a mirror, a rotation's axis turns round."""
    return np.column_stack([samples[:, 0], np.linalg.det(P) * samples[:, 1:] @ P.T])


def turned(camera: PinholeCamera, shutter: RollingShutter) -> Turned:
    """The camera that reads rows from the top in place of one that reads from any side."""
    scan, c = shutter.scan_of("left"), camera
    exchanged, flipped = scan in ("left", "right"), scan in ("bottom", "right")
    if exchanged:
        c = PinholeCamera(width=c.height, height=c.width, fx=c.fy, fy=c.fx, cx=c.cy, cy=c.cx)
    if flipped:
        c = replace(c, cy=c.height - 1 - c.cy)
    rows = RollingShutter(height=c.height, readout_ratio=shutter.readout_ratio)
    return Turned(camera=c, shutter=rows, exchanged=exchanged, flipped=flipped)
