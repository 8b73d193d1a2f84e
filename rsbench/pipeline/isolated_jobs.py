"""Many independent jobs over child processes that can be stopped at once."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import TypeVar

from rsbench.pipeline.isolation import Cancelled, IsolatedWorker, Outcome, Server

Job = TypeVar("Job")
_Done = tuple[Job, Outcome | BaseException]


def run_jobs(
    factory: Callable[..., Server],
    jobs: Sequence[Job],
    workers: int,
    environment: Mapping[str, str],
    *arguments: object,
) -> Generator[tuple[Job, Outcome], None, None]:
    """Jobs with their outcomes, as they become ready.

    A job whose process ended is tried once more, in a fresh one. When the iterator is closed or an exception
    passes through it, such as Ctrl-C, jobs that wait are dropped and all processes end at once.

    Args:
        factory: see ``IsolatedWorker``; what it returns is called with a job.
        jobs: picklable.
        workers: processes.
        environment, arguments: see ``IsolatedWorker``.

    Raises:
        RuntimeError: rsbench's own code in a child is at fault.
    """
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    done: queue.SimpleQueue[_Done[Job]] = queue.SimpleQueue()
    cancel = threading.Event()
    for job in jobs:
        waiting.put(job)

    def work() -> None:
        with IsolatedWorker(factory, *arguments, environment=environment, cancel=cancel) as worker:
            _work(worker, waiting, done)

    crew = [threading.Thread(target=work, daemon=True) for _ in range(min(workers, len(jobs)))]
    try:
        for member in crew:
            member.start()
        for _ in jobs:
            job, outcome = done.get()
            if isinstance(outcome, BaseException):
                raise outcome
            yield job, outcome
    finally:
        cancel.set()
        for member in crew:
            member.join()


def _work(worker: IsolatedWorker, waiting: queue.SimpleQueue[Job], done: queue.SimpleQueue[_Done[Job]]) -> None:
    """Hand jobs to a process until none waits."""
    while True:
        try:
            job = waiting.get_nowait()
        except queue.Empty:
            return
        try:
            outcome = worker.call(job, limit_s=math.inf)
            if outcome.ended:
                outcome = worker.call(job, limit_s=math.inf)
        except Cancelled:
            return
        except BaseException as error:  # for whoever waits in the other thread
            done.put((job, error))
            return
        done.put((job, outcome))
