"""Calibration of stated covariances: coverage of their ellipsoids, and a log score.

**Coverage.** The squared error normalised by the stated covariance (NEES) is chi-squared if this is correct, with
six degrees of freedom for a motion and one for a readout ratio (Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, section 5.4): the ellipsoid of a level then contains the truth in
that share of problems. A single large error can dominate the mean, so the interval is that of the median.

**Log score.** Good coverage is also possible with large deviations; a proper score rewards small ones too. It is
the logarithm of the ratio of the density stated by an answer, at the true motion x = (w, d), to a vague density v:

    log score = ln((1 - e) N(x; answer, covariance) + e v(x)) - ln v(x),    e = 0.01.

v depends only on the size of the motions in a split: it is a product of three-dimensional Cauchy densities about 0
for w and d, whose scales are the median lengths of the true w and d. So units cancel, and the score is the
information in nats (1.44 bits) relative to v. A failure, or an answer without a covariance, counts as v and scores
0. The share e makes the score robust: it is at least ln e = -4.6, even if the Gaussian excludes the truth. It is
proper within 0.01: stating another density than the believed one gains at most -ln(1 - e) on average. (By Gibbs'
inequality no mixture beats the true density p, and (1 - e) p + e v is at least (1 - e) p.) See Gneiting and
Raftery, Strictly proper scoring rules, JASA 2007, section 4.1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.special import gammaincinv

from rsbench.benchmark.statistics import median_interval, score_interval, typical_interval
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray

LEVELS = (0.5, 0.9, 0.95)
VAGUE = 0.01
"""Weight e of the vague density in the mixture above."""
NOT_STATED = math.nan, math.nan
_SEED = 0
Triple = tuple[float, float, float]


# Scores of one answer


def stated(error: FloatArray, covariance: FloatArray) -> tuple[float, float]:
    """Return NEES and the logarithm of the Gaussian density of an error (n,) under a stated covariance (n, n).

    They are inf and -inf if the covariance is not positive definite.
    """
    values, vectors = np.linalg.eigh(covariance)
    if not values[0] > 0.0:
        return math.inf, -math.inf
    nees = float(np.sum((vectors.T @ error) ** 2 / values))
    return nees, -0.5 * (nees + float(np.sum(np.log(2.0 * np.pi * values))))


def vague_log_densities(motions: Sequence[Motion]) -> FloatArray:
    """Return ln v (n,) of the true motions of a split; v has the unit rad^-3 m^-3."""
    found = np.zeros(len(motions))
    for vectors in (np.array([motion.w for motion in motions]), np.array([motion.d for motion in motions])):
        lengths = np.linalg.norm(vectors, axis=1)
        scale = float(np.median(lengths)) or 1.0
        found -= 2.0 * np.log(np.pi) + 3.0 * np.log(scale) + 2.0 * np.log1p((lengths / scale) ** 2)
    return found


def log_score(log_density: float, vague: float) -> float:
    """Return the log score from the logarithms of both densities at the truth; 0 if none is stated (NaN)."""
    if math.isnan(log_density):
        return 0.0
    return float(np.logaddexp(math.log1p(-VAGUE) + log_density - vague, math.log(VAGUE)))


# Calibration of an entry


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Agreement of stated covariances with the errors; each triple is a value and the ends of its interval."""

    stated: int
    """Number of answers with a covariance."""
    spread: Triple
    """Median NEES divided by its expected median: 1 if the covariance is right, 4 if errors are doubled."""
    covers: tuple[Triple, ...]
    """For each of ``LEVELS``, the share of problems whose true value lies within the ellipsoid of that level."""
    mean: float
    """Mean NEES divided by its degrees of freedom, without an interval."""
    log_score: Triple | None
    """Mean over scenes, nats; None on tracks that have none."""


def calibration(scores: pd.DataFrame, unknowns: int) -> Calibration | None:
    """Compute the calibration from the scores of an entry with ``unknowns`` unknowns; None without covariances."""
    if "nees" not in scores:
        return None
    known = scores[scores["nees"].notna()]
    if known.empty:
        return None
    nees, scenes = known["nees"].to_numpy(dtype=np.float64), list(known["scene"])
    ratio = nees / _chi_squared(0.5, unknowns)
    alone = len(set(scenes)) == len(scenes)
    low, high = median_interval(ratio) if alone else typical_interval(ratio, _SEED, scenes)
    gains = scores["log_score"].to_numpy(dtype=np.float64) if "log_score" in scores else None
    return Calibration(
        stated=len(known),
        spread=(float(np.median(ratio)), low, high),
        covers=tuple(
            score_interval((nees <= _chi_squared(level, unknowns)).astype(np.float64), scenes) for level in LEVELS
        ),
        mean=float(np.mean(nees)) / unknowns,
        log_score=None if gains is None else score_interval(gains, list(scores["scene"]), share=False),
    )


def _chi_squared(level: float, unknowns: int) -> float:
    """Return the quantile ``level`` of the chi-squared distribution with ``unknowns`` degrees of freedom."""
    return 2.0 * float(gammaincinv(0.5 * unknowns, level))


def named_numbers(found: Calibration | None, scored: bool) -> dict[str, Triple]:
    """Return the triples by the names of their columns; NaN if no covariance was stated.

    ``scored``: whether the log score is included.
    """
    nothing = (np.nan, np.nan, np.nan)
    covers = found.covers if found else (nothing,) * len(LEVELS)
    gain = nothing if found is None or found.log_score is None else found.log_score
    return {
        "nees_ratio": found.spread if found else nothing,
        **{f"covers_{100.0 * level:.0f}": triple for level, triple in zip(LEVELS, covers, strict=True)},
        **({"log_score": gain} if scored else {}),
    }
