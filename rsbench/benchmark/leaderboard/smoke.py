"""A few entries of every track on a few problems, compared with stored scores: what a change moved."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from rsbench.benchmark.images.store import read_record
from rsbench.benchmark.leaderboard.marking import mark
from rsbench.benchmark.leaderboard.protocols import PROTOCOLS
from rsbench.benchmark.leaderboard.running import answer_problem, header_of, load_entries
from rsbench.benchmark.leaderboard.smoke_tracks import metrics_of, track_scores
from rsbench.benchmark.leaderboard.splits import PUBLIC_SEED, points_split, simulated_problem
from rsbench.benchmark.leaderboard.submissions import read_submission, submission_text
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.storage.files import read_table, write_bytes

PROBLEMS = 6
"""Of points; a minute for all solvers of ours."""
_NAMES = ("method", "problem", "success")
_SAME, _NOTHING = 1e-4, 1e-7
"""Relative and absolute difference of equal scores. The same code on the same machine gives the same digits; a
processor that sums in another order changes the last ones, and now and then a choice of RANSAC: with OpenBLAS and
Numba told to use no AVX, 113 of 114 answers agreed so far, and one was another."""
OTHER_FRAMES = 0.15
"""Relative difference of equal scores where the frames are others: twice the largest that was seen. Rendered
with AVX2 in place of AVX-512, up to 0.09 % of the values of these frames were others, by up to 26 codes, and no
depth: 56 of 57 answers kept their scores to 7.3 %. One, of the corrector zhuang, was better by 4 dB, by another
choice of RANSAC."""
Row = dict[str, Any]


class Job(NamedTuple):
    """Entries of a track that one process runs."""

    track: str
    entries: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.track}: {', '.join(self.entries)}"


def file_of(track: str) -> str:
    """Where the scores of a track are stored."""
    return "scores.csv" if track == "points" else f"{track}.csv"


def record_of(track: str) -> str:
    """Where is stored how they came about."""
    return "provenance.json" if track == "points" else f"{track}.json"


def run_smoke(
    jobs: Sequence[Job],
    data: Path | None = None,
    problems: int | None = None,
    workers: int = 1,
    step: Callable[[str], None] = lambda word: None,
) -> dict[str, pd.DataFrame]:
    """Scores of entries on the first problems of their tracks; no stored prediction is used.

    Args:
        jobs: what to run.
        data: dataset of the tracks of frames.
        problems: how many; by default ``PROBLEMS`` of points, and all sequences of the dataset.
        workers: processes of one thread; with 1 it is this one.
        step: called after each job.

    Returns:
        By track, a row for each entry and problem: method, problem, success, and ``metrics_of`` the track.

    Raises:
        RsbenchError: no such entry, or no such number of problems.
    """
    rows: dict[str, list[Row]] = {job.track: [] for job in jobs}
    if workers == 1:
        run = _serve(data, problems)
        done = ((job, run(job)) for job in jobs)
    else:
        done = finished_jobs(_serve_child, jobs, workers, dict.fromkeys(THREAD_VARIABLES, "1"), data, problems)
    with closing(done) as found:
        for job, scores in found:
            rows[job.track] += scores
            step(job.track)
    order = {track: [name for job in jobs if job.track == track for name in job.entries] for track in rows}
    return {
        track: pd.DataFrame(sorted(found, key=lambda row: order[track].index(row["method"])))
        for track, found in rows.items()
    }


def _serve(data: Path | None, problems: int | None) -> Callable[[Job], list[Row]]:
    use_one_thread()

    def run(job: Job) -> list[Row]:
        if job.track == "points":
            table = points_scores(job.entries, PROBLEMS if problems is None else problems)
        else:
            assert data is not None
            table = track_scores(job.track, data, job.entries, problems)
        return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]

    return run


def _serve_child(data: Path | None, problems: int | None) -> Callable[[Job], list[Row]]:
    run = _serve(data, problems)

    def told(job: Job) -> list[Row]:
        try:
            return run(job)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return told


def points_scores(cards: Sequence[str], problems: int = PROBLEMS) -> pd.DataFrame:
    """Scores of solvers on the first problems of the public split of ``points``.

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
        for card, entry in load_entries(cards, split.protocol).items():
            answers = (answer_problem(problem, entry, runner) for problem in given)
            path = Path(folder) / "predictions.jsonl"
            write_bytes(path, submission_text(header_of(entry, split), answers).encode())
            scores = mark(read_submission(path, split), split)
            tables.append(scores.assign(method=card)[[*_NAMES, *metrics_of("points")]])
    return pd.concat(tables, ignore_index=True)


# Stored scores


def read_scores(folder: Path, track: str = "points") -> pd.DataFrame:
    """What ``run_smoke`` gave of a track when it was stored.

    Raises:
        RsbenchError: it is not there, or damaged.
    """
    return read_table(folder / file_of(track), _NAMES, metrics_of(track), dtype={"method": str, "problem": str})


def other_frames(folder: Path, track: str, frames: dict[str, str]) -> list[str]:
    """Problems whose pictures are not those of the stored scores; ``frames`` is of ``hashes_of_frames``."""
    inputs = (read_record(folder / record_of(track)) or {}).get("inputs")
    stored = inputs.get("frames") if isinstance(inputs, dict) else None
    return [name for name, digest in frames.items() if not isinstance(stored, dict) or stored.get(name) != digest]


def differences(
    track: str, found: pd.DataFrame, stored: pd.DataFrame, others: Collection[str] = ()
) -> Iterator[str]:
    """A line for each score of ``found`` that is not the stored one: track, problem, entry, metric, both values.

    Args:
        others: problems whose frames are not those of the stored scores, see ``OTHER_FRAMES``.
    """
    known = {(row["method"], row["problem"]): row for row in stored.to_dict("records")}
    for row in found.to_dict("records"):
        name = f"{track}, {row['problem']}, {row['method']}"
        old = known.get((row["method"], row["problem"]))
        if old is None:
            yield f"{name}: has no stored scores"
            continue
        if bool(row["success"]) != bool(old["success"]):
            yield f"{name}: success = {row['success']}, stored {old['success']}"
            continue
        tolerance = OTHER_FRAMES if row["problem"] in others else _SAME
        for key in metrics_of(track):
            if not _equal(row[key], old[key], tolerance):
                yield f"{name}: {key} = {row[key]:.6g}, stored {old[key]:.6g}"


def _equal(a: float, b: float, tolerance: float) -> bool:
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=tolerance, abs_tol=_NOTHING)
