"""Evaluation of a dataset: predictions, then scores, then their provenance."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from rsbench.benchmark.images.plan import EvaluationOptions, Places, Plan, make_plan
from rsbench.benchmark.images.predict import Bench, Step, prediction_steps
from rsbench.benchmark.images.score import AFTER, KEYS, TABLES, Row, Scorer, kept_scores
from rsbench.benchmark.provenance import dataset_record, provenance
from rsbench.benchmark.scoring import (
    METRICS,
    Case,
    Column,
    DepthCase,
    ImageCase,
    Metric,
    PoseCase,
    load_metrics,
    score,
)
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_pairs
from rsbench.jobs.isolation import ONE_THREAD, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs
from rsbench.pipeline.isolated_chain import Caller, Isolation
from rsbench.pipeline.isolated_components import SolverRunner, as_entry_failure
from rsbench.storage.files import HASHES, FileHashes, read_json, read_table, write_json, write_table
from rsbench.storage.work_folder import work_folder


class _Isolated(Metric):
    def __init__(self, original: Metric, call: Caller) -> None:
        self.case, self._columns, self._call = original.case, original.columns, call

    @property
    def columns(self) -> tuple[Column, ...]:
        return self._columns

    def compute(self, case: Case) -> Mapping[str, float]:
        found: Mapping[str, float] = self._call(case)
        return found


# In the child


def _serve_metric(place: str) -> Callable[..., object]:
    with as_entry_failure():
        (entry,) = load_metrics([place])

    def answer(case: Case) -> dict[str, float]:
        with as_entry_failure():
            return score(entry, case)

    return answer


class Job(NamedTuple):
    """The work of one call of a child process for a sequence: one further motion, all predictions, or the
    scores."""

    sequence: str
    solver: str = ""
    """Solver whose motion with the samples ``seed`` is estimated."""
    seed: int = 0
    predict: bool = False
    score: bool = False

    def __str__(self) -> str:
        return f"{self.sequence}, {self.solver}, seed {self.seed}" if self.solver else self.sequence


class Scores(NamedTuple):
    """Scores of one sequence."""

    rows: dict[str, list[Row]]
    """Rows of each table."""
    stale: list[str]
    """Stored predictions that are not current, and not scored."""


def isolated(plan: Plan, isolation: Isolation) -> Plan:
    """Return the plan with components of other packages run in child processes."""
    metrics = (isolation.wrap(METRICS, metric, _serve_metric, (), _Isolated) for metric in plan.metrics)
    return replace(plan, chain=isolation.chain(plan.chain), metrics=tuple(metrics))


def repeats_of(plan: Plan) -> list[Job]:
    """Return the motions planned in addition to the first one of each solver; slow ones are started early."""
    return [
        Job(sequence, solver.name, seed)
        for solver in sorted(plan.solvers, key=lambda entry: entry.name, reverse=True)
        if solver.name in plan.solver_names
        for sequence in sorted(plan.sequence_names)
        for seed in range(1, plan.seeds)
    ]


def _shared_words(value: Any) -> Any:
    """Share equal strings in JSON-ready data, so that the rows of many sequences fit in memory."""
    if isinstance(value, dict):
        return {_shared_words(k): _shared_words(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_shared_words(each) for each in value]
    return sys.intern(value) if isinstance(value, str) else value


def _serve(
    dataset: Path, out: Path, options: EvaluationOptions
) -> Callable[[Job], tuple[dict[str, Any] | None, list[str]]]:
    """Return the function that runs jobs in a child process: it returns fields of ``Scores`` and new hashes."""
    use_one_thread()
    evaluation = open_evaluation(dataset, out, options)
    sequences = {each.name: each for each in evaluation.sequences}
    entries = {entry.name: entry for entry in evaluation.plan.solvers}
    runner, plan = SolverRunner(single_thread=True), isolated(evaluation.plan, Isolation())  # end with the process
    hashes = FileHashes(dataset, out / HASHES)  # empty after --force, which clears them in the parent

    def run(job: Job) -> tuple[dict[str, Any] | None, list[str]]:
        bench = Bench(sequences[job.sequence], evaluation.folder(job.sequence), plan, runner, hashes.sha256)
        if job.solver:
            bench.move(entries[job.solver], job.seed)
        if job.predict:
            bench.predict(lambda word: None)
        scores = evaluation.scored(bench.places, plan)._asdict() if job.score else None
        return scores, hashes.taken()

    return run


_CASES = {"pose": PoseCase, "depth": DepthCase, "correction": ImageCase}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """An evaluation that is ready to run."""

    dataset: Path
    out: Path
    options: EvaluationOptions
    sequences: list[Sequence]
    plan: Plan

    @property
    def steps(self) -> int:
        """Number of progress reports of ``run``."""
        own = len(self.plan.sequence_names) * prediction_steps(self.plan)
        return own + len(repeats_of(self.plan)) + len(self.sequences)

    def run(self, command: str, step: Step, workers: Workers = 1) -> list[str]:
        """Predict and score; writes predictions/, scores/*.csv and provenance.json below ``out``.

        Predictions made before from the same data, components and options are kept and scored, whichever run made
        them. ``workers`` predict and score one sequence each; 1 is this process, with all its threads.

        Returns:
            Stored predictions that are not current: they are neither scored nor deleted.

        Raises:
            RsbenchError: the dataset is damaged, a stored prediction is of another entry of the same name, or
                another command works in ``out``.
        """
        with work_folder(self.out):
            hashes = FileHashes(self.dataset, self.out / HASHES, self.options.rehash)
            scored = self._here(hashes, step) if workers == 1 else self._apart(hashes, step, workers)
            found = [scored[sequence.name] for sequence in self.sequences]
            for table in TABLES:
                rows = [row for scores in found for row in scores.rows[table]]
                write_table(
                    self.out / "scores" / f"{table}.csv", pd.DataFrame(rows, columns=columns_of(table, self.plan))
                )
            hashes.flush()
            write_json(self.out / "scores" / "columns.json", described_columns(self.plan))
            write_json(self.out / "provenance.json", self._provenance(command))
        return [name for scores in found for name in scores.stale]

    def _here(self, hashes: FileHashes, step: Step) -> dict[str, Scores]:
        """Return scores by sequence name; this process does all the work except repeated motions."""
        scored = {}
        with SolverRunner() as runner, Isolation() as isolation:
            plan = isolated(self.plan, isolation)
            for sequence in self.sequences:
                if sequence.name in plan.sequence_names:
                    Bench(sequence, self.folder(sequence.name), plan, runner, hashes.sha256).predict(step)
            self._repeat(hashes, step, os.cpu_count() or 1)
            for sequence in self.sequences:
                places = Places(sequence, self.folder(sequence.name), plan.chain, hashes.sha256)
                scored[sequence.name] = self.scored(places, plan)
                step(f"{sequence.name}: scores")
        return scored

    def _apart(self, hashes: FileHashes, step: Step, workers: Workers) -> dict[str, Scores]:
        """Return scores by sequence name, computed by ``workers``."""
        due = self.plan.sequence_names
        if repeats_of(self.plan):  # repeats need the matches, and are scored with the others
            self._done([Job(name, predict=True) for name in sorted(due)], hashes, step, workers)
            self._repeat(hashes, step, workers)
            due = frozenset[str]()
        jobs = [Job(each.name, predict=each.name in due, score=True) for each in self.sequences]
        jobs.sort(key=lambda job: not job.predict)  # long jobs start early
        return self._done(jobs, hashes, step, workers)

    def _repeat(self, hashes: FileHashes, step: Step, workers: Workers) -> None:
        """Estimate the motions of ``repeats_of`` that are not current, from the matches that are stored."""
        entries, todo = {entry.name: entry for entry in self.plan.solvers}, list[Job]()
        sequences = {each.name: each for each in self.sequences}
        with SolverRunner() as runner:
            for job in repeats_of(self.plan):
                folder = self.folder(job.sequence)
                bench = Bench(sequences[job.sequence], folder, self.plan, runner, hashes.sha256)
                if bench.stands(bench.places.motion(entries[job.solver], job.seed)):
                    step(f"{job.sequence}: {job.solver}")
                else:
                    todo.append(job)
        if todo:
            hashes.flush()
            self._done(todo, hashes, step, workers)

    def _done(self, jobs: list[Job], hashes: FileHashes, step: Step, workers: Workers) -> dict[str, Scores]:
        """Run jobs in single-threaded child processes; return the scores of the jobs that compute scores.

        Raises:
            RsbenchError: a dataset, a stored prediction or an entry is invalid.
            LostJobsError: see ``finished_jobs``.
        """
        scored = {}
        done = finished_jobs(_serve, jobs, workers, ONE_THREAD, self.dataset, self.out, self.options)
        with closing(done) as found:
            for job, (scores, lines) in found:
                hashes.append(lines)
                for _ in range(prediction_steps(self.plan) if job.predict else 0):
                    step(job.sequence)
                if job.solver:
                    step(f"{job.sequence}: {job.solver}")
                if scores is not None:
                    scored[job.sequence] = Scores(**_shared_words(scores))
                    step(f"{job.sequence}: scores")
        return scored

    def scored(self, places: Places, plan: Plan) -> Scores:
        """Compute the scores of the stored current predictions of a sequence."""
        scorer = Scorer(places, plan, kept_scores(self.out, places.sequence.name), self.options.rehash)
        scorer.score()
        return Scores(scorer.rows, scorer.stale)

    def folder(self, sequence: str) -> Path:
        """Folder of the predictions of a sequence."""
        return self.out / "predictions" / sequence

    def _provenance(self, command: str) -> dict[str, object]:
        chain = self.plan.chain
        chosen = {name: getattr(chain, name) for name in ("features", "corrector", "solver", "matcher")}
        return provenance(
            command,
            **dataset_record(self.dataset),
            seed=chain.seed,
            seeds=self.plan.seeds,
            solvers={entry.name: entry.parameters for entry in self.plan.solvers},
            correction={name: entry.name for name, entry in chosen.items()},
            parameters={entry.name: entry.parameters for entry in chosen.values()},
            metrics=[metric.name for metric in self.plan.metrics],
        )


def open_evaluation(dataset: Path, out: Path, options: EvaluationOptions) -> Evaluation:
    """Read the dataset and load every component; makes the folders.

    Raises:
        RsbenchError: the dataset cannot be read, a component is wrong, or ``out`` cannot be written.
    """
    sequences = read_pairs(dataset)
    plan = make_plan(options, sequences)
    try:
        (out / "scores").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RsbenchError(f"{out}: cannot be written: {error.strerror}; choose another --out") from error
    return Evaluation(dataset=dataset, out=out, options=options, sequences=sequences, plan=plan)


def described_columns(plan: Plan) -> dict[str, list[dict[str, object]]]:
    """Descriptions of the metrics' columns of each table, ready for JSON; an infinite worst value is a text."""
    return {
        table: [
            {
                "name": column.name,
                "heading": column.heading,
                "unit": column.unit,
                "better": column.better,
                "worst": column.worst if math.isfinite(column.worst) else str(column.worst),
                "metric": metric.name,
            }
            for metric in plan.metrics
            if metric.component.case is case
            for column in metric.component.columns
        ]
        for table, case in _CASES.items()
    }


def columns_of(table: str, plan: Plan) -> list[str]:
    """Columns of a score file, in their order."""
    found = [c.name for m in plan.metrics if m.component.case is _CASES.get(table) for c in m.component.columns]
    return [*KEYS[table], *found, *AFTER.get(table, ())]


def read_headings(out: Path, table: str) -> dict[str, str]:
    """Headings of the metrics' columns of a score file, by their names.

    Raises:
        RsbenchError: columns.json is not there, or damaged.
    """
    path = out / "scores" / "columns.json"
    columns = read_json(path).get(table)
    try:
        return {str(column["name"]): str(column["heading"]) for column in columns}  # pyrefly: ignore[not-iterable]
    except (KeyError, TypeError) as error:
        raise RsbenchError(f"{path}: {table!r} must be a list of columns with name and heading") from error


def read_scores(out: Path, table: str) -> pd.DataFrame:
    """One of ``TABLES`` of an evaluation, as ``columns_of`` names its columns.

    Raises:
        RsbenchError: the evaluation is not there, or its files are damaged.
    """
    path = out / "scores" / f"{table}.csv"
    if not path.is_file():
        raise RsbenchError(f"{path}: no such scores; make them with: rsbench evaluate DIR --out {out}")
    numbers = read_headings(out, table) if table in _CASES else {}
    columns = (*KEYS[table], *AFTER.get(table, ()))
    return read_table(path, columns, numbers, keep_default_na=False, na_values=[""])
