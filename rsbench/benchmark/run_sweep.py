"""Running a sweep: chunks of trials over processes, each complete or absent, the same bytes whatever their number.

A folder holds

    sweep.json         the card, the solvers, the cells
    trials/NNN.npz     truth and predictions of a cell (arrays of ``trials.Trials``, reasons as codes)
    seconds.csv        median time of a solver per cell; the only file that differs between runs
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from rsbench import __version__
from rsbench.benchmark.predict import load_arrays, save_arrays
from rsbench.benchmark.sweeps import Cell, SweepCard
from rsbench.benchmark.trials import Arrays, Entrant, entrant, run_trials
from rsbench.dataset.files import read_json, write_bytes, write_json
from rsbench.errors import RsbenchError

FORMAT = 1
CHUNK = 50
"""Trials of one job."""
Progress = Callable[[str], None]
"""Called with the name of the variant after each chunk."""
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


class _Job(NamedTuple):
    card: SweepCard
    cell: Cell
    first: int
    path: Path


def sweep_steps(card: SweepCard) -> int:
    """Number of chunks, for a progress bar."""
    return len(card.cells()) * -(-card.trials // CHUNK)


def run_sweep(card: SweepCard, out: Path, *, workers: int = 1, progress: Progress | None = None) -> None:
    """Run what ``out`` does not hold yet.

    Args:
        card: the experiment.
        out: folder, made if missing.
        workers: processes, each with one thread.
        progress: see ``Progress``.

    Raises:
        RsbenchError: no such solver; ``out`` holds another sweep; a motion leaves too few points in view.
    """
    entrants = {name: entrant(name) for name in card.solvers}
    _open_folder(card, entrants, out)
    step = progress or (lambda word: None)
    chunks = out / ".chunks"
    chunks.mkdir(exist_ok=True)
    todo = []
    for cell in card.cells():
        for first in range(0, card.trials, CHUNK):
            job = _Job(card, cell, first, chunks / f"{cell.index:03d}-{first:06d}.npz")
            if trials_path(out, cell).is_file() or job.path.is_file():
                step(cell.variant)
            else:
                todo.append(job)
    for cell in _run_all(todo, workers):
        step(cell.variant)
    rows = [row for cell in card.cells() for row in _collect(card, cell, out)]
    write_table(out / "seconds.csv", pd.DataFrame(rows))
    shutil.rmtree(chunks)


def trials_path(out: Path, cell: Cell) -> Path:
    """File of a cell."""
    return out / "trials" / f"{cell.index:03d}.npz"


def read_sweep(folder: Path) -> dict[str, Any]:
    """sweep.json of a finished run.

    Raises:
        RsbenchError: no such file, or of another format.
    """
    content = read_json(folder / "sweep.json")
    if content.get("format") != FORMAT:
        raise RsbenchError(f"{folder / 'sweep.json'}: format = {content.get('format')!r}: must be {FORMAT}")
    return content


def write_table(path: Path, frame: pd.DataFrame) -> None:
    """CSV with enough digits to compare runs and few enough to read."""
    write_bytes(path, frame.to_csv(index=False, float_format="%.6g", lineterminator="\n").encode())


def _plan(card: SweepCard, entrants: dict[str, Entrant]) -> dict[str, Any]:
    """All that decides the bytes of a run."""
    solvers = [
        {
            "name": e.solver.name,
            "parameters": repr(e.solver),
            "information": e.information,
            "shutter": e.solver.shutter,
            "motion_model": e.solver.motion_model,
            "reference_point": e.solver.reference_point,
            "reference": e.solver.reference,
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
    (out / "trials").mkdir(parents=True, exist_ok=True)
    write_json(out / "sweep.json", plan)


def _run_all(todo: list[_Job], workers: int) -> Iterator[Cell]:
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
                    yield jobs[done].cell
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
    card, cell = job.card, job.cell
    count = min(CHUNK, card.trials - job.first)
    try:
        trials = run_trials(cell.setting, card.solvers, card.seed, job.first, count, card.robust)
    except RsbenchError as error:
        where = f"sweep {card.name}, {cell.variant}, {card.axis} = {cell.value:g}"
        raise RsbenchError(f"{where}: {error}") from error
    save_arrays(job.path, {**trials.predictions, "seconds": trials.seconds})


@lru_cache(maxsize=1)
def _single_thread() -> None:
    import cv2

    cv2.setNumThreads(1)


def _collect(card: SweepCard, cell: Cell, out: Path) -> list[dict[str, Any]]:
    """Join the chunks of a cell into its file; returns its rows of seconds.csv."""
    path, folder = trials_path(out, cell), out / ".chunks"
    if not path.is_file():
        parts = [
            load_arrays(folder / f"{cell.index:03d}-{first:06d}.npz") for first in range(0, card.trials, CHUNK)
        ]
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        seconds = joined.pop("seconds")
        save_arrays(path.with_suffix(".seconds.npz"), {"seconds": seconds})
        save_arrays(path, _coded(joined))
    seconds = load_arrays(path.with_suffix(".seconds.npz"))["seconds"]
    return [
        {"variant": cell.variant, "value": cell.value, "solver": solver, "median_ms": 1e3 * np.median(column)}
        for solver, column in zip(card.solvers, seconds.T, strict=True)
    ]


def _coded(arrays: Arrays) -> Arrays:
    """Reasons as numbers into a list of them."""
    reasons, codes = np.unique(arrays.pop("reason"), return_inverse=True)
    shape = arrays["success"].shape
    return {**arrays, "reason_code": codes.reshape(shape).astype(np.int32), "reasons": reasons}
