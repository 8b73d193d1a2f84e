"""Scores of corrections with one camera on twelve published pairs with ground truth.

The frames are those in ``demo/`` of github.com/ethliup/DeepUnrollNet (Liu, Cui, Larsson, Pollefeys, Deep Shutter
Unrolling Network, CVPR 2020): six pairs of Carla-RS (640 x 448, rendered, a field of view of 90 degrees) and six
of Fastec-RS (640 x 480, rows of the frames of a high-speed camera of unknown focal length; 768 px are assumed).
They are not ours to pass on: give the folder.

    git clone https://github.com/ethliup/DeepUnrollNet
    python benchmarks/public_rolling_pairs.py DeepUnrollNet/demo

A pair is rs_0.png, rs_1.png and gs_1.png, the truth of the second frame at the time of its middle row: row 224 of
Carla-RS and rows 240 and 241 of Fastec-RS, two of which are read at once, are equal in both. The repository has no
masks for these pairs. ``covered`` are therefore, for every method alike, the pixels that the second frame shows
when its optical flow moves it to that time.

``flow`` is optical flow (DIS) scaled by the times of the rows; what it leaves empty is black in ``flow, black``
and invented from its surroundings in ``flow``. PSNR in dB over all channels, the mean of the pairs' values.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.footage import read_frame
from rsbench.pipeline.mono_camera import OneCameraCard, find_camera
from rsbench.pipeline.mono_correction import find_own_motion
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.fusion import Origin, inpaint
from rsbench.vision.mono_fusion import MonoFusion, MonoFusionOptions, OwnMotion, find_flows

SETS = {"Carla": 320.0, "Fastec": 768.0}
"""Focal length, px."""
METHODS = ("uncorrected", "flow, black", "flow", "mono-fusion")
WORST_LOSS = 0.3
"""dB that a pair may lose against scaled flow."""
Image = NDArray[Any]
Scores = dict[str, tuple[float, float]]


def psnr(estimate: Image, truth: Image, mask: NDArray[np.bool_] | None = None) -> float:
    """dB of 8-bit images (H, W, 3), over a mask (H, W) or all pixels."""
    error = (estimate.astype(np.float64) - truth) ** 2
    return float(10.0 * np.log10(255.0**2 / np.mean(error if mask is None else error[mask])))


def score_pair(folder: Path, focal: float | None) -> tuple[Scores, float]:
    """PSNR of all pixels and of covered ones by method, and seconds of ours.

    ``focal``: px; None: as the command finds it, or assumes it.
    """
    images = [read_frame(folder / f"{name}.png") for name in ("rs_0", "rs_1", "gs_1")]
    first, second, truth = (image[..., :3] for image in images)
    height, width = truth.shape[:2]
    shutter, target = RollingShutter(height=height, readout_ratio=1.0), 1.5
    started = time.perf_counter()
    card = OneCameraCard(readout_ratio=1.0)
    if focal is None:
        camera = find_camera([first, second], 2, card, shutter, RobustOptions())[0]
    else:
        camera = PinholeCamera.centred(width, height, focal)
    rig = StereoRig(camera=camera, baseline=1.0)
    flows = find_flows([first, second])
    found = find_own_motion(flows, rig, shutter, "left", RobustOptions())
    ours = MonoFusion([first, second], found.own, flows).corrected(1, target)
    seconds = time.perf_counter() - started
    bare = MonoFusionOptions(fill=False, inpaint=False)
    still = OwnMotion(rig=found.own.rig, shutter=shutter, side="left", motion=None)
    flowed = MonoFusion([first, second], still, flows, bare).corrected(1, target)
    covered = flowed.origin != Origin.NOBODY
    estimates = (second, flowed.image, inpaint(flowed.image, ~covered), ours.image)
    scores = {
        method: (psnr(estimate, truth), psnr(estimate, truth, covered))
        for method, estimate in zip(METHODS, estimates, strict=True)
    }
    return scores, seconds


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Print the table; 1 where a pair is worse than what the corrector promises."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="folder that holds Carla/seq_01 and so on")
    parser.add_argument("--untold", action="store_true", help="do not tell the focal length")
    arguments = parser.parse_args()
    good = True
    for name, focal in SETS.items():
        pairs = {}
        for folder in sorted((arguments.demo / name).iterdir()):
            pairs[folder.name], seconds = score_pair(folder, None if arguments.untold else focal)
            values = "  ".join("{:5.2f} / {:5.2f}".format(*pairs[folder.name][each]) for each in METHODS)
            _say(f"{name:7}{folder.name:8}{values}  {seconds:.2f} s")
            scores = pairs[folder.name]
            good &= scores["mono-fusion"][0] > max(scores["flow"][0] - WORST_LOSS, scores["uncorrected"][0])
        means = [np.mean([scores[each] for scores in pairs.values()], axis=0) for each in METHODS]
        _say(f"{name:7}{'mean':8}" + "  ".join(f"{a:5.2f} / {b:5.2f}" for a, b in means))
    _say(f"columns: {', '.join(METHODS)}; all pixels / covered ones, dB")
    return 0 if good else 1


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main())
