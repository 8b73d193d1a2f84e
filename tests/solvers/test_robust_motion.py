"""The robust loop on motions and on lines: outliers, thresholds, left-right matches, reasons of failure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import pytest
from solver_trials import GLOBAL, RIG, SHUTTER, assert_near, robust, trial

from rsbench.benchmark.simulated.simulation import (
    GYRO_RATE,
    Simulation,
    SimulationOptions,
    simulate,
)
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.epipolar import rs_sampson_error
from rsbench.core.pose_errors import rotation_error, scale_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import (
    BESIDE,
    MatchSet,
    MotionEstimate,
    Solver,
    SolverSpec,
    list_solvers,
    load_solver,
    load_solver_entry,
)
from rsbench.solvers.engine.ransac import (
    RansacOptions,
    all_inlier_probability,
    log10_false_alarms,
    required_iterations,
)
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions
from rsbench.solvers.refined import RefinedSolver


def simulation(
    pairs: int = 0, tracks: int = 0, outliers: float = 0.3, noise: float = 0.5, seed: int = 1
) -> Simulation:
    sets = {"pairs": pairs, "tracks": tracks, "gyro_rate": GYRO_RATE, "gravity": True, "affine": True}
    return trial(np.random.default_rng(seed), noise_px=noise, outlier_ratio=outliers, **sets)


def run(s: Simulation, name: str = "rs-stereo-refined", seed: int = 0, **options: Any) -> RobustEstimate:
    return robust(s.correspondences, name, seed=seed, **options)


# Degrees; a few times the error of the same solver on the inliers alone.
@pytest.mark.parametrize(
    ("sets", "e_R", "e_T"), [("pairs", 0.06, 0.6), ("tracks", 0.03, 0.4), ("both", 0.03, 0.4)]
)
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.5])
def test_refined_withstands_outliers(sets: str, outliers: float, e_R: float, e_T: float) -> None:
    for seed in range(3):
        pairs, tracks = (0 if sets == "tracks" else 300), (0 if sets == "pairs" else 200)
        s = simulation(pairs, tracks, outliers, seed=seed)
        result = run(s)
        assert_near(result.estimate, s.motion, e_R, e_T)
        for name in ("left", "right", "tracks"):
            inliers, wrong = result.inliers[name], s.outliers[name]
            assert inliers.shape == wrong.shape
            if len(wrong):
                # 2.5 standard deviations keep 98.8 %; a random match has a few percent to lie near its line.
                assert np.mean(inliers[~wrong]) > 0.95
                most = (0.15 if name != "tracks" else 0.03) * np.count_nonzero(wrong)
                assert np.count_nonzero(inliers & wrong) <= most


def test_the_threshold_rejects_as_many_tracks_as_pairs() -> None:
    s = simulation(pairs=800, tracks=800, outliers=0.0)
    inliers = run(s, adapt_threshold=False).inliers
    for name in ("left", "right", "tracks"):
        # 1.24 % beyond 2.5 sigma; the binomial spread of 800 is 0.4 %.
        assert 1 - np.mean(inliers[name]) == pytest.approx(0.0124, abs=0.012)


@pytest.mark.parametrize(
    ("name", "matches"),
    [  # 40 pairs per camera, and 70 points in all four images of which 50 are repeated as left pairs
        ("gs-8pt", {"left": 110, "right": 0, "tracks": 0}),
        ("rs-stereo-refined-pairs", {"left": 110, "right": 110, "tracks": 0}),
        ("rs-stereo-refined", {"left": 40, "right": 40, "tracks": 70}),
        ("rs-stereo-tracks", {"left": 0, "right": 0, "tracks": 70}),
    ],
)
def test_each_match_counts_once(name: str, matches: dict[MatchSet, int]) -> None:
    s = simulation(pairs=40, tracks=70, outliers=0.0, noise=0.0)
    c = s.correspondences
    left = np.concatenate([c.left, c.tracks[:50, [0, 1, 4, 5]]])
    given = Correspondences(left=left, right=c.right, tracks=c.tracks)
    # A rolling shutter's matches miss a global motion by pixels: 100 px let all of these in.
    threshold = 100.0 if name.startswith("gs") else 1.0
    result = robust(given, name, threshold_px=threshold, adapt_threshold=False)
    assert {key: count.matches for key, count in result.counts.items()} == matches
    assert {key: count.inliers for key, count in result.counts.items()} == matches
    assert result.inlier_count == result.match_count == sum(matches.values())


@pytest.mark.parametrize("name", list_solvers())
def test_every_solver_runs_in_the_loop(name: str) -> None:
    """Low noise and few outliers: what even the most sensitive solver stands."""
    s = simulation(pairs=60, tracks=60, outliers=0.05, noise=1e-3)
    solver = load_solver(name)
    threshold = 0.3 if solver.spec.shutter == "rolling" else 3.0
    result = run(s, name, threshold_px=threshold, max_iterations=300)
    assert_near(result.estimate, s.motion, 0.5, 4.0, solver.spec.reference_point)
    assert set(result.inliers) == {"left", "right", "tracks"}
    assert result.iterations >= 1 and result.seconds > 0.0


# Matches or tracks, share of outliers, and degrees: three to six times the bound of the inliers at 0.3 px.
STANDS = {
    "rs-mono-refined": (200, 0.5, 0.15, 1.2),
    "rs-gyro-5pt": (150, 0.5, 1e-9, 1.0),
    "rs-gyro-stereo": (150, 0.5, 1e-9, 1.0),
    "gs-upright-3pt": (150, 0.5, 0.05, 1.0),
    "gs-upright-4pt": (150, 0.5, 0.05, 1.0),
    "rs-r6p": (150, 0.3, 0.06, 0.6),
    "rs-r6p-single": (150, 0.3, 0.06, 0.6),
    "gs-p3p": (200, 0.5, 0.04, 0.5),
    "gs-stereo-triplets": (150, 0.5, 0.03, 0.4),
}


@pytest.mark.parametrize("name", STANDS)
def test_solvers_withstand_many_outliers(name: str) -> None:
    entry, (count, share, e_R, e_T) = load_solver_entry(name), STANDS[name]
    spec, still = entry.solver.spec, entry.solver.spec.shutter == "global"
    # A rolling shutter's camera alone assumes that it moves itself as the paper's body does.
    alone, sets = spec.reference_point == "left" and not still, "tracks" if "tracks" in spec.needs else "pairs"
    rig, shutter = RIG.about("left") if alone else RIG, GLOBAL if still else SHUTTER
    options: dict[str, Any] = {sets: count, "noise_px": 0.3, "outlier_ratio": share}
    s = trial(3, degrees=3.0, rig=rig, shutter=shutter, gyro_rate=GYRO_RATE, gravity=True, **options)
    found = robust(s.correspondences, entry.solver, shutter=shutter, loop=entry.options.robust)
    assert_near(found.estimate, s.motion, e_R, e_T, "body" if alone else spec.reference_point)
    assert sets == "pairs" or np.mean(found.inliers["tracks"] == ~s.outliers["tracks"]) > 0.95


@final
@dataclass(frozen=True, kw_only=True)
class SpoiledByMany(Solver):
    """The eight-point algorithm, off when it is given more than 40 matches, of which alone it may know metres."""

    off_deg: float = 10.0
    metric_of_many: bool = False

    @property
    def spec(self) -> SolverSpec:
        return load_solver("gs-8pt").spec

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        found = load_solver("gs-8pt").estimate(correspondences, rig, shutter)
        if not found.success or len(correspondences.left) <= 40:
            return found
        return replace(found, w=found.w + np.radians(self.off_deg), metric=self.metric_of_many)


@pytest.mark.parametrize("adapt", [False, True])
def test_a_solver_that_more_matches_make_worse_keeps_what_the_search_found(adapt: bool) -> None:
    """Refits that RANSAC has refused must not come back at its end: the paper's linear solver is like that."""
    slow = RollingShutter(height=900, readout_ratio=1e-6)  # hardly rolls: the eight-point algorithm fits
    s = trial(1, shutter=slow, pairs=200, noise_px=0.1, outlier_ratio=0.2)
    found = robust(s.correspondences, SpoiledByMany(), shutter=slow, adapt_threshold=adapt)
    assert found.estimate.success
    assert found.inlier_count > 0.7 * 200  # 160 of 200 are right
    assert np.degrees(rotation_error(found.estimate.w, s.motion.w)) < 1.0
    # Not when it alone knows the length: minimal samples of some solvers do not, and a scaled one is no better.
    solver = SpoiledByMany(off_deg=0.3, metric_of_many=True)
    knowing = robust(s.correspondences, solver, shutter=slow, adapt_threshold=adapt)
    assert knowing.estimate.success and knowing.estimate.metric


@pytest.mark.parametrize("sets", ["pairs", "tracks"])
@pytest.mark.parametrize("noise", [0.15, 0.5, 1.2])
def test_threshold_follows_the_noise(sets: str, noise: float) -> None:
    s = simulation(300 if sets == "pairs" else 0, 0 if sets == "pairs" else 300, noise=noise)
    result = run(s)
    assert result.threshold_px == pytest.approx(2.5 * noise, rel=0.15)
    fixed = run(s, adapt_threshold=False)
    assert fixed.threshold_px == 1.25


def test_noise_far_above_the_threshold_gets_a_second_try() -> None:
    s = simulation(tracks=300, noise=2.0)
    fixed = run(s, adapt_threshold=False)
    assert np.mean(fixed.inliers["tracks"]) < 0.2
    result = run(s)
    assert result.estimate.success and np.mean(result.inliers["tracks"]) > 0.6
    # Eight times the bound for 210 tracks: 0.018 degrees per pixel.
    assert np.degrees(rotation_error(result.estimate.w, s.motion.w)) < 0.3


def test_wrong_tracks_do_not_hide_right_pairs() -> None:
    s = simulation(pairs=150, outliers=0.2)
    tracks = np.random.default_rng(0).uniform(0, 899, (12, 8))
    c = Correspondences(left=s.correspondences.left, right=s.correspondences.right, tracks=tracks)
    result = robust(c, "rs-stereo-refined", max_iterations=200)
    assert result.estimate.success
    assert np.degrees(rotation_error(result.estimate.w, s.motion.w)) < 0.1
    assert not np.any(result.inliers["tracks"]) and np.mean(result.inliers["left"]) > 0.7


def test_a_rig_that_stands_still_stands_still() -> None:
    motion = LinearMotion(np.zeros(3), np.zeros(3))
    for noise in (0.0, 0.5):
        options = SimulationOptions(tracks=60, noise_px=noise, outlier_ratio=0.2)
        s = simulate(RIG, SHUTTER, motion, options, np.random.default_rng(0))
        result = run(s)
        assert result.estimate.success and not result.estimate.direction_known
        # The bound for 48 tracks is 0.02 degrees and 3 mm.
        assert np.degrees(np.linalg.norm(result.estimate.w)) < 0.1 and np.linalg.norm(result.estimate.d) < 0.01


NEEDS = {load_solver(name).spec.needs: name for name in list_solvers()}


@pytest.mark.parametrize("name", NEEDS.values())
def test_too_few_matches_is_a_failure_with_a_reason(name: str) -> None:
    # Two matches and a gyroscope are enough, and three or four and the direction of gravity.
    pairs, tracks = (1, 0) if BESIDE.keys() & load_solver(name).spec.needs else (2, 2)
    s = simulation(pairs=pairs, tracks=tracks, outliers=0.0)
    result = run(s, name)
    assert not result.estimate.success and result.estimate.reason
    assert not any(np.any(mask) for mask in result.inliers.values())
    empty = robust(Correspondences(), name)
    assert not empty.estimate.success and empty.estimate.reason


def test_no_consensus_is_a_failure_with_a_reason() -> None:
    noise = Correspondences(tracks=np.random.default_rng(0).uniform(0, 899, (40, 8)))
    result = robust(noise, "rs-stereo-refined", max_iterations=50)
    assert not result.estimate.success and "no consensus" in result.estimate.reason


def test_reported_inliers_are_those_of_the_reported_motion() -> None:
    s = simulation(pairs=200)
    result = run(s)
    motion = LinearMotion(result.estimate.w, result.estimate.d)
    errors = rs_sampson_error(RIG, SHUTTER, motion, "left", s.correspondences.left)
    np.testing.assert_array_equal(result.inliers["left"], np.abs(errors) <= result.threshold_px)


@pytest.fixture(scope="module")
def noisy_castle() -> Correspondences:
    """SIFT matches of frames with photon noise of 27 dB: sequence castle-5 of ``rsbench generate moderate``.

    Kept by ``python benchmarks/robust_seeds.py DATASET``, in single precision and without the left-right matches.
    """
    with np.load(Path(__file__).parent / "noisy_castle.npz") as stored:
        return Correspondences(**{name: stored[name] for name in ("left", "right", "tracks")})


def test_every_seed_finds_the_same_motion_in_noisy_frames(noisy_castle: Correspondences) -> None:
    """Least squares on the inliers ends up to 12 stated deviations off: in one of two optima, by a single pair."""
    rig = StereoRig(camera=PinholeCamera.centred(900, 900, 1384.6), baseline=0.5)
    w, d = [-0.00563216, -0.01827359, 0.02920316], [-0.17881409, 0.0446896, 0.23670311]
    found = list[FloatArray]()
    for seed in range(5):
        estimate = robust(noisy_castle, "rs-stereo-refined", rig=rig, seed=seed).estimate
        assert estimate.covariance is not None
        sigma = np.sqrt(np.diag(estimate.covariance))
        found.append(np.concatenate([estimate.w, estimate.d]))
        assert np.all(np.abs(found[-1] - [*w, *d]) < 4.0 * sigma)
    assert np.all(np.std(found, axis=0) < 0.2 * sigma)


@final
@dataclass(frozen=True, kw_only=True)
class LinkedSolver(Solver):
    """Needs left matches whose ends have left-right matches, in the same order; descends on them as tracks."""

    stereo: int = 3
    left: int = 4
    samples: list[Correspondences] = field(default_factory=list)

    @property
    def spec(self) -> SolverSpec:
        minimum: Mapping[MatchSet, int] = {"left": self.left, "stereo": self.stereo}
        return replace(RefinedSolver().spec, needs={"left", "stereo"}, minimum=minimum)

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        c = correspondences
        linked = min(len(c.left), len(c.stereo_0), len(c.stereo_1))
        if len(c.stereo_0) < self.stereo or len(c.left) < self.left:
            return MotionEstimate.failed(f"{len(c.left)} left and {len(c.stereo_0)} linked matches")
        np.testing.assert_array_equal(c.left[:linked, :2], c.stereo_0[:linked, :2])
        np.testing.assert_array_equal(c.left[:linked, 2:], c.stereo_1[:linked, :2])
        tracks = np.concatenate([c.stereo_0, c.stereo_1], axis=1)
        return RefinedSolver().estimate(Correspondences(left=c.left, tracks=tracks), rig, shutter)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        self.samples.append(sample)
        return [self.estimate(sample, rig, shutter)]


@final
@dataclass(frozen=True, kw_only=True)
class StubbornSolver(Solver):
    """Finds nothing and says why; counts how often it was asked, and with how much."""

    asked: list[int] = field(default_factory=list)
    spec = RefinedSolver(use_tracks=False).spec

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        self.asked.append(len(correspondences.left))
        return MotionEstimate.failed("it is Sunday" if len(self.asked) % 3 else "it is Monday")


@final
@dataclass(frozen=True, kw_only=True)
class OwnLoopSolver(Solver):
    """Throws outliers out by itself, as far as the loop knows."""

    asked: list[Correspondences] = field(default_factory=list)
    spec = replace(
        RefinedSolver().spec, needs={"left", "right", "tracks"}, minimum={"left": 1, "right": 1, "tracks": 3}
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        self.asked.append(correspondences)
        return run_loop(RefinedSolver(), correspondences).estimate


def simulated(pairs: int, tracks: int, outliers: float = 0.3, seed: int = 1) -> Simulation:
    generator = np.random.default_rng(seed)
    return trial(generator, pairs=pairs, tracks=tracks, noise_px=0.5, outlier_ratio=outliers)


def run_loop(solver: Solver, c: Correspondences, loop: Literal["ransac", "own"] = "ransac") -> RobustEstimate:
    return robust(c, solver, loop=loop, max_iterations=200)


def pairwise(c: Correspondences, shift: float = 0.0) -> Correspondences:
    """Tracks as left matches and left-right matches, whose left ends are ``shift`` px off."""
    t = c.tracks
    off = np.array([shift, -shift, 0.0, 0.0])
    return Correspondences(
        left=np.concatenate([c.left, track_pairs(t, "left")]),
        stereo_0=t[::-1, :4] + off,
        stereo_1=t[:, 4:] + off,
    )


@pytest.mark.parametrize(("left", "linked"), [(4, 4), (40, 3)])
def test_left_right_matches_reach_the_solver_that_needs_them(left: int, linked: int) -> None:
    """Outliers among 30 tracks, and left matches of other points: samples of linked ones while these suffice."""
    s = simulated(pairs=60, tracks=30)
    solver = LinkedSolver(left=left)
    result = run_loop(solver, pairwise(s.correspondences, 1e-6))
    assert result.estimate.success, result.estimate.reason
    assert solver.samples
    for c in solver.samples:
        assert len(c.left) == left
        assert len(c.stereo_0) == len(c.stereo_1) == linked
        assert len(c.right) == len(c.tracks) == 0
    assert_near(result.estimate, s.motion, 0.1, 1.5)
    assert scale_error(result.estimate.d, s.motion.d) < 0.05
    wrong = s.outliers["tracks"]
    halves = result.inliers["left"][60:]
    # 1.2 % of good tracks lie beyond 2.5 sigma; a wrong one would have to meet five constraints.
    assert np.mean(halves[~wrong]) > 0.9 and not np.any(halves[wrong])
    assert result.counts["tracks"].matches == 30 and result.counts["left"].matches == 60
    assert result.counts["right"].matches == 0 and len(result.inliers["tracks"]) == 0


def test_too_few_linked_matches_is_a_failure_in_words() -> None:
    s = simulated(pairs=60, tracks=2)
    result = run_loop(LinkedSolver(), pairwise(s.correspondences))
    assert not result.estimate.success
    assert (
        "too few matches over time with left-right matches at both ends: 2, a sample needs 3"
        in result.estimate.reason
    )


def test_left_right_matches_a_hair_off_hold_the_scale() -> None:
    """1e-6 px off the left end, they used to be dropped without a word: e_s .0011 became .030."""
    s = simulated(pairs=0, tracks=200)
    exact, off = (run_loop(RefinedSolver(), pairwise(s.correspondences, shift)) for shift in (0.0, 1e-6))
    assert exact.counts["tracks"].matches == off.counts["tracks"].matches == 200
    assert exact.estimate.reason == off.estimate.reason == ""
    np.testing.assert_allclose(off.estimate.d, exact.estimate.d, atol=1e-6)  # metres; the data moved by 1e-6 px
    assert scale_error(off.estimate.d, s.motion.d) < 0.01


def test_the_reason_of_the_solver_is_in_that_of_the_loop() -> None:
    s = simulated(pairs=40, tracks=0)
    solver = StubbornSolver()
    result = run_loop(solver, s.correspondences)
    assert not result.estimate.success
    assert result.estimate.reason.endswith("most frequent failure: it is Sunday")


def test_an_own_loop_is_given_everything_once_and_not_wrapped() -> None:
    s = simulated(pairs=100, tracks=100)
    solver = OwnLoopSolver()
    result = run_loop(solver, s.correspondences, loop="own")
    (given,) = solver.asked
    assert given is s.correspondences
    assert result.estimate.success and result.iterations == 0 and result.seconds > 0.0
    assert np.degrees(rotation_error(result.estimate.w, s.motion.w)) < 0.05
    for name in ("left", "right", "tracks"):
        inliers, wrong = result.inliers[name], s.outliers[name]
        assert np.mean(inliers[~wrong]) > 0.9
        assert np.count_nonzero(inliers & wrong) <= 0.15 * np.count_nonzero(wrong)
    assert result.threshold_px == pytest.approx(2.5 * 0.5, rel=0.15)
    assert result.inlier_count == sum(np.count_nonzero(mask) for mask in result.inliers.values())


def test_an_own_loop_that_fails_has_its_own_reason() -> None:
    solver = StubbornSolver()
    result = run_loop(solver, simulated(pairs=40, tracks=0).correspondences, loop="own")
    assert solver.asked == [40] and result.estimate.reason == "it is Sunday"
    assert result.inlier_count == 0 and result.match_count == 80
    assert not any(np.any(mask) for mask in result.inliers.values())


def test_all_inlier_probability_by_hand() -> None:
    # 3 of 5 good, samples of 2: 3/5 * 2/4.
    assert all_inlier_probability((3,), (5,), (2,)) == pytest.approx(0.3)
    # A second group, 2 of 4 good, samples of 1.
    assert all_inlier_probability((3, 2), (5, 4), (2, 1)) == pytest.approx(0.15)
    assert all_inlier_probability((1,), (5,), (2,)) == 0.0
    assert all_inlier_probability((0, 5), (7, 5), (0, 3)) == 1.0


def test_required_iterations_by_hand() -> None:
    # 1 - (1 - 1/4)^k >= 0.99  ->  k >= ln 0.01 / ln 0.75 = 16.008
    assert required_iterations(0.25, 0.99) == pytest.approx(16.008, abs=1e-3)
    assert required_iterations(1.0, 0.99) == 1.0
    assert required_iterations(0.0, 0.99) == math.inf
    # (1 - p) rounds to 1: the logarithm must not.
    assert required_iterations(1e-18, 0.5) == pytest.approx(math.log(2) * 1e18)


@pytest.mark.parametrize(
    "bad",
    [
        {"threshold": 0.0},
        {"threshold": math.nan},
        {"confidence": 1.0},
        {"min_iterations": 0},
        {"min_iterations": 20, "max_iterations": 10},
        {"lo_steps": -1},
    ],
)
def test_options_of_ransac_refuse_nonsense(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad)).split("_")[0]):
        RansacOptions(**{"threshold": 1.0, **bad})  # pyrefly: ignore[bad-argument-type]
    same = {name.replace("threshold", "threshold_px"): value for name, value in bad.items()}
    with pytest.raises(ValueError, match=next(iter(bad)).split("_")[0]):
        RobustOptions(**same)  # pyrefly: ignore[bad-argument-type]


def test_false_alarms_by_hand() -> None:
    # C(10, 4) = 210 choices, two inliers beyond a sample of 2 at 1 in 100 each, 50 samples: 210 * 50 * 1e-4.
    assert log10_false_alarms(4, 10, 2, 50, 0.01) == pytest.approx(math.log10(210 * 50 * 1e-4), abs=1e-12)
