"""Confidence intervals: order statistics for small samples, a cluster bootstrap for large ones.

A percentile bootstrap of the median is too narrow for small samples. Two order statistics of independent values
enclose the median of any continuous distribution with a probability that follows exactly from the binomial
distribution. Values from the same scene are not independent; the bootstrap then resamples whole scenes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, betaincinv, stdtrit  # scipy.stats takes a second to load

from rsbench.components.seeds import generator
from rsbench.core.so3 import FloatArray

COVERAGE = 0.95
FEW = 30
"""Sample size below which the interval of a median is computed from order statistics."""
RESAMPLES = 10_000
_CHUNK = 2_000_000
"""Number of values that are drawn at once, which limits the memory."""
Statistic = Callable[[FloatArray], FloatArray]
"""Function that reduces the second axis of resampled values (resamples, values, ...)."""


class Interval(NamedTuple):
    """Ends of an interval; infinite if there are too few values."""

    low: float
    high: float


def median_interval(values: ArrayLike) -> Interval:
    """Return the exact interval of the median of the distribution of independent values (n,).

    The ends are the order statistics x[k] and x[n + 1 - k] with the largest k for which the probability is at
    least ``COVERAGE``. At 95 %, nine values give x[2] and x[8]; fewer than six give an infinite interval.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = len(ordered)
    # P(x[k] <= median <= x[n+1-k]) = 1 - 2 P(Binomial(n, 1/2) <= k - 1)
    k = 0
    while k + 1 <= n // 2 and 1.0 - 2.0 * float(bdtr(k, n, 0.5)) >= COVERAGE:
        k += 1
    if k == 0:
        return Interval(-np.inf, np.inf)
    return Interval(float(ordered[k - 1]), float(ordered[n - k]))


def share_interval(successes: int, trials: int, coverage: float = COVERAGE) -> Interval:
    """Return the exact (Clopper-Pearson) interval of a share; for 300 of 300 it is [0.988, 1]."""
    if trials == 0:
        return Interval(0.0, 1.0)
    tail, failures = 0.5 * (1.0 - coverage), trials - successes
    low = betaincinv(successes, failures + 1, tail) if successes > 0 else 0.0
    high = betaincinv(successes + 1, failures, 1.0 - tail) if failures > 0 else 1.0
    return Interval(float(low), float(high))


def scene_means(values: FloatArray, scenes: Sequence[str]) -> FloatArray:
    """Return the means (..., scenes) of values (..., n) over each scene, in the order of the scene names."""
    names, labels = np.unique(np.asarray(scenes), return_inverse=True)
    weights = np.zeros((len(names), len(labels)))
    weights[labels, np.arange(len(labels))] = 1.0
    return values @ (weights / weights.sum(axis=1, keepdims=True)).T


def mean_interval(means: FloatArray) -> Interval:
    """Return Student's t interval of the mean of independent scene means (k,); infinite for a single scene."""
    k = len(means)
    if k < 2:
        return Interval(-np.inf, np.inf)
    half = float(stdtrit(k - 1, 0.5 + 0.5 * COVERAGE) * np.std(means, ddof=1) / np.sqrt(k))
    middle = float(np.mean(means))
    return Interval(middle - half, middle + half)


def score_interval(values: FloatArray, scenes: Sequence[str], share: bool = True) -> tuple[float, float, float]:
    """Return the mean over scenes of values (n,) and the ends of its interval.

    A ``share`` and its interval lie in [0, 1]. If all values are 0 or 1 and each problem has its own scene, the
    interval is the exact binomial one. If problems share scenes, Student's interval is extended to contain the
    exact one, so that it does not shrink to a point if all values are equal.
    """
    means = scene_means(values, scenes)
    low, high = mean_interval(means)
    if not share:
        return float(np.mean(means)), low, high
    if np.all((values == 0.0) | (values == 1.0)):
        exact = share_interval(int(np.sum(values)), len(values))
        if len(means) == len(values):
            return float(np.mean(means)), exact.low, exact.high
        low, high = min(low, exact.low), max(high, exact.high)
    return float(np.mean(means)), max(low, 0.0), min(high, 1.0)


def bootstrap_interval(
    values: FloatArray,
    statistic: Statistic,
    seed: int,
    clusters: Sequence[Any] | NDArray[Any] | None = None,
    resamples: int = RESAMPLES,
) -> Interval:
    """Compute the percentile bootstrap interval of a statistic of values (n, ...).

    Args:
        values: n values, each a number or an array.
        statistic: see ``Statistic``.
        seed: calls with the same n, clusters and seed use the same resamples, so that entries are compared on
            common resamples.
        clusters: (n,) labels; whole clusters are resampled. Unequal clusters give resamples of unequal size.
        resamples: number of resamples.
    """
    rng = generator(seed, "bootstrap", len(values))
    if clusters is None:
        drawn = _statistics(values, statistic, rng, resamples)
    else:
        drawn = _clustered(values, statistic, np.asarray(clusters), rng, resamples)
    return _middle_part(drawn)


def _statistics(values: FloatArray, statistic: Statistic, rng: np.random.Generator, resamples: int) -> FloatArray:
    n = len(values)
    step = max(1, _CHUNK // max(values.size, 1))
    parts = [
        statistic(values[rng.integers(0, n, (min(step, resamples - first), n))])
        for first in range(0, resamples, step)
    ]
    return np.concatenate(parts)


def _clustered(
    values: FloatArray, statistic: Statistic, clusters: NDArray[Any], rng: np.random.Generator, resamples: int
) -> FloatArray:
    _, labels = np.unique(clusters, return_inverse=True)
    draws = rng.integers(0, int(labels.max()) + 1, (resamples, int(labels.max()) + 1))
    if statistic is median and values.ndim == 1:
        return _medians(values, labels, draws)
    members = [np.flatnonzero(labels == label) for label in range(int(labels.max()) + 1)]
    samples = [np.concatenate([members[k] for k in draw]) for draw in draws]
    return np.array([float(statistic(values[sample][None])[0]) for sample in samples])


def _medians(values: FloatArray, labels: NDArray[np.intp], draws: NDArray[np.int64]) -> FloatArray:
    """Return the medians (resamples,) of the values (n,) in the resampled clusters (resamples, clusters)."""
    order = np.argsort(values, kind="stable")
    times = np.sum(draws[:, :, None] == np.arange(draws.shape[1]), axis=1)
    below = np.cumsum(times[:, labels[order]], axis=1)
    middle = ((below[:, -1:] - 1) // 2, below[:, -1:] // 2)
    return np.asarray(np.mean([values[order][np.argmax(below > rank, axis=1)] for rank in middle], axis=0))


def typical_interval(values: FloatArray, seed: int, clusters: Sequence[Any] | None = None) -> Interval:
    """Return the interval of the median of values (n,): exact below ``FEW`` values, otherwise a bootstrap."""
    if len(values) < FEW:
        return median_interval(values)
    if clusters is not None:
        return bootstrap_interval(values, median, seed, clusters)
    # The median of a resample is the value at its median rank; the ranks do not depend on the values.
    middle = _middle_ranks(len(values), seed)
    return _middle_part(np.mean(np.sort(values)[middle], axis=1))


def average_interval(values: FloatArray, seed: int, of: Statistic | None = None) -> Interval:
    """Return the bootstrap interval of the mean of values (n,), or of a function ``of`` the means of (n, k).

    ``of`` reduces the last axis of means (resamples, k).
    """
    means = _counts(len(values), seed) @ values / len(values)
    return _middle_part(means if of is None else of(means))


@lru_cache(maxsize=4)
def _counts(n: int, seed: int) -> FloatArray:
    """Return how often each of n values occurs in each resample, (resamples, n)."""
    return generator(seed, "bootstrap", n).multinomial(n, np.full(n, 1.0 / n), RESAMPLES).astype(np.float64)


@lru_cache(maxsize=4)
def _middle_ranks(n: int, seed: int) -> NDArray[np.intp]:
    """Return the ranks (resamples, 2), from 0, of the one or two middle values of each resample."""
    drawn = np.cumsum(_counts(n, seed), axis=1)
    return np.stack([np.argmax(drawn > k, axis=1) for k in ((n - 1) // 2, n // 2)], axis=1)


def _middle_part(drawn: FloatArray) -> Interval:
    tail = 0.5 * (1.0 - COVERAGE)
    low, high = np.quantile(drawn, [tail, 1.0 - tail], method="inverted_cdf")  # no NaN between infinities
    return Interval(float(low), float(high))


def format_interval(value: float, low: float, high: float) -> str:
    """Format ``value [low, high]``; the last digit is at most a third of the half-width of the interval."""
    if low == high or not all(map(math.isfinite, (value, low, high))):
        return f"{value:.3g} [{low:.3g}, {high:.3g}]"
    digits = decimals(low, high)
    return f"{rounded(value, digits)} [{rounded(low, digits)}, {rounded(high, digits)}]"


def with_ends(name: str, value: Any, low: Any, high: Any) -> dict[str, Any]:
    """Return a value and the ends of its interval as columns of a table."""
    return {name: value, f"{name}_low": low, f"{name}_high": high}


def decimals(low: float, high: float) -> int:
    """Return the number of significant decimals for an interval, at most 9; negative for tens and hundreds."""
    half = 0.5 * (high - low)
    return 9 if half <= 0.0 else min(9, -math.floor(math.log10(half / 3.0)))


def rounded(value: float, digits: int) -> str:
    """Format a number with ``digits`` decimals and trailing zeros; negative: rounded to tens or hundreds."""
    return f"{round(value, digits):.{max(digits, 0)}f}"


def median_and_quartiles(values: ArrayLike) -> str:
    """Format ``median [lower, upper]`` with digits that suit the quartile range; one number if all are equal.

    NaN is left out. The quartiles are elements of ``values``, because a finite and an infinite value cannot be
    interpolated.
    """
    numbers = np.asarray(values, dtype=np.float64)
    found = numbers[~np.isnan(numbers)]
    if not found.size:
        return "–"
    low, high = np.quantile(found, [0.25, 0.75], method="inverted_cdf")
    middle = float(np.median(found))
    if not np.isfinite(middle):
        return "inf"
    size = _exponent(middle)
    width = size if np.isinf(high) else _exponent(high - low) if high > low else size - 2
    places = max(0, 1 - width if width >= size - 1 else 2 - size)
    texts = [f"{value:.{places}f}" for value in (middle, low, high)]
    return texts[0] if len(set(texts)) == 1 else f"{texts[0]} [{texts[1]}, {texts[2]}]"


def _exponent(value: float) -> int:
    """Return the decimal exponent of the first significant digit: 0 for ones, -1 for tenths."""
    return math.floor(math.log10(abs(value))) if value else 0


def median(values: FloatArray) -> FloatArray:
    """Median over the last axis."""
    return np.asarray(np.median(values, axis=-1))


def mean(values: FloatArray) -> FloatArray:
    """Mean over the last axis."""
    return np.asarray(np.mean(values, axis=-1))
