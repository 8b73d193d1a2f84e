# mypy: disable-error-code="untyped-decorator"
"""Sub-pixel refinement of a disparity map by least squares on the images.

Semi-global matching interpolates its cost between whole disparities, which pulls its answers towards them (pixel
locking). Here each pixel's disparity is fitted to the images: in the window around it the disparity is a plane,
``d(u, v) = d + a u + b v``, and each window pixel q measures ``d_q + g_q e_q / g_q^2`` with weight ``g_q^2``, its
current disparity corrected by one Lucas-Kanade step along the row (``e`` the difference of the two images, ``g``
their slope). The matcher's own value enters as a weak measurement, so a window without texture is smoothed
rather than lost. Pixels of another surface stay out of the window.

Lucas and Kanade, IJCAI 1981; along the row only, on the rectified pair.
"""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
_RADIUS = 4
_SURFACE_STEP = 1.5  # px of disparity between the centre and a window pixel of the same surface
_PRIOR = 16.0  # weight of the matcher's value, (grey levels per px)^2: 1 grey level of noise against 1/4 px
_FARTHEST = 1.0  # px that the refinement may move a disparity


def refine_disparity(
    reference: NDArray[np.uint8], other: NDArray[np.uint8], disparity: F32, *, iterations: int = 2
) -> F32:
    """Refined disparity (H, W), px; NaN stays NaN. Grey images (H, W), ``reference`` as the left one."""
    a, b = reference.astype(np.float32), other.astype(np.float32)
    slope_a, slope_b = _slope(a), _slope(b)
    x, y = np.meshgrid(np.arange(a.shape[1], dtype=np.float32), np.arange(a.shape[0], dtype=np.float32))
    start = np.asarray(disparity, dtype=np.float32)
    current = start
    for _ in range(iterations):
        partner = np.nan_to_num(x - current)
        warped = cv2.remap(b, partner, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        warped_slope = cv2.remap(slope_b, partner, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        slope = 0.5 * (slope_a + warped_slope)
        fitted = _fit_planes(current, slope, warped - a)
        current = np.clip(fitted, start - _FARTHEST, start + _FARTHEST)
    return current


def _slope(image: F32) -> F32:
    return cv2.filter2D(
        image, cv2.CV_32F, np.array([[-0.5, 0.0, 0.5]], dtype=np.float32), borderType=cv2.BORDER_REPLICATE
    )


@njit(cache=True, error_model="numpy")
def _fit_planes(disparity: F32, slope: F32, difference: F32) -> F32:
    """Centre value of the plane fitted to each pixel's window; NaN where the disparity is NaN."""
    height, width = disparity.shape
    fitted = np.full((height, width), np.nan, dtype=np.float32)
    for y in range(height):
        for x in range(width):
            centre = disparity[y, x]
            if centre == centre:
                fitted[y, x] = _fit_plane(disparity, slope, difference, y, x)
    return fitted


@njit(cache=True, error_model="numpy")
def _fit_plane(disparity: F32, slope: F32, difference: F32, y: int, x: int) -> float:
    height, width = disparity.shape
    centre = disparity[y, x]
    w0 = wu = wv = wuu = wuv = wvv = r0 = ru = rv = 0.0
    for row in range(max(y - _RADIUS, 0), min(y + _RADIUS + 1, height)):
        for column in range(max(x - _RADIUS, 0), min(x + _RADIUS + 1, width)):
            offset = disparity[row, column] - centre
            if not abs(offset) <= _SURFACE_STEP:
                continue
            g = slope[row, column]
            weight = g * g + _PRIOR
            value = weight * offset + g * difference[row, column]
            u, v = float(column - x), float(row - y)
            w0 += weight
            wu += weight * u
            wv += weight * v
            wuu += weight * u * u
            wuv += weight * u * v
            wvv += weight * v * v
            r0 += value
            ru += value * u
            rv += value * v
    return centre + _solve(w0, wu, wv, wuu, wuv, wvv, r0, ru, rv)


@njit(cache=True, error_model="numpy")
def _solve(
    w0: float, wu: float, wv: float, wuu: float, wuv: float, wvv: float, r0: float, ru: float, rv: float
) -> float:
    """First unknown of the symmetric 3 x 3 system; the weighted mean where the window is too thin for a plane."""
    uu, uv, vv = wuu - wu * wu / w0, wuv - wu * wv / w0, wvv - wv * wv / w0
    # A window one pixel wide has no slope across: a little stiffness keeps it flat there.
    uu, vv = uu + 0.1 * w0, vv + 0.1 * w0
    su, sv = ru - wu * r0 / w0, rv - wv * r0 / w0
    determinant = uu * vv - uv * uv
    a = (su * vv - sv * uv) / determinant
    b = (sv * uu - su * uv) / determinant
    return (r0 - a * wu - b * wv) / w0
