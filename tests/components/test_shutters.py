"""Shutters of real cameras: every card says where it comes from, and means what it says in other cards."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from commands import assert_refused, run_here
from small_scenes import write_small_card

from rsbench.components.cards import ShutterCard, list_cards, load_card, with_shutter
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.pipeline.footage import read_rig_card

SOURCES = r"gyroflow/lens_profiles \(CC0\), commit [0-9a-f]{8}: frame_readout_time in .+\.json|.*manual.*tRow = .*"


def test_there_are_phones_action_cameras_and_industrial_ones() -> None:
    assert len(list_cards("shutters")) >= 12
    families = {name.split("-")[0] for name in list_cards("shutters")}
    assert {"apple", "samsung", "google", "gopro", "insta360", "dji", "basler"} <= families


def test_every_shutter_names_its_source_and_can_be() -> None:
    for name in list_cards("shutters"):
        card = load_card(ShutterCard, "shutters", name)
        assert re.fullmatch(SOURCES, card.source), name
        # The description repeats the numbers for `rsbench list`.
        numbers = f"{card.width} x {card.height}, {card.fps:g} fps, read in {card.readout_ms:.4g} ms"
        assert numbers in card.description


def test_a_manual_s_line_time_is_times_its_rows() -> None:
    assert load_card(ShutterCard, "shutters", "basler-aca1920-25").readout_ms == pytest.approx(35e-3 * 1080)
    assert load_card(ShutterCard, "shutters", "basler-aca2500-14").readout_ms == pytest.approx(35e-3 * 1942)


def test_a_dataset_and_a_rig_take_it_by_name(tmp_path: Path) -> None:
    card = write_small_card(tmp_path, [])
    named = 'shutter = "gopro-hero6-4k30"'
    sequences = f'[[sequence]]\nname = "a"\nscene = "room"\n[[sequence]]\nname = "b"\nscene = "room"\n{named}\n'
    card.write_text(
        card.read_text().replace("readout_ratio = 0.8", 'shutter = "apple-iphone-12-wide"') + sequences
    )
    dataset = load_dataset_card(str(card))
    first, second = dataset.sequence
    assert dataset.period_of(first) == pytest.approx(1 / 24)
    assert dataset.shutter_for(first).readout_ratio == pytest.approx(6.6e-3 * 24)
    assert dataset.shutter_for(second).readout_ratio == pytest.approx(8.34167e-3 * 29.97)
    assert dataset.manifest_of(second)["readout_time_s"] == pytest.approx(8.34167e-3)

    rig = tmp_path / "rig.toml"
    rig.write_text(f"baseline = 0.1\n{named}\n[camera]\nfx = 800\nfy = 800\ncx = 400\ncy = 300\n")
    assert read_rig_card(rig).readout_ratio == pytest.approx(8.34167e-3 * 29.97)


def test_a_slower_frame_rate_keeps_the_readout_time() -> None:
    table = with_shutter({"shutter": "gopro-hero6-4k30", "frame_period_s": 0.1}, "card")
    assert table == {"frame_period_s": 0.1, "readout_ratio": pytest.approx(0.0834167)}


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"shutter": "gopro-hero99"}, "card: shutter: shutters card 'gopro-hero99' does not exist"),
        ({"shutter": 3}, "card: shutter = 3: must be a name"),
        ({"shutter": "gopro-hero6-4k30", "readout_ratio": 0.5}, "exclude each other"),
        ({"shutter": "gopro-hero6-4k30", "frame_period_s": 0.001}, "reads a frame for 0.00834167 s"),
    ],
)
def test_what_cannot_be_is_one_line(table: dict[str, object], words: str) -> None:
    with pytest.raises(RsbenchError, match=words) as caught:
        with_shutter(table, "card")
    assert "\n" not in str(caught.value)


def test_they_are_listed_and_shown() -> None:
    assert "samsung-galaxy-s25-ultra" in run_here("list", "shutters").stdout
    shown = run_here("show", "basler-aca2500-14").stdout
    assert "readout_ms = 67.97" in shown and "AW00123409000" in shown
    assert_refused(run_here("show", "gopro-hero6-4k3"), "did you mean 'gopro-hero6-4k30'")
