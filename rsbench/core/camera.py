"""The camera and its lens; the pixel convention is defined here alone.

Pixel coordinates are (x, y) and the centre of the top-left pixel is (0, 0), so a centred principal point of a 900
x 900 image is (449.5, 449.5). Camera frame: x right, y down, z forward. Pixels are those of the sensor's image,
which the lens distorts; "ideal" pixels are those of the same camera without a lens.

A lens maps ideal coordinates, x / z and y / z of a point in the camera frame, to distorted ones, which are
multiplied by the focal length and shifted by the principal point to give pixels. The lens models and their
coefficients are OpenCV's, except for the double sphere, which follows its paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import arguments
from rsbench.core.arguments import LARGEST_PX
from rsbench.core.so3 import FloatArray

LensModel = Literal["brown-conrady", "kannala-brandt", "rational", "double-sphere"]
COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "brown-conrady": ("k1", "k2", "p1", "p2", "k3"),
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "double-sphere": ("xi", "alpha"),
}
"""The coefficients of each model in the order of OpenCV's vectors, or of the paper."""
_ALWAYS_IN_FILES = ("k1", "k2", "p1", "p2", "k3", "k4")
"""Coefficients that files list for the first two models, even those that a model does not have."""
WIDEST = 1.5
"""Largest angle from the optical axis, rad, that a fisheye lens shows, as rays have z = 1."""
_CONVERGED = 1e-14
"""Length of a Newton step, relative to 1 + the radius, at which the iteration ends (rounding)."""
_MOST_STEPS = 40
_FEW = 16384
"""Results of ``undistort`` for at most this many coordinates are cached."""
_ENTRIES = 4097
"""Number of radii in the table of start values of Newton's method for a rational lens."""


class Distorted(NamedTuple):
    """Distorted coordinates with their derivative."""

    xy: FloatArray
    """(..., 2); NaN for points that the lens does not show."""
    jacobian: FloatArray
    """(..., 2, 2) derivative by the ideal coordinates."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Coefficients of a lens; those that are 0 may be left out.

    ``brown-conrady``: D. Brown, Close-range camera calibration, 1971; OpenCV's k1, k2, p1, p2, k3.
    ``kannala-brandt``: J. Kannala, S. Brandt, PAMI 2006, eq. 6; OpenCV's fisheye k1 to k4.
    ``rational``: OpenCV's k1, k2, p1, p2, k3, k4, k5, k6; the radial factor of ``brown-conrady`` over
    1 + k4 r^2 + k5 r^4 + k6 r^6.
    ``double-sphere``: V. Usenko, N. Demmel, D. Cremers, The double sphere camera model, 3DV 2018, eq. 40; its
    focal length in the middle of the image is fx / (1 + xi).

    Raises:
        ValueError: a coefficient that is not finite or that the model does not have, alpha outside 0 to 1, xi
            of -1 or less.
    """

    model: LensModel
    """``brown-conrady``: radial and tangential distortion of ordinary lenses; ``rational``: the same for wider
    lenses; ``kannala-brandt`` and ``double-sphere``: fisheye lenses."""
    k1: float = 0.0
    """First radial coefficient, as in OpenCV."""
    k2: float = 0.0
    """Second radial coefficient."""
    p1: float = 0.0
    """First tangential coefficient of ``brown-conrady`` and ``rational``."""
    p2: float = 0.0
    """Second tangential coefficient of ``brown-conrady`` and ``rational``."""
    k3: float = 0.0
    """Third radial coefficient."""
    k4: float = 0.0
    """Fourth radial coefficient of ``kannala-brandt``; first coefficient of the denominator of ``rational``."""
    k5: float = 0.0
    """Second coefficient of the denominator of ``rational``."""
    k6: float = 0.0
    """Third coefficient of the denominator of ``rational``."""
    xi: float = 0.0
    """Distance between the two spheres divided by their radius, for ``double-sphere``."""
    alpha: float = 0.0
    """Position of the pinhole behind the second sphere, 0 to 1, for ``double-sphere``."""

    def __post_init__(self) -> None:
        arguments.check_one_of("lens model", self.model, get_args(LensModel))
        for field in fields(self)[1:]:
            arguments.check_number(f"lens {field.name}", getattr(self, field.name))
        arguments.keep_plain(self)
        for field in fields(self)[1:]:
            if field.name not in COEFFICIENTS[self.model] and (value := getattr(self, field.name)) != 0.0:
                raise ValueError(f"lens {field.name} = {value}: {self.model} has no such coefficient")
        if not 0.0 <= self.alpha <= 1.0:
            raise ValueError(f"lens alpha = {self.alpha}: must lie in [0, 1]")
        if not self.xi > -1.0:
            raise ValueError(f"lens xi = {self.xi}: must be above -1")

    @property
    def number(self) -> int:
        """Number of the model in compiled code: its index in ``COEFFICIENTS``."""
        return list(COEFFICIENTS).index(self.model)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The coefficients that the model has, in the order of ``COEFFICIENTS``."""
        return tuple(getattr(self, name) for name in COEFFICIENTS[self.model])

    def record(self) -> dict[str, Any]:
        """The lens as a table of cards and files: its model and its coefficients."""
        first = self.model in ("brown-conrady", "kannala-brandt")
        names = _ALWAYS_IN_FILES if first else COEFFICIENTS[self.model]
        return {"model": self.model, **{name: getattr(self, name) for name in names}}

    @cached_property
    def reach(self) -> float:
        """Ideal radius up to which the distorted radius grows; beyond it the image folds back."""
        if self.model == "brown-conrady":
            return math.sqrt(_first_root([1.0, 3.0 * self.k1, 5.0 * self.k2, 7.0 * self.k3]))
        if self.model == "rational":
            return self._rational_reach()
        if self.model == "double-sphere":
            return self._sphere_reach()
        slope = [1.0, 3.0 * self.k1, 5.0 * self.k2, 7.0 * self.k3, 9.0 * self.k4]
        return math.tan(min(math.sqrt(_first_root(slope)), WIDEST))

    def distort(self, xy: ArrayLike) -> Distorted:
        """Distorted coordinates of ideal ones (..., 2); NaN beyond ``reach``."""
        ideal = np.asarray(xy, dtype=np.float64)
        radius = np.hypot(ideal[..., 0], ideal[..., 1])
        known = np.where((radius < self.reach)[..., None], ideal, np.nan)
        models = {
            "brown-conrady": self._brown,
            "kannala-brandt": self._kannala,
            "rational": self._rational,
            "double-sphere": self._sphere,
        }
        return models[self.model](known)

    def undistort(self, xy: ArrayLike) -> FloatArray:
        """Ideal coordinates (..., 2) of distorted ones (..., 2); NaN if there are none.

        Results are within ``reach``, where the lens does not fold, and ``distort`` maps them to ``xy`` up to
        rounding. The double sphere has a closed form; the others are solved by Newton's method.
        """
        wanted = np.asarray(xy, dtype=np.float64)
        if self.model == "double-sphere":
            return self._from_spheres(wanted)
        if wanted.size > _FEW:
            return self.solved(wanted)
        return _of_few(self, wanted.tobytes(), wanted.shape).copy()

    def solved(self, wanted: FloatArray) -> FloatArray:
        """``undistort`` by Newton's method."""
        flat = wanted.reshape(-1, 2)
        ideal = self._start(flat)
        done = np.zeros(len(flat), dtype=np.bool_)
        for _ in range(_MOST_STEPS):
            left = np.flatnonzero(~done & np.isfinite(ideal[:, 0]))
            if len(left) == 0:
                break
            found, J = self.distort(ideal[left])
            step = _solve(J, flat[left] - found)
            ideal[left] += step
            done[left] = np.max(np.abs(step), axis=-1) <= _CONVERGED * (1.0 + np.abs(ideal[left]).max(axis=-1))
        J = self.distort(ideal).jacobian
        with np.errstate(invalid="ignore"):
            good = done & (J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0] > 0.0) & (J[:, 0, 0] > 0.0)
        return np.where(good[:, None], ideal, np.nan).reshape(wanted.shape)

    def _start(self, distorted: FloatArray) -> FloatArray:
        """Start of Newton's method: the same radius, at most half of the reach; a table for a rational lens."""
        radius = np.hypot(distorted[:, 0], distorted[:, 1])
        if self.model == "rational":  # its radii may grow or shrink
            ideal, bent = self._radii
            return distorted * (np.interp(radius, bent, ideal) / np.where(radius > 0.0, radius, 1.0))[:, None]
        most = 0.5 * self.reach
        return distorted * np.where(radius > most, most / np.where(radius > 0.0, radius, 1.0), 1.0)[:, None]

    def _brown(self, ideal: FloatArray) -> Distorted:
        x, y = ideal[..., 0], ideal[..., 1]
        s = x * x + y * y
        gain = 1.0 + s * (self.k1 + s * (self.k2 + s * self.k3))
        bend = 2.0 * (self.k1 + s * (2.0 * self.k2 + s * 3.0 * self.k3))
        return self._tangential(x, y, s, gain, bend)

    def _rational(self, ideal: FloatArray) -> Distorted:
        x, y = ideal[..., 0], ideal[..., 1]
        s = x * x + y * y
        gain, bend, _ = self._quotient(s)
        return self._tangential(x, y, s, gain, bend)

    def denominator(self, s: FloatArray) -> FloatArray:
        """Denominator (...) of the radial factor of ``rational`` at squared ideal radii (...)."""
        return 1.0 + s * (self.k4 + s * (self.k5 + s * self.k6))

    def _quotient(self, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Radial factor of a rational lens by squared radii, twice its derivative, and the denominator."""
        above, below = 1.0 + s * (self.k1 + s * (self.k2 + s * self.k3)), self.denominator(s)
        above_slope = self.k1 + s * (2.0 * self.k2 + s * 3.0 * self.k3)
        below_slope = self.k4 + s * (2.0 * self.k5 + s * 3.0 * self.k6)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = above / below
            return gain, 2.0 * (above_slope - gain * below_slope) / below, below

    def _tangential(
        self, x: FloatArray, y: FloatArray, s: FloatArray, gain: FloatArray, bend: FloatArray
    ) -> Distorted:
        """Distort by a radial factor, given with twice its derivative by s = x^2 + y^2, and tangential terms."""
        p1, p2 = self.p1, self.p2
        xd = x * gain + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
        yd = y * gain + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
        across = bend * x * y + 2.0 * (p1 * x + p2 * y)
        by_x = gain + bend * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        by_y = gain + bend * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return Distorted(np.stack([xd, yd], axis=-1), _stack_2x2(by_x, across, across, by_y))

    def _kannala(self, ideal: FloatArray) -> Distorted:
        s = ideal[..., 0] * ideal[..., 0] + ideal[..., 1] * ideal[..., 1]
        r = np.sqrt(s)
        angle = np.arctan(r)
        a = angle * angle
        k1, k2, k3, k4 = self.k1, self.k2, self.k3, self.k4
        bent = angle * (1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        slope = 1.0 + a * (3.0 * k1 + a * (5.0 * k2 + a * (7.0 * k3 + a * 9.0 * k4)))
        central = s < 1e-12  # atan r = r - r^3 / 3 up to rounding
        gain = np.where(central, 1.0 + s * (k1 - 1.0 / 3.0), bent / np.where(central, 1.0, r))
        bend = np.where(central, 2.0 * (k1 - 1.0 / 3.0), (slope / (1.0 + s) - gain) / np.where(central, 1.0, s))
        return _radially(ideal, gain, bend)

    def _rational_reach(self) -> float:
        """Ideal radius at which the distorted one stops growing or is infinite, by successively finer tables."""
        low, high = 0.0, math.tan(WIDEST)
        for _ in range(5):
            radius = np.linspace(low, high, _ENTRIES)
            gain, bend, below = self._quotient(radius * radius)
            with np.errstate(invalid="ignore"):
                grows = (gain + bend * radius * radius > 0.0) & (below > 0.0)
            if np.all(grows):
                break
            first = int(np.argmin(grows))
            low, high = float(radius[first - 1]), float(radius[first])
        return high

    @cached_property
    def _radii(self) -> tuple[FloatArray, FloatArray]:
        """Increasing ideal radii of a rational lens, and the distorted radii without tangential terms."""
        ideal = np.linspace(0.0, self.reach, _ENTRIES)[:-1]
        return ideal, ideal * self._quotient(ideal * ideal)[0]

    def _sphere(self, ideal: FloatArray) -> Distorted:
        s, xi, alpha = ideal[..., 0] * ideal[..., 0] + ideal[..., 1] * ideal[..., 1], self.xi, self.alpha
        d1 = np.sqrt(s + 1.0)
        w = xi * d1 + 1.0
        d2 = np.sqrt(s + w * w)
        gain = 1.0 / (alpha * d2 + (1.0 - alpha) * w)
        bend = -gain * gain * (alpha * (1.0 + xi * w / d1) / d2 + (1.0 - alpha) * xi / d1)
        return _radially(ideal, gain, bend)

    def _sphere_reach(self) -> float:
        """Tangent of the angle at which the second projection folds (alpha > 1/2) or goes to infinity.

        Both occur at a cosine of -w, seen from the centre of the second sphere, at -xi on the axis.
        """
        low = self.alpha <= 0.5
        w = self.alpha / (1.0 - self.alpha) if low else (1.0 - self.alpha) / self.alpha
        square = 1.0 - self.xi**2 * (1.0 - w * w)
        cosine = -self.xi * (1.0 - w * w) - w * math.sqrt(square) if square > 0.0 else -1.0
        return math.tan(min(math.acos(max(cosine, -1.0)), WIDEST))

    def _from_spheres(self, distorted: FloatArray) -> FloatArray:
        """Closed form of ``undistort``: Usenko et al., eq. 46."""
        xi, alpha = self.xi, self.alpha
        s = np.sum(distorted * distorted, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = (1.0 - alpha * alpha * s) / (alpha * np.sqrt(1.0 - (2.0 * alpha - 1.0) * s) + 1.0 - alpha)
            scale = (z * xi + np.sqrt(z * z + (1.0 - xi * xi) * s)) / (z * z + s)
            forward = scale * z - xi
            ideal = distorted * (scale / np.where(forward > 0.0, forward, np.nan))[..., None]
            seen = np.sum(ideal * ideal, axis=-1) < self.reach**2
        return np.where(seen[..., None], ideal, np.nan)


def _radially(ideal: FloatArray, gain: FloatArray, bend: FloatArray) -> Distorted:
    """Distort by a radial factor, given with twice its derivative by s = x^2 + y^2."""
    x, y = ideal[..., 0], ideal[..., 1]
    across = bend * x * y
    J = _stack_2x2(gain + bend * x * x, across, across, gain + bend * y * y)
    return Distorted(ideal * gain[..., None], J)


def inverse_2x2(J: FloatArray) -> FloatArray:
    """Inverses of matrices (..., 2, 2); not finite for singular ones."""
    a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(_stack_2x2(d, -b, -c, a) / (a * d - b * c)[..., None, None])


def _stack_2x2(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    return np.stack([np.stack([a, b], axis=-1), np.stack([c, d], axis=-1)], axis=-2)


def _solve(J: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray((inverse_2x2(J) @ right[..., None])[..., 0])


def _first_root(coefficients: list[float]) -> float:
    """Smallest positive root of a polynomial, lowest power first; infinite if it has none."""
    # Negligible coefficients only give roots beyond all images, and would overflow as divisors.
    small = 1e-100 * max(map(abs, coefficients))
    roots = np.polynomial.polynomial.polyroots([c if abs(c) > small else 0.0 for c in coefficients])
    real = roots.real[(np.abs(roots.imag) <= 1e-6 * np.abs(roots)) & (roots.real > 0.0)]
    return float(np.min(real, initial=np.inf))


_TRIED = 33
"""Number of columns and rows of a grid over the image, at whose points a lens must be invertible."""


@lru_cache(maxsize=64)
def _of_few(lens: Lens, values: bytes, shape: tuple[int, ...]) -> FloatArray:
    """``Lens.undistort`` of few coordinates, cached since estimates use the same ones repeatedly."""
    return lens.solved(np.frombuffer(values).reshape(shape))


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """Intrinsics; sizes and focal lengths in pixels.

    Raises:
        ValueError: a value is impossible, or the lens folds or cannot be inverted inside the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens | None = None
    """None: an ideal camera, without distortion."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            arguments.check_whole(f"camera {name}", getattr(self, name), 1, arguments.LARGEST_SIZE)
        for name in ("fx", "fy"):
            arguments.check_positive(f"camera {name}", getattr(self, name), LARGEST_PX, "pixels")
        for name in ("cx", "cy"):
            arguments.check_number(
                f"camera {name}", getattr(self, name), -arguments.LARGEST_PX, arguments.LARGEST_PX
            )
        arguments.keep_plain(self)
        if self.lens is not None:
            arguments.check_type("camera lens", self.lens, Lens)
            self._check_lens(self.lens)

    def _check_lens(self, lens: Lens) -> None:
        axes = np.linspace(-0.5, self.width - 0.5, _TRIED), np.linspace(-0.5, self.height - 0.5, _TRIED)
        pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        lost = np.isnan(self.unproject(pixels)[:, 0])
        if np.any(lost):
            x, y = pixels[lost][0]
            form = "projection" if lens.model == "double-sphere" else "polynomial"
            raise ValueError(
                f"camera lens: the {lens.model} {form} folds inside the image, or leaves it: pixel "
                f"({x:g}, {y:g}) shows no ray in front of the camera; check the coefficients"
            )

    @classmethod
    def centred(cls, width: int, height: int, focal: float) -> PinholeCamera:
        """A camera with square pixels and the principal point in the middle of the image; raises as the class."""
        for name, size in (("width", width), ("height", height)):
            arguments.check_whole(f"camera {name}", size, 1, arguments.LARGEST_SIZE)
        return cls(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)

    @property
    def K(self) -> FloatArray:
        """Calibration matrix (3, 3); ValueError for a camera with a lens, see ``ideal``."""
        if self.lens is not None:
            raise ValueError(f"a camera with a lens ({self.lens.model}) has no calibration matrix; its ideal has")
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_ideal(self) -> bool:
        """Whether its pixels are ideal ones."""
        return self.lens is None

    @property
    def ideal(self) -> PinholeCamera:
        """The same camera without its lens."""
        return self if self.lens is None else replace(self, lens=None)

    def project(self, x_in_cam: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera frame; NaN where z <= 0 or beyond ``reach``."""
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
        """Rays (..., 3) of pixels (..., 2) in the camera frame with z = 1, so that ``depth * ray`` is the point.

        NaN where the lens shows no ray, which never occurs inside the image.
        """
        p = np.asarray(pixels, dtype=np.float64)
        x, y = (p[..., 0] - self.cx) / self.fx, (p[..., 1] - self.cy) / self.fy
        if self.lens is not None:
            xy = self.lens.undistort(np.stack([x, y], axis=-1))
            x, y = xy[..., 0], xy[..., 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def ideal_pixels(self, pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) in the camera without its lens that correspond to pixels (..., 2) of this one."""
        p = np.asarray(pixels, dtype=np.float64)
        return p if self.lens is None else self.ideal.project(self.unproject(p))

    def lens_pixels(self, ideal_pixels: ArrayLike) -> FloatArray:
        """Pixels (..., 2) that correspond to pixels (..., 2) of the camera without its lens; NaN: none."""
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
    def central_focal(self) -> tuple[float, float]:
        """Focal lengths in the middle of the image, px: fx and fy times the derivative of the lens there."""
        gain = 1.0 if self.lens is None else float(self.lens.distort([0.0, 0.0]).jacobian[0, 0])
        return gain * self.fx, gain * self.fy

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

    def resized(self, width: int, height: int) -> PinholeCamera:
        """The camera for the same images resized to another size."""
        x, y = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * x - 0.5, (self.cy + 0.5) * y - 0.5
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=cx, cy=cy)

    def pixel_grid(self) -> FloatArray:
        """Centres of all pixels, (height, width, 2)."""
        x, y = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return np.stack([x, y], axis=-1)
