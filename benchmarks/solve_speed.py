"""Speed and accuracy of motion estimation, ours beside PoseLib on the same matches, in one run on one core.

python benchmarks/solve_speed.py
python benchmarks/solve_speed.py --matches 1000 --outliers 0.5 --noise 0.3 --runs 20
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"  # before NumPy and Numba load

import sys
import time
from collections.abc import Callable

import numpy as np

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.packed import pack, pack_pairs, solve_triples
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import five_point

CAMERA = PinholeCamera.centred(900, 900, 810.0)
RIG = StereoRig(camera=CAMERA, baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
Vectors = tuple[np.ndarray, np.ndarray]


def problems(options: SimulationOptions, runs: int) -> list[Simulation]:
    rngs = [np.random.default_rng([7, run]) for run in range(runs)]
    return [simulate(RIG, SHUTTER, random_motion(rng, np.deg2rad(2.0), 0.3), options, rng) for rng in rngs]


def ours(solver_name: str) -> Callable[[Correspondences], Vectors]:
    solver = load_solver(solver_name)

    def solve(matches: Correspondences) -> Vectors:
        estimate = estimate_motion(
            matches, RIG, SHUTTER, solver, RobustOptions(confidence=0.99), np.random.default_rng(0)
        ).estimate
        return estimate.w, estimate.d

    return solve


def poselib_stereo(matches: Correspondences) -> Vectors:
    """PoseLib's own LO-RANSAC on the generalised relative pose of the rig, left and right pairs."""
    import poselib

    from rsbench.core import so3

    pairs = []
    for number, side in enumerate(("left", "right")):
        rows = track_pairs(matches.tracks, side)
        pair = poselib.PairwiseMatches()
        pair.cam_id1 = pair.cam_id2 = number
        pair.x1, pair.x2 = list(rows[:, :2]), list(rows[:, 2:])
        pairs.append(pair)
    model = {"model": "PINHOLE", "width": 900, "height": 900, "params": [810.0, 810.0, 449.5, 449.5]}
    places = [poselib.CameraPose(), poselib.CameraPose()]
    places[0].t, places[1].t = RIG.offset("left"), RIG.offset("right")
    options = {"max_error": 1.25, "max_epipolar_error": 1.25, "success_prob": 0.99, "seed": 0}
    pose, _ = poselib.estimate_generalized_relative_pose(
        pairs, places, [model, model], places, [model, model], options, {}
    )
    return so3.log(np.asarray(pose.R)), np.asarray(pose.t)


def row(name: str, solve: Callable[[Correspondences], Vectors], cases: list[Simulation]) -> str:
    solve(cases[0].correspondences)  # compiles
    times, e_R, e_T = [], [], []
    for case in cases:
        start = time.perf_counter()
        w, d = solve(case.correspondences)
        times.append(1e3 * (time.perf_counter() - start))
        e_R.append(np.rad2deg(rotation_error(w, case.motion.w)))
        e_T.append(np.rad2deg(translation_error(d, case.motion.d)))
    figures = [np.median(times), np.percentile(times, 90), np.median(e_R), np.median(e_T)]
    return f"{name:34s}" + "".join(f"{figure:12.4g}" for figure in figures)


def minimal_rates(case: Simulation, repetitions: int = 20000) -> list[str]:
    """Minimal samples solved per second; PoseLib's are called one by one, which is all that it offers."""
    import poselib

    tracks = case.correspondences.tracks
    rng = np.random.default_rng(1)
    samples = np.array([rng.choice(len(tracks), 6, replace=False) for _ in range(repetitions)])
    packed = pack(case.correspondences, RIG, SHUTTER)
    pairs = pack_pairs(track_pairs(tracks, "left"), "left", RIG, SHUTTER)
    rays = CAMERA.unproject(tracks.reshape(-1, 4, 2))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    left, right = ([list(rays[sample, view]) for sample in samples] for view in (0, 1))
    later = [list(rays[sample, 2]) for sample in samples]
    places = [np.array([side, 0.0, 0.0]) for side in (0.5, 0.5, 0.5, -0.5, -0.5, -0.5)]
    mixed = [a[:3] + b[3:] for a, b in zip(left, right, strict=True)]
    moved = [a[:3] + list(rays[s[3:], 3]) for a, s in zip(later, samples, strict=True)]

    def one_by_one(call: Callable[[int], object], count: int) -> Callable[[], int]:
        def loop() -> int:
            for k in range(count):
                call(k)
            return count

        return loop

    def batch() -> int:
        solve_triples(packed, samples[:, :3])
        return repetitions

    fives = [pairs[sample[:5]] for sample in samples[:1000]]
    rows = []
    for name, loop in (
        ("ours, 3 tracks, one batch", batch),
        ("ours, 5 pairs of one camera", one_by_one(lambda k: five_point(fives[k]), len(fives))),
        (
            "PoseLib 5pt, GS",
            one_by_one(lambda k: poselib.relpose_5pt(left[k][:5], later[k][:5]), repetitions),
        ),
        (
            "PoseLib generalised 6pt, GS",
            one_by_one(lambda k: poselib.gen_relpose_6pt(places, mixed[k], places, moved[k]), 200),
        ),
    ):
        loop()
        start = time.perf_counter()
        rows.append(f"{name:34s}{loop() / (time.perf_counter() - start):12.0f}")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--matches", type=int, default=1000, help="four-view tracks")
    parser.add_argument("--outliers", type=float, default=0.5, help="share of them that are wrong")
    parser.add_argument("--noise", type=float, default=0.3, help="px on every coordinate")
    parser.add_argument("--runs", type=int, default=20, help="problems per figure")
    arguments = parser.parse_args()
    options = SimulationOptions(
        tracks=arguments.matches, noise_px=arguments.noise, outlier_ratio=arguments.outliers
    )
    cases = problems(options, arguments.runs)
    lines = [
        f"{arguments.matches} matches, {100 * arguments.outliers:g} % outliers, {arguments.noise:g} px, one core"
    ]
    lines.append(
        f"{'robust pipeline':34s}" + "".join(f"{h:>12s}" for h in ("median ms", "p90 ms", "e_R deg", "e_T deg"))
    )
    for name in (
        "rs-stereo-refined",
        "rs-stereo-tracks",
        "rs-stereo-refined-pairs",
        "gs-poselib-stereo",
        "gs-8pt",
    ):
        lines.append(row(name, ours(name), cases))
    lines.append(row("PoseLib's own RANSAC, stereo rig", poselib_stereo, cases))
    lines += [f"{'minimal samples':34s}{'per second':>12s}", *minimal_rates(cases[0])]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
