"""A sample of ``attack.verifying``: planted faults of every family, and a few sound sequences."""

from __future__ import annotations

from pathlib import Path

import pytest

from attack import __main__ as program
from attack.clean_sequences import false_alarms
from attack.planted_faults import FAULTS
from attack.planting import Fault, found, planted
from attack.wet_castle import WET_CASTLE
from rsbench.scenes.load import read_scene_card

SAMPLE = [fault for fault in FAULTS if not (fault.rendered or fault.slow)][4::9]


def test_the_names_of_the_faults_differ() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 102


def test_the_card_of_the_glossy_scene_finds_its_builder() -> None:
    assert type(read_scene_card(WET_CASTLE)[1]).__name__ == "WetCastleBuilder"


def test_a_sound_sequence_of_a_random_card_passes(tmp_path: Path) -> None:
    *_, (_, count, _, found_in_it) = false_alarms(1, tmp_path)
    assert count == 1 and found_in_it == []


@pytest.mark.parametrize("fault", SAMPLE, ids=lambda fault: fault.name)
def test_a_planted_fault_is_named(smoke_dataset: Path, tmp_path: Path, fault: Fault) -> None:
    named, lines = found(fault, planted(fault, smoke_dataset, tmp_path / "planted"))
    assert named, lines


def test_rows_of_other_attacks_stay_in_the_document(tmp_path: Path) -> None:
    document = tmp_path / "figures.md"
    document.write_text(f"before\n{program.BEGIN}\n| kills | 3 | 0 | x |\n{program.END}\nafter\n")
    program._write(document, {"verify": "208 planted faults, 200 sound sequences | 2"}, ["verify"], 12)
    lines = document.read_text().splitlines()
    assert "| kills | 3 | 0 | x |" in lines and (lines[0], lines[-1]) == ("before", "after")
    (row,) = (
        line for line in lines if line.startswith("| verify | 208 planted faults, 200 sound sequences | 2 |")
    )
    assert row.endswith("`python -m attack verify --seed 12` |")
