"""Problems of a split: all errors of all entries in one table, and a page for each rendered sequence."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rsbench.benchmark.leaderboard.standings import Standing
from rsbench.report.board_figures import short
from rsbench.report.board_pictures import Album
from rsbench.report.board_splits import Board, fact_title

_SHADES = 5


def matrix_context(each: Board, album: Album) -> dict[str, Any]:
    """Of the template board_problems.html.j2: a row for each problem, a column for each entry."""
    errors = np.stack([line.scored.scores[each.track.error].to_numpy(dtype=np.float64) for line in each.lines])
    failed = np.stack([line.scored.scores["failure"].to_numpy() > 0.0 for line in each.lines])
    names = [str(name) for name in each.facts.columns]
    shades = _shades(errors)
    rows = [
        {
            "name": problem,
            "page": each.page_of(problem) if each.pages else "",
            "thumb": album.thumb(problem),
            "facts": [_fact(each, name, problem) for name in names],
            "cells": [
                {"value": repr(float(x)), "text": "failed" if lost else short(x), "shade": int(shade)}
                for x, lost, shade in zip(errors[:, k], failed[:, k], shades[:, k], strict=True)
            ],
        }
        for k, problem in enumerate(each.problems)
    ]
    entries = [{"method": line.scored.header.method, "oracle": line.rank is None} for line in each.lines]
    return {"split": each.named, "facts": [_title(each, name) for name in names], "entries": entries, "rows": rows}


def _shades(errors: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """0 for the smallest errors to ``_SHADES`` - 1 for the largest: as many of each."""
    inner = np.quantile(errors, np.linspace(0.0, 1.0, _SHADES + 1)[1:-1], method="inverted_cdf")
    return np.searchsorted(inner, errors, side="left")


def _title(each: Board, name: str) -> dict[str, Any]:
    return {"name": name, "title": fact_title(name), "text": each.facts[name].dtype == object}


def _fact(each: Board, name: str, problem: str) -> dict[str, str]:
    value = each.facts[name].get(problem, "")
    if isinstance(value, str):
        return {"value": value, "text": value}
    return {"value": repr(float(value)), "text": f"{value:.3g}"}


def problem_contexts(each: Board, album: Album) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names of rendered sequences, and for each the context of the template board_problem.html.j2."""
    if not each.pages:
        return
    for k, problem in enumerate(each.problems):
        before, after = each.problems[k - 1], each.problems[(k + 1) % len(each.problems)]
        yield (
            problem,
            {
                "split": each.named,
                "name": problem,
                "before": before,
                "after": after,
                "facts": [(fact_title(str(n)), _fact(each, str(n), problem)["text"]) for n in each.facts.columns],
                "columns": [{"title": score.title, "hint": score.hint} for score in each.track.scores],
                "rows": [_row(each, line, k) for line in each.lines],
                "place": f"../pictures/{problem}",
                "pictures": album.pictures(problem),
                "compared": album.compared(problem),
                "errors": album.errors,
            },
        )


def _row(each: Board, line: Standing, k: int) -> dict[str, Any]:
    scores = line.scored.scores.iloc[k]
    cells = [
        "–" if np.isnan(value) else f"{value:.3g}"
        for value in (float(scores[score.key]) for score in each.track.scores)
    ]
    method = line.scored.header.method
    return {"method": method, "page": f"../{method}.html", "oracle": line.rank is None, "cells": cells}
