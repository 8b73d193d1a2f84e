"""Run cards on exported inputs; answers are stored as soon as they are made and scored afterwards.

A method reads nothing but the exported inputs. Each answer has an identity made of method, inputs, options and
code; answers whose identity is current are reused, so that an interrupted run resumes. Cards of other packages run
in separate processes with limits, and their errors are recorded as failures with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from rsbench.benchmark.images.store import identity_of, keep, kept
from rsbench.benchmark.leaderboard.pictures import PICTURES
from rsbench.benchmark.leaderboard.submissions import method_header, submission_text
from rsbench.benchmark.leaderboard.track import Job, Limits, Runnable, Split, Step, Target, Track
from rsbench.benchmark.provenance import numeric_version, processor
from rsbench.core.errors import RsbenchError, naming
from rsbench.jobs.isolation import ONE_THREAD, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs, run_jobs
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import sha256, write_bytes
from rsbench.storage.untrusted_files import check_name
from rsbench.storage.work_folder import remove


def load_cards(track: Track, cards: Sequence[str]) -> dict[str, Runnable]:
    """Load the components of cards that a track can run; returns them by card.

    Raises:
        RsbenchError: a card is invalid or does not fit the track, or two components have the same name.
    """
    names = dict[str, str]()
    found = track.load(cards)
    for card, runnable in found.items():
        with naming(f"entry {card}"):
            check_name(runnable.name)
        if (other := names.setdefault(runnable.name, card)) != card:
            raise RsbenchError(
                f"--entry {card} and --entry {other}: both have the name {runnable.name!r}; rename one"
            )
    return found


def count_steps(split: Split, cards: Sequence[str], limits: Limits) -> int:
    """Return the number of calls of ``step`` by ``run_cards``."""
    problems = len(split.truths)
    matching = problems if split.track.own_matches else 0
    return len(cards) * -(-problems // split.track.chunk(limits)) + matching


def run_cards(
    split: Split,
    cards: Sequence[str],
    inputs: Path,
    work: Path,
    *,
    workers: Workers = 1,
    limits: Limits = Limits(),  # noqa: B008  it is a constant
    step: Step = lambda word: None,
    features: str | None = None,
) -> list[Path]:
    """Run cards on exported inputs; returns a file of predictions in ``work`` for each card, ready to submit.

    Args:
        split: the problems.
        cards: names or paths of the cards.
        inputs: folder written by ``prepare_inputs``.
        work: folder in which answers are stored.
        workers: number of processes; 0 runs rsbench's own components in this process, without limits.
        limits: time and memory per problem.
        step: called with the name of an entry, or of a problem, when a part is finished.
        features: feature matcher for solvers on tracks without given matches; None: ``sift-refined``.

    Raises:
        RsbenchError: a card does not fit the track, or processes died repeatedly on the same problems; finished
            answers are kept.
    """
    track = split.track
    runnables = load_cards(track, cards)
    inputs = track.prepare(split, inputs, work, step, features)
    data, names, size = sha256(inputs / "problems.jsonl"), list(split.by_name), track.chunk(limits)
    chunks = [tuple(names[first : first + size]) for first in range(0, len(names), size)]
    targets: dict[str, list[Target]] = {card: [] for card in runnables}
    jobs = list[Job]()
    for chunk in chunks:
        due = list[Target]()
        for card, runnable in runnables.items():
            identity = identity_of(
                source=numeric_version(),
                key=runnable.key,
                protocol=track.id,
                split=split.fingerprint,
                data=data,
                problems=chunk,
                limits=list(limits),
            )
            folder = work / runnable.name
            targets[card].append(target := Target(card, folder, identity, folder / "answers" / f"{chunk[0]}.json"))
            if kept(target.record, identity) is None:
                due.append(target)
            else:
                step(runnable.name)
        pictures = split.by_name[chunk[0]].pictures
        requested = () if pictures is None else pictures.requested
        together = [due] if due and track.pictures and limits == Limits() else [[each] for each in due]
        jobs += [Job(chunk, tuple(part), requested) for part in together]
    if jobs:
        warm_up({runnable.model for runnable in runnables.values()})
    built_in = {card for card, runnable in runnables.items() if runnable.built_in}
    for job in _done(track, jobs, workers, inputs, limits, built_in):
        for target in job.targets:
            step(target.folder.name)
    files = list[Path]()
    for card, runnable in runnables.items():
        parts = [kept(target.record, target.identity) or [] for target in targets[card]]
        files.append(_write(split, runnable, list(chain.from_iterable(parts)), work / runnable.name))
        track.copy_files(inputs, work / runnable.name)
    return files


def _write(split: Split, runnable: Runnable, answers: Sequence[dict[str, Any]], folder: Path) -> Path:
    """Write the answers of a card as a submission; returns the file."""
    about = dict(runnable.header)
    header = {
        **method_header(split, runnable.name, about.pop("uses"), about.pop("description")),
        "paper": about.pop("paper", "")[:300],
        "code": "rsbench" if runnable.built_in else "",
        "hardware": f"{processor()}, 1 thread"[:300],
        **about,
    }
    write_bytes(folder / "predictions.jsonl", submission_text(header, answers).encode())
    return folder / "predictions.jsonl"


def _done(
    track: Track, jobs: Sequence[Job], workers: Workers, inputs: Path, limits: Limits, built_in: set[str]
) -> Iterator[Job]:
    """Run jobs in single-threaded child processes, or in this one if ``workers`` is 0; yield each finished job.

    With limits, a job that exceeds them or ends its process is stored as a failure.

    Raises:
        RsbenchError: without limits, see ``finished_jobs``.
    """
    serve = partial(_serve, track)
    if workers == 0:
        run = serve(inputs, limits)
        for job in jobs:
            run(job)
            yield job
        return
    if limits == Limits():
        with closing(finished_jobs(serve, jobs, workers, ONE_THREAD, inputs, limits)) as found:
            yield from (job for job, _ in found)
        return

    def seconds_of(job: Job) -> float:
        """Return the time limit of a job; components of other packages are limited in their own processes."""
        own = all(target.card in built_in for target in job.targets)
        return limits.seconds if limits.seconds is not None and own else math.inf

    outcomes = run_jobs(
        serve, jobs, workers, ONE_THREAD, inputs, limits, seconds_of=seconds_of, memory_mb=limits.memory_mb
    )
    with closing(outcomes) as ready:
        for job, outcome in ready:
            if not outcome.success:
                (name,), (target,) = job.problems, job.targets
                remove(target.folder / PICTURES / name)
                failure = {"name": name, "success": False, "reason": outcome.reason[:300]}
                keep(target.record, target.identity, [failure])
            yield job


def _serve(track: Track, inputs: Path, limits: Limits) -> Any:
    """Return the function that runs jobs in the child process."""
    use_one_thread()
    warm_up()
    solve = track.solver_of_jobs(inputs, limits)

    def run(job: Job) -> None:
        for target in job.targets:
            remove(target.record)
        for target, answers in zip(job.targets, solve(job), strict=True):
            keep(target.record, target.identity, answers)

    return run
