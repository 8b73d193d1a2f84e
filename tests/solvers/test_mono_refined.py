"""One camera's maximum likelihood: exact, at the bound of its own matches, and deaf to the baseline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
LEFT = RIG.about("left")
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
SOLVER = load_solver("rs-mono-refined")


def trial(seed: int, noise_px: float, pairs: int = 100, outliers: float = 0.0) -> Simulation:
    """The left camera itself moves as the paper's body does: what a single camera's solver assumes."""
    motion = random_motion(np.random.default_rng(seed), np.radians(2.0), 0.3)
    options = SimulationOptions(pairs=pairs, noise_px=noise_px, outlier_ratio=outliers)
    return simulate(LEFT, SHUTTER, motion, options, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(4))
def test_exact_matches_give_the_exact_motion_with_a_unit_translation(seed: int) -> None:
    s = trial(seed, 0.0, pairs=20)
    estimate = SOLVER.estimate(s.correspondences, RIG, SHUTTER)
    assert estimate.success and not estimate.metric
    assert np.linalg.norm(estimate.d) == pytest.approx(1.0, abs=1e-12)
    # The rows are exact to 1e-10 px, which 20 matches amplify less than a thousandfold: 1e-10 rad.
    assert rotation_error(estimate.w, s.motion.w) < 1e-9 and translation_error(estimate.d, s.motion.d) < 1e-8


def test_it_is_at_the_bound_of_one_camera() -> None:
    """The error, by the information of the same matches, is chi-squared with five degrees of freedom."""
    noise, distances, stated = 0.3, list[float](), list[float]()
    for seed in range(40):
        s, exact = trial(seed, noise), trial(seed, 0.0)
        left = Correspondences(left=exact.correspondences.left)
        F = motion_bound(left, LEFT, SHUTTER, s.motion, noise).information
        estimate = SOLVER.estimate(s.correspondences, RIG, SHUTTER)
        length = float(np.linalg.norm(s.motion.d))
        error = np.concatenate([estimate.w - s.motion.w, length * estimate.d - s.motion.d])
        distances.append(float(error @ F @ error))
        assert estimate.covariance is not None
        scale = np.repeat([1.0, length], 3)
        stated.append(np.sum(F * (estimate.covariance * np.outer(scale, scale))))
    # Standard deviations of the means: sqrt(2 * 5 / 40) = 0.5, and of the noise's own estimate from 95 degrees of
    # freedom each, 5 * sqrt(2 / 95 / 40) = 0.12.
    assert np.mean(distances) == pytest.approx(5.0, abs=1.5)
    assert np.mean(stated) == pytest.approx(5.0, abs=0.5)


def test_the_baseline_and_the_right_camera_say_nothing() -> None:
    s = trial(0, 0.3)
    first = SOLVER.estimate(s.correspondences, RIG, SHUTTER)
    alone = Correspondences(left=s.correspondences.left)
    second = SOLVER.estimate(alone, replace(RIG, baseline=0.1), SHUTTER)
    # The length that a descent starts with is another: equal up to where it stops.
    np.testing.assert_allclose(second.w, first.w, atol=1e-9)
    np.testing.assert_allclose(second.d, first.d, atol=1e-8)


@pytest.mark.parametrize("outliers", [0.3, 0.5])
def test_it_stands_outliers(outliers: float) -> None:
    s = trial(1, 0.3, pairs=200, outliers=outliers)
    left = Correspondences(left=s.correspondences.left)
    found = estimate_motion(left, RIG, SHUTTER, SOLVER, RobustOptions(), np.random.default_rng(0)).estimate
    # Six times the bound of 100 matches (0.024 and 0.2 degrees at 0.3 px).
    assert found.success and np.degrees(rotation_error(found.w, s.motion.w)) < 0.15
    assert np.degrees(translation_error(found.d, s.motion.d)) < 1.2
    assert found.covariance is not None and np.degrees(np.sqrt(np.trace(found.covariance[:3, :3]))) < 0.1
