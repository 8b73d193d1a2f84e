"""Stated covariances: right ones are told right as often as the intervals say, wrong ones are told wrong."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from rsbench.benchmark.leaderboard.standings import LEVELS, calibration, named_numbers


def _scores(nees: np.ndarray, scenes: int = 0) -> pd.DataFrame:
    names = [f"s{k % scenes}" if scenes else f"s{k}" for k in range(len(nees))]
    return pd.DataFrame({"scene": names, "nees": nees})


def test_right_covariances_are_told_right() -> None:
    """Intervals hold in 95 % of boards: exact ones in at least so many; 150 boards."""
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((150, 40, 6))
    found = [calibration(_scores(nees), 6) for nees in np.sum(errors**2, axis=2)]
    held = np.zeros(4)
    for each in found:
        assert each is not None and each.stated == 40
        held[0] += each.spread[1] <= 1.0 <= each.spread[2]
        held[1:] += [low <= level <= high for level, (_, low, high) in zip(LEVELS, each.covers, strict=True)]
    assert np.all(held / len(found) >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / 150)), held


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_covariances_are_told_wrong(factor: float) -> None:
    """Errors that are ``factor`` times as large as stated: shares are those of chi-squared."""
    nees = factor**2 * np.sum(np.random.default_rng(1).standard_normal((500, 6)) ** 2, axis=1)
    found = calibration(_scores(nees), 6)
    assert found is not None
    assert found.spread[0] == pytest.approx(factor**2, rel=0.15)
    assert found.mean == pytest.approx(factor**2, rel=0.1)  # 500 values: standard deviation 2.6 %
    for level, (share, low, high) in zip(LEVELS, found.covers, strict=True):
        expected = chi2.cdf(chi2.ppf(level, 6) / factor**2, 6)
        assert low < expected < high and (share > level) == (factor < 1.0)


def test_nothing_stated_is_nothing_told() -> None:
    assert calibration(_scores(np.full(5, np.nan)), 6) is None
    assert calibration(pd.DataFrame({"scene": ["a"]}), 6) is None
    assert all(np.isnan(triple).all() for triple in named_numbers(None).values())
    some = calibration(_scores(np.array([np.nan, 1.0, np.inf]), scenes=2), 6)
    assert some is not None and some.stated == 2 and some.mean == np.inf
    assert list(named_numbers(some)) == ["nees_ratio", "covers_50", "covers_90", "covers_95"]
