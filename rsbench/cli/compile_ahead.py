"""The first use of an installation: a second process compiles what ``correct`` needs, beginning elsewhere.

The command compiles in the order in which it comes to its functions. Half of their time is the motion's, and the
spline is the last of it, so the process begins there, goes on to depth and correction, and takes the rest when
both are through with their halves. What one of them compiled the other loads from the cache on disk
(``rsbench.components.compiled``).
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import cache_folder
from rsbench.components.imports import end_with, lifeline
from rsbench.core.rig import VIEWS, View

_WIDTH, _HEIGHT, _DISPARITY = 160, 120, 5
_POSIX = os.name == "posix"
_COMMAND = "import sys; from rsbench.cli.compile_ahead import compile_all; compile_all(int(sys.argv[1]))"


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """While the body runs, and where nothing is compiled yet and there is a second core, compile beside it."""
    folder = cache_folder()
    if folder is None or any(folder.glob("*.nbi")) or (os.cpu_count() or 1) < 2:
        yield
        return
    with lifeline() as line:
        with suppress(OSError):  # no process to be had: the command compiles alone
            subprocess.Popen(
                [sys.executable, "-c", _COMMAND, str(line)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # its own process group, which ends with this process
                pass_fds=(line,) if _POSIX else (),
            )
        yield


def compile_all(line: int) -> None:
    """Run the parts of the chain on small images; end with the parent."""
    if _POSIX:
        end_with(line)
    gc.disable()  # compiling makes much that lasts, and looking for garbage among it takes a twentieth
    for part in parts():
        with suppress(Exception):  # whatever it is, the command meets it too, and says so
            part()


def parts() -> list[Callable[[], object]]:
    """What compiles the spline, depth, correction, motion and matching, in this order."""
    from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
    from rsbench.capture.two_frame_spline import shaken_motion
    from rsbench.components.motion_models import LinearMotion
    from rsbench.core.camera import PinholeCamera
    from rsbench.core.rig import FRAMES, StereoRig
    from rsbench.core.shutter import RollingShutter
    from rsbench.pipeline.chain import correct_frames, find_depth
    from rsbench.pipeline.correction_options import CorrectionOptions
    from rsbench.pipeline.frame_depth import depth_of_pair
    from rsbench.pipeline.frame_matches import match_frames
    from rsbench.pipeline.frame_motion import solve_frames

    rig = StereoRig(camera=PinholeCamera.centred(_WIDTH, _HEIGHT, 150.0), baseline=0.3)
    shutter, motion = (
        RollingShutter(height=_HEIGHT, readout_ratio=0.8),
        LinearMotion([0.0, 0.02, 0.0], [0.1, 0.0, 0.2]),
    )
    options, images = CorrectionOptions(motion_model="auto"), _images()
    data = simulate(
        rig, shutter, motion, SimulationOptions(pairs=80, tracks=80, noise_px=0.1), np.random.default_rng(0)
    )
    wall = [np.full((_HEIGHT, _WIDTH), 9.0, dtype=np.float32)] * 2
    wall[0][40:60, 40:60] = np.nan

    def corrected() -> object:
        first, second = (
            depth_of_pair(images["left", frame], images["right", frame], wall, rig, find_sky=False)
            for frame in FRAMES
        )
        return correct_frames(images, (first, second), rig, shutter, motion, options)

    return [
        lambda: shaken_motion(data.correspondences, rig, shutter, motion),
        lambda: find_depth(images, rig, shutter, motion, options),
        corrected,
        lambda: solve_frames(data.correspondences, rig, shutter.readout_ratio, options),
        lambda: match_frames(images, rig, options),
    ]


def _images() -> dict[View, NDArray[np.uint8]]:
    """Four views (H, W, 3) of a textured wall that moves by whole pixels."""
    noise = np.random.default_rng(0).random((_HEIGHT, 2 * _WIDTH, 3), dtype=np.float32)
    wall = cv2.normalize(cv2.GaussianBlur(noise, None, 2.0), None, 0.0, 255.0, cv2.NORM_MINMAX).astype(np.uint8)
    return {
        (side, frame): np.ascontiguousarray(wall[:, _DISPARITY * (side == "right") + 2 * frame :][:, :_WIDTH])
        for side, frame in VIEWS
    }
