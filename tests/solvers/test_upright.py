"""Solvers that know where down is."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, scale_error, translation_error, translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.problem import EXAMPLE, parse_problem, problem_record, read_problem
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.gyro_and_gravity import Uprights, UprightSolver

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)
NAMES = ("gs-upright-3pt", "gs-upright-4pt")


def trial(seed: int, degrees: float = 3.0, **options: Any) -> Simulation:
    motion = random_motion(np.random.default_rng(seed), np.radians(degrees), 0.3)
    chosen = replace(SimulationOptions(pairs=60, gravity=True), **options)
    return simulate(RIG, GLOBAL, motion, chosen, np.random.default_rng(seed))


def true_d(name: str, s: Simulation) -> FloatArray:
    if name == "gs-upright-4pt":
        return s.motion.d
    return translation_of_offset(s.motion.w, s.motion.d, RIG.offset("left"))


@pytest.mark.parametrize("name", NAMES)
def test_the_motion_of_exact_matches_is_exact(name: str) -> None:
    for seed in range(5):
        s = trial(seed, 3.0 if seed else 40.0)
        found = load_solver(name).estimate(s.correspondences, RIG, GLOBAL)
        assert found.success and rotation_error(found.w, s.motion.w) < 1e-10
        assert translation_error(found.d, true_d(name, s)) < 1e-9
        assert not found.metric or scale_error(found.d, s.motion.d) < 1e-6  # from w x baseline, a hundredth
        assert found.metric == (name == "gs-upright-4pt")


@pytest.mark.parametrize(("name", "sizes"), [(NAMES[0], (3, 0)), (NAMES[1], (2, 2))])
def test_one_of_the_motions_of_a_minimal_sample_is_the_true_one(name: str, sizes: tuple[int, int]) -> None:
    """Turns of 20 degrees: of small ones the length of the rig's d is nearly open in four matches."""
    nearest = []
    for seed in range(5):
        s = trial(seed, 20.0)
        c = s.correspondences
        sample = replace(c, left=c.left[: sizes[0]], right=c.right[: sizes[1]])
        assert dict(load_solver(name).sample_sizes(c)) == {
            side: size for side, size in zip(("left", "right"), sizes, strict=True) if size
        }
        found = load_solver(name).propose(sample, RIG, GLOBAL)
        errors = [
            max(float(rotation_error(each.w, s.motion.w)), float(translation_error(each.d, true_d(name, s))))
            for each in found
        ]
        nearest.append(min(errors))
    # The roots of PoseLib's polynomial for a rig have 5 to 7 digits on exact matches, those for a camera 12.
    assert np.max(nearest) < (1e-3 if sizes[1] else 1e-8)


def test_points_give_the_side_of_a_translation_whose_length_is_open() -> None:
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
        s, exact = trial(seed, noise_px=0.3), trial(seed)
        rig = RIG.about("left") if name == "gs-upright-3pt" else RIG
        c, d = exact.correspondences, true_d(name, s)
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
        c = trial(seed, noise_px=0.3, gravity_noise_deg=0.2).correspondences
        theirs = load_solver("gs-poselib-stereo").estimate(c, RIG, GLOBAL)
        ours, wrong = (solver.estimate(c, RIG, GLOBAL) for solver in (free, bound))
        assert np.degrees(rotation_error(ours.w, theirs.w)) < 1e-5
        assert np.degrees(translation_error(ours.d, theirs.d)) < 1e-4
        assert np.degrees(rotation_error(wrong.w, theirs.w)) > 0.02


@pytest.mark.parametrize("name", NAMES)
def test_it_stands_outliers_in_the_loop(name: str) -> None:
    s = trial(3, pairs=150, noise_px=0.3, outlier_ratio=0.5)
    rng = np.random.default_rng(0)
    found = estimate_motion(s.correspondences, RIG, GLOBAL, load_solver(name), RobustOptions(), rng)
    assert found.estimate.success and np.degrees(rotation_error(found.estimate.w, s.motion.w)) < 0.05
    assert np.degrees(translation_error(found.estimate.d, true_d(name, s))) < 1.0


def test_gravity_turns_with_the_camera_and_has_its_noise() -> None:
    s = trial(0)
    first, second = s.correspondences.gravity
    np.testing.assert_allclose(so3.exp(s.motion.w) @ first[1:], second[1:], atol=1e-14)
    angles = []
    for seed in range(40):
        noisy, exact = (trial(seed, pairs=0, gravity_noise_deg=g).correspondences.gravity for g in (0.5, 0.0))
        np.testing.assert_allclose(np.linalg.norm(noisy[:, 1:], axis=1), 1.0, atol=1e-14)
        angles.append(np.linalg.norm(np.cross(noisy[:, 1:], exact[:, 1:]), axis=1))
    # Two angles of 0.5 degrees each; the root of 160 squares is 6 % off.
    assert np.degrees(np.sqrt(np.mean(np.square(angles)))) == pytest.approx(0.5 * np.sqrt(2.0), rel=0.2)


def test_what_is_no_gravity_is_told_by_value() -> None:
    c, solver = trial(0).correspondences, load_solver("gs-upright-3pt")
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
