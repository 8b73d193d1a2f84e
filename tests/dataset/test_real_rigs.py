"""Dataset cards of rigs by name: smaller images of the same rig, and upright pictures of a vertical one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from small_scenes import write_box_card

from rsbench.components.cards import list_cards
from rsbench.components.rig_tables import load_rig
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.dataset.card import DatasetCard, load_dataset_card


def card_of(folder: Path, name: str, more: str = "") -> DatasetCard:
    return load_dataset_card(write_box_card(folder, f'name = "one"\nrig = "{name}"\n{more}'))


@pytest.mark.parametrize("name", list_cards("rigs"))
@pytest.mark.parametrize("scale", [0.5, 0.31, 1.2])
def test_a_smaller_rig_sees_what_the_images_show_when_they_are_resized(
    tmp_path: Path, name: str, scale: float
) -> None:
    whole, card = load_rig(name), card_of(tmp_path, name, f"rig_scale = {scale}")
    rig = card.rig_of(card.sequence[0])
    assert pytest.approx(whole.rig().right_from_left.R, abs=1e-12) == rig.right_from_left.R
    assert rig.baseline == pytest.approx(whole.rig().baseline, rel=1e-12)
    X = np.append(np.random.default_rng(1).uniform(-0.4, 0.4, (60, 2)), np.ones((60, 1)), axis=1)
    for side in SIDES:
        full, small = whole.rig().sensor(side), rig.sensor(side)
        # cv2.resize has the outer borders of the image stay: a ramp of pixel numbers says where pixels go.
        ramp = np.arange(full.width, dtype=np.float64)[None]
        resized = cv2.resize(ramp, (small.width, 1), interpolation=cv2.INTER_LINEAR)[0]
        inner = slice(small.width // 4, -small.width // 4)
        there = np.interp(resized[inner], ramp[0], ramp[0])
        slope, start = np.polyfit(there, np.arange(small.width)[inner], 1)
        seen, expected = small.project(X)[:, 0], slope * full.project(X)[:, 0] + start
        assert np.nanmax(np.abs(seen - expected)) < 0.02
        assert (small.width, small.height) == (round(scale * full.width), round(scale * full.height))


@pytest.mark.parametrize("name", list_cards("rigs"))
def test_the_left_camera_stands_upright_at_a_viewpoint(tmp_path: Path, name: str) -> None:
    card = card_of(tmp_path, name)
    (sequence,) = card.sequence
    turn = np.eye(3) if sequence.start is None else so3.from_quaternion(sequence.start.quaternion)
    camera = card.rig_of(sequence).own("left").R @ turn.T
    assert np.degrees(np.arccos(camera[1, 1])) < 5.0
    assert (sequence.start is not None) == (name == "shuttum-vertical")


@pytest.mark.parametrize("more", ["rig_scale = 0", 'rig_scale = "half"', "rig_scale = 9.0"])
def test_wrong_scales_are_refused_in_one_line(tmp_path: Path, more: str) -> None:
    with pytest.raises(RsbenchError, match=r"rig_scale = .*: must be above 0 and at most 4, beside a rig"):
        card_of(tmp_path, "zed2", more)
