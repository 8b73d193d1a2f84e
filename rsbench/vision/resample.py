"""Sampling an image at sub-pixel positions.

The cubic kernel is Keys' with a = -1/2, the only one of its family that reproduces straight lines and parabolas.
OpenCV's has a = -3/4: on a plain ramp it is wrong by up to 0.035 px, as much as a good disparity map.

Keys, "Cubic convolution interpolation for digital image processing", ASSP 1981.
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled

F32 = NDArray[np.float32]
Interpolation = Literal["cubic", "linear"]
_FEW, _PACKED = 4, 512
"""Positions for one that is not NaN, below which these are sampled in rows of so many."""
Weights = tuple[np.float32, np.float32, np.float32, np.float32]


def resample(image: NDArray[Any], positions: F32, interpolation: Interpolation = "cubic") -> NDArray[Any]:
    """Values (h, w[, C]) of ``image`` (H, W[, C]) at ``positions`` (h, w, 2), px; 0 where a position is NaN.

    Computed in float32 and rounded once where the image holds integers; the border pixels are repeated outward.
    ``image`` is uint8, uint16 or float32.
    """
    known = ~np.isnan(positions[..., 0])
    if _FEW * np.count_nonzero(known) < known.size:
        return _resample_few(image, positions, known, interpolation)
    source = np.ascontiguousarray(image, dtype=np.float32)
    if interpolation == "linear":
        places = np.where(known[..., None], positions, np.float32(0.0))
        values = cv2.remap(source, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values = values.reshape(*positions.shape[:2], *image.shape[2:])
        values[~known] = 0.0
    else:
        values = np.zeros((*positions.shape[:2], *image.shape[2:]), dtype=np.float32)
        _cubic(np.atleast_3d(source), positions, np.atleast_3d(values))
    if image.dtype == np.float32:
        return values
    largest = np.float32(np.iinfo(image.dtype).max)
    # Half is added and the fraction cut off: rounding, several times faster than np.rint.
    return (np.clip(values, 0.0, largest) + np.float32(0.5)).astype(image.dtype)


def _resample_few(
    image: NDArray[Any], positions: F32, known: NDArray[np.bool_], interpolation: Interpolation
) -> NDArray[Any]:
    """``resample`` of few ``known`` (h, w) positions."""
    out = np.zeros((*known.shape, *image.shape[2:]), dtype=image.dtype)
    some = positions[known]
    if len(some):
        places = np.zeros((-(-len(some) // _PACKED), _PACKED, 2), dtype=np.float32)
        places.reshape(-1, 2)[: len(some)] = some
        out[known] = resample(image, places, interpolation).reshape(-1, *image.shape[2:])[: len(some)]
    return out


@compiled(error_model="numpy", fastmath={"contract"})
def keys_weights(t: np.float32) -> Weights:
    """Weights of the samples at -1, 0, 1, 2 for position t in [0, 1]."""
    half, t2 = np.float32(0.5), t * t
    t3 = t2 * t
    return (
        half * (np.float32(2.0) * t2 - t - t3),
        np.float32(1.0) - np.float32(2.5) * t2 + np.float32(1.5) * t3,
        half * (t + np.float32(4.0) * t2 - np.float32(3.0) * t3),
        half * (t3 - t2),
    )


@compiled(error_model="numpy", fastmath={"contract"})
def _cubic(image: F32, positions: F32, values: F32) -> None:
    height, width, channels = image.shape
    flat = image.ravel()
    for y in range(positions.shape[0]):
        for x in range(positions.shape[1]):
            px, py = positions[y, x, 0], positions[y, x, 1]
            if px >= 1.0 and py >= 1.0 and px < width - 2.0 and py < height - 2.0:
                # A constant number of channels lets the compiler unroll: half the time for colour.
                if channels == 3:
                    _pixel(flat, width, 3, px, py, values, y, x)
                elif channels == 1:
                    _pixel(flat, width, 1, px, py, values, y, x)
                else:
                    _pixel(flat, width, channels, px, py, values, y, x)
            elif abs(px) < 1e9 and abs(py) < 1e9:
                _border_pixel(image, px, py, values, y, x)


@compiled(error_model="numpy", fastmath={"contract"}, inline="always")
def _pixel(
    flat: F32, width: int, channels: int, px: np.float32, py: np.float32, values: F32, y: int, x: int
) -> None:
    # Unsigned offsets spare numba's test for negative indices.
    i, j, step, line = np.uint64(px), np.uint64(py), np.uint64(channels), np.uint64(width * channels)
    wx, wy = keys_weights(px - np.float32(i)), keys_weights(py - np.float32(j))
    first = (j - np.uint64(1)) * line + (i - np.uint64(1)) * step
    for c in range(channels):
        at = first + np.uint64(c)
        total = wy[0] * _taps(flat, at, step, wx)
        total += wy[1] * _taps(flat, at + line, step, wx)
        total += wy[2] * _taps(flat, at + np.uint64(2) * line, step, wx)
        total += wy[3] * _taps(flat, at + np.uint64(3) * line, step, wx)
        values[y, x, c] = total


@compiled(error_model="numpy", fastmath={"contract"}, inline="always")
def _taps(flat: F32, at: np.uint64, step: np.uint64, w: Weights) -> np.float32:
    two = np.uint64(2) * step
    return w[0] * flat[at] + w[1] * flat[at + step] + w[2] * flat[at + two] + w[3] * flat[at + two + step]


@compiled(error_model="numpy")
def _border_pixel(image: F32, px: np.float32, py: np.float32, values: F32, y: int, x: int) -> None:
    """One position whose window leaves the image: the border pixels are repeated outward."""
    height, width, channels = image.shape
    i, j = int(np.floor(px)), int(np.floor(py))
    wx, wy = keys_weights(np.float32(px - i)), keys_weights(np.float32(py - j))
    for c in range(channels):
        total = np.float32(0.0)
        for k in range(4):
            row = image[min(max(j - 1 + k, 0), height - 1)]
            for n in range(4):
                total += wy[k] * wx[n] * row[min(max(i - 1 + n, 0), width - 1), c]
        values[y, x, c] = total
