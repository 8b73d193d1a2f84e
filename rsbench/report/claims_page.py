"""The table of claims as a page of Markdown."""

from __future__ import annotations

import pandas as pd

from rsbench.benchmark.studies.claims import CLAIMS, GLOBAL, OURS, PUBLISHED, Claim

_INTRODUCTION = f"""# What became of the paper's claims

Simulated points, no RANSAC, as in section 3.1 of the paper; made by `rsbench reproduce claims`. The paper leaves
open in what its noise of "10^-3" is measured, how many matches there were, depth, rotation and translation:
[../fig3/settings.csv](../fig3/settings.csv) has what was chosen here. The paper's statistic is the mean. Errors
are in degrees, brackets are 95 % bootstrap intervals, and every verdict follows from the stored figures by the
rule above its table.

Published: `{PUBLISHED}`. Ours: `{OURS}`, which is given the same matches. GS: `{GLOBAL}`, which is
given the left camera's matches and scored against the left camera's own translation.
"""


def claims_page(table: pd.DataFrame) -> str:
    """Markdown: an overview, then per claim the paper's words, the rule, and verdicts with their figures."""
    return "\n".join(
        [_INTRODUCTION, *_overview(table), *(line for claim in CLAIMS for line in _claim(claim, table))]
    )


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
