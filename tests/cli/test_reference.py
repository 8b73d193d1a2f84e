"""The reference of commands and cards is that of the code, and nothing in it is without a description."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from commands import assert_refused, run_here
from make_reference import all_tables, card_classes, component_classes, keys_of, pages

from rsbench.components.cards import CardKind, list_cards, read_toml

ROOT = Path(__file__).parents[2]
PAGES = pages()
TABLES = {
    cls
    for root in [
        *(cls for tables in card_classes().values() for _, cls in tables),
        *(cls for classes in component_classes().values() for cls in classes),
    ]
    for cls in all_tables(root)
}


@pytest.mark.parametrize("name", PAGES)
def test_the_committed_reference_is_that_of_the_code(name: str) -> None:
    assert (ROOT / "docs" / name).read_text("utf-8") == PAGES[name], (
        "run `make reference`, and commit what it wrote"
    )


@pytest.mark.parametrize("cls", sorted(TABLES, key=lambda cls: (cls.__module__, cls.__name__)))
def test_every_key_of_a_card_says_what_it_is(cls: type) -> None:
    assert [key.name for key in keys_of(cls) if not key.meaning] == []


@pytest.mark.parametrize(
    ("kind", "heading"),
    [
        ("datasets", "Dataset cards"),
        ("scenes", "Scene cards"),
        ("renderers", "Renderer cards"),
        ("sweeps", "Sweep cards"),
        ("shutters", "Shutter cards"),
        ("rigs", "Rig cards"),
        ("solvers", "Component cards"),
    ],
)
def test_the_reference_has_the_keys_of_the_cards_that_exist(kind: CardKind, heading: str) -> None:
    section = PAGES["reference/cards.md"].partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    known = set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))
    used = {key for path in list_cards(kind).values() for key in read_toml(path)}
    assert used and used <= known


def test_the_reference_has_every_option_that_help_prints() -> None:
    page = PAGES["reference/commands.md"]
    for command in ("generate", "solve", "leaderboard run"):
        section = page.partition(f"\n## rsbench {command}\n")[2].partition("\n## ")[0]
        printed = run_here(*command.split(), "--help", COLUMNS="200").stdout.partition("Options")[2]
        options = set(re.findall(r"^│[ *]*(--[a-z-]+)", printed, re.MULTILINE)) - {"--help"}
        assert len(options) > 3
        assert [option for option in options if f"| `{option}`" not in section] == []


@dataclass(frozen=True, kw_only=True)
class _Inner:
    """A table."""

    sides: tuple[float, float, float] = (1.0, 2.0, 3.0)
    """Three."""


@dataclass(frozen=True, kw_only=True)
class _Card:
    """A card of one key of each kind."""

    name: str
    """Its name."""
    mode: Literal["a", "b"] | None = None
    """Absent: none."""
    class_: int = 3
    """Of a word of Python."""
    inner: dict[str, _Inner] = dataclasses.field(default_factory=dict)
    """Tables."""
    rest: dict[str, Any] = dataclasses.field(default_factory=lambda: {"x": 1})
    """Anything."""


def test_keys_are_described_as_a_card_writes_them() -> None:
    found = [(key.name, key.type, key.default, key.meaning) for key in keys_of(_Card)]
    assert found == [
        ("name", "text", "required", "Its name."),
        ("mode", '"a" or "b"', "", "Absent: none."),
        ("class", "integer", "3", "Of a word of Python."),
        ("inner", "table of _Inner", "", "Tables."),
        ("rest", "table of values", "defaults", "Anything."),
    ]
    assert all_tables(_Card) == [_Card, _Inner]
    assert [(key.type, key.default) for key in keys_of(_Inner)] == [("3 numbers", "[1.0, 2.0, 3.0]")]


def test_a_misspelt_shutter_is_named(tmp_path: Path) -> None:
    text = list_cards("datasets")["smoke"].read_text("utf-8").replace("readout_ratio", "shuter", 1)
    (tmp_path / "mine.toml").write_text(text, "utf-8")
    result = run_here("generate", tmp_path / "mine.toml", "--out", tmp_path / "out")
    assert_refused(result, "shuter", "did you mean 'shutter'?")
