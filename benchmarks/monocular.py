"""Rolling-shutter solvers of one camera: bias and its order, noise over the bound, time, success under outliers.

python benchmarks/monocular.py                       # some minutes on one core
python benchmarks/monocular.py --trials 100 --solver rs-mono-refined --solver rs-zhuang-8pt

The robust loop has 200 matches. Each solver sees exact matches of its own motion model first;
rs-dai-linear those of `linear`, whose rotation within a frame it leaves out: on its own model it is exact, see
tests/solvers/test_free_velocities.py. "order" is the factor by which the errors fall when the motion is halved;
below 1e-6 deg they are rounding. The bound is of the same matches and six unknowns, or of a known rotation for the
solvers with a gyroscope. Times are of the processor.
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import time

import numpy as np

from rsbench.benchmark.simulated.bound import bound_from_root, joined, motion_bound
from rsbench.benchmark.simulated.simulation import (
    GYRO_RATE,
    Simulation,
    SimulationOptions,
    random_motion,
    simulate,
)
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.metrics import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.registry import load_solver
from rsbench.solvers.engine.warm_up import warm_up

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
SOLVERS = (
    "rs-mono-refined",
    "rs-zhuang-8pt",
    "rs-zhuang-9pt",
    "rs-dai-linear",
    "rs-dai-uniform",
    "rs-12param",
    "rs-gyro-5pt",
    "rs-gyro-stereo",
)
NOISE_PX, GOOD_DEG = 0.3, (0.3, 5.0)


def rig_of(solver: Solver) -> StereoRig:
    """The rig about the point whose motion the solver finds, so that its model holds there exactly."""
    return RIG if solver.spec.reference_point == "body" else RIG.about("left")


def trial(solver: Solver, seed: int, size: float = 1.0, pairs: int = 100, **options: float) -> Simulation:
    """2 degrees and 0.3 m times ``size``."""
    rng = np.random.default_rng([11, seed])
    motion = random_motion(rng, np.deg2rad(2.0 * size), 0.3 * size, solver.spec.motion_model)
    chosen = SimulationOptions(pairs=pairs, gyro_rate=GYRO_RATE, **options)  # pyrefly: ignore[bad-argument-type]
    return simulate(rig_of(solver), SHUTTER, motion, chosen, np.random.default_rng(seed))


def given(solver: Solver, s: Simulation) -> Correspondences:
    c, needs = s.correspondences, solver.spec.needs
    right = c.right if "right" in needs else c.right[:0]
    return Correspondences(left=c.left, right=right, gyro=c.gyro if "gyro" in needs else c.gyro[:0])


def errors(estimate: MotionEstimate, s: Simulation) -> tuple[float, float]:
    """e_R and e_T, degrees; 180 of a failure."""
    if not estimate.success:
        return 180.0, 180.0
    w, d = s.motion.w, s.motion.d
    return tuple(np.rad2deg([float(rotation_error(estimate.w, w)), float(translation_error(estimate.d, d))]))


def bias(solver: Solver, size: float, trials: int) -> FloatArray:
    """Median errors on exact matches."""
    found = []
    for seed in range(trials):
        s = trial(solver, seed, size)
        found.append(errors(solver.estimate(given(solver, s), RIG, SHUTTER), s))
    return np.median(found, axis=0)


def noise_factors(solver: Solver, trials: int) -> FloatArray:
    """Median errors over the medians of the bound's root mean squares, as of normal errors: 1 is at the bound."""
    found, bounds = [], []
    for seed in range(trials):
        exact, s = trial(solver, seed), trial(solver, seed, noise_px=NOISE_PX)
        found.append(errors(solver.estimate(given(solver, s), RIG, SHUTTER), s))
        root = motion_bound(given(solver, exact), rig_of(solver), SHUTTER, s.motion, NOISE_PX).root
        if "gyro" in solver.spec.needs:
            root = joined(root, 1e6 * np.eye(6)[:3])
        bound = bound_from_root(root, s.motion.w, s.motion.d)
        bounds.append(np.rad2deg([bound.rotation, bound.direction]))
    return np.sqrt(np.mean((np.array(found) / bounds) ** 2, axis=0))


def success(solver: Solver, outliers: float, trials: int) -> tuple[float, float]:
    """Share within ``GOOD_DEG`` in the robust loop, and median milliseconds of its processor time."""
    good, seconds = [], []
    for seed in range(trials):
        s = trial(solver, seed, pairs=200, noise_px=NOISE_PX, outlier_ratio=outliers)
        c = given(solver, s)
        start = time.process_time()
        found = estimate_motion(c, RIG, SHUTTER, solver, RobustOptions(), np.random.default_rng(seed))
        seconds.append(time.process_time() - start)
        good.append(np.all(np.array(errors(found.estimate, s)) < GOOD_DEG))
    return float(np.mean(good)), 1e3 * float(np.median(seconds))


def per_sample(solver: Solver) -> float:
    """Milliseconds of one minimal sample, of a hundred in batches of ten."""
    c = given(solver, trial(solver, 0, pairs=100))
    sizes, rng = solver.sample_sizes(c), np.random.default_rng(0)
    samples = []
    for _ in range(100):
        sets = {
            name: rng.choice(getattr(c, name), sizes.get(name, 0), replace=False) for name in ("left", "right")
        }
        samples.append(Correspondences(**sets, gyro=c.gyro))
    list(solver.propose_all(samples[:1], RIG, SHUTTER))
    start = time.process_time()
    for first in range(0, 100, 10):
        list(solver.propose_all(samples[first : first + 10], RIG, SHUTTER))
    return 10.0 * (time.process_time() - start)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--solver", action="append")
    parser.add_argument("--trials", type=int, default=20)
    options = parser.parse_args()
    heads = ("solver", "model", "bias e_R, e_T (deg)", "order", "RMS over bound", "ms sample", "ms robust, 30 %")
    sys.stdout.write(" | ".join((*heads, "success at 0, 30, 50 %")) + "\n")
    for name in options.solver or SOLVERS:
        solver = load_solver(name)
        warm_up([solver.spec.motion_model])
        full, half = (bias(solver, size, options.trials) for size in (1.0, 0.5))
        order = ", ".join("-" if a < 1e-6 else f"{a / b:.1f}" for a, b in zip(full, half, strict=True))
        factors = noise_factors(solver, options.trials)
        shares = [success(solver, outliers, options.trials) for outliers in (0.0, 0.3, 0.5)]
        told = (
            f"{full[0]:.1e}, {full[1]:.1e}",
            order,
            ", ".join("-" if not np.isfinite(each) or each > 1e3 else f"{each:.2g}" for each in factors),
            f"{per_sample(solver):.2g}",
            f"{shares[1][1]:.0f}",
        )
        row = (name, solver.spec.motion_model, *told, ", ".join(f"{share:.2f}" for share, _ in shares))
        sys.stdout.write(" | ".join(row) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
