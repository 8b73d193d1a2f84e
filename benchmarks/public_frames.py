"""Scores of corrections with one camera on published frames, and how rows of a real rig agree.

The frames of one camera are pairs in ``demo/`` of repositories of learned correctors: of Carla-RS (rendered, a
field of view of 90 degrees) and Fastec-RS (rows of the frames of a high-speed camera; 768 px are assumed as its
focal length), Liu, Cui, Larsson, Pollefeys, Deep Shutter Unrolling Network, CVPR 2020, both read in the whole
period; and of BS-RSC, real rolling shutter beside real global shutter, Cao, Zhong, Wang, Zheng, Learning Adaptive
Warping for Real-World Rolling Shutter Correction, CVPR 2022, read in 0.45 of the period, of unknown focal length.
They are not ours to pass on: give the folder that holds them.

    git clone https://github.com/ethliup/DeepUnrollNet    # twelve pairs, on which constants were chosen
    git clone https://github.com/GitCVfb/RSSR             # and CVR, LBCNet of the same author
    python benchmarks/public_frames.py FOLDER

A pair is rs_0.png, rs_1.png and a truth of one of them or both at the time of its middle row: gs_1.png or
gs_1_m.png of the second, gs_0_m.png of the first. Pairs with equal frames count once, and one image for both
truths is none of either (Fastec-RS in LBCNet). There are no masks that all of these have. ``covered`` are
therefore, for every method alike, the pixels that the corrected frame shows when its optical flow moves it to
that time.

``flow`` is optical flow (DIS) scaled by the times of the rows; what it leaves empty is black in ``flow, black``
and invented from its surroundings in ``flow``. PSNR in dB over all channels, the mean of the frames' values. The
methods that the repositories publish are trained on frames of these data, and report their own test sets, which
are larger: their figures are not comparable with these.

The frames of a rig are previews of WHUVID (Chen et al., Remote Sensing 14(9) 2033, 2022), of a ZED 2 on a car,
side by side, with the calibration of its authors (Kalibr):

    git clone https://github.com/SleepEarlyLiveLong/WHUVID
    python benchmarks/public_frames.py WHUVID

A preview has about every seventh or eighth frame, as the sizes of the published sequences say, so that its
readout ratio is 18.4 ms (Stereolabs) over as many times 33.3 ms. Row differences are medians, px of the preview,
of all left-right matches in ideal pixels, under the calibration as it is, and under the rig that the tracks show
(``refine_rig``); disparities of far points tell whether the cameras converge as they should, for none is below 0.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

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
from rsbench.pipeline.camera_capture import find_focal
from rsbench.pipeline.footage import FrameSource, OneCameraCard, RigCard, read_frame
from rsbench.pipeline.frame_capture import KnownCapture, find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.mono_correction import find_own_motion
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.fusion import Origin, inpaint
from rsbench.vision.mono_fusion import MonoFusion, MonoFusionOptions, OwnMotion, find_flows


class FrameSet(NamedTuple):
    """Frames of one kind of camera."""

    name: str
    """Of the folder that holds the pairs."""
    readout_ratio: float
    focal: float | None
    """px; None: found."""


SETS = (FrameSet("Carla", 1.0, 320.0), FrameSet("Fastec", 1.0, 768.0), FrameSet("BSRSC", 0.45, None))
TRUTHS = {0: ("gs_0_m.png",), 1: ("gs_1.png", "gs_1_m.png")}
"""Global-shutter images of both frames at the time of their middle rows, the first that there is."""
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


def pairs_in(folder: Path) -> Iterator[tuple[FrameSet, Path]]:
    """Pairs below a folder by set, each once: of the copies in several repositories, the one with most truths."""
    for each in SETS:
        found = dict[bytes, Path]()
        for first in sorted(folder.glob(f"**/{each.name}/*/rs_0.png")):
            pair = first.parent
            digest = hashlib.sha256(first.read_bytes() + (pair / "rs_1.png").read_bytes()).digest()
            truths = [path.read_bytes() for path in truths_of(pair).values()]
            if len(set(truths)) == len(truths) > len(truths_of(found[digest]) if digest in found else ()):
                found[digest] = pair
        yield from ((each, pair) for pair in found.values())


def truths_of(pair: Path) -> dict[int, Path]:
    """The truth of each frame that has one."""
    found = {frame: [pair / name for name in names if (pair / name).is_file()] for frame, names in TRUTHS.items()}
    return {frame: paths[0] for frame, paths in found.items() if paths}


def score_pair(folder: Path, of: FrameSet) -> tuple[dict[int, Scores], str, float]:
    """PSNR of all pixels and of covered ones by frame and method, the law of motion, and seconds of ours."""
    images = [read_frame(folder / f"rs_{frame}.png")[..., :3] for frame in (0, 1)]
    height, width = images[0].shape[:2]
    shutter = RollingShutter(height=height, readout_ratio=of.readout_ratio)
    started = time.perf_counter()
    if of.focal is None:
        card = OneCameraCard(readout_ratio=of.readout_ratio)
        known = KnownCapture(rig=StereoRig.of_one(card.camera_of(width, height)), shutter=shutter)
        camera = find_focal(images, 2, card, known, RobustOptions()).rig.camera
    else:
        camera = PinholeCamera.centred(width, height, of.focal)
    rig = StereoRig(camera=camera, baseline=1.0)
    flows = find_flows(images)
    found = find_own_motion(flows, rig, shutter, "left", RobustOptions())
    fusion = MonoFusion(images, found.own, flows)
    truths = {frame: read_frame(path)[..., :3] for frame, path in truths_of(folder).items()}
    times = {frame: float(shutter.pixel_time(np.array([0.0, height // 2]), frame, "left")) for frame in truths}
    ours = {frame: fusion.corrected(frame, times[frame]) for frame in truths}
    seconds = time.perf_counter() - started
    bare = MonoFusionOptions(fill=False, inpaint=False)
    still = OwnMotion(rig=found.own.rig, shutter=shutter, side="left", motion=None)
    by_flow, scores = MonoFusion(images, still, flows, bare), {}
    for frame, truth in truths.items():
        flowed = by_flow.corrected(frame, times[frame])
        covered = flowed.origin != Origin.NOBODY
        estimates = (images[frame], flowed.image, inpaint(flowed.image, ~covered), ours[frame].image)
        scores[frame] = {
            method: (psnr(estimate, truth), psnr(estimate, truth, covered))
            for method, estimate in zip(METHODS, estimates, strict=True)
        }
    return scores, "flow alone" if found.own.motion is None else type(found.own.motion).__name__, seconds


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
    parser.add_argument("folder", type=Path, help="folder that holds repositories, or the repository WHUVID")
    parser.add_argument("--unknown-focal", action="store_true", help="do not give the focal length")
    parser.add_argument("--only", default="", help="pairs whose path has this word")
    arguments = parser.parse_args()
    if (arguments.folder / CALIBRATION).is_file():
        return 0 if all([show_rig(arguments.folder, name) for name in PREVIEWS]) else 1
    good, table = True, dict[str, list[Scores]]()
    _say(f"columns: {', '.join(METHODS)}; all pixels / covered ones, dB; law of motion")
    for of, pair in pairs_in(arguments.folder):
        if arguments.only not in pair.as_posix():
            continue
        found, law, seconds = score_pair(pair, of._replace(focal=None) if arguments.unknown_focal else of)
        for frame, scores in found.items():
            values = "  ".join("{:5.2f} / {:5.2f}".format(*scores[each]) for each in METHODS)
            lost = scores["mono-fusion"][0] < max(scores["flow"][0] - WORST_LOSS, scores["uncorrected"][0])
            name = f"{pair.relative_to(arguments.folder).as_posix()} {frame}"
            _say(f"{name:44}{values}  {law:17} {seconds:6.1f} s{'  LOSES' if lost else ''}")
            good &= not lost
            table.setdefault(of.name, []).append(scores)
    for name, rows in table.items():
        means = [np.mean([scores[each] for scores in rows], axis=0) for each in METHODS]
        _say(f"{name + ', mean of ' + str(len(rows)):44}" + "  ".join(f"{a:5.2f} / {b:5.2f}" for a, b in means))
    return 0 if good else 1


if __name__ == "__main__":
    cv2.setNumThreads(1)
    sys.exit(main())
