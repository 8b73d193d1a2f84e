"""Residuals of cameras as they are: lenses, scans, a late right camera; exact data, and a bundle adjustment."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.optimize import least_squares

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.projection import back_project, rs_project_near
from rsbench.core.rig import FRAMES, SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.packed import Packed, pack
from rsbench.solvers.refined import RefinedSolver

IDEAL = StereoRig(
    camera=PinholeCamera(width=900, height=700, fx=610.0, fy=580.0, cx=440.0, cy=355.0), baseline=0.5
)
PLAIN = RollingShutter(height=700, width=900, readout_ratio=0.8)
BARREL = Lens(model="brown-conrady", k1=-0.2, k2=0.04, p1=0.001, p2=-0.0005)
FISHEYE = Lens(model="kannala-brandt", k1=-0.03, k2=0.01)
CASES = {
    "barrel": (BARREL, PLAIN),
    "fisheye": (FISHEYE, PLAIN),
    "late": (None, replace(PLAIN, right_delay=0.3)),
    "opposite": (BARREL, replace(PLAIN, right_scan="bottom")),
    "columns": (None, replace(PLAIN, scan="left", right_scan="right", right_delay=-0.1)),
    "up": (None, replace(PLAIN, scan="bottom")),
}
pytestmark = pytest.mark.parametrize("case", CASES)


def problem(case: str, noise_px: float, tracks: int = 30, pairs: int = 0) -> Simulation:
    lens, shutter = CASES[case]
    rig = replace(IDEAL, camera=replace(IDEAL.camera, lens=lens))
    rng = np.random.default_rng(3)
    motion = random_motion(rng, 0.04, 0.2, "linear")
    options = SimulationOptions(tracks=tracks, pairs=pairs, noise_px=noise_px)
    return simulate(rig, shutter, motion, options, rng)


def packed_of(s: Simulation) -> tuple[Packed, FloatArray]:
    packed = pack(s.correspondences, s.rig, s.shutter)
    return packed, packed.theta(s.motion.w, s.motion.d)


def test_the_truth_explains_exact_matches(case: str) -> None:
    s = problem(case, 0.0, pairs=20)
    packed, theta = packed_of(s)
    # 1e-9 px of the row equation, and two Gauss-Newton steps to the point.
    assert np.max(packed.track_squares(theta)) < 1e-14
    assert np.max(np.abs(packed.pair_residuals(theta))) < 1e-7
    assert packed.in_front(theta) == len(packed.pairs) == 40


def test_pair_errors_are_those_of_numpy(case: str) -> None:
    s = problem(case, 1.0, tracks=0, pairs=20)
    packed, theta = packed_of(s)
    matches = {side: getattr(s.correspondences, side) for side in SIDES}
    expected = [rs_sampson_error(s.rig, s.shutter, s.motion, side, matches[side]) for side in SIDES]
    np.testing.assert_allclose(packed.pair_residuals(theta), np.concatenate(expected), atol=1e-10)


def test_track_errors_are_those_of_the_best_point(case: str) -> None:
    s = problem(case, 0.3, tracks=2)
    packed, theta = packed_of(s)
    for track, square in zip(s.correspondences.tracks, packed.track_squares(theta), strict=True):

        def reprojection(X: FloatArray, track: FloatArray = track) -> FloatArray:
            found = []
            for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
                line = track[2 * k + s.shutter.axis(side)]
                found.append(rs_project_near(s.rig, s.shutter, s.motion, side, frame, X, line).pixels)
            return np.concatenate(found) - track

        x = s.rig.camera.ideal_pixels(track[:4].reshape(2, 2))
        depth = s.rig.depth(x[0, 0] - x[1, 0])
        start = back_project(s.rig, s.shutter, s.motion, "left", 0, track[:2], np.abs(depth))
        best = least_squares(reprojection, start, xtol=1e-14, ftol=1e-14)
        # Equal to first order in the noise, of which the velocity that weighs an end is 1 % uncertain.
        assert square == pytest.approx(2 * best.cost, rel=0.01, abs=1e-4)


def test_gradient_and_hessian_against_finite_differences(case: str) -> None:
    s = problem(case, 0.0, pairs=15)
    c = s.correspondences
    for part in (Correspondences(left=c.left, right=c.right), Correspondences(tracks=c.tracks)):
        packed = pack(part, s.rig, s.shutter)
        theta = packed.theta(s.motion.w, s.motion.d)
        shift, step = np.array([2.0, -3.0, 1.0, 4.0, -2.0, 3.0]) * 1e-6, 1e-6
        gradient, hessian = packed.normal_equations(theta + shift)[1], packed.normal_equations(theta)[2]
        costs = [
            [packed.normal_equations(theta + shift + sign * step * e)[0] for sign in (1, -1)] for e in np.eye(6)
        ]
        numeric = (np.array(costs) @ [1, -1]) / (2 * step)
        # A shift of 1e-6 leaves 3e-4 of second order in the errors of pairs.
        np.testing.assert_allclose(gradient, hessian @ shift, rtol=0, atol=1e-3 * np.max(np.abs(gradient)))
        np.testing.assert_allclose(gradient, numeric, rtol=2e-4, atol=1e-4 * np.max(np.abs(gradient)))


@pytest.mark.parametrize("tracks", [True, False])
def test_the_solver_finds_the_motion(case: str, tracks: bool) -> None:
    s = problem(case, 0.0, tracks=40) if tracks else problem(case, 0.0, tracks=0, pairs=60)
    found = RefinedSolver(use_tracks=tracks).estimate(s.correspondences, s.rig, s.shutter)
    assert found.success and found.metric
    # Exact data: what is left is where the descent stops.
    assert so3.angle(so3.exp(found.w) @ so3.exp(-s.motion.w)) < 1e-8
    np.testing.assert_allclose(found.d, s.motion.d, atol=1e-6)


def test_stated_deviations_hold(case: str) -> None:
    s = problem(case, 0.5, tracks=60)
    found = RefinedSolver().estimate(s.correspondences, s.rig, s.shutter)
    assert found.covariance is not None and found.noise_px == pytest.approx(0.5, rel=0.2)
    error = np.concatenate([found.w - s.motion.w, found.d - s.motion.d])
    # Chi-squared with 6 degrees of freedom: above 22.5 once in 1000.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
