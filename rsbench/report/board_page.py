"""The leaderboard as a static site: an index, a page for each entry, and each table as CSV, Markdown and LaTeX.

Everything comes from a board's stored scores. Nothing is fetched, and what entries say of themselves is escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined

from rsbench.benchmark.leaderboard.board import about_split, entries_of, place, splits_of
from rsbench.benchmark.leaderboard.protocols import KNOWLEDGE, Protocol, protocol_of_id
from rsbench.benchmark.leaderboard.standings import Standing, standings, table
from rsbench.benchmark.statistics import in_words
from rsbench.dataset.files import write_bytes
from rsbench.report.board_figures import bar, curves

_ABOUT = ("version", "description", "authors", "paper", "code", "licence", "hardware", "tuned_on", "motion_model")
_WORST = 10
_BRIEF = 2
"""Medians of the tables that show few numbers."""


@dataclass(frozen=True, kw_only=True)
class _Table:
    """A split with its lines, and what is told of its problems."""

    protocol: str
    split: str
    lines: list[Standing]
    facts: pd.DataFrame
    """By the name of the problem; without columns where they are secret."""

    @property
    def id(self) -> str:
        return f"{self.protocol}--{self.split}"


def build_site(board: Path, out: Path) -> Path:
    """Write the site of a board into a folder; returns its first page.

    Raises:
        RsbenchError: it is no board, an entry is damaged, or the folder cannot be written.
    """
    environment = Environment(
        loader=PackageLoader("rsbench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    tables = [_table(board, protocol, split) for protocol, split in splits_of(board)]
    tables = [each for each in tables if each.lines]
    out.mkdir(parents=True, exist_ok=True)
    for each in tables:
        for suffix, text in (
            ("csv", as_csv(each.lines)),
            ("md", as_markdown(each.lines)),
            ("tex", as_latex(each.lines)),
        ):
            write_bytes(out / f"{each.id}.{suffix}", text.encode())
        (out / each.id).mkdir(exist_ok=True)
        for line in each.lines:
            page = environment.get_template("board_entry.html.j2").render(**_entry(each, line))
            write_bytes(out / each.id / f"{line.scored.header.method}.html", page.encode())
    index = environment.get_template("board.html.j2").render(splits=[_section(each) for each in tables])
    write_bytes(out / "index.html", index.encode())
    return out / "index.html"


def _table(board: Path, protocol: str, split: str) -> _Table:
    facts = pd.DataFrame.from_dict(about_split(place(board, protocol, split)).facts, orient="index")
    return _Table(protocol=protocol, split=split, lines=standings(entries_of(board, protocol, split)), facts=facts)


# The index


def _section(each: _Table) -> dict[str, Any]:
    protocol, scores = protocol_of_id(each.protocol), each.lines[0].scored.scores
    used = {name for line in each.lines for name in line.scored.header.uses}
    return {
        **_named(each),
        "id": each.id,
        "problems": len(scores),
        "scenes": scores["scene"].nunique(),
        "given": protocol.given,
        "files": [f"{each.id}.{suffix}" for suffix in ("csv", "md", "tex")],
        "knowledge": [name for name in KNOWLEDGE if name in used],
        "columns": _columns(protocol),
        "rows": [_row(each, line) for line in each.lines],
        "figures": _figures(each, each.lines),
    }


def _named(each: _Table) -> dict[str, str]:
    protocol = protocol_of_id(each.protocol)
    return {
        "title": protocol.title,
        "protocol": each.protocol,
        "split": each.split,
        "primary": protocol.primary.title,
    }


def _columns(protocol: Protocol) -> list[dict[str, Any]]:
    def column(key: str, title: str, first: str, hint: str, *, text: bool = False) -> dict[str, Any]:
        return {"key": key, "title": title, "first": first, "hint": hint, "text": text}

    return [
        column("method", "method", "up", "name of the entry", text=True),
        column("uses", "uses", "up", "what it works on", text=True),
        column("rank", "rank", "up", "among those that use no more, with its interval"),
        *(column(s.key, s.title, "down" if s.better == "higher" else "up", s.hint) for s in protocol.scores),
        column("ties", "ties", "up", "entries that the data do not tell from it", text=True),
        column("tuned_on", "tuned on", "up", "data by which its parameters were chosen", text=True),
    ]


def _row(each: _Table, line: Standing) -> dict[str, Any]:
    header, rank, primary = line.scored.header, line.rank, line.protocol.primary.key
    cells: list[dict[str, Any]] = [
        {"value": "" if rank is None else rank.place, "text": line.rank_words, "bar": None}
    ]
    for key, triple in line.means.items():
        drawn = bar(*triple) if key == primary else None
        cells.append({"value": _value(triple[0]), "text": in_words(*triple), "bar": drawn})
    for value in line.medians.values():
        cells.append({"value": _value(value), "text": "–" if np.isnan(value) else f"{value:.3g}", "bar": None})
    return {
        "method": header.method,
        "uses": line.uses.replace(" + ", " "),
        "oracle": rank is None,
        "page": f"{each.id}/{header.method}.html",
        "cells": cells,
        "ties": ", ".join(line.ties),
        "tuned_on": header.tuned_on,
    }


def _value(value: float) -> str:
    """As JavaScript reads it, with all digits of the CSV file."""
    return "" if np.isnan(value) else "Infinity" if np.isinf(value) else repr(float(value))


def _figures(each: _Table, lines: Sequence[Standing]) -> list[dict[str, Any]]:
    """The best of each group that uses the same first, as far as there is room."""
    seen: dict[str, int] = {}
    places = []
    for line in lines:
        seen[line.uses] = seen.get(line.uses, 0) + 1
        places.append((line.rank is None, seen[line.uses]))
    chosen = [lines[k] for k in sorted(range(len(lines)), key=lambda k: places[k])]
    found, primary = [], protocol_of_id(each.protocol).primary.key
    for name in each.facts.columns:
        numbers = each.facts[name].reindex(chosen[0].scored.scores["problem"])
        if not pd.api.types.is_numeric_dtype(numbers) or not np.all(np.isfinite(numbers)):
            continue
        scores = {line.scored.header.method: line.scored.scores[primary].to_numpy() for line in chosen}
        drawn = curves(numbers, scores)
        if drawn is not None:
            found.append({"title": str(name), "svg": drawn})
    return found


# An entry


def _entry(each: _Table, line: Standing) -> dict[str, Any]:
    header, scores = line.scored.header, line.scored.scores
    said = asdict(header)
    protocol = line.protocol
    tables = [_worst(each, scores, protocol)]
    if scores["scene"].nunique() < len(scores):
        tables.insert(0, _by("scene", scores["scene"], scores, protocol))
    for name in each.facts.columns:
        kinds = each.facts[name].reindex(scores["problem"])
        if not pd.api.types.is_numeric_dtype(kinds):
            tables.append(_by(str(name), pd.Series(kinds.to_numpy()).astype(str), scores, protocol))
    return {
        "header": header,
        "split": _named(each),
        "back": f"../index.html#{each.id}",
        "about": [("uses", line.uses), *((name, said[name]) for name in _ABOUT if said[name])],
        "tables": tables,
        "figures": _figures(each, [line]),
    }


def _by(name: str, kinds: pd.Series, scores: pd.DataFrame, protocol: Protocol) -> dict[str, Any]:
    rows = []
    for kind, part in scores.groupby(kinds.to_numpy()):
        medians = (part[key].median() for key in protocol.of_kind("median")[:_BRIEF])
        numbers = [f"{part[protocol.primary.key].mean():.3f}", *(f"{x:.3g}" for x in medians)]
        rows.append([str(kind), len(part), *numbers, int(part["failure"].sum())])
    return {
        "title": f"By {name}",
        "columns": [name, "problems", protocol.primary.title, *_medians(protocol), "failed"],
        "rows": rows,
    }


def _medians(protocol: Protocol) -> list[str]:
    """Titles of the most telling ones."""
    return [score.title for score in protocol.scores if score.kind == "median"][:_BRIEF]


def _worst(each: _Table, scores: pd.DataFrame, protocol: Protocol) -> dict[str, Any]:
    worst = scores.sort_values([protocol.error, "problem"], ascending=[False, True]).head(_WORST)
    names = [str(name) for name in each.facts.columns]
    rows = []
    for case in worst.to_dict("records"):
        numbers = [f"{case[key]:.3g}" for key in protocol.of_kind("median")[:_BRIEF]]
        known = [each.facts[name].get(case["problem"], "") for name in names]
        words = [f"{value:.3g}" if isinstance(value, float) else str(value) for value in known]
        rows.append([str(case["problem"]), *numbers, *words])
    return {
        "title": "Worst problems",
        "columns": ["problem", *_medians(protocol), *names],
        "rows": rows,
    }


# Files


def as_csv(lines: Sequence[Standing]) -> str:
    """All numbers of a table, with all their digits."""
    return table(lines).to_csv(index=False, lineterminator="\n")


def _brief(lines: Sequence[Standing]) -> list[list[str]]:
    protocol = lines[0].protocol
    rows = [["method", "uses", "rank", protocol.primary.title, "failed", *_medians(protocol)]]
    for line in lines:
        shares = [in_words(*line.means[key]) for key in (protocol.primary.key, "failure")]
        medians = [f"{line.medians[key]:.3g}" for key in protocol.of_kind("median")[:_BRIEF]]
        rows.append([line.scored.header.method, line.uses, line.rank_words, *shares, *medians])
    return rows


def as_markdown(lines: Sequence[Standing]) -> str:
    """The most telling columns; names of methods hold nothing that Markdown reads, but underscores."""
    head, *rows = ["| " + " | ".join(row) + " |" for row in _brief(lines)]
    return "\n".join([head, "|" + "---|" * len(_brief(lines)[0]), *rows]).replace("_", r"\_") + "\n"


def as_latex(lines: Sequence[Standing]) -> str:
    """The same as a tabular with the rules of booktabs."""
    head, *rows = [" & ".join(row).replace("_", r"\_") + r" \\" for row in _brief(lines)]
    width = len(_brief(lines)[0])
    begin, end = rf"\begin{{tabular}}{{ll{'r' * (width - 2)}}}", r"\end{tabular}"
    return "\n".join([begin, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", end, ""])
