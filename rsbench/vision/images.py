"""What images may be, and their grey values."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_WINDOW = 9
_BRIGHT = 99.9
"""Percentile of a 16-bit image that becomes white for matching."""


def grey_u8(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Grey (H, W) uint8 of an image (H, W), (H, W, 1) or (H, W, 3) RGB, uint8 or uint16.

    Raises ValueError on other shapes and types.
    """
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3)) or image.size == 0:
        raise ValueError(f"image must have shape (H, W), (H, W, 1) or (H, W, 3), got {image.shape}")
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image must be uint8 or uint16, got {image.dtype}")
    grey = image if image.ndim == 2 else image[..., 0]
    if image.ndim == 3 and image.shape[2] == 3:
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
    if grey.dtype == np.uint16:
        grey = np.rint(grey / 257.0)
    return np.ascontiguousarray(grey, dtype=np.uint8)


def eight_bit(images: list[NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Images for matching; 16-bit ones are brought to 8 bits by one factor, for they may use few of their bits."""
    if images[0].dtype == np.uint8:
        return images
    top = max(float(np.percentile(image, _BRIGHT)) for image in images)
    scale = np.float32(255.0 / max(top, 1.0))
    return [np.clip(image * scale + np.float32(0.5), 0.0, 255.0).astype(np.uint8) for image in images]


def local_variance(image: NDArray[Any]) -> NDArray[np.float32]:
    """(H, W) of the grey levels around each pixel of an 8-bit image (H, W[, 3])."""
    grey = grey_u8(image).astype(np.float32)
    mean, square = (cv2.blur(each, (_WINDOW, _WINDOW)) for each in (grey, grey * grey))
    return np.asarray(square - mean * mean)
