"""What the chain of frames and videos costs, in units of OpenCV's SIFT of four frames and SGBM of two pairs.

Processor seconds of all threads, each row next to the anchor in the same run, so that other programs on the
machine change the quotients little. ``frames/s`` are of a machine whose anchor takes ``SECONDS`` by two threads,
if a frame keeps both cores as busy as the anchor does. Videos are of ``phone_video.py``'s room, without noise, of
a rig and of one of its cameras; PSNR (dB) is of left frames against the truth at their middle row.

    python benchmarks/chain_speed.py --data data/paper
    python benchmarks/chain_speed.py --data data/paper --only rig --profile
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy loads

import correct_chain
import cv2
import numpy as np
from numpy.typing import NDArray
from phone_video import FOV_DEG, FPS, RATIO, Hand, psnr, texture, view

from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import FRAMES, SIDES, VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.footage import FrameSource
from rsbench.pipeline.frame_capture import KnownCapture, find_matches
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.mono_sequence import options_of_camera
from rsbench.pipeline.sequence_correction import correct_sequence
from rsbench.vision.dense_matcher import forget_matches
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.fusion import finished

ROOT = Path(__file__).parents[1]
SECONDS, CORES = 1.5, 2
"""Of the anchor on the machine that limits in frames/s are for, and its cores."""
BASELINE_M = 0.2
KEPT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
"""Environment of commands: Python keeps what it compiled, as it does by default."""
DENSE = CorrectionOptions(features=load_features("dense"), motion_model="auto")
STEPS = (
    ("match", "rsbench.pipeline.sequence_correction", "match_frames"),
    ("depth", "rsbench.pipeline.sequence_correction", "frame_pair"),
    ("depth of motion", "rsbench.pipeline.sequence_correction", "find_depth"),
    ("correct", "rsbench.pipeline.sequence_correction", "correct_known_rows"),
    ("look and motion", "rsbench.pipeline.mono_sequence", "_analyse"),
    ("motion and depth", "rsbench.pipeline.mono_sequence", "_ready"),
    ("draw", "rsbench.pipeline.mono_sequence", "_corrected"),
)
"""Of videos, by the functions that do them; one camera's begin at the fifth."""


@dataclass(frozen=True, kw_only=True)
class Limit:
    """What issue 53 allows: a quotient, or frames/s."""

    most: float = 0.0
    frames_s: float = 0.0

    def words(self, quotient: float) -> str:
        if self.frames_s:
            return f"{quotient:7.2f}  {1.0 / (quotient * SECONDS):6.2f} frames/s (limit {self.frames_s:g})"
        return f"{quotient:7.2f}  (limit {self.most:g})"


class Beside:
    """Frames of the room as seen from the right of a hand."""

    def __init__(self, hand: Hand) -> None:
        self._hand = hand

    def at(self, seconds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        R, c = self._hand.at(seconds)
        return R, c + BASELINE_M * R[:, :, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class Video:
    """Of the room, in memory; frames of both sides, and what the left ones should become."""

    left: list[NDArray[np.uint8]]
    right: list[NDArray[np.uint8]]
    truth: list[NDArray[np.uint8]]
    camera: PinholeCamera

    @property
    def shutter(self) -> RollingShutter:
        return RollingShutter(height=self.camera.height, readout_ratio=RATIO)


def video(width: int, height: int, frames: int, seed: int = 5, *, rig: bool) -> Video:
    walls, hand = [texture(seed + k) for k in range(6)], Hand(seed)
    rows, size = np.arange(height) / height, (width, height)
    left, right, truth = list[Any](), list[Any](), list[Any]()
    for number in range(frames):
        times = (number + RATIO * rows) / FPS
        left.append(view(size, hand, times, walls))
        if rig:
            right.append(view(size, Beside(hand), times, walls))
        middle = (number + RATIO * 0.5 * (height - 1) / height) / FPS
        truth.append(view(size, hand, np.full(height, middle), walls))
    camera = PinholeCamera.centred(width, height, 0.5 * width / np.tan(np.deg2rad(0.5 * FOV_DEG)))
    return Video(left=left, right=right, truth=truth, camera=camera)


def spent(work: Callable[[], Any]) -> float:
    """Processor seconds with those of children."""
    began = time.process_time() + sum(os.times()[2:4])
    work()
    return time.process_time() + sum(os.times()[2:4]) - began


class Tally:
    """Processor seconds of functions that run one at a time."""

    def __init__(self) -> None:
        self.seconds = dict[str, float]()

    def around(self, name: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*words: Any, **named: Any) -> Any:
            began = time.process_time()
            try:
                return work(*words, **named)
            finally:
                self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - began

        return timed


def one_at_a_time(work: Callable[[], Any]) -> dict[str, float]:
    """Processor seconds of each of ``STEPS``, of a correction without threads beside each other."""
    tally, patches = Tally(), list[Any]()
    for name, module, function in STEPS:
        there = sys.modules[module]
        patches.append(patch.object(there, function, tally.around(name, getattr(there, function))))
    for module in ("rsbench.pipeline.sequence_correction", "rsbench.pipeline.mono_sequence"):
        there = sys.modules[module]
        patches.append(patch.object(there, "map_ahead", lambda work, items, *_: map(work, items)))
        if hasattr(there, "ahead"):
            patches.append(patch.object(there, "ahead", lambda items, _: items))
    for each in patches:
        each.start()
    try:
        tally.seconds["all"] = spent(work)
    finally:
        for each in patches:
            each.stop()
    return tally.seconds


def of_rig(shown: Video, options: CorrectionOptions) -> Callable[[], list[NDArray[np.uint8]]]:
    row = (shown.camera.height - 1) / 2
    known = KnownCapture(rig=StereoRig(camera=shown.camera, baseline=BASELINE_M), shutter=shown.shutter)

    def work() -> list[NDArray[np.uint8]]:
        forget_matches()
        with tempfile.TemporaryDirectory() as place:
            sources = [stored(Path(place) / side, getattr(shown, side)) for side in ("left", "right")]
            moments = correct_sequence(sources, known, replace(options, target_row=row))
            return [finished(each.shown["left"]).image for each in moments]

    return work


def of_camera(shown: Video) -> Callable[[], list[NDArray[np.uint8]]]:
    known = KnownCapture(rig=StereoRig.of_one(shown.camera), shutter=shown.shutter)
    options = options_of_camera(None, 0, (shown.camera.height - 1) / 2)

    def work() -> list[NDArray[np.uint8]]:
        with tempfile.TemporaryDirectory() as place:
            moments = correct_sequence([stored(Path(place), shown.left)], known, options)
            return [finished(each.shown["left"]).image for each in moments]

    return work


def stored(folder: Path, frames: list[NDArray[np.uint8]]) -> FrameSource:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{number:04d}.png" for number in range(len(frames))]
    for file, image in zip(files, frames, strict=True):
        cv2.imwrite(str(file), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return FrameSource.of_files(files)


def command(sequence: Sequence, name: str, folder: Path) -> Callable[[], object]:
    """``correct`` or ``inspect`` of four frames."""
    rig, camera = folder / "rig.toml", sequence.rig.camera
    inner = f"{{fx = {camera.fx}, fy = {camera.fy}, cx = {camera.cx}, cy = {camera.cy}}}"
    ratio = sequence.shutter.readout_ratio
    rig.write_text(f"baseline = {sequence.rig.baseline}\nreadout_ratio = {ratio}\ncamera = {inner}\n", "utf-8")
    frames = [str(sequence.folder / "rs" / f"{side}_{frame}.png") for frame in FRAMES for side in SIDES]
    words = [sys.executable, "-m", "rsbench", "--quiet", name, *frames, "--rig", str(rig)]
    words += ["--out", str(folder / "out")] if name == "correct" else []
    return lambda: subprocess.run(words, stdout=subprocess.DEVNULL, check=name == "correct", env=KEPT)


def command_of_video(shown: Video, folder: Path) -> Callable[[], object]:
    """``correct`` of a video of one camera."""
    file = folder / "video.mp4"
    height, width = shown.left[0].shape[:2]
    out = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (width, height))
    for image in shown.left:
        out.write(image[..., ::-1])
    out.release()
    words = [
        sys.executable,
        "-m",
        "rsbench",
        "--quiet",
        "correct",
        str(file),
        "--out",
        str(folder / "out.mp4"),
    ]
    return lambda: subprocess.run(words, stdout=subprocess.DEVNULL, check=True, env=KEPT)


def matched(sequence: Sequence) -> Callable[[], None]:
    images = {each: sequence.image("rs", *each) for each in VIEWS}

    def work() -> None:
        forget_matches()
        find_matches(images, DENSE)

    return work


def rows(
    sequence: Sequence, folder: Path, frames: int
) -> Iterator[tuple[str, Limit, Callable[[], tuple[Any, ...]]]]:
    """Name, limit, and what makes the work, how many times it does its unit, and the video it is of."""
    chain = lambda: correct_chain.run(sequence, DENSE)  # noqa: E731
    yield "four frames 900 x 900: chain", Limit(most=2.0), lambda: (chain, 1, None)
    yield "four frames: command", Limit(most=3.5), lambda: (command(sequence, "correct", folder), 1, None)
    yield "four frames: matching", Limit(most=1.0), lambda: (matched(sequence), 1, None)
    yield "four frames: inspect", Limit(most=1.5), lambda: (command(sequence, "inspect", folder), 1, None)

    def rig() -> tuple[Any, ...]:
        shown = video(640, 480, frames, rig=True)
        return of_rig(shown, DENSE), frames, shown

    def camera(width: int, height: int, count: int) -> Callable[[], tuple[Any, ...]]:
        def prepare() -> tuple[Any, ...]:
            shown = video(width, height, count, rig=False)
            return of_camera(shown), count, shown

        return prepare

    def started() -> tuple[Any, ...]:
        return command_of_video(video(1920, 1080, 8, rig=False), folder), 8, None

    yield "rig's video 640 x 480", Limit(frames_s=3.0), rig
    yield "one camera's video 640 x 480", Limit(frames_s=5.0), camera(640, 480, frames)
    yield "one camera's video 1920 x 1080", Limit(frames_s=2.0), camera(1920, 1080, max(frames // 2, 4))
    yield "command, one camera 1920 x 1080, nothing known", Limit(frames_s=1.0), started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/paper"), help="dataset; rendered when missing")
    parser.add_argument("--only", default="", help="rows in whose name this is")
    parser.add_argument("--runs", type=int, default=1, help="of each row; the median counts (default 1)")
    parser.add_argument("--frames", type=int, default=10, help="of a video (default 10)")
    parser.add_argument("--steps", action="store_true", help="seconds of a video by step, one step at a time")
    parser.add_argument("--profile", action="store_true", help="the functions that take longest")
    given = parser.parse_args()
    if not (given.data / "dataset.json").is_file():
        from rsbench.cli.generate import generate

        generate("paper", str(given.data), None, workers=1)
    sequence = next(one for one in read_dataset(given.data) if one.name == "castle")
    anchor, write = correct_chain.opencv_alone(sequence), sys.stdout.write
    cv2.setNumThreads(CORES)
    anchor()
    with tempfile.TemporaryDirectory() as place:
        for name, limit, prepare in rows(sequence, Path(place), given.frames):
            if given.only not in name:
                continue
            work, count, shown = prepare()
            work()  # compiles
            quotients, frames = list[float](), list[Any]()
            for _ in range(given.runs):
                ours = spent(lambda: frames.append(work()))  # noqa: B023
                quotients.append(ours / count / spent(anchor))
            write(f"{name:48}{limit.words(float(np.median(quotients)))}")
            if shown is not None:
                scores = [psnr(a, b) for a, b in zip(frames[0], shown.truth, strict=True)]
                write(f"  PSNR {np.mean(scores):.2f}, worst {np.min(scores):.2f}")
            write("\n")
            if given.steps and shown is not None:
                unit = spent(anchor) * count
                for step, seconds in one_at_a_time(work).items():
                    write(f"    {step:20}{seconds / unit:7.3f}\n")
            sys.stdout.flush()
            if given.profile:
                profile = cProfile.Profile(time.process_time)
                profile.runcall(work)
                pstats.Stats(profile, stream=sys.stdout).sort_stats("cumtime").print_stats(70)


if __name__ == "__main__":
    main()
