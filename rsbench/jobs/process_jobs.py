"""Runs independent jobs in child processes that can be stopped at once, on this machine or on a Dask cluster.

The cluster needs the extra ``rsbench[cluster]``; no other module imports distributed. Each task of the cluster is
one job, which a Dask worker runs in a child process, as on this machine: a crash ends only that child, and the job
is tried again there. The scheduler reassigns the jobs of a worker that dies. When the run ends, is stopped or
dies, its child processes end too.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import queue
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from typing import Any, TypeVar

from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import Cancelled, IsolatedWorker, Outcome, Server

Job = TypeVar("Job")
TRIES = 3
"""Number of tries of a job whose process ended by itself or was killed from outside."""


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """A Dask scheduler."""

    address: str
    """``tcp://host:8786``, or the path of a scheduler file, which ends in .json."""


Workers = int | Cluster
"""Number of processes on this machine, or a cluster."""


@dataclass(frozen=True, kw_only=True)
class WorkerProcesses:
    """Settings for starting the child processes of one run; picklable."""

    factory: Callable[..., Server]
    arguments: tuple[object, ...]
    environment: Mapping[str, str]
    memory_mb: float | None
    tries: int

    def hire(self, cancel: threading.Event) -> IsolatedWorker:
        """Create a worker with its own child process; ``cancel`` stops it."""
        return IsolatedWorker(
            self.factory,
            *self.arguments,
            environment=self.environment,
            cancel=cancel,
            memory_mb=self.memory_mb,
        )

    def done_by(self, worker: IsolatedWorker, job: object, limit_s: float = math.inf) -> Outcome:
        """Run a job on one of the workers; if its process ends, try again, up to ``tries`` times in total."""
        for _ in range(self.tries - 1):
            if not (outcome := worker.call(job, limit_s=limit_s)).ended:
                return outcome
        return worker.call(job, limit_s=limit_s)


_MOST_LOST = 10
"""Number of lost jobs after which the run stops: each of them costs the start of two processes."""
_NAMED = 3
_Finished = tuple[Job, Outcome | BaseException]


class LostJobsError(RsbenchError):
    """Raised if the process of some jobs ended at every try; results of the other jobs are kept."""

    exit_code = 1


def finished_jobs(
    factory: Callable[..., Server],
    jobs: Sequence[Job],
    workers: Workers,
    environment: Mapping[str, str],
    *arguments: object,
    name: Callable[[Job], str] = str,
) -> Generator[tuple[Job, Any], None, None]:
    """Yield jobs with their answers, see ``run_jobs``; ``name`` returns the name of a job for errors.

    Raises:
        LostJobsError: the process of some jobs ended ``TRIES`` times; raised after the other jobs, or after many.
        RsbenchError: a job failed; raised at once.
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
            f"not done: {', '.join(lost[:_NAMED])}{more}; perhaps for lack of memory: what is done is kept, and "
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
    """Run jobs and yield them with their outcomes as they become ready.

    A job whose process ended is tried ``TRIES`` times in fresh processes, or once if there are limits. When the
    iterator is closed or an exception such as Ctrl-C passes through it, waiting jobs are dropped and all processes
    end at once.

    Args:
        factory: see ``IsolatedWorker``; the function that it returns is called with a job.
        jobs: picklable jobs.
        workers: number of processes, or a cluster.
        environment, arguments: see ``IsolatedWorker``.
        seconds_of: returns the time limit of a job, possibly infinite; None for no limits.
        memory_mb: limit of the memory of a process, see ``IsolatedWorker``.

    Raises:
        RsbenchError: the cluster cannot be reached.
        RuntimeError: rsbench's own code in a child raised an exception.
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
        """Run jobs in one child process until none is left."""
        with processes.hire(cancel) as worker, contextlib.suppress(queue.Empty, Cancelled):
            while True:
                job = waiting.get_nowait()
                try:
                    limit = math.inf if seconds_of is None else seconds_of(job)
                    done.put((job, processes.done_by(worker, job, limit)))
                except Cancelled:
                    raise
                except BaseException as error:  # raised in the thread that waits
                    done.put((job, error))
                    return

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


_CONNECT_S = 30
_DISMISS_S = 5
_WATCH_S = 0.5


def run_on_cluster(
    cluster: Cluster, processes: WorkerProcesses, jobs: Sequence[Job], seconds_of: Callable[[Job], float] | None
) -> Generator[tuple[Job, Outcome], None, None]:
    """Run jobs on a cluster and yield them with their outcomes as they become ready; see ``run_jobs``.

    Raises:
        RsbenchError: there is no such scheduler, it has no worker, or distributed is not installed.
        RuntimeError: rsbench's own code in a child raised an exception.
    """
    content = bytes(ForkingPickler.dumps(processes))
    key = hashlib.sha256(content).hexdigest()
    with _connected(cluster) as client:
        from distributed import CancelledError, KilledWorker, as_completed

        try:
            # A separate task: its result is sent to each worker once, and repeated if all holders of it die.
            shared = client.submit(bytes, content, key=f"rsbench-workers-{key[:16]}")
            futures = {}
            for job in jobs:
                limit = math.inf if seconds_of is None else seconds_of(job)
                futures[client.submit(_do, key, shared, job, limit, pure=False)] = job
            for future in as_completed(list(futures)):
                job = futures.pop(future)
                try:  # if a worker dies with the result, this waits until the scheduler has repeated the task
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
    """Open a client of the scheduler for the duration of the context."""
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
    try:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            try:
                client.wait_for_workers(1, timeout=_CONNECT_S)
            except TimeoutError as error:
                raise RsbenchError(f"--scheduler {cluster.address}: has no workers") from error
        yield client
    finally:
        with contextlib.suppress(Exception):  # distributed may raise where the scheduler is gone
            client.close()


# On the machines of the cluster


_IDLE: dict[str, list[tuple[WorkerProcesses, IsolatedWorker]]] = {}
"""Idle children of this process, by the hash of the workers of their run."""
_IDLE_LOCK = threading.Lock()


def _take(key: str, content: bytes, cancel: threading.Event) -> tuple[WorkerProcesses, IsolatedWorker]:
    """Take an idle child of a run, or start one; end idle children of other runs. ``cancel`` stops its job."""
    with _IDLE_LOCK:
        others = [worker for name in list(_IDLE) if name != key for _, worker in _IDLE.pop(name)]
        own = _IDLE.get(key, [])
        found = own.pop() if own else None
    for worker in others:
        worker.close()
    if found is not None:
        found[1].cancel = cancel
        return found
    processes = ForkingPickler.loads(content)
    return processes, processes.hire(cancel)


def _dismiss(key: str) -> None:
    """End the idle children of a run; busy ones end when their task is cancelled."""
    with _IDLE_LOCK:
        idle = _IDLE.pop(key, [])
    for _, worker in idle:
        worker.close()


def _do(key: str, content: bytes, job: object, limit_s: float) -> Outcome:
    """Run one job in a child process of this Dask worker.

    Raises:
        distributed.Reschedule: the job was stopped. If the scheduler still needs it, it repeats the task.
    """
    from distributed import Reschedule

    cancel = threading.Event()  # one per job: the watch may set it when the child already runs the next job
    processes, worker = _take(key, content, cancel)
    with _watched(cancel):
        try:
            outcome = processes.done_by(worker, job, limit_s)
        except BaseException as error:
            worker.close()
            if isinstance(error, Cancelled):
                raise Reschedule from error
            raise
    with _IDLE_LOCK:
        _IDLE.setdefault(key, []).append((processes, worker))
    return outcome


@contextlib.contextmanager
def _watched(cancel: threading.Event) -> Iterator[None]:
    """Set ``cancel`` when the scheduler no longer needs this thread's task, because its run stopped or died."""
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
