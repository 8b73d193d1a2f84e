"""Generalised essential matrices, twelve parameters and affine frames, each on the motion that it assumes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from commands import run_here
from differences import derivatives
from solver_trials import CAMERA, RIG, SHUTTER, D, W, assert_second_order, errors_of_size

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import in_front
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.projection import back_project, rs_project
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray, hat
from rsbench.pipeline.problem import EXAMPLE, parse_problem, problem_record, read_problem
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.free_velocities import (
    AffineSolver,
    DaiSolver,
    FreeMotion,
    Rows,
    TwelveParameterSolver,
    coefficients,
    equations,
    errors,
    extract,
    from_row,
    jets,
    signed,
    system,
)
from rsbench.solvers.linear import null_vector
from rsbench.storage.files import load_matches


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


def sampson(motion: FreeMotion, rows: Rows) -> FloatArray:
    return errors(motion, rows)[0]


def constraint(motion: FreeMotion, matches: FloatArray) -> FloatArray:
    """y^T [T]x R x (n,)."""
    rows = Rows.of(matches, CAMERA, CAMERA.cy)
    R, T = motion.between(rows.s0, rows.s1)
    return np.einsum("ni,ni->n", rows.y, np.cross(T, np.einsum("nij,nj->ni", R, rows.x)))


def by_pixels(motion: FreeMotion, matches: FloatArray) -> FloatArray:
    """Derivatives (n, 4) of the constraint by central differences: of third order in a tenth of a pixel over f."""
    return derivatives(lambda moved: constraint(motion, moved), matches, 0.1)


def front(motion: FreeMotion, rows: Rows) -> int:
    """How many points lie in front of both cameras if T lies on the side of t."""
    R, T = motion.between(rows.s0, rows.s1)
    return int(np.count_nonzero(in_front(Pose(R, T * np.sign(T @ motion.t)[:, None]), rows.x, rows.y)))


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
    np.testing.assert_allclose(system(rows.x, rows.y, degree) @ coefficients(m, degree)[0], values, atol=1e-14)
    assert coefficients(m, degree)[0].shape == ({1: 21, 2: 45}[degree],)


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
        assert max(off(extract(-2.0 * coefficients(truth, 2)[0], 2)[0], truth)) < 1e-9


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


STEREO = RIG.about("left")
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
    assert_second_order(DaiSolver(), seeds=5, rig=STEREO, pairs=100)


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
        assert count == 30 == front(right, rows) and right.t @ t > 0.0
        assert front(right.flipped(), rows) == 0


def test_gradient_is_that_of_finite_differences() -> None:
    """To first order in the errors: those here are a hundredth of a pixel."""
    m = free_motion(0.1)
    matches = matches_of(m, 20) + 0.01 * np.random.default_rng(0).standard_normal((20, 4))
    rows = Rows.of(matches, CAMERA, CAMERA.cy)
    numeric = derivatives(lambda step: 0.5 * np.sum(sampson(m.moved(step), rows) ** 2), np.zeros(18), 1e-6)
    r, J = errors(m, rows)
    np.testing.assert_allclose(J.T @ r, numeric, atol=2e-3 * np.max(np.abs(numeric)))
    sampson_errors = constraint(m, matches) / np.linalg.norm(by_pixels(m, matches), axis=1)
    np.testing.assert_allclose(r, sampson_errors, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("degree", [1, 2])
def test_derivatives_of_the_coefficients_are_those_of_differences(degree: int) -> None:
    m = free_motion(0.1 * (degree - 1))
    numeric = derivatives(lambda step: coefficients(m.moved(step), degree)[0], np.zeros(6 + 6 * degree), 1e-6)
    np.testing.assert_allclose(coefficients(m, degree)[1][: 6 + 6 * degree], numeric.T, atol=1e-9)


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


def simulation(size: float = 1.0, seed: int = 0, pairs: int = 7, **noise: float) -> Simulation:
    options = SimulationOptions(pairs=pairs, affine=True, **noise)  # pyrefly: ignore[bad-argument-type]
    return simulate(STEREO, SHUTTER, LinearMotion(size * W, size * D), options, np.random.default_rng(seed))


def left(s: Simulation) -> Correspondences:
    return replace(s.correspondences, right=np.zeros((0, 4)))


def test_simulated_frames_are_those_of_planes_by_finite_differences() -> None:
    """Each column of A is where frame 1 sees the next pixel's point, at some depth.

    A change of depth moves it along a known line, so what is left across that line is zero; some plane has any
    two such columns.
    """
    s = simulation(2.0, pairs=30)
    c = s.correspondences
    A = c.affine.reshape(-1, 2, 2)

    def seen(pixels: FloatArray, inverse: FloatArray) -> FloatArray:
        """Where frame 1 sees what frame 0 sees at pixels, at an inverse depth."""
        points = back_project(STEREO, SHUTTER, s.motion, "left", 0, pixels, 1.0 / inverse)
        return rs_project(STEREO, SHUTTER, s.motion, "left", 1, points).pixels

    start, end = c.left[:, :2], c.left[:, 2:]
    inverse, along = np.full(len(start), 0.2), np.zeros((len(start), 2))
    for _ in range(8):  # Newton's steps to where frame 1 sees the match
        along = (seen(start, inverse + 1e-6) - seen(start, inverse - 1e-6)) / 2e-6
        inverse += np.sum((end - seen(start, inverse)) * along, axis=1) / np.sum(along**2, axis=1)
    np.testing.assert_allclose(seen(start, inverse), end, atol=1e-6)
    # What a change of depth along a step makes: along the epipolar line.
    left_over = A - derivatives(lambda pixels: seen(pixels, inverse), start, 1e-4)
    across = left_over[:, 0] * along[:, 1:] - left_over[:, 1] * along[:, :1]
    np.testing.assert_allclose(across / np.linalg.norm(along, axis=1, keepdims=True), 0.0, atol=1e-6)
    assert np.all(np.max(np.abs(left_over), axis=(0, 1)) > 1e-3)


def test_noise_of_frames_is_a_share_of_their_size() -> None:
    exact, noisy = (simulation(pairs=400, affine_noise=noise).correspondences for noise in (0.0, 0.1))
    np.testing.assert_array_equal(noisy.left, exact.left)
    size = np.sqrt(0.5 * np.sum(exact.affine**2, axis=1, keepdims=True))
    assert np.std((noisy.affine - exact.affine) / size) == pytest.approx(0.1, rel=0.08)  # 1600 of them: 3 sigma
    with_none = simulate(
        STEREO, SHUTTER, LinearMotion(W, D), SimulationOptions(pairs=9), np.random.default_rng(0)
    ).correspondences
    np.testing.assert_array_equal(with_none.left, simulation(pairs=9).correspondences.left)
    assert len(with_none.affine) == 0


def test_equations_are_the_derivatives_of_the_constraint() -> None:
    """Values and columns at rest, against ``constraint`` and its total derivative by the pixels."""
    c = simulation(pairs=12).correspondences
    rows = Rows.of(np.hstack([c.left, c.affine]), CAMERA, CAMERA.cy)
    R, t = so3.exp(np.array([0.1, -0.2, 0.05])), np.array([0.6, 0.0, 0.8])
    value, J = equations(R, t, *jets(rows, 3.0))
    A, still = c.affine.reshape(-1, 2, 2), FreeMotion(R, t, *np.zeros((4, 3)))

    def expected(motion: FreeMotion) -> FloatArray:
        f, gradient = constraint(motion, c.left), by_pixels(motion, c.left)
        return np.column_stack([f, 3.0 * (gradient[:, :2] + (gradient[:, None, 2:] @ A)[:, 0])])

    np.testing.assert_allclose(value, expected(still), atol=1e-12)
    numeric = derivatives(lambda step: expected(still.moved(step)), np.zeros(18), 1e-6)
    np.testing.assert_allclose(J, numeric, atol=1e-8)


def affine_errors(solver: AffineSolver, size: float, pairs: int) -> FloatArray:
    return errors_of_size(solver, size, seeds=15, rig=STEREO, pairs=pairs, affine=True)


def test_half_the_motion_has_an_eighth_of_the_rotation_s_and_a_quarter_of_the_direction_s_error() -> None:
    """Of second order in the velocities, relative to the motion."""
    solver = AffineSolver(refinement="none")
    for pairs in (7, 30):
        ratio = affine_errors(solver, 1.0, pairs) / affine_errors(solver, 0.5, pairs)
        np.testing.assert_allclose(ratio, [8.0, 4.0], rtol=0.3)
    assert np.all(affine_errors(solver, 1.0, 7) < [1e-5, 1e-4])


@pytest.mark.parametrize("size", [4.0, 1.0])
def test_the_descent_from_affine_frames_is_exact_on_the_paper_s_motion(size: float) -> None:
    assert np.all(affine_errors(AffineSolver(), size, 100) < [1e-9, 1e-8])


def test_the_robust_search_draws_matches_with_their_frames() -> None:
    """Tracks beside them have no frames and are left alone."""
    s = simulation(pairs=80, noise_px=0.1, affine_noise=0.02, outlier_ratio=0.3)
    extra = simulate(
        STEREO, SHUTTER, s.motion, SimulationOptions(tracks=10), np.random.default_rng(5)
    ).correspondences
    given = replace(s.correspondences, tracks=extra.tracks)
    options, rng = RobustOptions(max_iterations=200), np.random.default_rng(0)
    found = estimate_motion(given, STEREO, SHUTTER, load_solver("rs-12param-affine"), options, rng)
    assert rotation_error(found.estimate.w, W) < 0.01 and translation_error(found.estimate.d, D) < 0.2
    assert found.counts["left"].matches == 80 and found.counts["tracks"].matches == 0
    assert found.inliers["left"].shape == (80,) and not np.any(found.inliers["tracks"])
    good = ~s.outliers["left"]
    assert np.mean(found.inliers["left"][good]) > 0.7 and np.mean(found.inliers["left"][~good]) < 0.2


def test_without_frames_it_fails_by_value() -> None:
    s = simulation(pairs=40)
    bare = Correspondences(left=s.correspondences.left)
    assert "0 affine frames of left matches, need 7" in AffineSolver().estimate(bare, STEREO, SHUTTER).reason
    assert all(not motion.success for motion in AffineSolver().propose(bare, STEREO, SHUTTER))
    robust = estimate_motion(
        bare,
        STEREO,
        SHUTTER,
        load_solver("rs-12param-affine"),
        RobustOptions(),
        np.random.default_rng(0),
    )
    assert "too few left matches with affine frames: 0, a sample needs 7" in robust.estimate.reason
    assert robust.iterations == 0 and robust.inliers["left"].shape == (40,)


def test_a_problem_holds_affine_frames() -> None:
    record = problem_record(read_problem(EXAMPLE))
    frames = [[1.0, 0.1, 0.0, 0.9]] * len(record["left"])
    parsed = parse_problem(json.dumps(record | {"affine": frames}), "here")
    np.testing.assert_array_equal(parsed.correspondences.affine, frames)
    with pytest.raises(RsbenchError, match=r"affine\[0\] = \[1.0\]: must be 4 numbers: dx1/dx0"):
        parse_problem(json.dumps(record | {"affine": [[1.0]]}), "here")
    with pytest.raises(RsbenchError, match="here: affine has 1 rows and left"):
        parse_problem(json.dumps(record | {"affine": frames[:1]}), "here")


def test_evaluate_gives_it_the_frames_of_a_matcher_that_has_them(smoke_dataset: Path, tmp_path: Path) -> None:
    run = run_here(
        *("-q", "evaluate", smoke_dataset, "--out", tmp_path / "out"),
        *("--features", "sift-affine", "--solver", "rs-12param-affine"),
    )
    assert run.returncode == 0, run.stderr
    for folder in (tmp_path / "out/predictions").iterdir():
        matches = load_matches(folder / "matches.npz")
        assert len(matches.affine) == len(matches.left) > 0
        (record,) = (json.loads(path.read_text()) for path in (folder / "motion").glob("rs-12param-affine.json"))
        assert record["success"], record["reason"]
