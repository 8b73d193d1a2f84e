"""Reprojection of a pixel of given inverse depth into another view, each line at its own pose.

The plane of constant depth that a pixel looks at maps to the other view by the homography of two rows, that of
the pixel and that which sees it there; which row that is depends on where the pixel lands, so it is iterated.

Saurer, Koeser, Bouguet, Pollefeys, "Rolling shutter stereo", ICCV 2013; re-derived for poses of every line.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import Vector, apply
from rsbench.core.camera import PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.vision.compiled_camera import Table, across_lines, line_of, look, optics_of, see

F32 = NDArray[np.float32]
_STEPS = 6
"""Of the search for the line that sees a point: each leaves of the error what a pixel moves in a line."""


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
    """Of ``Optics``, as the next two."""
    lens: Table
    columns: bool
    there: bool
    """Whether the other view's lines are columns."""


def reprojection_of(
    camera: PinholeCamera, here: Pose, there: Pose, axes: tuple[int, int] = (1, 1)
) -> Reprojection:
    """From the view whose lines have the poses ``here`` to that of ``there``.

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
    """px, about, that a point of inverse depth 1 / m moves between two views; ``back`` maps the other way."""
    way = np.mean(back.c, axis=0) - np.mean(maps.c, axis=0)
    return max(camera.fx, camera.fy) * float(np.linalg.norm(way))


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
def homography(x: int, y: int, line: int, maps: Reprojection) -> tuple[Vector, Vector]:
    """M and b of a pixel and a line of the other view: it sees the pixel's point at M + rho b, homogeneous."""
    G, c, A, B, own = maps.G, maps.c, maps.A[line], maps.B[line], line_of(maps.columns, x, y)
    gx, gy = look(maps.ideal, x, y)
    ray = apply(G[own], (gx, gy, 1.0))
    centre = apply(A, (c[own, 0], c[own, 1], c[own, 2]))
    return apply(A, ray), (centre[0] + B[0], centre[1] + B[1], centre[2] + B[2])


@compiled(error_model="numpy", inline="always")
def land(M: Vector, b: Vector, rho: float, lens: Table) -> tuple[float, float, float]:
    """Pixel and depth factor there of ``homography``; NaN behind the camera."""
    z = M[2] + rho * b[2]
    s = 1.0 / z if z > 0.0 else np.nan
    u, v = see(lens, (M[0] + rho * b[0]) * s, (M[1] + rho * b[1]) * s)
    return u, v, s


@compiled(error_model="numpy")
def reproject_all(rho: F32, lines: NDArray[np.int32], maps: Reprojection, places: F32, factors: F32) -> None:
    """Fill ``places`` (H, W, 2) px and depth factors (H, W) of all pixels of inverse depth ``rho`` (H, W).

    NaN where the other view does not see the point. ``lines`` (H, W) are those where the search begins and, after
    it, those where it ended.
    """
    height, width = rho.shape
    A, B, lens, there = maps.A, maps.B, maps.lens, maps.there
    last = len(A) - 1
    for y in range(height):
        for x in range(width):
            line, u, v, s, along = min(max(lines[y, x], 0), last), np.nan, np.nan, np.nan, np.nan
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
            inside = -0.5 < u < width - 0.5 and -0.5 < v < height - 0.5
            places[y, x, 0] = u if inside else np.nan
            places[y, x, 1] = v if inside else np.nan
            factors[y, x] = s if inside else np.nan


def reproject_pixels(maps: Reprojection, rho: F32, lines: NDArray[Any]) -> tuple[F32, F32]:
    """``reproject_all`` into new arrays."""
    places, factors = np.zeros((*rho.shape, 2), np.float32), np.zeros_like(rho)
    reproject_all(rho, lines, maps, places, factors)
    return places, factors
