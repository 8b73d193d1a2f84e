"""Trajectories of whole sequences, scored: ours, windows, a global shutter's, a gyroscope's, and the truth.

    python benchmarks/trajectory_track.py --data data/handheld-small
    python benchmarks/trajectory_track.py --data data/footage --card footage --frames 30 --width 480 --psnr

Sequences of a dataset's card are rendered into --data where it has none yet, with --frames and --width in place of
the card's, the same field of view and the same motions. The shutter is told, and all methods get the same matches.
A row of the table is one method; the last table is of all sequences.

    rows        rotation of each row of the left camera against the first row of its frame, deg: median and 95 %
    way         the same against the first row of the sequence
    ATE, RPE    evo's, of the body at the starts of the frames: mm, mm and deg
    jitter      mean acceleration of true points after correction with their true depth, px per squared period
    PSNR        of left frames corrected with our depth, at the time of the first and of the middle row, dB, where
                the correction with the true motion draws something
    failed      windows without a motion, which score the worst value
    s           seconds of a window, without the matches

The methods are those of the leaderboard's track ``trajectory``, and the truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsbench.benchmark.trajectory_scores import METHODS, Estimate, Given, TrueTrajectory, trajectory_scores
from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.cards import card_path
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES
from rsbench.dataset.card import read_dataset_card
from rsbench.dataset.clock_channels import gyro_samples
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline import chain
from rsbench.pipeline.chain import correct_four
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions, frame_pairs
from rsbench.renderers.backend import start_backend
from rsbench.vision.fusion import Origin

COLUMNS = {
    "rows_median_deg": "rows med",
    "rows_95_deg": "95 %",
    "way_median_deg": "way med",
    "way_95_deg": "95 %",
    "ate_mm": "ATE mm",
    "rpe_mm": "RPE mm",
    "rpe_deg": "RPE deg",
    "jitter_px": "jitter",
    "psnr_first": "PSNR first",
    "psnr_middle": "middle",
    "failed": "failed",
    "seconds": "s",
}
_SMALL = ("castle-still", "old-town-walk", "street-shake")
ENTRIES = ("truth", *METHODS)
Scores = dict[str, float]


def psnr_scores(pictures: list[Any], estimate: Estimate) -> Scores:
    """Means over frames of PSNR at the times of the first and of the middle row; NaN without twins."""
    found: dict[str, list[float]] = {"psnr_first": [], "psnr_middle": []}
    for number, (pair, images, pairs, masks) in enumerate(pictures):
        motion = estimate.windows[number]
        for key, image, (true, mask) in zip(found, _drawn(pair, motion, images, pairs), masks, strict=True):
            error = (image.astype(np.float64) - true)[mask] if image is not None else None
            found[key].append(0.0 if error is None else 10.0 * np.log10(255.0**2 / max(np.mean(error**2), 1e-9)))
    return {key: float(np.mean(values)) for key, values in found.items()}


def _pictures(sequence: Sequence) -> Iterator[tuple[Any, ...]]:
    """Of each window: the pair, its frames with our depth, and truth and mask of both rows."""
    for pair in sequence.pairs():
        images = {(side, frame): pair.image("rs", side, frame) for frame in (0, 1) for side in SIDES}
        pairs = frame_pairs(images, pair.rig, CorrectionOptions())
        rows = (0, pair.shutter.height // 2)
        fused = _fused(pair, pair.motion, images, pairs)
        masks = [each.origin != Origin.NOBODY for each in fused]
        truths = [pair.image("gs", "left", 0, row) for row in rows]
        yield pair, images, pairs, list(zip(truths, masks, strict=True))


def _fused(pair: Sequence, motion: Motion, images: Any, pairs: Any) -> list[Any]:
    options, shutter = CorrectionOptions(), pair.shutter
    given, view = chain.Given(motion=motion, pairs=pairs), ("left", 0)
    rows = (float(shutter.height // 2),)
    inputs = KnownInputs.of(shutter)
    found = correct_four(images, pair.rig, inputs, options, given=given, views=(view,), rows=rows)
    return [found.frames[view], *(each[view] for each in found.at_rows)]


def _drawn(pair: Sequence, motion: Motion | None, images: Any, pairs: Any) -> list[Any]:
    if motion is None:
        return [None, None]
    if not (np.any(motion.w) or np.any(motion.d)):
        return [images["left", 0]] * 2
    return [each.image for each in _fused(pair, motion, images, pairs)]


# The table


def problem_of(sequence: Sequence) -> Given:
    """A sequence with the matches of our matcher."""
    options = CorrectionOptions()
    matches = list[Correspondences]()
    for pair in sequence.pairs():
        images = {(side, frame): pair.image("rs", side, frame) for frame in (0, 1) for side in SIDES}
        matches.append(find_matches_of_rig(images, pair.rig, pair.shutter.scanning, options))
    inertial = sequence.inertial() if "imu" in sequence.channels else None
    gyro = None if inertial is None else gyro_samples(inertial, sequence.frame_period_s)
    return Given(rig=sequence.rig, shutter=sequence.shutter, matches=matches, gyro=gyro)


def table(sequence: Sequence, entries: list[str], psnr: bool) -> dict[str, Scores]:
    """Scores of entries by name."""
    problem, truth, found = problem_of(sequence), TrueTrajectory.of(sequence), dict[str, Scores]()
    pictures = list(_pictures(sequence)) if psnr else []
    for name in entries:
        began = time.perf_counter()
        estimate = truth.estimate if name == "truth" else METHODS[name].solve(problem)
        if estimate is None:
            continue
        spent = (time.perf_counter() - began) / len(problem.matches)
        drawn = psnr_scores(pictures, estimate) if psnr and estimate.positions else {}
        found[name] = {**trajectory_scores(truth, estimate), **drawn, "seconds": spent}
    return found


def rendered(arguments: argparse.Namespace) -> list[Sequence]:
    """The sequences of a folder, made first where it has none."""
    if not (arguments.data / "dataset.json").is_file():
        start_backend()
        card = read_dataset_card(card_path("datasets", arguments.card))
        width, old = arguments.width, card.camera
        camera = replace(
            old, width=width, height=width * old.height // old.width, focal=old.focal * width / old.width
        )
        card = replace(card, camera=camera, frames=arguments.frames).expanded()
        generate_dataset(card.only(list(arguments.sequence)) if arguments.sequence else card, arguments.data)
    found = read_dataset(arguments.data)
    return [each for each in found if each.name in arguments.sequence] or found


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _print(title: str, found: dict[str, Scores]) -> None:
    shown = [key for key in COLUMNS if any(np.isfinite(each.get(key, np.nan)) for each in found.values())]
    _say(f"\n{title}\n{'':23}" + "".join(f"{COLUMNS[key]:>11}" for key in shown))
    for name, each in found.items():
        values = (each.get(key, np.nan) for key in shown)
        _say(f"{name:23}" + "".join(f"{'-' if np.isnan(value) else f'{value:.4g}':>11}" for value in values))


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the dataset")
    parser.add_argument("--card", default="handheld", help="of what is rendered where --data is not there")
    parser.add_argument("--sequence", nargs="*", help="names; of the card handheld three, of others all")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--entries", nargs="*", default=list(ENTRIES), choices=list(ENTRIES))
    parser.add_argument("--psnr", action="store_true", help="correct the frames too")
    arguments = parser.parse_args()
    if arguments.sequence is None:
        arguments.sequence = _SMALL if arguments.card == "handheld" else ()
    found = dict[str, dict[str, Scores]]()
    for sequence in rendered(arguments):
        found[sequence.name] = table(sequence, arguments.entries, arguments.psnr)
        _print(f"{sequence.name}, {sequence.frames} frames", found[sequence.name])
    names = [name for name in arguments.entries if all(name in each for each in found.values())]
    keys = {name: {key for each in found.values() for key in each[name]} for name in names}
    means = {
        name: {key: float(np.mean([each[name].get(key, np.nan) for each in found.values()])) for key in keys[name]}
        for name in names
    }
    _print(f"mean of {len(found)} sequences", means)
    return 0


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main())
