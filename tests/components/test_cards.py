"""Cards: lookup by name and path, and refusals that a reader can act on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from rsbench.components.cards import card_path, list_cards, load_card, parse_card, read_toml
from rsbench.core.errors import RsbenchError


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
    with pytest.raises(RsbenchError) as caught:
        parse_card(Card, {"name": "a", **change}, "dir/a.toml")
    message = str(caught.value)
    assert message.startswith("dir/a.toml: ") and "\n" not in message
    for part in parts:
        assert part in message


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
