"""How often stated ellipsoids hold the true motion, by setting: python benchmarks/coverage_study.py SETTING...

python benchmarks/coverage_study.py easy mid hard points [--seeds 0:60] [--model auto] [--out FILE.jsonl]
python benchmarks/coverage_study.py rendered --data DATASET [--features dense] [--parts 4]
python benchmarks/coverage_study.py --report FILE.jsonl...

easy, mid and hard are tracks of random points (300, 60 and 30; 0.3, 1 and 1.5 px; 10, 30 and 40 % outliers)
under a law drawn from the four; points: fresh draws of the problems of the track points-2, a seed for 240 of them.
rendered: frames of a dataset of rsbench's, whose matches are kept in the cache; with --parts also random parts of
the matches. For each: the share of 95 % ellipsoids that hold the true (w, d); the size of the stated deviations
over the actual ones (of an axis, by medians); log score (lower is better); errors; how often the truth's law has a
probability below 0.05, a spline is taken where nothing shakes, and an answer is called decided that errs by more
than ten deviations. ``--model true`` gives the law.
"""

# ruff: noqa: E402, T201
from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np
from scipy.stats import beta, chi2

from rsbench.benchmark.leaderboard.splits import POINTS_2, simulated_problem
from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.sequence import read_dataset_manifest, read_sequence
from rsbench.pipeline.answer import solve_problem
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.vision.feature_matcher import load_features

MODELS = ("linear", "twist", "inertial", "accelerated")
SETTINGS = {
    "easy": (StereoRig(camera=PinholeCamera.centred(640, 480, 500.0), baseline=0.2), 300, 0.3, 0.1),
    "mid": (StereoRig(camera=PinholeCamera.centred(640, 480, 500.0), baseline=0.1), 60, 1.0, 0.3),
    "hard": (StereoRig(camera=PinholeCamera.centred(640, 480, 300.0), baseline=0.02), 30, 1.5, 0.4),
}
OF_POINTS = 240
Case = tuple[str, Problem, Motion, str]
"""Name, problem, truth and group of it."""


def drawn(setting: str, seed: int) -> Case:
    """A problem of easy, mid or hard: 0.5 to 6 deg, 0.05 to 0.4 m, a readout ratio of 0.3 to 0.95."""
    rig, tracks, noise, outliers = SETTINGS[setting]
    rng = np.random.default_rng([52, seed, list(SETTINGS).index(setting)])
    angle, distance = np.deg2rad(0.5 * 12.0 ** rng.random()), 0.05 * 8.0 ** rng.random()
    model, k = MODELS[seed % 4], float(rng.uniform(-0.4, 0.4))
    base = random_motion(rng, angle, distance)
    motion = make_motion(model, base.w, base.d, {"acceleration": k} if model == "accelerated" else {})
    shutter = RollingShutter(height=480, readout_ratio=float(rng.uniform(0.3, 0.95)))
    options = SimulationOptions(tracks=tracks, noise_px=noise, outlier_ratio=outliers)
    data = simulate(rig, shutter, motion, options, np.random.default_rng([53, seed]))
    problem = Problem(name=str(seed), correspondences=data.correspondences, rig=rig, known_shutter=shutter)
    return str(seed), problem, motion, model


def points(seed: int) -> Case:
    """The problem ``seed % 240`` of points-2 under the seed 1000 + ``seed // 240``, in an order of our own."""
    board, number = 1000 + seed // OF_POINTS, (101 * seed) % OF_POINTS
    motion = POINTS_2.motion(board, number)
    return str(seed), simulated_problem(board, number, POINTS_2), motion, motion.name


def rendered(data: Path, cache: Path, numbers: range, parts: int, features: str) -> Iterator[Case]:
    """Sequences of a dataset by their places in it, and random parts of their matches."""
    cache.mkdir(parents=True, exist_ok=True)
    names = sorted(read_dataset_manifest(data).sequences)
    for number in numbers:
        if number >= len(names):
            return
        sequence, file = read_sequence(data / names[number]), cache / f"{names[number]}-{features}.npz"
        if not file.exists():
            images = {view: sequence.image("rs", *view) for view in VIEWS}
            options = CorrectionOptions(features=load_features(features))
            found = find_matches_of_rig(images, sequence.rig, sequence.shutter.scanning, options)
            sets = {name: getattr(found, name) for name in ("left", "right", "stereo_0", "stereo_1", "tracks")}
            np.savez_compressed(file, **sets)
        whole = Correspondences(**np.load(file))
        for part in range(parts + 1):
            matches = whole
            if part:
                rng = np.random.default_rng([54, number, part])
                keep = rng.permutation(len(whole.tracks))[: min(100, len(whole.tracks) // 2)]
                matches = Correspondences(tracks=whole.tracks[keep])
            name = names[number] + (f"/{part}" if part else "")
            problem = Problem(name=name, correspondences=matches, rig=sequence.rig, known_shutter=sequence.shutter)
            yield name, problem, sequence.motion, ("part " if part else "") + names[number].split("-")[-2]


def cases(args: argparse.Namespace, setting: str) -> Iterator[Case]:
    if setting == "rendered":
        yield from rendered(args.data, args.cache, args.numbers, args.parts, args.features)
        return
    for seed in args.numbers:
        try:
            yield points(seed) if setting == "points" else drawn(setting, seed)
        except Exception as error:
            print(f"{setting} {seed}: {error}", file=sys.stderr)


def judged(setting: str, case: Case, model: str, runner: SolverRunner) -> dict[str, Any]:
    """One line of the study."""
    name, problem, truth, group = case
    options, law = CorrectionOptions(), truth.name
    start = time.process_time()
    requested = (law if law in MODELS else "linear") if model == "true" else model
    answer = solve_problem(
        problem, options.solver, options.robust, runner, extras=("covariance",), motion_model=requested
    )
    line = {"setting": setting, "name": name, "group": group, "law": law, "success": bool(answer["success"])}
    line |= {"seconds": time.process_time() - start, "tracks": len(problem.correspondences.tracks)}
    choice = answer["model_choice"]
    if choice is not None:
        line |= {"used": choice["used"], "decided": choice["decided"], "odds": choice["probability"]}
    if not answer["success"]:
        return line
    w, d = np.array(answer["w"]), np.array(answer["d"])
    errors = rotation_error(w, truth.w), translation_error(d, truth.d)
    line["e_R"], line["e_T"] = np.rad2deg(errors).tolist()
    line["metric"], line["direction_known"] = answer["metric"], answer["direction_known"]
    error = np.concatenate([w - truth.w, d - truth.d])
    line["away"] = float(np.linalg.norm(error[3:]) / np.linalg.norm(truth.d))
    if answer["covariance"] is not None:
        C = np.array(answer["covariance"])
        sizes = np.sqrt(np.diagonal(C))
        scaled = C / np.outer(sizes, sizes)
        line["nees"] = float(error / sizes @ np.linalg.solve(scaled, error / sizes))
        line["log_det"] = float(np.linalg.slogdet(scaled)[1] + 2.0 * np.sum(np.log(sizes)))
    return line


def report(lines: list[dict[str, Any]]) -> None:
    """A table by setting, and by the law of the truth."""
    for setting in dict.fromkeys(line["setting"] for line in lines):
        own = [line for line in lines if line["setting"] == setting]
        _row(setting, own)
        for group in sorted({line["group"] for line in own}):
            _row(f"  {group}", [line for line in own if line["group"] == group])
    bins = [(p, name == line["law"]) for line in lines for name, p in line.get("odds", {}).items()]
    for low, high in ((0.0, 0.02), (0.02, 0.05), (0.05, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        chosen = [(p, right) for p, right in bins if low <= p < high]
        if chosen:
            p, right = np.mean(chosen, axis=0)
            print(f"stated probability {low:.2f} to {high:.2f}: mean {p:.3f}, right {right:.3f} of {len(chosen)}")


def _row(name: str, lines: list[dict[str, Any]]) -> None:
    solved = [line for line in lines if line["success"]]
    stated = [line for line in solved if "nees" in line]
    if not stated:
        print(f"{name:12} n={len(lines)} none stated")
        return
    nees = np.array([line["nees"] for line in stated])
    held, n = int(np.sum(nees <= chi2.ppf(0.95, 6))), len(nees)
    low, high = beta.ppf([0.025, 0.975], [held, held + 1], [n - held + 1, n - held])
    median = float(np.sqrt(np.median(nees) / chi2.ppf(0.5, 6)))
    score = float(np.mean(0.5 * np.minimum(nees, 1e3) + [0.5 * line["log_det"] for line in stated]))
    splines = [line.get("used") == "continuous" for line in solved if line["law"] != "spline"]
    odds = [line["odds"].get(line["law"], 0.0) for line in solved if line["law"] in MODELS and "odds" in line]
    gross = [line.get("decided", False) and line["nees"] > 600.0 for line in stated]
    errors = np.median([[line["e_R"], line["e_T"], line["away"]] for line in solved], axis=0)
    print(
        f"{name:12} n={len(lines):<4} held {held / n:.3f} "
        f"[{np.nan_to_num(low):.2f}, {np.nan_to_num(high, nan=1):.2f}] "
        f"size {1 / median if median else 0:.2f} score {score:6.2f} failed {1 - len(solved) / len(lines):.2f} "
        f"e_R {errors[0]:.4f} e_T {errors[1]:.3f} d {errors[2]:.3f} "
        f"p<.05 {np.mean(np.array(odds) < 0.05) if odds else np.nan:.3f} "
        f"spline {np.mean(splines) if splines else 0:.3f} gross {np.mean(gross):.3f} "
        f"decided {np.mean([line.get('decided', False) for line in solved]):.2f} "
        f"s {np.median([line['seconds'] for line in lines]):.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", nargs="*", choices=[*SETTINGS, "points", "rendered", []])
    parser.add_argument("--seeds", default="0:60", help="A:B or A:B:STEP; of rendered, places in the dataset")
    parser.add_argument("--model", default="auto", help="auto, true, or a motion model")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--cache", type=Path, default=Path("matches-of-coverage"))
    parser.add_argument("--features", default="sift-refined", help="matcher of rendered frames: a name or a card")
    parser.add_argument("--parts", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--report", type=Path, nargs="+")
    args = parser.parse_args()
    if args.report:
        report([json.loads(line) for file in args.report for line in file.read_text().splitlines()])
        return
    args.numbers = range(*map(int, args.seeds.split(":")))
    lines = []
    with SolverRunner() as runner:
        for setting in args.settings:
            for case in cases(args, setting):
                lines.append(judged(setting, case, args.model, runner))
                if args.out:
                    with args.out.open("a") as stream:
                        stream.write(json.dumps(lines[-1]) + "\n")
    report(lines)


if __name__ == "__main__":
    main()
