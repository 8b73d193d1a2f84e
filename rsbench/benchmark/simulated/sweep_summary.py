"""Scores and statistics of stored trials; no solver runs here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.scoring import pose_errors
from rsbench.benchmark.seeds import generator
from rsbench.benchmark.simulated.run_sweep import read_bounds, read_sweep, read_trials
from rsbench.benchmark.simulated.sweep_card import Cell, SweepCard
from rsbench.benchmark.simulated.trials import Arrays
from rsbench.cards import parse_card
from rsbench.core.so3 import FloatArray
from rsbench.dataset.files import write_table

SUCCESS_DEG = (1.0, 5.0)
"""A trial counts as solved when e_R and e_T are below these."""
OBSERVABLE = 0.5
"""Standard deviation of the direction of d (radians), or of its relative length, above which it is not known."""
RESAMPLES = 1000
SHOWN_REASONS = 3
COVERAGE = 0.95
Statistic = Callable[[FloatArray], FloatArray]
"""Reduces the axis of trials of resampled values (resamples, trials, ...)."""


def read_card(folder: Path) -> SweepCard:
    """The card that a folder was made from.

    Raises:
        RsbenchError: the folder holds no sweep.
    """
    return parse_card(SweepCard, read_sweep(folder)["card"], str(folder / "sweep.json"))


def summarise_sweep(folder: Path) -> pd.DataFrame:
    """Write summary.csv, one row per solver and cell, from the stored trials; returns it.

    Raises:
        RsbenchError: the folder holds no sweep.
    """
    card, solvers = read_card(folder), read_sweep(folder)["solvers"]
    rows = []
    for cell in card.cells():
        trials, bounds = read_trials(folder, cell), read_bounds(folder, card, cell)
        for number, solver in enumerate(solvers):
            scores = score_trials(trials, number, solver["reference_point"], cell)
            limit = {name: _scaled(values[:, number], cell.setting.noise_px) for name, values in bounds.items()}
            identity = {
                "sweep": card.name,
                "variant": cell.variant,
                "axis": card.axis,
                "value": cell.value,
                "solver": solver["name"],
                "shutter": solver["shutter"],
                "information": solver["information"],
                "ransac": card.robust,
            }
            row = identity | summary_row(scores, trials["success"][:, number], limit, card.seed)
            row["motion_model"] = cell.setting.motion_model
            row["assumed_motion"] = solver["motion_model"]
            row["failure_reasons"] = failure_reasons(trials, number)
            rows.append(row)
    table = pd.DataFrame(rows)
    write_table(folder / "summary.csv", table)
    return table


def _scaled(bounds: FloatArray, noise_px: float) -> FloatArray:
    """Bounds at a noise; what the matches do not tell stays unknown without noise too."""
    known = np.isfinite(bounds)
    return np.where(known, noise_px * np.where(known, bounds, 0.0), np.inf)


def score_trials(arrays: Arrays, solver: int, reference_point: str, cell: Cell) -> dict[str, FloatArray]:
    """e_R_deg, e_T_deg and e_s (trials,) of one solver: see ``scoring.pose_errors``."""
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
    """Why trials of a solver failed, the most frequent reasons first: ``3 x took longer than 60 s``."""
    codes = arrays["reason_code"][~arrays["success"][:, solver], solver]
    counts = Counter(str(arrays["reasons"][code]) for code in codes)
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    words = [f"{count} x {reason}" for reason, count in ranked[:SHOWN_REASONS]]
    rest = sum(count for _, count in ranked[SHOWN_REASONS:])
    return "; ".join([*words, *([f"{rest} x others"] if rest else [])])


def summary_row(
    scores: dict[str, FloatArray], success: NDArray[np.bool_], limit: Arrays, seed: int
) -> dict[str, Any]:
    """Statistics of one solver in one cell.

    Args:
        scores: see ``score_trials``.
        success: (trials,).
        limit: bounds ``rotation`` and ``direction`` (radians) and ``scale`` (trials,) at the noise of the cell.
        seed: of the bootstrap.

    Returns:
        Columns of summary.csv; errors that the data cannot determine are None, and ``unobservable`` names them.
    """
    e_R, e_T = scores["e_R_deg"], scores["e_T_deg"]
    solved = success & (e_R < SUCCESS_DEG[0]) & ~(e_T >= SUCCESS_DEG[1])
    low, high = bootstrap_interval(solved.astype(np.float64), _mean, seed)
    row: dict[str, Any] = {
        "trials": len(success),
        "failures": int(np.count_nonzero(~success)),
        "success_share": float(np.mean(solved)),
        "success_low": low,
        "success_high": high,
    }
    known = {name: limit[name] <= OBSERVABLE for name in ("direction", "scale")}
    hidden = {name: np.mean(known[name]) < 0.5 for name in known}
    row["unobservable"] = " and ".join(name for name in known if hidden[name])
    sigmas = {"e_R": np.rad2deg(limit["rotation"]), "e_T": np.rad2deg(limit["direction"])}
    for name, values, usable in (("e_R", e_R, np.isfinite(limit["rotation"])), ("e_T", e_T, known["direction"])):
        hide = name == "e_T" and hidden["direction"]
        shown = np.full(len(values), np.nan) if hide else values
        found = statistics(shown, seed) | over_bound(shown[usable], sigmas[name][usable], seed)
        row |= {f"{name}_{key}": value for key, value in found.items()}
    metric = scores["e_s"][~np.isnan(scores["e_s"])]
    row["metric_share"] = len(metric) / len(success)
    row["e_s_median"] = float(np.median(metric)) if len(metric) and not hidden["scale"] else None
    row["e_s_bound"] = float(_rms(limit["scale"][known["scale"]])) if not hidden["scale"] else None
    return row


def over_bound(values: FloatArray, sigmas: FloatArray, seed: int) -> dict[str, float | None]:
    """Root mean square of errors (n,), of their bounds (n,), and the quotient with its interval.

    None where they do not exist.
    """
    if len(values) == 0 or np.any(np.isnan(values)):
        return dict.fromkeys(("rms", "bound", "over_bound", "over_bound_low", "over_bound_high"))
    rms, bound = float(_rms(values)), float(_rms(sigmas))
    if bound == 0.0:
        return {"rms": rms, "bound": bound, "over_bound": None, "over_bound_low": None, "over_bound_high": None}
    squares = np.stack([values**2, sigmas**2], axis=-1)
    low, high = bootstrap_interval(squares, _rms_quotient, seed)
    return {"rms": rms, "bound": bound, "over_bound": rms / bound, "over_bound_low": low, "over_bound_high": high}


def _rms_quotient(squares: FloatArray) -> FloatArray:
    means = np.mean(squares, axis=-2)
    return np.sqrt(means[..., 0] / means[..., 1])


def _rms(values: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(values**2))


def statistics(values: FloatArray, seed: int) -> dict[str, float | None]:
    """Median and mean with their intervals, and the 90th percentile; None when a value does not exist."""
    names = ("median", "median_low", "median_high", "mean", "mean_low", "mean_high", "p90")
    if np.any(np.isnan(values)):
        return dict.fromkeys(names)
    median, mean = bootstrap_interval(values, _median, seed), bootstrap_interval(values, _mean, seed)
    numbers: list[Any] = [np.median(values), *median, np.mean(values), *mean, np.quantile(values, 0.9)]
    return {name: float(number) for name, number in zip(names, numbers, strict=True)}


def _median(values: FloatArray) -> FloatArray:
    return np.asarray(np.median(values, axis=-1))


def _mean(values: FloatArray) -> FloatArray:
    return np.asarray(np.mean(values, axis=-1))


def bootstrap_interval(
    values: FloatArray, statistic: Statistic, seed: int, resamples: int = RESAMPLES
) -> tuple[float, float]:
    """Percentile interval of a statistic of values (n, ...) that holds with probability ``COVERAGE``.

    All calls with the same n and seed draw the same trials, so that solvers are compared on common draws.
    """
    rng = generator(seed, "bootstrap", len(values))
    drawn = values[rng.integers(0, len(values), (resamples, len(values)))]
    tail = 0.5 * (1.0 - COVERAGE)
    low, high = np.quantile(statistic(drawn), [tail, 1.0 - tail])
    return float(low), float(high)
