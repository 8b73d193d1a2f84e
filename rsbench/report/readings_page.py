"""The claims in every reading of the paper's solver and in settings that it does not state, as a page."""

from __future__ import annotations

import pandas as pd

from rsbench.benchmark.studies.readings import GRID_NOISE_PX, GRID_TRIALS

_READINGS = """# The paper's claims in every reading of its solver

The paper leaves open how A is scaled (as it is | unit columns), the unit of the baseline in it (metre | half the
baseline), what gives w (all of E | its symmetric part) and the sign of d (cheirality | the scale): 16 readings,
the first of each literal. A claim is refuted only where the last verdict of its row fails. The best is over
readings and over mean and median; `holding` counts the readings in which the claim holds throughout, in the
paper's statistic. Made by `rsbench reproduce readings`. All verdicts: [readings.csv](readings.csv).
"""
_SETTINGS = f"""## In settings that the paper does not state

Depth, rotation, translation, baseline and number of matches are the paper's to choose, and not stated. The share
of a grid of settings in which a claim holds throughout, at {GRID_NOISE_PX:g} px, {GRID_TRIALS} trials each, on the
mean; the axis of a claim's sweep is left out of its grid. All settings: [settings.csv](settings.csv).
"""


def readings_page(best: pd.DataFrame, settings: pd.DataFrame) -> str:
    """Markdown from the tables of ``best_readings`` and ``holding_settings``."""
    return "\n".join([*_readings(best), *_settings(settings)])


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
