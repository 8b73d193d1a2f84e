"""Scores of submissions, a row for each problem: by the one scorer of their track, and by nothing else.

A problem without an answer is a failure, and a failure scores the worst value of everything. Pictures take
longest: they are scored problem by problem, for what is found of the truth serves all entries, each problem in one
process of one thread. A score does not depend on which process it comes from, or on the other entries: none draws
at random, or adds in an order of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import pandas as pd

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.track import Row, Step
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.plain_data import decode, encode
from rsbench.jobs.process_jobs import run_jobs
from rsbench.jobs.workers import Workers
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import read_bytes

Numbers = dict[str, float]


def mark(submission: Submission, split: Split, workers: Workers = 1) -> pd.DataFrame:
    """One row for each problem, in the order of the split; the columns are those of docs/how-to/submit.md.

    Args:
        submission: what was answered.
        split: the truth.
        workers: processes, which score pictures; the rest takes no time.

    Raises:
        RsbenchError: a picture is at fault, or the truth has changed since the split was read.
    """
    (found,) = mark_all([submission], split, workers)
    if isinstance(found, RsbenchError):
        raise found
    return found


def mark_all(
    submissions: Sequence[Submission],
    split: Split,
    workers: Workers = 1,
    step: Step = lambda word: None,
    kept: Path | None = None,
) -> list[pd.DataFrame | RsbenchError]:
    """``mark`` of several submissions, which share what is found of the truth; an error is that of one of them.

    Args:
        submissions, split, workers: as of ``mark``.
        step: called with the name of each problem whose pictures are scored.
        kept: folder for what is done of them, so that a run that is cut off goes on there.

    Raises:
        RsbenchError: the truth has changed since the split was read.
    """
    return split.track.mark(submissions, split, workers, step, kept)


def rows_of_workers(
    submissions: Sequence[Submission], split: Split, workers: Workers, kept: Path | None = None
) -> Iterator[tuple[str, list[Row | str]]]:
    """``picture_rows`` of each problem by its name, as they become ready; with one worker, in this process.

    A folder ``kept`` holds those of a run that was cut off, and gets those that are new.

    Raises:
        RsbenchError: as it does; or a process ended each time over the same problem.
    """
    names = list[str]()
    for truth in split.truths:
        if kept is not None and (path := kept / truth.name).is_file():
            yield truth.name, decode(read_bytes(path), {})
        else:
            names.append(truth.name)
    for name, rows in _rows_of(submissions, split, workers, names):
        if kept is not None:
            kept.mkdir(parents=True, exist_ok=True)
            write_bytes(kept / name, encode(rows))
        yield name, rows


def _rows_of(
    submissions: Sequence[Submission], split: Split, workers: Workers, names: list[str]
) -> Iterator[tuple[str, list[Row | str]]]:
    if workers == 1:
        for name in names:
            yield name, picture_rows(split, name, submissions)
        return
    outcomes = run_jobs(_serve, names, workers, dict.fromkeys(THREAD_VARIABLES, "1"), tuple(submissions), split)
    with closing(outcomes) as ready:
        for name, outcome in ready:
            if not outcome.success:
                raise RsbenchError(f"problem {name}: {outcome.reason}" if outcome.ended else outcome.reason)
            yield name, outcome.value


def _serve(submissions: Sequence[Submission], split: Split) -> Callable[[str], list[Row | str]]:
    use_one_thread()

    def run(name: str) -> list[Row | str]:
        try:
            return picture_rows(split, name, submissions)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run


def picture_rows(split: Split, name: str, submissions: Sequence[Submission]) -> list[Row | str]:
    """Of each submission the scores of its pictures, which are read here, or what is at fault with them.

    Raises:
        RsbenchError: the truth has changed since the split was read.
    """
    truth, track = split.by_name[name], split.track
    assert truth.pictures is not None
    truth.pictures.check()
    scores_of = track.scorer(truth, truth.pictures)
    rows = list[Row | str]()
    for submission in submissions:
        answer = submission.answers.get(truth.name)
        success = answer is not None and answer.success
        try:
            scores = scores_of(submission, success)
        except RsbenchError as error:
            rows.append(str(error))
        else:
            rows.append({**named(truth, success), **scores, **last(success, answer)})
    return rows


def named(truth: Truth, success: bool) -> Row:
    """The first columns."""
    return {"problem": truth.name, "scene": truth.scene, "success": success}


def last(success: bool, answer: Answer | None) -> Row:
    """The last columns."""
    seconds = math.nan if answer is None or answer.seconds is None else answer.seconds
    return {"failure": float(not success), "seconds": seconds}
