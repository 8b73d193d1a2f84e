"""Verify a dataset: every file must match the manifests, and every channel must agree with the others."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rsbench.components.cards import card_path
from rsbench.core import arguments
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.jobs.isolation import THREAD_VARIABLES, use_one_thread
from rsbench.jobs.process_jobs import finished_jobs
from rsbench.storage.files import read_json
from rsbench.verification import manifest_checks
from rsbench.verification.checks import STEPS, State, check_sequence, run_stage
from rsbench.verification.findings import DepthAgreement, Finding, Progress, SequenceReport
from rsbench.verification.reprojection import set_threads
from rsbench.verification.rerender import Rerender, Rerenderer

__all__ = [
    "DepthAgreement",
    "Finding",
    "Rerender",
    "SequenceReport",
    "verification_steps",
    "verify_dataset",
    "verify_sequence",
]

MOST_FAULTS = 1000
"""Number of faults of one sequence that are reported one by one: its manifests may list any number of files."""


def verify_dataset(
    folder: Path,
    stride: int = 1,
    progress: Progress | None = None,
    *,
    rerender: Rerender = "no",
    scenes: Collection[Path] = (),
    workers: int = 1,
) -> list[SequenceReport]:
    """Check every sequence of a dataset; faults are returned, only an unreadable dataset raises an error.

    Args:
        folder: the folder of dataset.json.
        stride: compare every ``stride``-th pixel in both directions.
        progress: see ``Progress``; there are ``verification_steps`` calls in all.
        rerender: which rows to render again if the scene can be built here.
        scenes: cards of scenes that are not built in, and mesh files of moving objects.
        workers: number of processes that check one sequence each; 1: this process, with all its threads.

    Returns:
        One report per sequence, after one named dataset.json if that file has faults, and one for each of the
        first ``MOST_MISSING`` sequences whose folder is missing or empty.

    Raises:
        ValueError: ``stride``, ``rerender`` or ``workers`` has a value that is not allowed.
        LostJobsError: the process of a sequence ended each time it was tried.
        RsbenchError: dataset.json is missing or not a JSON object, or a scene card that was named does not exist.
    """
    arguments.check_whole("stride", stride, 1, arguments.LARGEST_SIZE)
    arguments.check_one_of("rerender", rerender, ("no", "auto", "all"))
    arguments.check_whole("workers", workers, 1)
    manifest = read_json(folder / manifest_checks.DATASET)
    step = progress or (lambda name: None)
    listing = manifest_checks.Listing.of(folder, manifest)
    state = State(listing, manifest_checks.DATASET)
    run_stage(state, "dataset")
    reports = [SequenceReport(name=state.name, findings=tuple(state.findings))] if state.findings else []
    files = [path for path in scenes if path.suffix not in ("", ".toml")]
    cards = [card_path("scenes", path) for path in scenes if path not in files]
    missing = manifest_checks.missing_sequences(listing)
    reports += [SequenceReport(name=name, findings=(each,)) for name, each in missing.items() if each is not None]
    names = [name for name in listing.names if name not in missing]
    if workers == 1 or len(names) < 2:
        check = _checker(folder, stride, rerender, cards, files, step)
        return reports + [check(name) for name in names]
    found = {}
    for report in _reports_apart(names, workers, folder, stride, rerender, cards, files):
        found[report.name] = report
        for _ in range(_steps(listing)):
            step(report.name)
    return reports + [found[name] for name in names]


def _checker(
    folder: Path,
    stride: int,
    rerender: Rerender,
    cards: Sequence[Path],
    files: Sequence[Path],
    step: Progress = lambda name: None,
) -> Callable[[str], SequenceReport]:
    """Return a function that checks the sequence of a given name; it keeps the scene of the last one."""
    listing = manifest_checks.Listing.of(folder, read_json(folder / manifest_checks.DATASET))
    again = None if rerender == "no" else Rerenderer(rerender, cards, files)
    return lambda name: verify_sequence(listing, name, stride, step, again)


def _reports_apart(
    names: list[str], workers: int, folder: Path, stride: int, rerender: Rerender, *named: list[Path]
) -> Iterator[SequenceReport]:
    """Yield reports as they become ready, from processes that share the cores; ``named`` as for ``_checker``."""
    threads = max(1, (os.cpu_count() or 1) // workers)
    environment = dict.fromkeys(THREAD_VARIABLES, "1") if threads == 1 else {}
    given = threads, folder, stride, rerender, *named
    with closing(finished_jobs(_serve, names, workers, environment, *given, name="sequence {}".format)) as found:
        for _, report in found:
            yield SequenceReport(
                name=report["name"],
                findings=tuple(Finding(**each) for each in report["findings"]),
                agreements=tuple(DepthAgreement(**each) for each in report["agreements"]),
                notes=tuple(report["notes"]),
            )


def _serve(
    threads: int, folder: Path, stride: int, rerender: Rerender, cards: list[Path], files: list[Path]
) -> Callable[[str], dict[str, Any]]:
    """Return ``_checker`` for a child process, with its reports as dictionaries."""
    set_threads(threads)
    if threads == 1:
        use_one_thread()
    if rerender != "no":
        from rsbench.renderers import backend

        backend.set_threads(threads)
    check = _checker(folder, stride, rerender, cards, files)
    return lambda name: asdict(check(name))


def verification_steps(manifest: Mapping[str, Any]) -> int:
    """Return how often ``verify_dataset`` reports progress on a dataset with this dataset.json."""
    listing = manifest_checks.Listing.of(Path(), manifest)
    return _steps(listing) * len(listing.names)


def _steps(listing: manifest_checks.Listing) -> int:
    """Return the number of progress reports of each sequence."""
    frames = len(FRAMES) if isinstance(listing.card, Finding) else listing.card.frames
    return 1 + STEPS * (frames - 1)


def verify_sequence(
    listing: manifest_checks.Listing,
    name: str,
    stride: int = 1,
    step: Progress = lambda name: None,
    again: Rerenderer | None = None,
) -> SequenceReport:
    """Check one sequence of a dataset; ``stride`` as in ``verify_dataset``; ``again`` renders rows again."""
    steps = _steps(listing)

    def counted(sequence: str) -> None:
        nonlocal steps
        steps -= 1
        if steps >= 0:  # its frames may be more than the card says
            step(sequence)

    state = State(listing, name, stride, again, counted)
    try:
        check_sequence(state)
    except RsbenchError as error:
        state.findings.append(Finding.of(error))
    for _ in range(steps):
        step(name)
    findings, agreements = tuple(dict.fromkeys(state.findings)), tuple(state.agreements.values())
    if more := len(findings[MOST_FAULTS:]):
        findings = *findings[:MOST_FAULTS], Finding(f"{name}/", f"{more} more faults of this sequence")
    return SequenceReport(name=name, findings=findings, agreements=agreements, notes=tuple(state.notes))
