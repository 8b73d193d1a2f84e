"""What every solver does, in numbers: the tables behind docs/explanation/solvers.md (benchmarks/solver_pages.py).

    nice python benchmarks/solver_measurements.py                         # all: half an hour of a processor
    nice python benchmarks/solver_measurements.py --solver rs-dai-linear  # those rows; the others are kept

Each solver gets the least information that it can use fully, and exact or noisy matches of the motion model
that it declares, of the point of the rig that it declares. The bound is that of the same matches with six
unknowns; a gyroscope's solvers are compared with that of a known rotation, those with gravity with that of
two known angles. Affine frames are exact, and what they tell is not in the bound. The degenerate suite is
cards/sweeps/degenerate.toml with all solvers.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.simulated.bound import Bound, bound_from_root, joined, motion_bound
from rsbench.benchmark.simulated.run_sweep import (
    OBSERVABLE,
    SUCCESS_DEG,
    at_bound,
    failure_reasons,
    over_bound,
    read_bounds,
    read_trials,
    run_sweep,
    score_trials,
)
from rsbench.benchmark.simulated.simulation import (
    GYRO_RATE,
    Simulation,
    SimulationOptions,
    random_motion,
    simulate,
)
from rsbench.benchmark.simulated.sweep_card import load_sweep
from rsbench.benchmark.simulated.trials import Entrant, enter, given_matches
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import BESIDE, MotionEstimate, list_solvers, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import write_json, write_table

FOLDER = Path(__file__).parents[1] / "results/solvers"
RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
NOISE_PX, GOOD_DEG, SAMPLES = 0.3, (0.3, 5.0), 50
OUTLIERS = (0.0, 0.3, 0.5)
HARDEST = 0.5
"""Share of outliers at which budgets are compared."""
HOUSE_SAMPLES, FEW_SAMPLES, LEAST_SAMPLES = 1000, 100, 10
"""Most samples of a robust estimate: of the house, as an equal budget, and the least with which it begins."""
TIME_MS = 100.0
"""The other equal budget: of the processor, for a whole robust estimate."""
MANY, MANY_TRIALS = 1000, 3
"""Matches of each camera, and trials, in which the time of a run of all solvers is taken; 30 % are outliers."""
_KNOWN = 1e6
"""Root of the information of what a sensor tells, 1 / rad."""
_BEYOND = 3.0
"""Times the bound that an error may be in the degenerate suite, where that is more than ``SUCCESS_DEG``."""


class Robust(NamedTuple):
    """Of robust estimates: the share within ``GOOD_DEG``, their median milliseconds and samples."""

    good: float
    ms: float
    samples: int


class Asked(NamedTuple):
    """What decides the matches of a trial: solvers that agree on it share them."""

    linked: bool
    motion_model: str
    point: Literal["body", "left"]

    @classmethod
    def by(cls, e: Entrant) -> Asked:
        """The solver's own motion model and point, so that its model holds there exactly."""
        spec = e.solver.spec
        return cls(e.information in ("linked pairs", "tracks"), spec.motion_model, spec.reference_point)

    @property
    def rig(self) -> StereoRig:
        """The rig about that point."""
        return RIG if self.point == "body" else RIG.about("left")


def trial(e: Entrant, seed: int, size: float = 1.0, count: int = 100, **noise: float) -> Simulation:
    """2 degrees and 0.3 m times ``size``."""
    return _trial(Asked.by(e), seed, size, count, tuple(noise.items()))


@lru_cache(maxsize=2000)
def _trial(asked: Asked, seed: int, size: float, count: int, noise: tuple[tuple[str, float], ...]) -> Simulation:
    rng = np.random.default_rng([11, seed])
    motion = random_motion(rng, np.deg2rad(2.0 * size), 0.3 * size, asked.motion_model)
    options = SimulationOptions(
        pairs=0 if asked.linked else count,
        tracks=count if asked.linked else 0,
        gyro_rate=GYRO_RATE,
        gravity=True,
        affine=not asked.linked,
        **dict(noise),  # pyrefly: ignore[bad-argument-type]
    )
    return simulate(asked.rig, SHUTTER, motion, options, np.random.default_rng(seed))


def given(e: Entrant, s: Simulation) -> Correspondences:
    """What the solver gets: its matches, and the sensors that it needs."""
    sensed = {name: getattr(s.correspondences, name) for name in BESIDE if name in e.solver.spec.needs}
    return replace(given_matches(s, e.information), **sensed)


def errors(estimate: MotionEstimate, s: Simulation) -> tuple[float, float]:
    """e_R and e_T, degrees; 180 of a failure."""
    if not estimate.success:
        return 180.0, 180.0
    e_R, e_T = rotation_error(estimate.w, s.motion.w), translation_error(estimate.d, s.motion.d)
    return float(np.rad2deg(e_R)), float(np.rad2deg(e_T))


def bound(e: Entrant, exact: Simulation) -> Bound:
    """Of the matches and sensors that the solver is given, for ``NOISE_PX``."""
    c, w = exact.correspondences, exact.motion.w
    sets = {
        "left pairs": ("left",),
        "left and right pairs": ("left", "right"),
        "linked pairs": ("tracks",),
        "tracks": ("tracks",),
    }[e.information]
    matches = Correspondences(**{name: getattr(c, name) for name in sets})
    root = motion_bound(matches, Asked.by(e).rig, SHUTTER, exact.motion, NOISE_PX).root
    if "gyro" in e.solver.spec.needs:
        root = joined(root, _KNOWN * np.eye(6)[:3])
    elif "gravity" in e.solver.spec.needs:
        # R turns one direction of gravity into the other: its errors are about the second alone.
        down, J = c.gravity[1, 1:], so3.left_jacobian(w)
        across = (np.eye(3) - np.outer(down, down)) @ J
        root = joined(root, _KNOWN * np.hstack([across, np.zeros((3, 3))]))
    return bound_from_root(root, w, exact.motion.d)


def bias(e: Entrant, size: float, trials: int) -> FloatArray:
    """Median errors (2,) on exact matches."""
    found = []
    for seed in range(trials):
        s = trial(e, seed, size)
        found.append(errors(e.solver.estimate(given(e, s), RIG, SHUTTER), s))
    return np.median(found, axis=0)


def noise_factors(e: Entrant, trials: int) -> dict[str, Any]:
    """Root mean square and median errors with noise, over those of Gaussian errors at the bound."""
    found, axes = [], []
    for seed in range(trials):
        s = trial(e, seed, noise_px=NOISE_PX)
        least = bound(e, trial(e, seed))
        found.append(errors(e.solver.estimate(given(e, s), RIG, SHUTTER), s))
        axes.append((np.rad2deg(least.rotation_axes), np.rad2deg(least.direction_axes)))
    row: dict[str, Any] = {"noisy_failures": sum(e_R == 180.0 for e_R, _ in found)}
    for k, error in enumerate(("e_R", "e_T")):
        values, sigmas = np.array([each[k] for each in found]), np.array([each[k] for each in axes])
        factor: dict[str, Any] = dict.fromkeys(("over_bound", "over_bound_low", "over_bound_high"), np.nan)
        middle = np.nan
        if not (error == "e_R" and "gyro" in e.solver.spec.needs):  # exact samples leave rounding alone
            factor = over_bound(values, np.linalg.norm(sigmas, axis=1), 0)
            middle = float(np.median(values)) / at_bound(sigmas, 0)["bound_median"]
        row |= {f"{error}_{key}": value for key, value in factor.items() if key.startswith("over")}
        row[f"{error}_median_over_bound"] = middle
    return row


def sample_ms(e: Entrant) -> float:
    """Milliseconds of a minimal sample, of ``SAMPLES`` in batches of ten; NaN where the loop is its own."""
    if e.entry.options.robust == "own":
        return np.nan
    c, rng = given(e, trial(e, 0)), np.random.default_rng(0)
    sizes = e.solver.sample_sizes(c)
    names = ("left", "right", "stereo_0", "stereo_1", "tracks")
    samples = []
    for _ in range(SAMPLES):
        chosen = {name: rng.choice(len(getattr(c, name)), sizes.get(name, 0), replace=False) for name in names}
        sets = {name: getattr(c, name)[chosen[name]] for name in names}
        sets["affine"] = c.affine[chosen["left"]] if len(c.affine) else c.affine
        samples.append(replace(c, **sets))
    list(e.solver.propose_all(samples[:1], RIG, SHUTTER))
    start = time.process_time()
    for first in range(0, SAMPLES, 10):
        list(e.solver.propose_all(samples[first : first + 10], RIG, SHUTTER))
    return 1e3 * (time.process_time() - start) / SAMPLES


def sizes_of(e: Entrant) -> str:
    """Matches of a minimal sample, in words."""
    if e.entry.options.robust == "own":
        return "its own"
    sizes = e.solver.sample_sizes(given(e, trial(e, 0)))
    return " + ".join(f"{count} {name}" for name, count in sizes.items() if count)


def robust(e: Entrant, outliers: float, runner: SolverRunner, most: int, trials: int, count: int = 200) -> Robust:
    """Of robust estimates of at most ``most`` samples from ``count`` matches."""
    good, seconds, samples = [], [], []
    for seed in range(trials):
        s = trial(e, seed, count=count, noise_px=NOISE_PX, outlier_ratio=outliers)
        c, rng = given(e, s), np.random.default_rng(seed)
        start = time.process_time()
        found = runner.robust(e.entry, c, RIG, SHUTTER, RobustOptions(max_iterations=most), rng)
        seconds.append(time.process_time() - start)
        samples.append(found.iterations)
        good.append(np.all(np.array(errors(found.estimate, s)) < GOOD_DEG))
    return Robust(float(np.mean(good)), 1e3 * float(np.median(seconds)), int(np.median(samples)))


def successes(e: Entrant, outliers: float, runner: SolverRunner, trials: int) -> dict[str, Any]:
    """The share at the house's budget; of the most outliers, at equal numbers of samples and equal times too."""
    key, full = f"{outliers:.0%}", robust(e, outliers, runner, HOUSE_SAMPLES, trials)
    row: dict[str, Any] = {
        f"success_{key}": full.good,
        f"robust_ms_{key}": full.ms,
        f"samples_{key}": full.samples,
    }
    if outliers < HARDEST:
        return row
    few = robust(e, outliers, runner, FEW_SAMPLES, trials) if full.samples > FEW_SAMPLES else full
    quick, most = full, HOUSE_SAMPLES
    if full.ms > TIME_MS and full.samples:
        most = max(LEAST_SAMPLES, int(full.samples * TIME_MS / full.ms))
        quick = robust(e, outliers, runner, most, trials)
    return row | {
        "success_few": few.good,
        "success_quick": quick.good,
        "most_quick": most,
        "ms_quick": quick.ms,
    }


def measured(name: str, trials: int) -> dict[str, Any]:
    """A row of the table."""
    e = enter(load_solver_entry(name))
    warm_up([e.solver.spec.motion_model])
    full, half = bias(e, 1.0, trials), bias(e, 0.5, trials)
    row: dict[str, Any] = {"solver": name, "trials": trials, "information": e.information, "sample": sizes_of(e)}
    for k, error in enumerate(("e_R", "e_T")):
        row |= {f"bias_{error}_deg": full[k], f"bias_half_{error}_deg": half[k]}
    row |= noise_factors(e, trials) | {"sample_ms": sample_ms(e)}
    with SolverRunner() as runner:
        for outliers in OUTLIERS:
            row |= successes(e, outliers, runner, trials)
        row["robust_ms_many"] = robust(e, 0.3, runner, HOUSE_SAMPLES, MANY_TRIALS, MANY).ms
    return row


def degenerate(names: list[str], trials: int, workers: int) -> pd.DataFrame:
    """Each motion and scene of the suite, without and with noise, solver by solver."""
    card = load_sweep("degenerate")
    card = replace(card, solvers=tuple(names), trials=trials)
    rows = []
    with tempfile.TemporaryDirectory() as out:
        run_sweep(card, Path(out), workers=workers)
        for cell in card.cells():
            found, limits = read_trials(Path(out), card, cell), read_bounds(Path(out), card, cell)
            for number, name in enumerate(names):
                point = enter(load_solver_entry(name)).solver.spec.reference_point
                scores = score_trials(found, number, point, cell)
                sigma = np.linalg.norm(limits["direction"][:, number], axis=-1)
                open_ = ~np.isfinite(sigma)
                sigma = np.where(open_, np.inf, cell.value * np.where(open_, 0.0, sigma))
                rows.append(
                    {"variant": cell.variant, "noise_px": cell.value, "solver": name}
                    | outcome(scores, found["success"][:, number], sigma)
                    | {"failure_reasons": failure_reasons(found, number)}
                )
    return pd.DataFrame(rows)


def outcome(scores: dict[str, FloatArray], success: FloatArray, sigma: FloatArray) -> dict[str, Any]:
    """How many trials were solved, failed, and answered wrongly.

    A direction that the matches leave open, by its bound ``sigma`` (trials,) in radians, cannot be wrong.
    """
    known = sigma <= OBSERVABLE
    allowed = np.maximum(SUCCESS_DEG[1], _BEYOND * np.rad2deg(np.where(known, sigma, 0.0)))
    right = success & (scores["e_R_deg"] < SUCCESS_DEG[0]) & ~(known & (scores["e_T_deg"] >= allowed))
    return {
        "trials": len(success),
        "solved": int(np.count_nonzero(right)),
        "failed": int(np.count_nonzero(~success)),
        "wrong": int(np.count_nonzero(success & ~right)),
        "direction_known": float(np.mean(known)),
        "e_R_median_deg": float(np.median(scores["e_R_deg"])),
        "e_T_median_deg": float(np.median(scores["e_T_deg"])) if np.mean(known) >= 0.5 else np.nan,
    }


def stored(path: Path, made: pd.DataFrame, keys: list[str]) -> None:
    """Write rows; those of other solvers in the table stay, those of none go."""
    old = pd.read_csv(path) if path.exists() else made.iloc[:0]
    old = old[old["solver"].isin(list_solvers()) & ~old["solver"].isin(set(made["solver"]))]
    write_table(path, pd.concat([old, made] if len(old) else [made]).sort_values(keys, kind="stable"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solver", action="append", help="only this one; may be repeated")
    parser.add_argument("--workers", type=int, default=1, help="processes, each with one thread")
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--suite", choices=("numbers", "degenerate", "both"), default="both")
    options = parser.parse_args()
    names = options.solver or list(list_solvers())
    FOLDER.mkdir(parents=True, exist_ok=True)
    if options.suite != "degenerate":
        with ProcessPoolExecutor(options.workers) as pool:
            for row in pool.map(partial(measured, trials=options.trials), names):
                stored(FOLDER / "solvers.csv", pd.DataFrame([row]), ["solver"])
                sys.stdout.write(f"{row['solver']}\n")
                sys.stdout.flush()
    if options.suite != "numbers":
        stored(
            FOLDER / "degenerate.csv", degenerate(names, options.trials, options.workers), ["solver", "noise_px"]
        )
    inputs = {
        "noise_px": NOISE_PX,
        "good_deg": GOOD_DEG,
        "few_samples": FEW_SAMPLES,
        "time_ms": TIME_MS,
        "many": MANY,
        "solved_deg": SUCCESS_DEG,
        "seeds": "0 to trials - 1; of the degenerate suite 0",
    }
    write_json(FOLDER / "provenance.json", provenance("python benchmarks/solver_measurements.py", **inputs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
