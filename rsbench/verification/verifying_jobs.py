"""Sequences verified by child processes, each whole."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from typing import Any

from rsbench.jobs.isolation import THREAD_VARIABLES, use_one_thread
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.verification import reprojection
from rsbench.verification.findings import DepthAgreement, Finding, SequenceReport

CheckSequence = Callable[[str], SequenceReport]


def reports_apart(
    make: Callable[..., CheckSequence], names: list[str], workers: int, renders: bool, *arguments: object
) -> Iterator[SequenceReport]:
    """Reports of sequences as they are ready.

    Args:
        make: a function of a module, called in each child with ``arguments``; returns what checks a sequence.
        names: of the sequences.
        workers: processes, which share the cores.
        renders: whether checks render.

    Raises:
        LostJobsError: see ``finished_jobs``.
    """
    threads = max(1, (os.cpu_count() or 1) // workers)
    environment = dict.fromkeys(THREAD_VARIABLES, "1") if threads == 1 else {}
    given = (make, threads, renders, *arguments)
    with closing(finished_jobs(_serve, names, workers, environment, *given, name="sequence {}".format)) as found:
        for _, report in found:
            yield _report(**report)


def _report(name: str, findings: Any, agreements: Any, notes: Any) -> SequenceReport:
    return SequenceReport(
        name=name,
        findings=tuple(Finding(**each) for each in findings),
        agreements=tuple(DepthAgreement(**each) for each in agreements),
        notes=tuple(notes),
    )


def _serve(
    make: Callable[..., CheckSequence], threads: int, renders: bool, *arguments: object
) -> Callable[[str], dict[str, Any]]:
    """What checks, in a child."""
    reprojection.set_threads(threads)
    if threads == 1:
        use_one_thread()
    if renders:
        from rsbench.renderers.backend import set_threads

        set_threads(threads)
    check = make(*arguments)

    def run(name: str) -> dict[str, Any]:
        return asdict(check(name))

    return run
