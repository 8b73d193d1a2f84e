"""Sensor noise model: from light to electrons, their noise, and digital numbers.

The linear model of EMVA 1288 (release 4.0, section 2): light and dark current free a Poisson number of electrons,
read-out adds Gaussian noise, the gain makes digital numbers of them, which are rounded and clipped. In electrons
the variance of a pixel is ``mean + dark + read_noise^2 + step^2 / 12``, with ``step`` electrons to a number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Mosaic = Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"]
_MOSAIC_BITS = 16
"""Of what a mosaic reads where numbers are not rounded: they are interpolated as whole numbers."""
_BLACK_SHARE = 1 / 16
"""Of the digital range lies below black, so that noise in the dark is not clipped there."""
_RANGES: dict[str, tuple[float, float]] = {
    "exposure_s": (0.0, 3600.0),
    "full_well": (1.0, 1e9),
    "gain": (1e-3, 1e6),
    "read_noise": (0.0, 1e6),
    "dark_current": (0.0, 1e9),
    "bit_depth": (0, 16),
    "jpeg_quality": (0, 100),
    "vignetting": (0.0, 1.0),
    "right_exposure_s": (0.0, 3600.0),
    "right_gain": (1e-3, 1e6),
    "right_jpeg_quality": (0, 100),
    "right_brightness": (1e-3, 1e3),
}
_BRIGHTNESS = (1e-3, 1e3)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Exposure and noise of an image sensor; the defaults are those of an ideal one: nothing.

    Raises:
        ValueError: a value is out of its range.
    """

    exposure_s: float = 0.0
    """For how long a row collects light, seconds; the middle of it is the row's time. 0: an instant."""
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
        low, high = _BRIGHTNESS
        if not all(math.isfinite(value) and low <= value <= high for value in self.brightness):
            raise ValueError(f"sensor brightness = {list(self.brightness)}: allowed is {low:g} to {high:g}")

    @property
    def noiseless(self) -> Sensor:
        """The same exposure, fall-off and brightness without noise, rounding, mosaic and compression."""
        clean: dict[str, Any] = {"photon_noise": False, "read_noise": 0.0, "dark_current": 0.0, "bit_depth": 0}
        alike: dict[str, Any] = {"mosaic": "none", "jpeg_quality": 0}
        right: dict[str, Any] = {"right_mosaic": None, "right_jpeg_quality": None}
        return replace(self, **clean, **alike, **right)

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
        return self.brightness != _UNTOLD["brightness"]

    @property
    def longest_s(self) -> float:
        """Seconds of the longer exposure of the two cameras."""
        return max(self.exposure_s, self.right_exposure_s or 0.0)

    @property
    def record(self) -> dict[str, Any]:
        """As JSON holds it; what both cameras and frames share is told once, later keys where they say more."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        own = {name: value for name, value in values.items() if name not in _UNTOLD or value != _UNTOLD[name]}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in own.items()}

    @property
    def white(self) -> float:
        """Electrons of white."""
        return self.full_well / self.gain

    @property
    def bits(self) -> int:
        """Of the digital numbers; 0: there are none."""
        return self.bit_depth or (0 if self.mosaic == "none" else _MOSAIC_BITS)

    @property
    def levels(self) -> tuple[int, int]:
        """Digital numbers of black and white."""
        top = 2**self.bits - 1
        return round(_BLACK_SHARE * top), top

    def variance(self, light: ArrayLike) -> NDArray[np.float64]:
        """Of linear values (...), white = 1, where ``light`` falls on the sensor; away from black and white.

        Of a pixel as it is read: neither interpolated from a mosaic nor compressed.
        """
        black, top = self.levels
        dark = self.dark_current * self.exposure_s
        shot = self.white * np.asarray(light, dtype=np.float64) + dark if self.photon_noise else 0.0
        step = self.white / (top - black) if self.bits else 0.0
        return np.asarray((shot + self.read_noise**2 + step**2 / 12) / self.white**2, dtype=np.float64)


_BY_CAMERA = ("exposure_s", "gain", "mosaic", "jpeg_quality")
_UNTOLD = {
    "brightness": (1.0, 1.0),
    "right_brightness": 1.0,
    "mosaic": "none",
    "jpeg_quality": 0,
    **{f"right_{name}": None for name in _BY_CAMERA},
}
"""What records leave out, and with which values: there is none of it."""


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
