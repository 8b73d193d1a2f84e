"""The table of a split: scores with intervals, ranks among those that use no more, ties; oracles have no rank."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.calibration import Calibration, calibration, named_numbers
from rsbench.benchmark.leaderboard.ranking import Rank, better, ranks, scene_means, score_interval, ties
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, ORACLE, Track
from rsbench.benchmark.leaderboard.track_list import track_of_id
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """An entry's line."""

    scored: Scored
    rank: Rank | None
    """Among those that use no more; None of an oracle, and of an entry that is in doubt."""
    peers: int
    """How many those are, itself included."""
    ties: tuple[str, ...]
    """Of those, the ones that the data do not tell from it."""
    means: dict[str, tuple[float, float, float]]
    """Of the shares and means of its protocol: the mean over scenes, and the ends of its interval."""
    medians: dict[str, float]
    """Of the other scores: over problems; NaN where the entry gives none."""
    calibration: Calibration | None
    """Of the covariances that it states."""
    parts: dict[str, tuple[float, float, float]]
    """Of the primary score in the parts of the problems that its track tells apart, by their names."""
    worst: dict[str, tuple[str, float]]
    """The problem of each part with the largest error, and that error; "all" where there are no parts."""

    @property
    def track(self) -> Track:
        """Of the table that it stands in."""
        return track_of_id(self.scored.header.protocol)

    @property
    def rank_words(self) -> str:
        """Such as ``2 [1, 4] of 9``; whom nobody is compared with has no place."""
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
        """As tables show it: they tell entries that were handed in from those that the board ran itself."""
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
    """Of the values that there are, infinite ones too."""
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
