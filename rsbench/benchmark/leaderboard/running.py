"""Running cards: predictions first, each kept as soon as it is made; scores come after, and run no method.

A method sees what is exported, and nothing else. Each answer of a card is a file whose identity says from which
method, inputs, options and code it came: what is current is kept, so a killed run goes on where it was. Cards of
other packages run in processes of their own with a limit of time; what they do wrong is a failure with the reason.
"""

from __future__ import annotations

import hashlib
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import pandas as pd

from rsbench.benchmark.images.store import identity_of, read_record
from rsbench.benchmark.leaderboard.inputs import read_inputs
from rsbench.benchmark.leaderboard.submissions import submission_text, template_text, truth_text
from rsbench.benchmark.leaderboard.track import (
    LARGEST,
    LEAST_D,
    ORACLE,
    Limits,
    Row,
    Split,
    Step,
    Submission,
    Track,
)
from rsbench.benchmark.provenance import numeric_version, processor
from rsbench.benchmark.simulated.trials import Information, enter
from rsbench.capture.model_choice import AUTO
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs, run_jobs
from rsbench.pipeline.answer import Extra, solve_problem
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.base import SolverEntry, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import sha256, write_bytes, write_json
from rsbench.storage.untrusted_files import check_name

_EXTRAS: tuple[Extra, ...] = ("covariance",)
CHOOSES = "rs-stereo-auto"
"""Entry of the recommended solver under the motion model that the matches prefer: what ``rsbench solve`` does."""
Job = TypeVar("Job")
_USES: dict[Information, tuple[str, ...]] = {
    "left pairs": ("left",),
    "left and right pairs": ("left", "right"),
    "linked pairs": ("left", "right", "links"),
    "tracks": ("left", "right", "links"),
}
_KEPT = (
    "name",
    "success",
    "reason",
    "w",
    "d",
    "metric",
    "reference_point",
    "direction_known",
    "covariance",
    "seconds",
)
"""Of an answer of ``solve_problem``."""


class _Job(NamedTuple):
    card: str
    first: int
    problems: int
    path: Path

    def __str__(self) -> str:
        return f"{self.card}, problems {self.first} to {self.first + self.problems - 1}"


class SolverTrack(Track):
    """A track whose cards are solvers, and whose answers are lines of numbers."""

    example: ClassVar[Mapping[str, Any]]
    """An answer for a template."""
    also_uses: ClassVar[tuple[str, ...]] = ()
    """What is used of every entry beside its solver."""

    @abstractmethod
    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        """What a solver says of a problem, as a line of a submission."""

    def check_entry(self, entry: SolverEntry) -> None:
        """Raises RsbenchError when a solver does not fit the track."""
        try:
            check_name(entry.name)
            self.check_uses(uses_of(entry, self.gives_readout))
        except ValueError as error:
            raise RsbenchError(f"solver {entry.name!r}: {error}") from error

    def load(self, cards: Sequence[str]) -> None:
        load_entries(cards, self)

    def entry_of(self, card: str) -> SolverEntry:
        """Raises RsbenchError: no such solver."""
        return load_solver_entry(card)

    def assumed(self, entry: SolverEntry) -> str:
        """The motion model that a header names."""
        model = entry.solver.spec.motion_model
        return model if model in ("linear", "twist") else "linear"

    def steps(self, cards: Sequence[str], split: Split, limits: Limits) -> int:
        return len(cards) * -(-len(split.truths) // limits.chunk)

    def run(self, cards: Sequence[str], split: Split, inputs: Path, work: Path, **options: Any) -> list[Path]:
        return run_cards(self, cards, split, inputs, work, **options)

    @abstractmethod
    def rows(self, submission: Submission, split: Split) -> list[Row]:
        """Scores of each problem."""

    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Path | None
    ) -> list[pd.DataFrame | RsbenchError]:
        return [pd.DataFrame(self.rows(submission, split)) for submission in submissions]

    def write_template(self, split: Split, path: Path) -> None:
        write_bytes(path, template_text(split, self.example).encode())

    def write_truth(self, split: Split, folder: Path, file: str = "predictions.jsonl") -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / file, truth_text(split).encode())
        return folder / file

    def oracles(self, split: Split, folder: Path) -> Iterator[Path]:
        yield self.write_truth(split, folder / ORACLE)


def uses_of(entry: SolverEntry, readout: bool = True) -> tuple[str, ...]:
    """What a solver uses, by what it declares, of a track that gives the ``readout`` ratio or not."""
    rolling = entry.solver.spec.shutter == "rolling" and readout
    return _USES[enter(entry).information] + (("readout",) if rolling else ())


def load_entries(cards: Sequence[str], track: SolverTrack) -> dict[str, SolverEntry]:
    """Solvers by their cards.

    Raises:
        RsbenchError: no such solver, or it uses what the track does not give.
    """
    entries = {card: track.entry_of(card) for card in cards}
    for entry in entries.values():
        track.check_entry(entry)
    return entries


def run_cards(
    track: SolverTrack,
    cards: Sequence[str],
    split: Split,
    inputs: Path,
    work: Path,
    *,
    workers: Workers = 1,
    limits: Limits = Limits(),  # noqa: B008  it is a constant
    step: Callable[[str], None] = lambda word: None,
) -> list[Path]:
    """Run solvers on exported inputs; returns for each a file of predictions in ``work``, ready to be submitted.

    Raises:
        RsbenchError: no such solver; it uses what the protocol does not give; processes died each time over
            the same problems: what is done is kept.
    """
    entries = load_entries(cards, track)
    data, count = sha256(inputs / "problems.jsonl"), len(split.truths)
    jobs, identities = list[_Job](), dict[str, str]()
    for card, entry in entries.items():
        identities[card] = _identity(entry, split, data, limits)
        for first in range(0, count, limits.chunk):
            path = work / entry.name / f"{identities[card][:16]}-{first:05d}.json"
            if read_record(path) is None:
                jobs.append(_Job(card, first, limits.chunk, path))
            else:
                step(entry.name)
    if jobs:
        warm_up({entry.solver.spec.motion_model for entry in entries.values()})

    def fail(job: _Job, reason: str) -> None:
        name = split.truths[job.first].name
        job.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(job.path, {"answers": [{"name": name, "success": False, "reason": reason}]})

    def limited(job: _Job) -> bool:
        return entries[job.card].built_in  # those of others are limited in processes of their own

    for job in jobs_done(partial(_serve, track), jobs, workers, inputs, limits, fail, limited):
        step(entries[job.card].name)
    return [_joined(entry, split, work, identities[card], limits.chunk) for card, entry in entries.items()]


def jobs_done(
    serve: Callable[..., Callable[[Job], None]],
    jobs: Sequence[Job],
    workers: Workers,
    inputs: Path,
    limits: Limits,
    fail: Callable[[Job, str], None],
    limited: Callable[[Job], bool] = lambda job: True,
) -> Iterator[Job]:
    """Jobs as they are done in child processes of one thread.

    Args:
        serve: see ``IsolatedWorker``; called with ``inputs`` and ``limits``.
        jobs: what is to be done.
        workers: processes; 0: in this one, without limits, for components of ours.
        inputs: folder of the exported inputs.
        limits: with some, a job that takes more, or ends its process, is handed to ``fail`` with the reason.
        fail: keeps that as an answer.
        limited: whether the limit of time is that of the job.

    Raises:
        RsbenchError: see ``finished_jobs``; only without limits.
    """
    if workers == 0:
        run = serve(inputs, limits)
        for job in jobs:
            run(job)
            yield job
        return
    one_thread = dict.fromkeys(THREAD_VARIABLES, "1")
    if limits == Limits():
        with closing(finished_jobs(serve, jobs, workers, one_thread, inputs, limits)) as found:
            yield from (job for job, _ in found)
        return

    def seconds_of(job: Job) -> float:
        return limits.seconds if limits.seconds is not None and limited(job) else math.inf

    outcomes = run_jobs(
        serve, jobs, workers, one_thread, inputs, limits, seconds_of=seconds_of, memory_mb=limits.memory_mb
    )
    with closing(outcomes) as ready:
        for job, outcome in ready:
            if not outcome.success:
                fail(job, outcome.reason[:300])
            yield job


def _identity(entry: SolverEntry, split: Split, data: str, limits: Limits) -> str:
    return identity_of(
        **({} if limits == Limits() else {"limits": list(limits)}),
        source=numeric_version(),
        solver=entry.key,
        options=entry.options.deciding,
        robust=asdict(RobustOptions()),
        protocol=split.track.id,
        data=data,
    )


def header_of(entry: SolverEntry, split: Split) -> dict[str, Any]:
    """The first line of a solver's submission."""
    spec, track = entry.solver.spec, split.track
    assert isinstance(track, SolverTrack)
    return {
        "protocol": split.track.id,
        "split": split.name,
        "method": entry.name,
        "uses": (*uses_of(entry, track.gives_readout), *track.also_uses),
        "description": entry.description[:300],
        "paper": spec.reference[:300],
        "code": "rsbench" if entry.built_in else "",
        "hardware": f"{processor()}, 1 thread"[:300],
        "motion_model": track.assumed(entry),
    }


def _joined(entry: SolverEntry, split: Split, work: Path, identity: str, chunk: int) -> Path:
    """The chunks of a solver as one submission."""
    answers: list[dict[str, Any]] = []
    for first in range(0, len(split.truths), chunk):
        record = read_record(work / entry.name / f"{identity[:16]}-{first:05d}.json") or {}
        answers += record.get("answers", [])
    path = work / entry.name / "predictions.jsonl"
    write_bytes(path, submission_text(header_of(entry, split), iter(answers)).encode())
    return path


# In the child


def _serve(track: SolverTrack, inputs: Path, limits: Limits) -> Callable[[_Job], None]:
    use_one_thread()
    warm_up()
    runner = SolverRunner(time_limit_s=limits.seconds, single_thread=True, memory_mb=limits.memory_mb)
    problems = read_inputs(inputs, track)

    def run(job: _Job) -> None:
        try:
            entry = track.entry_of(job.card)
            answers = [
                track.answer(problem, entry, runner) for problem in problems[job.first : job.first + job.problems]
            ]
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error
        job.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(job.path, {"answers": answers})

    return run


def seed_of_answer(problem: Problem, entry: SolverEntry) -> int:
    """Samples are drawn by the names of problem and solver: they do not depend on the order or on the workers."""
    text = f"leaderboard {problem.name} {entry.name}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def answer_problem(problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
    """What a solver says of a problem, as a line of a submission."""
    seed, model = seed_of_answer(problem, entry), AUTO if entry.name == CHOOSES else None
    found = solve_problem(problem, entry, RobustOptions(), runner, seed, _EXTRAS, model)
    kept = {key: found[key] for key in _KEPT}
    if found["success"]:
        length = math.hypot(*found["d"])
        if max(length, *map(abs, found["w"])) > LARGEST:
            return {"name": problem.name, "success": False, "reason": f"w or d goes beyond {LARGEST:g}"}
        if length < LEAST_D:
            kept["d"] = [0.0, 0.0, 0.0]  # the rig stands still
    return {**kept, "seconds": round(found["seconds"], 6), "reason": str(found["reason"])[:300]}


# Second protocols: several laws of motion, scores that separate, ratios that nobody guesses, one entry each.


class Choosing(SolverTrack):
    """A track whose entries assume a law of motion, or choose one."""

    def entry_of(self, card: str) -> SolverEntry:
        if card != CHOOSES:
            return load_solver_entry(card)
        entry = load_solver_entry("rs-stereo-refined")
        words = "The recommended solver under the motion model that the matches of the problem prefer"
        return replace(entry, name=CHOOSES, description=words, key=f"{entry.key} {AUTO}")

    def assumed(self, entry: SolverEntry) -> str:
        if entry.name == CHOOSES:
            return "chosen"
        spec = entry.solver.spec
        return "none" if spec.shutter == "global" else spec.motion_model
