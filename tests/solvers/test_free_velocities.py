"""Dai's generalised essential matrices and the twelve-parameter correction, each on the motion that it assumes."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.free_velocities import (
    DaiSolver,
    FreeMotion,
    Rows,
    TwelveParameterSolver,
    coefficients,
    errors,
    extract,
    from_row,
    in_front_of_both,
    refine,
    sampson,
    sampson_jacobian,
    signed,
    system,
    with_derivatives,
)
from rsbench.solvers.linear import null_vector

CAMERA = PinholeCamera.centred(900, 900, 810.0)
RIG = StereoRig(camera=CAMERA, baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
W, D = np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18])


def free_motion(turn: float = 0.0, seed: int = 0) -> FreeMotion:
    """0.2 rad and 1 between the frames, 0.4 in the time of s = 1; turning by ``turn`` in it."""
    u = np.random.default_rng(seed).standard_normal((6, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return FreeMotion(so3.exp(0.2 * u[0]), u[1], 0.4 * u[2], 0.4 * u[3], turn * u[4], turn * u[5])


def matches_of(motion: FreeMotion, count: int, seed: int = 0) -> FloatArray:
    """Exact matches (n, 4) of a motion whose s = 0 is the middle row: each point moved from row to row."""
    rng = np.random.default_rng(seed)
    found: list[list[float]] = []
    while len(found) < count:
        x = np.array([*rng.uniform(-0.5, 0.5, 2), 1.0])
        X = so3.exp(-x[1] * motion.w0) @ (rng.uniform(2.0, 10.0) * x - x[1] * motion.v0)
        y = x
        for _ in range(100):
            Y = so3.exp(y[1] * motion.w1) @ (motion.R @ X) + motion.t + y[1] * motion.v1
            last, y = y, Y / Y[2]
            if abs(last[1] - y[1]) < 1e-16 or not abs(y[1]) < 0.55:
                break
        if Y[2] > 0.1 and np.all(np.abs(y[:2]) < 0.55) and abs(last[1] - y[1]) < 1e-15:
            found.append([*CAMERA.project(x), *CAMERA.project(y)])
    return np.array(found)


def off(found: FreeMotion, truth: FreeMotion) -> tuple[float, float]:
    """Errors of R and of the direction of t up to its sign, rad."""
    e_T = float(translation_error(found.t, truth.t))
    return float(so3.angle(found.R @ truth.R.T)), min(e_T, np.pi - e_T)


@pytest.mark.parametrize("degree", [1, 2])
def test_coefficients_are_those_of_the_polynomial_of_essential_matrices(degree: int) -> None:
    m = free_motion(0.1 * (degree - 1))
    rows = Rows.of(np.random.default_rng(1).uniform(0, 899, (30, 4)), CAMERA, CAMERA.cy)
    values = []
    for x, y in zip(rows.x, rows.y, strict=True):
        Q = (np.eye(3) + y[1] * hat(m.w1)) @ m.R @ (np.eye(3) - x[1] * hat(m.w0))
        values.append(y @ (hat(m.t + y[1] * m.v1) @ Q - Q @ hat(x[1] * m.v0)) @ x)
    np.testing.assert_allclose(system(rows.x, rows.y, degree) @ coefficients(m, degree), values, atol=1e-14)
    assert coefficients(m, degree).shape == ({1: 21, 2: 45}[degree],)


@pytest.mark.parametrize("count", [20, 100])
def test_the_linear_model_is_exact_from_twenty_matches(count: int) -> None:
    for seed in range(3):
        truth = free_motion(seed=seed)
        rows = Rows.of(matches_of(truth, count, seed), CAMERA, CAMERA.cy)
        F, _ = null_vector(system(rows.x, rows.y, 1), True)
        assert F is not None
        # Rounding of 1e-16 over the smallest singular value but one: 1e-5 of twenty matches, 1e-4 of a hundred.
        assert max(off(extract(F, 1)[0], truth)) < (1e-8 if count == 20 else 1e-10)


def test_the_uniform_model_is_read_off_its_own_coefficients() -> None:
    for seed in range(3):
        truth = free_motion(0.05, seed)
        assert max(off(extract(-2.0 * coefficients(truth, 2), 2)[0], truth)) < 1e-9


def test_half_the_turn_within_the_frames_has_half_of_the_uniform_model_s_error() -> None:
    """I + s [w]x is off a rotation by the square of the turn; but the singular value that tells it falls too."""
    errors = []
    for turn in (0.01, 0.005):
        each = []
        for seed in range(3):
            truth = free_motion(turn, seed)
            rows = Rows.of(matches_of(truth, 100, seed), CAMERA, CAMERA.cy)
            F, _ = null_vector(system(rows.x, rows.y, 2), True, 1e-14)
            assert F is not None
            each.append(off(extract(F, 2)[0], truth)[0])
        errors.append(np.median(each))
    assert errors[0] < 1e-3 and 1.5 < errors[0] / errors[1] < 3.0


@pytest.mark.parametrize("refinement", ["none", "sampson"])
def test_the_linear_solver_is_exact_on_its_own_model(refinement: Literal["none", "sampson"]) -> None:
    solver, truth = DaiSolver(refinement=refinement), free_motion()
    first = from_row(truth, -CAMERA.cy / CAMERA.fy)
    for count in (20, 60):
        matches = Correspondences(left=matches_of(truth, count))
        proposed = solver.propose(matches, RIG, SHUTTER) if count == 20 else []
        for found in [solver.estimate(matches, RIG, SHUTTER), *proposed]:
            # Rounding of 1e-16 over singular values of 1e-5; the sample's descent ends after 16 evaluations.
            assert rotation_error(found.w, so3.log(first.R)) < 1e-8
            assert translation_error(found.d, first.t) < 1e-8


UNIFORM = (DaiSolver(model="uniform"), TwelveParameterSolver())


def of_the_paper(size: float, noise_px: float = 0.0, seed: int = 0, pairs: int = 100) -> Correspondences:
    motion, options = LinearMotion(size * W, size * D), SimulationOptions(pairs=pairs, noise_px=noise_px)
    c = simulate(RIG.about("left"), SHUTTER, motion, options, np.random.default_rng(seed)).correspondences
    return Correspondences(left=c.left)


@pytest.mark.parametrize("solver", UNIFORM)
@pytest.mark.parametrize("size", [4.0, 1.0])
def test_the_descent_is_exact_on_the_paper_s_motion(
    solver: DaiSolver | TwelveParameterSolver, size: float
) -> None:
    found = solver.estimate(of_the_paper(size), RIG, SHUTTER)
    # The bound of free velocities is 0.02 and 0.2 rad per px, rounding 1e-11 px, and the end a billionth of C off.
    assert rotation_error(found.w, size * W) < 1e-9 and translation_error(found.d, D) < 1e-8


def test_half_the_motion_has_a_quarter_of_the_rotation_s_and_half_of_the_direction_s_error() -> None:
    """Of the linear model where the camera turns within its frames: in them it is off by half of the turn."""

    def errors_of(size: float) -> FloatArray:
        found = [DaiSolver().estimate(of_the_paper(size, seed=seed), RIG, SHUTTER) for seed in range(5)]
        each = [(rotation_error(one.w, size * W), translation_error(one.d, D)) for one in found]
        return np.median(each, axis=0)

    np.testing.assert_allclose(errors_of(0.5) / errors_of(0.25), [4.0, 2.0], rtol=0.25)


@pytest.mark.parametrize("solver", [DaiSolver(), *UNIFORM])
def test_noise_turns_neither_frame_1_nor_the_translation_round(solver: DaiSolver | TwelveParameterSolver) -> None:
    """At a constant velocity the length of T over that of t is lost in the noise, and so is its sign."""
    for size, seed in ((4.0, 0), (1.0, 1), (1.0, 2), (0.5, 3)):
        found = solver.estimate(of_the_paper(size, 0.3, seed), RIG, SHUTTER)
        # Of the bound, at most 4e-3 and 0.15 rad, five times as much; what turned round is off by 3.
        assert rotation_error(found.w, size * W) < 0.02 and translation_error(found.d, D) < 0.7


def test_points_vote_for_the_sign_of_t_where_t_passes_zero_within_the_image() -> None:
    t, w = D / np.linalg.norm(D), 0.02 * W
    still = FreeMotion(so3.exp(w), t, *np.zeros((4, 3)))
    rows = Rows.of(matches_of(still, 30), CAMERA, CAMERA.cy)
    # A factor 1 + 60 (s1 - s0) of T leaves every constraint as it is.
    wild = still._replace(v0=60.0 * still.R.T @ t, v1=60.0 * t)
    T = wild.between(rows.s0, rows.s1).t
    assert np.any(T @ t < 0.0) and np.any(T @ t > 0.0)
    np.testing.assert_allclose(sampson(wild, rows), 0.0, atol=1e-9)
    for motion in (still, wild, still.flipped(), wild.flipped()):
        right, count = signed(motion, rows)
        assert count == 30 == in_front_of_both(right, rows) and right.t @ t > 0.0
        assert in_front_of_both(right.flipped(), rows) == 0


def test_the_twin_has_the_same_errors_where_all_translations_are_along_one_line() -> None:
    still = FreeMotion(so3.exp(W), D / np.linalg.norm(D), *np.zeros((4, 3)))
    rows = Rows.of(matches_of(still, 30), CAMERA, CAMERA.cy)
    np.testing.assert_allclose(sampson(still.twin(), rows), 0.0, atol=1e-9)
    assert signed(still.twin(), rows)[1] == 0


def test_the_twelve_parameters_leave_an_error_of_first_order_in_the_velocities() -> None:
    """The essential matrix of all matches is none of the middle rows', and the correction does not touch it."""
    solver, errors = TwelveParameterSolver(refinement="none"), list[float]()
    for share in (1.0, 0.5):
        each = []
        for seed in range(6):
            m = free_motion(0.05, seed)
            m = m._replace(v0=share * m.v0, v1=share * m.v1, w0=share * m.w0, w1=share * m.w1)
            found = solver.linear(Rows.of(matches_of(m, 60, seed), CAMERA, CAMERA.cy))
            assert isinstance(found, list)
            each.append(off(found[0], m)[1])
        errors.append(np.median(each))
    assert 1.5 < errors[0] / errors[1] < 3.0


def test_gradient_is_that_of_finite_differences() -> None:
    """To first order in the errors: those here are a hundredth of a pixel."""
    m = free_motion(0.1)
    matches = matches_of(m, 20) + 0.01 * np.random.default_rng(0).standard_normal((20, 4))
    rows, steps = Rows.of(matches, CAMERA, CAMERA.cy), 1e-6 * np.eye(18)

    def cost(step: FloatArray) -> float:
        return 0.5 * float(np.sum(sampson(m.moved(step), rows) ** 2))

    numeric = [(cost(step) - cost(-step)) / 2e-6 for step in steps]
    analytic = sampson_jacobian(m, rows).T @ sampson(m, rows)
    np.testing.assert_allclose(analytic, numeric, atol=2e-3 * np.max(np.abs(numeric)))
    r, J = errors(m, rows)
    np.testing.assert_allclose(r, sampson(m, rows), atol=1e-9)
    np.testing.assert_allclose(J, sampson_jacobian(m, rows), atol=1e-9 * np.max(np.abs(J)))


@pytest.mark.parametrize("degree", [1, 2])
def test_derivatives_of_the_coefficients_are_those_of_differences(degree: int) -> None:
    m, h = free_motion(0.1 * (degree - 1)), 1e-6
    steps = h * np.eye(18)[: 6 + 6 * degree]
    numeric = [(coefficients(m.moved(e), degree) - coefficients(m.moved(-e), degree)) / (2.0 * h) for e in steps]
    np.testing.assert_allclose(with_derivatives(m, degree)[1][: len(steps)], numeric, atol=1e-9)


@pytest.mark.parametrize("turning", [False, True])
def test_the_descent_ends_where_no_step_is_better(turning: bool) -> None:
    """Of what it says it minimises, by steps of a hundredth of a standard deviation and more."""
    m = free_motion(0.1 * turning)
    matches = matches_of(m, 60) + 0.1 * np.random.default_rng(0).standard_normal((60, 4))
    rows = Rows.of(matches, CAMERA, CAMERA.cy)

    def cost(motion: FreeMotion) -> float:
        motion = motion.of_unit_length()
        fast = float(np.sum(motion.v0**2 + motion.v1**2)) * (CAMERA.height / CAMERA.fy) ** 2 / 60
        return float(np.sum(sampson(motion, rows) ** 2)) * (1.0 + fast)

    end, least = refine(m.at_rest(), rows, turning=turning, most=100)
    assert cost(end) == pytest.approx(least, rel=1e-12)
    for step in 1e-4 * np.random.default_rng(1).standard_normal((40, 18 if turning else 12)):
        assert cost(end.moved(step)) > least


def test_sampson_errors_vanish_on_exact_matches_and_are_distances_else() -> None:
    m = free_motion(0.1)
    matches = matches_of(m, 30)
    assert np.max(np.abs(sampson(m, Rows.of(matches, CAMERA, CAMERA.cy)))) < 1e-9
    noisy = matches + 0.1 * np.random.default_rng(0).standard_normal(matches.shape)
    # One of four normal components: their mean square is the noise's, of thirty within 2.6 standard deviations.
    squares = sampson(m, Rows.of(noisy, CAMERA, CAMERA.cy)) ** 2
    assert np.mean(squares) == pytest.approx(0.01, rel=0.67)


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_another_row_to_start_from_is_the_same_motion(turn: float) -> None:
    m, s = free_motion(turn), np.linspace(-0.5, 0.5, 5)
    old, new = m.between(s, s[::-1]), from_row(m, -0.5).between(s + 0.5, s[::-1] + 0.5)
    # Exact where the camera does not turn; else velocities change within the frame, by the turn times themselves.
    np.testing.assert_allclose(new.R, old.R, atol=1e-12 + 0.3 * turn**2 + 0.0)
    np.testing.assert_allclose(new.t, old.t, atol=1e-12 + 2.0 * turn)


def test_without_readout_or_with_too_few_matches_they_fail_by_value() -> None:
    few = Correspondences(left=matches_of(free_motion(), 43))
    assert "43 left matches, need 44" in DaiSolver(model="uniform").estimate(few, RIG, SHUTTER).reason
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (60, 3)) * [3.0, 3.0, 0.0] + [0.0, 0.0, 6.0]  # on a plane
    pixels = [CAMERA.project(points @ so3.exp(turn * W).T + turn * D) for turn in (0.0, 1.0)]
    found = DaiSolver().estimate(Correspondences(left=np.hstack(pixels)), RIG, SHUTTER)
    assert not found.success and "more than one solution" in found.reason
