"""A few entries of every track on a few problems, compared with stored scores: what a change moved."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from rsbench.benchmark.images.store import read_record
from rsbench.benchmark.leaderboard.inputs import prepare_inputs
from rsbench.benchmark.leaderboard.running import run_cards
from rsbench.benchmark.leaderboard.splits import FEATURES
from rsbench.benchmark.leaderboard.submissions import read_submission, write_oracles
from rsbench.benchmark.leaderboard.track import ORACLE, Split, mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import read_dataset_manifest
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.storage.files import read_table

CARD = "leaderboard-smoke"
"""The dataset's, for the tracks of frames."""
ENTRIES = {track.name: track.smoke for track in TRACKS.values() if track.inputs.rendered and track.smoke}
"""By track of frames."""
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
        By track, a row for each entry and problem: method, problem, success, and ``smoke_metrics`` of the track.

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
        given = None if job.track == "points" else data
        table = track_scores(job.track, given, job.entries, problems)
        return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]

    return run


def _serve_child(data: Path | None, problems: int | None) -> Callable[[Job], list[Row]]:
    run = _serve(data, problems)

    def run_or_fail(job: Job) -> list[Row]:
        try:
            return run(job)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run_or_fail


def track_scores(track: str, data: Path | None, entries: Sequence[str], problems: int | None) -> pd.DataFrame:
    """Scores of entries on the first problems of a track, made as anybody's: inputs, answers, marks.

    Raises:
        RsbenchError: no such dataset or entry, or no such number of problems.
    """
    split, tables = TRACKS[track].split(data), list[pd.DataFrame]()
    if data is None:
        problems = PROBLEMS if problems is None else problems
        if not 1 <= problems <= len(split.truths):
            raise RsbenchError(f"--problems {problems}: must lie in [1, {len(split.truths)}]")
    split = replace(split, truths=split.truths[:problems])
    with tempfile.TemporaryDirectory() as folder:
        inputs = Path(folder) / "inputs"
        prepare_inputs(split, data, None, inputs)
        for name, path in _answers(split, entries, inputs, Path(folder)):
            scores = mark(read_submission(path, split), split).assign(method=name)
            tables.append(scores[[*_NAMES, *split.track.smoke_metrics]])
    return pd.concat(tables, ignore_index=True)


def _answers(split: Split, entries: Sequence[str], inputs: Path, work: Path) -> Iterator[tuple[str, Path]]:
    """Entries with their files of answers; cards run in this process."""
    oracles = {ORACLE, *(name for name, _ in split.track.oracles)}
    cards = [name for name in entries if name not in oracles]
    if cards:
        yield from zip(cards, run_cards(split, cards, inputs, work, workers=0, features=FEATURES), strict=True)
    if len(cards) < len(entries):
        paths = write_oracles(split, work / "oracles")
        yield from ((path.parent.name, path) for path in paths if path.parent.name in entries)


def hashes_of_frames(data: Path) -> dict[str, str]:
    """Of each sequence of a dataset, a hash of its images and depth maps."""
    manifest, found = read_dataset_manifest(data), dict[str, str]()
    for name in manifest.sequences:
        pictures = [
            f"{path} {each.sha256}\n"
            for path, each in sorted(manifest.files.items())
            if path.startswith(f"{name}/") and path.endswith((".png", ".exr"))
        ]
        found[name] = hashlib.sha256("".join(pictures).encode()).hexdigest()
    return found


# Stored scores


def read_scores(folder: Path, track: str = "points") -> pd.DataFrame:
    """What ``run_smoke`` gave of a track when it was stored.

    Raises:
        RsbenchError: it is not there, or damaged.
    """
    return read_table(
        folder / file_of(track), _NAMES, TRACKS[track].smoke_metrics, dtype={"method": str, "problem": str}
    )


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
        for key in TRACKS[track].smoke_metrics:
            if not _equal(row[key], old[key], tolerance):
                yield f"{name}: {key} = {row[key]:.6g}, stored {old[key]:.6g}"


def _equal(a: float, b: float, tolerance: float) -> bool:
    return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=tolerance, abs_tol=_NOTHING)
