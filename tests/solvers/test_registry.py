"""Solvers by name, by card, by entry point."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import final

import numpy as np
import pytest

from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import (
    SOLVERS,
    MotionEstimate,
    Solver,
    SolverSpec,
    list_solvers,
    load_solver,
    load_solver_entry,
)
from rsbench.solvers.linear import LinearSolver

SPEC = SolverSpec(
    needs=frozenset({"left"}),
    minimum={"left": 1},
    metric=False,
    motion_model="linear",
    shutter="global",
    reference_point="body",
    reference="a test",
    assumes="nothing",
)


class _Nothing(Solver):
    spec = SPEC

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


def test_parameters_come_from_the_card(tmp_path: Path) -> None:
    path = card(
        tmp_path,
        'class = "rsbench.solvers.linear:LinearSolver"\ndescription = "mine"\n'
        '[parameters]\nextraction = "symmetric"\n',
    )
    loaded = load_solver_entry(path)
    assert isinstance(loaded.solver, LinearSolver) and loaded.solver.extraction == "symmetric"
    assert loaded.name == "mine" and loaded.description == "mine"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('class = "rsbench.solvers.linear:null_vector"', ["not a solver"]),
        ('class = "rsbench.solvers.engine.base:Solver"', ["not a solver"]),
        (
            'class = "rsbench.solvers.linear:LinearSolver"\n[parameters]\nextracton = "full"',
            ["unknown key 'extracton'", "did you mean 'extraction'", "there are: baseline_unit, extraction"],
        ),
        (
            'class = "rsbench.solvers.linear:LinearSolver"\n[parameters]\nextraction = "best"',
            ["extraction = 'best'", "'full' or 'symmetric'"],
        ),
        ('class = "rsbench.solvers.linear:IteratedSolver"\n[parameters]\npasses = 0', ["passes", "from 1 to"]),
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
    with pytest.raises(
        RsbenchError,
        match=r"rs-stereo-linaer.*did you mean 'rs-stereo-linear'.*rs-stereo-iterated.* and \d+ more",
    ):
        load_solver("rs-stereo-linaer")


def entry(name: str, target: str) -> metadata.EntryPoint:
    return metadata.EntryPoint(name=name, value=target, group=SOLVERS.group)


def install(monkeypatch: pytest.MonkeyPatch, solver: object, *names: str) -> None:
    entries = [entry(name, f"package{k}:Solver") for k, name in enumerate(names)]
    monkeypatch.setattr("rsbench.components.imports.points_of", lambda group, folders: entries)
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda self: solver)


def test_a_name_clash_is_an_error_of_that_name_only(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, Patient, "gs-8pt", "twice", "twice")
    assert list_solvers().count("twice") == 1
    assert load_solver_entry("rs-stereo-linear").built_in
    with pytest.raises(RsbenchError, match=r"gs-8pt.*card gs-8pt.toml of rsbench and of package0:Solver"):
        load_solver("gs-8pt")
    with pytest.raises(RsbenchError, match=r"twice.*package1:Solver.* and of package2:Solver"):
        load_solver("twice")


def test_a_card_finds_the_module_beside_it(tmp_path: Path) -> None:
    (tmp_path / "moody_solver.py").write_text(PLAIN, "utf-8")
    text = 'class = "moody_solver:Plain"\ntime_limit_s = 5\nrobust = "own"\n[parameters]\nmood = "wild"'
    loaded = load_solver_entry(card(tmp_path, text))
    assert vars(loaded.solver)["mood"] == "wild"
    assert loaded.options.time_limit_s == 5.0 and loaded.options.robust == "own"
    with pytest.raises(RsbenchError, match=r"unknown key 'moood'.*mood"):
        load_solver(card(tmp_path, 'class = "moody_solver:Plain"\n[parameters]\nmoood = "wild"'))
    with pytest.raises(RsbenchError, match=r"unknown key 'time_limit'.*did you mean 'time_limit_s'"):
        load_solver(card(tmp_path, 'class = "moody_solver:Plain"\ntime_limit = 5'))
    sys.modules.pop("moody_solver")


def test_a_solver_must_say_what_it_is(tmp_path: Path) -> None:
    (tmp_path / "specless_solver.py").write_text(PLAIN.replace('load_solver("gs-8pt").spec', '"a text"'), "utf-8")
    with pytest.raises(RsbenchError, match=r"mine.toml: declares what cannot be: .*must be a SolverSpec"):
        load_solver(card(tmp_path, 'class = "specless_solver:Plain"'))


PLAIN = """
from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.base import load_solver


class Plain(Solver):
    spec = load_solver("gs-8pt").spec

    def __init__(self, mood="calm"):
        self.mood = mood

    def estimate(self, correspondences, rig, shutter):
        return MotionEstimate.failed(self.mood)
"""


def test_the_key_follows_class_parameters_source_and_what_is_inside(tmp_path: Path) -> None:
    scaled = 'class = "rsbench.solvers.zhuang:FlowScaledSolver"\n[parameters]\nsolver = "{}"'
    inner = tmp_path / "inner.toml"
    keys = set()
    for iterations in (20, 30):
        inner.write_text(
            'class = "rsbench.solvers.refined:RefinedSolver"\n'
            f'[parameters]\nshutter = "global"\niterations = {iterations}'
        )
        keys.add(load_solver_entry(card(tmp_path, scaled.format(inner))).key)
    module = tmp_path / "moody_solver.py"
    for text in (PLAIN, PLAIN + "# changed\n"):
        module.write_text(text, "utf-8")
        for mood in ("calm", "wild"):
            path = card(tmp_path, f'class = "moody_solver:Plain"\n[parameters]\nmood = "{mood}"')
            keys.add(load_solver_entry(path).key)
            assert load_solver_entry(path).key in keys  # an object that is no dataclass keeps its key
        sys.modules.pop("moody_solver")
    assert len(keys) == 2 + 4
    assert (
        load_solver_entry("gs-8pt").key == load_solver_entry("gs-8pt").key != load_solver_entry("gs-poselib").key
    )


@pytest.mark.parametrize(
    ("field", "value", "part"),
    [
        ("shutter", "GS", "rolling, global"),
        ("reference_point", "Left", "body, left"),
        ("needs", {"Left"}, "left, right, stereo, tracks, affine, gyro, gravity"),
        ("needs", set(), "at least one"),
        ("minimum", {"right": 8}, "says nothing about left"),
        ("minimum", {"left": 0}, "above 0"),
        ("metric", "yes", "True or False"),
        ("motion_model", "", "must be a text"),
    ],
)
def test_a_wrong_declaration_is_refused(field: str, value: object, part: str) -> None:
    with pytest.raises(ValueError, match=part):
        replace(SPEC, **{field: value})  # pyrefly: ignore[bad-argument-type]


def test_a_failure_holds_no_motion() -> None:
    failure = MotionEstimate.failed("because")
    assert not failure.success and failure.reason == "because"
    assert np.all(np.isnan(failure.w)) and np.all(np.isnan(failure.d))
    with pytest.raises(ValueError, match="finite"):
        MotionEstimate(w=np.full(3, np.nan), d=np.zeros(3), success=True)
