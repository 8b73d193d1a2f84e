"""A camera as compiled loops see it: where its pixels look, where it sees a point, and which line reads a pixel.

An ideal camera is the special case: its pixels look where they are, and its loops are compiled without a lens.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rsbench.components.compiled import compiled
from rsbench.core.camera import PinholeCamera
from rsbench.core.so3 import FloatArray

Table = FloatArray | None


class Optics(NamedTuple):
    """What ``optics_of`` makes of a camera and its scan.

    The lens of an ideal camera is None: the compiler then leaves the branches away that would look at it. Rows and
    columns share one compilation: telling them apart costs less than a second one.
    """

    ideal: Table
    """(H, W, 2) px at which the camera without its lens sees what a pixel sees; None where there is no lens."""
    lens: Table
    """(12,) fx, fy, cx, cy, reach, whether a fisheye, k1, k2, p1, p2, k3, k4; None where there is no lens."""
    columns: bool
    """Whether lines, each read at one time, are columns."""


class LineMaps(NamedTuple):
    """Of each line of a frame its map of ideal pixels to another camera's, with the optics of both.

    Homogeneous target pixel = M_y (x, y, 1) + b_y / depth, and the target has the lens of the source.
    """

    M: FloatArray
    """(lines, 3, 3)."""
    b: FloatArray
    """(lines, 3) px m."""
    ideal: Table
    """Of ``Optics``, as the next two."""
    lens: Table
    columns: bool


@lru_cache(maxsize=4)
def optics_of(camera: PinholeCamera, columns: bool = False) -> Optics:
    """The camera for compiled loops."""
    lens = camera.lens
    if lens is None:
        return Optics(None, None, columns)
    fisheye = float(lens.model == "kannala-brandt")
    coefficients = (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, lens.reach, fisheye, *coefficients)
    return Optics(_ideal_pixels(camera), np.array(numbers), columns)


@lru_cache(maxsize=2)
def _ideal_pixels(camera: PinholeCamera) -> FloatArray:
    return np.ascontiguousarray(camera.ideal_pixels(camera.pixel_grid()))


# Not inlined by Numba, which would then not leave out the branch of what is None: LLVM inlines them.
@compiled(error_model="numpy")
def look(ideal: Table, x: int, y: int) -> tuple[float, float]:
    """Ideal pixel of a pixel of the image."""
    if ideal is None:
        return float(x), float(y)
    return ideal[y, x, 0], ideal[y, x, 1]


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


@compiled(error_model="numpy")
def distort(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """``rsbench.core.camera.Lens.distort`` of one ideal pixel, in pixels; NaN beyond the lens's reach."""
    x, y = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    s = x * x + y * y
    if not s < lens[4] * lens[4]:  # NaN included
        return np.nan, np.nan
    k1, k2, p1, p2, k3, k4 = lens[6], lens[7], lens[8], lens[9], lens[10], lens[11]
    if lens[5] > 0.0:
        r = np.sqrt(s)
        angle = np.arctan(r)
        a = angle * angle
        # atan r = r - r^3 / 3: what is left out near the axis is below rounding.
        bent = angle / r if r > 1e-6 else 1.0 - s / 3.0
        gain = bent * (1.0 + a * (k1 + a * (k2 + a * (k3 + a * k4))))
        xd, yd = x * gain, y * gain
    else:
        gain = 1.0 + s * (k1 + s * (k2 + s * k3))
        xd = x * gain + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
        yd = y * gain + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return xd * lens[0] + lens[2], yd * lens[1] + lens[3]
