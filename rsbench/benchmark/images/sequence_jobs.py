"""Sequences of an evaluation in child processes: what is predicted of each and its scores are one job.

A prediction is kept on disk when it is whole, so a job whose process was killed goes on there when it is tried
again. Scores are a job's answer: the parent only collects them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rsbench.benchmark.images.kept_scores import KeptScores, Row, kept_scores_file
from rsbench.benchmark.images.plan import EvaluationOptions, Places, Plan, make_plan
from rsbench.benchmark.images.predict import Bench
from rsbench.benchmark.images.score import Scorer
from rsbench.benchmark.isolated_metric import isolated_metrics
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import read_pairs
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs
from rsbench.pipeline.isolated_components import Isolation, SolverRunner
from rsbench.storage.files import HASHES, FileHashes


@dataclass(frozen=True, kw_only=True)
class SequenceJob:
    """What is to be done of one sequence."""

    sequence: str
    predict: bool
    score: bool


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Of one sequence."""

    rows: dict[str, list[Row]]
    """Of each table."""
    stale: list[str]
    """Predictions on disk that are not current, and not scored."""

    @classmethod
    def of(cls, places: Places, plan: Plan, kept: KeptScores) -> Scores:
        """What is stored and current; ``kept`` are those of the sequence that were computed before."""
        scorer = Scorer(places, plan, kept)
        scorer.score()
        return cls(rows=scorer.rows, stale=scorer.stale)


def isolated(plan: Plan, isolation: Isolation) -> Plan:
    """The plan with other packages' components in child processes."""
    return replace(plan, chain=isolation.chain(plan.chain), metrics=isolated_metrics(isolation, plan.metrics))


def done_apart(
    dataset: Path,
    out: Path,
    options: EvaluationOptions,
    jobs: Sequence[SequenceJob],
    workers: Workers,
    hashes: FileHashes,
) -> Iterator[tuple[SequenceJob, Scores | None]]:
    """Jobs as they are done, each in a child process of one thread; with the scores that they ask for.

    ``hashes`` gets those of the files that the children have read.

    Raises:
        RsbenchError: a dataset, a stored prediction or an entry is at fault.
        LostJobsError: see ``finished_jobs``.
    """
    one_thread = dict.fromkeys(THREAD_VARIABLES, "1")
    done = finished_jobs(_serve, jobs, workers, one_thread, dataset, out, options, name=lambda job: job.sequence)
    with closing(done) as found:
        for job, (scores, lines) in found:
            hashes.append(lines)
            yield job, None if scores is None else _collected(**scores)


def _collected(rows: dict[str, list[Row]], stale: list[str]) -> Scores:
    """A child's answer; its words are those of others, so that ten thousand answers hold each once."""

    def once(value: Any) -> Any:
        return sys.intern(value) if isinstance(value, str) else value

    shared = {
        table: [{once(k): once(v) for k, v in row.items()} for row in found] for table, found in rows.items()
    }
    return Scores(rows=shared, stale=stale)


def _serve(
    dataset: Path, out: Path, options: EvaluationOptions
) -> Callable[[SequenceJob], tuple[dict[str, Any] | None, list[str]]]:
    """What does the jobs, in a child: the fields of ``Scores``, and the hashes that are new."""
    use_one_thread()
    try:
        sequences = {each.name: each for each in read_pairs(dataset)}
        plan = make_plan(options, list(sequences.values()))
    except RsbenchError as error:
        raise EntryFailure(str(error)) from error
    runner, plan = SolverRunner(single_thread=True), isolated(plan, Isolation())  # as long as this process
    hashes = FileHashes(dataset, out / HASHES)  # the parent has forgotten them, if that was asked

    def run(job: SequenceJob) -> tuple[dict[str, Any] | None, list[str]]:
        sequence, folder = sequences[job.sequence], out / "predictions" / job.sequence
        scores = None
        try:
            if job.predict:
                Bench(sequence, folder, plan, runner, hashes.sha256).predict(lambda word: None)
            if job.score:
                kept = KeptScores(kept_scores_file(out, job.sequence), options.rehash)
                scores = vars(Scores.of(Places(sequence, folder, plan.chain, hashes.sha256), plan, kept))
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error
        return scores, hashes.taken()

    return run
