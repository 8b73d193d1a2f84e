"""Wrong matches that leap across the image are perfect ones at a ratio beyond 1, and must not hold it there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.capture.hypotheses import BEYOND_RATIO, Scans, TimedMatches
from rsbench.capture.hypothesis_ranking import without_leaps
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.components.motion_models import make_motion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter

RIG = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=0.2)
MOTION: Motion = make_motion("accelerated", [0.0, -0.009, 0.0], [0.006, 0.004, -0.2], {"acceleration": 0.06})
"""A vehicle that speeds up: the ratio trades with the acceleration, so the valley is shallow."""
RATIO = 0.8


def leap(ratio: float) -> np.ndarray:
    """From the bottom of the image to a row that is read at the same time, a period later; (1, 4)."""
    return np.array([[10.0, 470.0, 170.0, 470.0 - 480.0 / ratio]])


@pytest.mark.parametrize("ratio", [1.1, BEYOND_RATIO])
def test_a_leap_is_a_perfect_match_at_some_ratio_and_is_left_out(ratio: float) -> None:
    wrong = Correspondences(left=leap(ratio))
    timed = TimedMatches(wrong, RIG, "linear")
    unknowns = np.zeros(17)
    unknowns[0] = ratio
    theta = np.concatenate([MOTION.w, MOTION.d])
    assert abs(timed.packed(Scans("top", "top"), unknowns).pair_residuals(theta)[0]) < 1e-3
    assert len(without_leaps(wrong, RIG).left) == 0


@pytest.mark.slow
def test_leaps_do_not_hold_the_ratio() -> None:
    options = SimulationOptions(noise_px=0.05, pairs=300, tracks=300, depth=(3.0, 12.0))
    made = simulate(
        RIG, RollingShutter(height=480, readout_ratio=RATIO), MOTION, options, np.random.default_rng(0)
    )
    right = made.correspondences
    leaps = np.concatenate([leap(ratio) for ratio in np.linspace(1.02, 1.2, 10)])
    found = []
    for matches in (right, replace(right, left=np.concatenate([right.left, leaps]))):
        best = conclude([examine(matches, RIG)], np.inf).likeliest
        assert best is not None
        assert abs(best.ratio - RATIO) < 3.0 * best.sigma
        found.append(best.ratio)
    assert found[1] == pytest.approx(found[0], abs=1e-3)  # the start alone is found among other matches
