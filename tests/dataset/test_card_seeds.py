"""Cards that repeat their sequences over seeds and draw axes."""

from __future__ import annotations

import numpy as np
import pytest
from yard_dataset import boxes_card

from rsbench.dataset.card import DatasetCard, MotionCard, SequenceCard


def _card(**changes: object) -> DatasetCard:
    motion = MotionCard(rotation_deg=2.0, rotation_axis="random", translation=0.3, translation_axis="random")
    sequences = (SequenceCard(name="a", scene="castle"), SequenceCard(name="b", scene="room"))
    return boxes_card("castle", **({"motion": motion, "seeds": (1, 2), "sequence": sequences} | changes))


def test_every_sequence_is_made_once_per_seed() -> None:
    card = _card().expanded()
    assert [(s.name, s.scene, s.seed) for s in card.sequence] == [
        ("a-1", "castle", 1),
        ("a-2", "castle", 2),
        ("b-1", "room", 1),
        ("b-2", "room", 2),
    ]
    # What is written down says all: expanding it again changes nothing.
    assert card.expanded() == card


def test_axes_change_with_seed_and_sequence_and_keep_their_lengths() -> None:
    card = _card().expanded()
    motions = [card.motion_of(sequence) for sequence in card.sequence]
    assert len({tuple(motion.w) for motion in motions}) == 4
    for motion in motions:
        np.testing.assert_allclose(np.linalg.norm(motion.w), np.deg2rad(2.0), rtol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(motion.d), 0.3, rtol=1e-12)


def test_an_axis_is_not_used_before_it_is_drawn() -> None:
    with pytest.raises(ValueError, match="random"):
        _card().motion_of(_card().sequence[0])


def test_axes_are_uniform_on_the_sphere() -> None:
    card = _card(seeds=tuple(range(2000)), sequence=(SequenceCard(name="a", scene="castle"),)).expanded()
    axes = np.array([sequence.motion.rotation_axis for sequence in card.sequence if sequence.motion])
    # Each component of a uniform direction has mean 0 and variance 1/3; 5 standard errors of 2000 draws.
    assert np.all(np.abs(axes.mean(axis=0)) < 5 * np.sqrt(1 / 3 / 2000))
    assert np.all(np.abs((axes**2).mean(axis=0) - 1 / 3) < 5 * np.sqrt(4 / 45 / 2000))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": (1, 1)}, "must differ"),
        ({"sequence": (SequenceCard(name="a", scene="castle", seed=3),)}, "exclude each other"),
    ],
)
def test_contradictions_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _card(**changes)


def test_an_axis_is_numbers_or_random() -> None:
    with pytest.raises(ValueError, match='three numbers or "random"'):
        MotionCard(rotation_deg=2.0, rotation_axis="up", translation=0.3, translation_axis="random")
