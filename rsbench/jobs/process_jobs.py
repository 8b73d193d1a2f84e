"""Many independent jobs over child processes that can be stopped at once."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from typing import Any, TypeVar

from rsbench.core.errors import RsbenchError
from rsbench.jobs.dask_jobs import run_on_cluster
from rsbench.jobs.isolation import Cancelled, IsolatedWorker, Outcome, Server
from rsbench.jobs.workers import TRIES, Cluster, WorkerProcesses, Workers

Job = TypeVar("Job")
_MOST_LOST = 10
"""So many that the next ones will be too: each costs the start of two processes."""
_NAMED = 3
_Done = tuple[Job, Outcome | BaseException]


class LostJobsError(RsbenchError):
    """Jobs whose process ended each time they were tried; what the others did is kept."""

    exit_code = 1


def finished_jobs(
    factory: Callable[..., Server],
    jobs: Sequence[Job],
    workers: Workers,
    environment: Mapping[str, str],
    *arguments: object,
    name: Callable[[Job], str] = str,
) -> Generator[tuple[Job, Any], None, None]:
    """Jobs with their answers, as of ``run_jobs``; ``name`` says in errors which job it was.

    Raises:
        LostJobsError: names jobs whose process ended ``TRIES`` times, when the others are done, or many are.
        RsbenchError: at once, for a job that failed.
    """
    lost = []
    with closing(run_jobs(factory, jobs, workers, environment, *arguments)) as outcomes:
        for job, outcome in outcomes:
            if outcome.ended:
                lost.append(f"{name(job)} ({outcome.reason}, {TRIES} times)")
            elif not outcome.success:
                raise RsbenchError(f"{name(job)}: {outcome.reason}")
            else:
                yield job, outcome.value
            if len(lost) == _MOST_LOST:
                break
    if lost:
        more = f" and {len(lost) - _NAMED} more" if len(lost) > _NAMED else ""
        raise LostJobsError(
            f"not done: {', '.join(lost[:_NAMED])}{more}; perhaps for want of memory: what is done is kept, and "
            "the same command tries again"
        )


def run_jobs(
    factory: Callable[..., Server],
    jobs: Sequence[Job],
    workers: Workers,
    environment: Mapping[str, str],
    *arguments: object,
    seconds_of: Callable[[Job], float] | None = None,
    memory_mb: float | None = None,
) -> Generator[tuple[Job, Outcome], None, None]:
    """Jobs with their outcomes, as they become ready.

    A job whose process ended is tried ``TRIES`` times, in fresh ones; where there are limits, it fails. When the
    iterator is closed or an exception passes through it, such as Ctrl-C, jobs that wait are dropped and all
    processes end at once.

    Args:
        factory: see ``IsolatedWorker``; what it returns is called with a job.
        jobs: picklable.
        workers: processes, or a cluster.
        environment, arguments: see ``IsolatedWorker``.
        seconds_of: limit of time of a job, perhaps infinite; without one there is none.
        memory_mb: of a process; see ``IsolatedWorker``.

    Raises:
        RsbenchError: the cluster cannot be reached.
        RuntimeError: rsbench's own code in a child is at fault.
    """
    processes = WorkerProcesses(
        factory=factory,
        arguments=arguments,
        environment=environment,
        memory_mb=memory_mb,
        tries=TRIES if seconds_of is None and memory_mb is None else 1,
    )
    if isinstance(workers, Cluster):
        yield from run_on_cluster(workers, processes, jobs, seconds_of)
    else:
        yield from _run_here(workers, processes, jobs, seconds_of)


def _run_here(
    workers: int, processes: WorkerProcesses, jobs: Sequence[Job], seconds_of: Callable[[Job], float] | None
) -> Generator[tuple[Job, Outcome], None, None]:
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    done: queue.SimpleQueue[_Done[Job]] = queue.SimpleQueue()
    cancel = threading.Event()
    for job in jobs:
        waiting.put(job)

    def work() -> None:
        with processes.hire(cancel) as worker:
            _work(processes, worker, waiting, done, seconds_of)

    threads = [threading.Thread(target=work, daemon=True) for _ in range(min(workers, len(jobs)))]
    try:
        for member in threads:
            member.start()
        for _ in jobs:
            job, outcome = done.get()
            if isinstance(outcome, BaseException):
                raise outcome
            yield job, outcome
    finally:
        cancel.set()
        for member in threads:
            member.join()


def _work(
    processes: WorkerProcesses,
    worker: IsolatedWorker,
    waiting: queue.SimpleQueue[Job],
    done: queue.SimpleQueue[_Done[Job]],
    seconds_of: Callable[[Job], float] | None,
) -> None:
    """Hand jobs to a process until none waits."""
    while True:
        try:
            job = waiting.get_nowait()
        except queue.Empty:
            return
        try:
            outcome = processes.done_by(worker, job, math.inf if seconds_of is None else seconds_of(job))
        except Cancelled:
            return
        except BaseException as error:  # for whoever waits in the other thread
            done.put((job, error))
            return
        done.put((job, outcome))
