"""Stereo relative pose from points in three of four images."""

from __future__ import annotations

import numpy as np
import poselib
import pytest

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, random_motion, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.triplets import Triplets, TripletSolver, View, newton

RIG = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
GLOBAL = RollingShutter(height=900, readout_ratio=0.0)


def trial(seed: int, count: int = 3, noise_px: float = 0.0, outlier_ratio: float = 0.0) -> Simulation:
    motion = random_motion(np.random.default_rng(seed), np.radians(2.0), 0.3)
    options = SimulationOptions(tracks=count, noise_px=noise_px, outlier_ratio=outlier_ratio)
    return simulate(RIG, GLOBAL, motion, options, np.random.default_rng(seed))


@pytest.mark.parametrize("known", [(0, 0, 0), (0, 0, 1), (0, 1, 1), (1, 1, 1)])
def test_every_kind_of_three_triplets_gives_the_exact_motion(known: tuple[int, int, int]) -> None:
    sides: tuple[Side, ...] = ("left", "right", "left")
    views: list[View] = [(0 if frame else 1, side) for frame, side in zip(known, sides, strict=True)]
    errors = []
    for seed in range(30):
        s = trial(seed)
        pose = newton(Triplets.of(s.correspondences.tracks, views, RIG))
        truth = s.motion.body_from_world(1.0)
        errors.append(max(np.abs(pose.R - truth.R).max(), np.abs(pose.t - truth.t).max()))
    # Rounding; another root, or none, in few.
    assert np.mean(np.array(errors) < 1e-9) >= 0.9 and np.median(errors) < 1e-13


def test_points_known_in_frame_0_are_poselib_s_generalised_absolute_pose() -> None:
    """With noise, where the roots are not the truth."""
    views: list[View] = [(1, "left"), (1, "right"), (1, "left")]
    apart = []
    for seed in range(10):
        s = trial(seed, noise_px=0.5)
        triplets = Triplets.of(s.correspondences.tracks, views, RIG)
        pose = newton(triplets)
        seen = s.correspondences.tracks[[0, 1, 2], [[4, 6, 4], [5, 7, 5]]].T
        rays = RIG.camera.unproject(seen)
        unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        roots = poselib.gp3p(-triplets.offset, unit, triplets.X[:, 0])
        apart.append(min(max(np.abs(r.R - pose.R).max(), np.abs(r.t - pose.t).max()) for r in roots))
    # Half the digits are left of close roots in PoseLib's polynomial of degree eight.
    assert np.median(apart) < 1e-9 and np.sum(np.array(apart) < 1e-6) >= 8


def test_many_tracks_and_outliers() -> None:
    s = trial(0, 40)
    found = TripletSolver().estimate(s.correspondences, RIG, GLOBAL)
    np.testing.assert_allclose(np.concatenate([found.w, found.d]), [*s.motion.w, *s.motion.d], atol=1e-12)
    s = trial(3, 150, 0.3, 0.5)
    rng = np.random.default_rng(0)
    robust = estimate_motion(s.correspondences, RIG, GLOBAL, TripletSolver(), RobustOptions(), rng).estimate
    # Three times the median error of the optimum on 75 tracks, 0.01 and 0.08 degrees.
    assert np.degrees(rotation_error(robust.w, s.motion.w)) < 0.03
    assert np.degrees(translation_error(robust.d, s.motion.d)) < 0.4


def test_samples_without_depth_are_told_and_leave_the_others_alone() -> None:
    good, solver = trial(1).correspondences, TripletSolver()
    far = Correspondences(tracks=good.tracks[:, [2, 3, 0, 1, 6, 7, 4, 5]])
    same = Correspondences(tracks=good.tracks[[0, 0, 0]])
    first, second, third = solver.propose_all([far, good, same], RIG, GLOBAL)
    assert "positive disparity" in first[0].reason and not solver.estimate(far, RIG, GLOBAL).success
    alone = solver.propose(good, RIG, GLOBAL)
    assert [m.d.tolist() for m in second] == [m.d.tolist() for m in alone] and all(m.success for m in second)
    assert len(third) == 2
