"""The kinds of things that have names: one table for ``list``, ``show`` and the completion of names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, get_args

import typer

COMPONENTS = {
    "solvers": "rsbench.solvers.engine.registry:SOLVERS",
    "builders": "rsbench.scenes.load:BUILDERS",
    "motions": "rsbench.components.motion_models:MOTIONS",
    "matchers": "rsbench.vision.stereo_matcher:STEREO_MATCHERS",
    "features": "rsbench.vision.feature_matcher:FEATURE_MATCHERS",
    "correctors": "rsbench.vision.corrector:CORRECTORS",
    "metrics": "rsbench.benchmark.metric_plugins:METRICS",
}
"""Kinds whose names may come from installed packages, and where their ``plugins.Kind`` is."""


_GROUPS = {"builders": "rsbench.scenes"}
"""Groups of entry points that are not called as the kind is."""


def kind_names() -> list[str]:
    """All kinds, sorted: the folders of cards, and components that have none."""
    from rsbench.components.cards import CardKind

    return sorted({*get_args(CardKind), *COMPONENTS})


def component_kind(kind: str) -> Any:
    """The ``plugins.Kind`` of a kind; None for cards that name no class."""
    if kind not in COMPONENTS:
        return None
    from importlib import import_module

    module, _, name = COMPONENTS[kind].partition(":")
    return getattr(import_module(module), name)


def names_of(kind: str) -> list[str]:
    """Names of one kind, sorted."""
    from rsbench.components import plugins
    from rsbench.components.cards import list_cards

    described = component_kind(kind)
    return plugins.list_names(described) if described is not None else list(list_cards(kind))  # pyrefly: ignore[bad-argument-type]


def complete(kind: str) -> Callable[[str], list[str]]:
    """Completion of the names of one kind for a shell, which must be quick: cards only, and entry points."""

    def names(incomplete: str) -> list[str]:
        return [name for name in _quick_names(kind) if name.startswith(incomplete)]

    return names


def named(kind: str, text: str) -> Any:
    """An option that takes a name of one kind or the path of a card; ``text`` is its help."""
    return typer.Option(help=text, autocompletion=complete(kind))


def complete_kind(incomplete: str) -> list[str]:
    """Completion of a kind."""
    return [name for name in kind_names() if name.startswith(incomplete)]


def complete_any(incomplete: str) -> list[str]:
    """Completion of a name of any kind."""
    names = {name for kind in kind_names() for name in _quick_names(kind)}
    return sorted(name for name in names if name.startswith(incomplete))


def _quick_names(kind: str) -> list[str]:
    """Names without importing what they stand for; those of classes without a card are left out."""
    from importlib import metadata

    from rsbench.components.cards import CardKind, list_cards

    names = set(list_cards(kind)) if kind in get_args(CardKind) else set()  # pyrefly: ignore[bad-argument-type]
    if kind in COMPONENTS:
        try:
            group = _GROUPS.get(kind, f"rsbench.{kind}")
            names |= {point.name for point in metadata.entry_points(group=group)}
        except Exception:  # a package whose files about itself cannot be read; ``rsbench list`` says more
            return sorted(names)
    return sorted(names)
