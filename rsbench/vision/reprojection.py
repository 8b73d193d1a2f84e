"""Compiled projection: cameras, and pixels of given inverse depth seen in another view, each line at its own pose.

An ideal camera is the special case: its pixels look where they are, and its loops are compiled without a lens.

The plane of constant depth through a pixel's point maps to the other view by the homography of two lines: that of
the pixel and that which sees it there. Which line that is depends on where the pixel lands, so it is iterated.

Saurer, Koeser, Bouguet, Pollefeys, "Rolling shutter stereo", ICCV 2013; derived again for a pose of every line.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import Vector, apply
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray

Table = FloatArray | None


class Optics(NamedTuple):
    """A camera and its scan for compiled loops, by ``optics_of``.

    The lens of an ideal camera is None: the compiler then drops the branches that would use it. Rows and columns
    share one compilation: a branch costs less than a second one.
    """

    ideal: Table
    """(H, W, 2) px at which the camera without its lens sees what a pixel sees; None where there is no lens."""
    lens: Table
    """(14,) fx, fy, cx, cy, reach, number of the model, k1, k2, p1, p2, k3, k4, k5, k6, or xi and alpha first of
    these; None where there is no lens."""
    columns: bool
    """Whether lines, each read at one time, are columns."""


class LineMaps(NamedTuple):
    """Maps of each line of a frame, from its ideal pixels to another camera's, with the optics of both.

    Homogeneous target pixel = M_y (x, y, 1) + b_y / depth.
    """

    M: FloatArray
    """(lines, 3, 3)."""
    b: FloatArray
    """(lines, 3) px m."""
    ideal: Table
    """Field of ``Optics`` of the frame's camera, as ``columns``."""
    lens: Table
    """That of the target camera."""
    columns: bool


@lru_cache(maxsize=8)
def optics_of(camera: PinholeCamera, columns: bool = False) -> Optics:
    """The camera for compiled loops."""
    lens = camera.lens
    if lens is None:
        return Optics(None, None, columns)
    return Optics(ideal_pixels_of(camera), lens_table(camera, lens), columns)


def lens_table(camera: PinholeCamera, lens: Lens) -> FloatArray:
    """(14,) the numbers of ``Optics.lens``."""
    coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6)
    if lens.model == "double-sphere":
        coefficients = (lens.xi, lens.alpha, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, lens.reach, float(lens.number))
    return np.array([*numbers, *coefficients])


@lru_cache(maxsize=4)
def ideal_pixels_of(camera: PinholeCamera) -> FloatArray:
    """(H, W, 2) ideal pixels of all pixels of a camera; not to be written to."""
    return np.ascontiguousarray(camera.ideal_pixels(camera.pixel_grid()))


# Not inlined by Numba, which would then keep the branch for None: LLVM inlines them.
@compiled(error_model="numpy")
def look(ideal: Table, x: int, y: int) -> tuple[float, float]:
    """Ideal pixel of a pixel of the image."""
    if ideal is None:
        return float(x), float(y)
    return ideal[y, x, 0], ideal[y, x, 1]


@compiled(error_model="numpy")
def look_between(ideal: Table, u: float, v: float) -> tuple[float, float]:
    """Ideal pixel of any place of the image, linear between pixels; beyond the border as at the border."""
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
    """Pixel at which the camera sees what it would see at an ideal pixel without its lens; NaN for none."""
    if lens is None:
        return u, v
    return distort(lens, u, v)


@compiled(error_model="numpy", inline="always")
def line_of(columns: bool, x: int, y: int) -> int:
    """Number of the line that reads a pixel of the image, in the order of the image."""
    return x if columns else y


@compiled(error_model="numpy", inline="always")
def across_lines(columns: bool, u: float, v: float) -> float:
    """The coordinate of a place that numbers lines."""
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
        # atan r = r - r^3 / 3: what is left out near the axis is below rounding.
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
"""Steps of the search for the line that sees a point: each scales the error by the motion, px, in one line."""


class Reprojection(NamedTuple):
    """Lines' maps of ideal pixels (x, y, 1) of inverse depth rho to another view's: A (G x + rho c) + rho B."""

    G: FloatArray
    """(lines, 3, 3)."""
    c: FloatArray
    """(lines, 3)."""
    A: FloatArray
    """(lines, 3, 3) of the other view's lines."""
    B: FloatArray
    """(lines, 3)."""
    ideal: Table
    """Field of ``Optics``, as the next two."""
    lens: Table
    columns: bool
    there: bool
    """Whether the other view's lines are columns."""


def reprojection_of(
    camera: PinholeCamera, here: Pose, there: Pose, axes: tuple[int, int] = (1, 1)
) -> Reprojection:
    """Maps from the view whose lines have the poses ``here`` to that of ``there``.

    Args:
        camera: of both views.
        here: ``cam_from_world`` (lines, 3, 3), (lines, 3).
        there: the same of the other view.
        axes: coordinate that numbers the lines of each: 1 for rows, 0 for columns.
    """
    K, back = camera.ideal.K, np.swapaxes(here.R, -1, -2)
    centres = -(back @ here.t[..., None])[..., 0]
    G, A = back @ np.linalg.inv(K), K @ there.R
    return Reprojection(G, centres, A, there.t @ K.T, *optics_of(camera, axes[0] == 0), axes[1] == 0)


def parallax_gain(camera: PinholeCamera, maps: Reprojection, back: Reprojection) -> float:
    """px, about, that a point of inverse depth 1 / m moves between two views; ``back`` is the reverse map."""
    step = np.mean(back.c, axis=0) - np.mean(maps.c, axis=0)
    return max(camera.fx, camera.fy) * float(np.linalg.norm(step))


@compiled(error_model="numpy", inline="always")
def reproject(x: int, y: int, rho: float, line: int, maps: Reprojection) -> tuple[float, float, float]:
    """Pixel and depth factor in the other view's camera of ``line``; NaN behind it."""
    p, q, r = _point(x, y, rho, maps)
    return _seen_from(p, q, r, rho, maps.A[line], maps.B[line], maps.lens)


@compiled(error_model="numpy", inline="always")
def _point(x: int, y: int, rho: float, maps: Reprojection) -> tuple[float, float, float]:
    """World point of a pixel, times its inverse depth."""
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
    """Pixel and depth factor of such a point in a line's camera; NaN behind it."""
    z = A[2, 0] * p + A[2, 1] * q + A[2, 2] * r + rho * B[2]
    s = 1.0 / z if z > 0.0 else np.nan
    u = (A[0, 0] * p + A[0, 1] * q + A[0, 2] * r + rho * B[0]) * s
    v = (A[1, 0] * p + A[1, 1] * q + A[1, 2] * r + rho * B[1]) * s
    u, v = see(lens, u, v)
    return u, v, s


@compiled(error_model="numpy", inline="always")
def sight_of(x: int, y: int, maps: Reprojection) -> tuple[Vector, Vector]:
    """Ray of a pixel and centre of its camera, in the world's axes."""
    G, c, own = maps.G, maps.c, line_of(maps.columns, x, y)
    gx, gy = look(maps.ideal, x, y)
    return apply(G[own], (gx, gy, 1.0)), (c[own, 0], c[own, 1], c[own, 2])


@compiled(error_model="numpy", inline="always")
def homography(sight: tuple[Vector, Vector], line: int, maps: Reprojection) -> tuple[Vector, Vector]:
    """M and b of a pixel and a line of the other view: it sees the pixel's point at M + rho b, homogeneous."""
    A, B = maps.A[line], maps.B[line]
    centre = apply(A, sight[1])
    return apply(A, sight[0]), (centre[0] + B[0], centre[1] + B[1], centre[2] + B[2])


@compiled(error_model="numpy", inline="always")
def land(M: Vector, b: Vector, rho: float, lens: Table) -> tuple[float, float, float]:
    """Pixel and depth factor there of ``homography``; NaN behind the camera."""
    z = M[2] + rho * b[2]
    s = 1.0 / z if z > 0.0 else np.nan
    u, v = see(lens, (M[0] + rho * b[0]) * s, (M[1] + rho * b[1]) * s)
    return u, v, s


@compiled(error_model="numpy")
def reproject_all(
    rho: F32, lines: NDArray[np.int32], maps: Reprojection, beyond: float, places: F32, factors: F32
) -> None:
    """Fill ``places`` (H, W, 2) px and depth factors (H, W) of all pixels of inverse depth ``rho`` (H, W).

    NaN where the other view does not see the point, not even if it were larger by ``beyond`` px on all sides; its
    first and last line then see what lies before and after them. ``lines`` (H, W) are those where the search
    begins and, after it, those where it ended.
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
                # Between two lines the place changes evenly with the line: there it is on the line that sees it.
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
    """``reproject_all`` into new arrays."""
    places, factors = np.zeros((*rho.shape, 2), np.float32), np.zeros_like(rho)
    reproject_all(rho, lines, maps, beyond, places, factors)
    return places, factors
