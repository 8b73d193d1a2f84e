"""Every entry of ours on the first problems of ``points``, compared with stored scores: what a change moved."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from rsbench.benchmark.leaderboard.marking import mark
from rsbench.benchmark.leaderboard.protocols import PROTOCOLS
from rsbench.benchmark.leaderboard.running import answer_problem, header_of, load_entries
from rsbench.benchmark.leaderboard.splits import PUBLIC_SEED, points_split, simulated_problem
from rsbench.benchmark.leaderboard.submissions import read_submission, submission_text
from rsbench.dataset.files import read_table, write_bytes
from rsbench.errors import RsbenchError
from rsbench.pipeline.isolated_solver import SolverRunner

PROBLEMS = 6
"""A minute for all solvers of ours."""
FILE = "scores.csv"
_NAMES = ("method", "problem", "success")
_NUMBERS = ("e_R_deg", "e_T_deg", "e_s", "metres", "e_row_deg", "nees")
_SAME, _NOTHING = 1e-4, 1e-7
"""Relative and absolute difference of equal scores. The same code on the same machine gives the same digits; a
processor that sums in another order changes the last ones, and now and then a choice of RANSAC: with OpenBLAS and
Numba told to use no AVX, 113 of 114 answers agreed so far, and one was another."""


def run_smoke(
    cards: Sequence[str], problems: int = PROBLEMS, step: Callable[[str], None] = lambda word: None
) -> pd.DataFrame:
    """Scores of solvers on the first problems of the public split of ``points``; no stored prediction is used.

    Returns:
        A row for each solver and problem: method, problem, success, and the errors of docs/submit.md.

    Raises:
        RsbenchError: no such solver, or no such number of problems.
    """
    split = points_split(PROTOCOLS["points"])
    if not 1 <= problems <= len(split.truths):
        raise RsbenchError(f"--problems {problems}: must lie in [1, {len(split.truths)}]")
    split = replace(split, truths=split.truths[:problems])
    given = [simulated_problem(PUBLIC_SEED, number) for number in range(problems)]
    runner, tables = SolverRunner(single_thread=True), list[pd.DataFrame]()
    with tempfile.TemporaryDirectory() as folder:
        for entry in load_entries(cards, split.protocol).values():
            answers = (answer_problem(problem, entry, runner) for problem in given)
            path = Path(folder) / "predictions.jsonl"
            write_bytes(path, submission_text(header_of(entry, split), answers).encode())
            scores = mark(read_submission(path, split), split)
            tables.append(scores.assign(method=entry.name)[[*_NAMES, *_NUMBERS]])
            step(entry.name)
    return pd.concat(tables, ignore_index=True)


def read_scores(folder: Path) -> pd.DataFrame:
    """What ``run_smoke`` gave when it was stored.

    Raises:
        RsbenchError: it is not there, or damaged.
    """
    return read_table(folder / FILE, _NAMES, _NUMBERS, dtype={"method": str, "problem": str})


def differences(found: pd.DataFrame, stored: pd.DataFrame) -> Iterator[str]:
    """A line for each score of ``found`` that is not the stored one."""
    known = {(row["method"], row["problem"]): row for row in stored.to_dict("records")}
    for row in found.to_dict("records"):
        name, old = f"{row['method']}, {row['problem']}", known.get((row["method"], row["problem"]))
        if old is None:
            yield f"{name}: has no stored scores"
            continue
        if bool(row["success"]) != bool(old["success"]):
            yield f"{name}: success = {row['success']}, stored {old['success']}"
            continue
        for key in _NUMBERS:
            if not _equal(row[key], old[key]):
                yield f"{name}: {key} = {row[key]:.6g}, stored {old[key]:.6g}"


def _equal(a: float, b: float) -> bool:
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=_SAME, abs_tol=_NOTHING)
