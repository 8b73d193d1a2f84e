"""The clock of a gyroscope beside frames of one camera. Truth: a shake in closed form, and its rotations."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.components.motion_models import AcceleratedMotion
from rsbench.core import so3
from rsbench.pipeline.mono_gyro import PairRates, find_clock, mean_rates, mean_turn

Array = np.ndarray
RATIO, FARTHEST = 0.8, 15.0
ROWS = np.linspace(0.0, RATIO, 33)


def _shake(tau: Array, size: float = 1.0) -> Array:
    """Rotation vectors (..., 3): a walk's, of some tenths of a degree, on a steady turn."""
    waves = [(0.11, 0.0, 0.3), (0.23, 1.0, 0.2), (0.37, 2.0, 0.1)]
    axes = [sum(a * np.sin(2.0 * np.pi * f * tau + p + k) for f, p, a in waves) for k in (0.0, 2.0, 4.0)]
    return np.deg2rad(size * np.stack(axes, axis=-1) + 0.3 * tau[..., None])


def _pairs(size: float = 1.0, noise: float = 3e-4) -> PairRates:
    """Of each row's own rotation over a period, the mean over the rows."""
    starts = np.arange(20.0)
    moments = starts[:, None] + ROWS
    before, after = so3.exp(_shake(moments, size)), so3.exp(_shake(moments + 1.0, size))
    rates = so3.log(after @ np.swapaxes(before, -1, -2)).mean(axis=1)
    return PairRates(starts, rates + noise * np.random.default_rng(0).normal(size=rates.shape))


def _samples(late: float, size: float = 1.0) -> Array:
    """Of a gyroscope with a bias of 0.03 rad/s at 30 Hz, whose times are that late."""
    tau, step = np.arange(-20.0, 45.0, 1.0 / 16.0), 1e-4
    turns = so3.exp(_shake(tau + step, size)) @ np.swapaxes(so3.exp(_shake(tau - step, size)), -1, -2)
    return np.column_stack([tau + late, so3.log(turns) / (2.0 * step) + [1e-3, -5e-4, 2e-4]])


@pytest.mark.parametrize("late", [-11.3, -0.4, 0.0, 6.25])
def test_a_shake_tells_how_late_the_clock_is(late: float) -> None:
    clock = find_clock(_pairs(), _samples(late), RATIO, FARTHEST)
    assert clock.told and clock.used == (late != 0.0)
    assert abs(clock.shift - late) < 3.0 * clock.sigma and clock.sigma < 0.1


def test_pairs_whose_motion_is_wrong_count_little() -> None:
    pairs = _pairs()
    pairs.rates[::5] = np.deg2rad([3.0, -2.0, 1.0])
    clock = find_clock(pairs, _samples(6.25), RATIO, FARTHEST)
    assert clock.told and abs(clock.shift - 6.25) < 3.0 * clock.sigma


def test_a_steady_turn_few_pairs_and_another_gyroscope_tell_nothing() -> None:
    still = find_clock(_pairs(0.0), _samples(3.0, 0.0), RATIO, FARTHEST)
    few = find_clock(PairRates(*(each[:5] for each in _pairs())), _samples(3.0), RATIO, FARTHEST)
    other = find_clock(_pairs(), _samples(3.0) * [1.0, -1.0, -1.0, -1.0], RATIO, FARTHEST)
    for clock in (still, few, other):
        assert not clock.told and not clock.used and clock.shift == 0.0


def test_a_shift_beyond_what_is_looked_for_is_not_told() -> None:
    assert not find_clock(_pairs(), _samples(6.25), RATIO, 4.0).told


@pytest.mark.parametrize("start", [0.0, 3.0])
def test_the_rate_of_an_accelerated_pair_is_that_of_a_gyroscope_on_it(start: float) -> None:
    """About a fixed axis rotation vectors add up, so that the gyroscope's mean is exact.

    The rotation between the first rows alone would be that of half a readout earlier.
    """
    motion = AcceleratedMotion([0.0, 0.02, 0.0], [0.1, 0.0, 0.0], 0.3)
    tau = np.linspace(-1.0, 4.0, 501)
    samples = np.column_stack([tau + start, motion.velocity(tau)[0]])
    expected = mean_rates(samples, np.array([start]), RATIO)[0]
    np.testing.assert_allclose(mean_turn(motion, RATIO), expected, rtol=1e-3)
    assert abs(motion.w[1] / expected[1] - 1.0) > 0.05
