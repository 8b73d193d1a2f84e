"""Time of one corrected frame beside one cv2.remap of the same frame, both on one core.

The scene is a slanted wall with a card before it, of the paper's size and motion. Times are CPU times, the best of
several runs, because a busy machine stretches the clock.

    python benchmarks/warp.py --size 900
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable

import cv2
import numpy as np

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.geometry import FixedGeometry
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.vision.correction import correct_frame

BOUND = 6.0
"""Measured: 4.1 to 5.4 with OpenCV 5.0, whose cubic remap is faster than that of 4, on which 4 was the bound."""


def cpu_ms(work: Callable[[], object], repetitions: int) -> float:
    """Best CPU time of ``work``, milliseconds; it runs once more beforehand, to compile and to warm up."""
    work()
    times = []
    for _ in range(repetitions):
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return 1e3 * min(times)


def depth_map(size: int) -> np.ndarray:
    """Depth (size, size), metres, of a wall that leans and a card at 5 m."""
    y, x = np.mgrid[:size, :size] / size
    depth = 8.0 + 3.6 * x + 2.7 * y
    depth[(np.abs(x - 0.45) < 0.11) & (np.abs(y - 0.45) < 0.11)] = 5.0
    return depth.astype(np.float32)


def wall(size: int) -> tuple[np.ndarray, FixedGeometry, np.ndarray]:
    """Depth, moving camera and colours (size, size, 3) float32 of the scene."""
    camera = PinholeCamera.centred(size, size, 1384.6 * size / 900)
    rig = StereoRig(camera=camera, baseline=0.5)
    shutter = RollingShutter(height=size, readout_ratio=0.8)
    w, d = np.deg2rad(0.4) * np.array([0.6, 1.0, -0.5]), 0.3 * np.array([0.6, -0.4, 0.7])
    motion = LinearMotion(w / np.linalg.norm([0.6, 1.0, -0.5]), d / np.linalg.norm([0.6, -0.4, 0.7]))
    colour = np.random.default_rng(0).random((size, size, 3), dtype=np.float32)
    return depth_map(size), FixedGeometry(rig, shutter, motion), colour


def both(size: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """The correction of a float32 frame and the remap of it, warm; for one core."""
    depth, moving, image = wall(size)
    positions = np.nan_to_num(correct_frame(image, depth, moving, ("left", 1)).source_map)

    def remap() -> None:
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        cv2.remap(image, positions, None, cv2.INTER_CUBIC)
        cv2.setNumThreads(threads)

    remap()
    return lambda: correct_frame(image, depth, moving, ("left", 1)), remap


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=900, help="width and height, px (default 900)")
    parser.add_argument("--repetitions", type=int, default=15, help="runs of which the best counts (default 15)")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    depth, moving, colour = wall(arguments.size)
    sys.stdout.write(f"{'frame':<16}{'remap cubic':>14}{'correct':>12}{'ratio':>8}\n")
    for name, image in (("float32 colour", colour), ("uint8 colour", (255 * colour).astype(np.uint8))):
        corrected = correct_frame(image, depth, moving, ("left", 1))
        positions = np.nan_to_num(corrected.source_map)
        remap = cpu_ms(lambda: cv2.remap(image, positions, None, cv2.INTER_CUBIC), arguments.repetitions)  # noqa: B023
        correct = cpu_ms(
            lambda: correct_frame(image, depth, moving, ("left", 1)),  # noqa: B023
            arguments.repetitions,
        )
        sys.stdout.write(f"{name:<16}{remap:>11.1f} ms{correct:>9.1f} ms{correct / remap:>8.2f}\n")
    sys.stdout.write(f"allowed: {BOUND:g} times\n")


if __name__ == "__main__":
    main()
