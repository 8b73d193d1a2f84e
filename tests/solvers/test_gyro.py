"""A gyroscope's rotation, and the translation that is linear in the matches then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import AcceleratedMotion, LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.imu import GyroMotion
from rsbench.core.pose_errors import rotation_error, scale_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.spline_motion import SplineMotion
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.gyro_and_gravity import GyroSolver

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
MONO, STEREO = load_solver("rs-gyro-5pt"), load_solver("rs-gyro-stereo")


def trial(seed: int, *, stereo: bool, **options: float) -> Simulation:
    motion = random_motion(np.random.default_rng(seed), np.radians(3.0), 0.3)
    rig = RIG if stereo else RIG.about("left")
    chosen = SimulationOptions(**{"pairs": 60, "gyro_rate": 20, **options})  # pyrefly: ignore[bad-argument-type]
    return simulate(rig, SHUTTER, motion, chosen, np.random.default_rng(seed))


def test_rotations_are_those_of_the_motion_that_was_sampled() -> None:
    tau = np.linspace(0.0, 1.9, 50)
    turning = AcceleratedMotion(np.array([0.1, -0.2, 0.3]), np.ones(3), acceleration=0.5)
    at = np.linspace(-0.5, 2.5, 31)
    samples = np.column_stack([at, turning.velocity(at)[0]])[::-1]  # in any order
    gyro = GyroMotion(samples, turning.d)
    # Rates that change linearly about one axis are integrated exactly.
    np.testing.assert_allclose(gyro.body_from_world(tau).R, turning.body_from_world(tau).R, atol=1e-14)
    np.testing.assert_allclose(gyro.w, turning.w, atol=1e-14)
    shaking = SplineMotion(np.array([0.1, -0.2, 0.3]), np.ones(3), preset="handheld", seed=1)
    errors = []
    for count in (60, 120):
        at = np.linspace(0.0, 2.0, count + 1)
        gyro = GyroMotion(np.column_stack([at, shaking.velocity(at)[0]]), shaking.d)
        errors.append(np.max(np.abs(gyro.body_from_world(tau).R - shaking.body_from_world(tau).R)))
    assert errors[0] < 1e-3 and 3.0 < errors[0] / errors[1] < 5.0  # the trapezoidal rule's second order


def test_the_descent_keeps_the_side_of_a_translation_without_a_length() -> None:
    """Its errors are the same for every length: a step may be as long as to the other side of zero."""
    for seed in range(40):
        s = trial(seed, stereo=False)
        found = GyroSolver().estimate(s.correspondences, RIG, SHUTTER)
        assert translation_error(found.d, s.motion.d) < 1e-8, seed


def test_points_give_the_side_of_a_translation_whose_length_is_open() -> None:
    """About the baseline no camera moves against the other: a wrong rotation gives d a length of any sign."""
    motion = LinearMotion(np.array([0.03, 0.0, 0.0]), np.array([0.1, -0.2, 0.2]))
    options = SimulationOptions(pairs=60, noise_px=0.3, gyro_rate=20, gyro_bias_deg=0.05)
    for seed in range(10):
        s = simulate(RIG, SHUTTER, motion, options, np.random.default_rng(seed))
        found = STEREO.estimate(s.correspondences, RIG, SHUTTER)
        assert translation_error(found.d, s.motion.d) < np.radians(5.0), seed


@pytest.mark.parametrize("how", ["none", "sampson"])
def test_the_translation_of_exact_data_is_exact_and_metric_on_the_rig(how: str) -> None:
    for seed in range(3):
        s = trial(seed, stereo=False)
        found = GyroSolver(refinement=how).estimate(s.correspondences, RIG, SHUTTER)  # pyrefly: ignore[bad-argument-type]
        assert found.success and not found.metric and rotation_error(found.w, s.motion.w) < 1e-12
        assert translation_error(found.d, s.motion.d) < 1e-8
        s = trial(seed, stereo=True)
        found = GyroSolver(cameras_used="both", refinement=how).estimate(  # pyrefly: ignore[bad-argument-type]
            s.correspondences, RIG, SHUTTER
        )
        # The length comes from w x baseline, a hundredth of the flow.
        assert found.metric and scale_error(found.d, s.motion.d) < 1e-6


@pytest.mark.parametrize("stereo", [False, True])
def test_minimal_samples_suffice(stereo: bool) -> None:
    s, solver = trial(1, stereo=stereo), STEREO if stereo else MONO
    c = replace(s.correspondences, left=s.correspondences.left[:2], right=s.correspondences.right[: int(stereo)])
    (found,) = solver.propose(c, RIG, SHUTTER)
    assert found.success and found.metric == stereo
    np.testing.assert_allclose(found.d / np.linalg.norm(found.d), s.motion.d / 0.3, atol=1e-5)


def test_it_is_at_the_bound_of_a_known_rotation() -> None:
    distances = []
    for seed in range(25):
        s, exact = trial(seed, stereo=False, noise_px=0.3), trial(seed, stereo=False)
        rig, left = RIG.about("left"), Correspondences(left=exact.correspondences.left)
        F = motion_bound(left, rig, SHUTTER, s.motion, 0.3).information[3:, 3:]
        error = 0.3 * MONO.estimate(s.correspondences, RIG, SHUTTER).d - s.motion.d
        distances.append(error @ F @ error)
    # Chi-squared with two degrees of freedom: its mean of 25 scatters by sqrt(4 / 25) = 0.4.
    assert np.mean(distances) == pytest.approx(2.0, abs=1.2)


def test_errors_grow_with_the_bias_and_the_delay_of_the_gyroscope() -> None:
    """A bias is an error of the rotation as it is; a delay none of a constant rotation."""
    s = trial(2, stereo=False, gyro_bias_deg=0.1)
    assert np.degrees(rotation_error(MONO.estimate(s.correspondences, RIG, SHUTTER).w, s.motion.w)) == (
        pytest.approx(0.1, rel=0.1)
    )
    s = trial(2, stereo=False, gyro_delay=0.2)
    assert rotation_error(MONO.estimate(s.correspondences, RIG, SHUTTER).w, s.motion.w) < 1e-12
    noisy = [trial(2, stereo=False, gyro_noise_deg=noise).correspondences.gyro for noise in (0.0, 1.0)]
    assert 0.8 < np.std(np.degrees(noisy[1] - noisy[0])[:, 1:]) < 1.2


@pytest.mark.parametrize("stereo", [False, True])
def test_it_stands_outliers_in_the_loop(stereo: bool) -> None:
    s = trial(3, stereo=stereo, pairs=150, noise_px=0.3, outlier_ratio=0.5)
    solver = STEREO if stereo else MONO
    found = estimate_motion(s.correspondences, RIG, SHUTTER, solver, RobustOptions(), np.random.default_rng(0))
    assert found.estimate.success and rotation_error(found.estimate.w, s.motion.w) < 1e-12
    assert np.degrees(translation_error(found.estimate.d, s.motion.d)) < 1.0


def test_without_a_gyroscope_it_fails_by_value() -> None:
    c = replace(trial(0, stereo=True).correspondences, gyro=np.zeros((0, 4)))
    assert "0 samples of a gyroscope, need 2" in MONO.estimate(c, RIG, SHUTTER).reason
    still = replace(c, gyro=np.array([[0.0, 0.1, 0.0, 0.0]] * 3))
    assert "one time" in STEREO.estimate(still, RIG, SHUTTER).reason
