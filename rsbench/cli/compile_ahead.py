"""Faster first use of an installation: a second process compiles the functions of ``correct`` in another order.

The command compiles functions in the order of their first calls. Half of the time is spent on the motion, whose
spline comes last, so the second process begins with the spline, continues with depth and correction, and ends with
the rest. Each process loads functions that the other has compiled from the cache on disk
(``rsbench.components.compiled``).
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import (
    PORTABLE_CPU,
    SHIPPED,
    cache_folder,
    runs_portable_code,
    shipped_folder,
)
from rsbench.components.imports import end_with, ending, lifeline, start_child
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.storage.files import check_out

_WIDTH, _HEIGHT, _DISPARITY = 160, 120, 5
_POSIX = os.name == "posix"
_COMMAND = "import sys; from rsbench.cli.compile_ahead import compile_all; compile_all(int(sys.argv[1]))"


@contextmanager
def compiling_ahead(*, to_the_end: bool = False) -> Iterator[None]:
    """Compile in a second process while the body runs, if nothing is compiled yet and there are two cores.

    Args:
        to_the_end: whether the second process goes on after the body, until everything is compiled.
    """
    folder = cache_folder()
    compiled = folder is None or any(folder.glob("*.nbi")) or shipped_folder() is not None
    if compiled or (os.cpu_count() or 1) < 2:
        yield
        return
    if to_the_end:
        with suppress(OSError):
            start_child(_COMMAND, line=-1)
        yield
        return
    with lifeline() as line:
        with suppress(OSError):  # without a second process, the command compiles alone
            start_child(_COMMAND, line=line)
        yield


def compile_all(line: int) -> None:
    """Run the parts of the chain on small images; ``line``: see ``end_with``, or -1 to outlive the parent."""
    if _POSIX and line >= 0:
        end_with(line)
    gc.disable()  # compilation makes many lasting objects; garbage collection would take a twentieth of the time
    for part in parts():
        with suppress(Exception):  # the command meets the same error and reports it
            part()


def compile_now(step: Callable[[str], None]) -> Path | None:
    """Compile everything in two processes, and return the cache folder; None if no folder is writable.

    Args:
        step: called with each name of ``PARTS`` when this part is compiled.
    """
    with lifeline() as line:
        with suppress(OSError):
            start_child(_COMMAND, line=line)
        for name, part in reversed(list(zip(PARTS, parts(), strict=True))):
            part()
            step(name)
    return cache_folder()


def compile_portable() -> None:
    """Compile everything for ``PORTABLE_CPU`` into the folder of the package, in another process.

    Raises:
        RsbenchError: the folder cannot be written, or this processor cannot run such code.
    """
    if not runs_portable_code():
        raise RsbenchError(f"compile --portable: this processor cannot run code for {PORTABLE_CPU}")
    folder = Path(str(resources.files("rsbench"))) / SHIPPED
    check_out(folder)
    variables = {
        "NUMBA_CPU_NAME": PORTABLE_CPU,
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_DISABLE_INTEL_SVML": "1",  # others may lack the library
        "NUMBA_CACHE_DIR": str(folder),
    }
    done = subprocess.run([sys.executable, "-m", "rsbench", "compile"], env={**os.environ, **variables})
    if done.returncode:
        raise RsbenchError(f"compile --portable: {ending(done.returncode)}")


PARTS = ("spline", "depth", "correction", "motion", "matching")
"""Names of the parts of the correction, in the order of ``parts``."""


def parts() -> list[Callable[[], object]]:
    """Return functions whose calls compile spline, depth, correction, motion and matching, in this order."""
    from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
    from rsbench.capture.hypotheses import KnownInputs
    from rsbench.capture.two_frame_spline import two_frame_spline
    from rsbench.components.motion_models import InertialMotion, LinearMotion
    from rsbench.core.camera import PinholeCamera
    from rsbench.core.rig import FRAMES, StereoRig
    from rsbench.core.shutter import RollingShutter
    from rsbench.core.spline_motion import SplineMotion
    from rsbench.pipeline.chain import correct_frames, find_depth
    from rsbench.pipeline.frame_capture import know_matches, match_frames
    from rsbench.pipeline.frame_depth import CorrectionOptions, depth_of_pair
    from rsbench.pipeline.frame_motion import solve_frames

    rig = StereoRig(camera=PinholeCamera.centred(_WIDTH, _HEIGHT, 150.0), baseline=0.3)
    shutter = RollingShutter(height=_HEIGHT, readout_ratio=0.8)
    motion = LinearMotion([0.0, 0.02, 0.0], [0.1, 0.0, 0.2])
    options, images = CorrectionOptions(motion_model="auto"), _images()
    known = KnownInputs(readout_ratio=shutter.readout_ratio)
    few = SimulationOptions(pairs=80, tracks=80, noise_px=0.1)
    shaken = SplineMotion([0.03, 0.05, 0.0], [0.1, 0.0, 0.2], preset="handheld")
    # Matches under two motion models, and under vibrations that need a spline.
    straight, turning, shaking = (
        simulate(rig, shutter, each, few, np.random.default_rng(0)).correspondences
        for each in (motion, InertialMotion([0.05, 0.12, 0.05], [0.1, 0.0, 0.2]), shaken)
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
        lambda: two_frame_spline(shaking, rig, shutter, LinearMotion(shaken.w, shaken.d)),
        lambda: find_depth(images, rig, shutter, motion, options),
        corrected,
        lambda: [solve_frames(know_matches(each, rig, known, options), options) for each in (straight, turning)],
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
