"""Solvers whose rotation a gyroscope gives, or whose vertical is known."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from solver_trials import GLOBAL, RIG, SHUTTER, assert_near, errors_deg, trial, true_d

from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import AcceleratedMotion, LinearMotion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.imu import GyroMotion
from rsbench.core.pose_errors import rotation_error, scale_error, translation_error
from rsbench.core.spline_motion import SplineMotion
from rsbench.pipeline.problem import EXAMPLE, parse_problem, problem_record, read_problem
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.gyro_and_gravity import GyroSolver, Uprights, UprightSolver

MONO, STEREO = load_solver("rs-gyro-5pt"), load_solver("rs-gyro-stereo")


def turning(seed: int, *, stereo: bool, pairs: int = 60, **options: Any) -> Simulation:
    rig = RIG if stereo else RIG.about("left")
    return trial(seed, degrees=3.0, rig=rig, pairs=pairs, gyro_rate=20, **options)


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
        s = turning(seed, stereo=False)
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
        s = turning(seed, stereo=False)
        found = GyroSolver(refinement=how).estimate(s.correspondences, RIG, SHUTTER)  # pyrefly: ignore[bad-argument-type]
        assert found.success and not found.metric and rotation_error(found.w, s.motion.w) < 1e-12
        assert translation_error(found.d, s.motion.d) < 1e-8
        s = turning(seed, stereo=True)
        found = GyroSolver(cameras_used="both", refinement=how).estimate(  # pyrefly: ignore[bad-argument-type]
            s.correspondences, RIG, SHUTTER
        )
        # The length comes from w x baseline, a hundredth of the flow.
        assert found.metric and scale_error(found.d, s.motion.d) < 1e-6


@pytest.mark.parametrize("stereo", [False, True])
def test_minimal_samples_suffice(stereo: bool) -> None:
    s, solver = turning(1, stereo=stereo), STEREO if stereo else MONO
    c = replace(s.correspondences, left=s.correspondences.left[:2], right=s.correspondences.right[: int(stereo)])
    (found,) = solver.propose(c, RIG, SHUTTER)
    assert found.success and found.metric == stereo
    np.testing.assert_allclose(found.d / np.linalg.norm(found.d), s.motion.d / 0.3, atol=1e-5)


def test_it_is_at_the_bound_of_a_known_rotation() -> None:
    distances = []
    for seed in range(25):
        s, exact = turning(seed, stereo=False, noise_px=0.3), turning(seed, stereo=False)
        rig, left = RIG.about("left"), Correspondences(left=exact.correspondences.left)
        F = motion_bound(left, rig, SHUTTER, s.motion, 0.3).information[3:, 3:]
        error = 0.3 * MONO.estimate(s.correspondences, RIG, SHUTTER).d - s.motion.d
        distances.append(error @ F @ error)
    # Chi-squared with two degrees of freedom: its mean of 25 scatters by sqrt(4 / 25) = 0.4.
    assert np.mean(distances) == pytest.approx(2.0, abs=1.2)


def test_errors_grow_with_the_bias_and_the_delay_of_the_gyroscope() -> None:
    """A bias is an error of the rotation as it is; a delay none of a constant rotation."""
    s = turning(2, stereo=False, gyro_bias_deg=0.1)
    assert np.degrees(rotation_error(MONO.estimate(s.correspondences, RIG, SHUTTER).w, s.motion.w)) == (
        pytest.approx(0.1, rel=0.1)
    )
    s = turning(2, stereo=False, gyro_delay=0.2)
    assert rotation_error(MONO.estimate(s.correspondences, RIG, SHUTTER).w, s.motion.w) < 1e-12
    noisy = [turning(2, stereo=False, gyro_noise_deg=noise).correspondences.gyro for noise in (0.0, 1.0)]
    assert 0.8 < np.std(np.degrees(noisy[1] - noisy[0])[:, 1:]) < 1.2


def test_without_a_gyroscope_it_fails_by_value() -> None:
    c = replace(turning(0, stereo=True).correspondences, gyro=np.zeros((0, 4)))
    assert "0 samples of a gyroscope, need 2" in MONO.estimate(c, RIG, SHUTTER).reason
    still = replace(c, gyro=np.array([[0.0, 0.1, 0.0, 0.0]] * 3))
    assert "one time" in STEREO.estimate(still, RIG, SHUTTER).reason


NAMES = ("gs-upright-3pt", "gs-upright-4pt")
POINTS = dict(zip(NAMES, ("left", "body"), strict=True))


def upright_trial(seed: int, degrees: float = 3.0, pairs: int = 60, **options: Any) -> Simulation:
    return trial(seed, degrees=degrees, shutter=GLOBAL, pairs=pairs, gravity=True, **options)


@pytest.mark.parametrize("name", NAMES)
def test_the_motion_of_exact_matches_is_exact(name: str) -> None:
    for seed in range(5):
        s = upright_trial(seed, 3.0 if seed else 40.0)
        found = load_solver(name).estimate(s.correspondences, RIG, GLOBAL)
        assert found.success and rotation_error(found.w, s.motion.w) < 1e-10
        assert translation_error(found.d, true_d(s.motion, POINTS[name])) < 1e-9
        assert not found.metric or scale_error(found.d, s.motion.d) < 1e-6  # from w x baseline, a hundredth
        assert found.metric == (name == "gs-upright-4pt")


@pytest.mark.parametrize(("name", "sizes"), [(NAMES[0], (3, 0)), (NAMES[1], (2, 2))])
def test_one_of_the_motions_of_a_minimal_sample_is_the_true_one(name: str, sizes: tuple[int, int]) -> None:
    """Turns of 20 degrees: of small ones the length of the rig's d is nearly open in four matches."""
    nearest = []
    for seed in range(5):
        s = upright_trial(seed, 20.0)
        c = s.correspondences
        sample = replace(c, left=c.left[: sizes[0]], right=c.right[: sizes[1]])
        assert dict(load_solver(name).sample_sizes(c)) == {
            side: size for side, size in zip(("left", "right"), sizes, strict=True) if size
        }
        found = load_solver(name).propose(sample, RIG, GLOBAL)
        nearest.append(np.radians(min(max(errors_deg(each, s.motion, POINTS[name])) for each in found)))
    # The roots of PoseLib's polynomial for a rig have 5 to 7 digits on exact matches, those for a camera 12.
    assert np.max(nearest) < (1e-3 if sizes[1] else 1e-8)


def test_points_give_the_side_of_a_translation_of_known_gravity() -> None:
    """Without rotation no camera moves against the other."""
    motion = LinearMotion(np.zeros(3), np.array([0.0, 0.0, 0.3]))
    options = SimulationOptions(pairs=60, gravity=True, noise_px=0.3)
    for seed in range(15):
        s = simulate(RIG, GLOBAL, motion, options, np.random.default_rng(seed))
        found = load_solver("gs-upright-4pt").estimate(s.correspondences, RIG, GLOBAL)
        assert not found.metric and translation_error(found.d, s.motion.d) < np.radians(5.0), seed


@pytest.mark.parametrize("name", NAMES)
def test_it_is_at_the_bound_of_two_known_angles(name: str) -> None:
    """What the information says when only turns about the vertical are left."""
    solver = load_solver(name)
    assert isinstance(solver, UprightSolver)
    solver = replace(solver, refinement="upright")
    distances = []
    for seed in range(16):
        s, exact = upright_trial(seed, noise_px=0.3), upright_trial(seed)
        rig = RIG.about("left") if name == "gs-upright-3pt" else RIG
        c, d = exact.correspondences, true_d(s.motion, POINTS[name])
        sets = {"left": c.left, "right": c.right} if name == "gs-upright-4pt" else {"left": c.left}
        motion = type(s.motion)(s.motion.w, d)
        F = motion_bound(Correspondences(**sets), rig, GLOBAL, motion, 0.3).information
        found = solver.estimate(s.correspondences, RIG, GLOBAL)
        length = np.linalg.norm(d) if name == "gs-upright-3pt" else 1.0
        error = np.concatenate([found.w - s.motion.w, length * found.d - d])
        distances.append(error @ F @ error)
        # The turn that is left is about the vertical of frame 1.
        turn = so3.log(so3.exp(found.w) @ so3.exp(-s.motion.w))
        down = c.gravity[1, 1:] / np.linalg.norm(c.gravity[1, 1:])
        assert np.linalg.norm(np.cross(turn, down)) < 1e-9
    # Chi-squared with as many degrees of freedom as unknowns: its mean of 16 scatters by sqrt(2 * 4 / 16) = 0.7.
    assert np.mean(distances) == pytest.approx(3.0 if name == "gs-upright-3pt" else 4.0, abs=1.7)


def test_wrong_gravity_stays_wrong_unless_all_angles_are_free() -> None:
    """Then the end is PoseLib's least squares."""
    bound, free = (UprightSolver(cameras_used="both", refinement=how) for how in ("upright", "free"))
    for seed in range(3):
        c = upright_trial(seed, noise_px=0.3, gravity_noise_deg=0.2).correspondences
        theirs = load_solver("gs-poselib-stereo").estimate(c, RIG, GLOBAL)
        ours, wrong = (solver.estimate(c, RIG, GLOBAL) for solver in (free, bound))
        assert_near(ours, LinearMotion(theirs.w, theirs.d), 1e-5, 1e-4)
        assert np.degrees(rotation_error(wrong.w, theirs.w)) > 0.02


def test_gravity_turns_with_the_camera_and_has_its_noise() -> None:
    s = upright_trial(0)
    first, second = s.correspondences.gravity
    np.testing.assert_allclose(so3.exp(s.motion.w) @ first[1:], second[1:], atol=1e-14)
    angles = []
    for seed in range(40):
        noisy, exact = (
            upright_trial(seed, pairs=0, gravity_noise_deg=g).correspondences.gravity for g in (0.5, 0.0)
        )
        np.testing.assert_allclose(np.linalg.norm(noisy[:, 1:], axis=1), 1.0, atol=1e-14)
        angles.append(np.linalg.norm(np.cross(noisy[:, 1:], exact[:, 1:]), axis=1))
    # Two angles of 0.5 degrees each; the root of 160 squares is 6 % off.
    assert np.degrees(np.sqrt(np.mean(np.square(angles)))) == pytest.approx(0.5 * np.sqrt(2.0), rel=0.2)


def test_what_is_no_gravity_is_told_by_value() -> None:
    c, solver = upright_trial(0).correspondences, load_solver("gs-upright-3pt")
    found = solver.estimate(replace(c, gravity=np.array([[0.0, 0.0, 1.0, 0.0]] * 2)), RIG, GLOBAL)
    assert not found.success and "no direction of gravity" in found.reason
    assert (
        "0 directions of gravity, need 2"
        in solver.estimate(replace(c, gravity=np.zeros((0, 4))), RIG, GLOBAL).reason
    )
    up = Uprights.of(np.array([[1.0, 0.0, -2.0, 0.0], [0.0, 0.0, 3.0, 0.0]]))  # upside down, in any order
    assert up is not None
    np.testing.assert_allclose(up.first, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(up.second @ [0.0, -1.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


def test_a_problem_holds_gravity() -> None:
    record = problem_record(read_problem(EXAMPLE)) | {"gravity": [[0, 0, 9.81, 0], [1, 0.1, 9.81, 0]]}
    np.testing.assert_array_equal(
        parse_problem(json.dumps(record), "here").correspondences.gravity, record["gravity"]
    )
    with pytest.raises(RsbenchError, match=r"gravity\[0\] = \[0.0, 1.0\]: must be 4 numbers: tau, gx"):
        parse_problem(json.dumps(record | {"gravity": [[0, 1]]}), "here")
