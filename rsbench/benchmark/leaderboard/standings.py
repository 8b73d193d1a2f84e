"""Ranks of methods: confidence intervals of mean scores over scenes, ties, and ranks with intervals.

Scores within a scene are not independent. The score of an entry is therefore the mean over scenes of its mean over
the problems of a scene, and its interval is Student's, from the means of the scenes. Each simulated problem is a
scene of its own. Two entries are compared by their differences on the same scenes; Holm's method (Scandinavian
Journal of Statistics 1979) corrects for all pairs. The rank of an entry lies, with the same confidence for all
entries at once, between the number of better entries and that of worse ones (Mogstad, Romano, Shaikh, Wilhelm,
Review of Economic Studies 2024).
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
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, ORACLE, Track
from rsbench.benchmark.leaderboard.tracks import track_of_id
from rsbench.benchmark.statistics import COVERAGE, format_interval, scene_means, score_interval, with_ends
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray

_ROUNDING = 1e-12
"""Smaller differences of mean scores count as zero: scores lie in [0, 1]."""


class Rank(NamedTuple):
    """Rank, counted from 1, and the range of ranks that the data do not exclude."""

    place: int
    low: int
    high: int


class Place(NamedTuple):
    """Rank of an entry among those that use no more inputs; None if it is not ranked."""

    rank: Rank | None = None
    peers: int = 0
    """Number of these entries, itself included."""
    ties: tuple[str, ...] = ()
    """Those of them that the data do not distinguish from it."""


def better(means: FloatArray) -> NDArray[np.bool_]:
    """(n, n) whether entry i is better than entry j, from means (n, k) of entries in scenes; higher is better.

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
    """(n,) whether a hypothesis with the p value (n,) is rejected at a family-wise error of 1 - COVERAGE."""
    order = np.argsort(chances, kind="stable")
    limits = (1.0 - COVERAGE) / (len(chances) - np.arange(len(chances)))
    fails = np.flatnonzero(chances[order] > limits)
    fallen = np.zeros(len(chances), dtype=np.bool_)
    fallen[order[: fails[0] if len(fails) else len(order)]] = True
    return fallen


def ranks(scores: FloatArray, beats: NDArray[np.bool_], uses: Sequence[frozenset[str]]) -> list[Rank]:
    """Rank of each entry among those that use no more inputs.

    Args:
        scores: (n,) mean scores, higher is better.
        beats: result of ``better``.
        uses: the inputs of each entry.
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


# Tables of splits


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """A row of a table: an entry with its rank and scores."""

    scored: Scored
    rank: Rank | None
    """Rank among the entries that use no more inputs; None for oracles and entries in doubt."""
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
    log_rank: Rank | None
    """Rank by the log score among the entries that have one and use no more inputs; None if it has no log
    score."""
    log_peers: int
    """Number of these entries."""
    parts: dict[str, tuple[float, float, float]]
    """The primary score in each part of the problems, by the name of the part."""
    worst: dict[str, tuple[str, float]]
    """The problem with the largest error in each part, and that error; the key is "all" if there are no parts."""

    @property
    def track(self) -> Track:
        """The track of its table."""
        return track_of_id(self.scored.header.protocol)

    @property
    def rank_words(self) -> str:
        """Such as ``2 [1, 4] of 9``, ``alone``, ``oracle`` or ``in doubt``."""
        if self.rank is None:
            return "in doubt" if self.scored.doubt else "oracle"
        return _rank_words(self.rank, self.peers)

    @property
    def stated_words(self) -> dict[str, str]:
        """Text by column: coverage of its 95 % ellipsoids, its log score, and its rank by that."""
        found = self.calibration
        words = {"in 95 %": format_interval(*found.covers[-1]) if found else "-"}
        if "log_score" in self.scored.scores:
            words["log score"] = format_interval(*found.log_score) if found and found.log_score else "-"
            words["log rank"] = _rank_words(self.log_rank, self.log_peers) if self.log_rank else "-"
        return words

    @property
    def assumes(self) -> str:
        """The motion model that the method states; empty for an oracle."""
        return "" if ORACLE in self.scored.header.uses else self.scored.header.motion_model

    @property
    def name(self) -> str:
        """Name in tables, where submitted entries are marked."""
        return self.scored.header.method + (" (handed in)" if self.scored.handed_in else "")

    @property
    def uses(self) -> str:
        """Its inputs, in the order of ``KNOWLEDGE``."""
        return " + ".join(name for name in KNOWLEDGE if name in self.scored.header.uses)


def _rank_words(rank: Rank, peers: int) -> str:
    return "alone" if peers == 1 else f"{rank.place} [{rank.low}, {rank.high}] of {peers}"


def standings(entries: Sequence[Scored], at_most: Collection[str] | None = None) -> list[Standing]:
    """Rows of a table, sorted by the inputs (fewest first) and then by the score; oracles are last.

    Args:
        entries: of one split.
        at_most: leave out entries that use other inputs.

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
    # Entries that state any covariance have a log score.
    stating = [each for each in ranked if "log_score" in each.scores and each.scores["nees"].notna().any()]
    scenes, primary = list(problems["scene"]), track_of_id(kept[0].header.protocol).primary
    places = _ranked(ranked, primary.key, primary.sign, scenes)
    log_places = _ranked(stating, "log_score", 1.0, scenes)
    lines = [_standing(each, scenes, places.get(each, Place()), log_places.get(each, Place())) for each in kept]
    return sorted(lines, key=_order)


def _ranked(entries: Sequence[Scored], column: str, sign: float, scenes: Sequence[str]) -> dict[Scored, Place]:
    """Ranks of entries by a column."""
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


def _standing(scored: Scored, scenes: Sequence[str], place: Place, log_place: Place) -> Standing:
    scores, track = scored.scores, track_of_id(scored.header.protocol)
    return Standing(
        scored=scored,
        rank=place.rank,
        peers=place.peers,
        ties=place.ties,
        means={
            score.key: score_interval(scores[score.key].to_numpy(), scenes, score.kind == "share")
            for score in track.scores
            if score.kind != "median"
        },
        medians={name: _median(scores[name].to_numpy()) for name in track.of_kind("median")},
        calibration=calibration(scores, track.unknowns),
        log_rank=log_place.rank,
        log_peers=log_place.peers,
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
    """The numbers of a table, as in its CSV file; for a secret split without the ``worst`` problems."""
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
