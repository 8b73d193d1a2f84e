"""Matching costs: how alike two images are around each pixel."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.vision.resample import resample

F32 = NDArray[np.float32]
_NOISE = 4.0
"""Variance of grey levels, about that of noise and rounding: windows with less are alike by chance."""


class Comparer:
    """Zero-mean normalised cross-correlation of one image with others."""

    def __init__(self, grey: F32, window: int) -> None:
        self._grey, self._window = grey - np.float32(128.0), (window, window)
        self._mean = self._box(self._grey)
        self._variance = self._box(self._grey * self._grey) - self._mean * self._mean

    def _box(self, values: NDArray[Any]) -> F32:
        return np.asarray(cv2.boxFilter(values, -1, self._window, borderType=cv2.BORDER_REFLECT))

    def cost_of(self, other: F32, places: F32, *, cubic: bool) -> F32:
        """0 (alike) to 1 (H, W) of the other image (H, W) at places (H, W, 2) px; NaN where those are NaN."""
        return np.where(
            np.isnan(places[..., 0]), np.float32(np.nan), self.compared(self._seen(other, places, cubic))
        )

    def compared(self, other: F32) -> F32:
        """0 (alike) to 1 (H, W) of another image (H, W) that lies on the same pixels."""
        seen = other - np.float32(128.0)
        mean = self._box(seen)
        variance = self._box(seen * seen) - mean * mean
        together = self._box(seen * self._grey) - mean * self._mean
        noise = np.float32(_NOISE)
        alike = together / np.sqrt((np.maximum(variance, 0) + noise) * (np.maximum(self._variance, 0) + noise))
        return np.asarray(np.float32(0.5) * (1.0 - alike), dtype=np.float32)

    @staticmethod
    def _seen(other: F32, places: F32, cubic: bool) -> F32:
        if cubic:
            return np.asarray(resample(other, places))
        known = np.nan_to_num(places, nan=0.0)
        return np.asarray(cv2.remap(other, known, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
