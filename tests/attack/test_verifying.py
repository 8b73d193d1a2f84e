"""A sample of ``attack.verifying``: planted faults of every family, and a few sound sequences."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from attack import __main__ as program
from attack.clean_sequences import false_alarms
from attack.planted_faults import FAULTS
from attack.planting import Fault, found, planted
from attack.wet_castle import WET_CASTLE
from rsbench.scenes.load import read_scene_card

PRINTED = """  missed: depth scaled: ()
planted faults: 208, 1 missed; 300 s
  false alarm: random-3 (one): s1: rs/left_0.png: the image is black
sound sequences: 200, 1 false alarms; 7 motions refused; 900 s
"""
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


def test_the_long_run_reports_what_is_printed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[str] = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        started.extend(command)
        return SimpleNamespace(stdout=PRINTED, stderr="", returncode=1)

    monkeypatch.setattr(program, "subprocess", SimpleNamespace(run=run))
    tally = program._verify(12)
    assert started[1:] == ["-m", "attack.verifying", "--seed", "12"]
    assert tally.counts == {"planted faults": 208, "sound sequences": 200}
    assert tally.faults == [line.strip() for line in PRINTED.splitlines() if line.startswith("  ")]
    document = tmp_path / "figures.md"
    document.write_text(f"before\n{program.BEGIN}\n| kills | 3 | 0 | x |\n{program.END}\nafter\n")
    program._write(document, {"verify": "208 planted faults, 200 sound sequences | 2"}, ["verify"], 12)
    lines = document.read_text().splitlines()
    assert "| kills | 3 | 0 | x |" in lines and (lines[0], lines[-1]) == ("before", "after")
    (row,) = (
        line for line in lines if line.startswith("| verify | 208 planted faults, 200 sound sequences | 2 |")
    )
    assert row.endswith("`python -m attack verify --seed 12` |")
