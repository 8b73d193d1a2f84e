"""Running a sweep: chunks of trials over processes, each complete or absent, the same bytes whatever their number.

A folder holds

    sweep.json           the card, the solvers, the cells
    trials/NNN.npz       truth and predictions of a cell (see ``trials.run_trials``; reasons as codes)
    bounds/NNN.npz       Cramer-Rao bounds of all cells with the exact matches of NNN (see ``trials.run_bounds``)
    seconds/NNN.npz      how long the solvers took: no two runs agree on that
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from rsbench import __version__
from rsbench.benchmark.simulated.sweep_card import Cell, SweepCard
from rsbench.benchmark.simulated.trials import Arrays, Entrant, entrant, run_bounds, run_trials
from rsbench.dataset.files import load_arrays, read_json, save_arrays, write_json
from rsbench.errors import RsbenchError

FORMAT = 1
CHUNK = 50
"""Trials of one job."""
Progress = Callable[[str], None]
"""Called with the name of the variant after each chunk."""
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


class _Part(NamedTuple):
    """A file of the results: arrays over the trials of a cell."""

    kind: Literal["trials", "bounds"]
    cell: Cell

    def path(self, out: Path) -> Path:
        return out / self.kind / f"{self.cell.index:03d}.npz"


class _Job(NamedTuple):
    """A chunk of a part."""

    card: SweepCard
    part: _Part
    first: int
    trials: int
    path: Path


def sweep_steps(card: SweepCard) -> int:
    """Number of chunks, for a progress bar."""
    return len(_parts(card)) * len(_firsts(card))


def _firsts(card: SweepCard) -> range:
    return range(0, card.trials, CHUNK)


def _parts(card: SweepCard) -> list[_Part]:
    cells = card.cells()
    own_bounds = [cell for cell in cells if geometry_of(card, cell).index == cell.index]
    return [_Part("trials", cell) for cell in cells] + [_Part("bounds", cell) for cell in own_bounds]


def geometry_of(card: SweepCard, cell: Cell) -> Cell:
    """The first cell with the same exact matches: noise and what solvers are told may differ."""
    exact = cell.setting.exact()
    return next(other for other in card.cells() if other.setting.exact() == exact)


def run_sweep(card: SweepCard, out: Path, *, workers: int = 1, progress: Progress | None = None) -> None:
    """Run what ``out`` does not hold yet.

    Args:
        card: the experiment.
        out: folder, made if missing.
        workers: processes, each with one thread.
        progress: see ``Progress``.

    Raises:
        RsbenchError: no such solver; ``out`` holds another sweep; a motion leaves too few points in view; a
            worker was killed.
    """
    _open_folder(card, {name: entrant(name) for name in card.solvers}, out)
    step = progress or (lambda word: None)
    chunks = out / ".chunks"
    chunks.mkdir(exist_ok=True)
    todo = []
    for part in _parts(card):
        for first in _firsts(card):
            path = chunks / f"{part.kind}-{part.cell.index:03d}-{first:06d}.npz"
            if part.path(out).is_file() or path.is_file():
                step(part.cell.variant)
            else:
                todo.append(_Job(card, part, first, min(CHUNK, card.trials - first), path))
    for part in _run_all(todo, workers):
        step(part.cell.variant)
    for part in _parts(card):
        _collect(card, part, out)
    shutil.rmtree(chunks)


def read_trials(out: Path, cell: Cell) -> Arrays:
    """Stored truth and predictions of a cell."""
    return load_arrays(_Part("trials", cell).path(out))


def read_bounds(out: Path, card: SweepCard, cell: Cell) -> Arrays:
    """Stored bounds of a cell, for a noise of 1 px."""
    return load_arrays(_Part("bounds", geometry_of(card, cell)).path(out))


def read_sweep(folder: Path) -> dict[str, Any]:
    """sweep.json of a finished run.

    Raises:
        RsbenchError: no such file, or of another format.
    """
    content = read_json(folder / "sweep.json")
    if content.get("format") != FORMAT:
        raise RsbenchError(f"{folder / 'sweep.json'}: format = {content.get('format')!r}: must be {FORMAT}")
    return content


def _plan(card: SweepCard, entrants: dict[str, Entrant]) -> dict[str, Any]:
    """All that decides the bytes of a run."""
    solvers = [
        {
            "name": e.name,
            "key": e.entry.key,
            "information": e.information,
            "shutter": e.solver.spec.shutter,
            "motion_model": e.solver.spec.motion_model,
            "reference_point": e.solver.spec.reference_point,
            "reference": e.solver.spec.reference,
        }
        for e in entrants.values()
    ]
    names = [solver["name"] for solver in solvers]
    if len(set(names)) < len(names):
        raise RsbenchError(f"sweep {card.name}: two solvers have one name: {', '.join(names)}")
    cells = [asdict(cell) for cell in card.cells()]
    return {"format": FORMAT, "rsbench": __version__, "card": asdict(card), "solvers": solvers, "cells": cells}


def _open_folder(card: SweepCard, entrants: dict[str, Entrant], out: Path) -> None:
    import json

    plan = json.loads(json.dumps(_plan(card, entrants)))
    if (out / "sweep.json").is_file():
        stored = read_sweep(out)
        other = [key for key in plan["card"] if stored["card"].get(key) != plan["card"][key]]
        other += [key for key in plan if key != "card" and stored.get(key) != plan[key]]
        if other:
            raise RsbenchError(
                f"{out}: holds another sweep (differs in {', '.join(other)}); choose another --out or delete it"
            )
    for kind in ("trials", "bounds", "seconds"):
        (out / kind).mkdir(parents=True, exist_ok=True)
    write_json(out / "sweep.json", plan)


def _run_all(todo: list[_Job], workers: int) -> Iterator[_Part]:
    """Always in children, so that BLAS has one thread and one summation order whatever the parent has loaded."""
    if not todo:
        return
    with _environment({name: "1" for name in _ONE_THREAD}):
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(max(1, min(workers, len(todo))), mp_context=context) as pool:
            jobs = {pool.submit(_run_job, job): job for job in todo}
            try:
                for done in as_completed(jobs):
                    done.result()
                    yield jobs[done].part
            except BrokenProcessPool as error:
                raise RsbenchError(
                    "a worker process was killed, perhaps for want of memory; the same command resumes"
                ) from error
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise


@contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _run_job(job: _Job) -> None:
    """One chunk, in a child."""
    _single_thread()
    card, cell = job.card, job.part.cell
    try:
        if job.part.kind == "bounds":
            arrays = run_bounds(cell.setting, card.solvers, card.seed, job.first, job.trials)
        else:
            arrays = run_trials(cell.setting, card.solvers, card.seed, job.first, job.trials, card.robust)
    except RsbenchError as error:
        where = f"sweep {card.name}, {cell.variant}, {card.axis} = {cell.value:g}"
        raise RsbenchError(f"{where}: {error}") from error
    save_arrays(job.path, arrays)


@lru_cache(maxsize=1)
def _single_thread() -> None:
    import cv2

    cv2.setNumThreads(1)


def _collect(card: SweepCard, part: _Part, out: Path) -> None:
    """Join the chunks of a part into its file."""
    path, prefix = part.path(out), f"{part.kind}-{part.cell.index:03d}"
    if path.is_file():
        return
    chunks = [load_arrays(out / ".chunks" / f"{prefix}-{first:06d}.npz") for first in _firsts(card)]
    joined = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    if part.kind == "trials":
        save_arrays(out / "seconds" / path.name, {"seconds": joined.pop("seconds")})
        joined = _coded(joined)
    save_arrays(path, joined)


def _coded(arrays: Arrays) -> Arrays:
    """Reasons as numbers into a list of them."""
    reasons, codes = np.unique(arrays.pop("reason"), return_inverse=True)
    shape = arrays["success"].shape
    return {**arrays, "reason_code": codes.reshape(shape).astype(np.int32), "reasons": reasons}
