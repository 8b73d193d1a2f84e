"""Tracks of rigs as they are: what a loose calibration is, and that the left camera's motion is what counts."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from leaderboards import leaderboard, lines_of, oracle_scores, scores_of, truth_lines
from scipy.spatial.transform import Rotation
from small_scenes import write_box_scene

from rsbench.benchmark.leaderboard.rig_tracks import LOOSE, left_camera_motion, loose_of
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.components.cards import list_cards
from rsbench.components.motion_models import TwistMotion
from rsbench.components.rig_tables import load_rig
from rsbench.core.rig import SIDES
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset

RIGS = list_cards("rigs")


@pytest.mark.parametrize("name", RIGS)
def test_a_loose_calibration_is_off_by_what_the_protocol_says(name: str) -> None:
    rig = load_rig(name).rig()
    loose = loose_of("castle", rig)
    assert loose == loose_of("castle", rig) != loose_of("room", rig)
    (R, t), (Rl, tl) = rig.right_from_left, loose.right_from_left
    assert np.degrees(Rotation.from_matrix(Rl @ R.T).magnitude()) == pytest.approx(0.2, abs=1e-6)
    np.testing.assert_allclose(-Rl.T @ tl, -R.T @ t, atol=1e-12)
    for side in SIDES:
        true, given = rig.sensor(side), loose.sensor(side)
        assert (given.width, given.height, given.lens) == (true.width, true.height, true.lens)
        assert abs(given.fx / true.fx - 1.0) == pytest.approx(0.005)
        assert given.fy / true.fy == pytest.approx(given.fx / true.fx)
        assert np.hypot(given.cx - true.cx, given.cy - true.cy) == pytest.approx(0.5)


@pytest.mark.parametrize("name", RIGS)
def test_one_motion_of_the_left_camera_is_one_in_the_axes_of_both_calibrations(name: str) -> None:
    """Through the poses of the left camera, of which the conversion makes no use."""
    rig = load_rig(name).rig()
    loose, motion = loose_of("castle", rig), TwistMotion(np.array([0.03, -0.05, 0.2]), np.array([0.2, -0.1, 0.3]))
    w, d = left_camera_motion(motion.w, motion.d, "body", rig, loose)
    moves = []
    for each, moved in ((rig, motion), (loose.about("left"), TwistMotion(w, d))):
        start, end = (each.cam_from_world(moved, tau, "left") for tau in (0.0, 1.0))
        R = end.R @ start.R.T
        moves.append(np.column_stack([R, end.t - R @ start.t]))
    np.testing.assert_allclose(moves[1], moves[0], atol=1e-12)


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two rigs in a textured box: both cameras roll, and a vertical one whose left camera does not."""
    folder = tmp_path_factory.mktemp("rigs")
    scene = write_box_scene(folder, "box")
    sequences = "".join(
        f'[[sequence]]\nname = "{name}"\nscene = "{scene}"\nrig = "{name}"\nrig_scale = 0.15\n'
        for name in ("shuttum-vertical", "zed2")
    )
    (folder / "card.toml").write_text(f"""
name = "two-rigs"
renderer = "preview"
exposed_twins = true
[motion]
rotation_deg = 2
rotation_axis = [0.2, 1.0, -0.3]
translation = 0.1
translation_axis = [1.0, 0.2, 0.5]
{sequences}""")
    generate_dataset(load_dataset_card(str(folder / "card.toml")), folder / "data")
    return folder / "data"


def test_the_truth_is_exact_with_both_calibrations_and_no_other_axes(rigs: Path, tmp_path: Path) -> None:
    split = TRACKS["pose-rigs"].split(rigs)
    names = [truth.name for truth in split.truths]
    assert names == ["shuttum-vertical", f"shuttum-vertical{LOOSE}", "zed2", f"zed2{LOOSE}"]
    lines = truth_lines(split)
    found = scores_of(split, lines, tmp_path)
    assert list(found["calibration"]) == ["true", "loose"] * 2
    assert np.all(found["e_R_deg"] < 1e-9) and np.all(found["e_T_deg"] < 1e-9)
    # The true motion in the axes of the true calibration, given for the loose one, is off by what these differ.
    lines[2]["w"], lines[2]["d"] = lines[1]["w"], lines[1]["d"]
    found = scores_of(split, lines, tmp_path)
    assert 0.01 < found["e_T_deg"][1] < 1.0 and found["e_T_deg"][0] < 1e-9


def test_methods_are_given_the_loose_calibration_and_never_the_true_one(rigs: Path, tmp_path: Path) -> None:
    for track in ("pose-rigs", "correction-rigs"):
        out = tmp_path / track
        leaderboard("export", track, "--data", rigs, "--out", out, "--secret")
        given = {line["name"]: line for line in lines_of(out / "problems.jsonl")}
        split = TRACKS[track].split(rigs)
        for truth in split.truths:
            focal = given[truth.name]["cameras"]["left"]["fx"] / truth.rig.sensor("left").fx
            assert (abs(focal - 1.0) > 0.004) == truth.name.endswith(LOOSE)
        with (out / "problems.csv").open() as file:
            assert csv.DictReader(file).fieldnames == ["name", "baseline", "readout_ratio"]


def test_frames_are_of_the_sequences_whose_left_camera_rolls(rigs: Path, tmp_path: Path) -> None:
    split = TRACKS["correction-rigs"].split(rigs)
    assert [truth.name for truth in split.truths] == ["zed2", f"zed2{LOOSE}"]
    found = oracle_scores(split, tmp_path)
    assert list(found["truth"]["calibration"]) == ["true", "loose"]
    assert np.all(found["truth"]["picture"] > 1.0 - 1e-9) and np.all(found["truth"]["corrected"] > 0.99)
    assert np.all(found["fusion-true"]["corrected"] > found["uncorrected"]["corrected"])


def test_a_loose_calibration_is_part_of_the_fingerprint(rigs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = TRACKS["pose-rigs"].split(rigs).fingerprint
    monkeypatch.setattr("rsbench.benchmark.leaderboard.rig_tracks.TURN_DEG", 0.3)
    assert TRACKS["pose-rigs"].split(rigs).fingerprint != before
