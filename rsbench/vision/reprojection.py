"""Compiled projection, and reprojection of pixels of given inverse depth to another view; each line has a pose.

For an ideal camera, pixels equal ideal pixels, and loops are compiled without a lens.

The plane of constant depth through a pixel's point maps to the other view by the homography of two lines: the
line of the pixel, and the line that sees the point there. The latter depends on the result, so it is iterated.

Saurer, Koeser, Bouguet, Pollefeys, "Rolling shutter stereo", ICCV 2013; derived again for a pose of every line.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray

Table = FloatArray | None


class Optics(NamedTuple):
    """A camera and its scan in the form that compiled loops take, made by ``optics_of``.

    The lens of an ideal camera is None, so that the compiler drops the branches that would use it. Rows and
    columns share one compiled function: a branch costs less than compiling twice.
    """

    ideal: Table
    """(H, W, 2) ideal pixel of each pixel; None if there is no lens."""
    lens: Table
    """(14,) fx, fy, cx, cy, reach, number of the model, k1, k2, p1, p2, k3, k4, k5, k6 (double-sphere: xi and
    alpha in place of k1 and k2, then 0); None if there is no lens."""
    columns: bool
    """Whether lines (pixels that are read at one time) are columns."""


class LineMaps(NamedTuple):
    """Map of each line of a frame from its ideal pixels to those of another camera, with the optics of both.

    Homogeneous target pixel = M_y (x, y, 1) + b_y / depth.
    """

    M: FloatArray
    """(lines, 3, 3)."""
    b: FloatArray
    """(lines, 3) px m."""
    ideal: Table
    """As in ``Optics``, for the frame's camera; also ``columns``."""
    lens: Table
    """As in ``Optics``, for the target camera."""
    columns: bool


@lru_cache(maxsize=8)
def optics_of(camera: PinholeCamera, columns: bool = False) -> Optics:
    """Convert a camera to the form that compiled loops take."""
    lens = camera.lens
    if lens is None:
        return Optics(None, None, columns)
    return Optics(ideal_pixels_of(camera), lens_table(camera, lens), columns)


def lens_table(camera: PinholeCamera, lens: Lens) -> FloatArray:
    """Return the array (14,) described at ``Optics.lens``."""
    coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
    if lens.model == "double-sphere":
        coefficients = (lens.xi, lens.alpha, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, lens.reach, float(lens.number))
    return np.array([*numbers, *coefficients])


@lru_cache(maxsize=4)
def ideal_pixels_of(camera: PinholeCamera) -> FloatArray:
    """(H, W, 2) ideal pixels of all pixels of a camera. The result is cached: do not modify it."""
    return np.ascontiguousarray(camera.ideal_pixels(camera.pixel_grid()))


# Numba does not inline these functions, as it would then keep the branch for None; LLVM inlines them.
@compiled(error_model="numpy")
def look(ideal: Table, x: int, y: int) -> tuple[float, float]:
    """Return the ideal pixel of a pixel."""
    if ideal is None:
        return float(x), float(y)
    return ideal[y, x, 0], ideal[y, x, 1]


@compiled(error_model="numpy")
def look_between(ideal: Table, u: float, v: float) -> tuple[float, float]:
    """Return the ideal pixel of a sub-pixel position by linear interpolation; extrapolated beyond the border."""
    if ideal is None:
        return u, v
    height, width = ideal.shape[:2]
    x, y = min(max(int(np.floor(u)), 0), width - 2), min(max(int(np.floor(v)), 0), height - 2)
    p, q = u - x, v - y
    a, b, c, d = (1.0 - p) * (1.0 - q), p * (1.0 - q), (1.0 - p) * q, p * q
    gx = a * ideal[y, x, 0] + b * ideal[y, x + 1, 0] + c * ideal[y + 1, x, 0] + d * ideal[y + 1, x + 1, 0]
    gy = a * ideal[y, x, 1] + b * ideal[y, x + 1, 1] + c * ideal[y + 1, x, 1] + d * ideal[y + 1, x + 1, 1]
    return gx, gy


@compiled(error_model="numpy")
def see(lens: Table, u: float, v: float) -> tuple[float, float]:
    """Return the pixel of an ideal pixel; NaN beyond the reach of the lens."""
    if lens is None:
        return u, v
    return distort(lens, u, v)


@compiled(error_model="numpy", inline="always")
def line_of(columns: bool, x: int, y: int) -> int:
    """Return the index of a pixel's line in the image."""
    return x if columns else y


@compiled(error_model="numpy", inline="always")
def across_lines(columns: bool, u: float, v: float) -> float:
    """Return the coordinate of a position across the lines."""
    return u if columns else v


@compiled(error_model="numpy", inline="always")
def distort(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """``rsbench.core.camera.Lens.distort`` of one ideal pixel, in pixels; NaN beyond the lens's reach."""
    x, y = bend(lens, (u - lens[2]) / lens[0], (v - lens[3]) / lens[1])
    return x * lens[0] + lens[2], y * lens[1] + lens[3]


@compiled(error_model="numpy", inline="always")
def bend(lens: FloatArray, x: float, y: float) -> tuple[float, float]:
    """``rsbench.core.camera.Lens.distort`` of one point of the plane z = 1; NaN beyond the lens's reach."""
    s = x * x + y * y
    if not s < lens[4] * lens[4]:  # NaN included
        return np.nan, np.nan
    k1, k2, p1, p2, k3, k4 = lens[6], lens[7], lens[8], lens[9], lens[10], lens[11]
    if lens[5] == 3.0:
        xi, alpha = k1, k2
        w = xi * np.sqrt(s + 1.0) + 1.0
        gain = 1.0 / (alpha * np.sqrt(s + w * w) + (1.0 - alpha) * w)
        return x * gain, y * gain
    if lens[5] == 1.0:
        r = np.sqrt(s)
        angle = np.arctan(r)
        a = angle * angle
        # Near the axis atan r = r - r^3 / 3 up to rounding errors.
        bent = angle / r if r > 1e-6 else 1.0 - s / 3.0
        gain = bent * (1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        return x * gain, y * gain
    gain = 1.0 + s * (k1 + s * (k2 + s * k3))
    if lens[5] == 2.0:
        gain /= 1.0 + s * (k4 + s * (lens[12] + s * lens[13]))
    xd = x * gain + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    yd = y * gain + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return xd, yd


F32 = NDArray[np.float32]
_STEPS = 6
"""Iterations for the line that sees a point; each multiplies the error by the motion per line, px."""


class Reprojection(NamedTuple):
    """Maps ideal pixels x = (x, y, 1) of inverse depth rho to another view: A (G x + rho c) + rho B, per line."""

    G: FloatArray
    """(lines, 3, 3)."""
    c: FloatArray
    """(lines, 3)."""
    A: FloatArray
    """(lines, 3, 3), for the lines of the other view."""
    B: FloatArray
    """(lines, 3)."""
    ideal: Table
    """As in ``Optics``, also the next two fields."""
    lens: Table
    columns: bool
    there: bool
    """Whether the other view's lines are columns."""


def reprojection_of(
    camera: PinholeCamera, here: Pose, there: Pose, axes: tuple[int, int] = (1, 1)
) -> Reprojection:
    """Return the maps from a view with the line poses ``here`` to one with the line poses ``there``.

    Args:
        camera: camera of both views.
        here: ``cam_from_world`` (lines, 3, 3), (lines, 3) of the first view.
        there: ``cam_from_world`` of the other view.
        axes: for each view, 1 if its lines are rows, 0 if they are columns.
    """
    K, back = camera.ideal.K, np.swapaxes(here.R, -1, -2)
    centres = -(back @ here.t[..., None])[..., 0]
    G, A = back @ np.linalg.inv(K), K @ there.R
    return Reprojection(G, centres, A, there.t @ K.T, *optics_of(camera, axes[0] == 0), axes[1] == 0)


def parallax_gain(camera: PinholeCamera, maps: Reprojection, back: Reprojection) -> float:
    """Approximate parallax, px, of a point of inverse depth 1 / m between two views; ``back``: reverse map."""
    step = np.mean(back.c, axis=0) - np.mean(maps.c, axis=0)
    return max(camera.fx, camera.fy) * float(np.linalg.norm(step))


@compiled(error_model="numpy", inline="always")
def reproject(x: int, y: int, rho: float, line: int, maps: Reprojection) -> tuple[float, float, float]:
    """Project a pixel to the other view's ``line``: pixel, and new over old inverse depth; NaN behind it."""
    p, q, r = _point(x, y, rho, maps)
    return _seen_from(p, q, r, rho, maps.A[line], maps.B[line], maps.lens)


@compiled(error_model="numpy", inline="always")
def _point(x: int, y: int, rho: float, maps: Reprojection) -> tuple[float, float, float]:
    """World point of a pixel, multiplied by its inverse depth."""
    G, c, own = maps.G, maps.c, line_of(maps.columns, x, y)
    gx, gy = look(maps.ideal, x, y)
    p = G[own, 0, 0] * gx + G[own, 0, 1] * gy + G[own, 0, 2] + rho * c[own, 0]
    q = G[own, 1, 0] * gx + G[own, 1, 1] * gy + G[own, 1, 2] + rho * c[own, 1]
    r = G[own, 2, 0] * gx + G[own, 2, 1] * gy + G[own, 2, 2] + rho * c[own, 2]
    return p, q, r


@compiled(error_model="numpy", inline="always")
def _seen_from(
    p: float, q: float, r: float, rho: float, A: FloatArray, B: FloatArray, lens: Table
) -> tuple[float, float, float]:
    """Project a result of ``_point`` to a line's camera: as ``reproject`` returns it."""
    z = A[2, 0] * p + A[2, 1] * q + A[2, 2] * r + rho * B[2]
    s = 1.0 / z if z > 0.0 else np.nan
    u = (A[0, 0] * p + A[0, 1] * q + A[0, 2] * r + rho * B[0]) * s
    v = (A[1, 0] * p + A[1, 1] * q + A[1, 2] * r + rho * B[1]) * s
    u, v = see(lens, u, v)
    return u, v, s


@compiled(error_model="numpy")
def reproject_all(
    rho: F32, lines: NDArray[np.int32], maps: Reprojection, beyond: float, places: F32, factors: F32
) -> None:
    """Fill ``places`` (H, W, 2), px, and ``factors`` (H, W) for all pixels, of inverse depth ``rho`` (H, W).

    They are as ``reproject`` returns them; NaN if a point is more than ``beyond`` px outside the other image,
    beyond which the poses of its first and last line are used. ``lines`` (H, W) are the lines of the other view at
    which the iterations start; they are replaced by the lines found.
    """
    height, width = rho.shape
    A, B, lens, there = maps.A, maps.B, maps.lens, maps.there
    last = len(A) - 1
    for y in range(height):
        for x in range(width):
            line, u, v, s, along = min(max(lines[y, x], 0), last), np.nan, np.nan, np.nan, np.nan
            if np.isnan(rho[y, x]):
                places[y, x, 0], places[y, x, 1], factors[y, x], lines[y, x] = u, v, s, line
                continue
            p, q, r = _point(x, y, rho[y, x], maps)
            nearest = line
            for _ in range(_STEPS):
                line = nearest
                u, v, s = _seen_from(p, q, r, rho[y, x], A[line], B[line], lens)
                along = across_lines(there, u, v)
                if not abs(along - line) > 1.0 or not abs(along) < 2 * last + 2:
                    break
                nearest = min(max(int(np.floor(along + 0.5)), 0), last)
            lines[y, x] = nearest
            if -1.0 < along < last + 1.0 and last > 0:
                # Between two lines the position is linear in the line: solve for the line that sees it.
                beside = line + 1 if (along >= line and line < last) or line == 0 else line - 1
                u2, v2, s2 = _seen_from(p, q, r, rho[y, x], A[beside], B[beside], lens)
                step = beside - line
                share = (along - line) / (step - (across_lines(there, u2, v2) - along))
                u, v, s = u + share * (u2 - u), v + share * (v2 - v), s + share * (s2 - s)
            inside = -0.5 - beyond < u < width - 0.5 + beyond and -0.5 - beyond < v < height - 0.5 + beyond
            places[y, x, 0] = u if inside else np.nan
            places[y, x, 1] = v if inside else np.nan
            factors[y, x] = s if inside else np.nan


def reproject_pixels(maps: Reprojection, rho: F32, lines: NDArray[Any], beyond: float = 0.0) -> tuple[F32, F32]:
    """Call ``reproject_all`` with new arrays and return these."""
    places, factors = np.zeros((*rho.shape, 2), np.float32), np.zeros_like(rho)
    reproject_all(rho, lines, maps, beyond, places, factors)
    return places, factors
