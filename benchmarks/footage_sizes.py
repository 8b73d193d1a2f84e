"""What large frames cost, and at which size their motion and depth are best found.

Four frames of ``phone_video.py``'s room at one size are corrected with a known camera, with the search at a size
of at most so many pixels (``--enough``; default: the product's). Prints CPU seconds of a frame and of a million
pixels, the largest memory, and PSNR against the truth. One size and setting in each process:

    for most in 2097152 99999999; do python benchmarks/footage_sizes.py --width 3840 --enough $most; done
"""

from __future__ import annotations

import argparse
import resource
import sys
import time

import numpy as np
from phone_video import FOV_DEG, FPS, RATIO, Hand, psnr, texture, view

from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.mono_sequence import correct_frames
from rsbench.vision import epipolar_search

FRAMES = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--width", type=int, default=3840)
    parser.add_argument("--enough", type=int, default=epipolar_search._ENOUGH)
    parser.add_argument("--seed", type=int, default=5)
    given = parser.parse_args()
    epipolar_search._ENOUGH = given.enough
    size = width, height = given.width, given.width * 9 // 16
    walls, hand = [texture(given.seed + k, 2048) for k in range(6)], Hand(given.seed)
    rows = np.arange(height) / height
    frames, truths = [], []
    for number in range(FRAMES):
        frames.append(view(size, hand, (number + RATIO * rows) / FPS, walls, 440.0))
        middle = (number + RATIO * 0.5 * (height - 1) / height) / FPS
        truths.append(view(size, hand, np.full(height, middle), walls, 440.0))
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    camera = PinholeCamera.centred(width, height, 0.5 * width / np.tan(np.deg2rad(0.5 * FOV_DEG)))
    shutter = RollingShutter(height=height, readout_ratio=RATIO)
    few, tiny = [each[::8, ::8].copy() for each in frames[:2]], (width // 8, height // 8)
    quarter = RollingShutter(height=tiny[1], readout_ratio=RATIO)
    list(correct_frames(few, PinholeCamera.centred(*tiny, camera.fx / 8), quarter))  # compiles
    start, before = time.process_time(), []
    for each, truth, image in zip(correct_frames(frames, camera, shutter), truths, frames, strict=True):
        before.append((psnr(image, truth), psnr(each.shown["left"].image, truth)))
    spent = (time.process_time() - start) / FRAMES
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = " ".join(f"{a:.2f}->{b:.2f}" for a, b in before)
    sys.stdout.write(
        f"{width} x {height}, search in at most {given.enough} px: {spent:.1f} CPU s a frame, "
        f"{spent / (width * height / 1e6):.2f} a million px; {memory / 1e6:.2f} GB ({base / 1e6:.2f} before); "
        f"dB {found}, mean {np.mean([b for _, b in before]):.2f}\n"
    )


if __name__ == "__main__":
    main()
