"""Image quality: PSNR and SSIM on covered pixels, with one protocol.

Values are brought to [0, 1] (data range 1), never clamped or rounded. PSNR is ten times the logarithm of the mean
squared error over all channels of all counted pixels. SSIM (Wang et al. 2004) has an 11 x 11 Gaussian window of
sigma 1.5 and float64 moments, and is the mean over the channels and over the windows that lie inside the image.
Under a mask only windows without a single uncovered pixel count: filling the uncovered pixels, with either image,
would score the filling. This leaves out a rim of 5 px around every hole, so pictures that are compared must be
scored under the same mask.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(estimate: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio in dB of images (H, W[, C]); inf when equal, NaN when the mask is empty.

    Images are uint8, uint16 or floating point in [0, 1]; ``mask`` (H, W) tells which pixels count, all by default.
    Raises ValueError on shapes or types that do not fit.
    """
    a, b = _pair(estimate, truth, mask)
    difference = a - b if mask is None else (a - b)[mask]
    if difference.size == 0:
        return math.nan
    error = float(np.mean(difference * difference))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def ssim(estimate: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity of images (H, W[, C]) over the windows that ``mask`` covers entirely.

    NaN when no window is covered. Arguments and errors as for ``psnr``.
    """
    return ssim_within(estimate, truth, (mask,))[0]


def ssim_within(
    estimate: NDArray[Any], truth: NDArray[Any], masks: Sequence[NDArray[np.bool_] | None]
) -> list[float]:
    """``ssim`` for each of several masks, at the cost of one."""
    for mask in masks:
        _check_pair(estimate, truth, mask)
    a, b = to_unit(estimate), to_unit(truth)
    chosen = [window_mask(truth.shape[:2], mask) for mask in masks]
    if not any(np.any(windows) for windows in chosen):
        return [math.nan for _ in chosen]
    scores = ssim_map(a, b, _blur)
    return [float(np.mean(scores[windows])) if np.any(windows) else math.nan for windows in chosen]


def window_mask(size: tuple[int, ...], mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """(H, W) centres of the SSIM windows that lie inside the image and inside ``mask``."""
    covered = np.ones(size, dtype=np.uint8) if mask is None else mask.astype(np.uint8)
    kernel = np.ones((2 * _RADIUS + 1, 2 * _RADIUS + 1), dtype=np.uint8)
    return cv2.erode(covered, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(np.bool_)


def ssim_map(
    a: FloatArray, b: FloatArray, mean: Callable[[FloatArray], FloatArray], factor: float = 1.0
) -> FloatArray:
    """Local SSIM (H, W[, C]) of images in [0, 1].

    ``mean`` averages an image over the window of every pixel; ``factor`` multiplies variances and covariance.
    """
    mean_a, mean_b = mean(a), mean(b)
    var_a = factor * (mean(a * a) - mean_a * mean_a)
    var_b = factor * (mean(b * b) - mean_b * mean_b)
    covariance = factor * (mean(a * b) - mean_a * mean_b)
    luminance = (2.0 * mean_a * mean_b + _C1) / (mean_a * mean_a + mean_b * mean_b + _C1)
    return luminance * (2.0 * covariance + _C2) / (var_a + var_b + _C2)


def _blur(image: FloatArray) -> FloatArray:
    size = 2 * _RADIUS + 1
    return cv2.GaussianBlur(image, (size, size), _SIGMA, borderType=cv2.BORDER_REFLECT).reshape(image.shape)


def _pair(
    estimate: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_] | None
) -> tuple[FloatArray, FloatArray]:
    _check_pair(estimate, truth, mask)
    return to_unit(estimate), to_unit(truth)


def _check_pair(estimate: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_] | None) -> None:
    if estimate.shape != truth.shape or truth.ndim not in (2, 3):
        raise ValueError(f"images must have one shape (H, W) or (H, W, C), got {estimate.shape} and {truth.shape}")
    if mask is not None and (mask.shape != truth.shape[:2] or mask.dtype != np.bool_):
        raise ValueError(f"mask must be bool of shape {truth.shape[:2]}, got {mask.dtype} {mask.shape}")


def to_unit(image: NDArray[Any]) -> FloatArray:
    """Image as float64; integers are divided by the largest of their type."""
    if image.dtype in (np.uint8, np.uint16):
        return image.astype(np.float64) / np.iinfo(image.dtype).max
    if np.issubdtype(image.dtype, np.floating):
        return image.astype(np.float64)
    raise ValueError(f"images must be uint8, uint16 or floating point in [0, 1], got {image.dtype}")
