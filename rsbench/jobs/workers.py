"""Workers that do the jobs of a run: child processes of one kind, here or on other machines."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rsbench.jobs.isolation import IsolatedWorker, Outcome, Server

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
