"""Ranks of methods: confidence intervals of mean scores over scenes, ties, and ranks with intervals.

Scores of one scene are not independent, so scenes count, each alike: the score of an entry is the mean over scenes
of its mean over the problems there, and its interval is Student's, of the scenes' means. For simulated problems
each is a scene of its own. Two entries are compared by their differences on the same scenes, all pairs corrected
by Holm's method (Scandinavian Journal of Statistics 1979); an entry's rank lies, with the same confidence for all
entries at once, between the number of those that are better and of those that are worse (Mogstad, Romano, Shaikh,
Wilhelm, Review of Economic Studies 2024).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit  # Student's distribution and its inverse

from rsbench.benchmark.statistics import COVERAGE, Interval, share_interval
from rsbench.core.so3 import FloatArray

_ROUNDING = 1e-12
"""Scores lie in [0, 1]; differences of their means below this are none."""


class Rank(NamedTuple):
    """A place, from 1, and the places that the data do not exclude."""

    place: int
    low: int
    high: int


def scene_means(values: FloatArray, scenes: Sequence[str]) -> FloatArray:
    """Means (..., scenes), in the order of their names, of values (..., n)."""
    names, labels = np.unique(np.asarray(scenes), return_inverse=True)
    weights = np.zeros((len(names), len(labels)))
    weights[labels, np.arange(len(labels))] = 1.0
    return values @ (weights / weights.sum(axis=1, keepdims=True)).T


def mean_interval(means: FloatArray) -> Interval:
    """Interval of the mean of independent means (k,) of scenes; without bounds for a single scene."""
    k = len(means)
    if k < 2:
        return Interval(-np.inf, np.inf)
    half = float(stdtrit(k - 1, 0.5 + 0.5 * COVERAGE) * np.std(means, ddof=1) / np.sqrt(k))
    middle = float(np.mean(means))
    return Interval(middle - half, middle + half)


def score_interval(values: FloatArray, scenes: Sequence[str], share: bool = True) -> tuple[float, float, float]:
    """The mean over scenes of values (n,), and the ends of its interval.

    A ``share`` lies in [0, 1], and so does its interval. Of yes or no of problems that are independent the
    interval is exact; of those that share scenes it has that one inside: scenes that all say no do not bound the
    share to 0.
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


def better(means: FloatArray) -> NDArray[np.bool_]:
    """Whether entry i is better than entry j (n, n): of means (n, k) of entries and scenes, higher is better.

    All that is said holds at once with ``statistics.COVERAGE``.
    """
    i, j = np.triu_indices(len(means), 1)
    differences = means[i] - means[j]
    told = _holm(_chances(differences))
    i_first = np.mean(differences, axis=1) > 0.0
    out = np.zeros((len(means), len(means)), dtype=np.bool_)
    out[i, j], out[j, i] = told & i_first, told & ~i_first
    return out


def _chances(differences: FloatArray) -> FloatArray:
    """Of such differences (pairs, k), or larger ones, between equal entries: two-sided p of the paired t test."""
    k = differences.shape[1]
    middle = np.abs(np.mean(differences, axis=1))
    if k < 2:
        return np.ones(len(middle))
    spread = np.maximum(np.std(differences, axis=1, ddof=1) / np.sqrt(k), _ROUNDING)
    return np.where(middle < _ROUNDING, 1.0, 2.0 * stdtr(k - 1, -middle / spread))


def _holm(chances: FloatArray) -> NDArray[np.bool_]:
    """Which of the hypotheses fall at a family-wise error of 1 - COVERAGE."""
    order = np.argsort(chances, kind="stable")
    limits = (1.0 - COVERAGE) / (len(chances) - np.arange(len(chances)))
    fails = np.flatnonzero(chances[order] > limits)
    fallen = np.zeros(len(chances), dtype=np.bool_)
    fallen[order[: fails[0] if len(fails) else len(order)]] = True
    return fallen


def ranks(scores: FloatArray, beats: NDArray[np.bool_], uses: Sequence[frozenset[str]]) -> list[Rank]:
    """The rank of each entry among those that use no more than it does.

    Args:
        scores: (n,) mean scores, higher is better.
        beats: of ``better``.
        uses: what each entry uses.
    """
    found = []
    for i in range(len(scores)):
        peers = np.array([j != i and uses[j] <= uses[i] for j in range(len(scores))], dtype=np.bool_)
        before = int(np.count_nonzero(peers & (scores > scores[i] + _ROUNDING)))
        low = int(np.count_nonzero(peers & beats[:, i]))
        high = int(np.count_nonzero(peers & ~beats[i]))
        found.append(Rank(1 + before, 1 + low, 1 + high))
    return found


def ties(beats: NDArray[np.bool_], i: int) -> list[Any]:
    """Entries that the data do not tell from entry i."""
    return [j for j in range(len(beats)) if j != i and not beats[i, j] and not beats[j, i]]
