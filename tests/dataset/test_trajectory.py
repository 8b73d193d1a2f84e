"""A user's trajectory: read strictly, cut into pairs, hit at its own stamps, rendered and verified."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, refused, run_here
from numpy.typing import ArrayLike
from small_scenes import write_box_scene, write_small_card

from rsbench.core import so3
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import world_from_body
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.motion_cards import TrajectoryCard, parts_along, read_trajectory
from rsbench.scenes.model import Viewpoint
from rsbench.storage.files import read_json, write_json
from rsbench.verification import verify_dataset

RATE, COUNT = 40.0, 41
"""Poses of one second."""


def _walk(seconds: ArrayLike) -> Pose:
    """Some way in a box of 6 x 10 x 4 m, from its middle, and a look around."""
    s = np.asarray(seconds)
    turn = so3.exp(np.stack([0.1 * np.sin(5 * s), 0.3 * s, 0.05 * np.cos(7 * s)], axis=-1))
    return Pose(turn, np.stack([0.5 * np.sin(2 * s), 0.1 * np.cos(6 * s), 0.6 * s], axis=-1))


def _write(path: Path, poses: Pose) -> Path:
    lines = ["# a comment", ""]
    for k, (R, t) in enumerate(zip(poses.R, poses.t, strict=True)):
        w, x, y, z = so3.quaternion(R).tolist()
        stamp = Decimal("1305031102.175304") + Decimal("0.025") * k
        lines.append(" ".join([str(stamp), *(repr(float(value)) for value in (*t, x, y, z, w))]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return _write(tmp_path / "walk.txt", _walk(np.arange(COUNT) / RATE))


def _card(folder: Path) -> Path:
    return write_small_card(folder, [write_box_scene(folder, "box")])


def test_every_pose_of_the_file_is_hit_at_its_own_time(tmp_path: Path, walk: Path) -> None:
    card = load_dataset_card(str(_card(tmp_path)), walk)
    stamps, truth = np.arange(COUNT) / RATE, _walk(np.arange(COUNT) / RATE)
    assert [sequence.name for sequence in card.sequence] == [f"box-{k:04d}" for k in range(5)]
    first = Pose(truth.R[0], truth.t[0])
    for number, sequence in enumerate(card.sequence):
        assert sequence.start is not None and sequence.motion is not None
        start = Pose(so3.from_quaternion(sequence.start.quaternion), np.asarray(sequence.start.position))
        tau = (stamps - 0.2 * number) / card.frame_period_s
        seen = (tau > -1e-9) & (tau < 1.8)
        assert np.sum(seen) >= 7
        # Where the body is in the frame of the viewpoint, which is the first pose of the file.
        found = compose(start, inverse(card.motion_of(sequence).body_from_world(tau[seen])))
        given = compose(inverse(first), Pose(truth.R[seen], truth.t[seen]))
        np.testing.assert_allclose(found.R, given.R, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.t, given.t, rtol=0, atol=1e-9)


def test_pairs_follow_each_other_as_the_card_says(walk: Path) -> None:
    def starts(**keys: float) -> FloatArray:
        card = TrajectoryCard(file="walk.txt", absolute=True, **keys)  # pyrefly: ignore[bad-argument-type]
        return np.array([pair.start.position for pair in parts_along(card, walk.parent, 0.1, (-0.1, 1.9), 2)])

    # A pair takes 0.2 s, and begins 0.01 s after the first pose, for it is exposed from then on.
    for found, times in (
        (starts(), 0.01 + 0.2 * np.arange(5)),
        (starts(step=1, start_s=0.5), 0.51 + 0.1 * np.arange(4)),
    ):
        np.testing.assert_allclose(found, np.asarray(_walk(times).t), rtol=0, atol=1e-5)
    assert len(starts(pairs=2)) == 2


def test_what_a_sequence_keeps_of_a_long_file_is_enough(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    count = 400
    poses = Pose(so3.exp(np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0)), rng.normal(0, 1, (count, 3)))
    path = _write(tmp_path / "long.txt", poses)
    whole = read_trajectory(path, 1.0)
    pair = parts_along(TrajectoryCard(file="long.txt", start_s=5.0), tmp_path, 0.1, (0.0, 2.0), 2)[0]
    assert len(pair.poses) < 64
    tau = np.linspace(0, 2, 50)
    all_rows = np.column_stack([(whole.seconds - 5.0) / 0.1, whole.poses])
    # The rest decays by 2 - sqrt(3) from pose to pose: 24 of them leave 2e-14 of some metres.
    for part, full in zip(world_from_body(pair.poses, tau), world_from_body(all_rows, tau), strict=True):
        np.testing.assert_allclose(part, full, rtol=0, atol=1e-12)


def test_an_absolute_pose_is_one_of_the_scene(walk: Path) -> None:
    pair = parts_along(TrajectoryCard(file="walk.txt", absolute=True), walk.parent, 0.1, (0.0, 2.0), 2)[1]
    R, t = pair.start.world_from_scene(Viewpoint(eye=(9, 9, 9), target=(0, 0, 0)))
    place = _walk(np.array(0.2))
    np.testing.assert_allclose(R @ (place.t + place.R @ [0.1, 0.2, 0.3]) + t, [0.1, 0.2, 0.3], atol=1e-9)


LINE = "{} 0 0 0 0 0 0 1"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "has 0 poses, at least 2"),
        (["0 0 0 0 0 0 1"], "line 1: has 7 words; write the 8 numbers timestamp tx ty tz qx qy qz qw"),
        (["0,0,0,0,0,0,0,1"], "line 1: has 1 words"),
        (["# x", "0 0 0 zero 0 0 0 1"], "line 2: not 8 finite numbers"),
        (["nan 0 0 0 0 0 0 1"], "line 1: not 8 finite numbers"),
        ([LINE.format(0), "1 0 0 inf 0 0 0 1"], "line 2: not 8 finite numbers"),
        (["0 0 0 0 0.5 0 0 0.5"], "line 1: its quaternion has the length 0.707"),
        ([LINE.format(0.5), "", LINE.format(0.5)], "line 3: its timestamp is not later"),
        ([LINE.format(0), LINE.format(10**9)], r"line 2: is 1e\+09 s after the previous pose"),
        ([LINE.format(0), "0.1 0 0 0 1 0 0 0"], "line 2: turns by 180 degrees"),
        ([LINE.format(0), LINE.format(0.1)], "lasts 0.1 s; a pair of frames from start_s = 0 on needs 0.18 s"),
    ],
)
def test_a_wrong_file_is_one_line_with_its_number(tmp_path: Path, lines: list[str], words: str) -> None:
    path = tmp_path / "walk.txt"
    path.write_text("\n".join(lines))
    with refused(str(path), match=words):
        parts_along(TrajectoryCard(file="walk.txt"), tmp_path, 0.1, (0.0, 1.8), 2)


def test_the_command_refuses_in_one_line(tmp_path: Path) -> None:
    result = run_here("generate", _card(tmp_path), "--out", tmp_path / "out", "--trajectory", tmp_path / "no.txt")
    assert_refused(result, "no.txt", "cannot be read")


def test_a_card_has_a_motion_or_a_trajectory(tmp_path: Path) -> None:
    card = load_dataset_card(str(_card(tmp_path)))
    with pytest.raises(ValueError, match="exclude each other"):
        replace(card, trajectory=TrajectoryCard(file="walk.txt"))
    with pytest.raises(ValueError, match="'motion' is required"):
        replace(card, motion=None)


def test_it_is_rendered_verified_and_refused_when_moved(tmp_path: Path, walk: Path) -> None:
    path = _card(tmp_path)
    text = path.read_text().partition("[motion]")[0].replace("96", "48").replace("64", "36")
    text += '[trajectory]\nfile = "walk.txt"\npairs = 1\nabsolute = true\nstart_s = 0.5\n'
    path.write_text(f'{text}[[sequence]]\nname = "box"\nscene = "{tmp_path / "box.toml"}"\n')
    card, out, scenes = load_dataset_card(str(path)), tmp_path / "out", (tmp_path / "box.toml",)
    assert generate_dataset(card, out) == ["box-0000"]
    assert generate_dataset(card, out) == []
    assert [report.faults for report in verify_dataset(out, 8, rerender="auto", scenes=scenes)] == [()]
    assert str(tmp_path) not in str(read_json(out / "dataset.json")["card"]["trajectory"])
    # Another place in the scene gives other images, and is not that of the card.
    manifest = out / "box-0000" / "sequence.json"
    content = read_json(manifest)
    content["scene"]["start"]["position"][0] += 0.05
    write_json(manifest, content)
    (report,) = verify_dataset(out, 8, rerender="auto", scenes=scenes)
    assert any("scene.start" in fault for fault in report.faults)
    assert any("new rendering" in fault for fault in report.faults)
