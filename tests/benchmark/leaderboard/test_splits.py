"""Splits: their problems, their secrets, and inputs that are the same numbers in every format."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run_here
from leaderboards import small_split

from rsbench.benchmark.leaderboard.inputs import check_place, write_inputs
from rsbench.benchmark.leaderboard.motion_tracks import bound_text
from rsbench.benchmark.leaderboard.splits import exact_problem, simulated_problem
from rsbench.benchmark.leaderboard.submissions import read_submission
from rsbench.benchmark.leaderboard.track import mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.errors import RsbenchError
from rsbench.core.projection import rs_project
from rsbench.pipeline.problem import Problem, read_problems
from rsbench.storage.files import load_arrays


def test_problems_are_of_their_truth() -> None:
    """Without noise and outliers each track is a point: its four pixels are those that the true motion shows."""
    truth = next(t for t in TRACKS["points"].split(None).truths if t.facts["outliers"] == 0.0)
    tracks = simulated_problem(1, int(truth.name[1:])).correspondences.tracks
    assert len(tracks) == truth.facts["points"]
    noise = float(truth.facts["noise_px"])
    start = truth.rig.cam_from_world(truth.motion, truth.shutter.row_time(tracks[:, 1], 0), "left")
    depth = truth.rig.depth(tracks[:, 0] - tracks[:, 2])
    near = depth < 3.0  # where the noise of a disparity moves a point little
    in_cam = truth.rig.camera.unproject(tracks[:, :2]) * depth[:, None]
    world = (np.swapaxes(start.R, 1, 2) @ (in_cam - start.t)[:, :, None])[:, :, 0]
    seen = rs_project(truth.rig, truth.shutter, truth.motion, "left", 1, world[near]).pixels
    assert np.count_nonzero(near) > 3
    assert np.nanmedian(np.abs(seen - tracks[near, 4:6])) < 10.0 * noise


def test_secrets_make_splits_of_their_own(tmp_path: Path) -> None:
    protocol = TRACKS["points"]
    (tmp_path / "seed").write_text("a text that nobody can guess\n", "utf-8")
    secret, again = (protocol.split(None, tmp_path / "seed") for _ in range(2))
    assert secret.fingerprint == again.fingerprint != protocol.split(None).fingerprint
    assert secret.name.startswith("test-") and not secret.public
    (tmp_path / "seed").write_text("12345", "utf-8")
    with pytest.raises(RsbenchError, match="seed: holds 5 characters"):
        protocol.split(None, tmp_path / "seed")


def test_the_public_split_stays_as_it_was_announced() -> None:
    """Predictions of others are of these problems: what changes them is another protocol."""
    assert TRACKS["points"].split(None).name == "dev-f88c896f"


def test_all_inputs_are_the_same_numbers(tmp_path: Path) -> None:
    problems = [simulated_problem(1, number) for number in range(3)]
    write_inputs(small_split(3), iter(problems), tmp_path)
    read = list(read_problems(tmp_path / "problems.jsonl", sys.stdin))
    arrays = load_arrays(tmp_path / "problems.npz")
    rows = list(csv.reader((tmp_path / "tracks.csv").read_text("utf-8").splitlines()))[1:]
    lines = list(csv.DictReader((tmp_path / "problems.csv").read_text("utf-8").splitlines()))
    for k, (problem, given) in enumerate(zip(problems, read, strict=True)):
        assert isinstance(given, Problem)
        assert (given.name, given.rig, given.shutter) == (problem.name, problem.rig, problem.shutter)
        for found in (
            given.correspondences.tracks,
            arrays["tracks"][arrays["tracks_problem"] == k],
            np.array([[float(x) for x in row[1:]] for row in rows if row[0] == problem.name]),
        ):
            np.testing.assert_array_equal(found, problem.correspondences.tracks)
        assert arrays["names"][k] == lines[k]["name"] == problem.name
        assert arrays["rig"][k].tolist() == [float(x) for x in list(lines[k].values())[1:]]
    assert (tmp_path / "truth.jsonl").is_file()


def test_a_secret_split_is_exported_without_its_truth(tmp_path: Path) -> None:
    (tmp_path / "seed").write_text("a text that nobody can guess", "utf-8")
    split = TRACKS["points"].split(None, tmp_path / "seed")
    write_inputs(split, iter([simulated_problem(3, 0)]), tmp_path / "out")
    told = b"".join(path.read_bytes() for path in (tmp_path / "out").iterdir() if path.suffix != ".npz")
    assert not (tmp_path / "out" / "truth.jsonl").exists()
    for truth in split.truths:
        assert all(repr(float(x)).encode() not in told for x in (*truth.motion.w, *truth.motion.d))


def test_motions_at_the_bound_err_as_it_says(tmp_path: Path) -> None:
    """Their squared errors over the bound's covariance are chi-squared with six degrees of freedom: mean 6."""
    split = small_split(40)
    path = tmp_path / "x.jsonl"
    path.write_text(bound_text(split, tmp_path), "utf-8")
    scores = mark(read_submission(path, split), split)
    assert scores["success"].all()
    assert abs(scores["nees"].mean() - 6.0) < 3.0 * np.sqrt(12.0 / 40)  # its variance is 12
    # The bound of tracks without the outliers: no noisy pixel is among the exact ones, and no outlier.
    exact, noise = exact_problem(1, 0)
    given = simulated_problem(1, 0).correspondences.tracks
    near = np.min(np.max(np.abs(exact.correspondences.tracks[:, None] - given[None]), axis=2), axis=1)
    assert len(exact.correspondences.tracks) == round(
        (1.0 - float(split.truths[0].facts["outliers"])) * len(given)
    )
    assert np.all(near < 6.0 * noise) and np.all(near > 0.0)


def test_a_secret_dataset_is_exported_without_its_truth(smoke_dataset: Path, tmp_path: Path) -> None:
    where = ("--data", smoke_dataset, "--out", tmp_path / "out", "--secret")
    assert run_here("leaderboard", "export", "pose-own", *where).returncode == 0
    split = TRACKS["pose-own"].split(smoke_dataset)
    files = [path for path in (tmp_path / "out").rglob("*") if path.suffix in (".csv", ".json", ".jsonl")]
    told = b"".join(path.read_bytes() for path in files)
    assert len(files) == 3 and split.fingerprint.encode() in told
    for truth in split.truths:
        assert all(repr(float(x)).encode() not in told for x in (*truth.motion.w, *truth.motion.d))


def test_inputs_are_written_beside_nothing_else(tmp_path: Path) -> None:
    """Neither over files of somebody, nor beside another split's, nor beside a truth that is secret now."""
    split = small_split(3)
    check_place(split, tmp_path / "new")
    (tmp_path / "tracks.csv").write_text("mine")
    with pytest.raises(RsbenchError, match=r"holds tracks\.csv, not the inputs of"):
        check_place(split, tmp_path)
    out = tmp_path / "out"
    write_inputs(split, iter([simulated_problem(1, number) for number in range(3)]), out)
    check_place(split, out)
    for other in (small_split(4), replace(split, public=False)):
        with pytest.raises(RsbenchError, match="choose another folder"):
            check_place(other, out)
