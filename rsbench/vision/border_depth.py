"""Inverse depth in bands along an image's border, of what the other view does not show.

That of a plane is an affine function of the pixel, so that of a floor, a wall or a road goes on as a line in its
row or column. The farther neighbour, as behind an edge, would bend them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
_FITTED, _WIDEST = 0.125, 0.15
"""Of the image's height or width: what a line is fitted to beside a band, and how wide that is at most."""
_BESIDE = 1 / 16
"""Columns to either side, of the width, whose slopes count."""
_ON_LINE = 0.05
"""Root mean square off the line, of the inverse depth there, up to which there is one."""
_MOST = 1.5
"""Times the largest inverse depth that is known."""
_START = 5
"""Pixels whose median the line goes through, in their middle."""


def continued(rho: F32) -> F32:
    """Inverse depth (h, w), NaN where it is unknown, with bands along the border that are unknown filled."""
    if not np.any(np.isfinite(rho)):
        return rho
    most = _MOST * float(np.nanmax(rho))
    for _ in range(2):  # lower and upper ends of columns, then, turned, the ends of rows
        rho = _below(_below(rho, most)[::-1], most)[::-1].T
    return rho


def _below(rho: F32, most: float) -> F32:
    """``rho`` (h, w) with the unknown lower ends of columns filled, where what is above them is a line."""
    height, width = rho.shape
    known = np.isfinite(rho)
    last = np.where(known.any(axis=0), height - 1 - np.argmax(known[::-1], axis=0), -1)
    away = (np.arange(height)[:, None] - last).astype(np.float64)
    reach = max(int(_FITTED * height), 4)
    used = known & (away > -reach) & (away <= 0.0)
    count = np.maximum(used.sum(axis=0), 1)
    t, r = np.where(used, away, 0.0), np.where(used, rho, 0.0)
    mean_t, mean_r = t.sum(axis=0) / count, r.sum(axis=0) / count
    spread = np.maximum((t * t).sum(axis=0) / count - mean_t**2, 1e-9)
    slope = ((t * r).sum(axis=0) / count - mean_t * mean_r) / spread
    off = np.where(used, rho - (mean_r + slope * (away - mean_t)), 0.0)
    error = np.sqrt((off * off).sum(axis=0) / count)
    line = (count >= reach // 2) & (error < _ON_LINE * (mean_r - slope * mean_t)) & (last < height - 1)
    line &= height - 1 - last < _WIDEST * height
    if not np.any(line):
        return rho
    beside = int(_BESIDE * width)
    slopes = np.pad(np.where(line, slope, np.nan), beside, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(slopes, 2 * beside + 1)[line]
    start = np.nanmedian(np.where(used & (away > -_START), rho, np.nan)[:, line], axis=0)
    out = rho.copy()
    values = np.clip(start + np.nanmedian(windows, axis=1) * (away[:, line] + _START // 2), 0.0, most)
    out[:, line] = np.where(away[:, line] > 0.0, values, rho[:, line])
    return out
