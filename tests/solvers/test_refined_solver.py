"""The maximum likelihood of a rig and of one camera against their bounds; all solvers on real cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2
from solver_trials import RIG, SHUTTER, D, W, assert_near, errors_deg, matches_of, robust, trial

from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.benchmark.simulated.simulation import Simulation, random_motion
from rsbench.components.motion_models import LinearMotion, make_motion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import MotionEstimate, SolverSpec, load_solver
from rsbench.solvers.refined import RefinedSolver


def solver_of(model: str, use_tracks: bool = True) -> RefinedSolver:
    return RefinedSolver(motion_model=model, use_tracks=use_tracks)


def assert_motion(estimate: MotionEstimate, motion: Motion, tolerance: float) -> None:
    assert estimate.success, estimate.reason
    np.testing.assert_allclose(estimate.w, motion.w, atol=tolerance)
    np.testing.assert_allclose(estimate.d, motion.d, atol=tolerance)


@pytest.mark.parametrize("model", ["linear", "twist", "inertial", "accelerated"])
@pytest.mark.parametrize("sets", ["pairs", "tracks", "both"])
@given(seed=st.integers(0, 10_000), angle=st.floats(0.5, 6.0), distance=st.floats(0.1, 0.5))
@example(seed=1838, angle=4.5, distance=0.1875)  # of a plane's motions, one is 5 px wrong, most of it in few pairs
@settings(max_examples=12)
def test_exact_on_exact_data(model: str, sets: str, seed: int, angle: float, distance: float) -> None:
    rng = np.random.default_rng(seed)
    motion = random_motion(rng, np.radians(angle), distance, model)
    # Pairs hold the length of d through w x baseline alone.
    assume(sets != "pairs" or np.linalg.norm(motion.w[1:]) > 0.3 * np.linalg.norm(motion.w))
    try:
        c = matches_of(motion, pairs=0 if sets == "tracks" else 40, tracks=0 if sets == "pairs" else 15, seed=seed)
    except ValueError:
        assume(False)
    estimate = solver_of(model).estimate(c, RIG, SHUTTER)
    assert_motion(estimate, motion, 1e-6)
    assert estimate.metric and estimate.direction_known and not estimate.reason


@pytest.mark.parametrize("model", ["linear", "twist", "inertial", "accelerated"])
def test_three_tracks_suffice(model: str) -> None:
    motion = make_motion(model, W, D)
    for seed in range(10):
        c = matches_of(motion, tracks=3, seed=seed)
        assert_motion(solver_of(model).estimate(c, RIG, SHUTTER), motion, 1e-7)
        (proposal,) = solver_of(model).propose(c, RIG, SHUTTER)
        assert_motion(proposal, motion, 1e-5)


@pytest.mark.parametrize(
    ("w", "d", "plane"),
    [
        ([0.0, 0.0, 0.0], [0.2, 0.1, 0.3], False),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.3], False),
        ([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], True),
        ([0.01, -0.03, 0.02], [0.0, 0.0, 0.0], False),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], False),
        ([0.01, -0.03, 0.02], [0.2, 0.1, -0.1], True),
    ],
)
def test_tracks_solve_what_pairs_cannot(w: list[float], d: list[float], plane: bool) -> None:
    motion = LinearMotion(np.array(w), np.array(d))
    estimate = RefinedSolver().estimate(
        matches_of(motion, tracks=40, shape="plane" if plane else "box"), RIG, SHUTTER
    )
    assert_motion(estimate, motion, 1e-7)
    assert estimate.metric


@pytest.mark.parametrize("d", [[0.2, 0.1, 0.3], [0.0, 0.0, 0.3], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0]])
def test_pure_translation_of_pairs_gives_the_direction_without_length(d: list[float]) -> None:
    motion = LinearMotion(np.zeros(3), np.array(d))
    estimate = RefinedSolver().estimate(matches_of(motion, pairs=100, noise_px=0.1), RIG, SHUTTER)
    assert estimate.success and not estimate.metric and "length" in estimate.reason
    assert_near(estimate, motion, 0.05, 0.5)  # the bound is 0.05 degrees here


@pytest.mark.slow
def test_pairs_on_a_plane_are_solved_from_the_motions_of_their_homography() -> None:
    """Exact pairs always; with noise a plane that turns seldom leaves another motion of lower cost."""
    lost = 0
    for seed in range(30):
        motion = random_motion(np.random.default_rng([5, seed]), np.radians(2.0), 0.3)
        exact = RefinedSolver().estimate(matches_of(motion, pairs=100, shape="plane", seed=seed), RIG, SHUTTER)
        assert_motion(exact, motion, 1e-6)
        c = matches_of(motion, pairs=100, shape="plane", seed=seed, noise_px=0.3)
        estimate = RefinedSolver().estimate(c, RIG, SHUTTER)
        lost += int(np.degrees(rotation_error(estimate.w, motion.w)) > 0.3)
    assert lost <= 3


@pytest.mark.slow
def test_a_second_motion_that_a_plane_allows_is_told() -> None:
    """Pure translation before a plane: two motions fit as well, and half of the time the other one fits better."""
    wrong = 0
    for seed in range(20):
        motion = random_motion(np.random.default_rng([5, seed]), 0.0, 0.3)
        c = matches_of(motion, pairs=100, shape="plane", seed=seed, noise_px=0.3)
        estimate = RefinedSolver().estimate(c, RIG, SHUTTER)
        if np.degrees(rotation_error(estimate.w, motion.w)) > 0.5:
            wrong += 1
            assert not estimate.direction_known and "another motion" in estimate.reason
        scattered = RefinedSolver().estimate(matches_of(motion, pairs=100, seed=seed, noise_px=0.3), RIG, SHUTTER)
        assert scattered.direction_known and "another motion" not in scattered.reason
    assert wrong > 0


def test_pure_rotation_has_no_direction() -> None:
    motion = LinearMotion(np.array([0.01, -0.03, 0.02]), np.zeros(3))
    for use_tracks in (True, False):
        c = matches_of(motion, tracks=60, noise_px=0.5)
        estimate = RefinedSolver(use_tracks=use_tracks).estimate(c, RIG, SHUTTER)
        assert estimate.success and not estimate.direction_known and "direction" in estimate.reason
        assert np.degrees(rotation_error(estimate.w, motion.w)) < 0.2


def test_sign_is_that_of_points_in_front() -> None:
    """Cost alone flips d now and then with few noisy matches."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        motion = random_motion(rng, np.radians(2.0), 0.3)
        estimate = RefinedSolver().estimate(matches_of(motion, pairs=20, noise_px=0.5, seed=seed), RIG, SHUTTER)
        assert translation_error(estimate.d, motion.d) < np.pi / 2


def normalised_square(estimate: MotionEstimate, motion: Motion, noise_px: float) -> float:
    """Squared error (w, direction of d, 1 / |d|) over its covariance, at the noise that the data have.

    Pairs feel the length of d as baseline / |d|, so that is where its error is nearly Gaussian.
    """
    assert estimate.covariance is not None and estimate.noise_px is not None
    d, truth = estimate.d, motion.d
    length, unit = np.linalg.norm(d), estimate.d / np.linalg.norm(d)
    across = np.linalg.svd(unit[None])[2][1:]
    J = np.zeros((6, 6))
    J[:3, :3] = np.eye(3)
    J[3:5, 3:], J[5, 3:] = across / length, -unit / length**2
    turned = np.asarray(-across @ truth / np.linalg.norm(truth))
    error = np.array([*(estimate.w - motion.w), *turned, 1.0 / length - 1.0 / np.linalg.norm(truth)])
    covariance = J @ estimate.covariance @ J.T * (noise_px / estimate.noise_px) ** 2
    return float(error @ np.linalg.solve(covariance, error))


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.1, 1.0])
@pytest.mark.parametrize("sets", ["pairs", "tracks"])
def test_covariance_predicts_the_errors(sets: str, noise_px: float) -> None:
    """The mean of 150 normalised squared errors is at most what chi-squared with 6 degrees of freedom allows.

    And, for Hotelling's factor of few matches, no less than for axes that are 1.3 times as long.
    """
    squares, noises = list[float](), list[float]()
    for seed in range(150):
        rng = np.random.default_rng(seed)
        # Rotation about the vertical and the optical axis keeps the length of d observable from pairs.
        motion = LinearMotion(W + 0.004 * rng.standard_normal(3), D + 0.02 * rng.standard_normal(3))
        pairs, tracks = (80, 0) if sets == "pairs" else (0, 80)
        c = matches_of(motion, pairs=pairs, tracks=tracks, noise_px=noise_px, seed=seed)
        estimate = RefinedSolver().estimate(c, RIG, SHUTTER)
        if not estimate.metric:
            continue
        squares.append(normalised_square(estimate, motion, noise_px))
        noises.append(estimate.noise_px or np.nan)
    assert len(squares) >= 148
    band = np.asarray(chi2.ppf([0.005, 0.995], 6 * len(squares))) / len(squares)
    assert band[0] / 1.3**2 < np.mean(squares) < band[1]
    assert np.mean(noises) == pytest.approx(noise_px, rel=0.02)


def test_repeated_matches_do_not_determine_a_rotation() -> None:
    motion = LinearMotion(W, D)
    c = matches_of(motion, pairs=20, tracks=20)
    for repeated in (
        Correspondences(tracks=c.tracks[[0] * 20]),
        Correspondences(left=c.left[[0] * 20], right=c.right[[0] * 20]),
    ):
        assert not RefinedSolver().estimate(repeated, RIG, SHUTTER).success


def test_the_wrong_motion_model_costs_what_is_known() -> None:
    """Twist data under the paper's model: about 0.036 and 0.75 degrees at 2 degrees per frame."""
    errors = []
    for seed in range(20):
        motion = random_motion(np.random.default_rng(seed), np.radians(2.0), 0.3, "twist")
        estimate = RefinedSolver().estimate(matches_of(motion, pairs=100, seed=seed), RIG, SHUTTER)
        errors.append(errors_deg(estimate, motion))
    e_R, e_T = np.median(errors, axis=0)
    assert 0.015 < e_R < 0.08 and 0.35 < e_T < 1.5


def test_tracks_that_the_pairs_repeat_count_once() -> None:
    motion = LinearMotion(W, D)
    c = matches_of(motion, tracks=30, noise_px=0.3)
    both = Correspondences(left=c.tracks[:, [0, 1, 4, 5]], right=c.tracks[:, [2, 3, 6, 7]], tracks=c.tracks)
    alone, repeated = (RefinedSolver().estimate(each, RIG, SHUTTER) for each in (c, both))
    np.testing.assert_allclose(alone.w, repeated.w, atol=1e-10)
    assert alone.covariance is not None and repeated.covariance is not None
    np.testing.assert_allclose(alone.covariance, repeated.covariance, rtol=1e-6)


LEFT = RIG.about("left")
SOLVER = load_solver("rs-mono-refined")


def alone(seed: int, noise_px: float, pairs: int = 100) -> Simulation:
    """The left camera itself moves as the paper's body does: what a single camera's solver assumes."""
    return trial(seed, rig=LEFT, pairs=pairs, noise_px=noise_px)


def test_it_is_at_the_bound_of_one_camera() -> None:
    """The error, by the information of the same matches, is chi-squared with five degrees of freedom."""
    noise, distances, stated = 0.3, list[float](), list[float]()
    for seed in range(40):
        s, exact = alone(seed, noise), alone(seed, 0.0)
        left = Correspondences(left=exact.correspondences.left)
        F = motion_bound(left, LEFT, SHUTTER, s.motion, noise).information
        estimate = SOLVER.estimate(s.correspondences, RIG, SHUTTER)
        assert not estimate.metric and np.linalg.norm(estimate.d) == pytest.approx(1.0, abs=1e-12)
        length = float(np.linalg.norm(s.motion.d))
        error = np.concatenate([estimate.w - s.motion.w, length * estimate.d - s.motion.d])
        distances.append(float(error @ F @ error))
        assert estimate.covariance is not None
        scale = np.repeat([1.0, length], 3)
        stated.append(np.sum(F * (estimate.covariance * np.outer(scale, scale))))
    # Standard deviations of the means: sqrt(2 * 5 / 40) = 0.5. What is stated is the larger of two covariances,
    # with the factors of few measurements and of common errors, at least 1: it may exceed the bound by a half.
    assert np.mean(distances) == pytest.approx(5.0, abs=1.5)
    assert 4.5 < np.mean(stated) < 8.0


def test_the_baseline_and_the_right_camera_say_nothing() -> None:
    s = alone(0, 0.3)
    first = SOLVER.estimate(s.correspondences, RIG, SHUTTER)
    left = Correspondences(left=s.correspondences.left)
    second = SOLVER.estimate(left, replace(RIG, baseline=0.1), SHUTTER)
    # The length that a descent starts with is another: equal up to where it stops.
    np.testing.assert_allclose(second.w, first.w, atol=1e-9)
    np.testing.assert_allclose(second.d, first.d, atol=1e-8)


LENS = Lens(model="brown-conrady", k1=-0.2, k2=0.04, p1=0.001, p2=-0.0005)
CAMERA = PinholeCamera(width=900, height=700, fx=610.0, fy=580.0, cx=440.0, cy=355.0, lens=LENS)
REAL_RIG = StereoRig(camera=CAMERA, baseline=0.5)
REAL_SHUTTER = RollingShutter(height=700, readout_ratio=0.8)
LATE = replace(REAL_SHUTTER, right_delay=0.2)


def test_a_solver_that_says_nothing_takes_ideal_cameras_alone() -> None:
    spec = SolverSpec(
        needs={"left"},
        minimum={"left": 5},
        metric=False,
        motion_model="linear",
        shutter="rolling",
        reference_point="body",
        reference="none",
        assumes="nothing",
    )
    ideal = REAL_RIG.ideal
    assert not spec.refusal(ideal, REAL_SHUTTER)
    assert spec.refusal(REAL_RIG, REAL_SHUTTER) and spec.refusal(ideal, LATE)
    assert not replace(spec, shutter="global").refusal(REAL_RIG, LATE)
    assert replace(spec, cameras="lens").refusal(REAL_RIG, LATE) == (
        "it takes rows from the top that both cameras read at once, and no other scan or delay"
    )
    with pytest.raises(ValueError, match="cameras = 'all': must be one of ideal, lens, any"):
        replace(spec, cameras="all")  # pyrefly: ignore[bad-argument-type]


def test_matches_where_a_lens_shows_nothing_are_named() -> None:
    rig = replace(REAL_RIG, camera=replace(CAMERA, lens=Lens(model="brown-conrady", k1=-0.12)))
    left = np.array([[10.0, 20.0, 30.0, 40.0], [10.0, 20.0, 3000.0, 40.0]])
    matches = Correspondences(left=np.repeat(left, 5, axis=0))
    with pytest.raises(ValueError, match=r"left\[5\] = \[10.0, 20.0, 3000.0, 40.0\]: the lens shows no ray"):
        without_lens(matches, rig)
    found = robust(matches, "rs-stereo-refined", rig=rig, shutter=REAL_SHUTTER)
    assert "left[5]" in found.estimate.reason and not found.estimate.success


def test_disparities_below_their_noise_state_no_deviation() -> None:
    """A baseline of 2 cm, f = 300 px, 1.5 px of noise: the motion is given, its deviation is refused."""
    rig = StereoRig(camera=PinholeCamera.centred(640, 480, 300.0), baseline=0.02)
    shutter = RollingShutter(height=480, readout_ratio=0.8)
    motion = make_motion("linear", [0.0, 0.03, 0.0], [0.1, 0.0, 0.2])
    for noise, refused in ((1.5, True), (0.1, False)):
        c = matches_of(motion, rig=rig, shutter=shutter, tracks=40, noise_px=noise)
        found = RefinedSolver().estimate(c, rig, shutter)
        assert found.success and (found.covariance is None) == refused
        assert ("smaller than their noise" in found.reason) == refused


@pytest.mark.parametrize("one_camera", [False, True])
@pytest.mark.parametrize(("noise", "refused"), [(3.0, True), (0.5, False)])
def test_pairs_that_the_motion_hardly_fits_state_no_deviation(
    one_camera: bool, noise: float, refused: bool
) -> None:
    """Features are located to less than 1.5 px; larger residuals mean another motion or wrong matches."""
    motion = make_motion("linear", W, D)
    matches = matches_of(motion, pairs=120, tracks=0, noise_px=noise)
    found = RefinedSolver(one_camera=one_camera).estimate(matches, RIG, SHUTTER)
    assert found.success and (found.covariance is None) == refused
    assert ("the motion fits matches only to" in found.reason) == refused


def test_negative_disparities_determine_no_direction() -> None:
    """Points beyond infinity and the opposite motion would explain them as well."""
    motion = LinearMotion(np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.3]))
    matches = matches_of(motion, tracks=80, noise_px=0.1)
    estimate = RefinedSolver().estimate(matches, RIG, SHUTTER)
    assert estimate.direction_known and estimate.covariance is not None
    disparities = matches.tracks[:, [0, 4]] - matches.tracks[:, [2, 6]]
    tracks = matches.tracks.copy()
    tracks[:, [2, 6]] += 2.0 * disparities
    beyond = RefinedSolver().estimate(replace(matches, tracks=tracks), RIG, SHUTTER)
    assert not beyond.direction_known and "calibrate the rig again" in beyond.reason
    assert beyond.covariance is None
