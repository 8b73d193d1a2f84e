"""Image scores as published correction methods compute them, to compare with their tables; and FLIP.

The protocol of this package is ``rsbench.vision.quality``. Others differ in the second digit of SSIM: a Gaussian
window whose centre lies half a pixel off, with zeros beyond the border (DeepUnrollNet, and from there RSSR, CVR,
QRSC), or a uniform window with the sample covariance (scikit-image's default, as in EvUnroll). Their PSNR is ours
on 8-bit images without a mask, whether the estimate is rounded or not, for ours are rounded.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray
from rsbench.vision.quality import Picture, Window, picture_of, ssim_map

_SIZE, _SIGMA = 11, 1.5
_UNIFORM = 7
Image = NDArray[np.uint8] | Picture
"""(H, W[, C])."""


def ssim_deepunroll(estimate: Image, truth: Image) -> float:
    """SSIM of images (H, W[, C]) with DeepUnrollNet's window, centred at 5.5 of 0 ... 10; all windows count."""
    return float(np.mean(ssim_map(picture_of(estimate), picture_of(truth), _DEEPUNROLL)))


def psnr_deepunroll(estimate: Image, truth: Image, weights: FloatArray | None = None) -> float:
    """PSNR in dB of images (H, W[, C]) as DeepUnrollNet has it: each pixel with its weight (H, W), 100 if equal.

    NaN where no pixel has weight. Its masks are images, whose values are the weights.
    """
    difference = picture_of(estimate).unit - picture_of(truth).unit
    squares = (difference * difference).reshape(*difference.shape[:2], -1).mean(axis=-1)
    weights = np.ones_like(squares) if weights is None else weights
    total = float(np.sum(weights))
    if total == 0.0:
        return math.nan
    error = float(np.sum(squares * weights)) / total
    return 100.0 if error == 0.0 else -10.0 * math.log10(error)


def ssim_uniform(estimate: Image, truth: Image) -> float:
    """SSIM of images (H, W[, C]) over the 7 x 7 uniform windows inside the image, with the sample covariance."""
    rim = _UNIFORM // 2
    scores = ssim_map(picture_of(estimate), picture_of(truth), _SAMPLES)
    return float(np.mean(scores[rim:-rim, rim:-rim]))


def _off_centre(image: FloatArray) -> FloatArray:
    window = np.exp(-((np.arange(_SIZE) - _SIZE / 2) ** 2) / (2 * _SIGMA**2))
    window /= window.sum()
    # Not mirrored, as a network's convolution.
    filtered = cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered).reshape(image.shape)


def _evenly(image: FloatArray) -> FloatArray:
    return np.asarray(cv2.blur(image, (_UNIFORM, _UNIFORM))).reshape(image.shape)


_DEEPUNROLL = Window(_off_centre)
_SAMPLES = Window(_evenly, _UNIFORM**2 / (_UNIFORM**2 - 1))


def flip(estimate: NDArray[np.uint8], truth: NDArray[np.uint8]) -> FloatArray | None:
    """FLIP error (H, W) in [0, 1] of RGB images (H, W, 3): what one sees who switches between both.

    At 67 pixels per degree, the metric's default; None where its package has no wheel. Andersson et al., FLIP: A
    difference evaluator for alternating images, HPG 2020, by the authors' implementation.
    """
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return None
    images = [np.ascontiguousarray(image, dtype=np.float32) / np.float32(255.0) for image in (truth, estimate)]
    errors, _, _ = evaluate(*images, "LDR", applyMagma=False)
    return np.asarray(errors, dtype=np.float64).reshape(truth.shape[:2])
