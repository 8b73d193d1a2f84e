"""Affine correspondences: their frames, the equations, and the solver of seven of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run_here

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.projection import back_project, rs_project
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.problem import EXAMPLE, parse_problem, problem_record, read_problem
from rsbench.solvers.engine.base import load_solver
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.free_velocities import AffineSolver, FreeMotion, Rows, constraint, equations, jets
from rsbench.storage.files import load_matches

CAMERA = PinholeCamera.centred(900, 900, 810.0)
RIG = StereoRig(camera=CAMERA, baseline=0.6).about("left")
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)
W, D = np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18])


def simulation(size: float = 1.0, seed: int = 0, pairs: int = 7, **noise: float) -> Simulation:
    options = SimulationOptions(pairs=pairs, affine=True, **noise)  # pyrefly: ignore[bad-argument-type]
    return simulate(RIG, SHUTTER, LinearMotion(size * W, size * D), options, np.random.default_rng(seed))


def left(s: Simulation) -> Correspondences:
    return replace(s.correspondences, right=np.zeros((0, 4)))


def test_simulated_frames_are_those_of_planes_by_finite_differences() -> None:
    """Each column of A is where frame 1 sees the next pixel's point, at some depth.

    A change of depth moves it along a known line, so what is left across that line is zero; some plane has any
    two such columns.
    """
    s, h = simulation(2.0, pairs=30), 1e-4
    c = s.correspondences
    A = c.affine.reshape(-1, 2, 2)

    def seen(pixels: FloatArray, inverse: FloatArray) -> FloatArray:
        """Where frame 1 sees what frame 0 sees at pixels, at an inverse depth."""
        points = back_project(RIG, SHUTTER, s.motion, "left", 0, pixels, 1.0 / inverse)
        return rs_project(RIG, SHUTTER, s.motion, "left", 1, points).pixels

    start, end = c.left[:, :2], c.left[:, 2:]
    inverse, along = np.full(len(start), 0.2), np.zeros((len(start), 2))
    for _ in range(8):  # Newton's steps to where frame 1 sees the match
        along = (seen(start, inverse + 1e-6) - seen(start, inverse - 1e-6)) / 2e-6
        inverse += np.sum((end - seen(start, inverse)) * along, axis=1) / np.sum(along**2, axis=1)
    np.testing.assert_allclose(seen(start, inverse), end, atol=1e-6)
    for k, step in enumerate(h * np.eye(2)):
        flat = (seen(start + step, inverse) - seen(start - step, inverse)) / (2.0 * h)
        left_over = A[:, :, k] - flat  # what a change of depth along the step makes: along the epipolar line
        across = left_over[:, 0] * along[:, 1] - left_over[:, 1] * along[:, 0]
        np.testing.assert_allclose(across / np.linalg.norm(along, axis=1), 0.0, atol=1e-6)
        assert np.max(np.abs(left_over)) > 1e-3


def test_frames_of_a_plane_are_those_of_its_homography() -> None:
    """Of a global shutter: R + d n^T of the plane n.X = 1 that ``shape`` promises, by differences."""
    options, still = SimulationOptions(pairs=40, affine=True, shape="plane"), replace(SHUTTER, readout_ratio=0.0)
    c = simulate(RIG, still, LinearMotion(W, D), options, np.random.default_rng(0)).correspondences
    H, h = so3.exp(W) + np.outer(D, [0.05, -0.2 / 6.0, 1.0 / 6.0]), 1e-4

    def moved(pixels: FloatArray) -> FloatArray:
        return CAMERA.project(CAMERA.unproject(pixels) @ H.T)

    start, end = c.left[:, :2], c.left[:, 2:]
    np.testing.assert_allclose(moved(start), end, atol=1e-9)
    columns = [(moved(start + step) - moved(start - step)) / (2.0 * h) for step in h * np.eye(2)]
    np.testing.assert_allclose(c.affine.reshape(-1, 2, 2), np.stack(columns, axis=-1), atol=1e-7)


def test_noise_of_frames_is_a_share_of_their_size() -> None:
    exact, noisy = (simulation(pairs=400, affine_noise=noise).correspondences for noise in (0.0, 0.1))
    np.testing.assert_array_equal(noisy.left, exact.left)
    size = np.sqrt(0.5 * np.sum(exact.affine**2, axis=1, keepdims=True))
    assert np.std((noisy.affine - exact.affine) / size) == pytest.approx(0.1, rel=0.08)  # 1600 of them: 3 sigma
    with_none = simulate(
        RIG, SHUTTER, LinearMotion(W, D), SimulationOptions(pairs=9), np.random.default_rng(0)
    ).correspondences
    np.testing.assert_array_equal(with_none.left, simulation(pairs=9).correspondences.left)
    assert len(with_none.affine) == 0


def test_equations_are_the_derivatives_of_the_constraint() -> None:
    """Values and columns at rest, against ``constraint`` and its total derivative by the pixels."""
    c = simulation(pairs=12).correspondences
    rows = Rows.of(np.hstack([c.left, c.affine]), CAMERA, CAMERA.cy)
    R, t = so3.exp(np.array([0.1, -0.2, 0.05])), np.array([0.6, 0.0, 0.8])
    value, J = equations(R, t, *jets(rows, 3.0))
    A, still, h = c.affine.reshape(-1, 2, 2), FreeMotion(R, t, *np.zeros((4, 3))), 1e-6

    def told(motion: FreeMotion) -> FloatArray:
        f, gradient = constraint(motion, rows)
        return np.column_stack([f, 3.0 * (gradient[:, :2] + (gradient[:, None, 2:] @ A)[:, 0])])

    np.testing.assert_allclose(value, told(still), atol=1e-13)
    for k, step in enumerate(h * np.eye(18)):
        numeric = (told(still.moved(step)) - told(still.moved(-step))) / (2.0 * h)
        np.testing.assert_allclose(J[..., k], numeric, atol=1e-8)


def errors(solver: AffineSolver, size: float, pairs: int) -> FloatArray:
    each = []
    for seed in range(15):
        found = solver.estimate(left(simulation(size, seed, pairs)), RIG, SHUTTER)
        assert found.success
        each.append((rotation_error(found.w, size * W), translation_error(found.d, D)))
    return np.median(each, axis=0)


def test_half_the_motion_has_an_eighth_of_the_rotation_s_and_a_quarter_of_the_direction_s_error() -> None:
    """Of second order in the velocities, relative to the motion."""
    solver = AffineSolver(refinement="none")
    for pairs in (7, 30):
        ratio = errors(solver, 1.0, pairs) / errors(solver, 0.5, pairs)
        np.testing.assert_allclose(ratio, [8.0, 4.0], rtol=0.3)
    assert np.all(errors(solver, 1.0, 7) < [1e-5, 1e-4])


@pytest.mark.parametrize("size", [4.0, 1.0])
def test_the_descent_is_exact_on_the_paper_s_motion(size: float) -> None:
    assert np.all(errors(AffineSolver(), size, 100) < [1e-9, 1e-8])


def test_samples_are_of_seven_and_have_two_motions_each() -> None:
    c, solver = left(simulation(pairs=60)), AffineSolver()
    assert solver.sample_sizes(c) == {"left": 7}
    rng, samples = np.random.default_rng(0), list[Correspondences]()
    for _ in range(6):
        chosen = rng.choice(60, 7, replace=False)
        samples.append(replace(c, left=c.left[chosen], affine=c.affine[chosen]))
    together = solver.propose_all(samples, RIG, SHUTTER)
    for sample, motions in zip(samples, together, strict=True):
        alone = solver.propose(sample, RIG, SHUTTER)
        for one, other in zip(alone, motions, strict=True):
            np.testing.assert_allclose([*one.w, *one.d], [*other.w, *other.d], atol=1e-12)
        assert rotation_error(alone[0].w, W) < 1e-4 < rotation_error(alone[1].w, W) < 0.02


def test_the_robust_search_draws_matches_with_their_frames() -> None:
    """Tracks beside them have no frames and are left alone."""
    s = simulation(pairs=80, noise_px=0.1, affine_noise=0.02, outlier_ratio=0.3)
    extra = simulate(
        RIG, SHUTTER, s.motion, SimulationOptions(tracks=10), np.random.default_rng(5)
    ).correspondences
    given = replace(s.correspondences, tracks=extra.tracks)
    options, rng = RobustOptions(max_iterations=200), np.random.default_rng(0)
    found = estimate_motion(given, RIG, SHUTTER, load_solver("rs-12param-affine"), options, rng)
    assert rotation_error(found.estimate.w, W) < 0.01 and translation_error(found.estimate.d, D) < 0.2
    assert found.counts["left"].matches == 80 and found.counts["tracks"].matches == 0
    assert found.inliers["left"].shape == (80,) and not np.any(found.inliers["tracks"])
    good = ~s.outliers["left"]
    assert np.mean(found.inliers["left"][good]) > 0.7 and np.mean(found.inliers["left"][~good]) < 0.2


def test_without_frames_it_fails_by_value() -> None:
    s = simulation(pairs=40)
    bare = Correspondences(left=s.correspondences.left)
    assert "0 affine frames of left matches, need 7" in AffineSolver().estimate(bare, RIG, SHUTTER).reason
    assert all(not motion.success for motion in AffineSolver().propose(bare, RIG, SHUTTER))
    robust = estimate_motion(
        bare, RIG, SHUTTER, load_solver("rs-12param-affine"), RobustOptions(), np.random.default_rng(0)
    )
    assert "0 left matches with affine frames, a sample needs 7" in robust.estimate.reason
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
