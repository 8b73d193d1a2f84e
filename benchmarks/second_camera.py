"""What a second camera is worth: one camera's correction beside a rig's, on the sequences of a dataset.

Frame 1 of the left camera at the time of its middle row (``twins = ["middle"]``, as cards laws and standard have),
by ``mono-fusion`` from the left frames alone and by ``fusion`` from all four, both as the command does by default.
PSNR in dB over the pixels that the frame saw and whose parallax between its rows and the frame before is more than
2 px, by the true depth and motion.

    rsbench generate laws --out data/laws
    python benchmarks/second_camera.py --data data/laws --only ideal
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.images.score import visible_pixels
from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import row_poses
from rsbench.core.rig import FRAMES, VIEWS
from rsbench.dataset.sequence import Sequence, read_pairs
from rsbench.pipeline.arrays import of_rig, options_of
from rsbench.pipeline.mono_correction import find_own_motion, refusal
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.mono_fusion import MonoFusion, find_flows
from rsbench.vision.reprojection import reproject_pixels, reprojection_of

_VIEW = ("left", 1)
_PARALLAX_PX, _WITHIN_DB = 2.0, 1.5


def parallax(sequence: Sequence) -> NDArray[np.float32]:
    """(H, W) px by which the depth of a pixel moves it in the frame before; infinite where unseen."""
    poses = [row_poses(sequence.rig, sequence.shutter, sequence.motion, "left", frame) for frame in FRAMES]
    maps, z = reprojection_of(sequence.rig.camera, poses[1], poses[0]), sequence.depth("rs", *_VIEW)
    rho = np.where(z > 0.0, np.float32(1.0) / np.maximum(z, np.float32(1e-6)), np.float32(0.0))
    lines = np.indices(rho.shape, dtype=np.int32)[0]
    near, far = (reproject_pixels(maps, each, lines.copy())[0] for each in (rho, np.zeros_like(rho)))
    return np.asarray(np.nan_to_num(np.linalg.norm(near - far, axis=-1), nan=np.inf))


def scores(sequence: Sequence) -> tuple[float, float, float]:
    """PSNR uncorrected, by ``mono-fusion``, and by ``fusion``; NaN where that refuses the frames."""
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    row = sequence.rig.camera.height // 2
    truth = sequence.image("gs", *_VIEW, row)
    seen = visible_pixels(sequence, true_pairs(sequence, images), (_VIEW,), float(row))[_VIEW]
    counted = seen & (parallax(sequence) > _PARALLAX_PX)

    def psnr(image: NDArray[np.uint8]) -> float:
        error = (image[counted].astype(np.float64) - truth[counted]) ** 2
        return float(10.0 * np.log10(255.0**2 / np.mean(error)))

    own = [images["left", frame] for frame in FRAMES]
    flows, alone = find_flows(own), float("nan")
    if not refusal(own, flows):
        own_motion = find_own_motion(flows, sequence.rig, sequence.shutter, "left", RobustOptions()).own
        tau = float(sequence.shutter.time_after(float(row), 1, "left"))
        alone = psnr(MonoFusion(own, own_motion, flows).corrected(1, tau).image)
    options = options_of("rs-stereo-refined", "auto", "sgm", "sift-refined", "fusion", target_row=float(row))
    four = [images[view] for view in (("left", 0), ("right", 0), ("left", 1), ("right", 1))]
    try:
        found = of_rig(four, sequence.rig, KnownInputs.of(sequence.shutter), options, close=True)
        together = psnr(found.frames[_VIEW].image)
    except RsbenchError:
        together = float("nan")
    return psnr(own[1]), alone, together


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--only", default="", help="sequences in whose name this is")
    given = parser.parse_args()
    rows = []
    try:
        chosen = [sequence for sequence in read_pairs(given.data) if given.only in sequence.name]
    except RsbenchError as error:
        parser.error(str(error))
    if not chosen:
        parser.error(f"--only {given.only!r}: is in no sequence's name")
    for sequence in chosen:
        rows.append((sequence.motion.name, *scores(sequence)))
        sys.stdout.write(f"{sequence.name:44} " + "  ".join(f"{each:5.2f}" for each in rows[-1][1:]) + "\n")
        sys.stdout.flush()
    sys.stdout.write(
        "law, sequences, refused by one or the other; uncorrected, one camera, rig; median and mean gap\n"
    )
    for law in dict.fromkeys(name for name, *_ in rows):
        table = np.array([values for name, *values in rows if name == law])
        both = table[np.isfinite(table).all(axis=1)]
        gap = both[:, 2] - both[:, 1]
        mean = "  ".join(f"{each:.2f}" for each in both.mean(axis=0))
        share = f"within {_WITHIN_DB} dB: {np.mean(gap <= _WITHIN_DB):.0%}"
        sys.stdout.write(
            f"{law:12} {len(table):4} {len(table) - len(both):3}  {mean}  "
            f"{np.median(gap):.2f} {np.mean(gap):.2f}, {share}\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
