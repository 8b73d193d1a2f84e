"""From linear radiance to the 8-bit images of a dataset."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def to_srgb8(image: ArrayLike, exposure: float) -> NDArray[np.uint8]:
    """8-bit sRGB (IEC 61966-2-1) of linear radiance (..., 3) times ``exposure``, clipped to [0, 1], rounded."""
    linear = np.asarray(image, dtype=np.float32) * np.float32(exposure)
    return np.round(srgb_of(linear) * 255.0).astype(np.uint8)


def linear_of_codes(codes: ArrayLike) -> NDArray[np.float64]:
    """Linear values of 8-bit sRGB codes (...), also between them: the inverse of ``to_srgb8`` at exposure 1."""
    encoded = np.clip(np.asarray(codes, dtype=np.float64) / 255.0, 0.0, 1.0)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def srgb_of(linear: NDArray[Any]) -> NDArray[Any]:
    """sRGB values (...), from 0 to 1, of linear ones, clipped; of their type."""
    linear = np.clip(linear, 0.0, 1.0)
    curve = 1.055 * np.power(np.maximum(linear, 0.0031308), 1 / 2.4) - 0.055
    return np.asarray(np.where(linear <= 0.0031308, 12.92 * linear, curve))
