"""From linear radiance to the 8-bit images of a dataset: sRGB, sensor noise, mosaic, JPEG.

The linear model of EMVA 1288 (release 4.0, section 2): light and dark current free a Poisson number of electrons,
read-out adds Gaussian noise, the gain makes digital numbers of them, which are rounded and clipped. In electrons
the variance of a pixel is ``mean + dark + read_noise^2 + step^2 / 12``, with ``step`` electrons to a number.

A mosaic is interpolated by OpenCV's edge-aware demosaicing (``COLOR_Bayer..2RGB_EA``) of linear 16-bit numbers: a
green value is the mean of its two neighbours in the direction in which they differ less, a red or blue one that of
the two or four nearest. JPEG is OpenCV's too (libjpeg-turbo), with colours of half the resolution (4:2:0).
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
"""Bits of a mosaic's readings where numbers are not rounded: demosaicing needs whole numbers."""
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
    """Exposure and noise of an image sensor; the defaults are those of an ideal one: nothing.

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
    """Electrons per second without light; the camera subtracts its mean, its noise stays."""
    bit_depth: int = 0
    """Bits of the digital numbers; 0: they are not rounded."""
    vignetting: float = 0.0
    """Share of the light that the corners lose; it grows with the square of the distance from the centre."""
    brightness: tuple[float, ...] = (1.0, 1.0)
    """Brightness of each frame over that of the clean twin: what an automatic exposure does from frame to
    frame."""
    right_brightness: float = 1.0
    """Brightness of the right camera over the left one."""
    right_exposure_s: float | None = None
    """Exposure of the right camera, seconds. Absent: as the left camera's."""
    right_gain: float | None = None
    """Gain of the right camera. Absent: as the left camera's."""
    mosaic: Mosaic = "none"
    """Colour filters before the first two pixels of the first two rows, repeated over the image; "none": each
    pixel measures all three colours."""
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
        """The same exposure, fall-off and brightness without noise, rounding, mosaic and compression."""
        clean: dict[str, Any] = {"photon_noise": False, "read_noise": 0.0, "dark_current": 0.0, "bit_depth": 0}
        clean |= {"mosaic": "none", "jpeg_quality": 0, "right_mosaic": None, "right_jpeg_quality": None}
        return replace(self, **clean)

    def of(self, side: str, frame: int) -> Sensor:
        """The sensor of one camera at one time, both of whose frames and cameras are alike."""
        right = side == "right"
        own: dict[str, Any] = {name: getattr(self, f"right_{name}") if right else None for name in _BY_CAMERA}
        light = (self.brightness[frame] if self.scripted else 1.0) * (self.right_brightness if right else 1.0)
        alike: dict[str, Any] = {"brightness": (light, light), "right_brightness": 1.0}
        alike |= {f"right_{name}": None for name in _BY_CAMERA}
        return replace(self, **{name: value for name, value in own.items() if value is not None}, **alike)

    @property
    def scripted(self) -> bool:
        """Whether frames differ in brightness, which is then that of each."""
        return self.brightness != _DEFAULTS["brightness"]

    @property
    def longest_s(self) -> float:
        """Seconds of the longer exposure of the two cameras."""
        return max(self.exposure_s, self.right_exposure_s or 0.0)

    @property
    def record(self) -> dict[str, Any]:
        """Values for JSON; keys that were added later are left out at their defaults."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        own = {name: value for name, value in values.items() if name not in _DEFAULTS or value != _DEFAULTS[name]}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in own.items()}

    @property
    def white(self) -> float:
        """Electrons of white."""
        return self.full_well / self.gain

    @property
    def bits(self) -> int:
        """Bits of the digital numbers; 0 if values are not quantised."""
        return self.bit_depth or (0 if self.mosaic == "none" else _MOSAIC_BITS)

    @property
    def levels(self) -> tuple[int, int]:
        """Digital numbers of black and white."""
        top = 2**self.bits - 1
        return round(_BLACK_SHARE * top), top

    def variance(self, light: ArrayLike) -> NDArray[np.float64]:
        """Noise variance of linear values (...), white = 1, under light ``light``, away from black and white.

        It applies to raw pixels, before demosaicing and compression.
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
"""Values with which records leave a key out: there is no such effect."""


def filters(mosaic: Mosaic, width: int, rows: ArrayLike) -> NDArray[np.intp]:
    """Channels (n, width), 0 to 2, of the filters before the pixels of rows (n)."""
    tile = np.array(["RGB".index(colour) for colour in mosaic]).reshape(2, 2)
    return tile[np.asarray(rows)[:, None] % 2, np.arange(width) % 2]


def check_brightness(sensor: Sensor, frames: int) -> None:
    """Raises ValueError unless it says the brightness of each of so many frames, or of none."""
    if sensor.scripted and len(sensor.brightness) != frames:
        count = len(sensor.brightness)
        raise ValueError(f"sensor brightness has {count} values: one for each of {frames} frames is needed")


def fall_off(sensor: Sensor, width: int, height: int, rows: ArrayLike) -> NDArray[np.float64]:
    """Light on rows (n) of an image over that of its clean twin: (n, width); of one camera and time."""
    x, y = np.arange(width) - (width - 1) / 2, np.asarray(rows) - (height - 1) / 2
    corner = ((width - 1) / 2) ** 2 + ((height - 1) / 2) ** 2
    share = 1.0 - sensor.vignetting * (x**2 + y[:, None] ** 2) / max(corner, 1.0)
    return np.asarray(sensor.brightness[0] * share, dtype=np.float64)


def expose(
    linear: NDArray[np.float32], sensor: Sensor, seed: int, height: int, rows: ArrayLike
) -> NDArray[np.float64]:
    """What the sensor says of rows of an image, linear, white = 1: from a little below 0 to 1.

    Each row has random numbers of its own, so that it has the same bits by itself and in the whole image.

    Returns:
        (n, width, 3); (n, width, 1) where a mosaic lets one colour through to each pixel.

    Args:
        linear: (n, width, 3) light over white, before the lens' fall-off.
        sensor: of this camera and time.
        seed: of the image, not negative.
        height: rows of the whole image.
        rows: (n) their numbers.
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
    """One row over white, not rounded; dark current is taken off at its mean."""
    dark = sensor.dark_current * sensor.exposure_s
    # Far beyond white all is white, and Poisson numbers of the sun's electrons need not be drawn.
    electrons = sensor.white * np.minimum(light, 10.0) + dark
    if sensor.photon_noise:
        electrons = random.poisson(electrons).astype(np.float64)
    return (electrons - dark + random.normal(0.0, sensor.read_noise, light.shape)) / sensor.white


def to_srgb8(image: ArrayLike, exposure: float) -> NDArray[np.uint8]:
    """8-bit sRGB (IEC 61966-2-1) of linear radiance (..., 3) times ``exposure``, clipped to [0, 1], rounded."""
    linear = np.asarray(image, dtype=np.float32) * np.float32(exposure)
    return np.round(srgb_of(linear) * 255.0).astype(np.uint8)


def linear_of_codes(codes: ArrayLike) -> NDArray[np.float64]:
    """Linear values of 8-bit sRGB codes (...), also between them: the inverse of ``to_srgb8`` at exposure 1."""
    return srgb_to_linear(np.clip(np.asarray(codes, dtype=np.float64) / 255.0, 0.0, 1.0))


def srgb_of(linear: NDArray[Any]) -> NDArray[Any]:
    """sRGB values (...), from 0 to 1, of linear ones, clipped; of their type."""
    return linear_to_srgb(np.clip(linear, 0.0, 1.0))


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

    Which pair of neighbours is chosen does not depend on its mean, so the choice does not change the variance.
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
