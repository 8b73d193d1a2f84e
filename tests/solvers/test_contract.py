"""Every solver keeps the contract, the checks catch whoever breaks it, and solvers are found by name."""

from __future__ import annotations

import json
import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import refused, run_here

from rsbench.benchmark.simulated.contract import (
    CHECKS,
    Finding,
    check_solver,
)
from rsbench.core.errors import RsbenchError
from rsbench.solvers.engine.base import (
    MotionEstimate,
    SolverEntry,
    SolverSpec,
    list_solvers,
    load_solver,
    load_solver_entry,
)

ALLOWED_WARNINGS = {
    # The published linearisation couples rotation and readout: the rotation is 1 % off, and d with it.
    ("rs-stereo-linear", "finds the truth"),
    # OpenCV draws five of the matches in the order given, and keeps one model.
    ("gs-5pt-opencv", "ignores the order of matches"),
    # Points lie on the rays of the left camera: the right one's noise counts differently.
    ("gs-p3p", "mirrors with the world"),
    ("rs-r6p", "mirrors with the world"),
    ("rs-r6p-single", "mirrors with the world"),
    # And their three-point pose is its too.
    ("gs-stereo-pnp", "mirrors with the world"),
    ("gs-stereo-pnp-scaled", "mirrors with the world"),
}


@pytest.mark.parametrize("name", list_solvers())
def test_every_solver_keeps_the_contract(name: str) -> None:
    findings = check_solver(load_solver_entry(name))
    assert [finding.check for finding in findings] == list(CHECKS)
    assert [finding for finding in findings if finding.verdict == "failed"] == []
    warnings = {(name, finding.check) for finding in findings if finding.verdict == "warning"}
    assert warnings == {(solver, check) for solver, check in ALLOWED_WARNINGS if solver == name}


# Solvers that break it. All answer as the refined solver does, but for one thing.

HEAD = """
import os, sys, time
from dataclasses import replace
import numpy as np
from rsbench.core import so3
from rsbench.core.pose_errors import translation_of_offset
from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.refined import RefinedSolver

calls = []

class Bad(Solver):
    spec = {spec}

    def estimate(self, correspondences, rig, shutter):
        calls.append(1)
        right = RefinedSolver().estimate(correspondences, rig, shutter)
        if not right.success:
            return right
{body}
"""
SPEC = "RefinedSolver().spec"
BAD = {
    "raises": ("raise KeyError('tracks')", "answers", "raised KeyError: 'tracks'"),
    "tuple": ("return right.w, right.d", "answers", "returned a tuple, not a MotionEstimate"),
    "nan": ("return replace(right, w=right.w * np.nan)", "answers", "must be 3 finite numbers"),
    "no success": ("return replace(right, success=False, reason='shy')", "answers", "failed on 60 + 60"),
    "no reason": ("return replace(right, success=False)", "answers", "a failure without a reason"),
    "exits": ("sys.exit(0)", "answers", "SystemExit"),
    "negative covariance": (
        "return replace(right, covariance=-np.eye(6))",
        "answers",
        "a covariance with the eigenvalue -1",
    ),
    "random": (
        "return replace(right, w=right.w + 1e-9 * np.random.default_rng().standard_normal(3))",
        "is deterministic",
        "seed what you draw",
    ),
    "counts": ("return replace(right, w=right.w + 1e-12 * len(calls))", "is deterministic", "two motions"),
    "first match": (
        "return replace(right, w=right.w + 1e-7 * correspondences.left[0, 0])",
        "ignores the order of matches",
        "in another order",
    ),
    "writes": (
        "correspondences.tracks.setflags(write=True); correspondences.tracks[0] += 1.0; return right",
        "leaves its input alone",
        "wrote into tracks",
    ),
    "prints": ("print('iteration 3'); return right", "is quiet", "prints: 'iteration 3'"),
    "left side": (
        "side = correspondences.left[:, 0].mean() + correspondences.right[:, 0].mean()\n"
        "return replace(right, w=right.w * (1.0 if side > 899 else 1 + 1e-3))",
        "mirrors with the world",
        "of the mirrored world",
    ),
    "raises when there is little": (
        "if len(correspondences.tracks) != 60: raise IndexError('list index out of range')\nreturn right",
        "fails by value",
        "IndexError",
    ),
    "inverted w": ("return replace(right, w=-right.w)", "finds the truth", "w is inverted"),
    "inverted d": ("return replace(right, d=-right.d)", "finds the truth", "d is inverted"),
    "inverse": (
        "return replace(right, w=-right.w, d=-so3.exp(-right.w) @ right.d)",
        "finds the truth",
        "inverse motion",
    ),
    "paper's axes": (
        "return replace(right, w=-right.w[[1, 0, 2]], d=right.d[[1, 0, 2]])",
        "finds the truth",
        "the paper's axes",
    ),
    "degrees": ("return replace(right, w=np.rad2deg(right.w))", "finds the truth", "in degrees"),
    "left camera": (
        "return replace(right, d=translation_of_offset(right.w, right.d, rig.offset('left')))",
        "finds the truth",
        "d is the translation of the left camera, but the spec says reference_point = 'body'",
    ),
    "millimetres": ("return replace(right, d=1000 * right.d)", "finds the truth", "1e+03 times as long"),
    "a row off": (
        "return replace(right, w=1.03 * right.w)",
        "finds the truth",
        "rotation is 3.0e-02 off on exact data, and 3.0e-02 at a quarter",
    ),
}


def bad_entry(folder: Path, name: str, body: str, spec: str = SPEC) -> SolverEntry:
    module = re.sub(r"\W", "_", f"{folder.name}_{name}")  # one name, one module
    indented = "\n".join("        " + line for line in body.split("\n"))
    (folder / f"{module}.py").write_text(HEAD.format(body=indented, spec=spec), "utf-8")
    card = folder / f"{module}.toml"
    card.write_text(f'class = "{module}:Bad"\ntime_limit_s = 20', "utf-8")
    return load_solver_entry(card)


def found(findings: list[Finding], check: str) -> Finding:
    (finding,) = [finding for finding in findings if finding.check == check]
    return finding


@pytest.mark.parametrize("name", BAD)
def test_a_solver_that_breaks_the_contract_is_caught(tmp_path: Path, name: str) -> None:
    body, check, part = BAD[name]
    findings = check_solver(bad_entry(tmp_path, name, body), isolated=False)
    finding = found(findings, check)
    assert finding.verdict == ("warning" if check in ("is quiet",) else "failed"), findings
    assert part in finding.why and "\n" not in finding.why
    if check == "answers":
        assert {each.verdict for each in findings[1:]} == {"skipped"}


def test_a_solver_that_keeps_it_passes_everything(tmp_path: Path) -> None:
    findings = check_solver(bad_entry(tmp_path, "none", "return right"), isolated=False)
    assert {finding.verdict for finding in findings} == {"passed"}


def test_a_wrong_declaration_is_caught(tmp_path: Path) -> None:
    spec = f"replace({SPEC}, metric=False)"
    findings = check_solver(bad_entry(tmp_path, "metric", "return right", spec), isolated=False)
    assert findings[0].verdict == "failed" and "metric = True, but its spec says metric = False" in findings[0].why
    with pytest.raises(RsbenchError, match="motion model 'orbital' does not exist"):
        bad_entry(tmp_path, "model", "return right", f"replace({SPEC}, motion_model='orbital')")


@pytest.mark.parametrize(
    ("body", "part"),
    [("while True: pass", "took longer than 1 s"), ("os.abort()", "SIGABRT"), ("os._exit(7)", "exit code 7")],
)
def test_a_solver_that_hangs_or_ends_its_process_fails_alone(tmp_path: Path, body: str, part: str) -> None:
    start = time.monotonic()
    limit = 1.0 if "while" in body else 30.0  # a process that ends does so at once, but not on a busy machine
    findings = check_solver(bad_entry(tmp_path, "process", body), time_limit_s=limit)
    assert findings[0].verdict == "failed" and part in findings[0].why
    assert {finding.verdict for finding in findings[1:]} == {"skipped"}
    assert time.monotonic() - start < 60.0  # mostly the start of the child


def test_a_child_process_gives_the_same_findings(tmp_path: Path) -> None:
    """An isolated solver's matches are copies that refuse to be written, as they do here."""
    body = "print('hello'); os.write(2, b'low'); correspondences.left[0] = 0.0; return right"
    finding = check_solver(bad_entry(tmp_path, "child", body))[0]
    assert finding.verdict == "failed" and "read-only" in finding.why
    findings = check_solver(bad_entry(tmp_path, "quiet child", "os.write(1, b'from C\\n'); return right"))
    assert found(findings, "is quiet") == Finding(check="is quiet", verdict="warning", why="prints: 'from C'")
    assert [each.verdict for each in findings[:-1]] == ["passed"] * (len(CHECKS) - 1)


def test_a_biased_solver_is_a_warning(tmp_path: Path) -> None:
    """1 % of the rotation whatever its size: no error of linearisation, which would vanish with the motion."""
    findings = check_solver(bad_entry(tmp_path, "bias", "return replace(right, w=1.01 * right.w)"), isolated=False)
    finding = found(findings, "finds the truth")
    assert finding.verdict == "warning" and "rotation 1.0e-02 off however small the motion is" in finding.why


# The command


def test_the_command_prints_a_table_and_fails_with_the_solver(tmp_path: Path) -> None:
    entry = bad_entry(tmp_path, "inverted w", BAD["inverted w"][0])
    result = run_here("check-solver", entry.path, "--json")
    assert result.returncode == 1, result.stderr
    answer = json.loads(result.stdout)
    assert answer["solver"] == entry.name and answer["passed"] is False
    verdicts = {each["check"]: each["verdict"] for each in answer["checks"]}
    assert verdicts.pop("finds the truth") == "failed" and list(verdicts) == [
        c for c in CHECKS if "truth" not in c
    ]
    result = run_here("check-solver", "gs-8pt")
    assert result.returncode == 0, result.stderr
    assert all(name in result.stdout for name in CHECKS) and "0 of 8 checks failed" in result.stdout


OTHER_SPEC = SolverSpec(
    needs=frozenset({"left"}),
    minimum={"left": 1},
    metric=False,
    motion_model="linear",
    shutter="global",
    reference_point="body",
    reference="a test",
    assumes="nothing",
)


def card(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_a_card_may_name_the_module_that_a_class_was_in_before(tmp_path: Path) -> None:
    for name in ("dai:DaiSolver", "poselib_mono:PoselibMonoSolver", "eight_point:EightPointSolver"):
        solver = load_solver(card(tmp_path, f'class = "rsbench.solvers.{name}"'))
        assert type(solver).__name__ == name.partition(":")[2]


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
    with refused("mine.toml", *parts):
        load_solver(card(tmp_path, text))


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
        replace(OTHER_SPEC, **{field: value})  # pyrefly: ignore[bad-argument-type]


def test_a_failure_holds_no_motion() -> None:
    failure = MotionEstimate.failed("because")
    assert not failure.success and failure.reason == "because"
    assert np.all(np.isnan(failure.w)) and np.all(np.isnan(failure.d))
    with pytest.raises(ValueError, match="finite"):
        MotionEstimate(w=np.full(3, np.nan), d=np.zeros(3), success=True)
