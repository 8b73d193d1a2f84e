"""Whether a method of a paper would do better with other thresholds, refinement or search than its card has.

    nice python benchmarks/tune_solvers.py --out results/tuning                   # a quarter of an hour
    nice python benchmarks/tune_solvers.py --out results/tuning --solver rs-r6p    # those rows; others are kept
    nice python benchmarks/tune_solvers.py --out out --solver examples/solvers/opencv_usac.py:opencv_usac

Problems are drawn as those of the track `points`, of a seed of which nothing is published; gravity and gyroscopes,
where a card asks for them, with the noise below. One option at a time differs from the card: the largest error of
an inlier (half, twice), local optimisation (off), the refinement and the start that the card may choose. All
settings of a card see the same problems and draw from the same random numbers.

Scored is AUC@5 as on the track. A setting is better where the mean difference to the card lies above 0.001 with
its whole interval, of 95 % for all settings of a card together; where none is, the card stands.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.splits import POINTS_1
from rsbench.benchmark.leaderboard.track import PUBLIC_SEED
from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.scoring import pose_errors
from rsbench.benchmark.simulated.simulation import Simulation, simulate
from rsbench.benchmark.statistics import COVERAGE, RESAMPLES, average_interval
from rsbench.components.seeds import generator
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import Solver, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import write_json, write_table

SEED = 7
PROBLEMS = 40
LIMIT_DEG = 5.0
GRAVITY_NOISE_DEG, GYRO_NOISE_DEG = 0.5, 1.0 / 30.0
"""Of a telephone's: 1 deg/s of a sample at 30 frames a second."""
_LEAST_GAIN = 1e-3
"""Of AUC@5: less is no reason, and two problems that change can have it beyond a bootstrap's interval."""
CARDS = (
    *("gs-5pt-opencv", "gs-8pt", "gs-p3p", "gs-poselib", "gs-poselib-stereo", "gs-stereo-pnp"),
    *("gs-stereo-triplets", "gs-stereo-triplets-lines", "gs-upright-3pt", "gs-upright-4pt"),
    *("rs-12param", "rs-dai-linear", "rs-dai-uniform", "rs-gyro-5pt", "rs-gyro-stereo"),
    *("rs-r6p", "rs-r6p-single", "rs-stereo-linear", "rs-zhuang-8pt", "rs-zhuang-9pt"),
)


class Setting(NamedTuple):
    """One option that differs from the card."""

    option: str
    value: str
    solver: Solver
    loop: RobustOptions


def settings_of(solver: Solver, own_loop: bool) -> Iterator[Setting]:
    """The card's own setting, named ``card``, and the others."""
    loop = RobustOptions()
    yield Setting("card", "", solver, loop)
    if not own_loop:
        for factor in (0.5, 2.0):
            value = factor * loop.threshold_px
            yield Setting("loop.threshold_px", f"{value:g}", solver, replace(loop, threshold_px=value))
        yield Setting("loop.lo_steps", "0", solver, replace(loop, lo_steps=0))
    hints = get_type_hints(type(solver))
    for field in fields(solver):
        now, others = getattr(solver, field.name), tuple[Any, ...]()
        if field.name in ("threshold_px", "noise_px"):
            others = (0.5 * now, 2.0 * now)
        elif field.name == "lo_steps":
            others = (0,)
        elif field.name in ("refinement", "start"):
            others = tuple(value for value in get_args(hints[field.name]) if value != now)
        for value in others:
            named = value if isinstance(value, str) else f"{value:g}"
            yield Setting(field.name, named, replace(solver, **{field.name: value}), loop)


def problem(number: int) -> Simulation:
    """One of the seed, with gravity and a gyroscope."""
    setting = replace(
        POINTS_1.setting(SEED, number), gravity_noise_deg=GRAVITY_NOISE_DEG, gyro_noise_deg=GYRO_NOISE_DEG
    )
    motion, rng = POINTS_1.motion(SEED, number), generator(SEED, "leaderboard", "scene", number)
    return simulate(setting.rig(), setting.shutter(), motion, replace(setting.options(True), pairs=0), rng)


def errors_of(card: str, problems: int) -> list[tuple[Setting, FloatArray]]:
    """Errors (problems,) in degrees, the larger of rotation and direction, of each setting of a card."""
    e = load_solver_entry(card)
    settings = list(settings_of(e.solver, e.options.robust == "own"))
    found = np.zeros((len(settings), problems))
    for number in range(problems):
        s = problem(number)
        for k, each in enumerate(settings):
            rng = generator(SEED, "tuning", card, number)
            given = (s.correspondences, s.rig, s.shutter, each.solver, each.loop, rng)
            answer = estimate_motion(*given, e.options.robust).estimate
            error = pose_errors(
                answer.w,
                answer.d,
                true_w=s.motion.w,
                true_d=s.motion.d,
                rig=s.rig,
                success=answer.success,
                metric=answer.metric,
                reference_point=e.solver.spec.reference_point,
            )
            found[k, number] = np.fmax(error["e_R_deg"], error["e_T_deg"])
    return list(zip(settings, found, strict=True))


def gain_intervals(gains: FloatArray) -> FloatArray:
    """Ends (2, settings) of the mean gains (problems, settings), of 95 % for all together (Bonferroni)."""
    draws = generator(SEED, "tuning", "bootstrap").integers(0, len(gains), (RESAMPLES, len(gains)))
    tail = 0.5 * (1.0 - COVERAGE) / gains.shape[1]
    means = np.stack([column[draws].mean(axis=1) for column in gains.T], axis=1)
    return np.quantile(means, [tail, 1.0 - tail], axis=0)


def rows_of(card: str, found: Sequence[tuple[Setting, FloatArray]]) -> list[dict[str, Any]]:
    """Of the table: scores of each setting, what it gains over the card's, and which is the best."""
    scores = np.array([np.maximum(0.0, 1.0 - errors / LIMIT_DEG) for _, errors in found])
    gains = (scores - scores[0]).T
    low, high = np.pad(gain_intervals(gains[:, 1:]), ((0, 0), (1, 0)))
    best = int(np.argmax(np.where(low > _LEAST_GAIN, gains.mean(axis=0), 0.0)))  # the card's where none is better
    rows = []
    for k, (setting, errors) in enumerate(found):
        ends = average_interval(scores[k], SEED)
        row = {"solver": card, "option": setting.option, "value": setting.value, "problems": len(errors)}
        row |= {"auc_5": float(scores[k].mean()), "auc_5_low": ends.low, "auc_5_high": ends.high}
        row |= {"median_deg": float(np.median(errors)), "gain": float(gains[:, k].mean())}
        rows.append(row | {"gain_low": float(low[k]), "gain_high": float(high[k]), "best": k == best})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--solver", action="append", help="only these rows; also FILE.py:NAME")
    options = parser.parse_args()
    assert SEED != PUBLIC_SEED, "tuned on what is published"
    options.out.mkdir(parents=True, exist_ok=True)
    path, cards = options.out / "tuning.csv", options.solver or CARDS
    warm_up(["linear"])
    table = pd.read_csv(path, keep_default_na=False) if options.solver and path.is_file() else pd.DataFrame()
    for card in cards:
        rows = pd.DataFrame(rows_of(card, errors_of(card, PROBLEMS)))
        kept = table[table["solver"] != card] if len(table) else table
        table = pd.concat([kept, rows], ignore_index=True).sort_values("solver", kind="stable")
        write_table(path, table)
        sys.stdout.write(rows.to_string(index=False) + "\n")
    command = f"python benchmarks/tune_solvers.py --out {options.out.as_posix()}"
    noise = {"gravity_noise_deg": GRAVITY_NOISE_DEG, "gyro_noise_deg": GYRO_NOISE_DEG}
    write_json(options.out / "provenance.json", provenance(command, seed=SEED, problems=PROBLEMS, **noise))
    return 0


if __name__ == "__main__":
    sys.exit(main())
