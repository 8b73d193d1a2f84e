"""The page of an entry: what it says of itself, its scores, where it errs, and whether it knows how much."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.standings import LEVELS, Standing, score_interval
from rsbench.benchmark.statistics import in_words
from rsbench.report.board_figures import reliability
from rsbench.report.board_pictures import Album
from rsbench.report.board_splits import Board, fact_title
from rsbench.report.board_tables import BRIEF, brief_medians

_ABOUT = ("version", "description", "authors", "paper", "code", "licence", "hardware", "tuned_on", "motion_model")
_WORST = 10


def entry_context(each: Board, line: Standing, album: Album) -> dict[str, Any]:
    """Of the template board_entry.html.j2."""
    header = line.scored.header
    said = asdict(header)
    compared = [line, *_best_peer(each, line), *_oracles(each, line)]
    return {
        "header": header,
        "split": each.named,
        "about": [
            ("uses", line.uses),
            ("answers", "handed in as a file" if line.scored.handed_in else "made by this board"),
            *([("in_doubt", line.scored.doubt)] if line.scored.doubt else []),
            *((name, said[name]) for name in _ABOUT if said[name]),
        ],
        "scores": _scores(line),
        "ties": ", ".join(line.ties),
        "tables": [_by(each, line, name, kinds) for name, kinds in each.known() if _words(kinds)],
        "worst": None if each.secret else _worst(each, line, album),
        "figures_found": each.figures(compared),
        "figures_within": each.figures_within(compared),
        "calibration": _calibration(line),
    }


def _words(kinds: pd.Series) -> bool:
    return not pd.api.types.is_numeric_dtype(kinds)


def _best_peer(each: Board, line: Standing) -> list[Standing]:
    """The best of the other entries that use no more, which the figures show beside it."""
    uses = set(line.scored.header.uses)
    peers = [peer for peer in each.by_score if peer is not line and set(peer.scored.header.uses) <= uses]
    return peers[:1] if line.rank else []


def _oracles(each: Board, line: Standing) -> list[Standing]:
    return [other for other in each.lines if other.rank is None and other is not line]


def _scores(line: Standing) -> list[dict[str, str]]:
    found = [{"title": "rank", "text": line.rank_words, "hint": "among those that use no more"}]
    for score in line.track.scores:
        if score.kind != "median":
            text = in_words(*line.means[score.key])
        else:
            value = line.medians[score.key]
            text = "–" if np.isnan(value) else f"{value:.3g}"
        found.append({"title": score.title, "text": text, "hint": score.hint})
    return found


def _by(each: Board, line: Standing, name: str, kinds: pd.Series) -> dict[str, Any]:
    scores, track, rows = line.scored.scores, each.track, list[list[object]]()
    for kind, part in scores.groupby(kinds.astype(str).to_numpy()):
        primary = part[track.primary.key].to_numpy()
        value, low, high = score_interval(primary, list(part["scene"]), track.primary.kind == "share")
        # One scene bounds nothing: an interval of it would only round its value away.
        share = f"{value:.3g}" if part["scene"].nunique() == 1 else in_words(value, low, high)
        medians = (part[key].median() for key in track.of_kind("median")[:BRIEF])
        rows.append([str(kind), len(part), share, *(f"{x:.3g}" for x in medians), int(part["failure"].sum())])
    return {
        "title": f"By {fact_title(name)}",
        "columns": [fact_title(name), "problems", track.primary.title, *brief_medians(track), "failed"],
        "rows": rows,
    }


def _worst(each: Board, line: Standing, album: Album) -> dict[str, Any]:
    track = each.track
    worst = line.scored.scores.sort_values([track.error, "problem"], ascending=[False, True]).head(_WORST)
    names = [str(name) for name in each.facts.columns]
    rows = []
    for case in worst.to_dict("records"):
        numbers = [f"{case[key]:.3g}" for key in track.of_kind("median")[:BRIEF]]
        known = [each.facts[name].get(case["problem"], "") for name in names]
        words = [f"{value:.3g}" if isinstance(value, float) else str(value) for value in known]
        problem = str(case["problem"])
        thumb = album.thumb(problem)
        rows.append(
            {
                "name": problem,
                "page": f"../{each.page_of(problem)}",
                "thumb": thumb and f"../{thumb}",
                "cells": [*numbers, *words],
            }
        )
    return {"columns": [*brief_medians(track), *map(fact_title, names)], "rows": rows}


def _calibration(line: Standing) -> dict[str, Any] | None:
    found = line.calibration
    if found is None:
        return None
    rows = [
        {"level": f"{100.0 * level:.0f} %", "text": in_words(*(100.0 * x for x in triple)) + " %"}
        for level, triple in zip(LEVELS, found.covers, strict=True)
    ]
    return {
        "stated": found.stated,
        "of": len(line.scored.scores),
        "spread": in_words(*found.spread),
        "mean": f"{found.mean:.3g}",
        "unknowns": line.track.unknowns,
        "rows": rows,
        "figure": reliability(found.covers),
    }
