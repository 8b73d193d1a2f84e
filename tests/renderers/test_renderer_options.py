"""Renderer cards."""

from __future__ import annotations

from typing import Any

import pytest

from rsbench.components.cards import list_cards, load_card, parse_card
from rsbench.core.errors import RsbenchError
from rsbench.renderers.options import RendererOptions


def test_every_card_that_comes_along_is_valid() -> None:
    cards = {name: load_card(RendererOptions, "renderers", name) for name in list_cards("renderers")}
    assert {"default", "path", "stitched", "preview"} <= set(cards)
    assert all(card.description for card in cards.values())
    assert (cards["default"].method, cards["default"].integrator, cards["default"].samples) == (
        "single-pass",
        "sunsky",
        16,
    )
    assert cards["stitched"].method == "stitched" and cards["path"].integrator == "path"
    # Images of one dataset may come from any of them: equal brightness.
    assert len({card.exposure for card in cards.values()}) == 1


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("samples", 15, "perfect square"),
        ("samples", 0, "perfect square"),
        ("samples", 16.0, "samples"),
        ("method", "warp", "single-pass"),
        ("integrator", "magic", "sunsky"),
        ("max_depth", 0, "allowed are 1 to"),
        ("exposure", -1.0, "positive"),
        ("seed", -1, "4294967295"),
        ("sky_rays", 65, "0 to 64"),
        ("sample", 4, "samples"),
    ],
)
def test_bad_values_are_refused_with_what_is_allowed(field: str, value: Any, says: str) -> None:
    with pytest.raises(RsbenchError, match=says) as refusal:
        parse_card(RendererOptions, {field: value}, "my.toml")
    assert "my.toml" in str(refusal.value) and "\n" not in str(refusal.value)
