"""Jobs on the machines of a Dask cluster: the extra ``rsbench[cluster]``; nothing else imports distributed.

A task of the cluster is one job. It is done in a child process of the machine's worker, as ``run_jobs`` does it
here: what breaks in it breaks alone, and is tried again there. Jobs of a worker of the cluster that dies are given
to others by the scheduler. When the run ends, is stopped or dies, so do the children at work for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.reduction import ForkingPickler
from typing import Any, TypeVar

from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import Cancelled, IsolatedWorker, Outcome
from rsbench.jobs.workers import Cluster, WorkerProcesses

Job = TypeVar("Job")
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
