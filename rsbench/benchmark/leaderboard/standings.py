"""The table of a split: scores with intervals, ranks among those that use no more, ties; oracles have no rank."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.protocols import AUC_DEG, KNOWLEDGE, ORACLE, PRIMARY
from rsbench.benchmark.leaderboard.ranking import Rank, better, mean_interval, ranks, scene_means, ties
from rsbench.benchmark.statistics import share_interval
from rsbench.core.so3 import FloatArray
from rsbench.errors import RsbenchError

SUCCESS_DEG = (1.0, 5.0)
"""A success errs by less in rotation and direction, as in the sweeps of simulated points."""
MEANS = (*(f"auc_{limit}" for limit in AUC_DEG), "within", "flip", "failure")
"""Columns that are means over scenes, with an interval each."""
MEDIANS = ("e_R_deg", "e_T_deg", "e_row_deg", "e_s", "metres", "seconds")
"""Columns that are medians over problems; nothing where an entry gives none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Standing:
    """An entry's line."""

    scored: Scored
    rank: Rank | None
    """Among those that use no more; None of an oracle."""
    peers: int
    """How many those are, itself included."""
    ties: tuple[str, ...]
    """Of those, the ones that the data do not tell from it."""
    means: dict[str, tuple[float, float, float]]
    """Of ``MEANS``: the mean, and the ends of its interval."""
    medians: dict[str, float]
    """Of ``MEDIANS``."""

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
    ranked = [each for each in kept if ORACLE not in each.header.uses]
    scenes = list(problems["scene"])
    uses = [frozenset(each.header.uses) for each in ranked]
    found: list[Standing] = []
    if ranked:
        means = scene_means(np.stack([each.scores[PRIMARY].to_numpy() for each in ranked]), scenes)
        beats = better(means)
        for i, rank in enumerate(ranks(means.mean(axis=1), beats, uses)):
            peers = [j for j in range(len(ranked)) if uses[j] <= uses[i]]
            tied = tuple(ranked[j].header.method for j in ties(beats, i) if j in peers)
            found.append(_standing(ranked[i], scenes, rank, len(peers), tied))
    found.sort(key=_order)
    oracles = [_standing(each, scenes, None, 0, ()) for each in kept if ORACLE in each.header.uses]
    return found + sorted(oracles, key=_order)


def _order(standing: Standing) -> tuple[int, str, float, str]:
    header = standing.scored.header
    return len(set(header.uses)), standing.uses, -standing.means[PRIMARY][0], header.method


def _standing(
    scored: Scored, scenes: Sequence[str], rank: Rank | None, peers: int, tied: tuple[str, ...]
) -> Standing:
    scores = scored.scores
    within = (scores["e_R_deg"] < SUCCESS_DEG[0]) & ~(scores["e_T_deg"] >= SUCCESS_DEG[1])
    columns = {name: scores[name].to_numpy() for name in MEANS if name != "within"}
    columns["within"] = within.to_numpy(dtype=np.float64)
    return Standing(
        scored=scored,
        rank=rank,
        peers=peers,
        ties=tied,
        means={name: _interval(columns[name], scenes) for name in MEANS},
        medians={name: _median(scores[name].to_numpy()) for name in MEDIANS},
    )


def _interval(values: FloatArray, scenes: Sequence[str]) -> tuple[float, float, float]:
    """Nothing lies outside [0, 1]; of yes or no of problems that are independent the interval is exact."""
    means = scene_means(values, scenes)
    if len(means) == len(values) and np.all((values == 0.0) | (values == 1.0)):
        return float(np.mean(means)), *share_interval(int(np.sum(values)), len(values))
    low, high = mean_interval(means)
    return float(np.mean(means)), max(low, 0.0), min(high, 1.0)


def _median(values: FloatArray) -> float:
    """Of the values that there are, infinite ones too."""
    there = values[~np.isnan(values)]
    return float(np.quantile(there, 0.5, method="inverted_cdf")) if there.size else float("nan")


def table(lines: Sequence[Standing]) -> pd.DataFrame:
    """The numbers of a table, as its CSV file holds them."""
    rows = []
    for line in lines:
        header = line.scored.header
        row: dict[str, object] = {"method": header.method, "uses": line.uses, "peers": line.peers or None}
        row |= dict(zip(("rank", "rank_low", "rank_high"), line.rank or (None, None, None), strict=True))
        for name, (value, low, high) in line.means.items():
            row |= {name: value, f"{name}_low": low, f"{name}_high": high}
        rows.append(row | line.medians | {"ties": " ".join(line.ties)})
    integers = ["peers", "rank", "rank_low", "rank_high"]
    return pd.DataFrame(rows).astype(dict.fromkeys(integers, "Int64")) if rows else pd.DataFrame()
