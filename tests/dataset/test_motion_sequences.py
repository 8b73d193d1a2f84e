"""Rendered sequences of the models that have parameters of their own: files say all, verification holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from small_scenes import write_box_scene

from rsbench.components.cards import parse_card
from rsbench.core.projection import row_poses
from rsbench.dataset.card import CameraCard, MotionCard, load_dataset_card
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.sequence import read_dataset, read_sequence
from rsbench.storage.files import read_json, write_json
from rsbench.verification import verify_dataset
from rsbench.verification.pose_checks import pose_faults

COMMON = {"rotation_deg": 2.0, "rotation_axis": "random", "translation": 0.15, "translation_axis": "random"}
POSES = [[0.01 * k, 0.02 * k, 0.0, 0.06 * k, 0.0, 0.01 * k * k] for k in range(7)]


def motion_card(**fields: object) -> MotionCard:
    return parse_card(MotionCard, fields, "mine.toml")


def test_sequences_of_every_model_are_rendered_verified_and_read_back(tmp_path: Path) -> None:
    smoke, box = load_dataset_card("smoke"), write_box_scene(tmp_path, "box")
    motions = {
        "accelerated": motion_card(model="accelerated", **COMMON),
        "shaken": motion_card(model="spline", **COMMON),
        "posed": motion_card(model="spline", parameters={"interval": 0.5, "poses": POSES}),
    }
    card = replace(
        smoke,
        camera=CameraCard(width=48, height=36, focal=56.0),
        sequence=tuple(
            replace(smoke.sequence[0], name=name, scene=str(box), motion=motion)
            for name, motion in motions.items()
        ),
    ).expanded()
    folder = tmp_path / "out"
    generate_dataset(card, folder)
    assert [report.faults for report in verify_dataset(folder, scenes=[box])] == [(), (), ()]
    for sequence in read_dataset(folder):
        planned = next(card.motion_of(each) for each in card.sequence if each.name == sequence.name)
        expected = row_poses(sequence.rig, sequence.shutter, planned, "left", 1)
        np.testing.assert_array_equal(
            row_poses(sequence.rig, sequence.shutter, sequence.motion, "left", 1).t, expected.t
        )
    # The parameters are part of the truth: another acceleration does not fit the stored poses.
    path = folder / "accelerated" / "sequence.json"
    manifest = read_json(path)
    assert manifest["motion"]["parameters"] == {"acceleration": 0.2}
    manifest["motion"]["parameters"]["acceleration"] = 0.25
    write_json(path, manifest)
    assert read_sequence(path.parent).motion.parameters == {"acceleration": 0.25}
    assert all("differs from the motion" in fault.words for fault in pose_faults(read_sequence(path.parent)))
    assert len(list(pose_faults(read_sequence(path.parent)))) == 4


def test_a_shake_is_drawn_for_each_sequence_and_stays() -> None:
    card = motion_card(model="spline", **COMMON)
    first, second, again = card.drawn(1, "a"), card.drawn(1, "b"), card.drawn(1, "a").drawn(5, "c")
    assert first.parameters["seed"] != second.parameters["seed"]
    assert again == first
    fixed = motion_card(model="spline", parameters={"preset": "drone", "seed": 4}, **COMMON).drawn(1, "a")
    assert fixed.parameters == {"preset": "drone", "seed": 4}


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"model": "spline", "parameters": {"interval": 0.5, "poses": POSES}, "translation": 0.1},
            "fix the motion",
        ),
        ({"model": "spline", "parameters": {"interval": 0.5, "poses": POSES[:6]}}, "needs 7"),
        ({"model": "spline", "parameters": {"present": "drone"}, **COMMON}, "unknown parameter 'present'"),
        ({"model": "accelerated", "parameters": {"acceleration": -1.0}, **COMMON}, "above -0.5"),
        ({"model": "linear", "rotation_deg": 2.0}, "'rotation_axis' is required"),
        ({"model": "liner", **COMMON}, "did you mean 'linear'"),
    ],
)
def test_a_wrong_card_is_one_line(fields: dict[str, object], words: str) -> None:
    with refused(match=words):
        motion_card(**fields)
