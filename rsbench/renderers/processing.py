"""Camera processing of a sensor's reading: three colours at each pixel, 8-bit codes, and a JPEG image.

A mosaic is interpolated by OpenCV's edge-aware demosaicing (``COLOR_Bayer..2RGB_EA``) of linear 16-bit numbers: a
green value is the mean of its two neighbours in the direction in which they differ less, a red or blue one that of
the two or four nearest. JPEG is OpenCV's too (libjpeg-turbo), with colours of half the resolution (4:2:0).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.renderers.electrons import Mosaic, Sensor, filters
from rsbench.renderers.image import to_srgb8

_BLOCK = 16
"""Rows of JPEG that are coded together; their colours are blended with those of the rows beside."""
_PAD = 2
_LONGEST = 65500
"""Pixels of a side of a JPEG image."""


def rows_needed(sensor: Sensor, rows: Sequence[int], height: int) -> Sequence[int]:
    """Rows of the sensor, ascending, that decide these rows of its image; the same, where each decides itself.

    Args:
        sensor: of one camera and time.
        rows: of the image.
        height: of the whole image.
    """
    if sensor.mosaic == "none" and not sensor.jpeg_quality:
        return rows
    read = (_read_for(sensor, band, height) for band in _bands(sensor, rows, height))
    return sorted({row for band in read for row in band})


def processed(
    read: NDArray[np.float64], sensor: Sensor, height: int, needed: Sequence[int], rows: Sequence[int]
) -> NDArray[np.uint8]:
    """Rows (n, width, 3) of the image, sRGB, of what the sensor says of the rows that they need.

    Args:
        read: (m, width, 1 or 3) of ``electrons.expose``.
        sensor: of one camera and time.
        height: of the whole image.
        needed: (m) numbers of the rows that were read, of ``rows_needed``.
        rows: (n) of the image.

    Raises:
        RsbenchError: the image is too large for JPEG.
    """
    if needed is rows:
        return to_srgb8(read, 1.0)
    made = np.zeros((height, read.shape[1], 3), dtype=np.uint8)
    for band in _bands(sensor, rows, height):
        lines = _read_for(sensor, band, height)
        values = read[np.searchsorted(needed, lines)]
        if sensor.mosaic != "none":
            values = _interpolated(values[..., 0], sensor, lines[0])[band[0] - lines[0] :][: len(band)]
        codes = to_srgb8(values, 1.0)
        made[band] = compressed(codes, sensor.jpeg_quality) if sensor.jpeg_quality else codes
    return made[rows]


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """An image (H, W, 3), sRGB, after JPEG of a quality from 1 to 100.

    Raises:
        RsbenchError: it is too large for JPEG.
    """
    if max(image.shape) > _LONGEST:
        raise RsbenchError(f"sensor jpeg_quality = {quality}: a JPEG image has at most {_LONGEST} pixels a side")
    half = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, half]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), options)
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    return np.ascontiguousarray(decoded[..., ::-1])


def shares_of_noise(mosaic: Mosaic, width: int, height: int) -> NDArray[np.float64]:
    """Variance (H, W, 3) of the image's linear values over that of the pixels read, inside the image.

    Which two neighbours are nearer to each other does not tell their mean, so choosing them changes nothing.
    """
    if mosaic == "none":
        return np.ones((height, width, 3))
    own = filters(mosaic, width, np.arange(height))
    shares = np.where(own == 1, 0.5, 0.25)[..., None].repeat(3, axis=2)
    shares[own != 1, 1] = 0.5
    np.put_along_axis(shares, own[..., None], 1.0, axis=-1)
    return shares


def _bands(sensor: Sensor, rows: Sequence[int], height: int) -> Iterator[range]:
    """Rows of the image, ``rows`` among them, that can be made without those between the bands."""
    size, beside = (_BLOCK, 1) if sensor.jpeg_quality else (1, 0)
    near = {row // size + by for row in rows for by in range(-beside, beside + 1)}
    blocks = np.array(sorted(near & set(range(-(-height // size)))))
    ends = [0, *(np.flatnonzero(np.diff(blocks) > 1) + 1), len(blocks)]
    for first, after in pairwise(ends):
        yield range(int(blocks[first]) * size, min(int(blocks[after - 1] + 1) * size, height))


def _read_for(sensor: Sensor, band: range, height: int) -> range:
    """Rows of the sensor that decide a band of the image: interpolation looks one row farther."""
    beside = 0 if sensor.mosaic == "none" else 1
    return range(max(band.start - beside, 0), min(band.stop + beside, height))


def _interpolated(read: NDArray[np.float64], sensor: Sensor, first: int) -> NDArray[np.float64]:
    """Three colours (n, W, 3) of rows (n, W) of a mosaic, of which the upper one has the number ``first``."""
    black, top = sensor.levels
    shift = 16 - sensor.bits
    numbers = np.round(read * (top - black) + black).astype(np.uint16) << shift
    # Beyond the border lies what is seen in a mirror on it, by pixels of the same colours.
    padded = np.pad(numbers, _PAD, mode="reflect")
    pattern = sensor.mosaic if first % 2 == 0 else sensor.mosaic[2:] + sensor.mosaic[:2]
    colours = cv2.demosaicing(padded, getattr(cv2, f"COLOR_Bayer{pattern}2RGB_EA"))[_PAD:-_PAD, _PAD:-_PAD]
    return np.asarray((colours / 2.0**shift - black) / (top - black), dtype=np.float64)
