"""Rays through a lens, in the kernel: undistortion in double precision, at every sample of a pixel by itself.

The pixel centres are solved on the host. What the samples of a pixel share - its centre and the inverse derivative
there - is found once; from it a chord method, Newton's with that one derivative, goes the half pixel to each
sample: no ray is interpolated. It takes the steps that the lens needs, which the host tries. NumPy:
``rsbench.core.camera.Lens.undistort``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from rsbench.core.camera import Lens, PinholeCamera, inverse_2x2

_EXACT_PX = 1e-8
"""How near to its sample a ray is, in double precision; rounding it to single errs a thousand times more."""
_MOST_STEPS = 12
_TRIED = 65
"""Pixels along each side of the image that the host tries, the outermost among them."""
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4")


class LensRays:
    """Ideal coordinates of the pixels of one camera; numbers are data of the kernel, the model is its code."""

    def __init__(self, camera: PinholeCamera, lens: Lens) -> None:
        import drjit as dr
        import mitsuba as mi

        self.lens, self.width, self.steps = lens, dr.opaque(mi.UInt32, camera.width), chord_steps(camera, lens)
        self._centre = [dr.opaque(mi.Float64, value) for value in (camera.cx, camera.cy)]
        self._per_pixel = [dr.opaque(mi.Float64, 1.0 / value) for value in (camera.fx, camera.fy)]
        self._k = {name: dr.opaque(mi.Float64, getattr(lens, name)) for name in _COEFFICIENTS}
        self._most = dr.opaque(mi.Float, camera.width - 1.0), dr.opaque(mi.Float, camera.height - 1.0)
        centres = camera.unproject(camera.pixel_grid())[..., :2].reshape(-1, 2)
        if lens.model == "kannala-brandt":
            # With its tangent: a GPU's is good to single precision alone.
            tangent = np.hypot(centres[:, :1], centres[:, 1:])
            centres = np.concatenate([np.arctan(tangent), tangent], axis=1)
        self._start = [mi.Float64(np.ascontiguousarray(column)) for column in centres.T]

    def pixel(self, x: Any, y: Any, active: Any) -> tuple[Any, ...]:
        """What all samples of the pixel share in which (x, y) is, for ``coordinates``."""
        import drjit as dr
        import mitsuba as mi

        column, row = (
            mi.UInt32(dr.clip(dr.floor(v + 0.5), 0.0, most)) for v, most in zip((x, y), self._most, strict=True)
        )
        start = [dr.gather(mi.Float64, table, row * self.width + column, active) for table in self._start]
        xd, yd = self._distorted(column, row)
        if self.lens.model == "kannala-brandt":
            return start[0], 1.0 / self._slope(start[0]), dr.sqrt(xd * xd + yd * yd), start[1]
        by_x, across, by_y = self._derivative(*start)
        determinant = by_x * by_y - across * across
        return *start, xd, yd, by_y / determinant, -across / determinant, by_x / determinant

    def coordinates(self, x: Any, y: Any, pixel: tuple[Any, ...]) -> tuple[Any, Any]:
        """Ideal coordinates, in single precision, of pixel coordinates (x, y) inside a pixel."""
        import mitsuba as mi

        distorted = self._distorted(x, y)
        found = (self._brown if self.lens.model == "brown-conrady" else self._kannala)(*distorted, *pixel)
        return mi.Float(found[0]), mi.Float(found[1])

    def _distorted(self, x: Any, y: Any) -> list[Any]:
        import mitsuba as mi

        rates = zip((x, y), self._centre, self._per_pixel, strict=True)
        return [(mi.Float64(value) - centre) * rate for value, centre, rate in rates]

    def _derivative(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Of Brown's distortion, symmetric: by x of x, across, by y of y."""
        k1, k2, p1, p2, k3, _ = self._k.values()
        s = x * x + y * y
        gain = 1 + s * (k1 + s * (k2 + s * k3))
        bend = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
        across = bend * x * y + 2 * (p1 * x + p2 * y)
        return gain + bend * x * x + 2 * p1 * y + 6 * p2 * x, across, gain + bend * y * y + 6 * p1 * y + 2 * p2 * x

    def _brown(
        self, xd: Any, yd: Any, x0: Any, y0: Any, xd0: Any, yd0: Any, xx: Any, xy: Any, yy: Any
    ) -> tuple[Any, Any]:
        k1, k2, p1, p2, k3, _ = self._k.values()
        off_x, off_y = xd - xd0, yd - yd0
        x, y = x0 + xx * off_x + xy * off_y, y0 + xy * off_x + yy * off_y
        for _ in range(self.steps):
            square_x, square_y, twice = x * x, y * y, 2 * x * y
            s = square_x + square_y
            gain = 1 + s * (k1 + s * (k2 + s * k3))
            off_x = xd - (x * gain + p1 * twice + p2 * (s + 2 * square_x))
            off_y = yd - (y * gain + p1 * (s + 2 * square_y) + p2 * twice)
            x, y = x + xx * off_x + xy * off_y, y + xy * off_x + yy * off_y
        return x, y

    def _slope(self, angle: Any) -> Any:
        """Of Kannala's radius by the angle."""
        k1, k2, _, _, k3, k4 = self._k.values()
        a = angle * angle
        return 1 + a * (3 * k1 + a * (5 * k2 + a * (7 * k3 + a * 9 * k4)))

    def _kannala(self, xd: Any, yd: Any, angle0: Any, rate: Any, radius0: Any, tangent0: Any) -> tuple[Any, Any]:
        import drjit as dr

        k1, k2, _, _, k3, k4 = self._k.values()
        radius = dr.sqrt(xd * xd + yd * yd)
        angle = angle0 + rate * (radius - radius0)
        for _ in range(self.steps):
            a = angle * angle
            angle = angle + rate * (radius - angle * (1 + a * (k1 + a * (k2 + a * (k3 + a * k4)))))
        # tan(angle0 + turn) by the tangent of both; that of the turn, less than a pixel, by its series.
        turn = angle - angle0
        t = turn * turn
        tangent = turn * (1 + t * (1 / 3 + t * (2 / 15 + t * (17 / 315 + t * (62 / 2835)))))
        central = radius < 1e-9
        gain = (tangent0 + tangent) / ((1 - tangent0 * tangent) * dr.select(central, 1.0, radius))
        gain = dr.select(central, 1.0, gain)
        return xd * gain, yd * gain


@lru_cache(maxsize=2)
def lens_rays(camera: PinholeCamera, lens: Lens) -> LensRays:
    """The rays of a camera, made once: the host needs seconds for the centres of a million pixels."""
    return LensRays(camera, lens)


def chord_steps(camera: PinholeCamera, lens: Lens) -> int:
    """Steps that bring the corners of pixels, the farthest places of samples, to ``_EXACT_PX``."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    axes = (np.unique(np.linspace(0, size - 1, _TRIED).round()) for size in (camera.width, camera.height))
    middles = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 1, 2)
    start = lens.undistort((middles - centre) / focal)
    back = inverse_2x2(lens.distort(start).jacobian)
    wanted = (middles + np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]) - centre) / focal
    exact = lens.undistort(wanted)  # a corner may lie beyond the fold
    found = start + (back @ (wanted - (middles - centre) / focal)[..., None])[..., 0]
    for steps in range(_MOST_STEPS):
        missing = wanted - lens.distort(found).xy
        if not np.nanmax(np.abs(missing * focal), initial=0.0, where=np.isfinite(exact)) > _EXACT_PX:
            return steps
        found = found + (back @ missing[..., None])[..., 0]
    return _MOST_STEPS
