"""The claims in settings that the paper does not state, as a page."""

from __future__ import annotations

import pandas as pd

from rsbench.benchmark.studies.readings import GRID_NOISE_PX, GRID_TRIALS, SETTINGS

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
    """Markdown from the table of ``claims.holding_settings``."""
    grid = [f"- {name}{_UNITS.get(name, '')}: {low} or {high}" for name, (low, high) in SETTINGS.items()]
    names = list(dict.fromkeys(settings.reading))
    head = " | ".join(f"{name}: holds | fails" for name in names)
    lines = [_SETTINGS, *grid, "", f"| claim | settings | {head} |", f"|---|---|{'---|---|' * len(names)}"]
    for claim, rows in settings.groupby("claim", sort=False):
        by_reading = rows.set_index("reading")
        counts = [str(by_reading.loc[name, key]) for name in names for key in ("holding", "failing")]
        lines.append(f"| {claim} | {rows.settings.iloc[0]} | {' | '.join(counts)} |")
    return "\n".join([*lines, ""])
