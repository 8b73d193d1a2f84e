"""Cards and the shutters that they name."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from commands import assert_refused, refused, run_here
from small_scenes import write_small_card

from rsbench.components.cards import (
    ShutterCard,
    card_path,
    list_cards,
    load_card,
    parse_card,
    read_toml,
    with_shutter,
)
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import load_dataset_card
from rsbench.pipeline.footage import read_rig_card


@dataclass(frozen=True, kw_only=True)
class Lens:
    focal_px: float
    shape: Literal["flat", "round"] = "flat"


@dataclass(frozen=True, kw_only=True)
class Card:
    name: str
    size: tuple[int, int] = (900, 900)
    lens: Lens | None = None
    views: dict[str, Lens] = field(default_factory=dict)
    steps: tuple[Lens, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name == "forbidden":
            raise RsbenchError("name = 'forbidden' is taken")
        if min(self.size) <= 0:
            raise ValueError(f"size = {self.size}: both must be positive")


def test_tables_become_nested_dataclasses() -> None:
    data = {
        "name": "a",
        "size": [3, 4],
        "lens": {"focal_px": 2},
        "views": {"x": {"focal_px": 1.5, "shape": "round"}},
        "steps": [{"focal_px": 1.0}],
    }
    card = parse_card(Card, data, "a.toml")
    assert card == Card(
        name="a",
        size=(3, 4),
        lens=Lens(focal_px=2.0),
        views={"x": Lens(focal_px=1.5, shape="round")},
        steps=(Lens(focal_px=1.0),),
    )
    assert isinstance(card.lens, Lens) and isinstance(card.lens.focal_px, float)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"nme": "b"}, ["unknown key 'nme'", "did you mean 'name'?", "extra, lens, name, size, steps, views"]),
        ({"lens": {"focal": 1.0}}, ["unknown key 'lens.focal'", "focal_px, shape"]),
        ({"views": {"x": {"focal_px": 1.0, "shap": 1}}}, ["unknown key 'views.x.shap'", "focal_px, shape"]),
        ({"steps": [{"focal_px": 1.0, "z": 1}]}, ["unknown key 'steps.0.z'", "focal_px, shape"]),
        ({"lens": {}}, ["'lens.focal_px' is required"]),
        ({"lens": {"focal_px": "9"}}, ["lens.focal_px = '9'", "valid number"]),
        ({"lens": {"focal_px": True}}, ["lens.focal_px = True", "valid number"]),
        ({"lens": {"focal_px": float("nan")}}, ["lens.focal_px", "finite"]),
        ({"lens": {"focal_px": float("-inf")}}, ["lens.focal_px", "finite"]),
        ({"extra": {"a": [1.0, float("nan")]}}, ["extra.a.1 = nan: numbers must be finite"]),
        ({"lens": {"focal_px": 1.0, "shape": "cube"}}, ["lens.shape = 'cube'", "'flat' or 'round'"]),
        ({"size": [900]}, ["size.1"]),
        ({"size": [900.5, 900]}, ["size.0 = 900.5", "valid integer"]),
        ({"size": [0, 900]}, ["size = (0, 900): both must be positive"]),
        ({"name": "forbidden"}, ["name = 'forbidden' is taken"]),
        ({"name": 3}, ["name = 3", "valid string"]),
    ],
)
def test_bad_cards_are_refused_in_one_line(change: dict[str, Any], parts: list[str]) -> None:
    with refused(*parts, match="^dir/a.toml: "):
        parse_card(Card, {"name": "a", **change}, "dir/a.toml")


def test_invalid_toml_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('name = "a"\nsize = [1,\n')
    with pytest.raises(RsbenchError, match=r"bad\.toml: not valid TOML: .*(line 3|end of document)"):
        read_toml(path)
    path.write_text('name = "a"\nsize == 3\n')
    with pytest.raises(RsbenchError, match="line 2"):
        read_toml(path)
    path.write_bytes(b'name = "\xff"\n')
    with pytest.raises(RsbenchError, match="not UTF-8 text"):
        read_toml(path)


def test_names_and_paths(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('name = "mine"\n')
    assert card_path("scenes", str(path)) == path
    assert load_card(Card, "scenes", path) == Card(name="mine")
    with pytest.raises(RsbenchError, match="no such file"):
        card_path("scenes", tmp_path / "other.toml")


def test_shipped_names_resolve_and_unknown_ones_list_them() -> None:
    cards = list_cards("scenes")
    assert "castle" in cards
    assert card_path("scenes", "castle") == cards["castle"]
    with pytest.raises(RsbenchError, match=r"'castel'.*did you mean 'castle'.*old-town"):
        card_path("scenes", "castel")


def test_an_installed_package_finds_its_own_cards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "rsbench" / "_cards" / "scenes"
    folder.mkdir(parents=True)
    (folder / "only.toml").write_text('name = "only"\n')
    monkeypatch.setattr("rsbench.components.cards.resources.files", lambda package: tmp_path / package)
    assert list_cards("scenes") == {"only": folder / "only.toml"}
    assert list_cards("solvers") == {}
    with pytest.raises(RsbenchError, match="there are: only"):
        card_path("scenes", "castle")


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
    with refused(match=words):
        with_shutter(table, "card")


def test_they_are_listed_and_shown() -> None:
    assert "samsung-galaxy-s25-ultra" in run_here("list", "shutters").stdout
    shown = run_here("show", "basler-aca2500-14").stdout
    assert "readout_ms = 67.97" in shown and "AW00123409000" in shown
    assert_refused(run_here("show", "gopro-hero6-4k3"), "did you mean 'gopro-hero6-4k30'")
