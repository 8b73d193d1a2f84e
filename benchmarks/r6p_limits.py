"""What limits R6P: its linearisations by the rotation, on boxes and planes, and the bound of its twelve unknowns.

    nice python benchmarks/r6p_limits.py --out results/r6p          # half a minute of a processor

Exact data: of which share of the points minimal samples come within 4 px, for each linearisation and start; and
the error of direction that all points leave, linear and refined. Noise, of frame 1 alone: the measured error of
direction beside the bound of the method's own model (exact rotations, points known, velocities free: an estimator
of twelve unknowns can do no better) and that of six unknowns with the same velocities known. Errors are root mean
squares over draws of noise, medians over trials.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from rsbench.benchmark.provenance import provenance
from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.seeds import generator
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import translation_error
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.r6p import R6pSolver, Resection, RowPose, errors, linear_pose
from rsbench.storage.files import write_json, write_table

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.3)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
SEED, TRIALS, DRAWS, SAMPLES = 7, 8, 4, 10
POINTS, DISTANCE_M, NOISE_PX, NEAR_PX = 100, 0.3, 0.3, 4.0
ANGLES_DEG = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0)
KINDS: tuple[tuple[Literal["double", "single"], Literal["still", "p3p"]], ...] = (
    *(("double", "still"), ("double", "p3p"), ("single", "still")),
)
SHAPES: tuple[Literal["box", "plane"], ...] = ("box", "plane")


def trial(angle: float, shape: Literal["box", "plane"], number: int) -> Simulation:
    """Exact tracks of a motion of an angle, degrees."""
    motion = random_motion(generator(SEED, "r6p", "motion", number), float(np.radians(angle)), DISTANCE_M)
    options = SimulationOptions(tracks=POINTS, shape=shape)
    return simulate(RIG, SHUTTER, motion, options, generator(SEED, "r6p", "scene", number))


def near(s: Simulation, solver: R6pSolver, rng: np.random.Generator) -> float:
    """Mean share of the points that a minimal sample comes near."""
    tracks = s.correspondences.tracks
    R0 = solver.beginning(tracks, RIG, SHUTTER)
    drawn = np.concatenate([rng.choice(tracks, 6, replace=False) for _ in range(SAMPLES)])
    data = Resection.of(tracks, RIG, SHUTTER, ("left",), True)
    with np.errstate(all="ignore"):
        samples = Resection.of(drawn, RIG, SHUTTER, ("left",), True).in_samples(SAMPLES)
        found = linear_pose(samples, solver.linearisation == "single", R0)
        shares = []
        for pose in (RowPose(*parts) for parts in zip(*found, strict=True)):
            e, _ = errors(data, pose, data.points(so3.log(pose.R), pose.C))
            shares.append(np.mean(np.sum(e.reshape(-1, 2) ** 2, axis=1) < NEAR_PX**2) if pose.finite else 0.0)
    return float(np.mean(shares))


def direction(s: Simulation, solver: R6pSolver, tracks: FloatArray) -> float:
    """Error, degrees, of all tracks."""
    found = solver.estimate(Correspondences(tracks=tracks), RIG, SHUTTER)
    return float(np.degrees(translation_error(found.d, s.motion.d))) if found.success else 90.0


def bounds(s: Simulation) -> tuple[float, float]:
    """Root mean square error of direction, degrees, of the twelve unknowns and of the pose alone."""
    w, d = s.motion.w, s.motion.d
    data = Resection.of(s.correspondences.tracks, RIG, SHUTTER, SIDES, True)
    # As seen at tau = 1 + s: exp(s w) of exp(w) X, and d + s d.
    J = errors(data, RowPose(so3.exp(w), d, w, d), data.points(w, d))[1]
    across = np.eye(3) - np.outer(d, d) / (d @ d)
    found = []
    for known in (12, 6):
        _, sizes, V = np.linalg.svd(J[:, :known], full_matrices=False)
        root = across @ (V.T / sizes)[3:6]
        found.append(float(np.degrees(NOISE_PX * np.sqrt(np.sum(root**2) / (d @ d)))))
    return found[0], found[1]


def rows() -> list[dict[str, Any]]:
    """Of the table, one for each shape and angle."""
    table = []
    for shape in SHAPES:
        for angle in ANGLES_DEG:
            found: list[dict[str, float]] = []
            for number in range(TRIALS):
                s, rng = trial(angle, shape, number), generator(SEED, "r6p", "noise", number)
                exact, row = s.correspondences.tracks, dict[str, float]()
                for kind, start in KINDS:
                    solver, name = R6pSolver(linearisation=kind, start=start, threshold_px=50.0), f"{kind}_{start}"
                    row[f"near_{name}"] = near(s, solver, rng)
                    row[f"linear_deg_{name}"] = direction(s, replace(solver, refinement="none"), exact)
                solver = R6pSolver()
                row["refined_deg"] = direction(s, solver, exact)
                noisy = [exact.copy() for _ in range(DRAWS)]
                for each in noisy:
                    each[:, 4:] += rng.normal(0.0, NOISE_PX, each[:, 4:].shape)
                row["noisy_deg"] = float(np.sqrt(np.mean([direction(s, solver, each) ** 2 for each in noisy])))
                row["bound_deg"], row["bound_known_velocity_deg"] = bounds(s)
                row["over_bound"] = row["noisy_deg"] / row["bound_deg"]
                found.append(row)
            table.append({"shape": shape, "rotation_deg": angle, **pd.DataFrame(found).median().to_dict()})
    return table


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows())
    write_table(options.out / "limits.csv", table)
    sizes = {"seed": SEED, "trials": TRIALS, "draws": DRAWS, "samples": SAMPLES, "points": POINTS}
    sizes |= {"noise_px": NOISE_PX, "distance_m": DISTANCE_M}
    command = f"python benchmarks/r6p_limits.py --out {options.out.as_posix()}"
    write_json(options.out / "provenance.json", provenance(command, **sizes))
    sys.stdout.write(table.to_string(index=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
