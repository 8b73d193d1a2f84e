"""Sensor noise and camera processing."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import stats

from rsbench.core.errors import RsbenchError
from rsbench.renderers import image as processing
from rsbench.renderers.image import (
    Mosaic,
    Sensor,
    compressed,
    expose,
    fall_off,
    processed,
    rows_needed,
    shares_of_noise,
    to_srgb8,
)
from rsbench.verification.sensor_checks import processing_fault, quality_steps

PHONE = Sensor(
    exposure_s=0.01, full_well=6000, gain=4, photon_noise=True, read_noise=2.5, dark_current=100, bit_depth=10
)
LEVELS = np.linspace(0.02, 0.85, 20)


def _flat(level: float, sensor: Sensor, seed: int = 3, size: int = 100) -> np.ndarray:
    return expose(np.full((size, size, 3), level, np.float32), sensor, seed, size, np.arange(size))


@pytest.mark.parametrize("sensor", [PHONE, replace(PHONE, bit_depth=0), replace(PHONE, photon_noise=False)])
def test_mean_and_variance_are_the_model_s(sensor: Sensor) -> None:
    """30 000 pixels a level. The bounds hold for all 20 levels with 99.9 %: normal mean, chi-squared variance."""
    n, tail = 30_000, 0.001 / (2 * 20 * 2)
    for level in LEVELS:
        seen = _flat(level, sensor)
        expected = float(sensor.variance(level))
        # Poisson numbers have excess kurtosis 1 / mean, which the variance of the variance feels.
        spread = np.sqrt((2 + 1 / (sensor.white * level)) / n)
        step = 1 / (sensor.levels[1] - sensor.levels[0]) if sensor.bit_depth else 0.0
        assert abs(seen.mean() - level) < stats.norm.isf(tail) * np.sqrt(expected / n) + 1e-3 * step
        assert abs(seen.var() / expected - 1) < stats.norm.isf(tail) * spread + 1e-3


def test_photon_transfer_gives_the_gain() -> None:
    """The slope of variance over mean is one electron: EMVA's way to measure a gain, on the digital numbers."""
    seen = [_flat(level, PHONE) for level in LEVELS]
    slope = np.polyfit([x.mean() for x in seen], [x.var() for x in seen], 1)[0]
    assert slope == pytest.approx(1 / PHONE.white, rel=0.02)


def test_an_ideal_sensor_changes_nothing_but_clips_white() -> None:
    image = np.random.default_rng(1).random((7, 5, 3), dtype=np.float32) * 1.5
    np.testing.assert_allclose(expose(image, Sensor(), 0, 7, np.arange(7)), np.minimum(image, 1.0), atol=1e-15)


def test_cameras_and_frames_may_differ() -> None:
    uneven = replace(PHONE, right_gain=8, right_exposure_s=0.02, brightness=(1.0, 0.5), right_brightness=0.8)
    left, right = uneven.of("left", 0), uneven.of("right", 1)
    assert left == PHONE
    assert (right.gain, right.exposure_s, right.white) == (8, 0.02, 750.0)
    assert right.of("left", 0) == right.of("left", 1) == right, "of one camera and time there is no other"
    assert uneven.longest_s == 0.02
    # Half the light of the frame, four fifths of the camera; the noise is that of so much light at its own gain.
    seen = _flat(0.6, replace(right, bit_depth=0))
    expected = float(replace(right, bit_depth=0).variance(0.6 * 0.4))
    n = seen.size
    assert abs(seen.mean() - 0.6 * 0.4) < 5 * np.sqrt(expected / n)
    assert abs(seen.var() / expected - 1) < 5 * np.sqrt(2.1 / n)


def test_a_row_has_the_same_bits_by_itself() -> None:
    image = np.random.default_rng(1).random((12, 9, 3), dtype=np.float32)
    sensor = replace(PHONE, vignetting=0.3)
    whole = expose(image, sensor, 5, 12, np.arange(12))
    np.testing.assert_array_equal(expose(image[[3, 8]], sensor, 5, 12, [3, 8]), whole[[3, 8]])
    difference = expose(image, sensor, 6, 12, np.arange(12)) - whole
    light = image * fall_off(sensor, 9, 12, np.arange(12))[..., None]
    # Another seed, other noise.
    assert difference.var() == pytest.approx(2 * sensor.variance(light).mean(), rel=0.5)


def test_rows_and_colours_err_independently() -> None:
    noise = _flat(0.4, PHONE) - 0.4
    flat = noise.reshape(100, -1)
    limit = 5 / np.sqrt(30_000)
    assert abs(np.mean(flat[1:] * flat[:-1])) / noise.var() < limit
    assert abs(np.mean(noise[..., 0] * noise[..., 1])) / noise.var() < limit


def test_black_and_white_keep_within_the_numbers() -> None:
    dark, bright = _flat(0.0, PHONE), _flat(50.0, PHONE)
    black, top = PHONE.levels
    assert abs(dark.mean()) < 3e-5 and dark.min() >= -black / (top - black), "noise in the dark is not cut off"
    assert np.all(bright == 1.0)


def test_the_corners_lose_what_the_card_says() -> None:
    share = fall_off(Sensor(vignetting=0.4), 31, 21, np.arange(21))
    assert share[0, 0] == pytest.approx(0.6) and share[20, 30] == pytest.approx(0.6) and share[10, 15] == 1.0


@pytest.mark.parametrize(
    ("field", "value"), [("gain", 0.0), ("bit_depth", 17), ("read_noise", -1.0), ("exposure_s", float("nan"))]
)
def test_values_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"sensor {field} = .*: allowed is"):
        Sensor(**{field: value})  # pyrefly: ignore[bad-argument-type]


PATTERNS = [each for each in get_args(Mosaic) if each != "none"]
NOISY = Sensor(full_well=6000, gain=4, photon_noise=True, read_noise=2.5, bit_depth=10)
K_1 = """16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62
18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101 72 92 95 98 112 100 103 99"""
"""ITU-T T.81, table K.1."""


def _scene(height: int = 45, width: int = 38) -> NDArray[np.float32]:
    y, x = np.mgrid[:height, :width]
    waves = [0.4 + 0.3 * np.sin(0.9 * x + k) * np.cos(0.7 * y - k) for k in range(3)]
    return np.stack(waves, axis=-1).astype(np.float32)


def _image(light: NDArray[np.float32], sensor: Sensor, rows: list[int] | None = None) -> NDArray[np.uint8]:
    height = len(light)
    chosen = list(range(height)) if rows is None else rows
    needed = rows_needed(sensor, chosen, height)
    return processed(expose(light[needed], sensor, 7, height, needed), sensor, height, needed, chosen)


def _by_loops(light: NDArray[np.float32], pattern: str) -> NDArray[np.float64]:
    """Each pixel by itself; what lies beyond the border is seen in a mirror."""
    height, width = light.shape[:2]

    def near(y: int, x: int) -> tuple[str, float]:
        y, x = (n - 1 - abs(n - 1 - abs(k)) for k, n in ((y, height), (x, width)))
        colour = pattern[2 * (y % 2) + x % 2]
        return colour, float(light[y, x, "RGB".index(colour)])

    made = np.zeros(light.shape)
    for y, x in np.ndindex(height, width):
        for k, wanted in enumerate("RGB"):
            sides = [[near(y, x - 1), near(y, x + 1)], [near(y - 1, x), near(y + 1, x)]]
            corners = [near(y + i, x + j) for i in (-1, 1) for j in (-1, 1)]
            if near(y, x)[0] == wanted:
                made[y, x, k] = near(y, x)[1]
            elif wanted == "G":
                alike = min(sides, key=lambda two: abs(two[0][1] - two[1][1]))
                made[y, x, k] = np.mean([each for _, each in alike])
            else:
                same = [each for colour, each in (*sides[0], *sides[1]) if colour == wanted]
                made[y, x, k] = np.mean(same or [each for _, each in corners])
    return made


@pytest.mark.parametrize("pattern", PATTERNS)
def test_a_mosaic_is_interpolated_as_loops_do_it(pattern: Mosaic) -> None:
    light = _scene()[:16, :13]
    expected = to_srgb8(_by_loops(light, pattern), 1.0).astype(int)
    seen = _image(light, Sensor(mosaic=pattern)).astype(int)
    # Numbers of 16 bits move a rounding now and then; a tie of directions is decided otherwise by them.
    assert np.max(np.abs(seen - expected)) <= 1 and np.mean(seen != expected) < 0.01


@pytest.mark.parametrize(
    "sensor",
    [
        replace(NOISY, mosaic="GRBG"),
        replace(NOISY, jpeg_quality=60, bit_depth=0),
        replace(NOISY, mosaic="RGGB", jpeg_quality=80),
    ],
)
def test_rows_have_the_same_bits_by_themselves(sensor: Sensor) -> None:
    light = np.concatenate([_scene(), 0.5 * _scene(), _scene()])  # 135 rows: the last blocks are cut
    whole = _image(light, sensor)
    for rows in ([0], [3, 41], [70, 134, 16], [133]):
        np.testing.assert_array_equal(_image(light, sensor, rows), whole[rows])
    assert len(rows_needed(sensor, [70], len(light))) < 60


def test_the_noise_of_a_mosaic_is_drawn_before_it_is_interpolated() -> None:
    """Variances of pixels of each place in the pattern: of the pixel itself, or of the mean of its neighbours."""
    sensor, size = replace(NOISY, mosaic="GBRG", bit_depth=12), 160
    read = expose(np.full((size, size, 3), 0.4, np.float32), sensor, 1, size, range(size))
    assert read.shape == (size, size, 1)
    seen = processing._interpolated(read[..., 0], sensor, 0)
    shares = shares_of_noise("GBRG", size, size)
    for y, x, k in np.ndindex(2, 2, 3):
        part = seen[y + 2 : -2 : 2, x + 2 : -2 : 2, k]
        share = shares[y + 2, x + 2, k]
        assert share in (1.0, 0.5, 0.25)
        # 6000 pixels, of which neighbours share half of what they are made of at most: 2 sqrt(2 / 6000), 5 times.
        assert np.var(part) / sensor.variance(0.4) == pytest.approx(share, rel=0.19)
        assert abs(np.mean(part) - 0.4) < 5 * np.sqrt(2 * share * sensor.variance(0.4) / part.size)


def test_jpeg_is_that_of_the_standard_and_of_others() -> None:
    table = np.array(K_1.split(), dtype=float).reshape(8, 8)
    for quality, scale in ((10, 500), (50, 100), (85, 30)):
        np.testing.assert_array_equal(quality_steps(quality), np.clip((table * scale + 50) // 100, 1, 255))
    image = to_srgb8(_scene(), 1.0)
    for quality in (15, 75, 100):
        stream = io.BytesIO()
        Image.fromarray(image).save(stream, "JPEG", quality=quality, subsampling=2)
        np.testing.assert_array_equal(compressed(image, quality), np.array(Image.open(stream)))


@pytest.mark.parametrize("quality", [20, 40, 75, 92])
@pytest.mark.parametrize("sensor", [NOISY, replace(NOISY, mosaic="RGGB")])
def test_images_are_told_by_what_was_done_to_them(sensor: Sensor, quality: int) -> None:
    light = np.tile(_scene(48, 40), (2, 3, 1))
    raw, coded = _image(light, sensor), replace(sensor, jpeg_quality=quality)
    assert processing_fault(raw, sensor, "x") is None
    assert processing_fault(_image(light, coded), coded, "x") is None
    assert "looks not compressed" in str(processing_fault(raw, coded, "x"))
    other = compressed(raw, quality - 13)
    assert f"looks like quality {quality - 13}" in str(processing_fault(other, coded, "x"))
    interpolated = replace(sensor, mosaic="BGGR")
    assert "looks like " in str(processing_fault(raw, interpolated, "x"))


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match=r"sensor mosaic = 'RGBG': allowed are none, RGGB"):
        Sensor(mosaic="RGBG")  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match=r"sensor jpeg_quality = 101: allowed is 0 to 100"):
        Sensor(jpeg_quality=101)
    with pytest.raises(RsbenchError, match=r"jpeg_quality = 90: .* at most 65500"):
        compressed(np.zeros((1, 65501, 3), np.uint8), 90)


def test_cameras_may_differ_and_records_say_what_there_is() -> None:
    """Sequences of before had no keys for what differs."""
    sensor = replace(NOISY, mosaic="RGGB", right_mosaic="none", right_jpeg_quality=70)
    left, right = sensor.of("left", 1), sensor.of("right", 1)
    assert (left.mosaic, left.jpeg_quality) == ("RGGB", 0) and (right.mosaic, right.jpeg_quality) == ("none", 70)
    assert right.of("left", 0) == right
    assert set(sensor.record) - set(NOISY.record) == {"mosaic", "right_mosaic", "right_jpeg_quality"}
    assert NOISY.record["gain"] == 4
    assert not {"mosaic", "jpeg_quality", "brightness", "right_gain"} & set(NOISY.record)
    assert replace(NOISY, brightness=(1.0, 0.5)).record == NOISY.record | {"brightness": [1.0, 0.5]}


@pytest.mark.parametrize("quality", [10, 20, 50, 80])
def test_a_compressed_image_of_equal_rows_is_sound(quality: int) -> None:
    """In each block all rows are alike: their rounding repeats, and adds up in few coefficients."""
    rows = np.random.default_rng(0).uniform(30.0, 90.0, (12, 96)).repeat(8, axis=0)
    raw = (rows[..., None] * np.array([0.8, 1.0, 0.6])).astype(np.uint8)
    sensor = Sensor(jpeg_quality=quality)
    assert processing_fault(compressed(raw, quality), sensor, "x") is None
    assert "whole steps" in str(processing_fault(raw, sensor, "x"))
