"""Correctors that the correction study has on request, beside the others, with and without a translation.

Renders 18 small sequences (320 x 320, benchmarks/correctors.toml), runs the correction study on them with all its
methods, and prints the median of each motion over its scenes: PSNR on the pixels that the published methods cover,
flow error, and views without a correction.

    python benchmarks/correctors.py --out DIR

With --edges, in place of that, what `fusion` and `mono-fusion` make of depth edges: SSIM and FLIP, means over the
views of each motion, of the pixels up to 8 px from a jump of the true depth by 5 %, and of all others. Images are
as the command writes them: narrow holes closed, others black, frames that cannot be corrected as read. All
pixels count, of all frames.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.studies.correction_bench import METHODS, ON_REQUEST
from rsbench.benchmark.studies.correction_study import study_dataset
from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.rig import VIEWS, View
from rsbench.dataset import sequence as recorded
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.pipeline.arrays import of_rig, options_of
from rsbench.pipeline.chain import uncorrected
from rsbench.pipeline.mono_correction import MonoFusionCorrector
from rsbench.renderers.backend import start_backend
from rsbench.vision.corrector import CorrectionProblem
from rsbench.vision.fusion import Fused, finished
from rsbench.vision.quality import GAUSSIAN, Picture, flip, ssim_map

CARD = Path(__file__).with_suffix(".toml")
SHOWN = ("none", "gyro", "rotation", "gs-mono", "mono", *(method.key for method in ON_REQUEST), "ours", "truth")
EDGE_PX, JUMP = 8, 1.05
"""Reach of the band about a depth edge, and the ratio of neighbouring depths that is one."""
MOTIONS = ("turn-mild", "turn-moderate", "turn-aggressive", "mild", "moderate", "aggressive")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="of the dataset, and of what is done of the study")
    parser.add_argument("--edges", action="store_true", help="quality at depth edges instead")
    given = parser.parse_args(arguments)
    folder = given.out
    data = folder / "data"
    if not (data / "dataset.json").exists():
        start_backend()
        generate_dataset(load_dataset_card(str(CARD)), data)
    if given.edges:
        rows = [row for one in recorded.read_dataset(data) for row in edge_rows(one)]
        for line in edge_table(pd.DataFrame(rows)):
            sys.stdout.write(line + "\n")
        return 0
    others = tuple(method.key for method in ON_REQUEST)
    done = folder / "kept"
    views, _, _ = study_dataset(data, lambda name: None, kept=done, others=others)
    for line in table(pd.DataFrame(views)):
        sys.stdout.write(line + "\n")
    return 0


def edge_rows(sequence: recorded.Sequence) -> list[dict[str, object]]:
    """SSIM and FLIP at depth edges and elsewhere, of each method and view."""
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    frames = [images[view] for view in (("left", 0), ("right", 0), ("left", 1), ("right", 1))]
    options = options_of("rs-stereo-refined", None, "sgm", "sift-refined", "fusion", target_row=0.0)
    known = (sequence.rig, sequence.shutter)
    problem = CorrectionProblem(
        images=images, rig=known[0], shutter=known[1], target_row=0.0, motion=None, depth=None, guess=None
    )
    alone = MonoFusionCorrector().correct(problem, VIEWS)
    methods: dict[str, Mapping[View, Fused]] = {
        "uncorrected": uncorrected(images),
        "fusion": of_rig(frames, known[0], KnownInputs.of(known[1]), options, close=True).frames,
        "mono-fusion": {view: finished(fused) for view, fused in alone.items()},
    }
    rows = []
    for view in VIEWS:
        truth, near = sequence.image("gs", *view), edges(sequence.depth("gs", *view))
        for method, found in methods.items():
            image = found[view].image if found[view].success else images[view]
            scores = {"ssim": _ssim(image, truth), "flip": flip(image, truth)}
            for name, each in scores.items():
                if each is not None and np.any(near):
                    places = {"edges": near, "elsewhere": ~near}
                    rows += [
                        {
                            "sequence": sequence.name,
                            "method": method,
                            "score": f"{name}, {place}",
                            "value": float(np.mean(each[mask])),
                            "failed": not found[view].success,
                        }
                        for place, mask in places.items()
                    ]
    return rows


def edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) pixels up to ``EDGE_PX`` from a jump of a depth (H, W), of which 0 is infinity."""
    far = np.where(depth > 0.0, depth, np.float32(1e9))
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    jump = cv2.dilate(far, cross) > JUMP * cv2.erode(far, cross)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * EDGE_PX + 1, 2 * EDGE_PX + 1))
    return cv2.dilate(jump.astype(np.uint8), disc) > 0


def _ssim(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(H, W), the mean over the channels."""
    return np.asarray(ssim_map(Picture(image), Picture(truth), GAUSSIAN).mean(axis=-1))


def edge_table(rows: pd.DataFrame) -> list[str]:
    """As Markdown, a line for each score and method."""
    rows["motion"] = rows["sequence"].str.extract(r"^(?:castle|old-town|room)-(.*)$")
    groups = rows.groupby(["score", "method", "motion"], sort=False)
    means, failed = groups["value"].mean(), groups["failed"].mean()
    lines = ["| score | method | " + " | ".join(MOTIONS) + " |", "|" + " --- |" * (2 + len(MOTIONS))]
    for score, method in dict.fromkeys(zip(rows["score"], rows["method"], strict=True)):
        cells = [
            f"{means[score, method, motion]:.3f}"
            + (f" ({failed[score, method, motion]:.0%} failed)" if failed[score, method, motion] else "")
            for motion in MOTIONS
        ]
        lines.append(f"| {score} | {method} | " + " | ".join(cells) + " |")
    return [*lines[:2], *sorted(lines[2:])]


def table(views: pd.DataFrame) -> list[str]:
    """As Markdown: PSNR in dB / median flow error in px, and how many of the views have failed."""
    views["motion"] = views["sequence"].str.extract(r"^(?:castle|old-town|room)-(.*)$")
    titles = {method.key: method.title for method in (*METHODS, *ON_REQUEST)}
    lines = ["| method | " + " | ".join(MOTIONS) + " |", "|" + " --- |" * (1 + len(MOTIONS))]
    for key in SHOWN:
        cells = [_cell(views[(views["method"] == key) & (views["motion"] == motion)]) for motion in MOTIONS]
        lines.append(f"| {titles[key]} | " + " | ".join(cells) + " |")
    return lines


def _cell(own: pd.DataFrame) -> str:
    good = own[own["success"]]
    if not len(good):
        return f"all {len(own)} failed"
    lost = f" ({len(own) - len(good)} of {len(own)} failed)" if len(good) < len(own) else ""
    psnr, flow = (float(np.median(good[name])) for name in ("psnr_covered", "flow_median_px"))
    return f"{psnr:.1f} / {flow:.2f}{lost}"


if __name__ == "__main__":
    sys.exit(main())
