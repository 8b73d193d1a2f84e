"""The track of one camera: rows, what entries say that they use, a gyroscope, and no look to the right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic_dataset import write_analytic_dataset
from commands import run_here
from leaderboards import PLANES, lines_of

from rsbench.benchmark.leaderboard import running
from rsbench.benchmark.leaderboard.board import entries_of
from rsbench.benchmark.leaderboard.picture_track import SharedWork
from rsbench.benchmark.leaderboard.splits import with_gyro
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core.rig import VIEWS
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import read_dataset

TRACK = TRACKS["correction-mono"]
CARD = """
name = "seen-by-one"
baseline = 0.3
readout_ratio = 0.8
frame_period_s = 0.05
renderer = "preview"
twins = ["middle", "last"]
channels = ["imu"]

[camera]
width = 160
height = 120
focal = 170

[motion]
rotation_deg = 6
rotation_axis = [0.4, 1.0, -0.6]
translation = 0.06
translation_axis = [-0.7, 0.3, -0.6]

[[sequence]]
name = "corridor"
scene = "corridor"
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One sequence with a gyroscope, and the truth of three rows."""
    folder = tmp_path_factory.mktemp("rendered")
    (folder / "card.toml").write_text(CARD, encoding="utf-8")
    generate_dataset(load_dataset_card(str(folder / "card.toml")), folder / "data")
    return folder / "data"


def _here(serve: Any, jobs: Any, workers: int, environment: object, *arguments: object) -> Any:
    """``finished_jobs`` without a child."""
    run = serve(*arguments)
    yield from ((job, run(job)) for job in jobs)


@pytest.mark.slow
def test_methods_are_ranked_by_the_cameras_that_they_see(
    rendered: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running, "finished_jobs", _here)
    where = ("--data", rendered, "--board", tmp_path / "board")
    names = ("mono-fusion", "rotation-only", "gyro", "zhuang", "lao-lines", "fusion")
    cards = [word for name in names for word in ("--entry", name)]
    ran = run_here("leaderboard", "run", TRACK.name, *where, *cards)
    assert ran.returncode == 0, ran.stderr
    assert run_here("leaderboard", "oracles", TRACK.name, *where).returncode == 0
    split = TRACK.split(rendered)
    found = {e.header.method: e for e in entries_of(tmp_path / "board", TRACK.id, split.name)}
    uses = {name: found[name].header.uses[2:] for name in names}
    assert uses == {
        "mono-fusion": ("time",),
        "rotation-only": ("time",),
        "gyro": ("gyro",),
        "zhuang": ("time",),
        "lao-lines": (),
        "fusion": ("stereo", "time"),
    }
    psnr = {
        name: entry.scores.iloc[0][["psnr_first", "psnr_middle", "psnr_last"]] for name, entry in found.items()
    }
    # What turns alone gains, and what knows depth or flow gains more, at every row.
    for name in ("rotation-only", "gyro"):
        assert np.all(psnr[name] > psnr["uncorrected"] + 1.0)
    for name in ("mono-fusion", "fusion"):
        assert np.all(psnr[name] > psnr["rotation-only"])
    assert np.all(psnr["truth"] == np.inf)


def test_a_gyroscope_is_given_where_there_is_one(rendered: Path, tmp_path: Path) -> None:
    assert run_here("leaderboard", "export", TRACK.name, "--data", rendered, "--out", tmp_path).returncode == 0
    (problem,) = lines_of(tmp_path / "problems.jsonl")
    truth = TRACK.split(rendered).truths[0]
    tau, w = np.split(np.array(problem["gyro"]), [1], axis=1)
    assert tau.min() < 0.0 and tau.max() > 1.8
    # The motion turns evenly; 0.02 rad/s of bias on each axis, at 20 frames a second.
    np.testing.assert_allclose(np.mean(w, axis=0), truth.motion.w, atol=4.0 * 0.02 * 0.05)
    assert truth.pictures is not None and "imu/measured.csv" in truth.pictures.files
    # The tracks that do not give it are as they were.
    other = TRACKS["correction"].split(rendered).truths[0].pictures
    assert other is not None and "imu/measured.csv" not in other.files


def test_samples_of_a_pair_of_many_frames_have_its_own_times(rendered: Path) -> None:
    """As those of the sequence, from its frame on; the pair before it is one period earlier."""
    sequence = next(iter(read_dataset(rendered)))
    (problem,) = TRACK.problems(rendered, None, 1)
    later = replace(sequence, first=1, channels=())
    given, shifted = (with_gyro(problem, each).correspondences.gyro for each in (sequence, later))
    both = np.isin(np.round(shifted[:, 0] + 1.0, 9), np.round(given[:, 0], 9))
    assert np.count_nonzero(both) > 10
    rows = {round(float(row[0]), 9): row[1:] for row in given}
    for row in shifted[both]:
        np.testing.assert_array_equal(row[1:], rows[round(float(row[0] + 1.0), 9)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mono-fusion", "flow-scaled", "rotation-only", "zhuang", "vasu-layers"])
def test_nobody_looks_to_the_right(name: str, rendered: Path) -> None:
    """Black images of the right camera give the same frames."""
    split = TRACK.split(rendered)
    (problem,) = TRACK.problems(rendered, None, 1)
    pictures, made = split.truths[0].pictures, list[np.ndarray]()
    assert pictures is not None
    images = {view: pictures.sequence.image("rs", *view) for view in VIEWS}
    for seen in (images, {view: image * (view[0] == "left") for view, image in images.items()}):
        frames, seconds = TRACK.corrected(  # pyrefly: ignore[missing-attribute]
            SharedWork(problem, seen, pictures.requested),
            TRACK.chain(name).options,  # pyrefly: ignore[missing-attribute]
        )
        assert len(frames) == 3 and seconds > 0.0
        made.append(np.stack([frame["left", 1].image for frame in frames]))
    np.testing.assert_array_equal(made[0], made[1])


def test_rows_are_asked_where_their_truth_is(tmp_path: Path) -> None:
    for twins, rows in (((), [0]), ((40,), [0, 40]), ((40, 79), [0, 40, 79])):
        folder = tmp_path / str(len(twins))
        write_analytic_dataset(folder, *PLANES, twins=twins)
        for track, most in (("correction-mono", 3), ("correction", 2)):
            pictures = TRACKS[track].split(folder).truths[0].pictures
            assert pictures is not None and [each.row for each in pictures.requested] == rows[:most]
