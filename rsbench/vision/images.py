"""Allowed types of images, their grey values, half sizes and values between pixels; and processing of several
frames at once.

The cubic kernel is Keys' with a = -1/2, the only one of its family that reproduces straight lines and parabolas.
OpenCV's has a = -3/4: on a plain ramp it errs by up to 0.035 px, as much as a good disparity map. Keys, "Cubic
convolution interpolation for digital image processing", ASSP 1981.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray

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
    """Images for matching; 16-bit ones are scaled to 8 bits by one common factor, because they may use few of
    their bits."""
    if images[0].dtype == np.uint8:
        return images
    top = max(float(np.percentile(image, _BRIGHT)) for image in images)
    scale = np.float32(255.0 / max(top, 1.0))
    return [np.clip(image * scale + np.float32(0.5), 0.0, 255.0).astype(np.uint8) for image in images]


def local_variance(image: NDArray[Any]) -> NDArray[np.float32]:
    """(H, W) variance of the grey levels around each pixel of an 8-bit image (H, W[, 3])."""
    grey = grey_u8(image).astype(np.float32)
    mean, square = (cv2.blur(each, (_WINDOW, _WINDOW)) for each in (grey, grey * grey))
    return np.asarray(square - mean * mean)


F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]


def halved(image: U8) -> U8:
    """A grey image (H, W) at half the size, at least 1 x 1: each pixel is the mean of those that it covers."""
    height, width = (max(side // 2, 1) for side in image.shape)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def at_full_size(points: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Convert points (n, 2), px of the halved image, to px of an image of this shape (H, W); (0, 0) is the centre
    of the top-left pixel."""
    scale = np.array([side / max(side // 2, 1) for side in shape[1::-1]])
    return (points + 0.5) * scale - 0.5


def guided_upsample(values: F32, small: U8, grey: U8) -> F32:
    """Upsample values (h, w) of the halved image ``small`` to the pixels (H, W) of ``grey``; NaN is unknown.

    Each pixel gets the value of the one of the four half-size pixels around it whose grey level is most similar to
    its own, or the nearest of equal ones: thus borders lie where the image has them (J. Kopf et al., Joint
    bilateral upsampling, SIGGRAPH 2007, with a window of two pixels and only the largest weight).
    """
    (height, width), (h, w) = grey.shape, small.shape
    y, x = ((np.arange(n) + 0.5) * (m / n) - 0.5 for n, m in ((height, h), (width, w)))
    best, found = np.full(grey.shape, np.inf, np.float32), np.full(grey.shape, np.nan, np.float32)
    wanted = grey.astype(np.float32)
    for down in (0, 1):
        rows = np.clip(np.rint(y) if down == 0 else _farther_neighbour(y), 0, h - 1).astype(np.intp)
        for right in (0, 1):
            columns = np.clip(np.rint(x) if right == 0 else _farther_neighbour(x), 0, w - 1).astype(np.intp)
            here = np.ix_(rows, columns)
            value, off = values[here], np.abs(small[here] - wanted)
            better = (off < best) & np.isfinite(value)
            best, found = np.where(better, off, best), np.where(better, value, found)
    return found


def _farther_neighbour(places: FloatArray) -> NDArray[Any]:
    """The farther one of the two whole numbers around each place."""
    nearest = np.rint(places)
    return nearest + np.where(places >= nearest, 1.0, -1.0)


Interpolation = Literal["cubic", "linear"]
_FEW, _PACKED = 4, 512
"""If fewer than one in this many positions is not NaN, these are sampled in rows of the second length."""
Weights = tuple[np.float32, np.float32, np.float32, np.float32]


def resample(image: NDArray[Any], positions: F32, interpolation: Interpolation = "cubic") -> NDArray[Any]:
    """Values (h, w[, C]) of ``image`` (H, W[, C]) at ``positions`` (h, w, 2), px; 0 where a position is NaN.

    Computed in float32 and rounded once where the image holds integers; the border pixels are repeated outward.
    ``image`` is uint8, uint16 or float32.
    """
    known = ~np.isnan(positions[..., 0])
    if _FEW * np.count_nonzero(known) < known.size:
        out = np.zeros((*known.shape, *image.shape[2:]), dtype=image.dtype)
        out[known] = resample_at(image, positions[known], interpolation)
        return out
    source = np.ascontiguousarray(image, dtype=np.float32)
    if interpolation == "linear":
        places = np.where(known[..., None], positions, np.float32(0.0))
        values = cv2.remap(source, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values = values.reshape(*positions.shape[:2], *image.shape[2:])
        values[~known] = 0.0
    else:
        values = np.zeros((*positions.shape[:2], *image.shape[2:]), dtype=np.float32)
        _cubic(np.atleast_3d(source), positions, np.atleast_3d(values))
    return _rounded(values, image.dtype)


def resample_at(image: NDArray[Any], points: F32, interpolation: Interpolation = "cubic") -> NDArray[Any]:
    """``resample`` at single points (n, 2), none of them NaN: (n[, C])."""
    values = np.zeros((-(-len(points) // _PACKED) * _PACKED, *image.shape[2:]), dtype=np.float32)
    if len(points):
        places = np.zeros((len(values) // _PACKED, _PACKED, 2), dtype=np.float32)
        places.reshape(-1, 2)[: len(points)] = points
        packed = values.reshape(*places.shape[:2], *image.shape[2:])
        source = np.ascontiguousarray(image, dtype=np.float32)
        if interpolation == "linear":
            cv2.remap(source, places, None, cv2.INTER_LINEAR, packed, cv2.BORDER_REPLICATE)
        else:
            _cubic(np.atleast_3d(source), places, np.atleast_3d(packed))
    return _rounded(values[: len(points)], image.dtype)


def _rounded(values: F32, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values of an image of this type; ``values`` are overwritten."""
    if dtype == np.float32:
        return values
    largest = np.float32(np.iinfo(dtype).max)
    # Adding a half and truncating rounds, several times faster than np.rint.
    np.clip(values, 0.0, largest, out=values)
    values += np.float32(0.5)
    return values.astype(dtype)


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


SPLINE_INVERSE = (np.sqrt(3.0) - 2.0) ** np.abs(np.arange(-6, 7))
"""(13,) filter that turns samples into a cubic B-spline's coefficients, up to its sum.

M. Unser, Splines: a perfect fit for signal and image processing, IEEE Signal Processing Magazine 1999."""


@compiled(error_model="numpy", fastmath={"contract"})
def spline_weights(t: np.float32) -> Weights:
    """Weights of a cubic B-spline's coefficients at -1, 0, 1, 2 for position t in [0, 1]."""
    sixth, most, half, u = np.float32(1.0 / 6.0), np.float32(2.0 / 3.0), np.float32(0.5), np.float32(1.0) - t
    return sixth * u * u * u, most - t * t * (u + half * t), most - u * u * (t + half * u), sixth * t * t * t


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
    # Unsigned offsets avoid numba's test for negative indices.
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
    """Value at a position whose window extends beyond the image: the border pixels are repeated outward."""
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


T = TypeVar("T")
R = TypeVar("R")
_BYTES = 1e9
"""Memory for frames that are processed at once, bytes: correcting four frames of full HD takes less than 2 GB."""


@contextmanager
def single_opencv() -> Iterator[None]:
    """Let OpenCV use one thread per call, for callers that run several calls in parallel; results do not change.

    Its own threads on top of theirs take a tenth more processor time (a video on two cores).
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def map_frames(work: Callable[[T], R], items: Iterable[T], pixels: int, bytes_per_pixel: float) -> list[R]:
    """Apply ``work`` to each item in at least one and at most as many threads as there are cores.

    Args:
        pixels: number of pixels of one frame.
        bytes_per_pixel: measured memory that one call of ``work`` needs.
    """
    most = max(1, min(os.cpu_count() or 1, int(_BYTES / (pixels * bytes_per_pixel))))
    with ThreadPoolExecutor(most) as pool:
        return list(pool.map(work, items))


def ahead(items: Iterator[T], most: int) -> Iterator[T]:
    """Yield the items, in order; a thread prepares up to ``most`` in advance."""
    last, pool = object(), ThreadPoolExecutor(1)
    waiting = deque(pool.submit(next, items, last) for _ in range(most))
    try:
        while (item := waiting.popleft().result()) is not last:
            waiting.append(pool.submit(next, items, last))
            yield item  # pyrefly: ignore[invalid-yield]
    finally:  # an interrupt does not wait for running work
        pool.shutdown(wait=False, cancel_futures=True)


def map_ahead(work: Callable[[T], R], items: Iterable[T], most: int, threads: int) -> Generator[R]:
    """Apply ``work`` to each item, in order, in threads; up to ``most`` results wait for earlier ones."""
    waiting, pool = deque[Future[R]](), ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > most:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
