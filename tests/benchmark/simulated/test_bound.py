"""The bound on the motion: against the solvers' own information, a parametrised fit, known figures, and itself."""

from __future__ import annotations

import numpy as np
import pytest
from general_rigs import RIGS, SCANS
from solver_trials import RIG, SHUTTER, D, W, matches_of

from rsbench import estimate_motion
from rsbench.benchmark.simulated.bound import Views, bound_of_one_camera, motion_bound, root_information
from rsbench.benchmark.simulated.simulation import SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import LinearMotion, make_motion
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.projection import ProjectionStatus, back_project, rs_project
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import pack
from rsbench.solvers.refined import RefinedSolver


def assert_same_information(found: FloatArray, expected: FloatArray, atol: float = 1e-5) -> None:
    scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=atol)


@pytest.mark.parametrize("model", ["linear", "twist", "accelerated"])
@pytest.mark.parametrize(("views", "pairs", "tracks"), [("pairs", 30, 20), ("four-view", 0, 30)])
def test_equals_the_information_in_the_solvers_residuals(
    model: str, views: Views, pairs: int, tracks: int
) -> None:
    """Eliminating points from projections and whitening constraints without points: the same to first order."""
    motion = make_motion(model, W, D)
    c = matches_of(motion, pairs=pairs, tracks=tracks)
    bound = motion_bound(c, RIG, SHUTTER, motion, 1.0, views)
    packed = pack(c, RIG, SHUTTER, model, use_tracks=views != "pairs")
    J = np.linalg.inv(packed.motion_jacobian(packed.theta(motion.w, motion.d)))
    H = J.T @ packed.normal_equations(packed.theta(motion.w, motion.d))[2] @ J
    assert_same_information(bound.information, H, 1e-7)


@pytest.mark.parametrize(
    "views", [("left", "left"), ("left", "right", "left"), ("left", "right", "left", "right")]
)
def test_equals_a_numeric_fit_of_motion_and_points(views: tuple[Side, ...]) -> None:
    """The Jacobian of the exact projection by motion and points, from finite differences of rs_project."""
    motion = LinearMotion(W, D)
    frames = [0, 1] if len(views) == 2 else [0, 0, 1, 1][: len(views)]
    pixels = np.random.default_rng(0).uniform(200, 700, (8, 2))
    points = back_project(RIG, SHUTTER, motion, "left", 0, pixels, np.linspace(3, 8, 8))
    expected = numeric_information(RIG, SHUTTER, motion, points, list(zip(views, frames, strict=True)))
    rows = [
        (side, frame, rs_project(RIG, SHUTTER, motion, side, frame, points).pixels[:, 1])
        for side, frame in zip(views, frames, strict=True)
    ]
    root = root_information(RIG, SHUTTER, motion, points, rows)
    assert_same_information(root.T @ root, expected)


def numeric_information(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, points: FloatArray, views: list[tuple[Side, int]]
) -> FloatArray:
    """(6, 6) of (w, d) at a noise of 1 px in each camera's own pixels, points (n, 3) eliminated."""

    def project(parameters: FloatArray) -> FloatArray:
        moving, X = LinearMotion(parameters[:3], parameters[3:6]), parameters[6:].reshape(-1, 3)
        seen = [rs_project(rig, shutter, moving, side, frame, X) for side, frame in views]
        assert all(np.all(view.status == ProjectionStatus.SEEN) for view in seen)
        return np.concatenate([view.pixels.ravel() for view in seen])

    truth = np.concatenate([motion.w, motion.d, points.ravel()])
    step = 1e-5
    shifts = step * np.eye(len(truth))
    J = np.column_stack([(project(truth + shift) - project(truth - shift)) / (2 * step) for shift in shifts])
    F = J.T @ J
    return F[:6, :6] - F[:6, 6:] @ np.linalg.pinv(F[6:, 6:], rcond=1e-11) @ F[6:, :6]


@pytest.mark.parametrize("scanning", SCANS.values(), ids=SCANS)
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
def test_equals_a_numeric_fit_on_any_rig(rig: StereoRig, scanning: Scanning) -> None:
    motion, shutter = LinearMotion(0.5 * W, 0.3 * D), rig.shutter_of(scanning, 0.8)
    c = matches_of(motion, rig=rig, shutter=shutter, tracks=6, pairs=6, depth=(3.0, 6.0))
    X = {}
    for name, rays in (("tracks", 4), ("left", 2), ("right", 2)):
        # Where the exact rays of a match meet: the linear equations of their pixels.
        views: list[tuple[Side, int]] = [("left", 0), ("right", 0), ("left", 1), ("right", 1)]
        views = views if rays == 4 else [(side, frame) for side, frame in views if side == name]
        found = []
        for row in getattr(c, name):
            A, b = list[FloatArray](), list[float]()
            for (side, frame), pixel in zip(views, row.reshape(-1, 2), strict=True):
                R, t = rig.cam_from_world(motion, shutter.pixel_time(pixel, frame, side), side)
                x, y, _ = rig.sensor(side).unproject(pixel)
                A += [R[0] - x * R[2], R[1] - y * R[2]]
                b += [x * t[2] - t[0], y * t[2] - t[1]]
            found.append(np.linalg.lstsq(np.array(A), np.array(b), rcond=None)[0])
        X[name] = numeric_information(rig, shutter, motion, np.array(found, dtype=np.float64), views)
    expected = np.sum([*X.values()], axis=0)
    assert_same_information(motion_bound(c, rig, shutter, motion, 1.0).information, expected)


def test_scales_with_the_noise_and_gains_from_views() -> None:
    motion = LinearMotion(W, D)
    c = matches_of(motion, tracks=50)
    one, two = (motion_bound(c, RIG, SHUTTER, motion, sigma) for sigma in (1.0, 2.0))
    assert two.rotation == pytest.approx(2 * one.rotation) and two.scale == pytest.approx(2 * one.scale)
    assert one.covariance is not None
    np.testing.assert_allclose(one.covariance @ one.information, np.eye(6), atol=1e-6)
    rotations = [
        motion_bound(c, RIG, SHUTTER, motion, 1.0, v).rotation for v in ("pairs", "three-view", "four-view")
    ]
    assert rotations[0] > rotations[1] > rotations[2]


def one_camera(degrees: float) -> tuple[Correspondences, Motion]:
    motion = LinearMotion(np.radians(degrees) * np.array([0.5, 0.6, -0.62]), D)
    return Correspondences(left=matches_of(motion, pairs=100).left), motion


def test_what_is_hardly_known_is_no_rounding() -> None:
    """One camera's scale comes from terms of second order in the rotation: half of it, a quarter is known."""
    found = [motion_bound(*(c, RIG, SHUTTER, m), 1e-6).scale for c, m in map(one_camera, (0.2, 0.1, 0.05, 0.025))]
    ratios = np.divide(found[1:], found[:-1])
    # What is left of the next order halves too; the information had (2e7)^-2 of its largest value here.
    np.testing.assert_allclose(ratios, 4.0, rtol=0.02)
    assert abs(ratios[2] - 4.0) < 0.6 * abs(ratios[1] - 4.0) < 0.36 * abs(ratios[0] - 4.0)


def test_the_best_estimator_of_one_camera_is_at_the_bound_of_a_rig_of_one() -> None:
    """As a camera beside the body's origin its direction would be half as certain, and methods in doubt."""
    rig, rng, errors = StereoRig.of_one(RIG.camera), np.random.default_rng(3), list[float]()
    motion, options = LinearMotion(W, D), SimulationOptions(pairs=150, tracks=0, noise_px=0.0)
    left = simulate(rig, SHUTTER, motion, options, rng).correspondences.left
    bound = bound_of_one_camera(left, rig, SHUTTER, motion, 0.1)
    for _ in range(40):
        noisy = Correspondences(left=left + 0.1 * rng.normal(size=left.shape))
        found = estimate_motion(noisy, RIG, SHUTTER, solver="rs-mono-refined")
        errors.append(float(np.rad2deg(translation_error(found.estimate.d, D))))
    at_bound = np.rad2deg(np.sqrt(np.sum(bound.direction_axes**2)))
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) / at_bound < 1.35  # 40 errors: +-8 % of a root mean square
    assert bound.scale == np.inf


def test_no_translation_and_no_matches() -> None:
    still = LinearMotion(W, np.zeros(3))
    bound = motion_bound(matches_of(still, tracks=30), RIG, SHUTTER, still, 1.0)
    assert np.isinf(bound.direction) and np.isinf(bound.scale) and np.isfinite(bound.rotation)
    nothing = motion_bound(Correspondences(), RIG, SHUTTER, LinearMotion(W, D), 1.0)
    assert np.isinf(nothing.rotation) and nothing.covariance is None and nothing.scale > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("pairs", "tracks"), [(100, 0), (0, 100)])
def test_the_default_solver_reaches_it(pairs: int, tracks: int) -> None:
    """Root mean squares over 150 motions scatter by 6 %; 1.10 is the target."""
    ratios = []
    for seed in range(150):
        motion = random_motion(np.random.default_rng(seed), np.radians(2.0), 0.3)
        bound = motion_bound(matches_of(motion, pairs=pairs, tracks=tracks, seed=seed), RIG, SHUTTER, motion, 0.5)
        c = matches_of(motion, seed=seed, pairs=pairs, tracks=tracks, noise_px=0.5)
        estimate = RefinedSolver().estimate(c, RIG, SHUTTER)
        e_R, e_T = rotation_error(estimate.w, motion.w), translation_error(estimate.d, motion.d)
        ratios.append([float(e_R) / bound.rotation, float(e_T) / bound.direction])
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    assert np.all(rms < 1.10) and np.all(rms > 0.85)
