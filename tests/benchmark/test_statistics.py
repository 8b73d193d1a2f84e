"""Intervals cover the truth as often as they say, on distributions whose median and mean are known."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from rsbench.benchmark.statistics import (
    Interval,
    average_interval,
    bootstrap_interval,
    decimals,
    format_interval,
    mean,
    median,
    median_interval,
    rounded,
    share_interval,
    typical_interval,
)
from rsbench.core.so3 import FloatArray


def test_ends_are_the_tightest_that_hold() -> None:
    """Against the sum over all ways in which n coin tosses fall."""

    def holds(n: int, k: int) -> float:
        return 1.0 - 2.0 * sum(comb(n, j) for j in range(k)) / 2.0**n

    for n in range(1, 40):
        low, high = median_interval(np.arange(1.0, n + 1.0))
        if n < 6:
            assert (low, high) == (-np.inf, np.inf) and holds(n, 1) < 0.95
        else:
            assert high == n + 1 - low
            assert holds(n, int(low)) >= 0.95 > holds(n, int(low) + 1)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60))
def test_the_median_lies_in_its_interval(values: list[float]) -> None:
    low, high = median_interval(values)
    assert low <= np.median(values) <= high


def test_clusters_widen_the_interval_to_what_they_hold() -> None:
    """Thirty values of three scenes say as much about scenes as three values, not as thirty."""
    rng = np.random.default_rng(2)
    scenes = np.repeat(np.arange(12), 10)
    covered = {"clusters": 0, "alone": 0}
    for _ in range(200):
        values = rng.standard_normal(12)[scenes] + 0.1 * rng.standard_normal(120)
        for name, clusters in (("clusters", scenes), ("alone", None)):
            low, high = bootstrap_interval(values, mean, 0, clusters, resamples=400)
            covered[name] += int(low <= 0.0 <= high)
    # Twelve clusters: the percentile interval of their mean is a little short (t against normal quantiles).
    assert covered["clusters"] / 200 > 0.86
    assert covered["alone"] / 200 < 0.6


def test_drawing_clusters_of_one_is_drawing_values() -> None:
    """Against the exact distribution: all 27 samples of three values, each equally likely."""
    values = np.array([0.0, 1.0, 10.0])
    low, high = bootstrap_interval(values, mean, 0, ["a", "b", "c"])
    means = sorted({round(sum(c) / 3.0, 9) for c in combinations_with_replacement([0.0, 1.0, 10.0], 3)})
    assert (round(low, 9), round(high, 9)) == (means[0], means[-1])  # each end has probability 1/27 > 2.5 %


@given(trials=st.integers(1, 400), data=st.data())
def test_shares_against_the_beta_distribution(trials: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, trials))
    low, high = share_interval(successes, trials)
    assert low == pytest.approx(beta.ppf(0.025, successes, trials - successes + 1) if successes else 0.0, abs=1e-9)
    assert high == pytest.approx(
        beta.ppf(0.975, successes + 1, trials - successes) if successes < trials else 1.0, abs=1e-9
    )


def test_few_values_are_exact_and_many_drawn() -> None:
    rng = np.random.default_rng(3)
    few, many = rng.standard_normal(9), rng.standard_normal(100)
    assert typical_interval(few, 0) == median_interval(few)
    # Another draw of the same bootstrap: ends differ by what 10 000 samples leave open.
    np.testing.assert_allclose(typical_interval(many, 0), bootstrap_interval(many, median, 1), atol=0.05)
    assert typical_interval(many, 0) == typical_interval(many[::-1].copy(), 0)


INTERVALS: dict[str, tuple[Callable[[FloatArray, int], Interval], float]] = {
    "mean": (average_interval, 1.0),
    "median": (typical_interval, np.log(2.0)),
    "mean, drawn": (lambda values, seed: bootstrap_interval(values, mean, seed, resamples=1000), 1.0),
    "median, drawn": (lambda values, seed: bootstrap_interval(values, median, seed, resamples=1000), np.log(2.0)),
}
"""For many values, with what they shall cover for an exponential distribution."""


@pytest.mark.parametrize("name", INTERVALS)
def test_intervals_of_many_values_cover_the_truth(name: str) -> None:
    interval, truth = INTERVALS[name]
    found = [interval(values, 0) for values in np.random.default_rng(5).exponential(1.0, (300, 80))]
    # 95 % within four standard deviations (0.0126) of 300 experiments, less what n = 80 costs such an interval.
    assert 0.88 < np.mean([low <= truth <= high for low, high in found]) < 0.99


def test_failures_without_end_leave_an_interval() -> None:
    values = np.concatenate([np.arange(40.0), np.full(30, np.inf)])
    low, high = typical_interval(values, 0)
    assert 20.0 < low < 39.0 and np.isinf(high)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((8.22, 5.28, 12.1), "8 [5, 12]"),
        ((0.0597, 0.0561, 0.0655), "0.060 [0.056, 0.066]"),
        ((160.4, 96.0, 183.0), "160 [100, 180]"),
        ((1.0, 1.0, 1.0), "1 [1, 1]"),
        ((2.5, -np.inf, np.inf), "2.5 [-inf, inf]"),
    ],
)
def test_digits_follow_the_interval(numbers: tuple[float, float, float], words: str) -> None:
    assert format_interval(*numbers) == words


@given(st.floats(-1e3, 1e3), st.floats(1e-6, 1e3))
def test_rounding_moves_a_value_by_little_of_its_interval(value: float, half: float) -> None:
    low, high = value - half, value + half
    # Half a unit of the last digit, which is below a third of half the interval.
    assert abs(float(rounded(value, decimals(low, high))) - value) <= half / 6.0 * (1 + 1e-6) + 1e-9


_PROBLEMS = st.tuples(st.integers(0, 4), st.sampled_from([0.0, 0.5, 1.0, 2.5, np.inf]))


@given(st.lists(_PROBLEMS, min_size=1, max_size=40))
def test_the_median_of_drawn_clusters_is_that_of_their_values(problems: list[tuple[int, float]]) -> None:
    """Counted without drawing, against NumPy's of each draw: ties, infinite errors, clusters of any size."""
    clusters, values = [k for k, _ in problems], np.array([x for _, x in problems])
    drawn = bootstrap_interval(values, lambda each: np.median(each, axis=-1), 3, clusters, resamples=40)
    assert bootstrap_interval(values, median, 3, clusters, resamples=40) == drawn
