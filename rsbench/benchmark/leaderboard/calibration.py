"""Calibration of the covariances that methods state (NEES): shown beside scores, and never ranked.

The squared error of a motion by its covariance (NEES) is chi-squared with six degrees of freedom where that is
right (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4):
the ellipsoid of a level then holds the truth in that share of problems. One wild error decides about a mean, so
what has an interval is the median.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import gammaincinv

from rsbench.benchmark.leaderboard.ranking import score_interval
from rsbench.benchmark.statistics import median_interval, typical_interval
from rsbench.core.so3 import FloatArray

UNKNOWNS = 6
LEVELS = (0.5, 0.9, 0.95)
_SEED = 0
Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Of the answers that state a covariance; each triple is a value with the ends of its interval."""

    stated: int
    """How many those are."""
    spread: Triple
    """Median of NEES by that of a right covariance: 1 where it is right, 4 where errors are twice as large."""
    covers: tuple[Triple, ...]
    """For each of ``LEVELS``, the share of truths within the ellipsoid that should hold so many."""
    mean: float
    """NEES by ``UNKNOWNS``, without an interval."""


def calibration(scores: pd.DataFrame) -> Calibration | None:
    """Of the scores of an entry; None where nothing was stated."""
    if "nees" not in scores:
        return None
    told = scores[scores["nees"].notna()]
    if told.empty:
        return None
    nees, scenes = told["nees"].to_numpy(dtype=np.float64), list(told["scene"])
    ratio = nees / _chi_squared(0.5)
    alone = len(set(scenes)) == len(scenes)
    low, high = median_interval(ratio) if alone else typical_interval(ratio, _SEED, scenes)
    return Calibration(
        stated=len(told),
        spread=(float(np.median(ratio)), low, high),
        covers=tuple(score_interval(_inside(nees, level), scenes) for level in LEVELS),
        mean=float(np.mean(nees)) / UNKNOWNS,
    )


def _chi_squared(level: float) -> float:
    """Below which a share ``level`` of a chi-squared variable of ``UNKNOWNS`` degrees of freedom lies."""
    return 2.0 * float(gammaincinv(0.5 * UNKNOWNS, level))


def _inside(nees: FloatArray, level: float) -> FloatArray:
    return (nees <= _chi_squared(level)).astype(np.float64)


def named_numbers(found: Calibration | None) -> dict[str, Triple]:
    """The triples by the names of their columns; NaN where nothing was stated."""
    nothing = (np.nan, np.nan, np.nan)
    covers = found.covers if found else (nothing,) * len(LEVELS)
    return {
        "nees_ratio": found.spread if found else nothing,
        **{f"covers_{100.0 * level:.0f}": triple for level, triple in zip(LEVELS, covers, strict=True)},
    }
