"""Depth and correction of cameras that read columns, in opposite directions, or one of them late.

Renders small sequences of two scenes (480 x 480), corrects all four frames with the motion that is estimated, and
compares depth with the true one and images with the global-shutter twins; beside them a pair that reads its rows
together.

    python benchmarks/cameras_apart.py --out DIR
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import read_dataset
from rsbench.pipeline.chain import correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.vision.quality import psnr
from rsbench.vision.stereo_depth import depth_metrics

CASTLE: dict[str, Any] = {"scene": "castle", "rotation": 2.0, "translation": 0.3, "baseline": 0.6, "ratio": 0.9}
TOWN: dict[str, Any] = {"scene": "old-town", "rotation": 6.0, "translation": 0.5, "baseline": 0.5, "ratio": 0.8}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": (CASTLE, {}),
    "late": (CASTLE, {"right_delay": 0.15}),
    "columns": (CASTLE, {"scan": "left"}),
    "opposite": (CASTLE, {"right_scan": "bottom"}),
    "fast-opposite": (TOWN, {"right_scan": "bottom"}),
    "fast-columns": (TOWN, {"scan": "left", "right_scan": "right", "right_delay": 0.1}),
}


def card(name: str) -> DatasetCard:
    given, scanning = CASES[name]
    motion = MotionCard(
        rotation_deg=given["rotation"],
        rotation_axis="random",
        translation=given["translation"],
        translation_axis="random",
    )
    return DatasetCard(
        name=name,
        camera=CameraCard(width=480, height=480, focal=432.0),
        baseline=given["baseline"],
        readout_ratio=given["ratio"],
        motion=motion,
        renderer="default",
        sequence=(SequenceCard(name=given["scene"], scene=given["scene"], seed=2),),
        **scanning,
    ).expanded()


def row(folder: Path) -> str:
    (sequence,) = read_dataset(folder)
    images, twins = ({view: sequence.image(kind, *view) for view in VIEWS} for kind in ("rs", "gs"))
    found = correct_four(images, sequence.rig, KnownInputs.of(sequence.shutter), CorrectionOptions())
    before, after = (
        np.mean([psnr(each[view], twins[view]) for view in VIEWS])
        for each in (images, {view: found.frames[view].image for view in VIEWS})
    )
    scores = []
    for side, frame in VIEWS:
        depth = found.pairs[frame].depth[side] if found.pairs else np.zeros(images[side, frame].shape[:2])
        known = np.where(np.isfinite(depth), depth, 0.0)
        scores.append(depth_metrics(known, sequence.depth("rs", side, frame), sequence.rig))
    mean = {name: np.mean([each[name] for each in scores]) for name in ("median_m", "bad_1px", "coverage")}
    return (
        f"{folder.name:14}{mean['median_m']:8.3f}{100 * mean['bad_1px']:8.1f}{100 * mean['coverage']:8.1f}"
        f"{before:10.1f}{after:10.1f}{sum(found.seconds.values()):8.0f}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the datasets; rendered where they lack")
    given = parser.parse_args(arguments)
    sys.stdout.write("case          median m  >1 px %  known %  PSNR RS corrected seconds\n")
    for name in CASES:
        generate_dataset(card(name), given.out / name)
        sys.stdout.write(row(given.out / name) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
