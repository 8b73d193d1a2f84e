"""Second protocols of frames: a constant wins no ratio, rotation counts, and the card draws what it says."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, run_here
from leaderboards import lines_of, named, truth_lines, write

from rsbench.benchmark.leaderboard.board import entries_of
from rsbench.benchmark.leaderboard.publishing import drawn_split
from rsbench.benchmark.leaderboard.readout_tracks import best_constant
from rsbench.benchmark.leaderboard.submissions import read_submission, write_oracles
from rsbench.benchmark.leaderboard.track import Split, mark
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.core import so3
from rsbench.dataset.card import DatasetCard, load_dataset_card
from rsbench.dataset.secret_split import Secret


@pytest.fixture(scope="module")
def card() -> DatasetCard:
    return load_dataset_card("laws")


@pytest.fixture(scope="module")
def readouts() -> Split:
    """Of the card, from a secret: nothing is rendered."""
    return drawn_split(TRACKS["readout-2"], "laws", Secret("a text that nobody can guess"))


def test_the_card_draws_laws_and_ratios(card: DatasetCard) -> None:
    motions = [card.motion_of(each) for each in card.sequence]
    assert set(Counter(motion.name for motion in motions).values()) == {36} and len(motions) == 180
    assert len({tuple(motion.w) for motion in motions}) == 90  # both sensors see the same
    ratios = np.sort([card.shutter_for(each).readout_ratio for each in card.sequence])
    assert len(set(ratios)) == 180 and ratios[0] >= 0.1 and ratios[-1] <= 0.95
    # Even: the largest distance of 180 such draws from their distribution is below 0.121 in 99 of 100 cases.
    even = (ratios - 0.1) / 0.85
    assert np.max(np.abs(even - np.arange(1, 181) / 180)) < 0.121


@pytest.mark.parametrize("limits", ["[0.9, 0.1]", "[0.1, 1.2]", "[0.5, 0.5]"])
def test_ranges_of_ratios_that_are_none_are_refused(limits: str, tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "cards" / "datasets" / "laws.toml").read_text("utf-8")
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace("[0.1, 0.95]", limits), "utf-8")
    assert_refused(run_here("generate", path, "--out", tmp_path / "out"), "readout_range")


def test_no_constant_wins_the_ratio(readouts: Split, tmp_path: Path) -> None:
    """The best of all constants, found by trying a thousand, has what the oracle has, and that is little."""
    paths = {path.parent.name: path for path in write_oracles(readouts, tmp_path)}
    assert list(paths) == ["truth", "constant"]
    scores = {name: mark(read_submission(path, readouts), readouts)["auc_r10"] for name, path in paths.items()}
    ratios = np.array([truth.shutter.readout_ratio for truth in readouts.truths])
    tried = [np.mean(np.clip(1.0 - np.abs(ratios - c) / 0.1, 0.0, None)) for c in np.linspace(0.0, 1.0, 1001)]
    assert scores["truth"].mean() == 1.0
    assert max(tried) - 1e-3 <= scores["constant"].mean() + 1e-12 and scores["constant"].mean() < 0.2
    assert best_constant([0.2, 0.21, 0.9]) in (0.2, 0.21)
    header, *answers = lines_of(paths["constant"])
    assert header["uses"] == ["truth"] and len({line["readout_ratio"] for line in answers}) == 1


def test_ratios_that_repeat_are_refused(smoke_dataset: Path, tmp_path: Path) -> None:
    counts = Counter(truth.shutter.readout_ratio for truth in TRACKS["pose"].split(smoke_dataset).truths)
    assert max(counts.values()) > 1
    ran = run_here("leaderboard", "template", "readout-2", "--data", smoke_dataset)
    assert_refused(ran, "sequences have the readout ratio")


def test_rotation_counts_apart(readouts: Split, tmp_path: Path) -> None:
    """Of motions whose rotation alone is wrong by 0.05 deg, and of the others."""
    split = replace(readouts, track=TRACKS["pose-2"])
    lines = named(truth_lines(split), "mine", ("left", "right"))
    for line in lines[1:]:
        turned = so3.exp(np.deg2rad([0.05, 0.0, 0.0])) @ so3.exp(np.array(line["w"]))
        line["w"] = so3.log(turned).tolist()
    scores = mark(read_submission(write(tmp_path / "a.jsonl", lines), split), split)
    np.testing.assert_allclose(scores["auc_R"], 0.5, atol=1e-9)
    np.testing.assert_allclose(scores["auc_T"], 1.0, atol=1e-6)  # an angle from its sine and cosine
    np.testing.assert_allclose(scores["auc_apart"], 0.75, atol=1e-6)
    assert set(scores["motion"]) == {"linear", "twist", "inertial", "accelerated", "spline"}


def test_who_chooses_a_law_runs_on_frames(smoke_dataset: Path, tmp_path: Path) -> None:
    board = ("--board", tmp_path / "board", "--data", smoke_dataset)
    ran = run_here("leaderboard", "run", "pose-2", "--entry", "rs-stereo-auto", *board)
    assert ran.returncode == 0, ran.stderr
    split = TRACKS["pose-2"].split(smoke_dataset)
    (entry,) = entries_of(tmp_path / "board", "pose-2", split.name)
    assert entry.header.motion_model == "chosen" and entry.scores["success"].all()
    assert np.all(entry.scores["e_R_deg"] < [float(truth.facts["rotation_deg"]) for truth in split.truths])
    site = run_here("leaderboard", "build", "--board", tmp_path / "board", "--out", tmp_path / "site")
    assert site.returncode == 0, site.stderr
    assert '<td class="text">chosen</td>' in (tmp_path / "site" / "index.html").read_text("utf-8")
