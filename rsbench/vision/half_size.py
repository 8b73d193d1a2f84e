"""Work at half the size, where time counts for more than the last of accuracy: images down, results up again."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]


def halved(image: U8) -> U8:
    """A grey image (H, W) at half the size, at least 1 x 1: each pixel the mean of those that it covers."""
    height, width = (max(side // 2, 1) for side in image.shape)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def at_full_size(points: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Points (n, 2) px of the halved image on one of this shape (H, W); the top-left pixel's centre is (0, 0)."""
    scale = np.array([side / max(side // 2, 1) for side in shape[1::-1]])
    return (points + 0.5) * scale - 0.5


def guided_upsample(values: F32, small: U8, grey: U8) -> F32:
    """Values (h, w) of the halved image ``small`` on the pixels (H, W) of ``grey``; NaN is unknown.

    Each pixel takes the value of that one of the four half-size pixels around it whose grey is nearest to its own,
    of equals the nearest one: borders lie where the image has them (J. Kopf et al., Joint bilateral upsampling,
    SIGGRAPH 2007, with a window of two pixels and the largest weight alone).
    """
    (height, width), (h, w) = grey.shape, small.shape
    y, x = ((np.arange(n) + 0.5) * (m / n) - 0.5 for n, m in ((height, h), (width, w)))
    best, found = np.full(grey.shape, np.inf, np.float32), np.full(grey.shape, np.nan, np.float32)
    wanted = grey.astype(np.float32)
    for down in (0, 1):
        rows = np.clip(np.rint(y) if down == 0 else _other(y), 0, h - 1).astype(np.intp)
        for right in (0, 1):
            columns = np.clip(np.rint(x) if right == 0 else _other(x), 0, w - 1).astype(np.intp)
            here = np.ix_(rows, columns)
            value, off = values[here], np.abs(small[here] - wanted)
            better = (off < best) & np.isfinite(value)
            best, found = np.where(better, off, best), np.where(better, value, found)
    return found


def _other(places: FloatArray) -> NDArray[Any]:
    """Of the two whole numbers around each place the one that is farther."""
    nearest = np.rint(places)
    return nearest + np.where(places >= nearest, 1.0, -1.0)
