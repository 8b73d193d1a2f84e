"""What is gained where things that move by themselves go their own flow, and what that costs where nothing does.

Frame 1 of the left camera at the time of its middle row, by ``fusion`` with and without it, as the command does by
default: PSNR in dB over all pixels, and over those that show a moving thing in the truth.

    rsbench generate benchmarks/moving_things.toml --out DIR
    python benchmarks/moving_things.py --data DIR
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.errors import RsbenchError
from rsbench.dataset.layout import moving_file
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.arrays import of_rig, options_of
from rsbench.vision.correctors import FusionCorrector

_VIEW, _FOUR = ("left", 1), (("left", 0), ("right", 0), ("left", 1), ("right", 1))


def scores(sequence: Sequence) -> list[float]:
    """PSNR as it is, without and with own flow; then the same of what moves, NaN where nothing does."""
    row = sequence.rig.camera.height // 2
    truth, frames = sequence.image("gs", *_VIEW, row), [sequence.image("rs", *view) for view in _FOUR]
    images = [frames[2]]
    options = options_of("rs-stereo-refined", "auto", "sgm", "sift-refined", "fusion", target_row=float(row))
    for moving in (False, True):
        corrector = replace(options.corrector, component=FusionCorrector(moving=moving))
        chosen = replace(options, corrector=corrector)
        found = of_rig(frames, sequence.rig, KnownInputs.of(sequence.shutter), chosen, close=True)
        images.append(found.frames[_VIEW].image)
    everywhere = np.ones(truth.shape[:2], dtype=np.bool_)
    return [_psnr(image, truth, mask) for mask in (everywhere, _things(sequence, row)) for image in images]


def _things(sequence: Sequence, row: int) -> NDArray[np.bool_]:
    """(H, W) what shows a moving thing in the truth."""
    file = sequence.folder / moving_file("gs", *_VIEW, row)
    marked = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) if file.exists() else None
    shape = sequence.rig.camera.height, sequence.rig.camera.width
    return np.zeros(shape, dtype=np.bool_) if marked is None else np.asarray((marked & 127) > 0)


def _psnr(image: NDArray[np.uint8], truth: NDArray[np.uint8], mask: NDArray[np.bool_]) -> float:
    if not np.any(mask):
        return float("nan")
    return float(10.0 * np.log10(255.0**2 / np.mean((image[mask].astype(np.float64) - truth[mask]) ** 2)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", default="", help="sequences in whose name this is")
    given = parser.parse_args()
    try:
        chosen = [
            each
            for each in read_dataset(given.data)
            if given.only in each.name and each.rig.camera.height // 2 in each.twins
        ]
    except RsbenchError as error:
        parser.error(str(error))
    if not chosen:
        parser.error(f"--only {given.only!r}: names no sequence with truth at the middle row (twins)")
    head = " ".join(f"{name:>9}" for name in ("as it is", "still", "moving") * 2)
    sys.stdout.write(f"{'sequence':34} {head}   (all pixels, then what moves)\n")
    rows = dict[str, list[list[float]]]()
    for sequence in chosen:
        try:
            found = scores(sequence)
        except RsbenchError as error:
            sys.stdout.write(f"{sequence.name:34} {error}\n")
            continue
        rows.setdefault("moving" if sequence.moving else "still", []).append(found)
        sys.stdout.write(f"{sequence.name:34} {' '.join(f'{each:9.2f}' for each in found)}\n")
        sys.stdout.flush()
    for name, found in rows.items():
        means = np.mean(found, axis=0)
        sys.stdout.write(f"mean of {len(found)} {name:23} {' '.join(f'{each:9.2f}' for each in means)}\n")
        sys.stdout.write(f"least gain {name:23} {min(each[2] - each[1] for each in found):9.2f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
