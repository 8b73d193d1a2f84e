"""Ranks of methods: confidence intervals of mean scores over scenes, ties, and ranks with intervals.

Scores within a scene are not independent. The score of an entry is therefore the mean over scenes of the mean
score in each scene, with Student's confidence interval from the scene means. Each simulated problem is a scene of
its own. Two entries are compared by paired t tests on the same scenes; Holm's method (Scandinavian Journal of
Statistics 1979) corrects for the number of pairs. The numbers of significantly better and worse entries give
simultaneous confidence intervals of all ranks (Mogstad, Romano, Shaikh, Wilhelm, Review of Economic Studies 2024).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtr

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.deviations import Calibration, calibration, named_numbers
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, ORACLE, Score, Track
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import COVERAGE, format_interval, scene_means, score_interval, with_ends
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray

_ROUNDING = 1e-12
"""Smaller differences of mean scores count as zero: scores lie in [0, 1]."""


class Rank(NamedTuple):
    """A rank, counted from 1, and the ends of its confidence interval."""

    place: int
    low: int
    high: int


class Place(NamedTuple):
    """Rank of an entry among its peers, the entries whose inputs are a subset of its own."""

    rank: Rank | None = None
    """None if the entry is not ranked."""
    peers: int = 0
    """Number of peers, including the entry itself."""
    ties: tuple[str, ...] = ()
    """Names of the peers that do not differ significantly from it."""


def better(means: FloatArray) -> NDArray[np.bool_]:
    """Return a mask (n, n), whether entry i is significantly better than entry j, from scene means (n, k).

    Higher means are better. The family-wise error of all comparisons is at most 1 - ``statistics.COVERAGE``.
    """
    i, j = np.triu_indices(len(means), 1)
    differences = means[i] - means[j]
    decided = _holm(_chances(differences))
    i_first = np.mean(differences, axis=1) > 0.0
    out = np.zeros((len(means), len(means)), dtype=np.bool_)
    out[i, j], out[j, i] = decided & i_first, decided & ~i_first
    return out


def _chances(differences: FloatArray) -> FloatArray:
    """Return the two-sided p values (pairs,) of paired t tests, from differences (pairs, k)."""
    k = differences.shape[1]
    middle = np.abs(np.mean(differences, axis=1))
    if k < 2:
        return np.ones(len(middle))
    spread = np.maximum(np.std(differences, axis=1, ddof=1) / np.sqrt(k), _ROUNDING)
    return np.where(middle < _ROUNDING, 1.0, 2.0 * stdtr(k - 1, -middle / spread))


def _holm(chances: FloatArray) -> NDArray[np.bool_]:
    """Return the mask (n,) of rejected hypotheses, from p values (n,), at a family-wise error of 1 - COVERAGE."""
    order = np.argsort(chances, kind="stable")
    limits = (1.0 - COVERAGE) / (len(chances) - np.arange(len(chances)))
    fails = np.flatnonzero(chances[order] > limits)
    fallen = np.zeros(len(chances), dtype=np.bool_)
    fallen[order[: fails[0] if len(fails) else len(order)]] = True
    return fallen


def ranks(scores: FloatArray, beats: NDArray[np.bool_], uses: Sequence[frozenset[str]]) -> list[Rank]:
    """Return the rank of each entry among its peers, the entries whose inputs are a subset of its own.

    Args:
        scores: (n,) mean scores, higher is better.
        beats: (n, n) result of ``better``.
        uses: inputs of each entry.
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
    """Return the indices of the entries that do not differ significantly from entry i."""
    return [j for j in range(len(beats)) if j != i and not beats[i, j] and not beats[j, i]]


# Tables of splits


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """A row of a table: an entry with its rank and scores."""

    scored: Scored
    rank: Rank | None
    """Rank among the peers, the entries whose inputs are a subset of its own; None for oracles and entries in
    doubt."""
    peers: int
    """Number of peers, including the entry itself."""
    ties: tuple[str, ...]
    """Names of the peers that do not differ significantly from it."""
    means: dict[str, tuple[float, float, float]]
    """Mean over scenes and the ends of its confidence interval, for scores of the kinds share and mean."""
    medians: dict[str, float]
    """Median over problems, for scores of the kind median; NaN if the entry has no values."""
    calibration: Calibration | None
    """Calibration of its covariances; None without covariances."""
    log_rank: Rank | None
    """Rank by the log score among the peers with covariances; None if the entry has none or is not ranked."""
    log_peers: int
    """Number of peers with covariances."""
    parts: dict[str, tuple[float, float, float]]
    """Primary score with its interval for each value of ``Track.parting``; empty without a parting."""
    worst: dict[str, tuple[str, float]]
    """Problem with the largest error in each part, and that error; the key is "all" if there are no parts."""

    @property
    def track(self) -> Track:
        """The track of the entry."""
        return track_of_id(self.scored.header.protocol)

    @property
    def rank_words(self) -> str:
        """The rank as text, such as ``2 [1, 4] of 9``, ``alone``, ``oracle`` or ``in doubt``."""
        if self.rank is None:
            return "in doubt" if self.scored.doubt else "oracle"
        return _rank_words(self.rank, self.peers)

    @property
    def stated_words(self) -> dict[str, str]:
        """Table cells by column: coverage of the 95 % ellipsoids, log score, and rank by log score."""
        found = self.calibration
        words = {"in 95 %": format_interval(*found.covers[-1]) if found else "-"}
        if "log_score" in self.scored.scores:
            words["log score"] = format_interval(*found.log_score) if found and found.log_score else "-"
            words["log rank"] = _rank_words(self.log_rank, self.log_peers) if self.log_rank else "-"
        return words

    @property
    def assumes(self) -> str:
        """The motion model that the method assumes, from its header; empty for an oracle."""
        return "" if ORACLE in self.scored.header.uses else self.scored.header.motion_model

    @property
    def name(self) -> str:
        """Name in tables, where submitted entries are marked."""
        return self.scored.header.method + (" (handed in)" if self.scored.handed_in else "")

    @property
    def uses(self) -> str:
        """Names of its inputs, in the order of ``KNOWLEDGE``."""
        return " + ".join(name for name in KNOWLEDGE if name in self.scored.header.uses)


def _rank_words(rank: Rank, peers: int) -> str:
    return "alone" if peers == 1 else f"{rank.place} [{rank.low}, {rank.high}] of {peers}"


def standings(entries: Sequence[Scored], at_most: Collection[str] | None = None) -> list[Standing]:
    """Return the rows of a table, sorted by inputs (fewest first) and then by score; unranked entries are last.

    Args:
        entries: entries of one split.
        at_most: names of inputs; entries that use others are left out.

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
    # The ranking by log score has only entries with covariances.
    stating = [each for each in ranked if "log_score" in each.scores and each.scores["nees"].notna().any()]
    scenes, primary = list(problems["scene"]), track_of_id(kept[0].header.protocol).primary
    places = _ranked(ranked, primary.key, primary.sign, scenes)
    log_places = _ranked(stating, "log_score", 1.0, scenes)
    lines = [_standing(each, places.get(each, Place()), log_places.get(each, Place())) for each in kept]
    return sorted(lines, key=_order)


def _ranked(entries: Sequence[Scored], column: str, sign: float, scenes: Sequence[str]) -> dict[Scored, Place]:
    """Rank entries by a column of their scores; ``sign`` is -1 if lower is better."""
    if not entries:
        return {}
    uses = [frozenset(each.header.uses) for each in entries]
    means = scene_means(sign * np.stack([each.scores[column].to_numpy() for each in entries]), scenes)
    beats, names = better(means), [each.header.method for each in entries]
    found = dict[Scored, Place]()
    for i, rank in enumerate(ranks(means.mean(axis=1), beats, uses)):
        peers = [j for j in range(len(entries)) if uses[j] <= uses[i]]
        found[entries[i]] = Place(rank, len(peers), tuple(names[j] for j in ties(beats, i) if j in peers))
    return found


def _order(standing: Standing) -> tuple[bool, int, str, float, str]:
    header = standing.scored.header
    primary = standing.track.primary
    score = primary.sign * standing.means[primary.key][0]
    return standing.rank is None, len(set(header.uses)), standing.uses, -score, header.method


def _standing(scored: Scored, place: Place, log_place: Place) -> Standing:
    scores, track = scored.scores, track_of_id(scored.header.protocol)
    parts = [(str(name), part) for name, part in scores.groupby(track.parting)] if track.parting else []
    return Standing(
        scored=scored,
        rank=place.rank,
        peers=place.peers,
        ties=place.ties,
        means={score.key: _mean(scores, score) for score in track.scores if score.kind != "median"},
        medians={name: _median(scores[name].to_numpy()) for name in track.of_kind("median")},
        calibration=calibration(scores, track.unknowns),
        log_rank=log_place.rank,
        log_peers=log_place.peers,
        parts={name: _mean(part, track.primary) for name, part in parts},
        worst={name: _worst(part, track.error) for name, part in (parts if track.parting else [("all", scores)])},
    )


def _mean(scores: pd.DataFrame, score: Score) -> tuple[float, float, float]:
    """Return the mean of a score over scenes and the ends of its confidence interval."""
    return score_interval(scores[score.key].to_numpy(), list(scores["scene"]), score.kind == "share")


def _worst(scores: pd.DataFrame, column: str) -> tuple[str, float]:
    """Return the problem with the largest error, and that error; NaN is the smallest."""
    errors = scores[column].to_numpy(dtype=np.float64)
    at = int(np.argmax(np.where(np.isnan(errors), -np.inf, errors)))
    return str(scores["problem"].iloc[at]), float(errors[at])


def _median(values: FloatArray) -> float:
    """Return the median of all values except NaN; infinite values count."""
    there = values[~np.isnan(values)]
    return float(np.median(there)) if there.size else float("nan")


def table(lines: Sequence[Standing], worst: bool = True) -> pd.DataFrame:
    """Return a table as numbers, for its CSV file; ``worst`` adds the worst problems, unless a split is secret."""
    rows, unranked = list[dict[str, object]](), (None, None, None)
    for line in lines:
        header = line.scored.header
        row: dict[str, object] = {"method": header.method, "uses": line.uses, "peers": line.peers or None}
        row |= {"handed_in": line.scored.handed_in, "doubt": line.scored.doubt or None}
        row |= with_ends("rank", *(line.rank or unranked))
        row |= {"assumes": line.assumes or None} if line.parts else {}
        row |= _ends(line.means) | line.medians
        row |= _ends({f"{line.track.primary.key}_{name}": triple for name, triple in line.parts.items()})
        for name, (problem, error) in line.worst.items() if worst else ():
            row |= {f"worst_{name}": error, f"worst_{name}_problem": problem}
        if "nees" in line.scored.scores:
            row |= _ends(named_numbers(line.calibration, "log_score" in line.scored.scores))
        row |= with_ends("log_rank", *(line.log_rank or unranked)) if "log_score" in line.scored.scores else {}
        rows.append(row | {"ties": " ".join(line.ties)})
    found = pd.DataFrame(rows)
    integers = [name for name in map(str, found.columns) if name == "peers" or "rank" in name]
    return found.astype(dict.fromkeys(integers, "Int64"))


def _ends(triples: Mapping[str, tuple[float, float, float]]) -> dict[str, object]:
    return {key: number for name, triple in triples.items() for key, number in with_ends(name, *triple).items()}
