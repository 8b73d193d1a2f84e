"""A sample of ``attack.verifying``: planted faults of every family, and a few sound sequences."""

from __future__ import annotations

from pathlib import Path

import pytest

from attack.clean_sequences import false_alarms
from attack.planted_faults import FAULTS
from attack.planting import Fault, found, planted

SAMPLE = [fault for fault in FAULTS if not (fault.rendered or fault.slow)][4::9]


def test_the_names_of_the_faults_differ() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 102


def test_a_sound_sequence_of_a_random_card_passes(tmp_path: Path) -> None:
    *_, (_, count, found_in_it) = false_alarms(1, tmp_path)
    assert count == 1 and found_in_it == []


@pytest.mark.parametrize("fault", SAMPLE, ids=lambda fault: fault.name)
def test_a_planted_fault_is_named(smoke_dataset: Path, tmp_path: Path, fault: Fault) -> None:
    named, lines = found(fault, planted(fault, smoke_dataset, tmp_path / "planted"))
    assert named, lines
