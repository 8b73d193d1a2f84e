"""Run a sweep in chunks of trials; results do not depend on the number of workers.

The folder of a sweep contains

    sweep.json           the card, the solvers, the cells
    trials/NNN.npz       truth and predictions of a cell (see ``trials.run_trials``; reasons as codes)
    bounds/NNN.npz       Cramer-Rao bounds of all cells with the exact matches of NNN (see ``trials.run_bounds``)
    seconds/NNN.npz      run times of the solvers, which differ between runs
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.scoring import pose_errors
from rsbench.benchmark.simulated.sweep_card import Cell, SweepCard
from rsbench.benchmark.simulated.trials import Arrays, Entrant, enter, run_bounds, run_trials
from rsbench.benchmark.statistics import average_interval, share_interval, typical_interval, with_ends
from rsbench.components.cards import parse_card
from rsbench.components.imports import source_version
from rsbench.components.motion_models import motion_model
from rsbench.components.seeds import generator
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.core.version import __version__
from rsbench.jobs.isolation import ONE_THREAD, use_one_thread
from rsbench.jobs.process_jobs import Workers, finished_jobs
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import load_solver_entries
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import load_arrays, read_json, save_arrays, write_json, write_table
from rsbench.storage.work_folder import listed, remove, work_folder

FORMAT = 1
CHUNK = 50
"""Number of trials of one job."""
Progress = Callable[[str], None]
"""Function that is called with the name of the variant after each chunk."""
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
        """Return the file name of a chunk whose first trial is ``first``."""
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
    """Return the number of chunks, for the progress bar."""
    return len(_parts(card)) * len(_firsts(card))


def _firsts(card: SweepCard) -> range:
    """Return the number of the first trial of each chunk."""
    return range(0, card.trials, CHUNK)


def _parts(card: SweepCard) -> list[_Part]:
    cells = card.cells()
    own_bounds = [cell for cell in cells if geometry_of(card, cell).index == cell.index]
    return [_Part("trials", cell) for cell in cells] + [_Part("bounds", cell) for cell in own_bounds]


def geometry_of(card: SweepCard, cell: Cell) -> Cell:
    """Return the first cell with the same exact matches; noise and the inputs of solvers may differ."""
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
    """Run the chunks of a sweep that are not yet in ``out``.

    An exception such as Ctrl-C ends all processes at once; finished chunks are kept.

    Args:
        card: the experiment.
        out: folder of the results, created if missing.
        workers: number of processes, each with one thread.
        progress: see ``Progress``.
        time_limit_s: time limit per problem for solvers of other packages, instead of that of their cards.
        force: whether to run all chunks again.

    Raises:
        RsbenchError: a solver does not exist, or two have the same name; ``out`` contains another sweep; too few
            points are in view under a motion; workers were killed repeatedly on the same trials.
    """
    step, solvers = progress or (lambda word: None), entrants(card)
    with work_folder(out) as hidden:
        chunks = hidden / "chunks"
        if force:
            remove(chunks)
        _open_folder(_plan(card, solvers), out, force)
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
            warm_up(_motions(card, solvers))  # compile once, instead of in every worker
        for part in _run_all(todo, workers, time_limit_s):
            step(part.cell.variant)
        for part in _parts(card):
            _collect(card, part, out, chunks)
        remove(chunks)


def read_trials(out: Path, card: SweepCard, cell: Cell) -> Arrays:
    """Read the stored truth and predictions of a cell.

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
    """Read the stored bounds of a cell, for a noise of 1 px.

    Raises:
        RsbenchError: the file is damaged.
    """
    path = _Part("bounds", geometry_of(card, cell)).path(out)
    return _checked(load_arrays(path), path, card, _BOUNDS)


_SAID = ("name", "information", "shutter", "motion_model", "reference_point")
"""Required keys of each solver in sweep.json."""
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
"""Kind of the dtype of each array, and its shape after the axis of trials; 0 stands for the number of solvers."""


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
    """Read the sweep.json of a finished run.

    Raises:
        RsbenchError: the file is missing, damaged, or of another format.
    """
    path = folder / "sweep.json"
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise RsbenchError(f"{path}: format = {content.get('format')!r}: must be {FORMAT}")
    solvers = content.get("solvers")
    solvers = solvers if isinstance(solvers, list) else [solvers]
    stated = [[one.get(key) for key in _SAID] if isinstance(one, dict) else [None] for one in solvers]
    if not (
        isinstance(content.get("card"), dict) and all(isinstance(word, str) for words in stated for word in words)
    ):
        raise RsbenchError(
            f"{path}: card or solvers are damaged; choose another --out, or remake all with --force"
        )
    return content


def entrants(card: SweepCard) -> list[Entrant]:
    """Load the solvers of a card.

    Raises:
        RsbenchError: a solver does not exist, or two have the same name, which must be unique in tables and seeds.
    """
    return [enter(entry) for entry in load_solver_entries(card.solvers)]


def _plan(card: SweepCard, solvers: list[Entrant]) -> dict[str, Any]:
    """Return all data that determine the results of a run."""
    content = {
        "format": FORMAT,
        "rsbench": __version__,
        "code": simulator_version(),
        "card": asdict(card) | {"setting": card.setting.record},
        "solvers": [_identity(e) for e in solvers],
        "motions": {name: source_version(motion_model(name)) for name in _motions(card, solvers)},
        "cells": [asdict(cell) | {"setting": cell.setting.record} for cell in card.cells()],
        **_rigs(card),
    }
    return json.loads(json.dumps(content))  # as it will be read


def _rigs(card: SweepCard) -> dict[str, Any]:
    """Return the contents of the rig cards that a sweep names; empty if it names none."""
    named = {cell.setting.rig_card: cell.setting.tables for cell in card.cells()}
    found = {
        name: asdict(tables) for name, tables in named.items() if isinstance(name, str) and tables is not None
    }
    return {"rigs": found} if found else {}


def _motions(card: SweepCard, solvers: list[Entrant]) -> list[str]:
    """Return the motion models of the data and of the solvers."""
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
    """Return a hash of the sources of the simulation; the keys of solvers include their own sources."""
    package = resources.files("rsbench")
    simulator = package / "benchmark" / "simulated"
    files = [package / "components" / "seeds.py", *(simulator / name for name in _SIMULATOR)]
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
    """Return the differences between a stored run and a plan, in words; with any, the run cannot be continued."""
    fields = [key for key in plan["card"] if stored.get("card", {}).get(key) != plan["card"][key]]
    if fields:
        return [f"differs in {', '.join(fields)}"]
    old = {solver["name"]: solver for solver in stored.get("solvers", [])}
    changed = [solver["name"] for solver in plan["solvers"] if old.get(solver["name"]) != solver]
    words = [f"{', '.join(changed)} made by other code or another card"] if changed else []
    if stored.get("rsbench") != plan["rsbench"]:
        words.append(f"rsbench was {stored.get('rsbench')}, is {plan['rsbench']}")
    if stored.get("rigs") != plan.get("rigs"):
        words.append("of other rigs")
    if any(stored.get(key) != plan[key] for key in ("code", "motions")):
        words.append("simulated by other code")
    return words or (["differs in cells"] if stored.get("cells") != plan["cells"] else [])


def _run_all(todo: list[_Job], workers: Workers, time_limit_s: float | None) -> Iterator[_Part]:
    """Run jobs in child processes with one BLAS thread, which fixes the order of sums; yield their parts."""
    with closing(finished_jobs(_serve_jobs, todo, workers, ONE_THREAD, time_limit_s)) as found:
        for job, _ in found:
            yield job.part


def _serve_jobs(time_limit_s: float | None) -> Callable[[_Job], None]:
    """Return the function that runs jobs in a child process."""
    use_one_thread()
    warm_up()
    runner = SolverRunner(time_limit_s=time_limit_s, single_thread=True)  # lives as long as this process
    return lambda job: run_job(job, runner)


def run_job(job: _Job, runner: SolverRunner) -> None:
    """Simulate, solve and store one chunk.

    Raises:
        RsbenchError: too few points are in view under a motion.
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
    """Replace reasons by their indices in a list of distinct reasons."""
    reasons, codes = np.unique(arrays.pop("reason"), return_inverse=True)
    shape = arrays["success"].shape
    return {**arrays, "reason_code": codes.reshape(shape).astype(np.int32), "reasons": reasons}


SUCCESS_DEG = (1.0, 5.0)
"""A trial counts as solved when e_R and e_T are below these."""
OBSERVABLE = 0.5
"""Standard deviation of the direction of d (radians), or of its relative length, that makes it unobservable."""
SHOWN_REASONS = 3
_IDEAL_DRAWS = 100


def read_card(folder: Path) -> SweepCard:
    """Read the card from which a folder of results was made.

    Raises:
        RsbenchError: the folder holds no sweep.
    """
    return parse_card(SweepCard, read_sweep(folder)["card"], str(folder / "sweep.json"))


def summarise_sweep(folder: Path) -> pd.DataFrame:
    """Write summary.csv, one row per solver and cell, from the stored trials; returns it.

    Raises:
        RsbenchError: the folder holds no sweep, or a damaged one.
    """
    card, solvers = read_card(folder), read_sweep(folder)["solvers"]
    if len(solvers) != len(card.solvers):
        raise RsbenchError(f"{folder / 'sweep.json'}: solvers: {len(solvers)}, the card has {len(card.solvers)}")
    rows = []
    for cell in card.cells():
        trials, bounds = read_trials(folder, card, cell), read_bounds(folder, card, cell)
        for number, solver in enumerate(solvers):
            scores = score_trials(trials, number, solver["reference_point"], cell)
            limit = {key: _scaled(values[:, number], cell.setting.noise_px) for key, values in bounds.items()}
            row: dict[str, Any] = {
                "sweep": card.name,
                "variant": cell.variant,
                "axis": card.axis,
                "value": cell.value,
            }
            row |= {"solver": solver["name"], "shutter": solver["shutter"], "information": solver["information"]}
            row |= {"ransac": card.robust, "seed": card.seed}
            row |= summary_row(scores, trials["success"][:, number], limit, card.seed)
            row |= {"motion_model": cell.setting.motion_model, "assumed_motion": solver["motion_model"]}
            rows.append(row | {"failure_reasons": failure_reasons(trials, number)})
    table = pd.DataFrame(rows)
    write_table(folder / "summary.csv", table)
    return table


def _scaled(bounds: FloatArray, noise_px: float) -> FloatArray:
    """Scale bounds to a noise level; unobservable quantities stay infinite, also without noise."""
    known = np.isfinite(bounds)
    return np.where(known, noise_px * np.where(known, bounds, 0.0), np.inf)


def score_trials(arrays: Arrays, solver: int, reference_point: str, cell: Cell) -> dict[str, FloatArray]:
    """Return e_R_deg, e_T_deg and e_s (trials,) of one solver, see ``scoring.pose_errors``."""
    return pose_errors(
        arrays["w_est"][:, solver],
        arrays["d_est"][:, solver],
        true_w=arrays["w"],
        true_d=arrays["d"],
        rig=cell.setting.rig(),
        success=arrays["success"][:, solver],
        metric=arrays["metric"][:, solver],
        reference_point=reference_point,
    )


def failure_reasons(arrays: Arrays, solver: int) -> str:
    """Return the reasons of a solver's failures, such as ``3 x took longer than 60 s``, most frequent first."""
    codes = arrays["reason_code"][~arrays["success"][:, solver], solver]
    counts = Counter(str(arrays["reasons"][code]) for code in codes)
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    words = [f"{count} x {reason}" for reason, count in ranked[:SHOWN_REASONS]]
    rest = sum(count for _, count in ranked[SHOWN_REASONS:])
    return "; ".join([*words, *([f"{rest} x others"] if rest else [])])


def summary_row(
    scores: dict[str, FloatArray], success: NDArray[np.bool_], limit: Arrays, seed: int
) -> dict[str, Any]:
    """Compute the statistics of one solver in one cell.

    Args:
        scores: see ``score_trials``.
        success: (trials,) whether the solver succeeded.
        limit: bounds ``rotation`` (trials, 3) and ``direction`` (trials, 2) along their principal axes (radians),
            and ``scale`` (trials,), at the noise of the cell.
        seed: seed of the bootstrap.

    Returns:
        Columns of summary.csv; errors that the data cannot determine are None, and ``unobservable`` names them.
    """
    e_R, e_T = scores["e_R_deg"], scores["e_T_deg"]
    solved = success & (e_R < SUCCESS_DEG[0]) & ~(e_T >= SUCCESS_DEG[1])
    low, high = share_interval(int(np.count_nonzero(solved)), len(solved))
    row: dict[str, Any] = {
        "trials": len(success),
        "failures": int(np.count_nonzero(~success)),
        "success_share": float(np.mean(solved)),
        "success_low": low,
        "success_high": high,
    }
    total = {"direction": np.linalg.norm(limit["direction"], axis=-1), "scale": limit["scale"]}
    known = {name: total[name] <= OBSERVABLE for name in total}
    hidden = {name: np.mean(known[name]) < 0.5 for name in known}
    row["unobservable"] = " and ".join(name for name in known if hidden[name])
    finite = np.all(np.isfinite(limit["rotation"]), axis=-1)
    for name, values, usable in (("e_R", e_R, finite), ("e_T", e_T, known["direction"])):
        hide = name == "e_T" and hidden["direction"]
        shown = np.full(len(values), np.nan) if hide else values
        axes = np.rad2deg(limit["rotation" if name == "e_R" else "direction"][usable])
        found = statistics(shown, seed) | over_bound(shown[usable], np.linalg.norm(axes, axis=-1), seed)
        found |= at_bound(axes, seed) if found["bound"] is not None else dict.fromkeys(_AT_BOUND)
        row |= {f"{name}_{key}": value for key, value in found.items()}
    metric = scores["e_s"][~np.isnan(scores["e_s"])]
    row["metric_share"] = len(metric) / len(success)
    has_scale = len(metric) > 0 and not hidden["scale"]
    numbers = (np.median(metric), *typical_interval(metric, seed)) if has_scale else (None, None, None)
    row |= with_ends("e_s_median", *numbers)
    row["e_s_bound"] = float(_rms(limit["scale"][known["scale"]])) if not hidden["scale"] else None
    return row


_AT_BOUND = ("bound_median", "bound_mean")
_OVER_BOUND = ("rms", "bound", "over_bound", "over_bound_low", "over_bound_high")


def at_bound(axes: FloatArray, seed: int) -> dict[str, float]:
    """Return the median and mean error of a solver with Gaussian errors at the bound, for comparison.

    Args:
        axes: standard deviations (trials, k) along the principal axes of the error, a vector of k numbers.
        seed: seed of the random errors, whose sampling changes the mean of 300 trials by 0.4 %.
    """
    draws = generator(seed, "at bound", *axes.shape).standard_normal((_IDEAL_DRAWS, *axes.shape))
    errors = np.linalg.norm(axes * draws, axis=-1)
    return dict(zip(_AT_BOUND, (float(np.median(errors)), float(np.mean(errors))), strict=True))


def over_bound(values: FloatArray, sigmas: FloatArray, seed: int) -> dict[str, float | None]:
    """Return the root mean square of errors (n,), that of their bounds (n,), and the quotient with its interval.

    Values that do not exist are None.
    """
    found: dict[str, float | None] = dict.fromkeys(_OVER_BOUND)
    if not len(values) or np.any(np.isnan(values)):
        return found
    rms, bound = float(_rms(values)), float(_rms(sigmas))
    found |= {"rms": rms, "bound": bound}
    if bound == 0.0:
        return found
    squares = np.stack([values**2, sigmas**2], axis=-1)
    ends = average_interval(squares, seed, lambda means: np.sqrt(means[..., 0] / means[..., 1]))
    return found | with_ends("over_bound", rms / bound, *ends)


def _rms(values: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(values**2))


def statistics(values: FloatArray, seed: int) -> dict[str, float | None]:
    """Return median and mean with their intervals, and the 90th percentile; all None if any value is NaN."""
    names = ("median", "median_low", "median_high", "mean", "mean_low", "mean_high", "p90")
    if np.any(np.isnan(values)):
        return dict.fromkeys(names)
    median, mean = typical_interval(values, seed), average_interval(values, seed)
    numbers: list[Any] = [np.median(values), *median, np.mean(values), *mean, np.quantile(values, 0.9)]
    return {name: float(number) for name, number in zip(names, numbers, strict=True)}


MEASURES = ("e_R_deg", "e_T_deg")


def errors_of_rows(table: pd.DataFrame, folder: Path) -> dict[str, NDArray[np.float32]]:
    """Return ``MEASURES``, each (rows, trials), for the rows of a summary, from the folder of its sweep.

    Failures have the worst value, as in the summary.

    Raises:
        RsbenchError: the folder contains no sweep.
    """
    found: dict[tuple[object, ...], dict[str, NDArray[np.float32]]] = {}
    card, solvers = read_card(folder), read_sweep(folder)["solvers"]
    for cell in card.cells():
        trials = read_trials(folder, card, cell)
        for number, solver in enumerate(solvers):
            scores = score_trials(trials, number, solver["reference_point"], cell)
            key = (cell.variant, cell.value, solver["name"])
            found[key] = {name: scores[name].astype(np.float32) for name in MEASURES}
    keys = [(row.variant, row.value, row.solver) for row in table.itertuples(index=False)]
    return {name: np.stack([found[key][name] for key in keys]) for name in MEASURES}
