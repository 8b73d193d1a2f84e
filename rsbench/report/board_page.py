"""The leaderboard as a static site: an index, pages of entries and problems, and each table as files.

Everything comes from a board's stored scores. Nothing is fetched, and what entries say of themselves is escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from rsbench.benchmark.leaderboard.board import splits_of
from rsbench.benchmark.leaderboard.standings import LEVELS, Standing, named_numbers
from rsbench.benchmark.leaderboard.track import KNOWLEDGE, Score
from rsbench.benchmark.statistics import in_words
from rsbench.report.board_entry import entry_context
from rsbench.report.board_figures import bar
from rsbench.report.board_pictures import albums
from rsbench.report.board_problems import matrix_context, problem_contexts
from rsbench.report.board_splits import Board, read_split
from rsbench.report.board_tables import as_csv, as_latex, as_markdown
from rsbench.storage.files import write_bytes


def build_site(board: Path, out: Path, data: Sequence[Path] = (), *, problem_pages: bool = True) -> Path:
    """Write the site of a board into a folder; returns its first page.

    Args:
        data: datasets, of which pages of their problems show pictures.
        problem_pages: without them the site is a tenth as large; the table of all problems has their errors too.

    Raises:
        RsbenchError: it is no board, an entry or a dataset is damaged, or the folder cannot be written.
    """
    environment = Environment(
        loader=PackageLoader("rsbench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )

    def write(name: str, template: str, context: dict[str, Any]) -> None:
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, environment.get_template(f"{template}.html.j2").render(**context).encode())

    boards = [read_split(board, protocol, split) for protocol, split in splits_of(board)]
    boards = [replace(each, problem_pages=problem_pages) for each in boards if each.lines]
    secret, order = {each.track.id for each in boards if each.secret}, [each.track.id for each in boards]
    boards.sort(key=lambda each: (order.index(each.track.id), not each.secret))
    out.mkdir(parents=True, exist_ok=True)
    for each, album in zip(boards, albums(boards, out, data), strict=True):
        for suffix, text in (
            ("csv", as_csv(each.lines, each.secret)),
            ("md", as_markdown(each.lines)),
            ("tex", as_latex(each.lines)),
        ):
            write_bytes(out / f"{each.id}.{suffix}", text.encode())
        for line in each.lines:
            write(f"{each.id}/{line.scored.header.method}.html", "board_entry", entry_context(each, line, album))
        if not each.secret:
            write(f"{each.id}--problems.html", "board_problems", matrix_context(each, album))
        for name, context in problem_contexts(each, album):
            write(f"{each.id}/problem/{name}.html", "board_problem", context)
    write("index.html", "board", {"splits": [_section(each, each.track.id in secret) for each in boards]})
    return out / "index.html"


def _section(each: Board, ranked: bool) -> dict[str, Any]:
    """Of the first page; ``ranked``: whether the protocol has a secret split, which ranks."""
    used = {name for line in each.lines for name in line.scored.header.uses}
    return {
        **each.named,
        "word": ("Secret: it ranks." if each.secret else "Its truth is public: for practice.") if ranked else "",
        "count": len(each.problems),
        "scenes": len(set(each.scenes)),
        "given": each.track.given,
        "files": [(suffix, f"{each.id}.{suffix}") for suffix in ("csv", "md", "tex")],
        "knowledge": [name for name in KNOWLEDGE if name in used],
        "columns": _columns(each),
        "rows": [_row(each, line) for line in each.lines],
        "figures": each.figures(_first_of_groups(each.lines)),
    }


def _columns(each: Board) -> list[dict[str, Any]]:
    def column(key: str, title: str, first: str, hint: str, *, text: bool = False) -> dict[str, Any]:
        return {"key": key, "title": title, "first": first, "hint": hint, "text": text}

    parts, part, primary = each.lines[0].parts, each.track.parting, each.track.primary.title
    stated = [
        column("nees_ratio", "NEES", "up", "squared error by the stated covariance: 1 where that is right"),
        *(
            column(
                key, f"in {100.0 * level:.0f} %", "down", "share of truths in the stated ellipsoid of that level"
            )
            for level, key in zip(LEVELS, list(named_numbers(None))[1:], strict=True)
        ),
    ]
    return [
        column("method", "method", "up", "name of the entry", text=True),
        column("uses", "uses", "up", "what it works on", text=True),
        column("rank", "rank", "up", "among those that use no more, with its interval"),
        *(column(s.key, s.title, "down" if s.better == "higher" else "up", s.hint) for s in _scores(each)),
        *(stated if _stated(each) else []),
        *(column(f"part_{name}", name, "down", f"{primary} where the {part} is {name}") for name in parts),
        *([column("assumes", "assumes", "up", "motion model that it assumes", text=True)] if parts else []),
        column("ties", "ties", "up", "entries that the data do not tell from it", text=True),
        column("tuned_on", "tuned on", "up", "data by which its parameters were chosen", text=True),
    ]


def _scores(each: Board) -> list[Score]:
    """In the order of the cells: shares, then medians."""
    return sorted(each.track.scores, key=lambda score: score.kind == "median")


def _stated(each: Board) -> bool:
    return any(line.calibration for line in each.lines)


def _row(each: Board, line: Standing) -> dict[str, Any]:
    header, rank, primary = line.scored.header, line.rank, line.track.primary.key
    cells: list[dict[str, Any]] = [
        {"value": "" if rank is None else rank.place, "text": line.rank_words, "bar": None}
    ]
    for key, triple in line.means.items():
        drawn = bar(*triple) if key == primary else None
        cells.append({"value": _value(triple[0]), "text": in_words(*triple), "bar": drawn})
    for value in line.medians.values():
        cells.append({"value": _value(value), "text": "–" if np.isnan(value) else f"{value:.3g}", "bar": None})
    for triple in named_numbers(line.calibration).values() if _stated(each) else ():
        text = "–" if np.isnan(triple[0]) else in_words(*triple)
        cells.append({"value": _value(triple[0]), "text": text, "bar": None})
    for triple in line.parts.values():
        cells.append({"value": _value(triple[0]), "text": in_words(*triple), "bar": None})
    return {
        "method": header.method,
        "uses": line.uses.replace(" + ", " "),
        "oracle": rank is None,
        "handed_in": line.scored.handed_in,
        "doubt": line.scored.doubt,
        "page": f"{each.id}/{header.method}.html",
        "cells": cells,
        "words": [*([line.assumes] if line.parts else []), ", ".join(line.ties), header.tuned_on],
    }


def _value(value: float) -> str:
    """As JavaScript reads it, with all digits of the CSV file."""
    return "" if np.isnan(value) else "Infinity" if np.isinf(value) else repr(float(value))


def _first_of_groups(lines: Sequence[Standing]) -> list[Standing]:
    """The best of each group that uses the same first, then the second ones."""
    seen: dict[str, int] = {}
    places = []
    for line in lines:
        seen[line.uses] = seen.get(line.uses, 0) + 1
        places.append((line.rank is None, seen[line.uses]))
    return [lines[k] for k in sorted(range(len(lines)), key=lambda k: places[k])]
