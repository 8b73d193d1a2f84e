"""The track that asks for trajectories: what an answer must be, what it scores, and methods on a small dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic_dataset import write_analytic_dataset
from commands import assert_refused, run_here
from leaderboards import Line, entered, leaderboard, lines_of, named, run_entries, scores_of, truth_lines, write

from rsbench.benchmark.leaderboard.publishing import drawn_split
from rsbench.benchmark.leaderboard.submissions import check_submission, read_submission, write_truth
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.benchmark.trajectory_scores import METHODS
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.dataset.secret_split import Secret

TRACK = TRACKS["trajectory"]
FRAMES = 5
RIG = StereoRig(camera=PinholeCamera.centred(96, 80, 80.0), baseline=0.3)
MOTION = SplineMotion([0.02, -0.01, 0.03], [0.05, 0.02, -0.04], preset="handheld", seed=2, periods=FRAMES + 1)


def _dataset(folder: Path, frames: int = FRAMES, ratio: float = 0.6) -> Path:
    write_analytic_dataset(folder, RIG, RollingShutter(height=80, readout_ratio=ratio), MOTION, frames=frames)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _dataset(tmp_path_factory.mktemp("shaken") / "data")


@pytest.fixture(scope="module")
def split(data: Path) -> Split:
    return TRACK.split(data)


def _poses(tau: FloatArray, invert: bool = False, turn: FloatArray | None = None) -> list[list[float]]:
    """The true way at some times, as an answer has it, about a world that is turned."""
    pose = MOTION.body_from_world(tau)
    R, t = pose if invert else inverse(pose)
    if turn is not None:
        R, t = turn @ R, t @ turn.T
    return np.concatenate([tau[:, None], t, so3.quaternion(R)[:, [1, 2, 3, 0]]], axis=1).tolist()


def _scored(split: Split, folder: Path, **answer: Any) -> dict[str, Any]:
    lines = named(truth_lines(split), "mine")
    row = scores_of(split, [lines[0], {"name": lines[1]["name"], **answer}], folder).iloc[0]
    return {str(key): row[key] for key in row.index}


@pytest.mark.parametrize("ratio", [0.0, 0.6, 1.0])
def test_the_truth_has_the_best_of_everything(tmp_path: Path, ratio: float) -> None:
    split = TRACK.split(_dataset(tmp_path / "data", ratio=ratio))
    row = scores_of(split, write_truth(split, tmp_path)).iloc[0]
    assert row["auc_way"] > 1.0 - 1e-6 and row["auc_rows"] > 1.0 - 1e-6 and row["failure"] == 0.0
    assert row["way_95_deg"] < 1e-6 and row["ate_mm"] < 1e-4 and row["rpe_mm"] < 1e-4
    # Of points between the lines that are told: a spline through them.
    assert row["jitter_px"] < 1e-2


def test_poses_at_any_times_and_in_any_world_are_the_same_trajectory(split: Split, tmp_path: Path) -> None:
    tau = np.linspace(-0.3, FRAMES, 107)
    turned = _scored(split, tmp_path, poses=_poses(tau, turn=so3.exp([0.4, -0.2, 1.0])), metric=True)
    assert turned["way_95_deg"] < 1e-3 and turned["ate_mm"] < 0.05 and turned["auc_way"] > 0.99
    blind = _scored(split, tmp_path, poses=_poses(tau))
    assert (
        np.isnan(blind["ate_mm"])
        and np.isnan(blind["jitter_px"])
        and abs(blind["auc_way"] - turned["auc_way"]) < 1e-6
    )


def test_one_pose_a_frame_misses_the_shake_within_it(split: Split, tmp_path: Path) -> None:
    row = _scored(split, tmp_path, poses=_poses(np.arange(float(FRAMES))), metric=True)
    assert row["ate_mm"] < 1e-3 and row["rpe_deg"] < 1e-3 and row["rows_95_deg"] > 0.02 and row["jitter_px"] > 0.01


def test_failures_and_what_is_not_answered_score_the_worst(split: Split, tmp_path: Path) -> None:
    (header, _) = named(truth_lines(split), "mine")
    missing = scores_of(split, [header], tmp_path).iloc[0]
    failed = _scored(split, tmp_path, success=False, reason="lost")
    for row in (missing, failed):
        assert row["failure"] == row["error"] == 1.0 and row["auc_way"] == row["auc_rows"] == 0.0
        assert row["way_median_deg"] == row["rpe_deg"] == 180.0 and row["ate_mm"] == row["jitter_px"] == np.inf


GOOD = _poses(np.arange(float(FRAMES)))


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ({}, "poses: a success needs two rows"),
        ({"poses": GOOD[:1]}, "poses: a success needs two rows"),
        ({"poses": [row[:7] for row in GOOD]}, "poses"),
        ({"poses": [[*row[:7], 2.0] for row in GOOD]}, "a quaternion is not of length 1"),
        ({"poses": [*GOOD[:2], *GOOD[:2]]}, "later than the previous one"),
        ({"poses": [[row[0], 1e12, *row[2:]] for row in GOOD]}, "within 1e\\+09"),
        ({"poses": [[*row[:4], 0.0, 0.0, float(k % 2), 1.0 - k % 2] for k, row in enumerate(GOOD)]}, "90 degrees"),
        ({"poses": [GOOD[0], [1e-30, *GOOD[1][1:]], *GOOD[1:]]}, "1e-30 frame periods apart"),
        ({"poses": GOOD[:-1]}, "must reach from 0 to 4"),
        ({"poses": [[row[0] + 0.1, *row[1:]] for row in GOOD]}, "0.1|time 0"),
        ({"poses": GOOD, "w": [0.0, 0.0, 0.0]}, "w: does not belong here"),
    ],
)
def test_what_is_no_trajectory_is_a_fault(
    split: Split, tmp_path: Path, answer: dict[str, Any], words: str
) -> None:
    header, truth = named(truth_lines(split), "mine")
    path = write(tmp_path / "mine.jsonl", [header, {"name": truth["name"], **answer}])
    found = check_submission(path, split)
    assert found.submission is None and len(found.faults) == 1
    with pytest.raises(RsbenchError, match=words):
        read_submission(path, split)


def test_poses_of_another_age_cost_nothing(split: Split, tmp_path: Path) -> None:
    """Times and places are limited by 1e9 alone: nothing may be made for each frame period of them."""
    poses = [[-1e9, *GOOD[0][1:]], *GOOD, [1e9, *GOOD[0][1:]]]
    row = _scored(split, tmp_path, poses=poses, metric=True)
    assert row["ate_mm"] < 1e-3 and row["rows_95_deg"] > 0.02
    far = _scored(split, tmp_path, poses=[[pose[0], 1e9, *pose[2:]] for pose in GOOD], metric=True)
    assert far["auc_way"] > 0.0 and np.isfinite(far["ate_mm"])


def test_inverted_poses_are_noted(split: Split, tmp_path: Path) -> None:
    header, truth = named(truth_lines(split), "mine")
    lines: list[Line] = [header, {"name": truth["name"], "poses": _poses(np.arange(float(FRAMES)), invert=True)}]
    assert "near to the truth inverted" in check_submission(write(tmp_path / "a.jsonl", lines), split).notes[0]
    lines[1]["poses"] = GOOD
    assert not check_submission(write(tmp_path / "a.jsonl", lines), split).notes


def test_pairs_are_no_sequences(tmp_path: Path) -> None:
    data = _dataset(tmp_path / "data", frames=2)
    assert_refused(run_here("leaderboard", "template", "trajectory", "--data", data), "has 2 frames", "handheld")
    assert_refused(run_here("leaderboard", "template", "trajectory"), "--data")


def test_a_secret_split_needs_its_rendered_truth() -> None:
    with pytest.raises(RsbenchError, match="--keep"):
        drawn_split(TRACK, "handheld", Secret("a text that nobody can guess"))


@pytest.mark.slow
def test_methods_run_and_make_a_board(data: Path, split: Split, tmp_path: Path) -> None:
    board = ("--board", tmp_path / "board", "--data", data)
    names = ("no-motion", "gs-vo", "gyro-integrated")
    run_entries("trajectory", names, *board)
    found = entered(tmp_path / "board", split)
    assert set(found) == {*names}
    assert not found["gyro-integrated"].scores["success"].any()  # the dataset has none
    # A rig that stands still is off by as far as the true one turns, at nine lines of each frame.
    tau = np.concatenate([frame + 0.6 * np.round(np.linspace(0.0, 79.0, 9)) / 80 for frame in range(FRAMES)])
    turned = np.rad2deg(so3.angle(MOTION.body_from_world(tau).R))
    np.testing.assert_allclose(found["no-motion"].scores["way_median_deg"], np.median(turned), rtol=1e-6)
    leaderboard("oracles", "trajectory", *board)
    leaderboard("build", *board, "--out", tmp_path / "site")
    assert "AUC way" in (tmp_path / "site/index.html").read_text("utf-8")
    assert_refused(run_here("leaderboard", "run", "trajectory", "--entry", "gs-voo", *board), "--entry gs-voo")
    mine = named(truth_lines(split), "rs-trajectory")
    submitted = run_here("leaderboard", "submit", write(tmp_path / "mine.jsonl", mine), *board)
    assert_refused(submitted, "is the name of a method of rsbench")


def test_the_inputs_are_windows_of_sequences(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "inputs"
    leaderboard("export", "trajectory", "--data", data, "--out", out)
    assert [line["name"] for line in lines_of(out / "problems.jsonl")] == [
        f"planes.{k}" for k in range(FRAMES - 1)
    ]
    assert [line["name"] for line in lines_of(out / "truth.jsonl")[1:]] == ["planes"]


def test_what_a_method_says_it_uses_is_what_it_is_given() -> None:
    for method in METHODS.values():
        TRACK.check_uses(method.uses)
