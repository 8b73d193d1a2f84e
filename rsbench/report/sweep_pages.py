"""The page beside the tables of the simulations that the paper does not have."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any

import pandas as pd

from rsbench.benchmark.simulated.sweep_card import SweepCard
from rsbench.benchmark.statistics import in_words

_INTRODUCTION = """# Simulations beyond the paper

Made by `rsbench reproduce sweeps`. One row per solver and value; `information` says which matches a solver was
given (methods that see pairs and methods that see tracks through all four images are not on a par), `_low` and
`_high` are 95 % intervals (bootstrap of 10 000 draws; shares: exact), failures score 180 degrees, `over_bound`
is the root mean square error over its Cramer-Rao bound for that information, `bound_median` and `bound_mean` are
those statistics of Gaussian errors at the bound, and `unobservable` names what the matches do not determine.
Translations of solvers of the left camera are scored against that camera's own. Every row is one draw of its
trials and none was drawn again: of the ratios of a solver at its bound one in forty lies below 1 with its
interval, and rows that share scenes and noise, as all noises of one number of matches do, lie there together.

| table | what | varies | noise (px) | trials | RANSAC |
|---|---|---|---|---|---|
"""
SHOWN_NOISE_PX = 0.3


def sweeps_page(cards: list[SweepCard], tables: Mapping[str, pd.DataFrame]) -> str:
    """Markdown that says what each table holds, with the figures that README shows."""
    lines = [*_solvers(tables["solvers"]), "", *_bound(tables["limit"]), "", *_wrong(tables["wrong-readout"])]
    lines += ["", *_wrong_motion(tables["wrong-motion"])]
    return _INTRODUCTION + "".join(_row(card) for card in cards) + "\n" + "\n".join(lines) + "\n"


def _row(card: SweepCard) -> str:
    noises = sorted({cell.setting.noise_px for cell in card.cells()})
    noise = f"{noises[0]:g}" if len(noises) == 1 else f"{noises[0]:g} to {noises[-1]:g}"
    ransac = "yes" if card.robust else "no"
    cells = (f"[{card.name}]({card.name}.csv)", card.description, card.axis, noise, str(card.trials), ransac)
    return f"| {' | '.join(cells)} |\n"


def _solvers(table: pd.DataFrame) -> list[str]:
    """All solvers at one noise."""
    rows = table[table.value == SHOWN_NOISE_PX]
    lines = [
        f"## All solvers at {SHOWN_NOISE_PX:g} px",
        "",
        f"2 deg, 0.3 m, 100 matches per camera, {rows.trials.iloc[0]} trials; medians with 95 % intervals.",
        "",
        "| solver | sees | e_R (deg) | e_T (deg) | RMS e_T over bound |",
        "|---|---|---|---|---|",
    ]
    for row in rows.to_dict("records"):
        cells = [_words(row, name) for name in ("e_R_median", "e_T_median", "e_T_over_bound")]
        lines.append(f"| {row['solver']} | {row['information']} | {' | '.join(cells)} |")
    return lines


def _bound(table: pd.DataFrame) -> list[str]:
    """Errors over the bound."""
    lines = ["## Errors over the Cramer-Rao bound", "", "Root mean squares.", ""]
    lines += ["| solver | noise | matches per camera | e_R over bound | e_T over bound |", "|---|---|---|---|---|"]
    for row in table.to_dict("records"):
        cells = [_words(row, name) for name in ("e_R_over_bound", "e_T_over_bound")]
        lines.append(f"| {row['solver']} | {row['variant']} | {row['value']:g} | {' | '.join(cells)} |")
    return lines


def _wrong(table: pd.DataFrame) -> list[str]:
    """Errors when the solver is told a wrong readout ratio."""
    noise = "0.1 px, 2 deg, 0.3 m, 100 matches per camera, or tracks; medians."
    lines = [
        "## Told a wrong readout ratio",
        "",
        noise,
        "",
        "| solver | sees | told minus true | e_R (deg) | e_T (deg) |",
    ]
    lines.append("|---|---|---|---|---|")
    for row in table.to_dict("records"):
        cells = [_words(row, name) for name in ("e_R_median", "e_T_median")]
        lines.append(f"| {row['solver']} | {row['information']} | {row['value']:g} | {' | '.join(cells)} |")
    return lines


def _wrong_motion(table: pd.DataFrame) -> list[str]:
    """Errors when the data move otherwise than the solver assumes."""
    solvers = list(table.solver.unique())
    lines = [
        "## Data of another motion model",
        "",
        "Median e_T (deg); 0.1 px, 0.3 m, 100 matches per camera, or tracks.",
        "",
        f"| data follow | rotation (deg) | {' | '.join(solvers)} |",
        f"|---|---|{'---|' * len(solvers)}",
    ]
    for (variant, value), rows in table.groupby(["variant", "value"], sort=False):
        cells = [_words(row, "e_T_median") for row in rows.to_dict("records")]
        lines.append(f"| {variant} | {value:g} | {' | '.join(cells)} |")
    return lines


def _words(row: Mapping[Hashable, Any], name: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    return "-" if pd.isna(value) else in_words(value, low, high)
