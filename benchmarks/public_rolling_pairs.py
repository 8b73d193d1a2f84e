"""Scores of corrections with one camera on twelve published pairs, and how rows of a real rig agree.

The frames of one camera are those in ``demo/`` of github.com/ethliup/DeepUnrollNet (Liu, Cui, Larsson, Pollefeys,
Deep Shutter Unrolling Network, CVPR 2020): six pairs of Carla-RS (640 x 448, rendered, a field of view of 90
degrees) and six of Fastec-RS (640 x 480, rows of the frames of a high-speed camera of unknown focal length; 768 px
are assumed). They are not ours to pass on: give the folder.

    git clone https://github.com/ethliup/DeepUnrollNet
    python benchmarks/public_rolling_pairs.py DeepUnrollNet/demo

A pair is rs_0.png, rs_1.png and gs_1.png, the truth of the second frame at the time of its middle row: row 224 of
Carla-RS and rows 240 and 241 of Fastec-RS, two of which are read at once, are equal in both. The repository has no
masks for these pairs. ``covered`` are therefore, for every method alike, the pixels that the second frame shows
when its optical flow moves it to that time.

``flow`` is optical flow (DIS) scaled by the times of the rows; what it leaves empty is black in ``flow, black``
and invented from its surroundings in ``flow``. PSNR in dB over all channels, the mean of the pairs' values.

The frames of a rig are previews of WHUVID (Chen et al., Remote Sensing 14(9) 2033, 2022), of a ZED 2 on a car,
side by side, with the calibration of its authors (Kalibr):

    git clone https://github.com/SleepEarlyLiveLong/WHUVID
    python benchmarks/public_rolling_pairs.py WHUVID

A preview has about every seventh or eighth frame, as the sizes of the published sequences say, so that its readout
ratio is 18.4 ms (Stereolabs) over as many times 33.3 ms. Row differences are medians, px of the preview, of all
left-right matches in ideal pixels, under the calibration as it is, and under the rig that the tracks show
(``refine_rig``); disparities of far points tell whether the cameras converge as they should, for none is below 0.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.capture.rig_calibration import prior_of, refine_rig, rotation_of_rows
from rsbench.components.cards import parse_card
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.rig import SIDES, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.interop.readers.calibration_parts import Assumptions, resized
from rsbench.interop.readers.calibrations import read_calibration
from rsbench.pipeline.footage import FrameSource, RigCard, read_frame
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import find_matches_of_rig
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
PREVIEWS = {"032": (7, (80, 130, 134, 150, 160)), "020": (8, (52, 164, 216, 308, 366))}
"""Of WHUVID: frames of the camera per frame of the preview, about, and first frames of windows."""
READOUT = 18.4 / 33.3
CALIBRATION = "Calibration/camchain-imucam-homechandrakalibr_workspacemyCalibrate.yaml"
MOST_ROWS = 0.3
"""px, of the median row difference under the rig as found."""
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


def windows_of(preview: Path, firsts: tuple[int, ...]) -> list[dict[View, Image]]:
    """Two frames of both cameras from each of the given ones on, of a video with both side by side."""
    wanted = {number for first in firsts for number in (first, first + 1)}
    frames = {number: frame for number, frame in enumerate(FrameSource(preview)) if number in wanted}
    half = next(iter(frames.values())).shape[1] // 2
    halves = dict(zip(SIDES, (slice(None, half), slice(half, None)), strict=True))
    return [
        {(side, k): frames[first + k][:, halves[side]].copy() for side in SIDES for k in (0, 1)}
        for first in firsts
    ]


def rows_and_far(windows: list[Correspondences], rig: StereoRig) -> str:
    """Median row difference, px, and the 5 and 25 % quantiles of the disparities of matches within 2 rows."""
    stereo = np.concatenate([without_lens(each, rig).stereo_0 for each in windows])
    rows = np.abs(stereo[:, 1] - stereo[:, 3])
    near = rows < 2.0
    low, quarter = np.percentile((stereo[:, 0] - stereo[:, 2])[near], (5, 25))
    return f"rows {np.median(rows):.3f} px, disparities {low:+.2f} {quarter:+.2f}"


def show_rig(whuvid: Path, name: str) -> bool:
    """Print what matches of a preview say of the calibration; whether its rows agree after it was corrected."""
    step, firsts = PREVIEWS[name]
    windows = windows_of(whuvid / "previews" / f"{name}.mp4", firsts)
    height, width = windows[0]["left", 0].shape[:2]
    calibration = resized(read_calibration(whuvid / CALIBRATION, Assumptions()), (width, height))
    rig = parse_card(RigCard, calibration.tables(), CALIBRATION).rig((width, height))
    options = CorrectionOptions()
    anywhere = replace(options.features.component, row_tolerance=None)  # type: ignore[type-var]
    options = replace(options, features=replace(options.features, component=anywhere))
    matches = [find_matches_of_rig(images, rig, Scanning(), options) for images in windows]
    counts = ", ".join(f"{len(each.stereo_0)} / {len(each.tracks)}" for each in matches)
    _say(f"WHUVID {name}: {width} x {height}, windows {firsts}: matches / tracks {counts}")
    _say(f"  as published: {rows_and_far(matches, rig)}")
    ideal = [without_lens(each, rig) for each in matches]
    rows = rotation_of_rows(np.concatenate([each.stereo_0 for each in ideal]), rig)
    if rows is None:
        _say("  too few matches agree on a rotation")
        return False
    shutter = rig.shutter_of(Scanning(), READOUT / step)
    found = refine_rig(matches, rig, shutter, rows[0], prior_of(rows[0]))
    if found is None:
        _say("  no motion explains the tracks")
        return False
    _say(f"  as found: {rows_and_far(matches, found.rig)}; {found.words}; {found.tracks} tracks")
    differences = [np.abs(np.diff(without_lens(each, found.rig).stereo_0[:, [3, 1]])) for each in matches]
    return all(float(np.median(each)) < MOST_ROWS for each in differences)


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Print the table; 1 where a pair is worse than what the corrector promises."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="folder that holds Carla/seq_01 and so on, or that of WHUVID")
    parser.add_argument("--untold", action="store_true", help="do not tell the focal length")
    arguments = parser.parse_args()
    if (arguments.demo / CALIBRATION).is_file():
        return 0 if all([show_rig(arguments.demo, name) for name in PREVIEWS]) else 1
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
