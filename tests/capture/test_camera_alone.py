"""What matches of one camera say of its shutter. Truth: points projected exactly by it."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.hypotheses import Scans
from rsbench.capture.shutter_decision import (
    NoMotionError,
    conclude_alone,
    examine_alone,
    fits_backwards,
    known_alone,
    runs_backwards,
    shutter_alone,
)
from rsbench.capture.two_frame_estimate import Capture
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions

CAMERA = PinholeCamera.centred(640, 480, 500.0)
SHUTTER = RollingShutter(height=480, readout_ratio=0.7)


TURNING = [
    LinearMotion(w=np.radians([3.0, -1.0, 2.0]), d=[0.2, -0.1, 0.1]),
    LinearMotion(w=np.radians([-2.0, 2.0, -3.0]), d=[-0.1, -0.2, 0.2]),
]


def _matches(motion: LinearMotion, seed: int = 0) -> FloatArray:
    rig, options = StereoRig(camera=CAMERA, baseline=0.4), SimulationOptions(pairs=200, noise_px=0.1)
    return simulate(rig, SHUTTER, motion, options, np.random.default_rng(seed)).correspondences.left


def _capture(matches: list[FloatArray]) -> Capture:
    return conclude_alone([examine_alone(each, CAMERA, known_alone(), RobustOptions()) for each in matches])


def test_a_turning_camera_shows_its_readout_whatever_the_unit_of_length() -> None:
    capture = _capture([_matches(motion, seed) for seed, motion in enumerate(TURNING)])
    best = capture.likeliest
    assert best is not None and best.scans.left == "top" and best.probability > 0.95
    # Its own deviation covers the error; 0.1 is what a correction asks for.
    assert abs(best.ratio - 0.7) < 3.0 * best.sigma and best.sigma < 0.1
    assert shutter_alone(capture, CAMERA).readout_ratio == best.ratio


def test_exchanged_frames_look_read_from_the_other_side() -> None:
    forward = _matches(TURNING[0])
    backward = forward[:, [2, 3, 0, 1]]
    assert not fits_backwards(forward, CAMERA, SHUTTER, RobustOptions())
    assert fits_backwards(backward, CAMERA, SHUTTER, RobustOptions())
    assert runs_backwards(_capture([backward]), Scans("top", "top"))


def test_a_motion_along_the_lines_does_not_show_it() -> None:
    capture = _capture([_matches(LinearMotion(w=[0.0, 0.0, 0.0], d=[0.3, 0.0, 0.0]))])
    with pytest.raises(NoMotionError, match=r"cannot tell the readout ratio: the frames show .* read"):
        shutter_alone(capture, CAMERA)
