"""The camera; the only place that knows the pixel convention, and what a lens does to it.

Pixel coordinates are (x, y) and the centre of the top-left pixel is (0, 0), so a centred principal point of a
900 x 900 image is (449.5, 449.5). Camera frame: x right, y down, z forward. Pixels are those of the image as the
sensor has it, distorted by the lens; "ideal" pixels are those of the same camera without it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import given
from rsbench.core.lens import Lens, inverse_2x2
from rsbench.core.so3 import FloatArray

_TRIED = 33
"""Columns and rows of the points, spread over the whole image, at which a lens must be invertible."""


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """Intrinsics; sizes and focal lengths in pixels.

    Raises:
        ValueError: a value that is not possible, or a lens that folds or cannot be inverted inside the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens | None = None
    """None: an ideal one, without distortion."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            given.check_whole(f"camera {name}", getattr(self, name), 1, given.LARGEST_SIZE)
        for name in ("fx", "fy"):
            given.check_positive(f"camera {name}", getattr(self, name), given.LARGEST_PX, "pixels")
        for name in ("cx", "cy"):
            given.check_number(f"camera {name}", getattr(self, name), -given.LARGEST_PX, given.LARGEST_PX)
        given.keep_plain(self)
        if self.lens is not None:
            given.check_type("camera lens", self.lens, Lens)
            self._check_lens(self.lens)

    def _check_lens(self, lens: Lens) -> None:
        axes = np.linspace(-0.5, self.width - 0.5, _TRIED), np.linspace(-0.5, self.height - 0.5, _TRIED)
        pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        lost = np.isnan(self.unproject(pixels)[:, 0])
        if np.any(lost):
            x, y = pixels[lost][0]
            raise ValueError(
                f"camera lens: the {lens.model} polynomial folds inside the image, or leaves it: pixel "
                f"({x:g}, {y:g}) shows no ray in front of the camera; check the coefficients"
            )

    @classmethod
    def centred(cls, width: int, height: int, focal: float) -> PinholeCamera:
        """Square pixels and the principal point in the middle of the image; ValueError as of the class."""
        for name, size in (("width", width), ("height", height)):
            given.check_whole(f"camera {name}", size, 1, given.LARGEST_SIZE)
        return cls(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)

    @property
    def K(self) -> FloatArray:
        """Calibration matrix (3, 3); ValueError where there is none, with a lens: see ``ideal``."""
        if self.lens is not None:
            raise ValueError(f"a camera with a lens ({self.lens.model}) has no calibration matrix; its ideal has")
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def ideal(self) -> PinholeCamera:
        """The same camera without its lens."""
        return self if self.lens is None else replace(self, lens=None)

    def project(self, x_in_cam: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera frame; NaN where z <= 0 or the lens does not reach."""
        x = np.asarray(x_in_cam, dtype=np.float64)
        z = np.where(x[..., 2] > 0.0, x[..., 2], np.nan)
        if self.lens is not None:
            return self.lens.distort(x[..., :2] / z[..., None]).xy * self._focal + self._centre
        return np.stack([self.fx * x[..., 0] / z + self.cx, self.fy * x[..., 1] / z + self.cy], axis=-1)

    def velocity(self, x_in_cam: ArrayLike, rates: ArrayLike) -> FloatArray:
        """Velocities (..., 2) of the pixels of points (..., 3) that move by ``rates`` (..., 3)."""
        x, v = np.asarray(x_in_cam, dtype=np.float64), np.asarray(rates, dtype=np.float64)
        z = np.where(x[..., 2] > 0.0, x[..., 2], np.nan)
        if self.lens is None:
            across = self.fx * (v[..., 0] - x[..., 0] / z * v[..., 2]) / z
            down = self.fy * (v[..., 1] - x[..., 1] / z * v[..., 2]) / z
            return np.stack([across, down], axis=-1)
        xy = x[..., :2] / z[..., None]
        rate = (v[..., :2] - xy * v[..., 2:]) / z[..., None]
        return (self.lens.distort(xy).jacobian @ rate[..., None])[..., 0] * self._focal

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Rays (..., 3) in the camera frame with z = 1, so ``depth * ray`` is the point; from pixels (..., 2).

        NaN where the lens shows no ray, which is never inside the image.
        """
        p = np.asarray(pixels, dtype=np.float64)
        x, y = (p[..., 0] - self.cx) / self.fx, (p[..., 1] - self.cy) / self.fy
        if self.lens is not None:
            xy = self.lens.undistort(np.stack([x, y], axis=-1))
            x, y = xy[..., 0], xy[..., 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def ideal_pixels(self, pixels: ArrayLike) -> FloatArray:
        """Where the camera without its lens sees (..., 2) what this one sees at pixels (..., 2)."""
        p = np.asarray(pixels, dtype=np.float64)
        return p if self.lens is None else self.ideal.project(self.unproject(p))

    def lens_pixels(self, ideal_pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) at which this camera sees what the one without a lens sees at (..., 2); NaN for none."""
        p = np.asarray(ideal_pixels, dtype=np.float64)
        return p if self.lens is None else self.project(self.ideal.unproject(p))

    def ideal_by_pixel(self, pixels: ArrayLike) -> FloatArray:
        """Derivative (..., 2, 2) of ``ideal_pixels`` at pixels (..., 2)."""
        p = np.asarray(pixels, dtype=np.float64)
        if self.lens is None:
            return np.broadcast_to(np.eye(2), (*p.shape[:-1], 2, 2))
        by_distorted = inverse_2x2(self.lens.distort(self.unproject(p)[..., :2]).jacobian)
        return self._focal[:, None] * by_distorted / self._focal

    @property
    def _focal(self) -> FloatArray:
        return np.array([self.fx, self.fy])

    @property
    def _centre(self) -> FloatArray:
        return np.array([self.cx, self.cy])

    def contains(self, pixels: ArrayLike) -> np.ndarray:
        """Whether pixels (..., 2) lie inside the image area, half a pixel beyond the outermost centres."""
        p = np.asarray(pixels, dtype=np.float64)
        inside_x = (p[..., 0] >= -0.5) & (p[..., 0] <= self.width - 0.5)
        return inside_x & (p[..., 1] >= -0.5) & (p[..., 1] <= self.height - 0.5)

    def pixel_grid(self) -> FloatArray:
        """Centres of all pixels, (height, width, 2)."""
        x, y = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return np.stack([x, y], axis=-1)
