"""What single pairs of a global-shutter stereo drive are told of their readout ratio.

    python benchmarks/kitti_pairs.py FOLDER [FOLDER ...] --left image_l --right image_r --every 3

FOLDER is as of ``examples/score_kitti.py``. A line a pair: the ratio with its deviation as a correction would
state it, or "states none" where the scans that the matches allow have no ratio in common. A ratio that is told is
0 or wrong; one that is stated with "cannot tell" is right where 0 is within two deviations.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from score_kitti import read_rig, step

from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.shutter_decision import NoMotionError, as_global, known_of, shutter_found
from rsbench.capture.two_frame_estimate import CERTAIN, conclude, examine
from rsbench.core.errors import RsbenchError
from rsbench.pipeline.footage import FrameSource
from rsbench.pipeline.frame_capture import match_given
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.sequence_capture import window_images


def stated(folder: Path, names: tuple[str, str], every: int) -> Iterator[tuple[int, str, float, float]]:
    """Number of a pair, "told", "cannot tell" or "states none", ratio and standard deviation."""
    sources, options = [FrameSource(folder / name) for name in names], CorrectionOptions()
    files = [*sources[0].path.iterdir()] if sources[0].path.is_dir() else []
    if not files:
        raise RsbenchError(f"{sources[0].path}: no folder of images; --left and --right name them")
    rig = read_rig(folder, min(files))
    for number, images in enumerate(window_images(*sources)):
        if number % every:
            continue
        matches = match_given(images, rig, options, KnownInputs())[0]
        known = known_of(matches, rig, KnownInputs())
        found = conclude([examine(matches, rig, known, options.robust, 0)])
        capture = as_global(found, [matches], rig, known)
        best = capture.likeliest
        try:
            ratio = shutter_found(capture, rig).readout_ratio
            yield number, "told", ratio, 0.0 if best is None else best.sigma
        except NoMotionError:
            alone = best is not None and best.probability >= CERTAIN
            ratio, sigma = (best.ratio, best.sigma) if alone and best is not None else (0.0, 0.0)
            yield number, "cannot tell" if alone else "states none", ratio, sigma


def _tell(given: argparse.Namespace) -> None:
    """A line a pair, and the counts."""
    counts = {"told": 0, "told wrong": 0, "cannot tell": 0, "0 beyond two deviations": 0, "states none": 0}
    for folder in given.folders:
        for number, word, ratio, sigma in stated(folder, (given.left, given.right), given.every):
            counts[word] += 1
            counts["told wrong"] += word == "told" and ratio > 0.0
            counts["0 beyond two deviations"] += word == "cannot tell" and ratio > 2.0 * sigma
            number_words = "" if word == "states none" else f" {ratio:.3f} +- {sigma:.3f}"
            sys.stdout.write(f"{folder.name} {number}: {word}{number_words}\n")
            sys.stdout.flush()
    sys.stdout.write(", ".join(f"{name} {count}" for name, count in counts.items()) + "\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--left", default="image_0")
    parser.add_argument("--right", default="image_1")
    parser.add_argument("--every", type=step, default=1, help="ask every n-th pair")
    given = parser.parse_args()
    try:
        _tell(given)
    except RsbenchError as error:
        sys.stderr.write(f"kitti_pairs: error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
