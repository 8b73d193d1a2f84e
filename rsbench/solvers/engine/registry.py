"""Solvers by name: the cards that come with rsbench, a user's card, or an installed package's entry point."""

from __future__ import annotations

import importlib
import inspect
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from rsbench.cards import card_path, choices, list_cards, parse_card, read_toml
from rsbench.errors import RsbenchError
from rsbench.solvers.engine.base import Solver

ENTRY_POINT_GROUP = "rsbench.solvers"


@dataclass(frozen=True, kw_only=True)
class SolverCard:
    """Content of a solver card: a leaderboard entry is one of these."""

    name: str
    path: Path | None
    description: str
    solver: Solver


@dataclass(frozen=True, kw_only=True)
class _Content:
    class_: str
    description: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)


def list_solvers() -> list[str]:
    """Names of all solvers, sorted.

    Raises:
        RsbenchError: a package offers a solver under a name that is taken.
    """
    return sorted([*list_cards("solvers"), *_entry_points()])


def load_solver(name_or_path: str | Path) -> Solver:
    """A solver by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: no such solver, or its card or class is wrong.
    """
    return load_solver_card(name_or_path).solver


def load_solver_card(name_or_path: str | Path) -> SolverCard:
    """Like ``load_solver``, with what else the card says."""
    plugins = _entry_points()
    text = str(name_or_path)
    if text in plugins:
        where = f"entry point {ENTRY_POINT_GROUP}:{text}"
        try:
            cls = plugins[text].load()
        except Exception as error:
            raise RsbenchError(f"{where}: cannot be loaded: {error}") from error
        solver = _instance(cls, {}, text, where)
        return SolverCard(name=text, path=None, description="", solver=solver)
    if not text.endswith(".toml") and "/" not in text and text not in list_cards("solvers"):
        raise RsbenchError(f"solver {text!r} does not exist{choices(text, list_solvers())}; a path ends in .toml")
    path = card_path("solvers", name_or_path)
    data = read_toml(path)
    try:
        content = parse_card(
            _Content, {("class_" if key == "class" else key): data[key] for key in data}, str(path)
        )
    except RsbenchError as error:  # `class` cannot be the name of a field
        raise RsbenchError(str(error).replace("class_", "class")) from None
    cls = _import(content.class_, f"{path}: class = {content.class_!r}")
    solver = _instance(cls, content.parameters, path.stem, str(path))
    return SolverCard(name=path.stem, path=path, description=content.description, solver=solver)


def _entry_points() -> dict[str, metadata.EntryPoint]:
    found: dict[str, metadata.EntryPoint] = {}
    built_in = list_cards("solvers")
    for entry in metadata.entry_points(group=ENTRY_POINT_GROUP):
        if entry.name in built_in or entry.name in found:
            other = "a built-in solver" if entry.name in built_in else found[entry.name].value
            raise RsbenchError(
                f"solver name {entry.name!r} of {entry.value} is taken by {other}; rename one of them"
            )
        found[entry.name] = entry
    return found


def _import(target: str, where: str) -> object:
    module, _, name = target.partition(":")
    if not module or not name:
        raise RsbenchError(f"{where}: must be 'package.module:Class'")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise RsbenchError(f"{where}: cannot be imported: {error}") from error


def _instance(cls: object, parameters: dict[str, Any], name: str, where: str) -> Solver:
    """The solver with its parameters, under the name of its card."""
    if not (isinstance(cls, type) and issubclass(cls, Solver)) or inspect.isabstract(cls):
        raise RsbenchError(
            f"{where}: {cls!r} is not a solver: it must be a subclass of rsbench.solvers.engine.base.Solver"
        )
    solver: Solver
    if hasattr(cls, "__dataclass_fields__"):
        solver = parse_card(cls, parameters, f"{where}: parameters")
    else:
        known = list(inspect.signature(cls).parameters)
        unknown = [key for key in parameters if key not in known]
        if unknown:
            raise RsbenchError(f"{where}: parameters: unknown key {unknown[0]!r}{choices(unknown[0], known)}")
        try:
            solver = cls(**parameters)
        except (TypeError, ValueError) as error:
            raise RsbenchError(f"{where}: parameters: {error}") from error
    # Solvers are frozen, and the card's name is not one of their parameters.
    object.__setattr__(solver, "name", name)
    return solver
