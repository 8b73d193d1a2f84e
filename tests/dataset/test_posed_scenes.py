"""Which sequences share a scene in the renderer."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rsbench.dataset.card import SequenceCard
from rsbench.dataset.generation import Built, PosedScenes
from rsbench.renderers import scene as renderer
from rsbench.scenes.model import Start


def test_what_is_seen_from_one_place_is_loaded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[tuple[Any, ...]] = []

    def load(seen: tuple[Any, ...]) -> tuple[Any, ...]:
        loaded.append(seen)
        return seen

    monkeypatch.setattr(renderer, "MitsubaScene", load)
    scene: Any = SimpleNamespace(viewpoints={"default": "d", "gate": "g"}, seen_from=lambda *place: place)
    stage = PosedScenes(lambda name: Built(scene, f"hash of {name}"))
    moved = Start(position=(0, 0, 1), quaternion=(1, 0, 0, 0))
    sequences = [
        SequenceCard(name="a", scene="castle"),
        SequenceCard(name="b", scene="castle", readout_ratio=0.3),
        SequenceCard(name="c", scene="castle", start=moved),
        SequenceCard(name="d", scene="castle", viewpoint="gate"),
        SequenceCard(name="e", scene="room"),
    ]
    found = [stage.set_for(sequence) for sequence in sequences]
    assert loaded == [("d", None), ("d", moved), ("g", None), ("d", None)]
    assert [digest for _, digest in found] == ["hash of castle"] * 4 + ["hash of room"]
    assert found[0][0] is found[1][0]
