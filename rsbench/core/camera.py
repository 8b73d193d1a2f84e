"""The pinhole camera; the only place that knows the pixel convention.

Pixel coordinates are (x, y) and the centre of the top-left pixel is (0, 0), so a centred principal point of a
900 x 900 image is (449.5, 449.5). Camera frame: x right, y down, z forward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core.so3 import FloatArray


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """Intrinsics without distortion; sizes and focal lengths in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size must be at least 1 x 1, got {self.width} x {self.height}")
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"camera {name} must be a positive number of pixels, got {value}")
        for name in ("cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"camera {name} must be finite, got {getattr(self, name)}")

    @classmethod
    def centred(cls, width: int, height: int, focal: float) -> PinholeCamera:
        """Square pixels and the principal point in the middle of the image."""
        return cls(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)

    @property
    def K(self) -> FloatArray:
        """Calibration matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, x_in_cam: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera frame; NaN where z <= 0."""
        x = np.asarray(x_in_cam, dtype=np.float64)
        z = np.where(x[..., 2] > 0.0, x[..., 2], np.nan)
        return np.stack([self.fx * x[..., 0] / z + self.cx, self.fy * x[..., 1] / z + self.cy], axis=-1)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Rays (..., 3) in the camera frame with z = 1, so ``depth * ray`` is the point; from pixels (..., 2)."""
        p = np.asarray(pixels, dtype=np.float64)
        x, y = (p[..., 0] - self.cx) / self.fx, (p[..., 1] - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def contains(self, pixels: ArrayLike) -> np.ndarray:
        """Whether pixels (..., 2) lie inside the image area, half a pixel beyond the outermost centres."""
        p = np.asarray(pixels, dtype=np.float64)
        inside_x = (p[..., 0] >= -0.5) & (p[..., 0] <= self.width - 0.5)
        return inside_x & (p[..., 1] >= -0.5) & (p[..., 1] <= self.height - 0.5)

    def pixel_grid(self) -> FloatArray:
        """Centres of all pixels, (height, width, 2)."""
        x, y = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return np.stack([x, y], axis=-1)
