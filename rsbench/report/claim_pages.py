"""Pages of Markdown with the verdicts on the paper's claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from rsbench.benchmark.simulated.sweep_card import SweepCard
from rsbench.benchmark.studies.claims import (
    CLAIMS,
    GLOBAL,
    GRID_NOISE_PX,
    GRID_TRIALS,
    IMAGE_CLAIMS,
    OURS,
    SETTINGS,
    Claim,
)
from rsbench.report.markup import table_lines, words_of

_CLAIMS = f"""# What became of the paper's claims

Simulated points, no RANSAC, as in section 3.1 of the paper; made by `rsbench reproduce claims`. Claims about
images: [images.md](images.md).

The paper leaves open how its solver is meant in places: how A is scaled (as it is | unit columns), the unit of
the baseline in it (metre | half the baseline), what gives w (all of E | its symmetric part), the length of d
(the entries of X that hold w alone | the exact constraint) and its sign (cheirality | the scale), and which
nine matches are taken (any | nine of a hundred that stand far apart). `literal` is the reading without any of
these; `best` is the most favourable verdict over all readings, and over mean and median. **A claim is refuted
only where its best reading fails.** With 9 + 9 matches A X = 0 has an exact solution, which no scaling changes.
The paper also leaves open in what its noise of "10^-3" is measured: both are here. What settings it does not
state do to the verdicts: [../readings](../readings/README.md); what was chosen here:
[../fig3/settings.csv](../fig3/settings.csv).

Every verdict follows by the rule above its table, from the 95 % intervals in brackets (median: bootstrap of
10 000 draws, exact order statistics below 30 trials; mean and root mean square, RMS: bootstrap; shares: exact).
`undecided`: the intervals neither show that it holds nor that it fails. Margins were fixed before these runs, when
results of an earlier version, under other rules, were known. Errors are in degrees; the paper's statistic is the
mean. `ours` is `{OURS}`, which is given the same matches, but descends: the paper excludes that.
GS is `{GLOBAL}`, which is given the left camera's matches and scored against the left camera's own translation.

Read "more stable" and "no impact" beside the errors: a solver that errs as much everywhere passes both.
"""


def claims_page(table: pd.DataFrame, best: pd.DataFrame) -> str:
    """Return the page: an overview, then for each claim the paper's words, the rule, and verdicts with figures."""
    claims = [line for claim in CLAIMS for line in _claim(claim, table, best)]
    return "\n".join([_CLAIMS, *summary(best), *_overview(best), *claims])


def summary(best: pd.DataFrame) -> list[str]:
    """Lines of a table of verdicts on the paper's solver, with both readings of the noise side by side."""
    lines = []
    for (claim, matches), rows in best.groupby(["claim", "matches"], sort=False):
        verdicts = [row[name] for row in rows.to_dict("records") for name in ("literal", "best")]
        lines.append([claim, matches, *verdicts, *["-"] * (4 - len(verdicts))])
    head = ["claim", "matches", "10^-3 px: literal", "best reading", "0.81 px: literal", "best reading"]
    return [*table_lines(head, lines), ""]


def _overview(best: pd.DataFrame) -> list[str]:
    """Lines of a table of verdicts, with the number of readings for which a claim holds, and on our solver."""
    lines = []
    for row in best.to_dict("records"):
        holding = f"{row['holding']} of {row['readings']} hold"
        lines.append(
            (row["claim"], row["matches"], row["noise"], row["literal"], row["best"], holding, row["ours"])
        )
    head = ["claim", "matches", "noise", "literal", "best reading", "of the readings", "ours"]
    return [*table_lines(head, lines), ""]


def _claim(claim: Claim, table: pd.DataFrame, best: pd.DataFrame) -> list[str]:
    lines = [f"## {claim.key[0].upper()}{claim.key[1:]}", "", f"{claim.text}.", "", f"Rule: {claim.rule}.", ""]
    where, there = f"at the first and last {claim.axis}", "with 27 unknowns" if claim.against_complete else "GS"
    if claim.beside:
        there = "bound of one camera"
    cells, own = list[tuple[str, ...]](), table[table.claim == claim.key]
    for case in best[best.claim == claim.key].to_dict("records"):
        rows = own[(own.matches == case["matches"]) & (own.noise == case["noise"])]
        chosen = rows.solver.isin(["literal", "ours"])
        chosen |= (rows.solver == case["best_reading"]) & (rows.statistic == case["best_statistic"])
        cells += [_claim_row(row, claim) for row in rows[chosen].to_dict("records")]
    head = ("matches", "noise", "statistic", "solver", "verdict", where, f"{there} there")
    return [*lines, *table_lines(head, cells), ""]


def _claim_row(row: dict[str, str], claim: Claim) -> tuple[str, ...]:
    figures, other = f"{row['first']}<br>{row['last']}", f"{row['other_first']}<br>{row['other_last']}"
    if row["first"] == row["last"]:
        figures, other = row["first"], row["other_first"]
    cells = (row["matches"], row["noise"], row["statistic"], row["solver"], row["verdict"], figures)
    return (*cells, "-" if claim.exact else other)


_IMAGES = """# What became of the paper's claims about images

Made by `rsbench reproduce image-claims` from the tables that results hold; each claim names its own. The limits of
the rules were chosen when earlier results were known; the figures stand beside each verdict.
"""


def image_claims_page(table: pd.DataFrame) -> str:
    """Return the page: for each claim the paper's words, the rule, and verdicts with figures."""
    lines = [_IMAGES]
    for claim in IMAGE_CLAIMS:
        lines += [f"## {claim.key[0].upper()}{claim.key[1:]}", "", f"{claim.text}.", ""]
        lines += [f"Rule: {claim.rule}. From [{claim.table}](../{claim.table}).", ""]
        names = ["who", "verdict", "figures"]
        lines += [*table_lines(names, table.loc[table.claim == claim.key, names].to_numpy()), ""]
    return "\n".join(lines)


_SETTINGS = f"""# The paper's claims in settings that it does not state

Depth, rotation, translation, baseline and number of matches are the paper's to choose, and not stated. How
often a claim holds throughout, and how often it fails throughout, on a grid of settings (half of all corners of
the values below), at {GRID_NOISE_PX:g} px, {GRID_TRIALS} trials each, on the mean; the axis of a claim's sweep
is left out of its grid. In the literal reading of the solver, and with w from the symmetric part of E. Verdicts
in all readings at one setting: [../claims](../claims/README.md). All settings: [settings.csv](settings.csv).
Made by `rsbench reproduce readings`.
"""
_UNITS = {
    "depth": " (m)",
    "rotation_deg": " (deg)",
    "translation": " (m)",
    "baseline": " (m)",
    "points": " per camera",
}


def readings_page(settings: pd.DataFrame) -> str:
    """Return the page for the table of ``claims.holding_settings``."""
    grid = [f"- {name}{_UNITS.get(name, '')}: {low} or {high}" for name, (low, high) in SETTINGS.items()]
    names = list(dict.fromkeys(settings.reading))
    head = ["claim", "settings", *(word for name in names for word in (f"{name}: holds", "fails"))]
    lines = []
    for claim, rows in settings.groupby("claim", sort=False):
        by_reading = rows.set_index("reading")
        counts = [str(by_reading.loc[name, key]) for name in names for key in ("holding", "failing")]
        lines.append([claim, rows.settings.iloc[0], *counts])
    return "\n".join([_SETTINGS, *grid, "", *table_lines(head, lines), ""])


_INTRODUCTION = """# Simulations beyond the paper

Made by `rsbench reproduce sweeps`, one row per solver and value. `information` names the matches that a solver
uses: pairs over time, or tracks through all four images, which contain more information. `_low` and `_high` are
the ends of 95 % intervals (bootstrap of 10 000 draws; shares: exact); failures count as 180 degrees;
`over_bound` is the root mean square error over its Cramer-Rao bound for that information; `bound_median` and
`bound_mean` are the median and mean of Gaussian errors at the bound; `unobservable` names what the matches do
not determine. Translations of solvers of the left camera are scored against that camera's own. No row was run
again: by chance one in forty ratios of a solver at its bound is below 1 with its interval, and so are rows with
the same scenes and noise (all noises of one number of matches).
"""
SHOWN_NOISE_PX = 0.3


def sweeps_page(cards: list[SweepCard], tables: Mapping[str, pd.DataFrame]) -> str:
    """Return the page, which describes each table and shows some figures."""
    lines = [*_solvers(tables["solvers"]), "", *_bound(tables["limit"]), "", *_wrong(tables["wrong-readout"])]
    lines += ["", *_wrong_motion(tables["wrong-motion"])]
    head = ("table", "what", "varies", "noise (px)", "trials", "RANSAC")
    return "\n".join([_INTRODUCTION, *table_lines(head, map(_row, cards)), "", *lines, ""])


def _row(card: SweepCard) -> tuple[str, ...]:
    noises = sorted({cell.setting.noise_px for cell in card.cells()})
    noise = f"{noises[0]:g}" if len(noises) == 1 else f"{noises[0]:g} to {noises[-1]:g}"
    ransac = "yes" if card.robust else "no"
    return (f"[{card.name}]({card.name}.csv)", card.description, card.axis, noise, str(card.trials), ransac)


def _solvers(table: pd.DataFrame) -> list[str]:
    """Lines about all solvers at one noise."""
    rows = table[table.value == SHOWN_NOISE_PX]
    lines = [
        f"## All solvers at {SHOWN_NOISE_PX:g} px",
        "",
        f"2 deg, 0.3 m, 100 matches per camera, {rows.trials.iloc[0]} trials; medians with 95 % intervals.",
        "",
    ]
    head = ("solver", "sees", "e_R (deg)", "e_T (deg)", "RMS e_T over bound")
    return lines + _figures(rows, head, ("e_R_median", "e_T_median", "e_T_over_bound"), ("solver", "information"))


def _figures(table: pd.DataFrame, head: Sequence[str], figures: Sequence[str], names: Sequence[str]) -> list[str]:
    """Lines of a table: for each row the columns ``names``, and ``figures`` with their intervals."""
    rows = table.to_dict("records")
    named = [[f"{row[name]:g}" if name == "value" else row[name] for name in names] for row in rows]
    return table_lines(
        head,
        ([*cells, *(words_of(row, figure) for figure in figures)] for cells, row in zip(named, rows, strict=True)),
    )


def _bound(table: pd.DataFrame) -> list[str]:
    """Lines about errors relative to the Cramer-Rao bound."""
    lines = ["## Errors over the Cramer-Rao bound", "", "Root mean squares.", ""]
    head = ("solver", "noise", "matches per camera", "e_R over bound", "e_T over bound")
    return lines + _figures(table, head, ("e_R_over_bound", "e_T_over_bound"), ("solver", "variant", "value"))


def _wrong(table: pd.DataFrame) -> list[str]:
    """Lines about errors if the given readout ratio is wrong."""
    noise = "0.1 px, 2 deg, 0.3 m, 100 matches per camera, or tracks; medians."
    head = ("solver", "sees", "given minus true", "e_R (deg)", "e_T (deg)")
    figures = _figures(table, head, ("e_R_median", "e_T_median"), ("solver", "information", "value"))
    return ["## A wrong readout ratio", "", noise, "", *figures]


def _wrong_motion(table: pd.DataFrame) -> list[str]:
    """Lines about errors on data whose motion model differs from the solver's."""
    solvers = list(table.solver.unique())
    lines = [
        "## Data of another motion model",
        "",
        "Median e_T (deg); 0.1 px, 0.3 m, 100 matches per camera, or tracks.",
        "",
    ]
    found = []
    for (variant, value), rows in table.groupby(["variant", "value"], sort=False):
        cells = [words_of(row, "e_T_median") for row in rows.to_dict("records")]
        found.append([variant, f"{value:g}", *cells])
    return lines + table_lines(["data follow", "rotation (deg)", *solvers], found)
