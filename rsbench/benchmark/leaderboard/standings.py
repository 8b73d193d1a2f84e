"""Ranks of methods: confidence intervals of mean scores over scenes, ties, and ranks with intervals.

Scores of one scene are not independent, so scenes count, each alike: the score of an entry is the mean over scenes
of its mean over the problems there, and its interval is Student's, of the scenes' means. For simulated problems
each is a scene of its own. Two entries are compared by their differences on the same scenes, all pairs corrected
by Holm's method (Scandinavian Journal of Statistics 1979); an entry's rank lies, with the same confidence for all
entries at once, between the number of those that are better and of those that are worse (Mogstad, Romano, Shaikh,
Wilhelm, Review of Economic Studies 2024).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import gammaincinv, stdtr, stdtrit  # Student's distribution and its inverse

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, ORACLE, Track
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import COVERAGE, Interval, median_interval, share_interval, typical_interval
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray

_ROUNDING = 1e-12
"""Smaller differences of mean scores count as zero: scores lie in [0, 1]."""


class Rank(NamedTuple):
    """A place, counted from 1, and the range of places that the data do not exclude."""

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

    All comparisons hold at once with ``statistics.COVERAGE``.
    """
    i, j = np.triu_indices(len(means), 1)
    differences = means[i] - means[j]
    decided = _holm(_chances(differences))
    i_first = np.mean(differences, axis=1) > 0.0
    out = np.zeros((len(means), len(means)), dtype=np.bool_)
    out[i, j], out[j, i] = decided & i_first, decided & ~i_first
    return out


def _chances(differences: FloatArray) -> FloatArray:
    """Two-sided p values (pairs,) of the paired t test of differences (pairs, k)."""
    k = differences.shape[1]
    middle = np.abs(np.mean(differences, axis=1))
    if k < 2:
        return np.ones(len(middle))
    spread = np.maximum(np.std(differences, axis=1, ddof=1) / np.sqrt(k), _ROUNDING)
    return np.where(middle < _ROUNDING, 1.0, 2.0 * stdtr(k - 1, -middle / spread))


def _holm(chances: FloatArray) -> NDArray[np.bool_]:
    """Which hypotheses are rejected at a family-wise error of 1 - COVERAGE, by p value (n,)."""
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
    """Entries that the data do not distinguish from entry i."""
    return [j for j in range(len(beats)) if j != i and not beats[i, j] and not beats[j, i]]


# Calibration of the covariances that methods state (NEES): shown beside scores, and never ranked.
#
# The squared error by the stated covariance (NEES) is chi-squared where that is right, with six degrees of freedom
# for a motion and one for a readout ratio (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking
# and Navigation, 2001, section 5.4): the ellipsoid of a level then holds the truth in that share of problems. A
# single wild error can dominate a mean, so the interval is that of the median.

LEVELS = (0.5, 0.9, 0.95)
_SEED = 0
Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """How well stated covariances fit the errors; each triple is a value with the ends of its interval."""

    stated: int
    """Number of answers with a covariance."""
    spread: Triple
    """Median of NEES over that of a right covariance: 1 where it is right, 4 where errors are twice as large."""
    covers: tuple[Triple, ...]
    """For each of ``LEVELS``, the share of truths within the ellipsoid of that level."""
    mean: float
    """NEES over its degrees of freedom, without an interval."""


def calibration(scores: pd.DataFrame, unknowns: int) -> Calibration | None:
    """Calibration of an entry's scores, whose answers have ``unknowns`` numbers; None without covariances."""
    if "nees" not in scores:
        return None
    stated = scores[scores["nees"].notna()]
    if stated.empty:
        return None
    nees, scenes = stated["nees"].to_numpy(dtype=np.float64), list(stated["scene"])
    ratio = nees / _chi_squared(0.5, unknowns)
    alone = len(set(scenes)) == len(scenes)
    low, high = median_interval(ratio) if alone else typical_interval(ratio, _SEED, scenes)
    return Calibration(
        stated=len(stated),
        spread=(float(np.median(ratio)), low, high),
        covers=tuple(
            score_interval((nees <= _chi_squared(level, unknowns)).astype(np.float64), scenes) for level in LEVELS
        ),
        mean=float(np.mean(nees)) / unknowns,
    )


def _chi_squared(level: float, unknowns: int) -> float:
    """Quantile ``level`` of the chi-squared distribution with ``unknowns`` degrees of freedom."""
    return 2.0 * float(gammaincinv(0.5 * unknowns, level))


def named_numbers(found: Calibration | None) -> dict[str, Triple]:
    """The triples by the names of their columns; NaN where nothing was stated."""
    nothing = (np.nan, np.nan, np.nan)
    covers = found.covers if found else (nothing,) * len(LEVELS)
    return {
        "nees_ratio": found.spread if found else nothing,
        **{f"covers_{100.0 * level:.0f}": triple for level, triple in zip(LEVELS, covers, strict=True)},
    }


# Tables of splits


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """An entry's line."""

    scored: Scored
    rank: Rank | None
    """Rank among the entries that use no more; None for oracles and entries in doubt."""
    peers: int
    """Number of these entries, itself included."""
    ties: tuple[str, ...]
    """Those of them that the data do not distinguish from it."""
    means: dict[str, tuple[float, float, float]]
    """For each share or mean of its protocol, the mean over scenes and the ends of its interval."""
    medians: dict[str, float]
    """For each other score, the median over problems; NaN where the entry has none."""
    calibration: Calibration | None
    """Calibration of the covariances that it states."""
    parts: dict[str, tuple[float, float, float]]
    """The primary score in each part into which its track divides the problems, by name."""
    worst: dict[str, tuple[str, float]]
    """The problem of each part with the largest error, and that error; "all" where there are no parts."""

    @property
    def track(self) -> Track:
        """The track of its table."""
        return track_of_id(self.scored.header.protocol)

    @property
    def rank_words(self) -> str:
        """Such as ``2 [1, 4] of 9``, ``alone``, ``oracle`` or ``in doubt``."""
        if self.rank is None:
            return "in doubt" if self.scored.doubt else "oracle"
        if self.peers == 1:
            return "alone"
        return f"{self.rank.place} [{self.rank.low}, {self.rank.high}] of {self.peers}"

    @property
    def assumes(self) -> str:
        """The motion model that the method names; nothing of an oracle."""
        return "" if ORACLE in self.scored.header.uses else self.scored.header.motion_model

    @property
    def name(self) -> str:
        """As tables show it: submitted entries are marked."""
        return self.scored.header.method + (" (handed in)" if self.scored.handed_in else "")

    @property
    def uses(self) -> str:
        """In the order of ``KNOWLEDGE``."""
        return " + ".join(name for name in KNOWLEDGE if name in self.scored.header.uses)


def standings(entries: Sequence[Scored], at_most: Collection[str] | None = None) -> list[Standing]:
    """Lines of a table: those that use least first, of equal ones the better first, oracles last.

    Args:
        entries: of one split.
        at_most: leave out entries that use something else.

    Raises:
        RsbenchError: the entries are not scored on the same problems.
    """
    kept = [each for each in entries if at_most is None or set(each.header.uses) <= set(at_most)]
    if not kept:
        return []
    problems = kept[0].scores[["problem", "scene"]]
    for each in kept:
        if not each.scores[["problem", "scene"]].equals(problems):
            raise RsbenchError(
                f"{each.folder}: is scored on other problems than {kept[0].folder.name}; rescore the board"
            )
    ranked = [each for each in kept if ORACLE not in each.header.uses and not each.doubt]
    scenes = list(problems["scene"])
    uses = [frozenset(each.header.uses) for each in ranked]
    found: list[Standing] = []
    if ranked:
        primary = track_of_id(ranked[0].header.protocol).primary
        values = np.stack([each.scores[primary.key].to_numpy() for each in ranked])
        means = scene_means(primary.sign * values, scenes)
        beats = better(means)
        for i, rank in enumerate(ranks(means.mean(axis=1), beats, uses)):
            peers = [j for j in range(len(ranked)) if uses[j] <= uses[i]]
            tied = tuple(ranked[j].header.method for j in ties(beats, i) if j in peers)
            found.append(_standing(ranked[i], scenes, rank, len(peers), tied))
    found.sort(key=_order)
    oracles = [_standing(each, scenes, None, 0, ()) for each in kept if each not in ranked]
    return found + sorted(oracles, key=_order)


def _order(standing: Standing) -> tuple[int, str, float, str]:
    header = standing.scored.header
    primary = standing.track.primary
    score = primary.sign * standing.means[primary.key][0]
    return len(set(header.uses)), standing.uses, -score, header.method


def _standing(
    scored: Scored, scenes: Sequence[str], rank: Rank | None, peers: int, tied: tuple[str, ...]
) -> Standing:
    scores, track = scored.scores, track_of_id(scored.header.protocol)
    return Standing(
        scored=scored,
        rank=rank,
        peers=peers,
        ties=tied,
        means={
            score.key: score_interval(scores[score.key].to_numpy(), scenes, score.kind == "share")
            for score in track.scores
            if score.kind != "median"
        },
        medians={name: _median(scores[name].to_numpy()) for name in track.of_kind("median")},
        calibration=calibration(scores, track.unknowns),
        parts={} if not track.parting else _parts(scores, track),
        worst=_worst(scores, track),
    )


def _worst(scores: pd.DataFrame, track: Track) -> dict[str, tuple[str, float]]:
    parts = scores.groupby(track.parting) if track.parting else [("all", scores)]
    found: dict[str, tuple[str, float]] = {}
    for name, part in parts:
        errors = part[track.error].to_numpy(dtype=np.float64)
        at = int(np.argmax(np.where(np.isnan(errors), -np.inf, errors)))
        found[str(name)] = str(part["problem"].iloc[at]), float(errors[at])
    return found


def _parts(scores: pd.DataFrame, track: Track) -> dict[str, tuple[float, float, float]]:
    return {
        str(name): score_interval(
            part[track.primary.key].to_numpy(), list(part["scene"]), track.primary.kind == "share"
        )
        for name, part in scores.groupby(track.parting)
    }


def _median(values: FloatArray) -> float:
    """Median of the values that are not NaN, infinite ones included."""
    there = values[~np.isnan(values)]
    return float(np.median(there)) if there.size else float("nan")


def table(lines: Sequence[Standing], worst: bool = True) -> pd.DataFrame:
    """The numbers of a table, as its CSV file holds them; of a secret split without the ``worst`` problems."""
    rows = []
    for line in lines:
        header = line.scored.header
        row: dict[str, object] = {"method": header.method, "uses": line.uses, "peers": line.peers or None}
        row |= {"handed_in": line.scored.handed_in, "doubt": line.scored.doubt or None}
        row |= dict(zip(("rank", "rank_low", "rank_high"), line.rank or (None, None, None), strict=True))
        row |= {"assumes": line.assumes or None} if line.parts else {}
        row |= _ends(line.means) | line.medians
        row |= _ends({f"{line.track.primary.key}_{name}": triple for name, triple in line.parts.items()})
        for name, (problem, error) in line.worst.items() if worst else ():
            row |= {f"worst_{name}": error, f"worst_{name}_problem": problem}
        if "nees" in line.scored.scores:
            row |= _ends(named_numbers(line.calibration))
        rows.append(row | {"ties": " ".join(line.ties)})
    integers = ["peers", "rank", "rank_low", "rank_high"]
    return pd.DataFrame(rows).astype(dict.fromkeys(integers, "Int64")) if rows else pd.DataFrame()


def _ends(triples: Mapping[str, tuple[float, float, float]]) -> dict[str, object]:
    return {
        f"{name}{end}": number
        for name, triple in triples.items()
        for end, number in zip(("", "_low", "_high"), triple, strict=True)
    }
