"""Each table of the leaderboard as CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence

from rsbench.benchmark.leaderboard.standings import Standing, table
from rsbench.benchmark.leaderboard.track import Track
from rsbench.benchmark.statistics import in_words

BRIEF = 2
"""Medians of the tables that show few numbers."""


def as_csv(lines: Sequence[Standing], secret: bool) -> str:
    """All numbers of a table, with all their digits; no cell begins as a formula does, since names do not."""
    return table(lines, worst=not secret).to_csv(index=False, lineterminator="\n")


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


def brief_medians(track: Track) -> list[str]:
    """Titles of the most telling ones."""
    return [score.title for score in track.scores if score.kind == "median"][:BRIEF]


def _brief(lines: Sequence[Standing]) -> list[list[str]]:
    track = lines[0].track
    assumes = ["assumes"] if track.parting else []
    titles = {score.key: score.title for score in track.scores}
    stated = ["in 95 %"] if any(line.calibration for line in lines) else []
    head = ["method", *assumes, "uses", "rank", track.primary.title, *lines[0].parts]
    rows = [[*head, *(titles[key] for key in track.beside), *brief_medians(track), *stated]]
    for line in lines:
        primary, *beside = [in_words(*line.means[key]) for key in (track.primary.key, *track.beside)]
        parts = [f"{triple[0]:.2f}" for triple in line.parts.values()]
        medians = [f"{line.medians[key]:.3g}" for key in track.of_kind("median")[:BRIEF]]
        assumed = [line.assumes] if track.parting else []
        covers = [in_words(*line.calibration.covers[-1]) if line.calibration else "-"] if stated else []
        cells = [line.name, *assumed, line.uses, line.rank_words, primary, *parts, *beside, *medians, *covers]
        rows.append(cells)
    return rows
