"""Scores of pictures, which take longest, in several processes: each problem in one of them, of one thread.

A score does not depend on which process it comes from: none draws at random, or adds in an order of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from typing import Any

from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.errors import RsbenchError
from rsbench.pipeline.crew import Workers
from rsbench.pipeline.isolated_jobs import run_jobs
from rsbench.pipeline.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread

Row = dict[str, Any]


def rows_of_workers(submission: Submission, split: Split, workers: Workers) -> list[Row]:
    """``marking.picture_row`` of each problem, in the order of the split.

    Raises:
        RsbenchError: as it does; or a process ended each time over the same problem.
    """
    rows: dict[str, Row] = {}
    names = [truth.name for truth in split.truths]
    outcomes = run_jobs(_serve, names, workers, dict.fromkeys(THREAD_VARIABLES, "1"), submission, split)
    with closing(outcomes) as ready:
        for name, outcome in ready:
            if not outcome.success:
                raise RsbenchError(f"problem {name}: {outcome.reason}" if outcome.ended else outcome.reason)
            rows[name] = outcome.value
    return [rows[name] for name in names]


def _serve(submission: Submission, split: Split) -> Callable[[str], Row]:
    from rsbench.benchmark.leaderboard.marking import picture_row

    use_one_thread()

    def run(name: str) -> Row:
        try:
            return picture_row(split.by_name[name], submission)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run
