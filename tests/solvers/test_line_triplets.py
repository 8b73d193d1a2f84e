"""Stereo relative pose from points and straight lines in three of four images."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.solvers.engine.base import load_solver, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.triplets import (
    PATTERNS,
    Features,
    LineErrors,
    LineTripletSolver,
    line_rays,
    newton,
    stereo_ends,
    usable_lines,
)

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)
SOLVER = LineTripletSolver()


def trial(
    seed: int, tracks: int, lines: int, noise_px: float = 0.0, outlier_ratio: float = 0.0, size: float = 1.0
) -> Simulation:
    motion = random_motion(np.random.default_rng(seed), np.radians(2.0 * size), 0.3 * size)
    options = SimulationOptions(tracks=tracks, lines=lines, noise_px=noise_px, outlier_ratio=outlier_ratio)
    return simulate(RIG, GLOBAL, motion, options, np.random.default_rng(seed))


def steep(s: Simulation, count: int) -> Correspondences:
    """With the first lines that have depth."""
    lines = s.correspondences.lines
    return replace(s.correspondences, lines=lines[usable_lines(lines, RIG)][:count])


def errors(w: FloatArray, d: FloatArray, s: Simulation) -> tuple[float, float]:
    return float(np.degrees(rotation_error(w, s.motion.w))), float(np.degrees(translation_error(d, s.motion.d)))


@pytest.mark.parametrize(("tracks", "lines"), [(3, 0), (2, 1), (1, 2), (0, 3)])
def test_three_exact_features_of_any_kind_give_the_motion(tracks: int, lines: int) -> None:
    found = list[float]()
    for seed in range(30):
        s = trial(seed, tracks, 12)
        estimate = SOLVER.estimate(steep(s, lines), RIG, GLOBAL)
        found.append(max(np.abs(estimate.w - s.motion.w).max(), np.abs(estimate.d - s.motion.d).max()))
    # Rounding; another root, or none, in few.
    assert np.mean(np.array(found) < 1e-9) >= 0.9 and np.median(found) < 1e-12


@pytest.mark.parametrize(("size", "least"), [(1.0, 0.9), (2.5, 0.75)])
def test_minimal_samples_find_the_motion_from_none(size: float, least: float) -> None:
    """Each pattern of third images, three lines and mixed: the share that ends at the truth."""
    found = list[float]()
    for seed, lines in itertools.product(range(15), (1, 3)):
        s = trial(seed, 3 - lines, 16, size=size)
        c = steep(s, lines)
        features = Features.of(c.tracks, c.lines, RIG)
        for views in PATTERNS:
            pose = newton(features.triplets(np.arange(3), views, RIG))
            found.append(float(np.abs(pose.R - s.motion.body_from_world(1.0).R).max()))
    assert np.mean(np.array(found) < 1e-9) >= least


def test_stereo_gives_points_of_the_true_line() -> None:
    """Against projection by the camera's own model: both points lie on the line in each image."""
    s = trial(0, 0, 40)
    lines = steep(s, 40).lines
    ends = stereo_ends(line_rays(lines, RIG), RIG)
    pose = s.motion.body_from_world(1.0)
    for frame, k in itertools.product((0, 1), (0, 1)):
        X = ends[:, 0] @ pose.R.T + pose.t if frame else ends[:, 0]
        image = RIG.camera.project(X + RIG.offset(("left", "right")[k]))
        a, b = np.moveaxis(lines[:, 8 * frame + 4 * k : 8 * frame + 4 * k + 4].reshape(-1, 2, 2), 1, 0)
        u = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        off = (image - a[:, None]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        assert np.abs(np.sum(off * u[:, None], axis=-1)).max() < 1e-8


def test_errors_of_a_line_are_those_of_the_best_line() -> None:
    """Against SciPy's search over two points in space."""
    s = trial(4, 0, 8, noise_px=0.5)
    lines = steep(s, 3).lines
    w, d = s.motion.w * 1.02, s.motion.d * 0.98
    squares = LineErrors.of(lines, RIG).squares(w, d, steps=8)
    R = so3.exp(w)
    for line, square in zip(lines, squares, strict=True):
        start = stereo_ends(line_rays(line[None], RIG), RIG)[0, 0]
        seen = line.reshape(2, 2, 2, 2)

        def distances(x: FloatArray, seen: FloatArray = seen) -> FloatArray:
            out = list[float]()
            for frame, side in itertools.product((0, 1), (0, 1)):
                X = x.reshape(2, 3) @ R.T + d if frame else x.reshape(2, 3)
                a, b = RIG.camera.project(X + RIG.offset(("left", "right")[side]))
                u = (b - a) / np.linalg.norm(b - a)
                out += [u[0] * (p - a)[1] - u[1] * (p - a)[0] for p in seen[frame, side]]
            return np.array(out)

        best = least_squares(distances, start.ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert square == pytest.approx(2.0 * best.cost, rel=1e-6)


def test_with_points_alone_it_is_the_solver_of_points() -> None:
    points, rng = load_solver("gs-stereo-triplets"), np.random.default_rng(0)
    for seed in range(6):
        s = trial(seed, 100, 0, 0.3, 0.3)
        one = estimate_motion(s.correspondences, RIG, GLOBAL, points, RobustOptions(), rng).estimate
        same = LineTripletSolver(threshold_px=RobustOptions().threshold_px)
        two = estimate_motion(s.correspondences, RIG, GLOBAL, same, RobustOptions(), rng, "own").estimate
        # A fiftieth of the noise's error: either may keep a match at the threshold.
        assert rotation_error(one.w, two.w) < np.radians(2e-3) and translation_error(one.d, two.d) < np.radians(
            0.02
        )


def test_lines_help_points_and_do_alone() -> None:
    kinds: dict[str, list[tuple[float, float]]] = {"points": [], "lines": [], "both": []}
    for seed in range(12):
        s = trial(seed, 30, 30, 0.3, 0.3)
        c = s.correspondences
        for kind, given in (
            ("points", replace(c, lines=c.lines[:0])),
            ("lines", replace(c, tracks=c.tracks[:0])),
            ("both", c),
        ):
            found = SOLVER.estimate(given, RIG, GLOBAL)
            kinds[kind].append(errors(found.w, found.d, s))
    mean = {kind: np.sqrt(np.mean(np.square(each), axis=0)) for kind, each in kinds.items()}
    assert np.all(mean["both"] < mean["points"]) and np.all(mean["both"] < mean["lines"])
    assert np.all(mean["lines"] < [0.1, 1.5])


def test_noise_of_lines_other_than_that_of_points_is_weighed() -> None:
    """Points ten times as exact: lines must not spoil them."""
    apart = []
    for seed in range(8):
        s, noisy = trial(seed, 60, 60, 0.05), trial(seed, 60, 60, 0.5)
        c = replace(s.correspondences, lines=noisy.correspondences.lines)
        both, alone = (SOLVER.estimate(g, RIG, GLOBAL) for g in (c, replace(c, lines=c.lines[:0])))
        apart.append((errors(both.w, both.d, s)[0], errors(alone.w, alone.d, s)[0]))
    both_error, alone_error = np.sqrt(np.mean(np.square(apart), axis=0))
    assert both_error < 1.1 * alone_error


def test_order_and_ends_mean_nothing() -> None:
    s = trial(2, 20, 40, 0.3, 0.2)
    c, rng = s.correspondences, np.random.default_rng(1)
    swapped = c.lines.reshape(-1, 4, 2, 2).copy()
    swapped[::2, 1] = swapped[::2, 1, ::-1]
    swapped[1::3, 2] = swapped[1::3, 2, ::-1]
    other = replace(c, tracks=rng.permutation(c.tracks), lines=rng.permutation(swapped.reshape(-1, 16)))
    one, two = (SOLVER.estimate(g, RIG, GLOBAL) for g in (c, other))
    np.testing.assert_allclose(np.concatenate([one.w, one.d]), np.concatenate([two.w, two.d]), atol=1e-7)


def test_lines_without_depth_are_left_out_and_too_few_are_a_failure() -> None:
    x = np.linspace(100.0, 800.0, 10)
    flat = np.tile(np.stack([x, x, x + 50.0, x + 2.0], axis=1), (1, 4))
    assert not np.any(usable_lines(flat, RIG))
    for lines in (flat, np.zeros((5, 16)), np.zeros((0, 16))):
        found = SOLVER.estimate(Correspondences(lines=lines), RIG, GLOBAL)
        assert not found.success and "0 lines with depth, need 3" in found.reason
    s = trial(1, 60, 20)
    mixed = replace(s.correspondences, lines=np.concatenate([flat, s.correspondences.lines]))
    found = SOLVER.estimate(mixed, RIG, GLOBAL)
    assert max(errors(found.w, found.d, s)) < 1e-6


def test_parallel_lines_leave_the_motion_open() -> None:
    """Verticals say nothing of a shift along them."""
    rng = np.random.default_rng(3)
    X = np.column_stack([rng.uniform(-2, 2, 30), np.zeros(30), rng.uniform(3, 8, 30)])
    motion = trial(0, 3, 0).motion
    pose, ends = motion.body_from_world(1.0), list[FloatArray]()
    for frame, side in itertools.product((0, 1), ("left", "right")):
        for y in (-1.0, 1.0):
            P = X + np.array([0.0, y, 0.0])
            P = P @ pose.R.T + pose.t if frame else P
            ends.append(RIG.camera.project(P + RIG.offset("left" if side == "left" else "right")))
    lines = np.concatenate(ends, axis=1)
    found = SOLVER.estimate(Correspondences(lines=lines), RIG, GLOBAL)
    assert not found.success and "leave the motion open" in found.reason
    told = 0
    for seed in range(10):
        noisy = lines[:10] + 0.3 * np.random.default_rng(seed).standard_normal((10, 16))
        found = SOLVER.estimate(Correspondences(lines=noisy), RIG, GLOBAL)
        told += not (found.success and found.direction_known)
        assert found.success == np.all(np.isfinite(found.d)) and found.direction_known == (not found.reason)
    assert told >= 5  # noise bends the lines apart, by which the others believe their shift


def test_random_lines_have_no_consensus() -> None:
    lines = np.random.default_rng(0).uniform(0.0, 899.0, (60, 16))
    found = SOLVER.estimate(Correspondences(lines=lines), RIG, GLOBAL)
    assert not found.success and found.reason


def test_lines_pass_the_lens_the_loop_and_the_runner() -> None:
    """A camera with a lens: the lines are those of the distorted images' ends."""
    s = trial(5, 40, 40)
    lens = replace(RIG.camera, lens=Lens(model="brown-conrady", k1=-0.1))
    rig = StereoRig(camera=lens, baseline=0.6)
    bent = {
        name: lens.lens_pixels(rows.reshape(len(rows), -1, 2)).reshape(rows.shape)
        for name, rows in (("tracks", s.correspondences.tracks), ("lines", s.correspondences.lines))
    }
    seen = Correspondences(**{name: rows[np.all(np.isfinite(rows), axis=1)] for name, rows in bent.items()})
    np.testing.assert_allclose(without_lens(seen, lens).lines, s.correspondences.lines, atol=1e-6)
    entry, rng = load_solver_entry("gs-stereo-triplets-lines"), np.random.default_rng(0)
    with SolverRunner() as runner:
        for given in (seen, Correspondences(lines=seen.lines)):
            found = runner.robust(entry, given, rig, GLOBAL, RobustOptions(), rng).estimate
            assert found.success and max(errors(found.w, found.d, s)) < 1e-5


@pytest.mark.parametrize("wrong", [{"threshold_px": 0.0}, {"confidence": 1.0}, {"max_iterations": 3}])
def test_parameters_that_no_search_can_have_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LineTripletSolver(**wrong)  # pyrefly: ignore[bad-argument-type]
