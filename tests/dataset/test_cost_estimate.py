"""What ``--estimate`` tries and counts; that it is near what is rendered: test_generation.py."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rsbench.dataset import generation
from rsbench.dataset.card import DatasetCard, SequenceCard, load_dataset_card
from rsbench.dataset.generation import Built
from rsbench.dataset.sequence import files_of
from rsbench.renderers import scene as renderer


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bool]]:
    """Scene, and whether the sensor is real, of what would have been rendered."""
    tried: list[tuple[str, bool]] = []

    def render(card: DatasetCard, sequence: SequenceCard, *rest: Any) -> Iterator[None]:
        side, frame, folder, _ = rest[-4:]
        real = card.sensor_of(sequence) is not None
        tried.append((sequence.scene, real))
        Path(folder, "rs", f"{side}_{frame}.png").write_bytes(b"x" * (300 if real else 100))
        yield

    monkeypatch.setattr(generation, "build_scene", lambda name: Built(SimpleNamespace(glossy=False), ""))  # pyrefly: ignore[bad-argument-type]
    monkeypatch.setattr(generation, "seen_scene", lambda scene, sequence: scene)
    monkeypatch.setattr(generation, "render_camera", render)
    monkeypatch.setattr(renderer, "MitsubaScene", lambda seen: seen)
    return tried


def listed_files(card: DatasetCard) -> int:
    return 2 + sum(1 + len(files_of(card.manifest_of(sequence))) for sequence in card.sequence)


def test_every_sensor_of_a_scene_is_tried_and_stands_for_its_own(tried: list[tuple[str, bool]]) -> None:
    card = load_dataset_card("standard")
    found = generation.estimate_dataset(card, lambda scene: None)
    scenes = {sequence.scene for sequence in card.sequence}
    assert set(tried) == {(scene, real) for scene in scenes for real in (False, True)}
    # The first picture of each sensor is made twice, for it compiles.
    assert len(tried) == 2 * len(scenes) + 2
    files = listed_files(card)
    assert (found.sequences, found.files) == (216, files)
    assert found.bytes == 4 * 108 * (100 + 300) + 200 * files


def test_moving_objects_can_be_estimated(tried: list[tuple[str, bool]]) -> None:
    """Their motions have parameters, which Python does not hash."""
    card = load_dataset_card("stress")
    found = generation.estimate_dataset(card, lambda scene: None)
    assert (found.sequences, found.files) == (45, listed_files(card))
    assert set(tried) == {(sequence.scene, True) for sequence in card.sequence}
