"""Epipolar algebra of row pairs against geometry in the world frame, differences and the nearest match."""

from __future__ import annotations

import numpy as np
import pytest
from differences import derivatives
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import epipolar, so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.projection import ProjectionStatus, project_at, rs_project
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

few = settings(max_examples=25)
vectors = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
seeds = st.integers(0, 2**32 - 1)
models = st.sampled_from([LinearMotion, TwistMotion])

RIG = StereoRig(
    camera=PinholeCamera(width=900, height=800, fx=1384.6, fy=1300.0, cx=440.0, cy=405.0), baseline=0.2
)
SHUTTER = RollingShutter(height=800, readout_ratio=0.8)
MOTIONS = [
    model(np.array([0.01, -0.03, 0.02]), np.array([0.2, -0.1, 0.3])) for model in (LinearMotion, TwistMotion)
]


def _exact_matches(
    motion: Motion, side: Side, seed: int = 0, shutter: RollingShutter = SHUTTER
) -> tuple[FloatArray, FloatArray]:
    """Matches (n, 4) of points (n, 3) seen once in both frames."""
    X = np.random.default_rng(seed).uniform([-2, -2, 5], [2, 2, 15], size=(120, 3))
    first, second = (rs_project(RIG, shutter, motion, side, frame, X) for frame in (0, 1))
    ok = (first.status == ProjectionStatus.SEEN) & (second.status == ProjectionStatus.SEEN)
    return np.concatenate([first.pixels, second.pixels], axis=1)[ok], X[ok]


def _world_constraint(motion: Motion, side: Side, match: FloatArray, shutter: RollingShutter = SHUTTER) -> float:
    """Volume spanned by the two viewing rays and the line between the two centres, all in the world frame."""
    centres, rays = list[FloatArray](), list[FloatArray]()
    for frame, (x, y) in enumerate(match.reshape(2, 2)):
        tau = frame + shutter.readout_ratio * y / shutter.height
        world_from_cam = inverse(RIG.cam_from_world(motion, tau, side))
        centres.append(world_from_cam.t)
        rays.append(world_from_cam.R @ [(x - 440.0) / 1384.6, (y - 405.0) / 1300.0, 1.0])
    return float(np.linalg.det(np.stack([rays[1], centres[0] - centres[1], rays[0]])))


def _numeric_gradient(motion: Motion, side: Side, match: FloatArray, step: float = 1e-3) -> FloatArray:
    return derivatives(lambda moved: _world_constraint(motion, side, moved), match, step)


def test_row_pair_pose_is_the_chain_through_the_world() -> None:
    for motion in MOTIONS:
        for side in SIDES:
            cam0 = RIG.cam_from_world(motion, 0.8 * 120.5 / 800, side)
            cam1 = RIG.cam_from_world(motion, 1 + 0.8 * 700.25 / 800, side)
            expected = compose(cam1, inverse(cam0))
            found = epipolar.row_pair_pose(RIG, SHUTTER, motion, side, 120.5, 700.25)
            np.testing.assert_allclose(found.R, expected.R, rtol=0, atol=1e-15)
            np.testing.assert_allclose(found.t, expected.t, rtol=0, atol=1e-15)


@few
@given(models, vectors, vectors, seeds, st.sampled_from(SIDES))
def test_exact_matches_satisfy_the_constraint(
    model: type[LinearMotion] | type[TwistMotion], w: FloatArray, d: FloatArray, seed: int, side: Side
) -> None:
    motion = model(0.1 * w, d)
    matches, _ = _exact_matches(motion, side, seed)
    x0, x1 = RIG.camera.unproject(matches[:, :2]), RIG.camera.unproject(matches[:, 2:])
    E = epipolar.essential_matrix(epipolar.row_pair_pose(RIG, SHUTTER, motion, side, matches[:, 1], matches[:, 3]))
    # Rows are solved to 1e-9 px, 1e-12 of the image plane; |E| is at most a few metres.
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", x1, E, x0), 0.0, rtol=0, atol=1e-11)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_constraint_and_its_gradient_are_those_of_the_world_frame(motion: Motion, side: Side) -> None:
    matches, _ = _exact_matches(motion, side)
    matches = matches[:15] + np.random.default_rng(1).normal(size=(15, 4))
    value, gradient = epipolar.rs_constraint(RIG, SHUTTER, motion, side, matches)
    in_world = np.array([_world_constraint(motion, side, m) for m in matches])
    np.testing.assert_allclose(value, in_world, rtol=0, atol=1e-15)
    numeric = np.array([_numeric_gradient(motion, side, m) for m in matches])
    np.testing.assert_allclose(gradient, numeric, rtol=0, atol=1e-6 * np.abs(gradient).max())
    error = epipolar.rs_sampson_error(RIG, SHUTTER, motion, side, matches)
    np.testing.assert_allclose(error, value / np.linalg.norm(numeric, axis=1), rtol=1e-6)


def _nearest_exact_match(motion: Motion, side: Side, match: FloatArray) -> FloatArray:
    """Shift (4,) to the nearest match on the constraint: it lies on the surface and along its normal there."""
    shift = np.zeros(4)
    for _ in range(8):  # the distance from the surface falls by more than a hundred in each
        normal = _numeric_gradient(motion, side, match + shift)
        value = _world_constraint(motion, side, match + shift)
        shift = -normal * (value - normal @ shift) / (normal @ normal)
    assert abs(_world_constraint(motion, side, match + shift)) < 1e-14
    return shift


@pytest.mark.parametrize(("side", "noise"), [("left", 0.5), ("right", 0.05)])
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_sampson_error_is_the_distance_to_the_nearest_exact_match(
    motion: Motion, side: Side, noise: float
) -> None:
    matches, _ = _exact_matches(motion, side)
    matches = matches[:8] + noise * np.random.default_rng(2).normal(size=(8, 4))
    errors = epipolar.rs_sampson_error(RIG, SHUTTER, motion, side, matches)
    distances = [np.linalg.norm(_nearest_exact_match(motion, side, m)) for m in matches]
    # To first order: what is missing is relative to the curvature of the surface and shrinks with the noise.
    np.testing.assert_allclose(np.abs(errors), distances, rtol=0.01 * noise)


def test_a_global_shutter_gives_the_textbook_sampson_error() -> None:
    shutter = RollingShutter(height=800, readout_ratio=0.0)
    matches, _ = _exact_matches(MOTIONS[0], "left", shutter=shutter)
    matches = matches + np.random.default_rng(3).normal(size=matches.shape)
    K = RIG.camera.K
    E = epipolar.essential_matrix(epipolar.row_pair_pose(RIG, shutter, MOTIONS[0], "left", 0, 0))
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    ones = np.ones((len(matches), 1))
    p0, p1 = np.hstack([matches[:, :2], ones]), np.hstack([matches[:, 2:], ones])
    lines1, lines0 = p0 @ F.T, p1 @ F  # Hartley & Zisserman eq. 11.9, in pixels
    square = np.sum(lines1[:, :2] ** 2, axis=1) + np.sum(lines0[:, :2] ** 2, axis=1)
    expected = np.sum(p1 * lines1, axis=1) / np.sqrt(square)
    found = epipolar.rs_sampson_error(RIG, shutter, MOTIONS[0], "left", matches)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_sampson_error_of_no_motion_is_zero_not_nan() -> None:
    matches = np.array([[10.0, 20.0, 30.0, 40.0]])
    # Without rotation, translation and shutter even the offset camera stands still: E and its gradient vanish.
    still = LinearMotion(np.zeros(3), np.zeros(3))
    instant = RollingShutter(height=800, readout_ratio=0.0)
    assert epipolar.rs_sampson_error(RIG, instant, still, "left", matches) == 0.0


@pytest.mark.parametrize("side", SIDES)
def test_ray_depths_are_those_of_the_points(side: Side) -> None:
    motion = MOTIONS[1]
    matches, X = _exact_matches(motion, side)
    pose = epipolar.row_pair_pose(RIG, SHUTTER, motion, side, matches[:, 1], matches[:, 3])
    x0, x1 = RIG.camera.unproject(matches[:, :2]), RIG.camera.unproject(matches[:, 2:])
    depths = epipolar.ray_depths(pose, x0, x1)
    for frame in (0, 1):
        tau = SHUTTER.row_time(matches[:, 1 + 2 * frame], frame)
        true = project_at(RIG, motion, side, tau, X)[:, 2]
        # A parallax of 10 px and up turns 1e-9 px of row residual into 1e-9 / 10 relative depth and less.
        np.testing.assert_allclose(depths[:, frame], true, rtol=1e-8)
    assert np.all(epipolar.in_front(pose, x0, x1))
    assert not np.any(epipolar.in_front(Pose(pose.R, -pose.t), x0, x1))


def test_ray_depths_of_skew_rays_are_the_least_squares_ones() -> None:
    rng = np.random.default_rng(5)
    pose, x0, x1 = (
        Pose(so3.exp(0.1 * rng.normal(size=3)), rng.normal(size=3)),
        rng.normal(size=3),
        rng.normal(size=3),
    )
    system = np.stack([-(pose.R @ x0), x1], axis=1)  # z1 x1 - z0 R x0 = T
    expected = np.linalg.lstsq(system, pose.t, rcond=None)[0]
    np.testing.assert_allclose(epipolar.ray_depths(pose, x0, x1), expected, rtol=1e-10)


@pytest.mark.parametrize(
    ("t", "depth", "moved_depth"),
    # Sideways; and five metres along the axis: 3 m ahead of one camera is 2 m behind the other, either way round.
    [((-0.5, 0, 0), 3.0, 3.0), ((-0.5, 0, 0), -3.0, -3.0), ((0, 0, -5), 3.0, -2.0), ((0, 0, 5), -2.0, 3.0)],
)
def test_in_front_needs_both_depths_positive(
    t: tuple[float, float, float], depth: float, moved_depth: float
) -> None:
    pose, point = Pose(np.eye(3), np.array(t)), np.array([0.1, 0.2, depth])
    x0, x1 = point / depth, transform(pose, point) / moved_depth
    np.testing.assert_allclose(epipolar.ray_depths(pose, x0, x1), [depth, moved_depth], rtol=1e-12)
    assert epipolar.in_front(pose, x0, x1) == (depth > 0.0 and moved_depth > 0.0)


def test_parallel_rays_have_no_depth_and_are_not_in_front() -> None:
    pose = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    ray = np.array([0.1, 0.2, 1.0])
    assert np.all(np.isnan(epipolar.ray_depths(pose, ray, ray)))
    assert not epipolar.in_front(pose, ray, ray)
