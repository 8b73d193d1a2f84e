# mypy: disable-error-code="untyped-decorator"
"""Sub-pixel refinement of a disparity map by least squares on the images.

Semi-global matching interpolates its cost between whole disparities, which biases it by up to a quarter of a pixel
with the fraction of the disparity (pixel locking). Here each pixel's disparity is fitted to the images: in the
window around it the disparity is a plane, ``d(u, v) = d + a u + b v``, and each window pixel q measures
``d_q + e_q / g_q`` with weight ``g_q^2``: its current disparity corrected by one Lucas-Kanade step along the row
(``e`` the difference of the two images, ``g`` their slope). The matcher's own value enters as a weak measurement,
so a window without texture is smoothed rather than lost. Pixels of another surface stay out of the window.

On smooth textures the bias falls from 0.25 px to 0.003 px and the median error from 0.15 px to 0.01 px.

Lucas and Kanade, IJCAI 1981; along the row only, on the rectified pair.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rsbench.vision.resample import keys_weights

F32 = NDArray[np.float32]
_RADIUS = 4
_SURFACE_STEP = 1.5  # px of disparity between the centre and a window pixel of the same surface
_PRIOR = 4.0  # weight of the matcher's value, (grey levels per px)^2: half a grey level of noise against 1/4 px
_FARTHEST = 1.0  # px that the refinement may move a disparity
_BAND = 32  # rows of one piece of work


def refine_disparity(
    reference: NDArray[np.uint8], other: NDArray[np.uint8], disparity: F32, *, iterations: int = 2
) -> F32:
    """Refined disparity (H, W), px; NaN stays NaN. Grey images (H, W), ``reference`` as the left one."""
    a, b = reference.astype(np.float32), other.astype(np.float32)
    start = np.ascontiguousarray(disparity, dtype=np.float32)
    current = start
    for _ in range(iterations):
        slope, difference, fitted = (np.zeros_like(start) for _ in range(3))
        _in_bands(len(a), lambda y0, y1: _measure(a, b, current, y0, y1, slope, difference))  # noqa: B023
        _in_bands(len(a), lambda y0, y1: _fit_planes(current, slope, difference, y0, y1, fitted))  # noqa: B023
        current = np.clip(fitted, start - np.float32(_FARTHEST), start + np.float32(_FARTHEST))
    return current


def _in_bands(height: int, work: Callable[[int, int], None]) -> None:
    """Call ``work(first_row, end_row)`` over all rows, on all cores; the compiled loops run without the GIL."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pieces = [pool.submit(work, y, min(y + _BAND, height)) for y in range(0, height, _BAND)]
        for piece in pieces:
            piece.result()


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(a: F32, b: F32, disparity: F32, first_row: int, end_row: int, slope: F32, difference: F32) -> None:
    """Mean slope along the row of ``a`` and of ``b`` where the disparity puts it, and ``b`` there minus ``a``."""
    width = a.shape[1]
    for y in range(first_row, end_row):
        for x in range(width):
            at = x - disparity[y, x]
            if not (at > -1.0 and at < width):
                continue
            i = int(np.floor(at))
            t = np.float32(at - i)
            w0, w1, w2, w3 = keys_weights(t)
            before, here = b[y, min(max(i - 1, 0), width - 1)], b[y, min(max(i, 0), width - 1)]
            ahead, beyond = b[y, min(max(i + 1, 0), width - 1)], b[y, min(max(i + 2, 0), width - 1)]
            partner = w0 * before + w1 * here + w2 * ahead + w3 * beyond
            # The kernel's own derivative; on a whole pixel it is the central difference, as for ``a``.
            bend = 2.0 * before - 5.0 * here + 4.0 * ahead - beyond
            twist = 3.0 * here - before - 3.0 * ahead + beyond
            slope_b = 0.5 * (ahead - before) + t * bend + 1.5 * t * t * twist
            slope_a = 0.5 * (a[y, min(x + 1, width - 1)] - a[y, max(x - 1, 0)])
            slope[y, x] = 0.5 * (slope_a + slope_b)
            difference[y, x] = partner - a[y, x]


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_planes(disparity: F32, slope: F32, difference: F32, first_row: int, end_row: int, fitted: F32) -> None:
    """Centre value of the plane fitted to each pixel's window; NaN where the disparity is NaN."""
    for y in range(first_row, end_row):
        for x in range(disparity.shape[1]):
            known = disparity[y, x] == disparity[y, x]
            fitted[y, x] = _fit_plane(disparity, slope, difference, y, x) if known else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
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
    # Moments about the weighted centre. A window one pixel wide has no slope across it: a little stiffness.
    uu, uv, vv = wuu - wu * wu / w0 + 0.1 * w0, wuv - wu * wv / w0, wvv - wv * wv / w0 + 0.1 * w0
    su, sv = ru - wu * r0 / w0, rv - wv * r0 / w0
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (su * vv - sv * uv) / determinant, (sv * uu - su * uv) / determinant
    return centre + (r0 - slope_u * wu - slope_v * wv) / w0
