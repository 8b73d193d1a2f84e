"""From which bias, noise or delay of a gyroscope on vision alone errs less, with intervals, and a figure.

    for each in bias noise delay; do rsbench simulate gyro-$each --out DATA/gyro-$each; done    # some minutes
    python benchmarks/gyro_crossing.py DATA --out results/gyro

A crossing is where the median error with a gyroscope becomes that of vision alone on the same trials. Between two
values of the sweep the squares of the medians are taken as linear in the square of the value: those of
independent errors are. Intervals are of 95 %, by a bootstrap over the trials, which both solvers share. A crossing
of 0 says that vision alone errs less even beside an exact gyroscope; one beyond the sweep is infinite.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.simulated.run_sweep import read_card, read_sweep, read_trials, score_trials
from rsbench.benchmark.simulated.sweep_card import load_sweep
from rsbench.benchmark.statistics import bootstrap_interval, format_interval, typical_interval
from rsbench.core.so3 import FloatArray
from rsbench.storage.files import write_json, write_table

SWEEPS = ("gyro-bias", "gyro-noise", "gyro-delay")
FRAMES_PER_S = 30.0
PAIRS = (
    ("rs-gyro-5pt", "rs-mono-refined"),
    ("rs-gyro-stereo", "rs-stereo-refined-pairs"),
    ("rs-gyro-stereo", "rs-stereo-refined"),
)
"""A solver with a gyroscope, and vision alone; the first two on the same matches."""
MEASURES = {"e_R_deg": "e_R", "e_T_deg": "e_T", "e_s": "e_s"}
UNITS = {"gyro-bias": "deg/s", "gyro-noise": "deg/s", "gyro-delay": "ms"}
FACTORS = {"gyro-bias": FRAMES_PER_S, "gyro-noise": FRAMES_PER_S, "gyro-delay": 1e3 / FRAMES_PER_S}
Scores = dict[tuple[str, str], FloatArray]
"""Errors (values, trials) by solver and measure; a length that is not found errs infinitely."""


def read_scores(folder: Path) -> Iterator[tuple[str, FloatArray, Scores]]:
    """Of each variant of a sweep: its name, the values and the errors."""
    card, solvers = read_card(folder), read_sweep(folder)["solvers"]
    for variant in dict.fromkeys(cell.variant for cell in card.cells()):
        cells = [cell for cell in card.cells() if cell.variant == variant]
        found: dict[tuple[str, str], list[FloatArray]] = {}
        for cell in cells:
            trials = read_trials(folder, card, cell)
            for number, solver in enumerate(solvers):
                scores = score_trials(trials, number, solver["reference_point"], cell)
                for name in MEASURES:
                    found.setdefault((solver["name"], name), []).append(
                        np.where(np.isnan(scores[name]), np.inf, scores[name])
                    )
        yield (
            variant,
            np.array([cell.value for cell in cells]),
            {key: np.array(rows) for key, rows in found.items()},
        )


def crossing(values: FloatArray, gyro: FloatArray, vision: FloatArray) -> FloatArray:
    """The first value (...) from which on the error with a gyroscope is the larger one, of medians (..., k)."""
    above = gyro > vision
    first = np.argmax(above, axis=-1)
    last = np.maximum(first - 1, 0)

    def at(rows: FloatArray, k: FloatArray) -> FloatArray:
        return np.take_along_axis(rows, k[..., None], axis=-1)[..., 0]

    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        gap = gyro**2 - vision**2
        low, high = at(gap, last), at(gap, first)
        share = np.where(np.isfinite(high - low) & (high > low), -low / (high - low), 1.0)
    square = values[last] ** 2 + share * (values[first] ** 2 - values[last] ** 2)
    found = np.where(first == 0, values[0], np.sqrt(square))
    return np.where(np.any(above, axis=-1), found, np.inf)


def crossing_row(values: FloatArray, gyro: FloatArray, vision: FloatArray, seed: int) -> dict[str, Any]:
    """The crossing of errors (values, trials) of two solvers, and its interval."""
    k = len(values)

    def of(drawn: FloatArray) -> FloatArray:
        middle = np.median(drawn, axis=1)
        return crossing(values, middle[:, :k], middle[:, k:])

    both = np.concatenate([gyro, vision]).T
    low, high = bootstrap_interval(both, of, seed)
    return {"crossing": float(of(both[None])[0]), "low": low, "high": high}


def tables(data: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Medians of all solvers, and crossings, in the units of ``UNITS``."""
    medians, crossings = [], []
    for sweep in SWEEPS:
        seed = read_card(data / sweep).seed
        for variant, values, scores in read_scores(data / sweep):
            told = {"sweep": sweep, "variant": variant, "unit": UNITS[sweep]}
            scaled = values * FACTORS[sweep]
            for (solver, measure), rows in scores.items():
                if np.all(np.isinf(rows)):  # a length, of one camera
                    continue
                for value, row in zip(scaled, rows, strict=True):
                    low, high = typical_interval(row, seed)
                    found = {"median": float(np.median(row)), "low": low, "high": high}
                    found |= {"trials": len(row), "known": float(np.mean(np.isfinite(row)))}
                    medians.append(told | {"value": value, "solver": solver, "measure": measure} | found)
            for gyro, vision in PAIRS:
                for measure in MEASURES:
                    with_it, without = scores[gyro, measure], scores[vision, measure]
                    if not np.all(np.isinf(with_it)):
                        row = crossing_row(scaled, with_it, without, seed)
                        crossings.append(told | {"gyro": gyro, "vision": vision, "measure": measure} | row)
    return pd.DataFrame(medians), pd.DataFrame(crossings)


def shown(crossings: pd.DataFrame) -> list[str]:
    """Rows of Markdown for docs/explanation/monocular.md: crossings of angles, of each pair of solvers."""
    lines = []
    angles = crossings[crossings.measure != "e_s"]
    for (sweep, variant, measure), rows in angles.groupby(["sweep", "variant", "measure"], sort=False):
        most = max(load_sweep(str(sweep)).values) * FACTORS[str(sweep)]
        cells = [
            format_interval(row.crossing, row.low, row.high) if np.isfinite(row.low) else f"beyond {most:g}"
            for row in rows.itertuples(index=False)
        ]
        name = str(sweep).removeprefix("gyro-") + ("" if variant == "all" else f", {variant}")
        lines.append(f"| {name} ({UNITS[str(sweep)]}) | {MEASURES[str(measure)]} | {' | '.join(cells)} |")
    return lines


_STYLES: dict[str, dict[str, Any]] = {
    "rs-gyro-stereo": {"color": "#0072B2", "linestyle": "-", "marker": "o"},
    "rs-gyro-5pt": {"color": "#56B4E9", "linestyle": "--", "marker": "s"},
    "rs-stereo-refined": {"color": "#D55E00", "linestyle": "-", "marker": "D"},
    "rs-stereo-refined-pairs": {"color": "#D55E00", "linestyle": ":", "marker": "^"},
    "rs-mono-refined": {"color": "#E69F00", "linestyle": "--", "marker": "v"},
}
"""Blue with a gyroscope, orange without; lines tell them apart in grey."""
_TITLES = {"gyro-bias": "bias", "gyro-noise": "noise of a sample, 600 Hz", "gyro-delay": "delay"}


def draw(medians: pd.DataFrame, path: Path) -> None:
    """Medians with 95 % bands over bias, noise and delay, for rotation and direction."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    columns = list(medians.groupby(["sweep", "variant"], sort=False).groups)
    settings = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "lines.markersize": 4}
    with plt.style.context("default"), plt.rc_context(settings):
        figure, grid = plt.subplots(2, len(columns), figsize=(3.3 * len(columns), 6.6), sharey="row", sharex="col")
        for column, (sweep, variant) in enumerate(columns):
            here = medians[(medians.sweep == sweep) & (medians.variant == variant)]
            least = float(here.value[here.value > 0].min())
            for axes, measure in zip(grid[:, column], ("e_R_deg", "e_T_deg"), strict=True):
                for solver, style in _STYLES.items():
                    rows = here[(here.solver == solver) & (here.measure == measure)]
                    axes.plot(rows.value, rows["median"].where(rows["median"] > 1e-9), label=solver, **style)
                    axes.fill_between(
                        rows.value, rows.low, rows.high, color=style["color"], alpha=0.2, linewidth=0
                    )
                axes.set_xscale("symlog", linthresh=least, linscale=0.5)
                axes.set_yscale("log")
                axes.grid(True, color="0.88", linewidth=0.6)
                axes.set_xlim(left=0.0)
                ticks = [0.0, *(each for each in (0.1, 1.0, 10.0) if each <= here.value.max())]
                axes.set_xticks(ticks, [f"{each:g}" for each in ticks])
            grid[0, column].set_title(_TITLES[sweep] + ("" if variant == "all" else f", {variant}"), loc="left")
            grid[1, column].set_xlabel(f"{sweep.removeprefix('gyro-')} ({UNITS[sweep]})")
        grid[0, 0].set_ylim(bottom=1e-3)
        for axes, name in zip(grid[:, 0], ("e_R_deg", "e_T_deg"), strict=True):
            axes.set_ylabel(f"median {MEASURES[name]} (deg)")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper center", ncol=len(labels), frameon=False)
        figure.tight_layout(rect=(0, 0, 1, 0.95))
        figure.savefig(path, dpi=110, metadata={"Software": None})
        plt.close(figure)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="holds gyro-bias, gyro-noise and gyro-delay")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    medians, crossings = tables(options.data)
    write_table(options.out / "medians.csv", medians)
    write_table(options.out / "crossings.csv", crossings)
    draw(medians, options.out / "gyro.png")
    cards = {sweep: read_card(options.data / sweep) for sweep in SWEEPS}
    inputs = {sweep: {"seed": card.seed, "trials": card.trials} for sweep, card in cards.items()}
    command = f"python benchmarks/gyro_crossing.py DATA --out {options.out.as_posix()}"
    write_json(options.out / "provenance.json", provenance(command, frames_per_s=FRAMES_PER_S, **inputs))
    sys.stdout.write("\n".join(shown(crossings)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
