"""Motions by other samples of the robust loop, over processes: how much a solver's result is chance."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from rsbench.benchmark.images.plan import EvaluationOptions, Plan, make_plan
from rsbench.benchmark.images.predict import Bench, Step
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_pairs
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.storage.files import HASHES, FileHashes

Job = tuple[str, str, int]
"""Names of sequence and solver, and the number of the samples."""


def repeats_of(plan: Plan) -> list[Job]:
    """What is planned beside the first motion of each solver; what takes long is begun early."""
    return [
        (sequence, solver.name, seed)
        for solver in sorted(plan.solvers, key=lambda entry: entry.name, reverse=True)
        if solver.name in plan.solver_names
        for sequence in sorted(plan.sequence_names)
        for seed in range(1, plan.seeds)
    ]


def repeat(
    dataset: Path,
    out: Path,
    options: EvaluationOptions,
    plan: Plan,
    sequences: list[Sequence],
    hashes: FileHashes,
    step: Step,
    workers: Workers,
) -> None:
    """Make the motions of ``repeats_of`` that are not current, with the matches that are stored.

    Raises:
        RsbenchError: a solver cannot be loaded.
        LostJobsError: see ``finished_jobs``.
    """
    with SolverRunner() as runner:
        benches = {s.name: Bench(s, out / "predictions" / s.name, plan, runner, hashes.sha256) for s in sequences}
        entries = {entry.name: entry for entry in plan.solvers}
        todo = []
        for sequence, solver, seed in repeats_of(plan):
            bench = benches[sequence]
            if bench.stands(bench.places.motion(entries[solver], seed)):
                step(f"{sequence}: {solver}")
            else:
                todo.append((sequence, solver, seed))
    if not todo:
        return
    hashes.flush()
    processes = (os.cpu_count() or 1) if workers == 1 else workers
    one_thread = dict.fromkeys(THREAD_VARIABLES, "1")
    with closing(finished_jobs(_serve, todo, processes, one_thread, dataset, out, options, name=_name)) as found:
        for (sequence, solver, _), _ in found:
            step(f"{sequence}: {solver}")


def _name(job: Job) -> str:
    sequence, solver, seed = job
    return f"{sequence}, {solver}, seed {seed}"


def _serve(dataset: Path, out: Path, options: EvaluationOptions) -> Callable[[Job], None]:
    """What repeats, in a child."""
    use_one_thread()
    try:
        sequences = read_pairs(dataset)
        plan = make_plan(options, sequences)
    except RsbenchError as error:
        raise EntryFailure(str(error)) from error
    runner = SolverRunner(single_thread=True)  # as long as this process
    hashes = FileHashes(dataset, out / HASHES)
    benches = {s.name: Bench(s, out / "predictions" / s.name, plan, runner, hashes.sha256) for s in sequences}
    entries = {entry.name: entry for entry in plan.solvers}

    def run(job: Job) -> None:
        sequence, solver, seed = job
        try:
            benches[sequence].move(entries[solver], seed)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run
