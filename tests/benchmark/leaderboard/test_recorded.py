"""The track of points on recordings. Truth: SciPy's splines and rotations, and the files themselves."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import assert_refused, run_here
from documents import ROOT
from leaderboards import jobs_here, leaderboard
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsbench.benchmark.leaderboard import recorded, running
from rsbench.benchmark.leaderboard.recorded import (
    DEVICES,
    OF_A_RECORDING,
    recorded_draws,
    recordings_folder,
    recordings_in,
)
from rsbench.benchmark.leaderboard.splits import exact_problem
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.cli import reproduce_leaderboard
from rsbench.cli.reproduce import Target, reproduce
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.dataset.secret_split import Secret

TRACK = TRACKS["points-recorded"]


@pytest.fixture(scope="module")
def split() -> Split:
    return TRACK.split(None)


def test_each_recording_has_as_many_windows_spread_over_it(split: Split) -> None:
    assert split.name == "dev-0bc59642"  # as announced: other problems are another protocol
    assert Counter(truth.facts["recording"] for truth in split.truths) == dict.fromkeys(
        ("car-phone", "hand-kinect", "hand-rig"), OF_A_RECORDING
    )
    order = [truth.facts["recording"] for truth in split.truths]
    assert order != sorted(order, key=str) and len(set(order[:10])) == 3  # names tell no recording
    for truth in split.truths:
        kind = DEVICES[str(truth.facts["recording"]).partition("-")[0]]
        assert (truth.rig.camera.width, truth.rig.camera.height) == (kind.width, kind.height)
        assert 0.5 <= truth.shutter.readout_ratio < 1.0 and truth.motion.name == "trajectory"


def test_rows_move_as_the_recording_does(split: Split) -> None:
    """By SciPy's spline through all poses of the file, wherever in it the window lies."""
    for number in (0, 1, 2, 3):
        truth = split.truths[number]
        rows = np.loadtxt(recordings_folder() / f"{truth.facts['recording']}.txt")
        quaternions = rows[:, 4:].copy()
        flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
        quaternions[1:] *= np.cumprod(np.where(flips, -1.0, 1.0))[:, None]
        place, turn = CubicSpline(rows[:, 0], rows[:, 1:4]), CubicSpline(rows[:, 0], quaternions)
        poses = np.array(truth.motion.parameters["poses"])  # in frame periods of 1/30 s
        at = np.argmin(np.abs(rows[:, 1:4] - poses[0, 1:4]).sum(axis=1))
        zero = rows[at, 0] - poses[0, 0] / 30.0
        tau = np.array([0.0, 0.4, 1.0, 1.0 + truth.shutter.readout_ratio])
        found, world = truth.motion.body_from_world(tau), Rotation.from_quat(turn(zero + tau / 30.0))
        R = (world.inv() * world[0]).as_matrix()
        t = world.inv().apply(place(zero) - place(zero + tau / 30.0))
        assert np.allclose(found.R, R, atol=1e-9) and np.allclose(found.t, t, atol=1e-9)


def test_matches_are_of_points_seen_along_the_path(split: Split) -> None:
    problem, _ = exact_problem(split.seed, 5, split.draws)
    truth, tracks = split.truths[5], problem.correspondences.tracks
    fx, cx, cy = truth.rig.camera.fx, truth.rig.camera.cx, truth.rig.camera.cy

    def seen(motion: Motion, pixels: np.ndarray, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Points in the world at time 0 from the disparity of one frame, whose two rows are the same."""
        z = fx * truth.rig.baseline / (pixels[:, 0] - pixels[:, 2])
        x = (0.5 * (pixels[:, 0] + pixels[:, 2]) - cx) * z / fx
        tau = frame + truth.shutter.readout_ratio * pixels[:, 1] / truth.rig.camera.height
        pose = motion.body_from_world(tau)
        points = np.stack([x, (pixels[:, 1] - cy) * z / fx, z], axis=1) - pose.t
        return np.einsum("nji,nj->ni", pose.R, points), z

    (first, z), (second, _) = seen(truth.motion, tracks[:, :4], 0), seen(truth.motion, tracks[:, 4:], 1)
    assert len(tracks) >= 20 and np.max(np.linalg.norm(first - second, axis=1) / z) < 1e-6


def test_recordings_of_ones_own(tmp_path: Path) -> None:
    """A straight flight: the truth is exact, the split is named after the folder, and solvers run on it."""
    folder = tmp_path / "mine"
    folder.mkdir()
    lines = [f"{0.1 * k:.1f} {0.3 * k:.3f} 0 0 0 0 0 1" for k in range(60)]
    (folder / "drone-straight.txt").write_text("\n".join(lines))
    mine = TRACK.split(folder)
    assert mine.name.startswith("mine-") and len(mine.truths) == OF_A_RECORDING
    assert all(np.allclose(truth.motion.d, [-0.1, 0.0, 0.0], atol=1e-9) for truth in mine.truths)
    where = ("--data", folder, "--board", tmp_path / "board", "--workers", 1)
    shown = leaderboard("run", "points-recorded", "--entry", "rs-stereo-auto", "--problems", 2, *where)
    assert "rs-stereo-auto" in shown
    (file,) = (tmp_path / "board").glob("points-recorded-1/*/entries/*/predictions.jsonl")
    answers = [json.loads(line) for line in file.read_text().splitlines()[1:]]
    assert all(answer["motion_model"] for answer in answers)
    scores = pd.read_csv(file.with_name("scores.csv"))
    assert list(scores["chosen"]) == [answer["motion_model"] for answer in answers]


@pytest.mark.slow
def test_one_command_makes_the_boards_and_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two windows of each recording, and of one's own copy of the drone where it is there."""
    monkeypatch.setattr(recorded, "OF_A_RECORDING", 2)
    monkeypatch.setattr(
        reproduce_leaderboard, "entries_of_laws", lambda: {"points-2": ["gs-8pt", "rs-stereo-auto"]}
    )
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    out, data = tmp_path / "results", tmp_path / "data"
    forget()
    reproduce(Target.recorded, out, data, workers=1)
    assert set(pd.read_csv(out / "recorded/recordings.csv")["recording"]) == set(
        recordings_in(recordings_folder())
    )
    (data / "euroc").mkdir()
    shutil.copy(recordings_folder() / "hand-kinect.txt", data / "euroc/drone-mav.txt")
    reproduce(Target.recorded, out, data, workers=1)
    forget()
    table = pd.read_csv(out / "recorded/recordings.csv")
    assert set(table["problems"]) == {2} and "drone-mav" in set(table["recording"])
    assert set(table["method"]) == {"gs-8pt", "rs-stereo-auto", "truth", "cramer-rao"}
    assert (
        len(list((out / "recorded/tables").glob("*.md"))) == 2
        and "drone-mav" in (out / "recorded/README.md").read_text()
    )
    chosen = pd.read_csv(out / "recorded/choices.csv")
    assert len(chosen) == 8 and (chosen["departure_px"] > 0.0).all()


@pytest.mark.slow
def test_an_announced_split_is_run_beside_the_public_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two windows of each recording; another text, or another split, is not what was announced."""
    monkeypatch.setattr(recorded, "OF_A_RECORDING", 2)
    monkeypatch.setattr(reproduce_leaderboard, "COMPARED", ("gs-8pt",))
    usac = f"{ROOT / 'examples/solvers/opencv_usac.py'}:opencv_usac"
    monkeypatch.setattr(reproduce_leaderboard, "solvers_of_others", lambda: [usac])
    monkeypatch.setattr(running, "finished_jobs", jobs_here)
    forget()
    folder = tmp_path / "results/held-out"
    folder.mkdir(parents=True)
    (folder / "seed.txt").write_text("a text that nobody could guess")
    split = TRACK.split(None, folder / "seed.txt")
    about = {"commitment": Secret("a text that nobody could guess").commitment}
    about |= {"splits": {TRACK.id: {"split": split.name, "fingerprint": split.fingerprint}}}
    (folder / "announced.json").write_text(json.dumps(about))
    reproduce(Target.held_out, tmp_path / "results", tmp_path / "data", workers=1)
    table = pd.read_csv(folder / "scores.csv").set_index("method")
    assert set(table.index) == {"gs-8pt", "opencv_usac"}
    assert table["code"]["gs-8pt"] == "rsbench" and table["code"]["opencv_usac"].startswith("OpenCV")
    board = tmp_path / "data/held-out-board" / TRACK.id
    for name, label in (("dev", TRACK.split(None).name), ("test", split.name)):
        scores = pd.read_csv(board / label / "entries/gs-8pt/scores.csv")
        assert table[f"{name}_score"]["gs-8pt"] == pytest.approx(
            scores["near_bound"].mean(), abs=1e-6
        )  # six digits
    (folder / "seed.txt").write_text("another text that nobody could guess")
    with pytest.raises(RsbenchError, match=r"seed\.txt: draws .* does not announce"):
        reproduce(Target.held_out, tmp_path / "results", tmp_path / "data", workers=1)
    forget()


def forget() -> None:
    """What is kept of the recordings that were read."""
    for function in (recorded_draws, recordings_in, recorded._order, recorded._motion, recorded._setting):
        function.cache_clear()


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    def refused(words: str) -> None:
        forget()
        run = run_here("leaderboard", "template", "points-recorded", "--data", tmp_path / "mine")
        assert_refused(run, words)

    refused("is no folder of recordings")
    (tmp_path / "mine").mkdir()
    refused("has no recording")
    (tmp_path / "mine" / "horse.txt").write_text("0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n")
    refused("its name begins with 'horse'")
    (tmp_path / "mine" / "horse.txt").rename(tmp_path / "mine" / "hand-short.txt")
    (tmp_path / "mine" / "hand-short.txt").write_text("0 0 0 0 0 0 0 1\n0.05 0 0 0 0 0 0 1\n")
    refused("is shorter than two frame periods")
