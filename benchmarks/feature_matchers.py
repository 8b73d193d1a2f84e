"""Feature matchers on rendered frames: pose-2's score of the motion that their matches give, and their time.

Of each sequence of a dataset with two stereo frames: tracks, the share of their later ends that the truth
contradicts by more than 1 px, errors of the motion under the law that the matches choose (``rs-stereo-refined``,
``auto``), pose-2's score (mean of the areas under the curves of e_R to 0.1 deg and of e_T to 1 deg), and processor
seconds of matching and of solving. Matchers take turns on each sequence, so that what else runs on the machine
slows them alike. A table of each sequence is written beside the summary by sensor and by law.

    rsbench generate laws --out data/laws --only castle-twist-moderate-real-1 ...
    python benchmarks/feature_matchers.py --data data/laws --features sift sift-refined dense --out matchers.csv
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from rsbench.benchmark.leaderboard.motion_tracks import match_scores
from rsbench.benchmark.scoring import pose_errors
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import FRAMES, SIDES, VIEWS, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.answer import solve_problem
from rsbench.pipeline.footage import read_frame, read_rig_card
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.dense_matcher import forget_matches
from rsbench.vision.feature_matcher import load_features


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """Four frames with their truth."""

    name: str
    law: str
    sensor: str
    images: dict[View, NDArray[Any]]
    rig: StereoRig
    shutter: RollingShutter
    w: FloatArray
    d: FloatArray
    sequence: Sequence | None = None
    """With the true depth."""


def rendered(folder: Path) -> Iterator[Case]:
    """Of a dataset of rsbench."""
    for sequence in read_dataset(folder):
        yield Case(
            name=sequence.name,
            law=sequence.motion.name,
            sensor="ideal" if sequence.sensor is None else "real",
            images={view: sequence.image("rs", *view) for view in VIEWS},
            rig=sequence.rig,
            shutter=sequence.shutter,
            w=sequence.motion.w,
            d=sequence.motion.d,
            sequence=sequence,
        )


def foreign(folder: Path) -> Iterator[Case]:
    """Pairs of times that ``foreign_frames.py`` traced."""
    for place in sorted(each.parent for each in folder.glob("*/truth.json")):
        truth = json.loads((place / "truth.json").read_text("utf-8"))
        if truth["frames"] != len(FRAMES):
            continue
        images = {(side, frame): read_frame(place / f"{side}_{frame}.png") for side, frame in VIEWS}
        card, sizes = read_rig_card(place / "told.toml"), [images[side, 0].shape[1::-1] for side in SIDES]
        rig = card.rig(*sizes)
        yield Case(
            name=place.name,
            law=truth["motion_model"] or truth["law"],
            sensor="noise",
            images=images,
            rig=rig,
            shutter=rig.shutter_of(card.scanning or Scanning(), truth["ratio"]),
            w=np.array(truth["w"]),
            d=np.array(truth["d"]),
        )


def row_of(case: Case, features: str, model: str, most: int, seed: int) -> dict[str, Any]:
    """Figures of one matcher on one case."""
    options = CorrectionOptions(features=load_features(features))
    forget_matches()
    begin = time.process_time()
    matches = find_matches_of_rig(case.images, case.rig, case.shutter.scanning, options)
    matched = time.process_time()
    if 0 < most < len(matches.tracks):
        kept = np.sort(np.random.default_rng(seed).permutation(len(matches.tracks))[:most])
        matches = Correspondences(tracks=matches.tracks[kept])
    problem = Problem(name=case.name, correspondences=matches, rig=case.rig, known_shutter=case.shutter)
    solving = time.process_time()
    with SolverRunner() as runner:
        entry = load_solver_entry("rs-stereo-refined")
        found = solve_problem(problem, entry, RobustOptions(), runner, seed, ("covariance",), model)
    solved = time.process_time()
    w, d = (np.full(3, np.nan) if found[key] is None else np.array(found[key]) for key in ("w", "d"))
    errors = pose_errors(
        w,
        d,
        true_w=case.w,
        true_d=case.d,
        rig=case.rig,
        success=bool(found["success"]),
        metric=bool(found["metric"]),
        reference_point=found["reference_point"],
    )
    e_R, e_T = float(errors["e_R_deg"]), float(errors["e_T_deg"])
    wrong = square = float("nan")
    if found["success"] and found["metric"] and found["covariance"] is not None:
        error = np.concatenate([w - case.w, d - case.d])
        square = float(error @ np.linalg.solve(np.array(found["covariance"]), error))
    if case.sequence is not None and case.rig.rectified:
        wrong = 1.0 - match_scores(case.sequence, Correspondences(tracks=matches.tracks))["matches_1px"]
    return {
        "sequence": case.name,
        "law": case.law,
        "sensor": case.sensor,
        "features": Path(features).stem,
        "tracks": len(matches.tracks),
        "wrong": wrong,
        "e_R": e_R,
        "e_T": e_T,
        "score": 0.5 * (max(0.0, 1.0 - e_R / 0.1) + max(0.0, 1.0 - e_T)),
        "square": square,
        "model": str(found["motion_model"]),
        "matching_s": matched - begin,
        "solving_s": solved - solving,
    }


_LEVEL, _MEDIAN = chi2.ppf([0.95, 0.5], 6)


def summary(table: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Means of score, share of wrong ends and seconds; medians of tracks; geometric means of the errors.

    Also how many motions have a stated covariance, how many of their 95 % ellipsoids hold the truth, and the size
    of their axes over the actual scatter, by medians.
    """
    groups = table.groupby([*by, "features"], sort=False)
    found = groups[["score", "wrong", "matching_s", "solving_s"]].mean()
    found["tracks"] = groups["tracks"].median()
    found["stated"] = groups["square"].count()
    found["in_95"] = groups["square"].agg(lambda each: float(np.mean(each.dropna() <= _LEVEL)))
    found["size"] = groups["square"].agg(lambda each: float(np.sqrt(_MEDIAN / each.median())))
    for name in ("e_R", "e_T"):
        found[name] = groups[name].agg(lambda each: float(np.exp(np.mean(np.log(np.maximum(each, 1e-9))))))
    found["sequences"] = groups.size()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="dataset, or folder of foreign_frames.py")
    parser.add_argument("--features", nargs="+", default=["sift", "sift-refined", "dense"], help="names or cards")
    parser.add_argument("--only", default="", help="sequences whose name holds this")
    parser.add_argument("--true-law", action="store_true", help="solve under the law that the rig follows")
    parser.add_argument("--most", type=int, default=0, help="tracks that are solved with, at most; 0: all")
    parser.add_argument("--seed", type=int, default=0, help="of the solver's samples")
    parser.add_argument("--out", type=Path, help="table of each sequence and matcher")
    arguments = parser.parse_args()
    rows = list[dict[str, Any]]()
    for case in (rendered if (arguments.data / "dataset.json").is_file() else foreign)(arguments.data):
        if arguments.only not in case.name:
            continue
        for features in arguments.features:
            model = case.law if arguments.true_law else "auto"
            row = row_of(case, features, model, arguments.most, arguments.seed)
            rows.append(row)
            sys.stdout.write(
                f"{row['sequence']:40} {row['features']:14} {row['tracks']:5d} tracks, "
                f"{row['wrong']:6.1%} wrong, e_R {row['e_R']:.4f}, e_T {row['e_T']:.3f}, "
                f"score {row['score']:.3f}, {row['model']}, "
                f"{row['matching_s']:.2f} + {row['solving_s']:.2f} s\n"
            )
            sys.stdout.flush()
    table = pd.DataFrame(rows)
    if arguments.out:
        table.to_csv(arguments.out, index=False)
    for by in (["sensor"], ["law", "sensor"]):
        sys.stdout.write(summary(table, by).round(4).to_string() + "\n")


if __name__ == "__main__":
    main()
