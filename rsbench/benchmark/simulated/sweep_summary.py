"""Scores and statistics of stored trials; no solver runs here."""

from __future__ import annotations

from collections import Counter
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
from rsbench.benchmark.statistics import average_interval, share_interval, typical_interval
from rsbench.components.cards import parse_card
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.storage.files import write_table

SUCCESS_DEG = (1.0, 5.0)
"""A trial counts as solved when e_R and e_T are below these."""
OBSERVABLE = 0.5
"""Standard deviation of the direction of d (radians), or of its relative length, above which it is not known."""
SHOWN_REASONS = 3
_IDEAL_DRAWS = 100


def read_card(folder: Path) -> SweepCard:
    """The card that a folder was made from.

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
            identity = {
                "sweep": card.name,
                "variant": cell.variant,
                "axis": card.axis,
                "value": cell.value,
                "solver": solver["name"],
                "shutter": solver["shutter"],
                "information": solver["information"],
                "ransac": card.robust,
                "seed": card.seed,
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
        limit: bounds ``rotation`` (trials, 3) and ``direction`` (trials, 2) along their principal axes (radians),
            and ``scale`` (trials,), at the noise of the cell.
        seed: of the bootstrap.

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
    row |= dict(zip(("e_s_median", "e_s_median_low", "e_s_median_high"), numbers, strict=True))
    row["e_s_bound"] = float(_rms(limit["scale"][known["scale"]])) if not hidden["scale"] else None
    return row


_AT_BOUND = ("bound_median", "bound_mean")


def at_bound(axes: FloatArray, seed: int) -> dict[str, float]:
    """Median and mean of the errors of a solver with Gaussian errors at the bound: the bound of each statistic.

    Args:
        axes: standard deviations (trials, k) along the principal axes of the error, a vector of k numbers.
        seed: of the draws, which leave 0.4 % of the mean of 300 trials open.
    """
    draws = generator(seed, "at bound", *axes.shape).standard_normal((_IDEAL_DRAWS, *axes.shape))
    errors = np.linalg.norm(axes * draws, axis=-1)
    return dict(zip(_AT_BOUND, (float(np.median(errors)), float(np.mean(errors))), strict=True))


def over_bound(values: FloatArray, sigmas: FloatArray, seed: int) -> dict[str, float | None]:
    """Root mean square of errors (n,), of their bounds (n,), and the quotient with its interval.

    None where they do not exist.
    """
    if len(values) == 0 or np.any(np.isnan(values)):
        return dict.fromkeys(("rms", "bound", "over_bound", "over_bound_low", "over_bound_high"))
    rms, bound = float(_rms(values)), float(_rms(sigmas))
    if bound == 0.0:
        return {"rms": rms, "bound": bound, "over_bound": None, "over_bound_low": None, "over_bound_high": None}
    low, high = average_interval(np.stack([values**2, sigmas**2], axis=-1), seed, _rms_quotient)
    return {"rms": rms, "bound": bound, "over_bound": rms / bound, "over_bound_low": low, "over_bound_high": high}


def _rms_quotient(means: FloatArray) -> FloatArray:
    return np.sqrt(means[..., 0] / means[..., 1])


def _rms(values: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(values**2))


def statistics(values: FloatArray, seed: int) -> dict[str, float | None]:
    """Median and mean with their intervals, and the 90th percentile; None when a value does not exist."""
    names = ("median", "median_low", "median_high", "mean", "mean_low", "mean_high", "p90")
    if np.any(np.isnan(values)):
        return dict.fromkeys(names)
    median, mean = typical_interval(values, seed), average_interval(values, seed)
    numbers: list[Any] = [np.median(values), *median, np.mean(values), *mean, np.quantile(values, 0.9)]
    return {name: float(number) for name, number in zip(names, numbers, strict=True)}
