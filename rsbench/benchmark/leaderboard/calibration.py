"""Calibration of the covariances that methods state (NEES): shown beside scores, and never ranked.

The squared error by the stated covariance (NEES) is chi-squared where that is right, with six degrees of freedom
for a motion and one for a readout ratio (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4): the ellipsoid of a level then holds the truth in that share of problems. One wild
error decides about a mean, so what has an interval is the median.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import gammaincinv

from rsbench.benchmark.leaderboard.ranking import score_interval
from rsbench.benchmark.statistics import median_interval, typical_interval

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
    """NEES over its degrees of freedom, without an interval."""


def calibration(scores: pd.DataFrame, unknowns: int) -> Calibration | None:
    """Of the scores of an entry, whose answers have so many unknowns; None where no covariance was stated."""
    if "nees" not in scores:
        return None
    told = scores[scores["nees"].notna()]
    if told.empty:
        return None
    nees, scenes = told["nees"].to_numpy(dtype=np.float64), list(told["scene"])
    ratio = nees / _chi_squared(0.5, unknowns)
    alone = len(set(scenes)) == len(scenes)
    low, high = median_interval(ratio) if alone else typical_interval(ratio, _SEED, scenes)
    return Calibration(
        stated=len(told),
        spread=(float(np.median(ratio)), low, high),
        covers=tuple(
            score_interval((nees <= _chi_squared(level, unknowns)).astype(np.float64), scenes) for level in LEVELS
        ),
        mean=float(np.mean(nees)) / unknowns,
    )


def _chi_squared(level: float, unknowns: int) -> float:
    """Below which a share ``level`` of a chi-squared variable of so many degrees of freedom lies."""
    return 2.0 * float(gammaincinv(0.5 * unknowns, level))


def named_numbers(found: Calibration | None) -> dict[str, Triple]:
    """The triples by the names of their columns; NaN where nothing was stated."""
    nothing = (np.nan, np.nan, np.nan)
    covers = found.covers if found else (nothing,) * len(LEVELS)
    return {
        "nees_ratio": found.spread if found else nothing,
        **{f"covers_{100.0 * level:.0f}": triple for level, triple in zip(LEVELS, covers, strict=True)},
    }
