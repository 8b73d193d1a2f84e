"""Scores of pictures, which take longest: problem by problem, for what is found of the truth serves all entries.

In several processes each problem is in one of them, of one thread. A score does not depend on which process it
comes from, or on the other entries: none draws at random, or adds in an order of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.picture_files import FOLDER, read_answer_depth, read_answer_frame
from rsbench.benchmark.leaderboard.picture_marking import (
    Numbers,
    TrueDepth,
    TrueFrame,
    depth_scores,
    frame_scores,
)
from rsbench.benchmark.leaderboard.protocols import Asks
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.true_pictures import TruePictures
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.plain_data import decode, encode
from rsbench.jobs.process_jobs import run_jobs
from rsbench.jobs.workers import Workers
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import read_bytes

Row = dict[str, Any]


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
            yield name, picture_rows(split.by_name[name], submissions, split.protocol.asks)
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
            return picture_rows(split.by_name[name], submissions, split.protocol.asks)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run


def picture_rows(truth: Truth, submissions: Sequence[Submission], asks: Asks) -> list[Row | str]:
    """Of each submission the scores of its pictures, which are read here, or what is at fault with them.

    Raises:
        RsbenchError: the truth has changed since the split was read.
    """
    assert truth.pictures is not None
    truth.pictures.check()
    scores_of = _scores_of(truth, truth.pictures, asks)
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


def _scores_of(truth: Truth, pictures: TruePictures, asks: Asks) -> Callable[[Submission, bool], Numbers]:
    """Scores of the answers of submissions to one problem, by whether it is none that failed."""
    if asks == "depth":
        depth = TrueDepth.of(pictures)

        def of_depth(submission: Submission, success: bool) -> Numbers:
            folder, unit = submission.folder / FOLDER, submission.header.png_unit_m
            return depth_scores(depth, read_answer_depth(folder, truth, unit) if success else None)

        return of_depth
    frames = TrueFrame.all_of(pictures)

    def of_frames(submission: Submission, success: bool) -> Numbers:
        folder = submission.folder / FOLDER
        drawn = [read_answer_frame(folder, truth, each) for each in pictures.asked] if success else None
        return frame_scores(frames, drawn)

    return of_frames


def named(truth: Truth, success: bool) -> Row:
    """The first columns."""
    return {"problem": truth.name, "scene": truth.scene, "success": success}


def last(success: bool, answer: Answer | None) -> Row:
    """The last columns."""
    seconds = math.nan if answer is None or answer.seconds is None else answer.seconds
    return {"failure": float(not success), "seconds": seconds}
