"""The errors of single trials behind the rows of a summary, small enough to be kept with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.simulated.run_sweep import read_sweep, read_trials
from rsbench.benchmark.simulated.sweep_summary import read_card, score_trials

MEASURES = ("e_R_deg", "e_T_deg")


def errors_of_rows(table: pd.DataFrame, folder: Path) -> dict[str, NDArray[np.float32]]:
    """``MEASURES`` (rows, trials) of the rows of a summary, whose trials lie in the folder of its sweep.

    Failures have the worst value, as in the summary.

    Raises:
        RsbenchError: the folder holds no sweep.
    """
    found: dict[tuple[object, ...], dict[str, NDArray[np.float32]]] = {}
    card, solvers = read_card(folder), read_sweep(folder)["solvers"]
    for cell in card.cells():
        trials = read_trials(folder, card, cell)
        for number, solver in enumerate(solvers):
            scores = score_trials(trials, number, solver["reference_point"], cell)
            key = (cell.variant, cell.value, solver["name"])
            found[key] = {name: scores[name].astype(np.float32) for name in MEASURES}
    keys = [(row.variant, row.value, row.solver) for row in table.itertuples(index=False)]
    return {name: np.stack([found[key][name] for key in keys]) for name in MEASURES}
