"""Many independent jobs in child processes that can be stopped at once, on this machine or on a Dask cluster.

The cluster is the extra ``rsbench[cluster]``; nothing else imports distributed. A task of the cluster is one job,
done in a child process of the machine's worker as it would be here: a crash ends that child alone, and the job is
tried again there. The scheduler gives the jobs of a worker that dies to others. When the run ends, is stopped or
dies, so do the children that work for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import queue
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from multiprocessing.reduction import ForkingPickler
from typing import Any, TypeVar

from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import Cancelled, IsolatedWorker, Outcome, Server

Job = TypeVar("Job")
TRIES = 3
"""Of a job whose process ended by itself or was killed by others."""


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A Dask scheduler, and how to reach it."""

    address: str
    """``tcp://host:8786``, or the path of a scheduler file, which ends in .json."""


Workers = int | Cluster
"""Processes on this machine, or a cluster."""


@dataclass(frozen=True, kw_only=True)
class WorkerProcesses:
    """Child processes that serve the jobs of one run; picklable, as ``IsolatedWorker`` wants its arguments."""

    factory: Callable[..., Server]
    arguments: tuple[object, ...]
    environment: Mapping[str, str]
    memory_mb: float | None
    tries: int

    def hire(self, cancel: threading.Event) -> IsolatedWorker:
        """One child; ``cancel`` stops it."""
        return IsolatedWorker(
            self.factory,
            *self.arguments,
            environment=self.environment,
            cancel=cancel,
            memory_mb=self.memory_mb,
        )

    def done_by(self, worker: IsolatedWorker, job: object, limit_s: float = math.inf) -> Outcome:
        """A job by one of the workers, tried again where its process ended."""
        for _ in range(self.tries - 1):
            if not (outcome := worker.call(job, limit_s=limit_s)).ended:
                return outcome
        return worker.call(job, limit_s=limit_s)


_MOST_LOST = 10
"""So many that the next ones will be too: each costs the start of two processes."""
_NAMED = 3
_Finished = tuple[Job, Outcome | BaseException]


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
    done: queue.SimpleQueue[_Finished[Job]] = queue.SimpleQueue()
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
    done: queue.SimpleQueue[_Finished[Job]],
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


_CONNECT_S = 30
_DISMISS_S = 5
_WATCH_S = 0.5


def run_on_cluster(
    cluster: Cluster, processes: WorkerProcesses, jobs: Sequence[Job], seconds_of: Callable[[Job], float] | None
) -> Generator[tuple[Job, Outcome], None, None]:
    """Jobs with their outcomes, as they become ready; see ``run_jobs``.

    Raises:
        RsbenchError: there is no such scheduler, it has no worker, or distributed is not installed.
        RuntimeError: rsbench's own code in a child is at fault.
    """
    content = bytes(ForkingPickler.dumps(processes))
    key = hashlib.sha256(content).hexdigest()
    with _connected(cluster) as client:
        from distributed import CancelledError, KilledWorker, as_completed

        try:
            # A task of its own: it is sent to each worker once, and made again where all that had it died.
            shared = client.submit(bytes, content, key=f"rsbench-workers-{key[:16]}")
            futures = {}
            for job in jobs:
                limit = math.inf if seconds_of is None else seconds_of(job)
                futures[client.submit(_do, key, shared, job, limit, pure=False)] = job
            for future in as_completed(list(futures)):
                job = futures.pop(future)
                try:  # it waits again where a worker dies with the result: the scheduler repeats the task then
                    outcome = future.result()
                except KilledWorker as error:
                    reason = f"workers of the cluster died: {error.last_worker.address}"
                    outcome = Outcome(value=None, reason=reason, output="", ended=True)
                except (CancelledError, OSError) as error:
                    if future.status == "error":  # raised by the job, not by fetching its result
                        raise
                    raise RsbenchError(
                        f"--scheduler {cluster.address}: the connection is lost or the scheduler has restarted; "
                        "what is done is kept, and the same command goes on there"
                    ) from error
                future.release()
                yield job, outcome
        finally:
            with contextlib.suppress(Exception):  # a worker that is gone has no children; one may be frozen
                client.cancel(list(futures), force=True)
                client.sync(client.run, _dismiss, key, callback_timeout=_DISMISS_S)


@contextlib.contextmanager
def _connected(cluster: Cluster) -> Iterator[Any]:
    """A client of the scheduler, for as long as the context is open."""
    try:
        from distributed import Client
    except ImportError as error:
        raise RsbenchError("--scheduler needs distributed: pip install 'rsbench[cluster]'") from error
    where = (
        {"scheduler_file": cluster.address} if cluster.address.endswith(".json") else {"address": cluster.address}
    )
    try:
        client = Client(**where, timeout=_CONNECT_S, name="rsbench")
    except (OSError, ValueError) as error:
        raise RsbenchError(f"--scheduler {cluster.address}: {error or 'no answer'}") from error
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            try:
                client.wait_for_workers(1, timeout=_CONNECT_S)
            except TimeoutError as error:
                raise RsbenchError(f"--scheduler {cluster.address}: has no workers") from error
        yield client


# On the machines of the cluster


@dataclass
class _Hired:
    """A child process and the set of workers that it belongs to."""

    processes: WorkerProcesses
    worker: IsolatedWorker


@dataclass
class _ClusterWorkers:
    """The children of this process: idle ones by the set of workers that they belong to."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    idle: dict[str, list[_Hired]] = field(default_factory=dict)

    def take(self, key: str, content: bytes, cancel: threading.Event) -> _Hired:
        """An idle child of a set of workers, or a new one, for one job, which ``cancel`` stops.

        Children of other sets, whose runs are over, end.
        """
        with self.lock:
            others = [hired for name in list(self.idle) if name != key for hired in self.idle.pop(name)]
            own = self.idle.get(key, [])
            found = own.pop() if own else None
        for hired in others:
            hired.worker.close()
        if found is not None:
            found.worker.cancel = cancel
            return found
        processes = ForkingPickler.loads(content)
        return _Hired(processes, processes.hire(cancel))

    def give_back(self, key: str, hired: _Hired) -> None:
        with self.lock:
            self.idle.setdefault(key, []).append(hired)

    def dismiss(self, key: str) -> None:
        with self.lock:
            idle = self.idle.pop(key, [])
        for hired in idle:
            hired.worker.close()


_CREWS = _ClusterWorkers()


def _dismiss(key: str) -> None:
    """End the idle children of a set of workers; those at work end when their task is cancelled."""
    _CREWS.dismiss(key)


def _do(key: str, processes: bytes, job: object, limit_s: float) -> Outcome:
    """One job in a child of this worker of the cluster.

    Raises:
        distributed.Reschedule: the job was stopped. If the scheduler wants it after all, it repeats the task.
    """
    from distributed import Reschedule

    cancel = threading.Event()  # of this job alone: the watch may set it when the child already does the next one
    hired = _CREWS.take(key, processes, cancel)
    with _watched(cancel):
        try:
            outcome = hired.processes.done_by(hired.worker, job, limit_s)
        except BaseException as error:
            hired.worker.close()
            if isinstance(error, Cancelled):
                raise Reschedule from error
            raise
    _CREWS.give_back(key, hired)
    return outcome


@contextlib.contextmanager
def _watched(cancel: threading.Event) -> Iterator[None]:
    """Set an event when the scheduler no longer wants the task of this thread: its run was stopped, or died."""
    from distributed import get_worker

    worker = get_worker()
    task, done = worker.get_current_task(), threading.Event()

    def watch() -> None:
        while not done.wait(_WATCH_S):
            known = worker.state.tasks.get(task)
            if known is None or known.state not in ("executing", "long-running"):
                cancel.set()
                return

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        done.set()
