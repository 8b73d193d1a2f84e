"""The focal length that matches of one camera tell. Truth: points projected exactly by it."""

from __future__ import annotations

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.self_calibration import PRIOR, PairFocal, conclude_focal, focal_of_pair
from rsbench.components.motion_models import InertialMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.robust_motion import RobustOptions

WIDTH, HEIGHT = 640, 480
SHUTTER = RollingShutter(height=HEIGHT, readout_ratio=0.7)


def _pair(focal: float, w: list[float], d: list[float], seed: int) -> PairFocal:
    rig = StereoRig(camera=PinholeCamera.centred(WIDTH, HEIGHT, focal), baseline=0.4)
    motion, options = InertialMotion(w=np.radians(w), d=d), SimulationOptions(pairs=300, noise_px=0.1)
    matches = simulate(rig, SHUTTER, motion, options, np.random.default_rng(seed)).correspondences.left
    found = focal_of_pair(matches, (WIDTH, HEIGHT), SHUTTER, RobustOptions())
    assert found is not None
    return found


@pytest.mark.parametrize("focal", [300.0, 1100.0])
def test_a_camera_that_turns_shows_its_focal_length(focal: float) -> None:
    found = _pair(focal, [3.0, -2.0, 1.0], [0.1, -0.2, 0.1], 0)
    # Exact but for 0.1 px of noise: 5 of its deviations, and less than a quarter of what two frames are trusted.
    assert abs(found.log - np.log(focal / WIDTH)) < min(5.0 * found.sigma, 0.06)
    told = conclude_focal(3 * [found], WIDTH)
    assert told.determined and abs(told.focal - focal) < 2.0 * told.sigma


def test_a_camera_that_goes_straight_on_does_not() -> None:
    found = conclude_focal([_pair(400.0, [0.0, 0.0, 0.0], [0.2, 0.1, 0.2], 1)], WIDTH)
    assert not found.determined and found.focal == WIDTH and found.sigma == PRIOR * WIDTH


def test_more_pairs_tell_more_and_the_more_they_scatter_the_less() -> None:
    def sigma(*logs: float) -> float:
        found = conclude_focal([PairFocal(log, 0.01, 0.1) for log in logs], WIDTH)
        return found.sigma / found.focal

    assert sigma(-0.2, -0.2, -0.2, -0.2) < sigma(-0.2, -0.2) < sigma(-0.2)
    assert sigma(-0.2, -0.2, -0.2, -0.2) < sigma(-0.6, 0.2, -0.6, 0.2)


def test_pairs_that_show_no_lens_that_is_made_are_not_averaged() -> None:
    broken, good = PairFocal(1.5, 0.01, 0.1), PairFocal(-0.2, 0.01, 0.1)
    assert not conclude_focal([broken, broken, good, good], WIDTH).determined
    assert conclude_focal([broken, good, good, good], WIDTH).pairs == 3
    still = PairFocal(-0.2, 0.01, np.deg2rad(0.3))
    assert not conclude_focal([None, still], WIDTH).determined
    assert not conclude_focal([good, still, still], WIDTH).determined
