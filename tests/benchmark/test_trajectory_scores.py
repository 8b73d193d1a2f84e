"""Scores of trajectories against evo's and closed forms, methods against the motion that made their matches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_dataset import write_analytic_dataset
from evo.core import metrics
from evo.core.metrics import PoseRelation, StatisticsType
from evo.core.trajectory import PoseTrajectory3D
from solver_trials import matches_of

from rsbench.benchmark.trajectory_scores import (
    METHODS,
    Estimate,
    Given,
    TrueTrajectory,
    absolute_error,
    along,
    chained,
    jitter,
    pnp_motion,
    relative_errors,
    trajectory_scores,
    turn_errors,
)
from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import se3, so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.sequence import read_dataset

RIG = StereoRig(camera=PinholeCamera.centred(160, 120, 140.0), baseline=0.2)
SHUTTER = RollingShutter(height=120, readout_ratio=0.5)
FRAMES = 6
OURS = ("rs-trajectory", "rs-trajectory-streamed")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def _of_evo(poses: Pose) -> PoseTrajectory3D:
    R, t = inverse(poses)
    matrices = np.tile(np.eye(4), (len(t), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = R, t
    return PoseTrajectory3D(poses_se3=list(matrices), timestamps=np.arange(float(len(t))))


def _walk(rng: np.random.Generator, count: int = 20) -> tuple[Pose, Pose]:
    """A trajectory, and another that is a little off, in a world of its own."""
    truth = se3.exp(np.cumsum(0.1 * rng.normal(size=(count, 6)), axis=0))
    off = compose(se3.exp(0.02 * rng.normal(size=(count, 6))), truth)
    return compose(off, se3.exp(rng.normal(size=6))), truth


def test_ate_and_rpe_are_those_of_evo(rng: np.random.Generator) -> None:
    estimate, truth = _walk(rng)
    found, true = _of_evo(estimate), _of_evo(truth)
    expected = []
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_rad):
        rpe = metrics.RPE(relation, 1, metrics.Unit.frames)
        rpe.process_data((true, found))
        expected.append(rpe.get_statistic(StatisticsType.rmse))
    np.testing.assert_allclose(relative_errors(estimate, truth), expected, rtol=1e-9)
    found.align(true)
    ape = metrics.APE(PoseRelation.translation_part)
    ape.process_data((true, found))
    np.testing.assert_allclose(absolute_error(estimate, truth), ape.get_statistic(StatisticsType.rmse), rtol=1e-9)


def test_a_turn_too_slow_by_a_tenth_is_off_by_a_tenth_of_the_way() -> None:
    tau = np.linspace(0.0, 3.0, 31)
    truth, slow = (TwistMotion([0.0, 0.02 * k, 0.0], [0.1, 0.0, 0.0]).body_from_world(tau) for k in (1.0, 0.9))
    np.testing.assert_allclose(turn_errors(slow.R, truth.R), 0.002 * tau, atol=1e-9)
    # In which world they are is no matter.
    turned = slow.R @ so3.exp([0.3, -0.2, 0.1])
    np.testing.assert_allclose(turn_errors(turned, truth.R), 0.002 * tau, atol=1e-9)


def test_what_is_not_known_has_the_worst_score(rng: np.random.Generator) -> None:
    estimate, truth = _walk(rng)
    estimate.R[5], estimate.t[5] = np.nan, np.nan
    errors = turn_errors(estimate.R, truth.R)
    assert errors[5] == np.pi and np.all(np.delete(errors, 5) < 0.2)
    assert absolute_error(estimate, truth) == np.inf and relative_errors(estimate, truth) == (np.inf, np.pi)


def test_jitter_is_the_second_difference_of_what_points_are_off() -> None:
    frames = np.arange(8.0)
    truth = np.zeros((8, 3, 2)) + frames[:, None, None]
    truth[4:, 2] = np.nan  # a point that leaves
    estimate = truth + np.array([3.0, 4.0]) * 0.5 * frames[:, None, None] ** 2
    np.testing.assert_allclose(jitter(estimate, truth), 5.0)
    assert jitter(truth + 2.0 * frames[:, None, None] + 1.0, truth) == 0.0
    assert np.isnan(jitter(estimate[:2], truth[:2]))
    estimate[3, 0] = np.nan
    assert jitter(estimate, truth) == np.inf


def test_windows_of_one_motion_are_chained_to_it() -> None:
    motion = SplineMotion([0.02, -0.01, 0.03], [0.1, 0.02, -0.1], preset="handheld", seed=2, periods=8)
    whole = along(motion, FRAMES - 1)
    chain = chained([motion.from_time(float(k)) for k in range(FRAMES - 1)])
    for frame in range(FRAMES):
        tau = frame + np.linspace(0.0, 0.5, 5)
        R, t = compose(chain.within(frame, tau), chain.start(frame))
        true = motion.body_from_world(tau)
        for estimate in (Pose(R, t), compose(whole.within(frame, tau), whole.start(frame))):
            np.testing.assert_allclose(estimate.R, true.R, atol=1e-12)
            np.testing.assert_allclose(estimate.t, true.t, atol=1e-12)


def test_after_a_window_without_a_motion_nobody_knows_where_the_rig_is() -> None:
    motion = LinearMotion([0.0, 0.01, 0.0], [0.1, 0.0, 0.0])
    chain = chained([motion, None, motion, motion])
    assert chain.failed == 1
    assert np.isnan(chain.within(1, np.array([1.2])).R).all() and np.isnan(chain.start(2).R).all()
    np.testing.assert_allclose(chain.within(2, np.array([2.5])).R[0], so3.exp([0.0, 0.005, 0.0]), atol=1e-15)
    assert np.isfinite(chain.start(1).R).all()


def _tracks(motion: Motion, shutter: RollingShutter = SHUTTER, seed: int = 0) -> FloatArray:
    """Exact tracks (n, 8) of points in front of the rig, in all four images."""
    return matches_of(motion, seed=seed, rig=RIG, shutter=shutter, tracks=150, depth=(3.0, 8.0)).tracks.copy()


def test_a_global_shutter_is_seen_by_pnp_to_rounding(rng: np.random.Generator) -> None:
    motion = LinearMotion([0.02, -0.01, 0.03], [0.1, 0.02, -0.1])
    tracks = _tracks(motion, RollingShutter(height=120, readout_ratio=0.0))
    tracks[:20, 4:6] += rng.uniform(-30.0, 30.0, size=(20, 2))
    found = pnp_motion(tracks, RIG)
    assert found is not None
    np.testing.assert_allclose(found.w, motion.w, atol=1e-5)
    np.testing.assert_allclose(found.d, motion.d, atol=1e-4)
    assert pnp_motion(tracks[:5], RIG) is None


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> TrueTrajectory:
    bands = [[0.05, 0.1, 0.5, 0.01], [0.1, 0.3, 0.1, 0.001]]
    given = {"interval": 0.5, "periods": 8, "spectrum": {"path": [0, 0.2, 0, 0, 0, -0.05], "bands": bands}}
    w, d = SplineMotion.endpoint(given) or (np.zeros(3), np.zeros(3))
    folder: Path = tmp_path_factory.mktemp("shaken") / "data"
    write_analytic_dataset(folder, RIG, SHUTTER, SplineMotion(w, d, **given), frames=FRAMES)
    return TrueTrajectory.of(read_dataset(folder)[0])


@pytest.mark.slow
def test_methods_in_the_order_of_what_they_know(shaken: TrueTrajectory) -> None:
    """Exact matches: what fits the shake is near it, what assumes another motion is not."""
    motion = shaken.sequence.motion
    windows = [Correspondences(tracks=_tracks(motion.from_time(float(k)), seed=k)) for k in range(FRAMES - 1)]
    problem = Given(rig=RIG, shutter=SHUTTER, matches=windows)
    found = {}
    for name in (*OURS, "windows-linear", "gs-vo", "no-motion"):
        estimate = METHODS[name].solve(problem)
        assert estimate is not None
        found[name] = trajectory_scores(shaken, estimate)
        assert found[name]["failed"] == 0.0
    assert METHODS["gyro-integrated"].solve(problem) is None
    for key in ("rows_median_deg", "way_median_deg", "ate_mm", "rpe_mm", "rpe_deg", "jitter_px"):
        for name in OURS:
            assert found[name][key] < 0.2 * min(found["windows-linear"][key], found["gs-vo"][key]), (name, key)
    assert found["windows-linear"]["way_median_deg"] < found["no-motion"]["way_median_deg"]


def test_the_truth_has_no_error_and_one_without_positions_no_drift(shaken: TrueTrajectory) -> None:
    exact = trajectory_scores(shaken, shaken.estimate)
    np.testing.assert_allclose([exact.pop("auc_way"), exact.pop("auc_rows")], 1.0, rtol=1e-12)
    assert all(abs(value) < 1e-6 for value in exact.values())
    blind = along(shaken.sequence.motion, FRAMES - 1, positions=False)
    found = trajectory_scores(shaken, blind)
    assert np.isnan([found[key] for key in ("ate_mm", "rpe_mm", "jitter_px")]).all()
    assert found["way_95_deg"] < 1e-6


def test_a_trajectory_with_a_hole_has_the_worst_drift(shaken: TrueTrajectory) -> None:
    windows: list[Motion | None] = [shaken.sequence.motion.from_time(float(k)) for k in range(FRAMES - 1)]
    windows[2] = None
    estimate: Estimate = chained(windows)
    found = trajectory_scores(shaken, estimate)
    assert found["failed"] == 1.0 and found["rows_median_deg"] < 1e-6 and found["rows_95_deg"] == 180.0
    assert found["way_95_deg"] == 180.0 and found["ate_mm"] == found["jitter_px"] == np.inf
