"""Mosaics and JPEG against plain loops, the tables of ITU-T T.81, and another program's JPEG."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from rsbench.core.errors import RsbenchError
from rsbench.renderers import processing
from rsbench.renderers.electrons import Mosaic, Sensor, expose
from rsbench.renderers.image import to_srgb8
from rsbench.renderers.processing import compressed, processed, rows_needed, shares_of_noise
from rsbench.verification.processing_checks import processing_fault, quality_steps

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
                made[y, x, k] = np.mean(
                    [each for _, each in min(sides, key=lambda two: abs(two[0][1] - two[1][1]))]
                )
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


def test_without_both_nothing_is_done() -> None:
    light, rows = _scene(), list(range(45))
    assert rows_needed(NOISY, rows, 45) is rows
    np.testing.assert_array_equal(_image(light, NOISY), to_srgb8(expose(light, NOISY, 7, 45, rows), 1.0))


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
    sensor = replace(NOISY, mosaic="RGGB", right_mosaic="none", right_jpeg_quality=70)
    left, right = sensor.of("left", 1), sensor.of("right", 1)
    assert (left.mosaic, left.jpeg_quality) == ("RGGB", 0) and (right.mosaic, right.jpeg_quality) == ("none", 70)
    assert right.of("left", 0) == right
    assert set(sensor.record) - set(NOISY.record) == {"mosaic", "right_mosaic", "right_jpeg_quality"}
    assert not {"mosaic", "jpeg_quality"} & set(NOISY.record)
