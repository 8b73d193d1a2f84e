"""A section for each solver in docs/solvers.md: what it is, from its card and class, and what it does, measured.

    python benchmarks/solver_pages.py                # the page, from results/solvers/solvers.csv: a second
    python benchmarks/solver_pages.py --measure      # the table too: a quarter of an hour of a processor
    python benchmarks/solver_pages.py --measure --solver rs-dai-linear   # only that row; the others are kept

Each solver gets the least information that it can use fully, and exact or noisy matches of the motion model
that it declares, of the point of the rig that it declares. The bound is that of the same matches with six
unknowns; a gyroscope's solvers are compared with that of a known rotation, those with gravity with that of
two known angles.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.simulated.bound import Bound, bound_from_information, motion_bound
from rsbench.benchmark.simulated.simulation import (
    GYRO_RATE,
    Simulation,
    SimulationOptions,
    random_motion,
    simulate,
)
from rsbench.benchmark.simulated.trials import Entrant, enter, given_matches
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.metrics import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.files import write_bytes, write_json, write_table
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.robust_motion import RobustOptions
from rsbench.solvers.engine.base import SENSORS, MotionEstimate
from rsbench.solvers.engine.registry import SolverEntry, list_solvers, load_solver_entry
from rsbench.solvers.engine.warm_up import warm_up

ROOT = Path(__file__).parents[1]
TABLE, PAGE = ROOT / "results/solvers/solvers.csv", ROOT / "docs/solvers.md"
RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
NOISE_PX, GOOD_DEG, TRIALS, SAMPLES = 0.3, (0.3, 5.0), 20, 50
OUTLIERS = (0.0, 0.3, 0.5)
_KNOWN = 1e12
"""Information of what a sensor tells, 1 / rad^2."""
HEAD = """# The solvers, one by one

Made by `python benchmarks/solver_pages.py` from the solvers' cards and [the table of what was
measured](https://github.com/rsbench/rsbench/blob/main/results/solvers/solvers.csv) ({date}): a rig of two
cameras of 900 x 900 px, f = 810 px, baseline 0.6 m, readout ratio 0.8; 2 deg and 0.3 m per frame period in
random directions, points at 2 to 10 m, {trials} trials.

- **Bias**: median error on 100 exact matches per camera, of the motion model that the solver declares; the
  order is what halving the motion divides it by. A solver that assumes a global shutter sees
  rolling-shutter matches here.
- **Noise**: root mean square error with {noise} px of noise, over the Cramer-Rao bound of what the solver is
  given: 1 is best. A bias counts too.
- **Time**: of the processor, one core: a minimal sample, and a whole robust estimate from 200 matches with
  30 % outliers.
- **Success**: share of robust estimates within {e_R} deg and {e_T} deg, at 0, 30 and 50 % outliers.

Solvers of the left camera are scored on that camera's own motion. [How solvers are
written](add-a-solver.md), [of one camera](monocular.md), [sweeps over noise, motion and
scene](https://github.com/rsbench/rsbench/blob/main/results/sweeps/README.md).
"""
_SETS = {
    "left": "matches over time of the left camera",
    "right": "of the right camera",
    "stereo": "left-right matches at both times",
    "tracks": "tracks through all four images",
    **SENSORS,
}


# What is measured


def rig_of(entry: SolverEntry) -> StereoRig:
    """The rig about the point whose motion the solver finds, so that its model holds there exactly."""
    return RIG if entry.solver.spec.reference_point == "body" else RIG.about("left")


def trial(e: Entrant, seed: int, size: float = 1.0, count: int = 100, **noise: float) -> Simulation:
    """2 degrees and 0.3 m times ``size``."""
    spec, rng = e.solver.spec, np.random.default_rng([11, seed])
    motion = random_motion(rng, np.deg2rad(2.0 * size), 0.3 * size, spec.motion_model)
    linked = e.information in ("linked pairs", "tracks")
    options = SimulationOptions(
        pairs=0 if linked else count,
        tracks=count if linked else 0,
        gyro_rate=GYRO_RATE,
        gravity=True,
        **noise,  # pyrefly: ignore[bad-argument-type]
    )
    return simulate(rig_of(e.entry), SHUTTER, motion, options, np.random.default_rng(seed))


def given(e: Entrant, s: Simulation) -> Correspondences:
    """What the solver gets: its matches, and the sensors that it needs."""
    sensed = {name: getattr(s.correspondences, name) for name in SENSORS if name in e.solver.spec.needs}
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
    F = motion_bound(matches, rig_of(e.entry), SHUTTER, exact.motion, NOISE_PX).information.copy()
    if "gyro" in e.solver.spec.needs:
        F[:3, :3] += _KNOWN * np.eye(3)
    elif "gravity" in e.solver.spec.needs:
        down, J = c.gravity[1, 1:], so3.left_jacobian(w)
        F[:3, :3] += _KNOWN * J.T @ (np.eye(3) - np.outer(down, down)) @ J
    return bound_from_information(F, w, exact.motion.d)


def bias(e: Entrant, size: float) -> FloatArray:
    """Median errors (2,) on exact matches."""
    found = []
    for seed in range(TRIALS):
        s = trial(e, seed, size)
        found.append(errors(e.solver.estimate(given(e, s), RIG, SHUTTER), s))
    return np.median(found, axis=0)


def over_bound(e: Entrant) -> FloatArray:
    """Root mean square errors (2,) with noise over the bound."""
    ratios = []
    for seed in range(TRIALS):
        s = trial(e, seed, noise_px=NOISE_PX)
        least = bound(e, trial(e, seed))
        found = errors(e.solver.estimate(given(e, s), RIG, SHUTTER), s)
        ratios.append(np.array(found) / np.rad2deg([least.rotation, least.direction]))
    return np.sqrt(np.mean(np.square(ratios), axis=0))


def sample_ms(e: Entrant) -> float:
    """Milliseconds of a minimal sample, of ``SAMPLES`` in batches of ten; NaN where the loop is its own."""
    if e.entry.options.robust == "own":
        return np.nan
    c, rng = given(e, trial(e, 0)), np.random.default_rng(0)
    sizes = e.solver.sample_sizes(c)
    names = ("left", "right", "stereo_0", "stereo_1", "tracks")
    samples = []
    for _ in range(SAMPLES):
        sets = {name: rng.choice(getattr(c, name), sizes.get(name, 0), replace=False) for name in names}
        samples.append(replace(c, **sets))
    list(e.solver.propose_all(samples[:1], RIG, SHUTTER))
    start = time.process_time()
    for first in range(0, SAMPLES, 10):
        list(e.solver.propose_all(samples[first : first + 10], RIG, SHUTTER))
    return 1e3 * (time.process_time() - start) / SAMPLES


def robust(e: Entrant, outliers: float, runner: SolverRunner) -> tuple[float, float]:
    """Share within ``GOOD_DEG`` of robust estimates, and their median milliseconds of the processor."""
    good, seconds = [], []
    for seed in range(TRIALS):
        s = trial(e, seed, count=200, noise_px=NOISE_PX, outlier_ratio=outliers)
        c, rng = given(e, s), np.random.default_rng(seed)
        start = time.process_time()
        found = runner.robust(e.entry, c, RIG, SHUTTER, RobustOptions(), rng)
        seconds.append(time.process_time() - start)
        good.append(np.all(np.array(errors(found.estimate, s)) < GOOD_DEG))
    return float(np.mean(good)), 1e3 * float(np.median(seconds))


def measured(name: str, runner: SolverRunner) -> dict[str, Any]:
    """A row of the table."""
    e = enter(load_solver_entry(name))
    warm_up([e.solver.spec.motion_model])
    full, half, factor = bias(e, 1.0), bias(e, 0.5), over_bound(e)
    runs = [robust(e, outliers, runner) for outliers in OUTLIERS]
    row: dict[str, Any] = {"solver": name, "information": e.information}
    for k, error in enumerate(("e_R", "e_T")):
        row |= {f"bias_{error}_deg": full[k], f"bias_half_{error}_deg": half[k], f"{error}_over_bound": factor[k]}
    row |= {"sample_ms": sample_ms(e), "robust_ms": runs[1][1]}
    return row | {f"success_{outliers:.0%}": share for outliers, (share, _) in zip(OUTLIERS, runs, strict=True)}


def measure(names: list[str]) -> None:
    """Make the rows of these solvers again; the table keeps those of the others."""
    kept = pd.read_csv(TABLE).to_dict("records") if TABLE.exists() else []
    rows = {str(row["solver"]): row for row in kept}
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with SolverRunner() as runner:
        for name in names:
            start = time.process_time()
            rows[name] = measured(name, runner)
            write_table(TABLE, pd.DataFrame([rows[each] for each in sorted(rows)]))
            sys.stdout.write(f"{name}: {time.process_time() - start:.0f} s\n")
            sys.stdout.flush()
    command = "python benchmarks/solver_pages.py --measure"
    write_json(TABLE.parent / "provenance.json", provenance(command, trials=TRIALS, noise_px=NOISE_PX))


# The page


def page(table: pd.DataFrame, date: str) -> str:
    """The document, from the table and the cards."""
    parts = [HEAD.format(date=date, trials=TRIALS, noise=NOISE_PX, e_R=GOOD_DEG[0], e_T=GOOD_DEG[1])]
    rows = {str(row["solver"]): row for row in table.to_dict("records")}
    parts += [section(load_solver_entry(name), rows.get(name)) for name in list_solvers() if name in rows]
    return "\n".join(parts)


def section(entry: SolverEntry, row: Mapping[Any, Any]) -> str:
    spec = entry.solver.spec
    needs = "; ".join(f"{spec.minimum[name]} {_SETS[name]}" for name in _SETS if name in spec.needs)
    gives = f"w and {'d in metres' if spec.metric else 'the direction of d'}, of the "
    gives += "rig" if spec.reference_point == "body" else "left camera"
    lines = [
        f"- Paper: {spec.reference}.",
        f"- Needs at least {needs}; measured with {row['information']}. Gives {gives}.",
        f"- Assumes {spec.assumes}; motion model `{spec.motion_model}`.",
        f"- Bias {_angle(row['bias_e_R_deg'])}, {_angle(row['bias_e_T_deg'])} (e_R, e_T){_order(row)}.",
        f"- Noise {_times(row['e_R_over_bound'])}, {_times(row['e_T_over_bound'])} the bound (e_R, e_T).",
        f"- Time {_sample(row['sample_ms'])}{_number(row['robust_ms'])} ms robust. Success "
        + ", ".join(f"{row[f'success_{outliers:.0%}']:.2f}" for outliers in OUTLIERS)
        + ".",
        f"- Take it: {entry.options.use}",
    ]
    return "\n".join([f"## {entry.name}\n", f"{entry.description}.\n", *lines, ""])


def _order(row: Mapping[Any, Any]) -> str:
    """What halving the motion divides the errors by, where they are no rounding."""
    pairs = [(row[f"bias_{error}_deg"], row[f"bias_half_{error}_deg"]) for error in ("e_R", "e_T")]
    told = [f"{full / half:.1f}" if half > 1e-6 and full < 90.0 else "-" for full, half in pairs]
    return "" if set(told) == {"-"} else f", order {', '.join(told)}"


def _angle(degrees: float) -> str:
    return "none (fails)" if degrees >= 180.0 else "0" if degrees < 1e-7 else f"{_number(degrees)} deg"


def _times(ratio: float) -> str:
    return "-" if not np.isfinite(ratio) or ratio > 1e3 else f"{ratio:.2g} times"


def _sample(ms: float) -> str:
    return "" if not np.isfinite(ms) else f"{_number(ms)} ms a sample, "


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.2g}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--solver", action="append", help="with --measure: only this one; may be repeated")
    options = parser.parse_args()
    if options.measure:
        measure(options.solver or list_solvers())
    made = pd.read_json(TABLE.parent / "provenance.json", typ="series")
    write_bytes(PAGE, page(pd.read_csv(TABLE), str(made["date"])).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
