"""Solvers by name: see ``rsbench.components.plugins``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rsbench.components import plugins
from rsbench.components.arguments import name_or_path as name_or_path_of
from rsbench.components.plugins import Entry, Kind
from rsbench.core import given
from rsbench.core.errors import RsbenchError
from rsbench.solvers.engine.base import Solver, SolverSpec


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """What a solver's card may say beside its parameters."""

    robust: Literal["ransac", "own"] = "ransac"
    """``own``: the solver throws outliers out by itself; it is given all matches, timed and scored as it is."""
    use: str = ""
    """When to take this one rather than another, in a line for people; nothing else reads it."""
    time_limit_s: float = 60.0
    """Wall-clock time for one problem, after which a solver of another package has failed."""

    def __post_init__(self) -> None:
        if not self.time_limit_s > 0.0:
            raise ValueError(f"time_limit_s = {self.time_limit_s}: must be a positive number of seconds")

    @property
    def deciding(self) -> dict[str, Any]:
        """What may change an answer, by name."""
        return {"robust": self.robust, "time_limit_s": self.time_limit_s}


def _check_spec(solver: Solver) -> None:
    if not isinstance(solver.spec, SolverSpec):
        raise ValueError(f"spec = {solver.spec!r}: must be a SolverSpec")


SOLVERS: Kind[Solver, SolverOptions] = Kind(
    singular="solver",
    cards="solvers",
    base=Solver,
    options=SolverOptions,
    check=_check_spec,
)


class SolverEntry(Entry[Solver, SolverOptions]):
    """A solver under the name of its card or entry point: what tables rank."""

    @property
    def solver(self) -> Solver:
        """The solver itself."""
        return self.component


def list_solvers() -> list[str]:
    """Names of all solvers, sorted."""
    return plugins.list_names(SOLVERS)


def load_solver(name_or_path: str | Path) -> Solver:
    """A solver by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: no such solver, two of that name, or its card or class is wrong.
    """
    return load_solver_entry(name_or_path_of("name_or_path", name_or_path)).solver


def load_solver_entries(names_or_paths: Sequence[str]) -> list[SolverEntry]:
    """Several solvers that go into one table.

    Raises:
        RsbenchError: see ``load_solver``; or two of them have one name, by which nobody could tell them apart.
    """
    entries: dict[str, SolverEntry] = {}
    given: dict[str, str] = {}
    for text in names_or_paths:
        entry = load_solver_entry(text)
        if entry.name in entries:
            raise RsbenchError(
                f"solver {text!r} and solver {given[entry.name]!r} are both named {entry.name!r}: "
                "leave one out, or rename its card"
            )
        entries[entry.name], given[entry.name] = entry, text
    return list(entries.values())


def load_solver_entry(name_or_path: str | Path) -> SolverEntry:
    """Like ``load_solver``, with its name, its card's options and its key."""
    return SolverEntry(**vars(plugins.load_entry(SOLVERS, name_or_path)))


def wrap_solver(solver: Solver) -> SolverEntry:
    """The entry of a solver that was made without a card; its class names it."""
    return SolverEntry(**vars(plugins.wrap(SOLVERS, solver)))


def entry_of(solver: str | Path | Solver) -> SolverEntry:
    """The entry of a solver by its name, the path of its card, or itself; ValueError for anything else."""
    if isinstance(solver, str | Path):
        return load_solver_entry(solver)
    if not isinstance(solver, Solver):
        raise ValueError(
            f"solver: must be a name, the path of a card or an rsbench.Solver, got {given.shown(solver)}"
        )
    return wrap_solver(solver)
