"""A function is a solver: like the class that does the same, wherever a card is taken, and wrong in one line."""

from __future__ import annotations

import json
import pickle  # noqa: TID251  what others do with a solver
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from commands import assert_refused, refused, run_here, sweep_card

import rsbench
from rsbench import Correspondences, RollingShutter, StereoRig
from rsbench.benchmark.images.plan import _named
from rsbench.benchmark.simulated.contract import RIG, ROLLING, D, W
from rsbench.components import imports
from rsbench.core.errors import RsbenchError
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import MotionEstimate, load_solver, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions

BODY = """
import numpy as np
import rsbench

def eight_points(left, rig):
    x0, x1 = (rig.camera.unproject(left[:, k : k + 2]) for k in (0, 2))
    E = np.linalg.svd((x1[:, :, None] * x0[:, None]).reshape(-1, 9))[2][-1].reshape(3, 3)
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.linalg.det(U), Vt * np.linalg.det(Vt)
    spin = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    motions = [(U @ turn @ Vt, t) for turn in (spin, spin.T) for t in (U[:, 2], -U[:, 2])]
    R, t = max(motions, key=lambda motion: in_front(*motion, x0, x1))
    w = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine = np.linalg.norm(w)
    return w * (np.arcsin(sine) / sine), t

def in_front(R, t, x0, x1):
    normal = np.cross(x1, x0 @ R.T)
    z0 = -np.sum(normal * np.cross(x1, t), axis=1) / np.sum(normal**2, axis=1)
    return np.count_nonzero((z0 > 0) & ((z0[:, None] * (x0 @ R.T) + t)[:, 2] > 0))
"""
FUNCTION = f"""{BODY}
@rsbench.solver(needs={{"left"}}, minimum=8, shutter="global", reference_point="left")
def eight(correspondences, rig, shutter, scale: float = 1.0):
    \"\"\"Eight points.\"\"\"
    w, d = eight_points(correspondences.left, rig)
    return scale * w, d
"""
CLASS = f"""{BODY}
from dataclasses import dataclass
from rsbench import MotionEstimate, Solver, SolverSpec
from rsbench.core.correspondences import temporal_pairs

@dataclass(frozen=True, kw_only=True)
class Eight(Solver):
    spec = SolverSpec(
        needs={{"left"}}, minimum={{"left": 8}}, metric=False, motion_model="linear", shutter="global",
        reference_point="left", reference="eight points", assumes="translation",
    )

    def estimate(self, correspondences, rig, shutter):
        left = temporal_pairs(correspondences, "left")
        if short := self.spec.shortage({{"left": len(left)}}):
            return short
        w, d = eight_points(left, rig)
        return MotionEstimate(w=w, d=d, success=True)
"""
HEAD = "import numpy as np\nimport rsbench\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working folder, with a function and a class that do the same; modules are forgotten afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(imports, "_folders", [])
    monkeypatch.setattr(imports, "_beside_cards", {})
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules)
    (tmp_path / "by_function.py").write_text(FUNCTION, "utf-8")
    (tmp_path / "by_class.py").write_text(CLASS, "utf-8")
    yield tmp_path
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) and str(tmp_path) in str(sys.modules[name].__file__):
            del sys.modules[name]


def written(folder: Path, text: str, name: str = "mine.py") -> str:
    (folder / name).write_text(f"{HEAD}{text}", "utf-8")
    return name


def test_a_function_answers_like_the_class_that_does_the_same(folder: Path) -> None:
    """Tracks are matches of both; some matches are wrong. In processes of their own, as of another package."""
    motion = rsbench.LinearMotion(W, D)
    data = rsbench.simulate(RIG, ROLLING, motion, pairs=40, tracks=40, noise_px=0.3, outlier_ratio=0.2)
    with SolverRunner() as runner:
        found = [
            runner.robust(
                load_solver_entry(name),
                data.correspondences,
                RIG,
                ROLLING,
                RobustOptions(),
                np.random.default_rng(0),
            ).estimate
            for name in ("by_function.py", "by_class.py")
        ]
    assert found[0].success, found[0].reason
    np.testing.assert_array_equal([found[0].w, found[0].d], [found[1].w, found[1].d])


def test_the_motion_of_exact_data_is_the_true_one(folder: Path) -> None:
    shutter = rsbench.RollingShutter(height=900, readout_ratio=0.0)
    data = rsbench.simulate(RIG, shutter, rsbench.LinearMotion(W, D), noise_px=0.0)
    found = load_solver("by_function.py").estimate(data.correspondences, RIG, shutter)
    np.testing.assert_allclose(found.w, W, atol=1e-9)
    assert not found.metric and load_solver_entry("by_function.py").description == "Eight points."


@pytest.mark.slow
def test_commands_take_the_file(folder: Path) -> None:
    (folder / "sweep.toml").write_text(sweep_card(["gs-8pt"], noise_px=[0.2], trials=8), "utf-8")
    problem = Path(__file__).parents[2] / "examples" / "problem.json"
    assert run_here("check-solver", "by_function.py", "--json").returncode == 0
    solved = run_here("solve", problem, "--solver", "by_function.py", "--json")
    assert json.loads(solved.stdout)["solver"] == "by_function"
    given = ("--solver", "by_function.py", "--solver", "by_class.py", "--workers", 1)
    shown = run_here("simulate", "sweep.toml", *given, "--out", "out", COLUMNS="80")
    assert shown.returncode == 0, shown.stderr
    stored = pd.read_csv(folder / "out" / "summary.csv").to_dict("records")
    by_function, by_class = ({str(key): value for key, value in each.items()} for each in stored)
    assert by_function["e_T_mean"] == by_class["e_T_mean"] < 60.0
    row = next(line for line in shown.stdout.splitlines() if "by_function" in line)
    assert row.count("[") == 2 and row.rstrip().endswith("%") and len(row) <= 80
    ends = [float(end) for end in re.findall(r"\[(.*?), (.*?)\]", row)[0]]
    np.testing.assert_allclose(ends, [by_function[f"e_R_median_{end}"] for end in ("low", "high")], rtol=0.1)
    run = ("leaderboard", "run", "points", "--solver", "by_function.py", "--problems", 2, "--workers", 1)
    shown = run_here(*run, "--board", "board").stdout
    assert {"by_function", "gs-8pt", "cramer-rao"} <= {*shown.split()} and "ranked among 4" in shown


def test_further_parameters_are_those_of_a_card(folder: Path) -> None:
    (folder / "double.toml").write_text('class = "by_function:eight"\nparameters = {scale = 2.0}\n', "utf-8")
    data = rsbench.simulate(RIG, ROLLING, rsbench.LinearMotion(W, D), noise_px=0.1)
    single, double = (
        load_solver(name).estimate(data.correspondences, RIG, ROLLING)
        for name in ("by_function.py:eight", "double.toml")
    )
    np.testing.assert_array_equal(double.w, 2.0 * single.w)
    (folder / "double.toml").write_text('class = "by_function:eight"\nparameters = {scale = "x"}\n', "utf-8")
    with refused("double.toml", "scale"):
        load_solver("double.toml")


def test_samples_of_a_sensor_are_no_matches_to_draw(folder: Path) -> None:
    name = written(folder, "@rsbench.solver(needs={'left', 'gyro'}, minimum=5)\ndef f(c, r, s): pass\n")
    assert load_solver(name).spec.minimum == {"left": 5, "gyro": 2}


def test_a_solver_of_a_function_is_sent_to_other_processes(folder: Path) -> None:
    solver = load_solver("by_function.py")
    assert pickle.loads(pickle.dumps(solver)) == solver


def test_the_function_stays_one_and_is_a_solver_for_python() -> None:
    @rsbench.solver(needs="tracks", minimum=3, metric=True)
    def still(correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter) -> Any:
        assert len(correspondences.tracks) >= 3
        return [0.0, 0.0, 1e-3], np.array([[0.0], [0.0], [0.1]])

    data = rsbench.simulate(RIG, ROLLING, rsbench.LinearMotion([0, 0, 1e-3], [0, 0, 0.1]), noise_px=0.0)
    found = rsbench.estimate_motion(data.correspondences, RIG, ROLLING, still).estimate
    assert found.success and found.metric
    np.testing.assert_array_equal(found.d, [0.0, 0.0, 0.1])
    assert still(data.correspondences, RIG, ROLLING)[0] == [0.0, 0.0, 1e-3]
    left = rsbench.solver(lambda matches, rig, shutter: (np.zeros(3), np.ones(3)), needs="left", minimum=5)
    assert rsbench.estimate_motion(data.correspondences, RIG, ROLLING, left).estimate.metric is False
    with pytest.raises(ValueError, match=r"below @rsbench\.solver"):
        rsbench.estimate_motion(data.correspondences, RIG, ROLLING, print)


def test_the_function_states_defaults_for_the_keys_of_its_card(folder: Path) -> None:
    text = '@rsbench.solver(robust="own", code="OpenCV", tuned_on="seed 7")\ndef f(c, r, s): pass\n'
    module = Path(written(folder, text))
    options = load_solver_entry(module).options
    assert (options.robust, options.code, options.tuned_on) == ("own", "OpenCV", "seed 7")
    (folder / "mine-card.toml").write_text(f"class = '{module.stem}:f'\ncode = 'OpenCV 5'\n", "utf-8")
    options = load_solver_entry("./mine-card.toml").options
    assert (options.robust, options.code, options.tuned_on) == ("own", "OpenCV 5", "seed 7")


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("None", "found no motion"),
        ("np.full(3, np.nan), np.ones(3)", "not finite"),
        ("np.linalg.inv(np.zeros((3, 3)))", "Singular matrix"),
    ],
)
def test_what_is_no_motion_is_a_failure(folder: Path, answer: str, words: str) -> None:
    solver = load_solver(written(folder, f"@rsbench.solver\ndef f(c, rig, shutter):\n    return {answer}\n"))
    data = rsbench.simulate(RIG, ROLLING, rsbench.LinearMotion(W, D))
    found = solver.estimate(data.correspondences, RIG, ROLLING)
    assert isinstance(found, MotionEstimate) and not found.success and words in found.reason
    few = rsbench.Correspondences(left=data.correspondences.left[:8], right=data.correspondences.right)
    assert solver.estimate(few, RIG, ROLLING).reason == "8 left matches, need 9"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("np.eye(3), np.ones(3)", "as_rotvec"),
        ("np.ones(3)", "must return w and d"),
        ("np.ones(2), np.ones(3)", "must be 3 numbers"),
        ("1 / 0", "ZeroDivisionError"),
    ],
)
def test_a_mistake_is_told_in_the_reason(folder: Path, answer: str, words: str) -> None:
    name = written(folder, f"@rsbench.solver\ndef f(c, rig, shutter):\n    return {answer}\n")
    data = rsbench.simulate(RIG, ROLLING, rsbench.LinearMotion(W, D))
    with SolverRunner() as runner:
        found, _ = runner.bare(load_solver_entry(name), data.correspondences, RIG, ROLLING)
    assert not found.success and words in found.reason


WRONG = {
    "x = 1": ("mine.py: defines no solver", "@rsbench.solver"),
    "def f(c, rig, shutter): pass": ("write @rsbench.solver above def f(c, rig, shutter)",),
    "def f(:": ("mine.py: cannot be imported: SyntaxError",),
    "@rsbench.solver\ndef f(c, rig): pass": ("f(c, rig): a solver has the arguments",),
    "@rsbench.solver\ndef f(c, rig, shutter, k): pass": ("defaults for all others",),
    "@rsbench.solver\ndef f(c, rig, shutter, spec=1): pass": ("rename the parameter 'spec'",),
    "@rsbench.solver(needs={'lefts'})\ndef f(c, rig, shutter): pass": ("'lefts' is no set of matches",),
    "@rsbench.solver(robust='no')\ndef f(c, rig, shutter): pass": ("robust = 'no'", "ransac, own"),
    "@rsbench.solver(code=3)\ndef f(c, rig, shutter): pass": ("code = 3", "must be a text"),
    "@rsbench.solver(minimum=0)\ndef f(c, rig, shutter): pass": ("minimum", "above 0"),
    "f = rsbench.solver(len)": ("must decorate a function",),
    "@rsbench.solver\ndef f(c, r, s): pass\n@rsbench.solver\ndef g(c, r, s): pass": ("mine.py:f", "f, g"),
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_file_is_refused_in_one_line(folder: Path, text: str) -> None:
    with refused(*WRONG[text]):
        load_solver(written(folder, text))


def test_a_wrong_path_is_refused_in_one_line(folder: Path) -> None:
    written(folder, "def plain(c, r, s): pass\n")
    for path, words in {
        "missing.py": "no such file",
        "by_function.py:nine": "defines no 'nine'",
        "mine.py:plain": "above def plain",
        "by_function": "did you mean by_function.py?",
        "neither": "a path ends in .toml or .py",
    }.items():
        assert_refused(run_here("check-solver", path), words)
    (folder / "my-solver.py").write_text(FUNCTION, "utf-8")
    assert_refused(run_here("simulate", "rotation", "--out", "out", "--solver", "my-solver.py"), "rename it")


def test_a_record_names_no_file_to_run() -> None:
    """Records of an evaluation are untrusted: what they name is loaded by name alone."""
    for source in ("mine.py", "mine.py:f", "./mine.toml"):
        with pytest.raises(RsbenchError, match="does not name"):
            _named(load_solver_entry, source)
