"""From linear radiance to the 8-bit images of a dataset: sRGB, sensor noise, mosaic, JPEG.

The noise model is the linear one of EMVA 1288 (release 4.0, section 2): light and dark current generate a
Poisson-distributed number of electrons, read-out adds Gaussian noise, and the gain converts electrons to digital
numbers, which are rounded and clipped. The variance of a pixel, in electrons squared, is
``mean + dark + read_noise^2 + step^2 / 12``, where ``step`` is the number of electrons per digital number.

OpenCV's edge-aware demosaicing (``COLOR_Bayer..2RGB_EA``) interpolates a mosaic, as linear 16-bit numbers: a green
value is the mean of its two neighbours in the direction in which they differ less, a red or blue one the mean of
the two or four nearest. OpenCV (libjpeg-turbo) also compresses JPEG, with chroma at half resolution (4:2:0).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import linear_to_srgb, srgb_to_linear

Mosaic = Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"]
_MOSAIC_BITS = 16
"""Bit depth of a mosaic without a given ``bit_depth``: demosaicing needs whole numbers."""
_BLACK_SHARE = 1 / 16
"""Share of the digital range below black, so that noise in the dark is not clipped there."""
_RANGES: dict[str, tuple[float, float]] = {
    "exposure_s": (0.0, 3600.0),
    "full_well": (1.0, 1e9),
    "gain": (1e-3, 1e6),
    "read_noise": (0.0, 1e6),
    "dark_current": (0.0, 1e9),
    "bit_depth": (0, 16),
    "jpeg_quality": (0, 100),
    "vignetting": (0.0, 1.0),
    "right_brightness": (1e-3, 1e3),
}
_BY_CAMERA = ("exposure_s", "gain", "mosaic", "jpeg_quality")
_RANGES |= {f"right_{name}": _RANGES[name] for name in _BY_CAMERA if name in _RANGES}


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Exposure and noise of an image sensor; the defaults describe an ideal sensor without any effect.

    Raises:
        ValueError: a value is out of its range.
    """

    exposure_s: float = 0.0
    """Exposure time of a row, seconds, centred on the row's time; 0 is instantaneous."""
    full_well: float = 6000.0
    """Electrons of a pixel that saturates at gain 1."""
    gain: float = 1.0
    """ISO over base ISO: white is ``full_well / gain`` electrons."""
    photon_noise: bool = False
    """Whether the number of electrons is drawn from a Poisson distribution."""
    read_noise: float = 0.0
    """Standard deviation of the noise of reading a pixel, electrons."""
    dark_current: float = 0.0
    """Electrons per second without light; the camera subtracts their mean, but their noise remains."""
    bit_depth: int = 0
    """Bits of the digital numbers; 0: they are not rounded."""
    vignetting: float = 0.0
    """Share of the light that the corners lose; it grows with the square of the distance from the centre."""
    brightness: tuple[float, ...] = (1.0, 1.0)
    """Brightness of each frame, relative to the image of an ideal sensor; it simulates automatic exposure."""
    right_brightness: float = 1.0
    """Brightness of the right camera, relative to the left one."""
    right_exposure_s: float | None = None
    """Exposure of the right camera, seconds. Absent: as the left camera's."""
    right_gain: float | None = None
    """Gain of the right camera. Absent: as the left camera's."""
    mosaic: Mosaic = "none"
    """Colour filters of the first two pixels of the first two rows, repeated over the image; "none": each pixel
    measures all three colours."""
    right_mosaic: Mosaic | None = None
    """Colour filters of the right camera. Absent: as the left camera's."""
    jpeg_quality: int = 0
    """JPEG quality of the image that leaves the camera, 1 to 100; 0: it is not compressed."""
    right_jpeg_quality: int | None = None
    """JPEG quality of the right camera. Absent: as the left camera's."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"sensor {name} = {value}: allowed is {low:g} to {high:g}")
        for name in ("mosaic", "right_mosaic"):
            if (value := getattr(self, name)) not in (*get_args(Mosaic), None):
                raise ValueError(f"sensor {name} = {value!r}: allowed are {', '.join(get_args(Mosaic))}")
        low, high = _RANGES["right_brightness"]
        if not all(math.isfinite(value) and low <= value <= high for value in self.brightness):
            raise ValueError(f"sensor brightness = {list(self.brightness)}: allowed is {low:g} to {high:g}")

    @property
    def noiseless(self) -> Sensor:
        """The sensor with the same exposure, vignetting and brightness, but no noise, rounding, mosaic or JPEG."""
        clean: dict[str, Any] = {"photon_noise": False, "read_noise": 0.0, "dark_current": 0.0, "bit_depth": 0}
        clean |= {"mosaic": "none", "jpeg_quality": 0, "right_mosaic": None, "right_jpeg_quality": None}
        return replace(self, **clean)

    def of(self, side: str, frame: int) -> Sensor:
        """Return the sensor of one camera in one frame, as a ``Sensor`` whose two cameras and frames are equal."""
        right = side == "right"
        own: dict[str, Any] = {name: getattr(self, f"right_{name}") if right else None for name in _BY_CAMERA}
        light = (self.brightness[frame] if self.scripted else 1.0) * (self.right_brightness if right else 1.0)
        alike: dict[str, Any] = {"brightness": (light, light), "right_brightness": 1.0}
        alike |= {f"right_{name}": None for name in _BY_CAMERA}
        return replace(self, **{name: value for name, value in own.items() if value is not None}, **alike)

    @property
    def scripted(self) -> bool:
        """Whether ``brightness`` is set, so that it has one value for each frame."""
        return self.brightness != _DEFAULTS["brightness"]

    @property
    def longest_s(self) -> float:
        """The longer exposure time of the two cameras, seconds."""
        return max(self.exposure_s, self.right_exposure_s or 0.0)

    @property
    def record(self) -> dict[str, Any]:
        """Values for JSON, without keys added in later versions that have their defaults."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        own = {name: value for name, value in values.items() if name not in _DEFAULTS or value != _DEFAULTS[name]}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in own.items()}

    @property
    def white(self) -> float:
        """Number of electrons of a white pixel."""
        return self.full_well / self.gain

    @property
    def bits(self) -> int:
        """Number of bits of the digital numbers; 0 if values are not quantised."""
        return self.bit_depth or (0 if self.mosaic == "none" else _MOSAIC_BITS)

    @property
    def levels(self) -> tuple[int, int]:
        """Digital numbers of black and white."""
        top = 2**self.bits - 1
        return round(_BLACK_SHARE * top), top

    def variance(self, light: ArrayLike) -> NDArray[np.float64]:
        """Return the noise variance of linear values ``light`` (...), white = 1, far from clipping.

        It is the variance of raw pixels, before demosaicing and compression.
        """
        black, top = self.levels
        dark = self.dark_current * self.exposure_s
        shot = self.white * np.asarray(light, dtype=np.float64) + dark if self.photon_noise else 0.0
        step = self.white / (top - black) if self.bits else 0.0
        return np.asarray((shot + self.read_noise**2 + step**2 / 12) / self.white**2, dtype=np.float64)


_DEFAULTS = {
    "brightness": (1.0, 1.0),
    "right_brightness": 1.0,
    "mosaic": "none",
    "jpeg_quality": 0,
    **{f"right_{name}": None for name in _BY_CAMERA},
}
"""Values at which ``Sensor.record`` omits a key, because the effect is absent."""


def filters(mosaic: Mosaic, width: int, rows: ArrayLike) -> NDArray[np.intp]:
    """Return the colour channel (n, width), 0 to 2, that each pixel of the rows (n) measures."""
    tile = np.array(["RGB".index(colour) for colour in mosaic]).reshape(2, 2)
    return tile[np.asarray(rows)[:, None] % 2, np.arange(width) % 2]


def check_brightness(sensor: Sensor, frames: int) -> None:
    """Raise ValueError if ``brightness`` is set but does not have one value for each frame."""
    if sensor.scripted and len(sensor.brightness) != frames:
        count = len(sensor.brightness)
        raise ValueError(f"sensor brightness has {count} values: one for each of {frames} frames is needed")


def fall_off(sensor: Sensor, width: int, height: int, rows: ArrayLike) -> NDArray[np.float64]:
    """Return the light on rows (n) of an image relative to an ideal sensor's: vignetting times brightness.

    The result has shape (n, width); ``sensor`` is that of one camera and frame, from ``Sensor.of``.
    """
    x, y = np.arange(width) - (width - 1) / 2, np.asarray(rows) - (height - 1) / 2
    corner = ((width - 1) / 2) ** 2 + ((height - 1) / 2) ** 2
    share = 1.0 - sensor.vignetting * (x**2 + y[:, None] ** 2) / max(corner, 1.0)
    return np.asarray(sensor.brightness[0] * share, dtype=np.float64)


def expose(
    linear: NDArray[np.float32], sensor: Sensor, seed: int, height: int, rows: ArrayLike
) -> NDArray[np.float64]:
    """Simulate the sensor's readings of some rows of an image: linear, white = 1, from slightly below 0 to 1.

    The random numbers of a row depend only on the seed and the row, so that a row rendered alone has the same bits
    as in the whole image.

    Returns:
        Values (n, width, 3), or (n, width, 1) for a sensor with a mosaic.

    Args:
        linear: (n, width, 3) light relative to white, before vignetting.
        sensor: sensor of this camera and frame.
        seed: seed of the image, not negative.
        height: number of rows of the whole image.
        rows: (n) numbers of the rows.
    """
    rows = np.asarray(rows)
    light = np.asarray(linear, dtype=np.float64) * fall_off(sensor, linear.shape[1], height, rows)[..., None]
    if sensor.mosaic != "none":
        light = np.take_along_axis(light, filters(sensor.mosaic, light.shape[1], rows)[..., None], axis=-1)
    numbered = zip(rows, light, strict=True)
    read = np.stack([_read_out(line, sensor, np.random.default_rng([seed, row])) for row, line in numbered])
    black, top = sensor.levels
    if not sensor.bits:
        return np.minimum(read, 1.0)
    numbers = np.clip(np.round(read * (top - black)) + black, 0, top)
    return (numbers - black) / (top - black)


def _read_out(light: NDArray[np.float64], sensor: Sensor, random: np.random.Generator) -> NDArray[np.float64]:
    """Simulate the reading of one row, relative to white and not rounded, minus the mean dark current."""
    dark = sensor.dark_current * sensor.exposure_s
    # Values far above white are clipped to white anyway, so the Poisson draw is bounded, e.g. for the sun.
    electrons = sensor.white * np.minimum(light, 10.0) + dark
    if sensor.photon_noise:
        electrons = random.poisson(electrons).astype(np.float64)
    return (electrons - dark + random.normal(0.0, sensor.read_noise, light.shape)) / sensor.white


def to_srgb8(image: ArrayLike, exposure: float) -> NDArray[np.uint8]:
    """Convert linear radiance (..., 3) times ``exposure`` to 8-bit sRGB (IEC 61966-2-1), clipped and rounded."""
    linear = np.asarray(image, dtype=np.float32) * np.float32(exposure)
    return np.round(srgb_of(linear) * 255.0).astype(np.uint8)


def linear_of_codes(codes: ArrayLike) -> NDArray[np.float64]:
    """Convert 8-bit sRGB codes (...), also fractional ones, to linear: inverts ``to_srgb8`` at exposure 1."""
    return srgb_to_linear(np.clip(np.asarray(codes, dtype=np.float64) / 255.0, 0.0, 1.0))


def srgb_of(linear: NDArray[Any]) -> NDArray[Any]:
    """Convert linear values (...), clipped to [0, 1], to sRGB values in [0, 1] of the same type."""
    return linear_to_srgb(np.clip(linear, 0.0, 1.0))


_BLOCK = 16
"""Number of rows that JPEG codes together; chroma upsampling also reads the adjacent rows."""
_PAD = 2
_LONGEST = 65500
"""Largest width and height of a JPEG image, px."""


def rows_needed(sensor: Sensor, rows: Sequence[int], height: int) -> Sequence[int]:
    """Return the sensor rows, ascending, on which these image rows depend after demosaicing and JPEG.

    Without mosaic and JPEG, each image row depends only on itself, and ``rows`` itself is returned.

    Args:
        sensor: sensor of one camera and frame.
        rows: rows of the image.
        height: height of the whole image.
    """
    if sensor.mosaic == "none" and not sensor.jpeg_quality:
        return rows
    read = (_read_for(sensor, band, height) for band in _bands(sensor, rows, height))
    return sorted({row for band in read for row in band})


def processed(
    read: NDArray[np.float64], sensor: Sensor, height: int, needed: Sequence[int], rows: Sequence[int]
) -> NDArray[np.uint8]:
    """Convert sensor readings to rows (n, width, 3) of the sRGB image: demosaicing, sRGB and JPEG.

    Args:
        read: (m, width, 1 or 3) readings from ``expose``.
        sensor: sensor of one camera and frame.
        height: height of the whole image.
        needed: (m) numbers of the rows that were read, from ``rows_needed``.
        rows: (n) numbers of the image rows to return.

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
    """Return an sRGB image (H, W, 3) after JPEG compression and decompression; ``quality`` is 1 to 100.

    Raises:
        RsbenchError: the image is too large for JPEG.
    """
    if max(image.shape) > _LONGEST:
        raise RsbenchError(f"sensor jpeg_quality = {quality}: a JPEG image has at most {_LONGEST} pixels a side")
    half = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, half]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), options)
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    return np.ascontiguousarray(decoded[..., ::-1])


def shares_of_noise(mosaic: Mosaic, width: int, height: int) -> NDArray[np.float64]:
    """Return the ratio (H, W, 3) of the noise variance after demosaicing to that of raw pixels, inside the image.

    Edge-aware demosaicing selects the pair of neighbours by their difference, which is independent of their mean,
    so the selection does not change the variance.
    """
    if mosaic == "none":
        return np.ones((height, width, 3))
    own = filters(mosaic, width, np.arange(height))
    shares = np.where(own == 1, 0.5, 0.25)[..., None].repeat(3, axis=2)
    shares[own != 1, 1] = 0.5
    np.put_along_axis(shares, own[..., None], 1.0, axis=-1)
    return shares


def _bands(sensor: Sensor, rows: Sequence[int], height: int) -> Iterator[range]:
    """Yield ranges of image rows that together contain ``rows`` and can be processed independently."""
    size, beside = (_BLOCK, 1) if sensor.jpeg_quality else (1, 0)
    near = {row // size + by for row in rows for by in range(-beside, beside + 1)}
    blocks = np.array(sorted(near & set(range(-(-height // size)))))
    ends = [0, *(np.flatnonzero(np.diff(blocks) > 1) + 1), len(blocks)]
    for first, after in pairwise(ends):
        yield range(int(blocks[first]) * size, min(int(blocks[after - 1] + 1) * size, height))


def _read_for(sensor: Sensor, band: range, height: int) -> range:
    """Return the sensor rows on which a band of the image depends: demosaicing reads one more row on each side."""
    beside = 0 if sensor.mosaic == "none" else 1
    return range(max(band.start - beside, 0), min(band.stop + beside, height))


def _interpolated(read: NDArray[np.float64], sensor: Sensor, first: int) -> NDArray[np.float64]:
    """Demosaic rows (n, W) to colours (n, W, 3); ``first`` is the number of the topmost row."""
    black, top = sensor.levels
    shift = 16 - sensor.bits
    numbers = np.round(read * (top - black) + black).astype(np.uint16) << shift
    # Mirroring at the border pixels continues the pattern of the colour filters.
    padded = np.pad(numbers, _PAD, mode="reflect")
    pattern = sensor.mosaic if first % 2 == 0 else sensor.mosaic[2:] + sensor.mosaic[:2]
    colours = cv2.demosaicing(padded, getattr(cv2, f"COLOR_Bayer{pattern}2RGB_EA"))[_PAD:-_PAD, _PAD:-_PAD]
    return np.asarray((colours / 2.0**shift - black) / (top - black), dtype=np.float64)
