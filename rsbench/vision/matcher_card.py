"""Cards of stereo matchers."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from rsbench.cards import load_card
from rsbench.vision.stereo_depth import SgmOptions


@dataclass(frozen=True, kw_only=True)
class MatcherCard:
    """How depth is found."""

    description: str
    sgm: SgmOptions = field(default_factory=SgmOptions)


def load_matcher(name_or_path: str | Path) -> SgmOptions:
    """Parameters of a matcher card.

    Raises:
        RsbenchError: no such card, or a wrong field in it.
    """
    return load_card(MatcherCard, "matchers", name_or_path).sgm
