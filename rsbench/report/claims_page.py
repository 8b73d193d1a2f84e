"""The table of claims as a page of Markdown."""

from __future__ import annotations

import pandas as pd

from rsbench.benchmark.studies.claims import CLAIMS, GLOBAL, OURS, PUBLISHED, Claim
from rsbench.benchmark.studies.readings import GRID_NOISE_PX, GRID_TRIALS

_INTRODUCTION = f"""# What became of the paper's claims

Simulated points, no RANSAC, as in section 3.1 of the paper; made by `rsbench reproduce claims`. The paper leaves
open in what its noise of "10^-3" is measured, how many matches there were, depth, rotation and translation:
[../fig3/settings.csv](../fig3/settings.csv) has what was chosen here. The paper's statistic is the mean. Errors
are in degrees, brackets are 95 % bootstrap intervals, and every verdict follows from the stored figures by the
rule above its table.

Published: `{PUBLISHED}`. Ours: `{OURS}`, which is given the same matches. GS: `{GLOBAL}`, which is
given the left camera's matches and scored against the left camera's own translation.
"""


_READINGS = """## In every reading of the paper's solver

The paper leaves open how A is scaled (as it is | unit columns), the unit of the baseline in it (metre | half the
baseline), what gives w (all of E | its symmetric part) and the sign of d (cheirality | the scale): 16 readings,
the first of each literal. A claim is refuted only where the last verdict of its row fails. The best is over
readings and over mean and median; `holding` counts the readings in which the claim holds throughout, in the
paper's statistic. All verdicts: [readings.csv](readings.csv).
"""
_SETTINGS = f"""## In settings that the paper does not state

Depth, rotation, translation, baseline and number of matches are the paper's to choose, and not stated. The share
of a grid of settings in which a claim holds throughout, at {GRID_NOISE_PX:g} px, {GRID_TRIALS} trials each, on the
mean; the axis of a claim's sweep is left out of its grid. All settings: [settings.csv](settings.csv).
"""


def claims_page(table: pd.DataFrame, best: pd.DataFrame, settings: pd.DataFrame) -> str:
    """Markdown: an overview, verdicts in all readings, then per claim the paper's words, the rule, and figures.

    Args:
        table: of ``judge_claims``.
        best: of ``best_readings``.
        settings: of ``holding_settings``.
    """
    claims = (line for claim in CLAIMS for line in _claim(claim, table))
    return "\n".join([_INTRODUCTION, *_overview(table), *_readings(best), *_settings(settings), *claims])


def _readings(best: pd.DataFrame) -> list[str]:
    lines = [_READINGS, "| claim | matches | noise | literal | holding | best | in the reading |"]
    lines.append("|---|---|---|---|---|---|---|")
    for row in best.to_dict("records"):
        where = f"{row['best_reading']} ({row['best_statistic']})"
        holding = f"{row['holding']} of {row['readings']}"
        cells = (row["claim"], row["matches"], row["noise"], row["literal"], holding, row["best"], where)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return [*lines, ""]


def _settings(settings: pd.DataFrame) -> list[str]:
    names = list(dict.fromkeys(settings.reading))
    lines = [_SETTINGS, f"| claim | {' | '.join(names)} |", f"|---|{'---|' * len(names)}"]
    for claim, rows in settings.groupby("claim", sort=False):
        shares = {row["reading"]: f"{row['holding']} of {row['settings']}" for row in rows.to_dict("records")}
        lines.append(f"| {claim} | {' | '.join(shares[name] for name in names)} |")
    return [*lines, ""]


def _overview(table: pd.DataFrame) -> list[str]:
    """Verdicts on the paper's statistic side by side."""
    lines = ["| claim | matches | noise | published | ours |", "|---|---|---|---|---|"]
    chosen = table[table.statistic != "median"]
    for (claim, matches, noise), rows in chosen.groupby(["claim", "matches", "noise"], sort=False):
        verdicts = dict(zip(rows.solver, rows.verdict, strict=True))
        lines.append(f"| {claim} | {matches} | {noise} | {verdicts[PUBLISHED]} | {verdicts[OURS]} |")
    return [*lines, ""]


def _claim(claim: Claim, table: pd.DataFrame) -> list[str]:
    lines = [f"## {claim.key[0].upper()}{claim.key[1:]}", "", f"{claim.text}.", "", f"Rule: {claim.rule}.", ""]
    lines += [
        f"| matches | noise | statistic | solver | verdict | at the first and last {claim.axis} | GS there |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in table[table.claim == claim.key].to_dict("records"):
        who = "published" if row["solver"] == PUBLISHED else "ours"
        figures, other = f"{row['first']}<br>{row['last']}", f"{row['gs_first']}<br>{row['gs_last']}"
        cells = (row["matches"], row["noise"], row["statistic"], who, row["verdict"], figures, other)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return [*lines, ""]
