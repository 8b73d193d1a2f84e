"""What interpolation and compression leave in an image, whatever it shows: without it, it was made otherwise."""

from __future__ import annotations

import io
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple, TypeVar, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rsbench.core.so3 import FloatArray
from rsbench.renderers.image import Mosaic, Sensor, filters, linear_of_codes, srgb_of
from rsbench.verification.findings import Finding, rows_of

T = TypeVar("T")
_BLOCK = 8
_MOST, _MOST_OF_ROWS = 0.02, 0.1
"""Share of the values of an image, or of a row of pixels or blocks, that may be otherwise. Sound: none of a
mosaic; of JPEG up to 1.2e-2 at quality 20, 1e-3 at 90."""
_LEAST, _LEAST_OF_ROWS = 200, 20
"""Values that must tell."""
_NEAR = 1.5
"""Codes by which a value may differ from the mean of its neighbours. All are rounded by half a code; in the mean
that of a bright neighbour counts up to twice."""
_COARSE, _OFF = 4, 1.25
"""Steps from which on a coefficient tells, and how far it may be from whole steps: six standard deviations of what
rounding to codes leaves where it differs from pixel to pixel. Of those that were not rounded to a step of 4, a third
are farther off. In blocks of equal rows or columns the rounding repeats and adds up: coefficients count only where
whole steps also leave more than so many codes at a pixel, where both roundings, of luminance and of RGB, leave 1."""
_OPEN = 125.0
"""Luminance about grey beyond which it may have been cut off."""
_FIRST = 1.0 / np.sqrt(2.0)
_DCT = 0.5 * np.cos(np.pi / 16 * np.outer(np.arange(8), 2 * np.arange(8) + 1)) * np.array([[_FIRST], *[[1.0]] * 7])
"""Orthonormal discrete cosine transform of eight values (ITU-T T.81, A.3.3)."""


class _Counts(NamedTuple):
    """Of each row of pixels (H,) how many values are not what they should be, and how many tell."""

    wrong: FloatArray
    asked: FloatArray

    def rows(self) -> NDArray[np.bool_]:
        """(H,) those in which too many are wrong; none where the values do not tell."""
        bad = (self.wrong > _MOST_OF_ROWS * self.asked) & (self.asked >= _LEAST_OF_ROWS)
        if np.sum(self.asked) >= _LEAST and np.sum(self.wrong) > _MOST * np.sum(self.asked):
            bad |= self.wrong > _MOST * self.asked
        return np.asarray(bad)


def processing_fault(image: NDArray[np.uint8], sensor: Sensor, file: str) -> Finding | None:
    """An image (H, W, 3) that is not compressed or interpolated as its sensor's are; None where nothing tells.

    Compressed images do not show a mosaic any more.
    """
    if sensor.jpeg_quality:
        blocks = _Blocks.of(image)
        if not np.any(wrong := blocks.off_steps(sensor.jpeg_quality).rows()):
            return None
        # The coarsest that fits: whole steps of 8 are those of 4 too.
        like = _first(q for q in range(1, 100) if _fits(blocks.off_steps(q)))
        what = f"is no JPEG image of quality {sensor.jpeg_quality}: its blocks are not of whole steps"
        return Finding(
            file, what, rows_of(wrong), f"looks like quality {like}" if like else "looks not compressed"
        )
    if sensor.mosaic == "none" or not np.any(wrong := _not_means(image, sensor.mosaic).rows()):
        return None
    patterns = [each for each in get_args(Mosaic) if each != "none"]
    alike = _first(each for each in patterns if _fits(_not_means(image, each)))
    what = f"is not interpolated from a mosaic {sensor.mosaic}: values are not the mean of their neighbours"
    return Finding(file, what, rows_of(wrong), f"looks like {alike or 'no mosaic'}")


def _first(values: Iterable[T]) -> T | None:
    return next(iter(values), None)


def _fits(counts: _Counts) -> bool:
    return bool(np.sum(counts.asked) >= _LEAST and np.sum(counts.wrong) <= _MOST * np.sum(counts.asked))


def _not_means(image: NDArray[np.uint8], mosaic: Mosaic) -> _Counts:
    """Interpolated values that are not the mean of the neighbours behind filters of their colour."""
    height, width = image.shape[:2]
    light, codes = linear_of_codes(image), image.astype(np.float64)
    own = filters(mosaic, width, np.arange(height))
    open_ = np.all((image > 0) & (image < 255), axis=-1).astype(np.uint8)
    inner = cv2.erode(open_, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    wrong, asked = np.zeros(height), np.zeros(height)
    for channel in range(3):
        across, down, corners = (
            np.abs(255 * srgb_of(cv2.filter2D(light[..., channel], -1, kernel)) - codes[..., channel]) <= _NEAR
            for kernel in _KERNELS
        )
        level, upright = (np.any(own == channel, axis=axis, keepdims=True) for axis in (1, 0))
        # Of two directions the camera has chosen one, by numbers that rounding has changed.
        right = np.where(level | upright, (across & level) | (down & upright), corners)
        judged = inner & (own != channel)
        wrong += np.sum(judged & ~right, axis=1)
        asked += np.sum(judged, axis=1)
    return _Counts(wrong, asked)


_KERNELS = [
    np.array(kernel) / np.sum(kernel)
    for kernel in (
        [[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        [[1.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 1.0]],
    )
]


class _Blocks(NamedTuple):
    """The whole blocks of an image, (H / 8, W / 8, ...)."""

    coefficients: FloatArray
    """(..., 8, 8) of luminance."""
    open: NDArray[np.bool_]
    """(...) whether no value in them is cut off at black or white."""
    rows: int
    """Of pixels in the image."""

    @classmethod
    def of(cls, image: NDArray[np.uint8]) -> _Blocks:
        height, width = (size // _BLOCK * _BLOCK for size in image.shape[:2])
        shape = height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, 3
        blocks = image[:height, :width].reshape(shape).swapaxes(1, 2)
        luminance = blocks @ np.array([0.299, 0.587, 0.114]) - 128.0
        open_ = np.all((blocks > 0) & (blocks < 255), axis=4) & (np.abs(luminance) < _OPEN)
        return cls(_DCT @ luminance @ _DCT.T, np.all(open_, axis=(2, 3)), len(image))

    def off_steps(self, quality: int) -> _Counts:
        """Coefficients that are not whole steps."""
        steps = quality_steps(quality)
        left = np.where(steps >= _COARSE, self.coefficients - steps * np.round(self.coefficients / steps), 0.0)
        off = (np.abs(left) > _OFF) & np.any(np.abs(_DCT.T @ left @ _DCT) > _OFF, axis=(-2, -1), keepdims=True)
        judged = np.broadcast_to(self.open[..., None, None] & (steps >= _COARSE), off.shape)
        counts = (
            np.sum(each, axis=(1, 2, 3)).repeat(_BLOCK).astype(np.float64) for each in (off & judged, judged)
        )
        return _Counts(*(np.pad(each, (0, self.rows - len(each))) for each in counts))


@cache
def quality_steps(quality: int) -> FloatArray:
    """Steps (8, 8) of the coefficients of luminance, as OpenCV's encoder writes them."""
    _, data = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    with Image.open(io.BytesIO(data.tobytes())) as image:
        return np.array(image.quantization[0], dtype=np.float64).reshape(8, 8)
