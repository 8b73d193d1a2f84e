"""Sky detection in a frame: a guess from its texture, for semi-global matching cannot tell.

Without texture the matcher carries the disparity of the neighbours on, so the sky comes out as far as the roof
below it. Here the sky is a large smooth area that reaches the upper border, not darker than the middle of the
image, not redder than it is blue, and with only far surfaces around it. A white wall can pass as sky where nothing
near it has a depth; the answer is an estimate.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.vision.images import grey_u8

Mask = NDArray[np.bool_]
_SMOOTH = 2.0
"""Largest standard deviation, grey levels, of 3 x 3 pixels of sky."""
_LEAST_SHARE = 0.002
"""Of the image; smaller areas are left alone."""
_FAR_QUANTILE = 0.4
"""Of all disparities: what surrounds the sky is farther than this."""
_RIM = 7
_REDDER = 6.0
"""Levels by which the mean red of the sky may exceed its mean blue."""


def sky_mask(image: NDArray[Any], disparity: NDArray[np.float32]) -> Mask:
    """Pixels (H, W) that look like sky in ``image`` (H, W[, 3] RGB), uint8 or uint16.

    ``disparity`` (H, W), px, NaN where unknown.
    """
    grey = grey_u8(image).astype(np.float32)
    mean = cv2.blur(grey, (3, 3))
    deviation = np.sqrt(np.maximum(cv2.blur(grey * grey, (3, 3)) - mean * mean, 0.0))
    smooth = (deviation <= _SMOOTH).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(smooth, connectivity=4)
    sky = np.zeros(grey.shape, dtype=np.bool_)
    known = np.isfinite(disparity)
    if not np.any(known):
        return sky
    far = float(np.quantile(disparity[known], _FAR_QUANTILE))
    brightness = float(np.median(grey))
    for label in range(1, count):
        if stats[label, cv2.CC_STAT_TOP] > 0 or stats[label, cv2.CC_STAT_AREA] < _LEAST_SHARE * grey.size:
            continue
        area = labels == label
        if float(np.mean(grey[area])) >= brightness and _is_blue(image, area) and _is_far(area, disparity, far):
            sky |= area
    # The 3 x 3 windows that touch an edge were not smooth: one pixel of the sky along it is missing.
    return cv2.dilate(sky.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _is_blue(image: NDArray[Any], area: Mask) -> bool:
    if image.ndim == 2 or image.shape[2] == 1:
        return True
    levels = 1.0 if image.dtype == np.uint8 else 257.0
    red, blue = (float(np.mean(image[..., channel][area])) / levels for channel in (0, 2))
    return red - blue <= _REDDER


def _is_far(area: Mask, disparity: NDArray[np.float32], far: float) -> bool:
    """Whether most of what surrounds the area is far; an area with no known rim may be sky."""
    grown = cv2.dilate(area.astype(np.uint8), np.ones((2 * _RIM + 1, 2 * _RIM + 1), np.uint8)) > 0
    rim = disparity[grown & ~area]
    rim = rim[np.isfinite(rim)]
    return rim.size == 0 or float(np.quantile(rim, 0.25)) <= far
