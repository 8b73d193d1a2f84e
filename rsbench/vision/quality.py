"""Image quality: PSNR and SSIM on covered pixels, with one protocol; the protocols of others; and FLIP.

Values are brought to [0, 1] (data range 1), never clamped or rounded. PSNR is ten times the logarithm of the mean
squared error over all channels of all counted pixels. SSIM (Wang et al. 2004) has an 11 x 11 Gaussian window of
sigma 1.5 and float64 moments, and is the mean over the channels and over the windows that lie inside the image.
Under a mask only windows without a single uncovered pixel count: filling the uncovered pixels, with either image,
would score the filling. This leaves out a rim of 5 px around every hole, so pictures that are compared must be
scored under the same mask.

Published correction methods differ in the second digit of SSIM: a Gaussian window whose centre lies half a pixel
off, with zeros beyond the border (DeepUnrollNet, and from there RSSR, CVR, QRSC), or a uniform window with the
sample covariance (scikit-image's default, as in EvUnroll). Their PSNR is ours on 8-bit images without a mask,
whether the estimate is rounded or not, for ours are rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


class Window(NamedTuple):
    """The window of SSIM around every pixel."""

    mean: Callable[[FloatArray], FloatArray]
    """Function that averages an image (H, W[, C]) over the window of every pixel."""
    factor: float = 1.0
    """Factor of the variances and the covariance."""


class Moments(NamedTuple):
    """Moments of the windows of an image (H, W[, C])."""

    mean: FloatArray
    variance: FloatArray


class Picture:
    """An image (H, W[, C]) with the quantities that comparisons need, each computed once."""

    def __init__(self, image: NDArray[Any]) -> None:
        self.image = image
        self._moments: dict[Window, Moments] = {}

    @cached_property
    def unit(self) -> FloatArray:
        """Values in [0, 1], by ``to_unit``."""
        return to_unit(self.image)

    def moments(self, window: Window) -> Moments:
        """Moments of the image's values in [0, 1]."""
        if window not in self._moments:
            unit = self.unit
            mean = window.mean(unit)
            self._moments[window] = Moments(mean, window.factor * (window.mean(unit * unit) - mean * mean))
        return self._moments[window]


def picture_of(image: NDArray[Any] | Picture) -> Picture:
    return image if isinstance(image, Picture) else Picture(image)


def psnr(
    estimate: NDArray[Any] | Picture, truth: NDArray[Any] | Picture, mask: NDArray[np.bool_] | None = None
) -> float:
    """Peak signal-to-noise ratio in dB of images (H, W[, C]); inf if they are equal, NaN if the mask is empty.

    Images are uint8, uint16 or floating point in [0, 1]; ``mask`` (H, W) selects the pixels that count, by default
    all. Raises ValueError for unsuitable shapes or types.
    """
    return psnr_within(estimate, truth, (mask,))[0]


def psnr_within(
    estimate: NDArray[Any] | Picture, truth: NDArray[Any] | Picture, masks: Sequence[NDArray[np.bool_] | None]
) -> list[float]:
    """``psnr`` for each of several masks."""
    a, b = _pair(estimate, truth, masks)
    difference = a.unit - b.unit
    squares = difference * difference
    return [_decibels(squares if mask is None else squares[mask]) for mask in masks]


def _decibels(squares: FloatArray) -> float:
    if squares.size == 0:
        return math.nan
    error = float(np.mean(squares))
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


def ssim(
    estimate: NDArray[Any] | Picture, truth: NDArray[Any] | Picture, mask: NDArray[np.bool_] | None = None
) -> float:
    """Structural similarity of images (H, W[, C]) over the windows that ``mask`` covers entirely.

    NaN if no window is covered. Arguments and errors as for ``psnr``.
    """
    return ssim_within(estimate, truth, (mask,))[0]


def ssim_within(
    estimate: NDArray[Any] | Picture, truth: NDArray[Any] | Picture, masks: Sequence[NDArray[np.bool_] | None]
) -> list[float]:
    """``ssim`` for each of several masks, in the time of one."""
    a, b = _pair(estimate, truth, masks)
    chosen = [window_mask(b.image.shape[:2], mask) for mask in masks]
    if not any(np.any(windows) for windows in chosen):
        return [math.nan for _ in chosen]
    scores = ssim_map(a, b, GAUSSIAN)
    return [float(np.mean(scores[windows])) if np.any(windows) else math.nan for windows in chosen]


class LastSsim:
    """``ssim`` of one pair of images within several masks, one after the other, in the time of one."""

    def __init__(self) -> None:
        self._last: tuple[NDArray[Any], NDArray[Any], FloatArray] | None = None

    def within(self, estimate: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_]) -> float:
        """``ssim`` within a mask; the last images are recognised as the same objects and must not be modified."""
        a, b = _pair(estimate, truth, (mask,))
        windows = window_mask(truth.shape[:2], mask)
        if not np.any(windows):
            return math.nan
        last = self._last
        if last is None or last[0] is not estimate or last[1] is not truth:
            last = self._last = estimate, truth, ssim_map(a, b, GAUSSIAN)
        return float(np.mean(last[2][windows]))


def window_mask(size: tuple[int, ...], mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """(H, W) centres of the SSIM windows that lie inside the image and inside ``mask``."""
    covered = np.ones(size, dtype=np.uint8) if mask is None else mask.astype(np.uint8)
    kernel = np.ones((2 * _RADIUS + 1, 2 * _RADIUS + 1), dtype=np.uint8)
    return cv2.erode(covered, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(np.bool_)


def ssim_map(a: Picture, b: Picture, window: Window, constants: float = 1.0) -> FloatArray:
    """Local SSIM (H, W[, C]) of images; ``constants`` scales the two constants that prevent 0 / 0."""
    c1, c2 = constants * _C1, constants * _C2
    first, second = a.moments(window), b.moments(window)
    product = first.mean * second.mean
    covariance = window.factor * (window.mean(a.unit * b.unit) - product)
    luminance = (2.0 * product + c1) / (first.mean * first.mean + second.mean * second.mean + c1)
    return luminance * (2.0 * covariance + c2) / (first.variance + second.variance + c2)


def _blur(image: FloatArray) -> FloatArray:
    size = 2 * _RADIUS + 1
    return cv2.GaussianBlur(image, (size, size), _SIGMA, borderType=cv2.BORDER_REFLECT).reshape(image.shape)


GAUSSIAN = Window(_blur)


def _pair(
    estimate: NDArray[Any] | Picture, truth: NDArray[Any] | Picture, masks: Sequence[NDArray[np.bool_] | None]
) -> tuple[Picture, Picture]:
    a, b = picture_of(estimate), picture_of(truth)
    shape = b.image.shape
    if a.image.shape != shape or len(shape) not in (2, 3):
        raise ValueError(f"images must have one shape (H, W) or (H, W, C), got {a.image.shape} and {shape}")
    for mask in masks:
        if mask is not None and (mask.shape != shape[:2] or mask.dtype != np.bool_):
            raise ValueError(f"mask must be bool of shape {shape[:2]}, got {mask.dtype} {mask.shape}")
    for picture in (a, b):
        picture.unit  # noqa: B018  raises for other types, also where no window is compared
    return a, b


def to_unit(image: NDArray[Any]) -> FloatArray:
    """Image as float64; integers are divided by the largest of their type."""
    if image.dtype in (np.uint8, np.uint16):
        return image.astype(np.float64) / np.iinfo(image.dtype).max
    if np.issubdtype(image.dtype, np.floating):
        return image.astype(np.float64)
    raise ValueError(f"images must be uint8, uint16 or floating point in [0, 1], got {image.dtype}")


_OFF_CENTRE_SIZE, _OFF_CENTRE_SIGMA = 11, 1.5
_UNIFORM = 7
Image = NDArray[np.uint8] | Picture
"""(H, W[, C])."""


def ssim_deepunroll(estimate: Image, truth: Image) -> float:
    """SSIM of images (H, W[, C]) with DeepUnrollNet's window, centred at 5.5 of 0 ... 10; all windows count."""
    return float(np.mean(ssim_map(picture_of(estimate), picture_of(truth), _DEEPUNROLL)))


def psnr_deepunroll(estimate: Image, truth: Image, weights: FloatArray | None = None) -> float:
    """PSNR in dB of images (H, W[, C]) as computed by DeepUnrollNet: pixels have weights (H, W), and equal images
    get 100. NaN if no pixel has weight.

    Its masks are images, whose values are the weights.
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
    window = np.exp(-((np.arange(_OFF_CENTRE_SIZE) - _OFF_CENTRE_SIZE / 2) ** 2) / (2 * _OFF_CENTRE_SIGMA**2))
    window /= window.sum()
    # Not mirrored, like a network's convolution.
    filtered = cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered).reshape(image.shape)


def _evenly(image: FloatArray) -> FloatArray:
    return np.asarray(cv2.blur(image, (_UNIFORM, _UNIFORM))).reshape(image.shape)


_DEEPUNROLL = Window(_off_centre)
_SAMPLES = Window(_evenly, _UNIFORM**2 / (_UNIFORM**2 - 1))


def flip(estimate: NDArray[np.uint8], truth: NDArray[np.uint8]) -> FloatArray | None:
    """FLIP error (H, W) in [0, 1] of RGB images (H, W, 3): the difference that a viewer perceives when switching
    between both images.

    At 67 pixels per degree, the metric's default; None if its package has no wheel for this system. Andersson et
    al., FLIP: A difference evaluator for alternating images, HPG 2020, in the authors' implementation.
    """
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return None
    images = [np.ascontiguousarray(image, dtype=np.float32) / np.float32(255.0) for image in (truth, estimate)]
    errors, _, _ = evaluate(*images, "LDR", applyMagma=False)
    return np.asarray(errors, dtype=np.float64).reshape(truth.shape[:2])
