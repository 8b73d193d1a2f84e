"""Evaluations that several test files make, and what is in their folders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from commands import bytes_below

from rsbench.benchmark.images.evaluation import open_evaluation
from rsbench.benchmark.images.plan import EvaluationOptions
from rsbench.storage.files import HASHES

QUICK = EvaluationOptions(solvers=("gs-8pt",), correction_solver="rs-stereo-refined")
MACHINE = ("seconds.json", "seconds.csv", "provenance.json")
"""Files that hold times, the date and the machine."""
KEPT = Path(HASHES)
"""Hashes of the data with its times."""


def evaluate(dataset: Path, out: Path, step: Any = lambda word: None, **changes: Any) -> list[str]:
    options = EvaluationOptions(**{**vars(QUICK), **changes})
    return open_evaluation(dataset, out, options).run("test", step)


def contents(out: Path) -> dict[str, bytes]:
    return bytes_below(out, *MACHINE, KEPT.name)


def times(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in (out / "predictions").rglob("*") if p.is_file()}


def remade(before: dict[str, int], out: Path) -> set[str]:
    """Predictions that were written since, such as ``castle/motion/gs-8pt``; none may be gone."""
    after = times(out)
    assert before.keys() <= after.keys()
    changed = {name for name in after if after[name] != before.get(name) and Path(name).name not in MACHINE}
    return {name.removeprefix("predictions/").removesuffix(".json") for name in changed if name.endswith(".json")}


def cell(table: pd.DataFrame, column: str, **keys: object) -> float:
    """The one number of a table in the row that has these keys."""
    rows = table[np.logical_and.reduce([table[name] == value for name, value in keys.items()])]
    (value,) = rows[column].to_numpy()
    return float(value)
