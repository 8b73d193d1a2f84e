"""The compiled residuals against the NumPy geometry, finite differences and an explicit bundle adjustment."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import in_front, row_pair_pose, rs_sampson_error, rs_stereo_transfer
from rsbench.core.motion import Motion
from rsbench.core.projection import back_project, project_at
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import Packed, pack

# Unequal focal lengths, so that no two of them can be mistaken for one another.
RIG = StereoRig(camera=PinholeCamera(width=900, height=700, fx=810.0, fy=760.0, cx=440.0, cy=355.0), baseline=0.5)
SHUTTER = RollingShutter(height=700, readout_ratio=0.8)

pytestmark = pytest.mark.parametrize("model", ["linear", "twist", "inertial", "accelerated"])


def problem(model: str, noise_px: float) -> tuple[Correspondences, Motion, Packed]:
    rng = np.random.default_rng(3)
    motion = random_motion(rng, 0.05, 0.3, model)
    options = SimulationOptions(pairs=40, tracks=40, noise_px=noise_px)
    c = simulate(RIG, SHUTTER, motion, options, rng).correspondences
    return c, motion, pack(c, RIG, SHUTTER, model)


def middle(tracks: FloatArray) -> FloatArray:
    """x, y, disparity (n, 3) of stereo matches (n, 4)."""
    return np.column_stack([0.5 * (tracks[:, :2] + tracks[:, 2:]), tracks[:, 0] - tracks[:, 2]])


def test_pair_residuals_equal_the_numpy_sampson_error(model: str) -> None:
    c, motion, packed = problem(model, noise_px=2.0)
    expected = [rs_sampson_error(RIG, SHUTTER, motion, side, getattr(c, side)) for side in SIDES]
    np.testing.assert_allclose(
        packed.pair_residuals(packed.theta(motion.w, motion.d)), np.concatenate(expected), atol=1e-10
    )


def test_track_errors_equal_the_whitened_numpy_transfer(model: str) -> None:
    c, motion, packed = problem(model, noise_px=1.0)

    def transfer(tracks: FloatArray) -> FloatArray:
        return rs_stereo_transfer(RIG, SHUTTER, motion, middle(tracks[:, :4]), middle(tracks[:, 4:]))

    # Derivative by all eight coordinates; the row differences are the two equations that the motion leaves alone.
    step = 1e-3
    D = np.stack(
        [(transfer(c.tracks + step * e) - transfer(c.tracks - step * e)) / (2 * step) for e in np.eye(8)], axis=-1
    )
    rows = np.zeros((2, 8))
    rows[0, [1, 3]], rows[1, [5, 7]] = (1, -1), (1, -1)
    D = np.concatenate([D, np.broadcast_to(rows, (len(D), 2, 8))], axis=1)
    error = np.concatenate([transfer(c.tracks), c.tracks @ rows.T], axis=1)
    expected = np.einsum("ni,nij,nj->n", error, np.linalg.inv(D @ np.swapaxes(D, 1, 2)), error)
    # 1e-6: the central differences.
    np.testing.assert_allclose(packed.track_squares(packed.theta(motion.w, motion.d)), expected, rtol=1e-6)


def test_track_errors_are_those_of_the_best_point(model: str) -> None:
    c, motion, packed = problem(model, noise_px=0.3)
    squares = packed.track_squares(packed.theta(motion.w, motion.d))
    for track, square in zip(c.tracks[:10], squares, strict=False):

        def reprojection(X: FloatArray, track: FloatArray = track) -> FloatArray:
            views: list[FloatArray] = []
            for frame in (0, 1):
                y = track[4 * frame + 1]
                for _ in range(8):  # the row equation: image points move much slower than the readout
                    y = project_at(RIG, motion, "left", SHUTTER.row_time(y, frame), X)[1]
                views += [project_at(RIG, motion, side, SHUTTER.row_time(y, frame), X)[:2] for side in SIDES]
            return np.concatenate(views) - track

        disparity = track[[0]] - track[[2]]
        start = back_project(RIG, SHUTTER, motion, "left", 0, track[None, :2], RIG.depth(disparity))[0]
        best = least_squares(reprojection, start, xtol=1e-14, ftol=1e-14)
        # Equal to first order in the noise, which is 0.5 % of the disparity.
        assert square == pytest.approx(2 * best.cost, rel=0.01, abs=1e-4)


def test_gradient_and_hessian_against_finite_differences(model: str) -> None:
    c, motion, _ = problem(model, noise_px=0.0)
    for part in (Correspondences(left=c.left, right=c.right), Correspondences(tracks=c.tracks)):
        packed = pack(part, RIG, SHUTTER, model)
        # Move the measurements onto the motion: at zero residuals the Hessian is exact.
        shift = np.array([2.0, -3.0, 1.0, 4.0, -2.0, 3.0]) * 1e-6
        exact = packed.theta(motion.w, motion.d)
        gradient = packed.normal_equations(exact + shift)[1]
        hessian = packed.normal_equations(exact)[2]
        np.testing.assert_allclose(gradient, hessian @ shift, rtol=2e-4, atol=1e-4 * np.max(np.abs(gradient)))
        step = 1e-6
        numeric = [
            (
                packed.normal_equations(exact + shift + step * e)[0]
                - packed.normal_equations(exact + shift - step * e)[0]
            )
            / (2 * step)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(gradient, numeric, rtol=2e-4, atol=1e-4 * np.max(np.abs(gradient)))
        for angle in (0.0, 1e-4, 0.5):
            turned = packed.theta(motion.w * angle / 0.05, motion.d)
            assert np.all(np.isfinite(packed.normal_equations(turned)[2]))


def test_gradient_is_that_of_the_sampson_cost_under_noise(model: str) -> None:
    """With the weights frozen it would be off by tens of percent."""
    c, motion, _ = problem(model, noise_px=0.5)
    for part in (Correspondences(left=c.left, right=c.right), Correspondences(tracks=c.tracks)):
        packed = pack(part, RIG, SHUTTER, model)
        theta = packed.theta(motion.w, motion.d)
        step = 1e-6
        numeric = np.array(
            [
                (packed.normal_equations(theta + step * e)[0] - packed.normal_equations(theta - step * e)[0])
                / (2 * step)
                for e in np.eye(6)
            ]
        )
        scale = np.sqrt(np.diagonal(packed.normal_equations(theta)[2]))
        # In units of a standard deviation of each parameter.
        np.testing.assert_allclose(packed.normal_equations(theta)[1] / scale, numeric / scale, atol=2e-2)


def test_cheirality_equals_the_numpy_one(model: str) -> None:
    c, motion, packed = problem(model, noise_px=0.5)
    for candidate in (motion, motion.with_endpoint(motion.w, -motion.d)):
        expected = 0
        for side in SIDES:
            matches = getattr(c, side)
            pose = row_pair_pose(RIG, SHUTTER, candidate, side, matches[:, 1], matches[:, 3])
            x0, x1 = RIG.camera.unproject(matches[:, :2]), RIG.camera.unproject(matches[:, 2:])
            expected += int(np.count_nonzero(in_front(pose, x0, x1)))
        assert packed.in_front(packed.theta(candidate.w, candidate.d)) == expected


def test_no_motion_explains_only_matches_that_stay(model: str) -> None:
    """Without translation the constraint vanishes; the residual must not."""
    c, _, _ = problem(model, noise_px=0.0)
    moved = pack(Correspondences(left=c.left), RIG, SHUTTER, model).pair_residuals(np.zeros(6))
    distance = np.linalg.norm(c.left[:, 2:] - c.left[:, :2], axis=1)
    np.testing.assert_allclose(moved, distance / np.sqrt(2.0), rtol=1e-12)
    still = np.hstack([c.left[:, :2], c.left[:, :2]])
    assert np.max(pack(Correspondences(left=still), RIG, SHUTTER, model).pair_residuals(np.zeros(6))) < 1e-9
