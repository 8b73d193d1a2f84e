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


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("block_size = 4", "block_size must be odd"),
        ("consistency_px = -1.0", "consistency_px must be positive"),
        ("uniqueness_percent = 500", "uniqueness_percent must lie in"),
        ("prefilter_cap = -3", "prefilter_cap must be at least 0"),
        ("speckle_window = -5", "speckle_window must be at least 0"),
        ("speckle_range = -5", "speckle_range must be at least 0"),
        ("consistency_px = nan", "must be finite"),
        ("blok_size = 3", "unknown key"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, line: str, message: str) -> None:
    card = tmp_path / "wrong.toml"
    card.write_text(f'description = "x"\n[sgm]\n{line}\n', "utf-8")
    with pytest.raises(RsbenchError, match=message) as caught:
        load_matcher(card)
    assert "\n" not in str(caught.value)
