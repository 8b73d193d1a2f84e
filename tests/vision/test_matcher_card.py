"""Cards of stereo matchers."""

from __future__ import annotations

from pathlib import Path

import pytest

from rsbench.cards import list_cards
from rsbench.errors import RsbenchError
from rsbench.vision.matcher_card import load_matcher
from rsbench.vision.stereo_depth import SgmOptions


@pytest.mark.parametrize("name", list_cards("matchers"))
def test_cards_load(name: str) -> None:
    assert load_matcher(name).block_size % 2 == 1


def test_the_default_card_states_the_defaults() -> None:
    assert load_matcher("sgm") == SgmOptions()


def test_a_wrong_value_is_named(tmp_path: Path) -> None:
    card = tmp_path / "even.toml"
    card.write_text('description = "x"\n[sgm]\nblock_size = 4\n', "utf-8")
    with pytest.raises(RsbenchError, match="block_size must be odd") as caught:
        load_matcher(card)
    assert "\n" not in str(caught.value)
