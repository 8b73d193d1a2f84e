"""Solvers by name, by card, by entry point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import ClassVar, final

import numpy as np
import pytest

from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.errors import RsbenchError
from rsbench.solvers.engine import registry
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver
from rsbench.solvers.engine.registry import list_solvers, load_solver, load_solver_card
from rsbench.solvers.linear import LinearSolver


class _Nothing(Solver):
    needs = frozenset()
    minimum: ClassVar[Mapping[MatchSet, int]] = {}
    metric = False
    motion_model = "linear"
    shutter = "global"
    reference_point = "body"
    reference = "a test"
    assumes = "nothing"

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        return MotionEstimate.failed("never tries")


@final
@dataclass(frozen=True, kw_only=True)
class Patient(_Nothing):
    patience: int = 3

    def __post_init__(self) -> None:
        if self.patience < 0:
            raise ValueError(f"patience cannot be negative, got {self.patience}")


@final
class Plain(_Nothing):
    """A solver that is no dataclass."""

    def __init__(self, mood: str = "calm") -> None:
        self.mood = mood


def card(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_built_in_solvers_are_listed() -> None:
    assert {"rs-stereo-linear", "gs-8pt", "rs-stereo-refined"} <= set(list_solvers())


def test_parameters_come_from_the_card(tmp_path: Path) -> None:
    path = card(
        tmp_path,
        'class = "rsbench.solvers.linear:LinearSolver"\ndescription = "mine"\n'
        '[parameters]\nextraction = "symmetric"\n',
    )
    loaded = load_solver_card(path)
    assert isinstance(loaded.solver, LinearSolver) and loaded.solver.extraction == "symmetric"
    assert loaded.solver.name == loaded.name == "mine" and loaded.description == "mine"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('clas = "a:b"', ["unknown key 'clas'"]),
        ('description = "no class"', ["class"]),
        ('class = "rsbench.solvers.linear"', ["package.module:Class"]),
        ('class = "rsbench.solvers.nowhere:X"', ["cannot be imported", "nowhere"]),
        ('class = "rsbench.solvers.linear:Nope"', ["cannot be imported", "Nope"]),
        ('class = "rsbench.solvers.linear:null_vector"', ["not a solver"]),
        ('class = "rsbench.solvers.engine.base:Solver"', ["not a solver"]),
        (
            'class = "rsbench.solvers.linear:LinearSolver"\n[parameters]\nextracton = "full"',
            ["unknown key 'extracton'", "did you mean 'extraction'", "there are: extraction"],
        ),
        (
            'class = "rsbench.solvers.linear:LinearSolver"\n[parameters]\nextraction = "best"',
            ["extraction = 'best'", "'full' or 'symmetric'"],
        ),
        ('class = "rsbench.solvers.linear:LinearSolver"\n[parameters]\nname = "x"', ["unknown key 'name'"]),
        ('class = "rsbench.solvers.iterated:IteratedSolver"\n[parameters]\npasses = 0', ["passes", "at least 1"]),
    ],
)
def test_a_wrong_card_is_refused_in_one_line(tmp_path: Path, text: str, parts: list[str]) -> None:
    with pytest.raises(RsbenchError) as caught:
        load_solver(card(tmp_path, text))
    message = str(caught.value)
    assert "mine.toml" in message and "\n" not in message
    for part in parts:
        assert part in message


def test_an_unknown_name_lists_what_exists() -> None:
    with pytest.raises(RsbenchError, match=r"rs-stereo-linaer.*did you mean 'rs-stereo-linear'.*gs-8pt"):
        load_solver("rs-stereo-linaer")


def entry(name: str, target: str) -> metadata.EntryPoint:
    return metadata.EntryPoint(name=name, value=target, group=registry.ENTRY_POINT_GROUP)


def install(monkeypatch: pytest.MonkeyPatch, solver: object, *names: str) -> None:
    entries = [entry(name, f"package{k}:Solver") for k, name in enumerate(names)]
    monkeypatch.setattr(metadata, "entry_points", lambda group: entries)
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda self: solver)


@pytest.mark.parametrize("cls", [Patient, Plain])
def test_an_installed_package_adds_a_solver(monkeypatch: pytest.MonkeyPatch, cls: type[Solver]) -> None:
    install(monkeypatch, cls, "patient")
    assert "patient" in list_solvers()
    solver = load_solver("patient")
    assert type(solver) is cls and solver.name == "patient"


def test_a_name_clash_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, Patient, "gs-8pt")
    with pytest.raises(RsbenchError, match=r"gs-8pt.*taken by a built-in"):
        list_solvers()
    install(monkeypatch, Patient, "twice", "twice")
    with pytest.raises(RsbenchError, match=r"twice.*taken by package0"):
        load_solver("twice")


def test_a_broken_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "not a class", "odd")
    with pytest.raises(RsbenchError, match="not a solver"):
        load_solver("odd")

    def fail(self: metadata.EntryPoint) -> object:
        raise ImportError("no module named x")

    monkeypatch.setattr(metadata.EntryPoint, "load", fail)
    with pytest.raises(RsbenchError, match=r"odd.*cannot be loaded.*no module named x"):
        load_solver("odd")


def test_parameters_of_a_plain_class() -> None:
    solver = registry._instance(Plain, {"mood": "wild"}, "plain", "card.toml")
    assert isinstance(solver, Plain) and solver.mood == "wild"
    with pytest.raises(RsbenchError, match=r"unknown key 'moood'.*mood"):
        registry._instance(Plain, {"moood": "wild"}, "plain", "card.toml")


def test_a_failure_holds_no_motion() -> None:
    failure = MotionEstimate.failed("because")
    assert not failure.success and failure.reason == "because"
    assert np.all(np.isnan(failure.w)) and np.all(np.isnan(failure.d))
    with pytest.raises(ValueError, match="finite"):
        MotionEstimate(w=np.full(3, np.nan), d=np.zeros(3), success=True)
