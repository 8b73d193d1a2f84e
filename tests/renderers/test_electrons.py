"""The sensor's noise against the formulas of EMVA 1288, at 20 grey levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from rsbench.renderers.electrons import Sensor, expose, fall_off

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


def test_what_all_share_is_recorded_as_ever() -> None:
    """Sequences of before had no keys for what differs."""
    assert "right_gain" not in PHONE.record and "brightness" not in PHONE.record
    assert PHONE.record["gain"] == 4
    uneven = replace(PHONE, brightness=(1.0, 0.5))
    assert uneven.record == PHONE.record | {"brightness": [1.0, 0.5]}


def test_a_row_has_the_same_bits_by_itself() -> None:
    image = np.random.default_rng(1).random((12, 9, 3), dtype=np.float32)
    sensor = replace(PHONE, vignetting=0.3)
    whole = expose(image, sensor, 5, 12, np.arange(12))
    np.testing.assert_array_equal(expose(image[[3, 8]], sensor, 5, 12, [3, 8]), whole[[3, 8]])
    difference = expose(image, sensor, 6, 12, np.arange(12)) - whole
    light = image * fall_off(sensor, 9, 12, np.arange(12))[..., None]
    assert difference.var() == pytest.approx(2 * sensor.variance(light).mean(), rel=0.5), (
        "another seed, other noise"
    )


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
