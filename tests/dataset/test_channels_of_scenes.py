"""Channels of scenes that have joints, sills and panes thinner than a pixel: verify must find them sound."""

from __future__ import annotations

from pathlib import Path

import pytest
from yard_dataset import boxes_card

from rsbench.dataset.card import CameraCard, MotionCard
from rsbench.dataset.generation import generate_dataset
from rsbench.verification import verify_dataset


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "width", "focal", "rotation_deg", "seed"),
    [("corridor", 160, 150.0, 2.0, 1), ("street", 96, 80.0, 6.0, 4)],
)
def test_things_thinner_than_a_pixel_are_no_faults(
    tmp_path: Path, scene: str, width: int, focal: float, rotation_deg: float, seed: int
) -> None:
    """Seeds at which joints of a floor were taken for wrong masks, and windows for wrong instances."""
    motion = MotionCard(
        rotation_deg=rotation_deg, rotation_axis="random", translation=0.2, translation_axis="random"
    )
    camera = CameraCard(width=width, height=3 * width // 4, focal=focal)
    channels = ("gs_flow", "instances")
    card = boxes_card(scene, camera=camera, readout_ratio=0.8, motion=motion, channels=channels, seeds=(seed,))
    generate_dataset(card.expanded(), tmp_path / "out")
    (report,) = verify_dataset(tmp_path / "out", rerender="no")
    assert report.faults == ()
