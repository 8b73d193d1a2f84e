"""Compiled residuals against their NumPy forms, bundle adjustment and differences; errors with heavy tails."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import solver_trials
from differences import derivatives
from scipy.optimize import least_squares
from scipy.stats import chi2, t

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import in_front, row_pair_pose, rs_sampson_error
from rsbench.core.projection import back_project, rs_project_near
from rsbench.core.rig import FRAMES, SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.levenberg_marquardt import levenberg_marquardt
from rsbench.solvers.engine.packed import (
    HeavyTailed,
    Packed,
    each_term,
    heavy_tailed,
    pack,
    t_distribution,
)
from rsbench.solvers.refined import RefinedSolver

# Unequal focal lengths, so that no two of them can be mistaken for one another.
RIG = StereoRig(camera=PinholeCamera(width=900, height=700, fx=810.0, fy=760.0, cx=440.0, cy=355.0), baseline=0.5)
SHUTTER = RollingShutter(height=700, width=900, readout_ratio=0.8)
BARREL = Lens(model="brown-conrady", k1=-0.2, k2=0.04, p1=0.001, p2=-0.0005)
FISHEYE = Lens(model="kannala-brandt", k1=-0.03, k2=0.01)
MODELS = ("linear", "twist", "inertial", "accelerated")
TIMED = {
    "barrel": (BARREL, SHUTTER),
    "fisheye": (FISHEYE, SHUTTER),
    "late": (None, replace(SHUTTER, right_delay=0.3)),
    "opposite": (BARREL, replace(SHUTTER, right_scan="bottom")),
    "columns": (None, replace(SHUTTER, scan="left", right_scan="right", right_delay=-0.1)),
    "up": (None, replace(SHUTTER, scan="bottom")),
}
"""Lenses and scans by which the four ends of a track have times of their own, but for the last."""
EACH_MODEL = pytest.mark.parametrize("case", MODELS)
EACH_TIMED = pytest.mark.parametrize("case", TIMED)
EACH = pytest.mark.parametrize("case", [*MODELS, *TIMED])


def problem(
    case: str, noise_px: float, tracks: int = 40, pairs: int = 40
) -> tuple[Simulation, Packed, FloatArray]:
    """Matches of a motion model, or of a lens and a scan, packed, and the true parameters."""
    lens, shutter = TIMED.get(case, (None, SHUTTER))
    model, rng = case if case in MODELS else "linear", np.random.default_rng(3)
    motion, rig = random_motion(rng, 0.04, 0.2, model), replace(RIG, camera=replace(RIG.camera, lens=lens))
    s = simulate(rig, shutter, motion, SimulationOptions(pairs=pairs, tracks=tracks, noise_px=noise_px), rng)
    packed = pack(s.correspondences, rig, shutter, model)
    return s, packed, packed.theta(motion.w, motion.d)


def parts(s: Simulation, packed: Packed) -> list[Packed]:
    """The pairs alone, and the tracks alone."""
    c, model = s.correspondences, s.motion.name
    sets = (Correspondences(left=c.left, right=c.right), Correspondences(tracks=c.tracks))
    return [pack(each, s.rig, s.shutter, model) for each in sets]


@EACH
def test_pair_residuals_equal_the_numpy_sampson_error(case: str) -> None:
    s, packed, theta = problem(case, noise_px=2.0)
    matches = {side: getattr(s.correspondences, side) for side in SIDES}
    expected = [rs_sampson_error(s.rig, s.shutter, s.motion, side, matches[side]) for side in SIDES]
    np.testing.assert_allclose(packed.pair_residuals(theta), np.concatenate(expected), atol=1e-10)


@EACH
def test_track_errors_are_those_of_the_best_point(case: str) -> None:
    s, packed, theta = problem(case, noise_px=0.3, tracks=5)
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


@EACH
def test_gradient_and_hessian_against_finite_differences(case: str) -> None:
    """On the motion itself: at zero residuals the Hessian is exact."""
    s, both, exact = problem(case, noise_px=0.0)
    shift = np.array([2.0, -3.0, 1.0, 4.0, -2.0, 3.0]) * 1e-6
    for packed in parts(s, both):
        gradient, hessian = packed.normal_equations(exact + shift)[1], packed.normal_equations(exact)[2]
        largest = np.max(np.abs(gradient))
        # A shift of 1e-6 leaves 3e-4 of second order in the errors of pairs seen through a lens.
        off = 1e-3 if case in TIMED else 1e-4
        np.testing.assert_allclose(gradient, hessian @ shift, rtol=2e-4, atol=off * largest)
        numeric = derivatives(lambda theta, p=packed: p.normal_equations(theta)[0], exact + shift, 1e-6)
        np.testing.assert_allclose(gradient, numeric, rtol=2e-4, atol=1e-4 * largest)
        for angle in (0.0, 1e-4, 0.5):
            turned = packed.theta(s.motion.w * angle / 0.04, s.motion.d)
            assert np.all(np.isfinite(packed.normal_equations(turned)[2]))


@EACH_MODEL
def test_gradient_is_that_of_the_sampson_cost_under_noise(case: str) -> None:
    """With the weights frozen it would be off by tens of percent."""
    s, both, theta = problem(case, noise_px=0.5)
    for packed in parts(s, both):
        numeric = derivatives(lambda theta, p=packed: p.normal_equations(theta)[0], theta, 1e-6)
        _, gradient, H = packed.normal_equations(theta)
        scale = np.sqrt(np.diagonal(H))
        # In units of a standard deviation of each parameter.
        np.testing.assert_allclose(gradient / scale, numeric / scale, atol=2e-2)


@EACH_MODEL
def test_cheirality_equals_the_numpy_one(case: str) -> None:
    s, packed, _ = problem(case, noise_px=0.5)
    for candidate in (s.motion, s.motion.with_endpoint(s.motion.w, -s.motion.d)):
        expected = 0
        for side in SIDES:
            matches = getattr(s.correspondences, side)
            pose = row_pair_pose(RIG, SHUTTER, candidate, side, matches[:, 1], matches[:, 3])
            x0, x1 = RIG.camera.unproject(matches[:, :2]), RIG.camera.unproject(matches[:, 2:])
            expected += int(np.count_nonzero(in_front(pose, x0, x1)))
        assert packed.in_front(packed.theta(candidate.w, candidate.d)) == expected


@EACH_MODEL
def test_no_motion_explains_only_matches_that_stay(case: str) -> None:
    """Without translation the constraint vanishes; the residual must not."""
    c = problem(case, noise_px=0.0)[0].correspondences
    moved = pack(Correspondences(left=c.left), RIG, SHUTTER, case).pair_residuals(np.zeros(6))
    distance = np.linalg.norm(c.left[:, 2:] - c.left[:, :2], axis=1)
    np.testing.assert_allclose(moved, distance / np.sqrt(2.0), rtol=1e-12)
    still = np.hstack([c.left[:, :2], c.left[:, :2]])
    assert np.max(pack(Correspondences(left=still), RIG, SHUTTER, case).pair_residuals(np.zeros(6))) < 1e-9


@pytest.mark.parametrize("shutter", [SHUTTER, replace(SHUTTER, right_delay=0.05)])
def test_a_point_that_comes_up_to_the_camera_ends_no_search(shutter: RollingShutter) -> None:
    """The covariance of its image grows until floats show it singular: it is refused, without an error."""
    rng, camera = np.random.default_rng(0), PinholeCamera.centred(640, 480, 300.0)
    rig, shutter = StereoRig(camera=camera, baseline=0.02), replace(shutter, height=480)
    tracks = simulate(
        rig, shutter, random_motion(rng, 0.05, 0.3), SimulationOptions(tracks=30), rng
    ).correspondences
    for track in tracks.tracks:
        one = pack(Correspondences(tracks=track[None]), rig, shutter)
        between = shutter.pixel_time(track[4:6], 1, "left") - shutter.pixel_time(track[:2], 0, "left")
        towards = -rig.depth(track[0] - track[2]) / between
        for left in 10.0 ** np.arange(-6.0, 0.0, 0.1):
            theta = np.array([0.0, 0.0, 0.0, *(0.5 * towards * rng.normal(size=2)), towards * (1.0 - left)])
            cost, gradient, H = one.normal_equations(theta)
            assert cost >= 0.0 and np.all(np.isfinite(gradient)) and np.all(np.isfinite(H))


@EACH_TIMED
@pytest.mark.parametrize("tracks", [True, False])
def test_the_solver_finds_the_motion(case: str, tracks: bool) -> None:
    s, _, _ = problem(case, 0.0, pairs=0) if tracks else problem(case, 0.0, tracks=0, pairs=60)
    found = RefinedSolver(use_tracks=tracks).estimate(s.correspondences, s.rig, s.shutter)
    assert found.success and found.metric
    # Exact data: what is left is where the descent stops.
    assert so3.angle(so3.exp(found.w) @ so3.exp(-s.motion.w)) < 1e-8
    np.testing.assert_allclose(found.d, s.motion.d, atol=1e-6)


@EACH_TIMED
def test_stated_deviations_hold(case: str) -> None:
    s, _, _ = problem(case, 0.5, tracks=60, pairs=0)
    found = RefinedSolver().estimate(s.correspondences, s.rig, s.shutter)
    assert found.covariance is not None and found.noise_px == pytest.approx(0.5, rel=0.2)
    error = np.concatenate([found.w - s.motion.w, found.d - s.motion.d])
    # Chi-squared with 6 degrees of freedom: above 22.5 once in 1000.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5


MOTION = LinearMotion(solver_trials.W, solver_trials.D)
TRUTH = MotionEstimate(w=MOTION.w, d=MOTION.d, success=True)


def exact(pairs: int, tracks: int, seed: int = 0, depth: tuple[float, float] = (2.0, 10.0)) -> Simulation:
    options = SimulationOptions(pairs=pairs, tracks=tracks, depth=depth)
    return simulate(solver_trials.RIG, solver_trials.SHUTTER, MOTION, options, np.random.default_rng(seed))


def heavy(points: FloatArray, scale: float, nu: float, rng: np.random.Generator) -> FloatArray:
    """Points (n, k) with errors of a multivariate t distribution: each row has a variance of its own."""
    spread = np.sqrt(nu / rng.chisquare(nu, (len(points), 1)))
    return points + scale * spread * rng.standard_normal(points.shape)


def tailed_problem(noise: float = 0.3, pairs: int = 30, tracks: int = 40) -> tuple[Packed, FloatArray]:
    rng, c = np.random.default_rng(1), exact(pairs, tracks).correspondences
    sets = {name: heavy(getattr(c, name), noise, 3.0, rng) for name in ("left", "right", "tracks")}
    packed = pack(Correspondences(**sets), solver_trials.RIG, solver_trials.SHUTTER)
    return packed, packed.theta(MOTION.w, MOTION.d)


@pytest.mark.parametrize("nu", [3.0, 5.0])
def test_the_distribution_is_that_of_scipy(nu: float) -> None:
    """Of one residual each; the six parameters of a motion are 0.15 % of 2000, and the scale feels twice that."""
    x = 0.2 * np.random.default_rng(0).standard_t(nu, 2000)
    found, scale = t_distribution(x**2, np.ones(2000), 1.0, 1994.0)
    assert found == nu
    assert scale == pytest.approx(t.fit(x, fdf=nu, floc=0.0)[2], rel=4e-3)


def test_normal_errors_have_no_tails() -> None:
    rng = np.random.default_rng(0)
    nu, scale = t_distribution(0.04 * rng.chisquare(5, 1000), np.full(1000, 5.0), 1.0, 4994.0)
    # A t distribution of 30 degrees is wider by sqrt(30 / 28); the standard error of 5000 residuals is 1 %.
    assert nu == 30.0 and scale * np.sqrt(30 / 28) == pytest.approx(0.2, rel=0.03)


def test_rows_disagree_as_noise_lets_them_under_the_true_law_and_by_far_where_it_does_not_hold() -> None:
    """Squares under noise are chi-squared of 30: over 60 draws the mean varies by 3 %."""
    squares = []
    for seed in range(60):
        rng, tracks = np.random.default_rng(seed), exact(0, 120, seed).correspondences.tracks
        tracks = tracks + 0.3 * rng.normal(size=tracks.shape)
        found = []
        for shake_px in (0.0, 1.0):
            moved = tracks.copy()
            moved[:, 4::2] += shake_px * np.sin(2.0 * np.pi * tracks[:, 1:2] / solver_trials.SHUTTER.height)
            packed = pack(Correspondences(tracks=moved), solver_trials.RIG, solver_trials.SHUTTER)
            theta = packed.theta(MOTION.w, MOTION.d)
            tailed = heavy_tailed(packed, theta, 0.3)
            assert tailed is not None
            rows = tailed.by_rows(levenberg_marquardt(tailed.normal_equations, theta, 20, 10.0).theta)
            assert rows is not None and rows.freedom == 30
            found.append(rows)
        still, shaken = found
        squares.append(still.square)
        assert not still.contradict and shaken.contradict
        assert 1.0 <= still.dispersion(1.0) < 3.0 < shaken.dispersion(1.0)
    assert np.mean(squares) == pytest.approx(30.0, rel=0.1)


def test_equations_of_heavy_tails_against_finite_differences() -> None:
    """With noise of 3e-3 px and a scale of 0.05: the Sampson errors' own curvature is then 1e-4 of the Hessian."""
    packed, theta = tailed_problem(noise=3e-3)
    count = len(packed.pairs) + len(packed.tracks)
    trust = np.random.default_rng(0).uniform(0.2, 1.0, count)
    tailed = HeavyTailed(**vars(packed), nu=3.0, scale=0.05, trust=trust)
    _, gradient, H = tailed.normal_equations(theta)
    slope, curvature = (
        derivatives(lambda theta, k=k: tailed.normal_equations(theta)[k], theta, 1e-6) for k in (0, 1)
    )
    np.testing.assert_allclose(gradient, slope, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())
    np.testing.assert_allclose(H, curvature, atol=0.01 * np.abs(H).max())


def normalised(found: MotionEstimate) -> float:
    assert found.covariance is not None
    error = np.concatenate([found.w - MOTION.w, found.d - MOTION.d])
    return float(error @ np.linalg.solve(found.covariance, error))


def with_errors(kind: str, seed: int) -> Correspondences:
    rng, tracks = np.random.default_rng([2, seed]), exact(0, 300, seed).correspondences.tracks
    if kind == "heavy":
        return Correspondences(tracks=heavy(tracks, 0.2, 3.0, rng))
    noise = 0.3 * rng.standard_normal((len(tracks), 4))  # both cameras see a point wrongly alike
    return Correspondences(tracks=tracks + noise[:, [0, 1, 0, 1, 2, 3, 2, 3]])


@pytest.mark.parametrize("kind", ["heavy", "shared"])
def test_covariance_holds_whatever_the_errors(kind: str) -> None:
    """40 trials: below the 99.9 % band of the mean of chi-squared and a tenth more, and above half of it.

    A stated covariance is the larger of two by direction and has factors of at least 1, so that it is up to half
    too large where nothing is shared. Least squares, too, sees the errors of two cameras that one track shares.
    """
    squares, plain = list[float](), list[float]()
    for seed in range(40):
        c = with_errors(kind, seed)
        found = RefinedSolver().weigh(TRUTH, c, solver_trials.RIG, solver_trials.SHUTTER, 0.3)
        assert found is not None and found.success
        squares.append(normalised(found))
        if kind == "shared":
            plain.append(normalised(RefinedSolver().improve(TRUTH, c, solver_trials.RIG, solver_trials.SHUTTER)))
    low, high = np.asarray(chi2.ppf([0.0005, 0.9995], 6 * len(squares))) / len(squares)
    assert low / 2.0 < np.mean(squares) < 1.1 * high
    assert kind == "heavy" or low / 2.0 < np.mean(plain) < 1.1 * high


def test_wrong_matches_nearby_are_no_tails() -> None:
    """A fifth of the tracks are wrong by some px: they are doubted, and the scale stays that of the others.

    Without the uniform part the scale exceeds it by a tenth.
    """
    rng, c = np.random.default_rng(1), exact(0, 300).correspondences
    tracks = c.tracks + 0.3 * rng.standard_normal(c.tracks.shape)
    tracks[:60, 4:] += rng.uniform(-4.0, 4.0, (60, 4))
    packed = pack(Correspondences(tracks=tracks), solver_trials.RIG, solver_trials.SHUTTER)
    tailed = heavy_tailed(packed, packed.theta(MOTION.w, MOTION.d), 0.5)
    assert tailed is not None and tailed.doubt is not None
    assert tailed.scale == pytest.approx(0.3, rel=0.08)
    wrong = len(tailed.doubt) - 240
    assert np.median(tailed.doubt[:wrong]) > 1e3 * np.median(tailed.doubt[wrong:])


@pytest.fixture(scope="module")
def bent() -> tuple[Correspondences, Packed, FloatArray]:
    """Far tracks, a wrong pair of great parallax, and where least squares ends: the pair's residual vanishes.

    Far points fix the direction of d weakly, and the pair, 8 px off, counts for hundreds of them.
    """
    rng, c = np.random.default_rng(0), exact(0, 300, depth=(60.0, 100.0)).correspondences
    near = exact(1, 0, seed=3, depth=(3.0, 3.0)).correspondences.left + np.array([0.0, 0.0, 0.0, 8.0])
    tracks = c.tracks + 0.2 * rng.standard_normal(c.tracks.shape)
    matches = Correspondences(tracks=tracks, left=near)
    packed = pack(matches, solver_trials.RIG, solver_trials.SHUTTER)
    start = packed.theta(MOTION.w, MOTION.d)
    return matches, packed, levenberg_marquardt(packed.normal_equations, start, 60, 50.0).theta


def test_a_wrong_pair_of_great_leverage_does_not_bend_the_motion(
    bent: tuple[Correspondences, Packed, FloatArray],
) -> None:
    matches, packed, theta = bent
    assert np.abs(packed.pair_residuals(theta)[0]) < 0.5  # an inlier, among 300
    w, d = packed.motion(theta)
    start = MotionEstimate(w=w, d=d, success=True)
    assert normalised(RefinedSolver().improve(start, matches, solver_trials.RIG, solver_trials.SHUTTER)) > 100.0
    found = RefinedSolver().weigh(start, matches, solver_trials.RIG, solver_trials.SHUTTER, 0.2)
    assert found is not None and found.covariance is not None
    error = np.concatenate([found.w - MOTION.w, found.d - MOTION.d])
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(found.covariance)))


def test_few_measurements_are_left_to_least_squares() -> None:
    c = exact(0, 29).correspondences
    assert RefinedSolver().weigh(TRUTH, c, solver_trials.RIG, solver_trials.SHUTTER, 0.3) is None


@pytest.mark.parametrize("shutter", [SHUTTER, replace(SHUTTER, right_delay=0.05)])
def test_shifts_of_all_ends_move_the_optimum_as_the_shifted_gradients_say(shutter: RollingShutter) -> None:
    """Against the optimum of matches that are shifted in the image; one step of Newton is good to a per cent."""
    rng = np.random.default_rng(5)
    motion = random_motion(rng, 0.05, 0.3, "linear")
    options = SimulationOptions(pairs=0, tracks=40, noise_px=0.0)
    c = simulate(RIG, shutter, motion, options, rng).correspondences
    packed, px = pack(c, RIG, shutter), 1e-2
    theta = packed.theta(motion.w, motion.d)
    H = packed.normal_equations(theta)[2]
    kinds = [[2], [3], [6], [7], [4, 6], [5, 7]]
    if packed.tracks.ndim == 2:  # rows of stereo matches are not used there
        kinds = [[2], [6], [4, 6], [5, 7]]
    for columns, shifted in zip(kinds, packed.shifted(1e-3), strict=True):
        step = -np.linalg.solve(H, np.sum(each_term(shifted, theta).gradients, axis=0)) * px / 1e-3
        moved = c.tracks.copy()
        moved[:, columns] += px
        again = pack(Correspondences(tracks=moved), RIG, shutter)
        found = levenberg_marquardt(again.normal_equations, theta, 50, 100.0, inverse_length=False).theta
        deviations = np.sqrt(np.diagonal(np.linalg.inv(H)))
        np.testing.assert_allclose(step / deviations, (found - theta) / deviations, atol=0.05 * px * 6.0)
