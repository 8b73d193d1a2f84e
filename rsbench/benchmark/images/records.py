"""What the records of predictions hold: one that does not is made again, like one that cannot be read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from rsbench.components.cards import parse_card
from rsbench.core.errors import RsbenchError

_Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class _Record:
    identity: str
    success: bool
    reason: str


@dataclass(frozen=True, kw_only=True)
class _Matches(_Record):
    features: str
    matches: dict[str, int]


@dataclass(frozen=True, kw_only=True)
class _Motion(_Record):
    solver: str
    entry: str
    key: str
    w: _Vector | None
    d: _Vector | None
    metric: bool
    reference_point: Literal["body", "left"]
    motion_model: str
    motion_parameters: dict[str, Any]
    shutter: str
    uses: tuple[str, ...]
    inliers: dict[str, int]
    matches: dict[str, int]
    iterations: int
    seed: int

    def __post_init__(self) -> None:
        if self.success and (self.w is None or self.d is None):
            raise ValueError("a success without w and d")


@dataclass(frozen=True, kw_only=True)
class _Depth(_Record):
    matcher: str
    entry: str
    timed: bool


@dataclass(frozen=True, kw_only=True)
class _Correction(_Record):
    corrector: str
    solver: str
    matcher: str
    entries: dict[str, str]
    failures: dict[str, str] = field(default_factory=dict)
    """By views such as ``left_0`` that the corrector gave up, why."""


_KINDS: dict[str, type[_Record]] = {
    "matches": _Matches,
    "motion": _Motion,
    "seeds": _Motion,
    "depth": _Depth,
    "corrected": _Correction,
}


def is_whole(name: str, record: Mapping[str, Any]) -> bool:
    """Whether a record has what the one of an artefact such as ``motion/gs-8pt`` must have, and nothing else."""
    try:
        parse_card(_KINDS[name.partition("/")[0]], record, name)
    except RsbenchError:
        return False
    return True
