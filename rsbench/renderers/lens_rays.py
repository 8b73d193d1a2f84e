"""Rays through a lens, in the kernel: undistortion in double precision, at every sample of a pixel by itself.

A table of the pixel centres, solved on the host, gives Newton's method a start within a pixel of the end, so that
few steps are exact: no ray is interpolated. NumPy: ``rsbench.core.lens.Lens.undistort``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rsbench.core.camera import PinholeCamera
from rsbench.core.lens import Lens

_STEPS = 3
"""Half a pixel off is 1e-3 in ideal coordinates; squared three times it is below rounding, for fisheyes too."""
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4")


class LensRays:
    """Ideal coordinates of the pixels of one camera; numbers are data of the kernel, the model is its code."""

    def __init__(self, camera: PinholeCamera, lens: Lens) -> None:
        import drjit as dr
        import mitsuba as mi

        self.lens, self.width, self.height = lens, dr.opaque(mi.UInt32, camera.width), camera.height
        self._focal = [dr.opaque(mi.Float64, value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)]
        self._k = {name: dr.opaque(mi.Float64, getattr(lens, name)) for name in _COEFFICIENTS}
        self._most = dr.opaque(mi.Float, camera.width - 1.0), dr.opaque(mi.Float, camera.height - 1.0)
        centres = camera.unproject(camera.pixel_grid())[..., :2].reshape(-1, 2)
        if lens.model == "kannala-brandt":
            centres = np.arctan(np.hypot(centres[:, :1], centres[:, 1:]))
        self._start = [mi.Float64(np.ascontiguousarray(column)) for column in centres.T]

    def coordinates(self, x: Any, y: Any, active: Any) -> tuple[Any, Any]:
        """Ideal coordinates, in single precision, of pixel coordinates (x, y) inside the image."""
        import drjit as dr
        import mitsuba as mi

        column, row = (
            mi.UInt32(dr.clip(dr.floor(v + 0.5), 0.0, most)) for v, most in zip((x, y), self._most, strict=True)
        )
        start = [dr.gather(mi.Float64, table, row * self.width + column, active) for table in self._start]
        fx, fy, cx, cy = self._focal
        xd, yd = (mi.Float64(x) - cx) / fx, (mi.Float64(y) - cy) / fy
        u, v = self._brown(xd, yd, *start) if self.lens.model == "brown-conrady" else self._kannala(xd, yd, *start)
        return mi.Float(u), mi.Float(v)

    def _brown(self, xd: Any, yd: Any, x: Any, y: Any) -> tuple[Any, Any]:
        k1, k2, p1, p2, k3, _ = self._k.values()
        for _ in range(_STEPS):
            s = x * x + y * y
            gain = 1 + s * (k1 + s * (k2 + s * k3))
            bend = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
            off_x = x * gain + 2 * p1 * x * y + p2 * (s + 2 * x * x) - xd
            off_y = y * gain + p1 * (s + 2 * y * y) + 2 * p2 * x * y - yd
            across = bend * x * y + 2 * (p1 * x + p2 * y)
            by_x = gain + bend * x * x + 2 * p1 * y + 6 * p2 * x
            by_y = gain + bend * y * y + 6 * p1 * y + 2 * p2 * x
            determinant = by_x * by_y - across * across
            x = x - (by_y * off_x - across * off_y) / determinant
            y = y - (by_x * off_y - across * off_x) / determinant
        return x, y

    def _kannala(self, xd: Any, yd: Any, angle: Any) -> tuple[Any, Any]:
        import drjit as dr

        k1, k2, _, _, k3, k4 = self._k.values()
        radius = dr.sqrt(xd * xd + yd * yd)
        for _ in range(_STEPS):
            a = angle * angle
            bent = angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
            slope = 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))
            angle = angle - (bent - radius) / slope
        central = radius < 1e-9
        gain = dr.select(central, 1.0, dr.tan(angle) / dr.select(central, 1.0, radius))
        return xd * gain, yd * gain
