"""The stored scores of the smoke run are those of today's code; what differs is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_here
from leaderboards import leaderboard

from rsbench.benchmark.leaderboard.smoke import CARD, ENTRIES, differences, read_scores
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset

STORED = Path(__file__).parents[3] / "results" / "leaderboard" / "smoke"
QUICK = ("rs-stereo-refined", "gs-poselib", "gs-stereo-tracks")
"""Of the least time; none of them takes another sample on another processor."""


@pytest.mark.skipif(not STORED.is_dir(), reason="needs the committed results")
def test_the_stored_scores_are_those_of_this_code() -> None:
    entries = [word for name in QUICK for word in ("--entry", name)]
    where = ("--track", "points", "--stored", STORED, "--workers", 1)
    shown = leaderboard("smoke", *where, "--problems", 2, *entries)
    assert shown.startswith("6 answers of 3 entries of 1 tracks, 0 differ from ")


def test_each_difference_is_named(tmp_path: Path) -> None:
    text = "method,problem,success,e_R_deg,e_T_deg,e_s,metres,e_row_deg,nees\n"
    rows = ["a,p000,True,0.5,2.0,,,0.6,\n", "a,p001,False,180,180,inf,inf,180,\n", "b,p000,True,1,1,1,1,1,6\n"]
    (tmp_path / "scores.csv").write_text(text + "".join(rows[:2]), "utf-8")
    stored = read_scores(tmp_path)
    (tmp_path / "scores.csv").write_text(text + "".join(rows), "utf-8")
    found = read_scores(tmp_path)
    assert list(differences("points", found, stored)) == ["points, p000, b: has no stored scores"]
    found.loc[0, "e_T_deg"], found.loc[1, "success"] = 2.0 * (1 + 1e-3), True
    found.loc[0, "e_R_deg"] = 0.5 * (1 + 1e-6)  # rounding
    assert list(differences("points", found.iloc[:2], stored)) == [
        "points, p000, a: e_T_deg = 2.002, stored 2",
        "points, p001, a: success = True, stored False",
    ]
    found.loc[0, "e_T_deg"], found.loc[1, "success"] = 2.2, False
    assert list(differences("points", found.iloc[:2], stored, ["p000"])) == []  # of other frames
    found.loc[0, "nees"] = np.inf
    assert "points, p000, a: nees = inf, stored nan" in differences("points", found, stored)


def test_without_stored_scores_nothing_runs(tmp_path: Path) -> None:
    assert_refused(run_here("leaderboard", "smoke", "--track", "points-2"), "--track points-2: has no smoke run")
    points = ("leaderboard", "smoke", "--track", "points", "--stored", tmp_path)
    assert_refused(run_here(*points), "scores.csv")
    assert_refused(
        run_here(*points, "--write", "--workers", 1, "--problems", 251, "--entry", "gs-8pt"), "--problems 251"
    )


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first sequence of the tracks of frames."""
    card = load_dataset_card(CARD)
    folder = tmp_path_factory.mktemp("data") / CARD
    generate_dataset(card.only([card.sequence[0].name]), folder)
    return folder


@pytest.mark.slow
@pytest.mark.skipif(not STORED.is_dir(), reason="needs the committed results")
def test_the_stored_scores_of_frames_are_those_of_this_code(corridor: Path) -> None:
    """All tracks, with what costs least of each: both kinds of cards, and oracles."""
    entries = ("rs-stereo-refined", "gs-stereo-tracks-scaled", "sgm-plain", "fusion", "uncorrected", "truth")
    words = [word for name in entries for word in ("--entry", name)]
    tracks = [word for track in ENTRIES for word in ("--track", track)]
    where = ("--stored", STORED, "--data", corridor, "--workers", 1)
    shown = leaderboard("smoke", *where, *tracks, *words)
    assert shown.splitlines()[-1].startswith("16 answers of 16 entries of 6 tracks, 0 differ from ")


def test_scores_are_stored_by_track(smoke_dataset: Path, tmp_path: Path) -> None:
    """Of another dataset: stored, found again, and named where they are others."""
    smoke = ("smoke", "--stored", tmp_path, "--data", smoke_dataset, "--workers", 1)
    part = ("--track", "pose", "--entry", "gs-stereo-tracks-scaled", "--entry", "truth")
    leaderboard(*smoke, *part, "--write")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pose.csv", "pose.json"]
    assert leaderboard(*smoke, *part).startswith("4 answers of 2 entries of 1 tracks, 0 differ from ")
    text = (tmp_path / "pose.csv").read_text("utf-8")
    (tmp_path / "pose.csv").write_text(text.replace("truth,castle,True,0,", "truth,castle,True,9,"), "utf-8")
    record = (tmp_path / "pose.json").read_text("utf-8")
    (tmp_path / "pose.json").write_text(record.replace('"castle": "', '"castle": "0'), "utf-8")
    ran = run_here("leaderboard", *smoke, *part, "--problems", 1)
    assert ran.returncode == 1
    assert "note: pose: other frames than those of the stored scores: castle\n" in ran.stdout
    assert "pose, castle, truth: e_R_deg = 0, stored 9\n" in ran.stdout
    for words, fault in (
        (("--track", "depth"), "depth.csv"),
        (("--track", "points", "--entry", "sgm"), "--entry sgm: is not run on points"),
        (("--track", "dept"), "dept"),
    ):
        assert_refused(run_here("leaderboard", *smoke, *words), fault)
