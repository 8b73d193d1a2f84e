"""Simulated correspondences against the exact geometry of the core, and their noise against its statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from solver_trials import RIG, SHUTTER, matches_of

from rsbench.benchmark.simulated import simulation
from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import LinearMotion, make_motion
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.motion import Motion
from rsbench.core.projection import ProjectionStatus, back_project, rs_project
from rsbench.core.rig import SIDES
from rsbench.core.shutter import RollingShutter

MOTION = LinearMotion(w=np.deg2rad([0.8, -1.5, 1.0]), d=np.array([0.2, -0.1, 0.25]))


@pytest.mark.parametrize("model", ["linear", "twist", "accelerated", "spline"])
def test_without_noise_all_matches_satisfy_the_exact_constraint(model: str) -> None:
    motion = make_motion(model, MOTION.w, MOTION.d)
    c = matches_of(motion, seed=1, pairs=40, tracks=30)
    assert len(c.left) == len(c.right) == 40 and len(c.tracks) == 30
    for side, halves in zip(SIDES, ([0, 1, 4, 5], [2, 3, 6, 7]), strict=True):
        for matches in (getattr(c, side), c.tracks[:, halves]):
            # Rows are solved to 1e-9 px, and a Sampson error moves no faster than the pixels.
            assert np.abs(rs_sampson_error(RIG, SHUTTER, motion, side, matches)).max() < 1e-7
    # Both cameras read a row at the same time, so a point keeps its row and has its true depth.
    np.testing.assert_allclose(c.tracks[:, 1], c.tracks[:, 3], atol=1e-7)
    np.testing.assert_allclose(c.tracks[:, 5], c.tracks[:, 7], atol=1e-7)
    assert np.all(RIG.depth(c.tracks[:, 0] - c.tracks[:, 2]) > 2.0 - 1e-9)


@pytest.mark.parametrize(
    "motion",
    [
        MOTION,
        LinearMotion(w=np.deg2rad([10.0, -6.0, 9.0]), d=np.array([0.9, -0.5, 1.2])),
        # Fast enough for points that are seen twice or never.
        LinearMotion(w=np.deg2rad([60.0, 0.0, 10.0]), d=np.array([0.0, 2.5, 0.5])),
    ],
)
def test_fast_projection_agrees_with_the_search_over_all_rows(motion: Motion) -> None:
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0.0, 899.0, (300, 2))
    points = back_project(RIG, SHUTTER, motion, "left", 0, pixels, rng.uniform(2.0, 10.0, 300))
    world = simulation.MovingRig(RIG, SHUTTER, motion, SimulationOptions())
    for side in SIDES:
        for frame in (0, 1):
            expected = rs_project(RIG, SHUTTER, motion, side, frame, points)
            found = world.seen_once(side, frame, points, pixels[:, 1])
            once = expected.status == ProjectionStatus.SEEN
            assert np.array_equal(np.isfinite(found[:, 0]), once)
            # Both solve the row equation to 1e-9 px; its slope is at least 0.5 where the fast way is taken.
            np.testing.assert_allclose(found[once], expected.pixels[once], atol=1e-8)


def test_noise_has_the_stated_deviation_on_every_coordinate() -> None:
    noisy, exact = (matches_of(MOTION, seed=4, pairs=2000, tracks=2000, noise_px=px) for px in (0.7, 0.0))
    for name in ("left", "right", "tracks"):
        noise = (getattr(noisy, name) - getattr(exact, name)) / 0.7
        # Per coordinate, within the 1e-5 tails of chi-squared; coordinates are independent.
        squares = np.sum(noise**2, axis=0)
        assert np.all((squares > chi2.ppf(1e-5, 2000)) & (squares < chi2.ppf(1 - 1e-5, 2000)))
        correlation = np.corrcoef(noise.T) - np.eye(noise.shape[1])
        assert np.abs(correlation).max() < 5 / np.sqrt(2000)


def test_common_random_numbers() -> None:
    base = SimulationOptions(pairs=50, tracks=20, noise_px=0.5, outlier_ratio=0.2)

    def draw(options: SimulationOptions, motion: Motion = MOTION) -> simulation.Simulation:
        return simulate(RIG, SHUTTER, motion, options, np.random.default_rng(7))

    first, again = draw(base), draw(base)
    assert np.array_equal(first.correspondences.left, again.correspondences.left)
    # Fewer matches are the first of more, and the sets do not disturb each other.
    fewer = draw(replace(base, pairs=20, tracks=0, outlier_ratio=0.0)).correspondences
    more = draw(replace(base, outlier_ratio=0.0)).correspondences
    assert np.array_equal(fewer.left, more.left[:20]) and np.array_equal(fewer.right, more.right[:20])
    # Noise of twice the size is twice the noise.
    exact, twice = (draw(replace(base, noise_px=s, outlier_ratio=0.0)).correspondences.left for s in (0.0, 1.0))
    np.testing.assert_allclose(twice - exact, 2 * (more.left - exact), atol=1e-10)
    # Another motion moves the same points, as long as they stay in view: frame 0's columns show it.
    other = draw(replace(base, noise_px=0.0, outlier_ratio=0.0), LinearMotion(MOTION.w * 0.5, MOTION.d * 0.5))
    common = [x for x in other.correspondences.left[:, 0] if np.any(np.abs(exact[:, 0] - x) < 1e-9)]
    assert len(common) > 40
    # The left and right cameras see different points, and so do different generators.
    assert not np.any(np.isin(first.correspondences.left[:, 0], first.correspondences.right[:, 0]))


def test_outliers_are_as_many_and_as_far_as_stated() -> None:
    options = SimulationOptions(pairs=100, tracks=50, outlier_ratio=0.3, outlier_px=40.0)
    wrong = simulate(RIG, SHUTTER, MOTION, options, np.random.default_rng(2))
    right = simulate(RIG, SHUTTER, MOTION, replace(options, outlier_ratio=0.0), np.random.default_rng(2))
    for name, count in (("left", 30), ("right", 30), ("tracks", 15)):
        shift = getattr(wrong.correspondences, name) - getattr(right.correspondences, name)
        mask = wrong.outliers[name]
        half = shift.shape[1] // 2
        assert np.count_nonzero(mask) == count
        assert not np.any(shift[~mask]) and not np.any(shift[:, :half])
        assert 20.0 < np.abs(shift[mask, half:]).max() <= 40.0


def test_points_of_a_plane_lie_on_one() -> None:
    still = LinearMotion(np.zeros(3), np.array([0.0, 0.0, 1e-9]))
    tracks = matches_of(still, seed=8, tracks=60, shape="plane").tracks
    X = RIG.depth(tracks[:, 0] - tracks[:, 2])[:, None] * RIG.camera.unproject(tracks[:, :2])
    normal, *_ = np.linalg.lstsq(X, np.ones(len(X)), rcond=None)
    np.testing.assert_allclose(X @ normal, 1.0, atol=1e-6)


def test_a_motion_that_loses_the_scene_is_refused() -> None:
    away = LinearMotion(np.array([0.0, 3.0, 0.0]), np.zeros(3))
    with pytest.raises(ValueError, match="points in view"):
        matches_of(away, pairs=5)


def test_random_motion_has_the_given_magnitudes() -> None:
    motion = random_motion(np.random.default_rng(0), 0.1, 0.4, "twist")
    np.testing.assert_allclose([np.linalg.norm(motion.w), np.linalg.norm(motion.d)], [0.1, 0.4], rtol=1e-12)


@pytest.mark.parametrize("ratio", [0.0, 0.8])
def test_lines_are_straight_where_the_shutter_is_global(ratio: float) -> None:
    """Points of one line in all four images: its four planes meet in it; noise is of the ends alone."""
    shutter = RollingShutter(height=900, readout_ratio=ratio)
    options = SimulationOptions(lines=40, tracks=5)
    c = simulate(RIG, shutter, MOTION, options, np.random.default_rng(1)).correspondences
    assert c.lines.shape == (40, 16)
    rays = RIG.camera.unproject(c.lines.reshape(40, 4, 2, 2))
    planes = np.cross(rays[..., 0, :], rays[..., 1, :])
    R, t = MOTION.body_from_world(1.0)
    poses = [np.column_stack([Q, o + RIG.offset(s)]) for Q, o in ((np.eye(3), 0.0 * t), (R, t)) for s in SIDES]
    in_world = np.stack([planes[:, k] @ pose for k, pose in enumerate(poses)], axis=1)
    in_world /= np.linalg.norm(in_world, axis=2, keepdims=True)
    third = np.linalg.svd(in_world, compute_uv=False)[:, 2]
    assert np.max(third) < 1e-9 if ratio == 0.0 else np.median(third) > 1e-5
    # Ends are other points in each image: those of frame 0 differ in row between the cameras.
    assert np.median(np.abs(c.lines[:, 1] - c.lines[:, 5])) > 1.0
    few = simulate(RIG, shutter, MOTION, replace(options, lines=7), np.random.default_rng(1)).correspondences
    np.testing.assert_array_equal(few.lines, c.lines[:7])
    wrong = simulate(RIG, shutter, MOTION, replace(options, outlier_ratio=0.25), np.random.default_rng(1))
    moved = np.any(wrong.correspondences.lines != c.lines, axis=1)
    assert np.array_equal(moved, wrong.outliers["lines"]) and np.count_nonzero(moved) == 10
    np.testing.assert_array_equal(wrong.correspondences.lines[:, :8], c.lines[:, :8])
