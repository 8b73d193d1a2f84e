"""Smoke run: score a few entries of every track on a few problems and compare them with stored scores."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from rsbench.benchmark.images.store import read_record
from rsbench.benchmark.leaderboard.inputs import prepare_inputs
from rsbench.benchmark.leaderboard.running import run_cards
from rsbench.benchmark.leaderboard.splits import FEATURES
from rsbench.benchmark.leaderboard.submissions import read_submission, write_oracles
from rsbench.benchmark.leaderboard.track import ORACLE, Row, Split, mark
from rsbench.benchmark.leaderboard.tracks import TRACKS, track_of_name
from rsbench.benchmark.provenance import provenance
from rsbench.components.plugins import offers
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset, steps_of
from rsbench.dataset.sequence import read_dataset_manifest
from rsbench.jobs.isolation import ONE_THREAD, use_one_thread
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.renderers.backend import start_backend
from rsbench.solvers.engine.base import BESIDE, SOLVERS, load_solver_entry
from rsbench.storage.files import read_table, write_json, write_table

CARD = "leaderboard-smoke"
"""Dataset card for the tracks of rendered frames."""
ENTRIES = {track.name: track.smoke for track in TRACKS.values() if track.inputs.rendered and track.smoke}
"""Entries of each track of rendered frames."""
PROBLEMS = 6
"""Default number of problems of the track ``points``: all of rsbench's solvers take a minute."""
_NAMES = ("method", "problem", "success")
_SAME, _NOTHING = 1e-4, 1e-7
"""Relative and absolute tolerance of scores. The same code on the same machine gives identical scores. A processor
that sums in another order changes the last digits, and occasionally the sample that RANSAC selects: without AVX in
OpenBLAS and Numba, 113 of 114 answers agreed within the tolerance."""
OTHER_FRAMES = 0.15
"""Relative tolerance if the frames differ from those of the stored scores: twice the largest observed difference.
With AVX2 instead of AVX-512, up to 0.09 % of the pixel values of a rendered frame changed, by up to 26 levels, and
no depth changed: 56 of 57 scores agreed within 7.3 %. The other one, of the corrector zhuang, improved by 4 dB
because RANSAC selected another sample."""
Bar = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]


class Job(NamedTuple):
    """Entries of a track that one process runs one after the other."""

    track: str
    entries: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.track}: {', '.join(self.entries)}"


def file_of(track: str) -> str:
    """Return the name of the file with the scores of a track."""
    return "scores.csv" if track == "points" else f"{track}.csv"


def record_of(track: str) -> str:
    """Return the name of the file with the provenance of these scores."""
    return "provenance.json" if track == "points" else f"{track}.json"


def own_solvers() -> list[str]:
    """Return the names of rsbench's own solvers that need only the inputs of the track ``points``."""
    own = [offer.name for offer in offers(SOLVERS) if offer.origin == "rsbench"]
    return [name for name in own if not BESIDE.keys() & load_solver_entry(name).solver.spec.minimum]


def chosen_jobs(tracks: Sequence[str] | None, entries: Sequence[str] | None) -> list[Job]:
    """Return the jobs, the longest first; the track ``points`` has one job per solver.

    Raises:
        RsbenchError: a track does not exist, or none of the tracks has an entry.
    """
    chosen = [track_of_name(track).name for track in dict.fromkeys(tracks or TRACKS)]
    jobs, taken = list[Job](), set[str]()
    for track in (*reversed(ENTRIES), "points"):
        if track not in chosen:
            continue
        known = own_solvers() if track == "points" else list(ENTRIES[track])
        if track == "points" and entries is not None:
            others = {name for names in ENTRIES.values() for name in names} - set(known)
            known = [name for name in entries if name not in others]  # also user cards
        names = tuple(name for name in known if entries is None or name in entries)
        taken |= set(names)
        jobs += [Job(track, (name,)) for name in names] if track == "points" else [Job(track, names)][: len(names)]
    if not jobs and entries is None:
        raise RsbenchError(
            f"--track {', '.join(chosen)}: has no smoke run; there are: {', '.join(('points', *ENTRIES))}"
        )
    for name in entries or ():
        if name not in taken:
            raise RsbenchError(f"--entry {name}: is not run on {', '.join(chosen)}")
    return jobs


@contextmanager
def smoke_frames(
    data: Path | None, tracks: Collection[str], problems: int | None, bar: Bar, note: Callable[[str], None]
) -> Iterator[Path | None]:
    """Yield the dataset folder for tracks of frames: ``data``, or a rendered one that is removed afterwards.

    ``bar`` makes a progress bar from a title and a number of steps; ``note`` prints a line.
    """
    if data is not None or set(tracks) <= {"points"}:
        yield data
        return
    card = load_dataset_card(CARD)
    card = card.only([sequence.name for sequence in card.sequence[:problems]])
    if message := start_backend().message:
        note(message)
    with tempfile.TemporaryDirectory() as folder:
        with bar(f"rendering {card.name}", steps_of(card) * len(card.sequence)) as advance:
            generate_dataset(card, Path(folder) / CARD, progress=advance)
        yield Path(folder) / CARD


def run_smoke(
    jobs: Sequence[Job],
    data: Path | None = None,
    problems: int | None = None,
    workers: int = 1,
    step: Callable[[str], None] = lambda word: None,
) -> dict[str, pd.DataFrame]:
    """Score entries on the first problems of their tracks, without stored predictions.

    Args:
        jobs: the jobs to run.
        data: dataset of the tracks of frames.
        problems: number of problems; default: ``PROBLEMS`` for points, and all sequences of the dataset.
        workers: number of single-threaded processes; with 1, jobs run in this process.
        step: called after each job.

    Returns:
        For each track, a table with a row per entry and problem: method, problem, success, and ``smoke_metrics``.

    Raises:
        RsbenchError: an entry does not exist, or the number of problems is invalid.
    """
    rows: dict[str, list[Row]] = {job.track: [] for job in jobs}
    if workers == 1:
        use_one_thread()
        done = ((job, _rows_of(job, data, problems)) for job in jobs)
    else:
        done = finished_jobs(_serve, jobs, workers, ONE_THREAD, data, problems)
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
    return lambda job: _rows_of(job, data, problems)


def _rows_of(job: Job, data: Path | None, problems: int | None) -> list[Row]:
    table = track_scores(job.track, None if job.track == "points" else data, job.entries, problems)
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


def track_scores(track: str, data: Path | None, entries: Sequence[str], problems: int | None) -> pd.DataFrame:
    """Score entries on the first problems of a track by the steps of a board: inputs, answers, scores.

    Raises:
        RsbenchError: the dataset or an entry does not exist, or the number of problems is invalid.
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
    """Yield the entries and their files of answers; cards run in this process."""
    oracles = {ORACLE, *(name for name, _ in split.track.oracles)}
    cards = [name for name in entries if name not in oracles]
    if cards:
        yield from zip(cards, run_cards(split, cards, inputs, work, workers=0, features=FEATURES), strict=True)
    if len(cards) < len(entries):
        paths = write_oracles(split, work / "oracles")
        yield from ((path.parent.name, path) for path in paths if path.parent.name in entries)


def hashes_of_frames(data: Path) -> dict[str, str]:
    """Return a hash of the images and depth maps of each sequence of a dataset."""
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
    """Read the stored table of ``run_smoke`` for a track.

    Raises:
        RsbenchError: the file is missing or damaged.
    """
    path = folder / file_of(track)
    if not path.is_file():
        raise RsbenchError(
            f"{path}: there are no stored scores; a checkout of rsbench has some (--stored names their folder), "
            "and --write stores those of this code"
        )
    return read_table(path, _NAMES, TRACKS[track].smoke_metrics, dtype={"method": str, "problem": str})


def store_scores(
    folder: Path, found: Mapping[str, pd.DataFrame], frames: dict[str, str], command: str
) -> list[Path]:
    """Write the tables of ``run_smoke`` and their provenance with the ``command``; return the files of scores."""
    folder.mkdir(parents=True, exist_ok=True)
    for track, table in found.items():
        inputs = {} if track == "points" else {"frames": frames}
        write_table(folder / file_of(track), table)
        write_json(folder / record_of(track), provenance(command, **inputs))
    return [folder / file_of(track) for track in found]


def other_frames(folder: Path, track: str, frames: dict[str, str]) -> list[str]:
    """Return the problems whose frames differ from those of the stored scores, by ``hashes_of_frames``."""
    inputs = (read_record(folder / record_of(track)) or {}).get("inputs")
    stored = inputs.get("frames") if isinstance(inputs, dict) else None
    return [name for name, digest in frames.items() if not isinstance(stored, dict) or stored.get(name) != digest]


def differences(
    track: str, found: pd.DataFrame, stored: pd.DataFrame, others: Collection[str] = ()
) -> Iterator[str]:
    """Yield a line for each score of ``found`` that differs from the stored one beyond the tolerance.

    Args:
        others: problems whose frames differ from those of the stored scores, see ``OTHER_FRAMES``.
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
