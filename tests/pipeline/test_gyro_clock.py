"""The offset of a gyroscope's clock, estimated with frames of one camera. Truth: a shake in closed form."""

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
    """Rotation vectors (..., 3) of a walking person: some tenths of a degree, on a constant angular velocity."""
    waves = [(0.11, 0.0, 0.3), (0.23, 1.0, 0.2), (0.37, 2.0, 0.1)]
    axes = [sum(a * np.sin(2.0 * np.pi * f * tau + p + k) for f, p, a in waves) for k in (0.0, 2.0, 4.0)]
    return np.deg2rad(size * np.stack(axes, axis=-1) + 0.3 * tau[..., None])


def _pairs(size: float = 1.0, noise: float = 3e-4) -> PairRates:
    """The mean over the rows of each row's rotation over a period."""
    starts = np.arange(20.0)
    moments = starts[:, None] + ROWS
    before, after = so3.exp(_shake(moments, size)), so3.exp(_shake(moments + 1.0, size))
    rates = so3.log(after @ np.swapaxes(before, -1, -2)).mean(axis=1)
    return PairRates(starts, rates + noise * np.random.default_rng(0).normal(size=rates.shape))


def _samples(late: float, size: float = 1.0) -> Array:
    """Samples of a gyroscope with a bias of 0.03 rad/s at 30 Hz, whose times are too large by ``late``."""
    tau, step = np.arange(-20.0, 45.0, 1.0 / 16.0), 1e-4
    turns = so3.exp(_shake(tau + step, size)) @ np.swapaxes(so3.exp(_shake(tau - step, size)), -1, -2)
    return np.column_stack([tau + late, so3.log(turns) / (2.0 * step) + [1e-3, -5e-4, 2e-4]])


@pytest.mark.parametrize("late", [-11.3, -0.4, 0.0, 6.25])
def test_a_shake_determines_the_offset_of_the_clock(late: float) -> None:
    clock = find_clock(_pairs(), _samples(late), RATIO, FARTHEST)
    assert clock.told and clock.used == (late != 0.0)
    assert abs(clock.shift - late) < 3.0 * clock.sigma and clock.sigma < 0.1


def test_pairs_whose_motion_is_wrong_count_little() -> None:
    pairs = _pairs()
    pairs.rates[::5] = np.deg2rad([3.0, -2.0, 1.0])
    clock = find_clock(pairs, _samples(6.25), RATIO, FARTHEST)
    assert clock.told and abs(clock.shift - 6.25) < 3.0 * clock.sigma


def test_a_constant_rate_few_pairs_and_another_gyroscope_determine_no_offset() -> None:
    still = find_clock(_pairs(0.0), _samples(3.0, 0.0), RATIO, FARTHEST)
    few = find_clock(PairRates(*(each[:5] for each in _pairs())), _samples(3.0), RATIO, FARTHEST)
    other = find_clock(_pairs(), _samples(3.0) * [1.0, -1.0, -1.0, -1.0], RATIO, FARTHEST)
    for clock in (still, few, other):
        assert not clock.told and not clock.used and clock.shift == 0.0


@pytest.mark.parametrize("late, farthest", [(0.4, 0.5), (-0.8, 1.0), (3.8, 4.0)])
def test_offsets_up_to_the_largest_one_are_found(late: float, farthest: float) -> None:
    clock = find_clock(_pairs(), _samples(late), RATIO, farthest)
    assert clock.told and clock.used
    assert abs(clock.shift - late) < 3.0 * clock.sigma


@pytest.mark.parametrize("late, farthest", [(6.25, 4.0), (-1.4, 0.5), (0.8, 0.5)])
def test_an_offset_beyond_the_largest_one_is_not_determined(late: float, farthest: float) -> None:
    assert not find_clock(_pairs(), _samples(late), RATIO, farthest).told


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
