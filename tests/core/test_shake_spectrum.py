"""Shakes by their spectrum: the power of each band, read back with a Fourier transform."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.core import so3
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.card import load_dataset_card

STILL = [0.0] * 6


def _motion(bands: list[list[float]], path: list[float] = STILL, **others: Any) -> SplineMotion:
    given: dict[str, Any] = {"interval": 0.5, "spectrum": {"path": path, "bands": bands}, **others}
    w, d = SplineMotion.endpoint(given) or (None, None)
    assert w is not None and d is not None
    return SplineMotion(w, d, **given)


def _power(values: FloatArray, cycles: float) -> tuple[FloatArray, FloatArray]:
    """Power (n, 3) by frequency (n,) of values (m, 3), ``cycles`` of which are a frame period."""
    window = np.hanning(len(values))[:, None]
    spectrum = np.abs(np.fft.rfft((values - values.mean(axis=0)) * window, axis=0)) ** 2
    return np.asarray(np.fft.rfftfreq(len(values), 1.0 / cycles), dtype=np.float64), spectrum / np.sum(
        window**2
    ) * 2.0 / len(values)


@pytest.mark.parametrize(("low", "high"), [(0.05, 0.1), (0.2, 0.4)])
def test_a_band_has_its_strength_at_its_frequencies_and_nowhere_else(low: float, high: float) -> None:
    """Of 400 periods: eight sines add their powers to 3 %, a spline through 5 points of the fastest loses 1 %."""
    motion = _motion([[low, high, 0.1, 0.002]], periods=400)
    tau = np.arange(0.0, 400.0, 0.25)
    R, t = motion.body_from_world(tau)
    for values, sigma in ((np.rad2deg(so3.log(R)), 0.1), (t, 0.002)):
        np.testing.assert_allclose(np.std(values, axis=0), sigma, rtol=0.05)
        frequency, power = _power(values, 4.0)
        inside = (frequency > low - 0.01) & (frequency < high + 0.01)
        # Outside are what the window leaks, and turns that do not commute: 0.1 deg of each other.
        assert np.all(np.sum(power[~inside], axis=0) < 1e-3 * np.sum(power, axis=0))


def test_bands_add_and_the_path_goes_on_below_them() -> None:
    motion = _motion(
        [[0.01, 0.05, 0.3, 0.0], [0.2, 0.4, 0.0, 0.001]], [0.0, 0.5, 0.0, 0.0, 0.0, -0.03], periods=100
    )
    R, t = motion.body_from_world(np.arange(101.0))
    np.testing.assert_allclose(np.rad2deg(np.linalg.norm(so3.log(R[-1]))), 50.0, atol=2.0)
    # A circle of half a degree and 30 mm each period, seen from the start of a body that sways by 0.3 deg there.
    chord = 0.03 * np.sin(np.deg2rad(25.0)) / np.sin(np.deg2rad(0.25))
    np.testing.assert_allclose(
        np.linalg.norm(inverse(type(motion.body_from_world(0.0))(R, t)).t[-1]), chord, rtol=0.02
    )


def test_a_longer_shake_begins_as_a_shorter_one_and_is_read_back_to_rounding() -> None:
    bands = [[0.05, 0.3, 0.2, 0.003]]
    short, long = (_motion(bands, periods=periods, seed=3) for periods in (4, 40))
    tau = np.linspace(0.0, 4.0, 33)
    for a, b in zip(short.body_from_world(tau), long.body_from_world(tau), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    again = SplineMotion(long.w, long.d, **long.parameters)
    for a, b in zip(again.body_from_world(tau), long.body_from_world(tau), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
    assert np.max(np.abs(_motion(bands, seed=4).w - short.w)) > 1e-4


@pytest.mark.parametrize(
    ("spectrum", "words"),
    [
        (3, "spectrum must be a table with path and bands"),
        ({"bands": [[0.1, 0.2, 0.1, 0.0]]}, "spectrum must be a table with path and bands"),
        ({"path": [0.0] * 5, "bands": [[0.1, 0.2, 0.1, 0.0]]}, "spectrum.path must be 6"),
        ({"path": ["a"] * 6, "bands": [[0.1, 0.2, 0.1, 0.0]]}, "spectrum.path"),
        ({"path": STILL, "bands": []}, "spectrum.bands must be 1 to 32 rows of 4"),
        ({"path": STILL, "bands": [[0.2, 0.1, 0.1, 0.0]]}, "must rise from 0"),
        ({"path": STILL, "bands": [[0.2, 0.6, 0.1, 0.0]]}, "at most 0.5 cycles per frame period"),
        ({"path": STILL, "bands": [[0.2, 0.3, -0.1, 0.0]]}, "standard deviations from 0"),
        ({"path": STILL, "bands": [[0.2, 0.3, float("nan"), 0.0]]}, "spectrum.bands"),
    ],
)
def test_what_is_no_spectrum_is_refused(spectrum: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SplineMotion.endpoint({"interval": 0.5, "spectrum": spectrum})


def test_a_spectrum_excludes_other_shakes() -> None:
    spectrum = {"path": STILL, "bands": [[0.1, 0.2, 0.1, 0.0]]}
    with pytest.raises(ValueError, match="spectrum and preset exclude each other"):
        SplineMotion.endpoint({"interval": 0.5, "spectrum": spectrum, "preset": "handheld"})
    with pytest.raises(ValueError, match="at most 20000 are drawn"):
        SplineMotion.endpoint({"interval": 1e-6, "spectrum": spectrum})


def test_the_card_handheld_turns_as_fast_as_it_says() -> None:
    """RMS about an axis: over a second a band's sines beat, so that each sequence is up to a half off."""
    card = load_dataset_card("handheld")
    said = {"still": 2.7, "walk": 14.0, "shake": 27.0}
    rates: dict[str, list[FloatArray]] = {name: [] for name in said}
    for sequence in card.sequence:
        motion = card.motion_of(sequence)
        assert motion.lasts >= card.frames - 1 + card.shutter_for(sequence).readout_ratio
        rates[sequence.name.rpartition("-")[2]].append(motion.velocity(np.linspace(0.0, card.frames, 600))[0])
    for name, turns in rates.items():
        rms = np.rad2deg(np.sqrt(np.mean(np.concatenate(turns) ** 2))) / card.frame_period_s
        assert 0.7 * said[name] < rms < 1.4 * said[name]
