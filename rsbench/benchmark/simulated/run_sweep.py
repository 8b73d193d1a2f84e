"""Running a sweep: chunks of trials over processes, each complete or absent, the same bytes whatever their number.

A folder holds

    sweep.json           the card, the solvers, the cells
    trials/NNN.npz       truth and predictions of a cell (see ``trials.run_trials``; reasons as codes)
    bounds/NNN.npz       Cramer-Rao bounds of all cells with the exact matches of NNN (see ``trials.run_bounds``)
    seconds/NNN.npz      how long the solvers took: no two runs agree on that
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from rsbench.benchmark.simulated.sweep_card import Cell, SweepCard
from rsbench.benchmark.simulated.trials import Arrays, Entrant, enter, run_bounds, run_trials
from rsbench.components.imports import source_version
from rsbench.components.motion_models import motion_model
from rsbench.core.errors import RsbenchError
from rsbench.core.version import __version__
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import load_solver_entries
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import load_arrays, read_json, save_arrays, write_json
from rsbench.storage.work_folder import listed, remove, work_folder

FORMAT = 1
CHUNK = 50
"""Trials of one job."""
Progress = Callable[[str], None]
"""Called with the name of the variant after each chunk."""
_KINDS = ("trials", "bounds", "seconds")
_OURS = re.compile(r"[0-9]{3,}\.npz")
"""Names of the files of cells."""
_SIMULATOR = ("bound.py", "simulation.py", "sweep_card.py", "trials.py")


class _Part(NamedTuple):
    """A file of the results: arrays over the trials of a cell."""

    kind: Literal["trials", "bounds"]
    cell: Cell

    def path(self, out: Path) -> Path:
        return out / self.kind / f"{self.cell.index:03d}.npz"

    def chunk(self, first: int) -> str:
        """Name of the file of some of its trials, from number ``first``."""
        return f"{self.kind}-{self.cell.index:03d}-{first:06d}.npz"


class _Job(NamedTuple):
    """A chunk of a part."""

    card: SweepCard
    part: _Part
    first: int
    trials: int
    path: Path

    def __str__(self) -> str:
        cell, last = self.part.cell, self.first + self.trials - 1
        where = f"sweep {self.card.name}, {cell.variant}, {self.card.axis} = {cell.value:g}"
        return f"{where}, {self.part.kind} {self.first} to {last}"


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


def run_sweep(
    card: SweepCard,
    out: Path,
    *,
    workers: Workers = 1,
    progress: Progress | None = None,
    time_limit_s: float | None = None,
    force: bool = False,
) -> None:
    """Run what ``out`` does not hold yet.

    An exception that passes through, such as Ctrl-C, ends all processes at once; what is done stays.

    Args:
        card: the experiment.
        out: folder, made if missing.
        workers: processes, each with one thread.
        progress: see ``Progress``.
        time_limit_s: for one problem of another package's solver, instead of what its card says.
        force: whether to do all again, whatever ``out`` holds.

    Raises:
        RsbenchError: no such solver, or two of one name; ``out`` holds another sweep; a motion leaves too few
            points in view; a worker was killed each time over the same trials.
    """
    step, plan = progress or (lambda word: None), _plan(card, entrants(card))
    with work_folder(out) as hidden:
        chunks = hidden / "chunks"
        if force:
            remove(chunks)
        _open_folder(plan, out, force)
        chunks.mkdir(exist_ok=True)
        todo = []
        for part in _parts(card):
            for first in _firsts(card):
                path = chunks / part.chunk(first)
                if part.path(out).is_file() or path.is_file():
                    step(part.cell.variant)
                else:
                    todo.append(_Job(card, part, first, min(CHUNK, card.trials - first), path))
        if todo:
            _compile(card)
        for part in _run_all(todo, workers, time_limit_s):
            step(part.cell.variant)
        for part in _parts(card):
            _collect(card, part, out, chunks)
        remove(chunks)


def read_trials(out: Path, card: SweepCard, cell: Cell) -> Arrays:
    """Stored truth and predictions of a cell.

    Raises:
        RsbenchError: the file is damaged.
    """
    path = _Part("trials", cell).path(out)
    arrays = _checked(load_arrays(path), path, card, _TRIALS)
    codes, reasons = arrays["reason_code"], arrays.get("reasons", np.zeros(0))
    if reasons.ndim != 1 or np.any((codes < 0) | (codes >= len(reasons))):
        raise RsbenchError(f"{path}: 'reasons' is damaged; {_REMAKE}")
    return arrays


def read_bounds(out: Path, card: SweepCard, cell: Cell) -> Arrays:
    """Stored bounds of a cell, for a noise of 1 px.

    Raises:
        RsbenchError: the file is damaged.
    """
    path = _Part("bounds", geometry_of(card, cell)).path(out)
    return _checked(load_arrays(path), path, card, _BOUNDS)


_SAID = ("name", "information", "shutter", "motion_model", "reference_point")
"""What sweep.json must say of every solver."""
_REMAKE = "delete the file, and the same command makes it again"
_TRIALS = {
    "w": ("f", (3,)),
    "d": ("f", (3,)),
    "w_est": ("f", (0, 3)),
    "d_est": ("f", (0, 3)),
    "success": ("b", (0,)),
    "metric": ("b", (0,)),
    "direction_known": ("b", (0,)),
    "reason_code": ("i", (0,)),
}
_BOUNDS = {"rotation": ("f", (0, 3)), "direction": ("f", (0, 2)), "scale": ("f", (0,))}
"""Kind of the arrays of a part, and their shape after the trials; 0 stands for the number of solvers."""


def _checked(
    arrays: Arrays, path: Path, card: SweepCard, layout: Mapping[str, tuple[str, tuple[int, ...]]]
) -> Arrays:
    for name, (kind, tail) in layout.items():
        shape = (card.trials, *(size or len(card.solvers) for size in tail))
        array = arrays.get(name, np.zeros(0))
        if array.dtype.kind != kind or array.shape != shape:
            raise RsbenchError(f"{path}: {name!r} is damaged; {_REMAKE}")
    return arrays


def read_sweep(folder: Path) -> dict[str, Any]:
    """sweep.json of a finished run.

    Raises:
        RsbenchError: no such file, of another format, or damaged.
    """
    path = folder / "sweep.json"
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise RsbenchError(f"{path}: format = {content.get('format')!r}: must be {FORMAT}")
    solvers = content.get("solvers")
    solvers = solvers if isinstance(solvers, list) else [solvers]
    said = [[one.get(key) for key in _SAID] if isinstance(one, dict) else [None] for one in solvers]
    if not (
        isinstance(content.get("card"), dict) and all(isinstance(word, str) for words in said for word in words)
    ):
        raise RsbenchError(
            f"{path}: card or solvers are damaged; choose another --out, or remake all with --force"
        )
    return content


def entrants(card: SweepCard) -> list[Entrant]:
    """The solvers of a card.

    Raises:
        RsbenchError: no such solver, or two of one name, which tables and seeds could not tell apart.
    """
    return [enter(entry) for entry in load_solver_entries(card.solvers)]


def _plan(card: SweepCard, solvers: list[Entrant]) -> dict[str, Any]:
    """All that decides the bytes of a run."""
    content = {
        "format": FORMAT,
        "rsbench": __version__,
        "code": simulator_version(),
        "card": asdict(card),
        "solvers": [_identity(e) for e in solvers],
        "motions": {name: source_version(motion_model(name)) for name in _motions(card, solvers)},
        "cells": [asdict(cell) for cell in card.cells()],
    }
    return json.loads(json.dumps(content))  # as it will be read


def _motions(card: SweepCard, solvers: list[Entrant]) -> list[str]:
    """Motion models of the data and of the solvers."""
    return sorted({e.solver.spec.motion_model for e in solvers} | {c.setting.motion_model for c in card.cells()})


def _identity(e: Entrant) -> dict[str, Any]:
    spec = e.solver.spec
    return {
        "name": e.name,
        "key": e.entry.key,
        "information": e.information,
        "shutter": spec.shutter,
        "motion_model": spec.motion_model,
        "reference_point": spec.reference_point,
        "reference": spec.reference,
    }


def simulator_version() -> str:
    """Hash of the sources that decide what is simulated: the keys of solvers hold the rest."""
    package = resources.files("rsbench.benchmark")
    files = [package / "seeds.py", *(package / "simulated" / name for name in _SIMULATOR)]
    return hashlib.sha256(b"\n".join(file.read_bytes() for file in files)).hexdigest()


def _open_folder(plan: dict[str, Any], out: Path, force: bool) -> None:
    links = [out / kind for kind in _KINDS if (out / kind).is_symlink()]
    there = [path for kind in _KINDS for path in listed(out / kind, ".npz") if _OURS.fullmatch(path.name)]
    if links or (there and not (out / "sweep.json").is_file()):
        raise RsbenchError(
            f"{[*links, *there][0]}: 'rsbench simulate' did not make it; move it away or choose another --out"
        )
    if force:
        for path in there:
            path.unlink()
    elif (out / "sweep.json").is_file():
        other = _differences(read_sweep(out), plan)
        if other:
            what = "; ".join(other)
            raise RsbenchError(
                f"{out}: holds another sweep ({what}); choose another --out, or remake with --force"
            )
    for kind in _KINDS:
        (out / kind).mkdir(parents=True, exist_ok=True)
    write_json(out / "sweep.json", plan)


def _differences(stored: dict[str, Any], plan: dict[str, Any]) -> list[str]:
    """What keeps a stored run from being continued, in words."""
    fields = [key for key in plan["card"] if stored.get("card", {}).get(key) != plan["card"][key]]
    if fields:
        return [f"differs in {', '.join(fields)}"]
    old = {solver["name"]: solver for solver in stored.get("solvers", [])}
    changed = [solver["name"] for solver in plan["solvers"] if old.get(solver["name"]) != solver]
    words = [f"{', '.join(changed)} made by other code or another card"] if changed else []
    words += [
        f"{key} was {stored.get(key)}, is {plan[key]}" for key in ("rsbench",) if stored.get(key) != plan[key]
    ]
    if any(stored.get(key) != plan[key] for key in ("code", "motions")):
        words.append("simulated by other code")
    return words or (["differs in cells"] if stored.get("cells") != plan["cells"] else [])


def _compile(card: SweepCard) -> None:
    """Once, before the workers would each do it."""
    warm_up(_motions(card, entrants(card)))


def _run_all(todo: list[_Job], workers: Workers, time_limit_s: float | None) -> Iterator[_Part]:
    """Always in children, so that BLAS has one thread and one summation order whatever the parent has loaded."""
    one_thread = dict.fromkeys(THREAD_VARIABLES, "1")
    with closing(finished_jobs(_serve_jobs, todo, workers, one_thread, time_limit_s)) as found:
        for job, _ in found:
            yield job.part


def _serve_jobs(time_limit_s: float | None) -> Callable[[_Job], None]:
    """What does jobs, in a child."""
    use_one_thread()
    warm_up()
    runner = SolverRunner(time_limit_s=time_limit_s, single_thread=True)  # as long as this process

    def run(job: _Job) -> None:
        try:
            run_job(job, runner)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run


def run_job(job: _Job, runner: SolverRunner) -> None:
    """Simulate, solve and store one chunk.

    Raises:
        RsbenchError: a motion leaves too few points in view.
    """
    card, cell = job.card, job.part.cell
    if job.part.kind == "bounds":
        arrays = run_bounds(cell.setting, card.solvers, card.seed, job.first, job.trials)
    else:
        arrays = run_trials(
            cell.setting, card.solvers, card.seed, job.first, job.trials, robust=card.robust, runner=runner
        )
    save_arrays(job.path, arrays)


def _collect(card: SweepCard, part: _Part, out: Path, folder: Path) -> None:
    """Join the chunks of a part into its file."""
    path = part.path(out)
    if path.is_file():
        return
    chunks = [load_arrays(folder / part.chunk(first)) for first in _firsts(card)]
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
