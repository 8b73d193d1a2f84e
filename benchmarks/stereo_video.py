"""Frames a second of a rig's video through ``rsbench correct``, and what ``--fast`` costs.

Both runs write all that the command writes, of 100 frames 640 x 480 (``stereo_video.toml``, rendered first). PSNR
in dB of the left frames against the truth at their middle row; "worst" is the largest loss of a frame against the
run without ``--fast``. OpenCV's SIFT of the frames and SGBM of the pairs, by as many threads, are beside it: what
any chain of these parts needs.

    python benchmarks/stereo_video.py --data data/stereo-video
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.storage.files import read_png

CARD = Path(__file__).with_suffix(".toml")
RUNS = {"as it is": (), "--fast": ("--fast",)}


def rsbench(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "rsbench", *map(str, words)], stdout=subprocess.DEVNULL, check=True)


def timed(*words: object) -> tuple[float, float]:
    """Seconds of a command, and of the processor."""
    start, spent = time.monotonic(), sum(os.times()[2:4])
    rsbench(*words)
    return time.monotonic() - start, sum(os.times()[2:4]) - spent


def psnr(out: Path, sequence: Sequence) -> np.ndarray:
    """Of the left frames."""
    row, found = sequence.rig.camera.height // 2, list[float]()
    for frame in range(sequence.frames):
        truth = sequence.image("gs", "left", frame, row).astype(np.float64)
        off = read_png(out / "corrected" / f"left_{frame:06d}.png") - truth
        found.append(float(10.0 * np.log10(255.0**2 / np.mean(off * off))))
    return np.array(found)


def opencv_alone(sequence: Sequence) -> float:
    """Seconds for all frames."""
    sift, total = cv2.SIFT.create(nfeatures=6000), 0.0
    matcher = cv2.StereoSGBM.create(0, 64, 5, 8 * 25, 32 * 25, mode=cv2.StereoSGBM_MODE_SGBM_3WAY)
    for frame in range(sequence.frames):
        both = [cv2.cvtColor(sequence.image("rs", side, frame), cv2.COLOR_RGB2GRAY) for side in SIDES]
        start = time.monotonic()
        for each in both:
            sift.detectAndCompute(each, None)
        matcher.compute(*both)
        total += time.monotonic() - start
    return total


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the dataset")
    given = parser.parse_args()
    rsbench("generate", CARD, "--out", given.data)
    try:
        (sequence,) = read_dataset(given.data)
    except (RsbenchError, ValueError) as error:
        parser.error(f"--data {given.data}: {error}")
    folder, scores = sequence.folder, dict[str, np.ndarray]()
    sys.stdout.write("run       frames/s  processor s  PSNR (dB)  worst\n")
    with tempfile.TemporaryDirectory() as place:
        for name, words in RUNS.items():
            out = Path(place) / name
            seconds, spent = timed("correct", folder, "--out", out, "--target", "middle", *words)
            scores[name] = psnr(out, sequence)
            worst = float(np.max(scores["as it is"] - scores[name]))
            rate, mean = sequence.frames / seconds, scores[name].mean()
            sys.stdout.write(f"{name:9} {rate:8.2f} {spent:12.1f} {mean:10.2f} {worst:6.2f}\n")
            sys.stdout.flush()
    sys.stdout.write(f"OpenCV    {sequence.frames / opencv_alone(sequence):8.2f}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
