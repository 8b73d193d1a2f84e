"""Rolling-shutter absolute pose from six points."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from differences import derivatives
from solver_trials import (
    CAMERA,
    GLOBAL,
    RIG,
    SHUTTER,
    D,
    W,
    assert_second_order,
    errors_of_size,
    trial,
)

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.so3 import FloatArray
from rsbench.solvers.r6p import R6pSolver, Resection, RowPose, errors

SPIN, SPEED = np.array([-0.03, 0.04, 0.05]), np.array([0.1, 0.3, -0.2])
"""Within the frame, of no kin to the motion between them: the method ties nothing."""


def own_model(kind: str, count: int, seed: int, spin: FloatArray = SPIN) -> Correspondences:
    """Tracks of still points that a linearised camera sees in frame 1, at the first row of which it has (W, D)."""
    rng = np.random.default_rng(seed)
    pixels, depth = rng.uniform(150.0, 750.0, (count, 2)), rng.uniform(2.0, 10.0, (count, 1))
    X = depth * CAMERA.unproject(pixels) - RIG.offset("left")
    turned = X @ so3.exp(W).T if kind == "single" else X + np.cross(W, X)
    ends: dict[str, FloatArray] = {}
    for side in ("left", "right"):
        seen = pixels
        for _ in range(60):  # the pose depends on the row; each round is 20 times nearer
            s = SHUTTER.h * seen[:, 1:]
            P = turned + s * np.cross(spin, turned) + D + s * SPEED + RIG.offset(side)
            seen = CAMERA.project(P)
        ends[side] = seen
    shift = np.column_stack([CAMERA.fx * RIG.baseline / depth, 0.0 * depth])
    return Correspondences(tracks=np.hstack([pixels, pixels - shift, ends["left"], ends["right"]]))


@pytest.mark.parametrize("kind", ["double", "single"])
@pytest.mark.parametrize("count", [6, 40])
def test_the_pose_of_its_own_model_is_exact(kind: Literal["double", "single"], count: int) -> None:
    solver = R6pSolver(linearisation=kind, frame_0="still", refinement="none", start="still")
    found = []
    for seed in range(10):
        c = own_model(kind, count, seed)
        one = solver.estimate(c, RIG, SHUTTER)
        found.append([np.abs(one.w - W).max(), np.abs(one.d - D).max()])
    # Some samples of six amplify rounding ten thousandfold.
    assert np.max(found) < (1e-9 if count == 6 else 1e-11) and np.median(found) < 1e-12


@pytest.mark.parametrize("kind", ["double", "single"])
def test_samples_of_a_camera_that_turns_by_thirty_degrees_in_the_frame_are_exact(
    kind: Literal["double", "single"],
) -> None:
    spin = np.radians(30.0) / SHUTTER.readout_ratio * SPIN / np.linalg.norm(SPIN)
    solver = R6pSolver(linearisation=kind, frame_0="still", start="still", refinement="none")
    found = list[bool]()
    for seed in range(30):
        (one,) = solver.propose(own_model(kind, 6, seed, spin), RIG, SHUTTER)
        found.append(one.success and bool(max(np.abs(one.w - W).max(), np.abs(one.d - D).max()) < 1e-6))
    assert np.mean(found) > 0.8  # with v alone frozen 0.17 after six steps


@pytest.mark.parametrize(("kind", "frame_0"), [("double", "moved"), ("single", "moved"), ("double", "still")])
def test_half_the_motion_has_a_quarter_of_the_rotation_s_and_half_of_the_direction_s_error(
    kind: Literal["double", "single"], frame_0: Literal["moved", "still"]
) -> None:
    """What linearisations drop, and what a frame 0 that is taken as still moves, is of second order."""
    solver = R6pSolver(linearisation=kind, frame_0=frame_0, refinement="none")
    assert_second_order(solver, tracks=40)


def test_exact_rotations_and_a_moved_frame_0_leave_rounding() -> None:
    for kind in ("double", "single"):
        assert np.all(errors_of_size(R6pSolver(linearisation=kind), 1.0, tracks=40) < 1e-9)
    assert errors_of_size(R6pSolver(frame_0="still"), 1.0, tracks=40)[0] > 1e-4  # why frame 0 is moved


def test_derivatives_are_those_of_finite_differences() -> None:
    data = Resection.of(own_model("single", 10, 0).tracks, RIG, SHUTTER, ("left", "right"), True)
    start, X = RowPose(so3.exp(2.0 * W), D, SPIN, SPEED), data.points(W, D)

    def at(step: FloatArray) -> FloatArray:
        a, b, c, d = step.reshape(4, 3)
        return errors(data, RowPose(so3.exp(a) @ start.R, start.C + b, start.w + c, start.t + d), X)[0]

    # Errors of 100 px and second derivatives of 1e3 px: 1e-8 and 1e-9 px over the step.
    numeric = derivatives(at, np.zeros(12), 1e-6)
    np.testing.assert_allclose(errors(data, start, X)[1], numeric, rtol=1e-6, atol=1e-4)


def test_a_plane_leaves_a_pitch_a_rise_and_a_speed_along_the_axis_open() -> None:
    """To first order, at rest, facing it at Z: v_x moves the image by -1 - y^2, -x y, which a speed along the axis
    that grows with the row and a rise undo. Any other points tell them apart."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform(50.0, 850.0, (60, 2))
    Z, rows, y0 = 5.0, SHUTTER.h * CAMERA.fy, CAMERA.unproject(np.zeros(2))[1]
    open_ = np.array([1.0, 0.0, 0.0, 0.0, Z, -Z * y0, 0.0, 0.0, 0.0, 0.0, 0.0, -Z / rows])
    for depth, least in ((np.full(60, Z), 0.0), (rng.uniform(2.0, 10.0, 60), 0.01)):
        left = np.column_stack([CAMERA.fx * RIG.baseline / depth, 0.0 * depth])
        data = Resection.of(np.hstack([pixels, pixels - left] * 2), RIG, SHUTTER, ("left", "right"), True)
        rest = RowPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
        J = errors(data, rest, data.body)[1]
        share = float(np.linalg.norm(J @ open_) / np.linalg.norm(J * open_))
        assert share > least if least else share < 1e-12


def test_the_search_is_by_its_own_velocities() -> None:
    """A frame 1 of velocities of its own: no motion of constant velocity explains more than a few points."""
    c, rng = own_model("single", 60, 0), np.random.default_rng(0)
    wrong = c.tracks.copy()
    wrong[:24, 4:] += rng.uniform(-60.0, 60.0, (24, 4))
    found = R6pSolver(frame_0="still").estimate(Correspondences(tracks=wrong), RIG, SHUTTER)
    right = R6pSolver(frame_0="still").estimate(Correspondences(tracks=wrong[24:]), RIG, SHUTTER)
    np.testing.assert_allclose(np.concatenate([found.w, found.d]), [*right.w, *right.d], atol=1e-6)


def test_without_readout_it_is_absolute_pose_and_little_is_told_by_value() -> None:
    s = trial(1, degrees=np.degrees(0.03), shutter=GLOBAL, tracks=20)
    c, found = s.correspondences, R6pSolver().estimate(s.correspondences, RIG, GLOBAL)
    np.testing.assert_allclose(np.concatenate([found.w, found.d]), [*s.motion.w, *s.motion.d], atol=1e-9)
    far = Correspondences(tracks=c.tracks[:, [2, 3, 0, 1, 6, 7, 4, 5]])
    assert "positive disparity" in R6pSolver().estimate(far, RIG, GLOBAL).reason
    same = Correspondences(tracks=c.tracks[[0] * 6])
    assert "open" in R6pSolver().estimate(same, RIG, GLOBAL).reason
