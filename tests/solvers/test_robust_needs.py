"""What the robust loop gives a solver of another make: left-right matches, its own loop, its own words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.pose_errors import rotation_error, scale_error, translation_error, translation_of_offset
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
SHUTTER = RollingShutter(height=900, readout_ratio=0.8)


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
        return run(RefinedSolver(), correspondences).estimate


def simulation(pairs: int, tracks: int, outliers: float = 0.3, seed: int = 1) -> Simulation:
    rng = np.random.default_rng(seed)
    motion = random_motion(rng, np.radians(2.0), 0.3)
    options = SimulationOptions(pairs=pairs, tracks=tracks, noise_px=0.5, outlier_ratio=outliers)
    return simulate(RIG, SHUTTER, motion, options, rng)


def run(solver: Solver, c: Correspondences, **keywords: object) -> RobustEstimate:
    options = RobustOptions(max_iterations=200)
    return estimate_motion(c, RIG, SHUTTER, solver, options, np.random.default_rng(0), **keywords)  # pyrefly: ignore[bad-argument-type]


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
    s = simulation(pairs=60, tracks=30)
    solver = LinkedSolver(left=left)
    result = run(solver, pairwise(s.correspondences, 1e-6))
    assert result.estimate.success, result.estimate.reason
    assert solver.samples
    for c in solver.samples:
        assert len(c.left) == left
        assert len(c.stereo_0) == len(c.stereo_1) == linked
        assert len(c.right) == len(c.tracks) == 0
    assert np.degrees(rotation_error(result.estimate.w, s.motion.w)) < 0.1
    assert np.degrees(translation_error(result.estimate.d, s.motion.d)) < 1.5
    assert scale_error(result.estimate.d, s.motion.d) < 0.05
    wrong = s.outliers["tracks"]
    halves = result.inliers["left"][60:]
    # 1.2 % of good tracks lie beyond 2.5 sigma; a wrong one would have to meet five constraints.
    assert np.mean(halves[~wrong]) > 0.9 and not np.any(halves[wrong])
    assert result.counts["tracks"].matches == 30 and result.counts["left"].matches == 60
    assert result.counts["right"].matches == 0 and len(result.inliers["tracks"]) == 0


def test_too_few_linked_matches_is_a_failure_in_words() -> None:
    s = simulation(pairs=60, tracks=2)
    result = run(LinkedSolver(), pairwise(s.correspondences))
    assert not result.estimate.success
    assert "2 matches over time with left-right matches at both ends, a sample needs 3" in result.estimate.reason


def test_left_right_matches_a_hair_off_hold_the_scale() -> None:
    """1e-6 px off the left end, they used to be dropped without a word: e_s .0011 became .030."""
    s = simulation(pairs=0, tracks=200)
    exact, off = (run(RefinedSolver(), pairwise(s.correspondences, shift)) for shift in (0.0, 1e-6))
    assert exact.counts["tracks"].matches == off.counts["tracks"].matches == 200
    assert exact.estimate.reason == off.estimate.reason == ""
    np.testing.assert_allclose(off.estimate.d, exact.estimate.d, atol=1e-6)  # metres; the data moved by 1e-6 px
    assert scale_error(off.estimate.d, s.motion.d) < 0.01


def test_what_did_not_join_is_said() -> None:
    s = simulation(pairs=0, tracks=80)
    c = pairwise(s.correspondences)
    c = replace(c, stereo_0=np.concatenate([c.stereo_0, [[1.0, 2.0, 0.5, 2.0]] * 7]))
    assert "7 of 87 stereo_0 matches join no match over time" in run(RefinedSolver(), c).estimate.reason


def test_the_reason_of_the_solver_is_in_that_of_the_loop() -> None:
    s = simulation(pairs=40, tracks=0)
    solver = StubbornSolver()
    result = run(solver, s.correspondences)
    assert not result.estimate.success
    assert result.estimate.reason.endswith("the solver said most often: it is Sunday")


def test_an_own_loop_is_given_everything_once_and_not_wrapped() -> None:
    s = simulation(pairs=100, tracks=100)
    solver = OwnLoopSolver()
    result = run(solver, s.correspondences, loop="own")
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
    result = run(solver, simulation(pairs=40, tracks=0).correspondences, loop="own")
    assert solver.asked == [40] and result.estimate.reason == "it is Sunday"
    assert result.inlier_count == 0 and result.match_count == 80
    assert not any(np.any(mask) for mask in result.inliers.values())


def test_a_metric_left_camera_is_judged_by_its_own_pairs() -> None:
    """A solver of the left camera that uses left-right matches: its d is not the body's, and no track is lost."""

    @final
    @dataclass(frozen=True, kw_only=True)
    class LeftSolver(Solver):
        inner: LinkedSolver = field(default_factory=LinkedSolver)

        @property
        def spec(self) -> SolverSpec:
            return replace(self.inner.spec, reference_point="left")

        def estimate(
            self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
        ) -> MotionEstimate:
            body = self.inner.estimate(correspondences, rig, shutter)
            if not body.success:
                return body
            return replace(body, d=translation_of_offset(body.w, body.d, rig.offset("left")))

    s = simulation(pairs=0, tracks=100)
    result = run(LeftSolver(), pairwise(s.correspondences))
    assert result.estimate.success, result.estimate.reason
    assert np.mean(result.inliers["left"][~s.outliers["tracks"]]) > 0.9
