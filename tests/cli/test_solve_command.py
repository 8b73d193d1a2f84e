"""``rsbench solve`` as users meet it: many problems, several solvers, and solvers that misbehave."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import assert_refused, run_apart, run_here
from documents import ROOT, blocks

import rsbench
from rsbench.components.motion_models import TwistMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.problem import EXAMPLE, Problem, problem_record

PLUGIN = """
import os, sys, time
from dataclasses import dataclass
from rsbench.solvers.essential_matrix import EightPointSolver
from rsbench.solvers.engine.base import MotionEstimate, Solver

print("imported")


@dataclass(frozen=True, kw_only=True)
class Odd(Solver):
    what: str
    spec = EightPointSolver.spec

    def estimate(self, correspondences, rig, shutter):
        print("estimating", flush=True)
        if self.what == "exit":
            sys.exit(3)
        if self.what == "crash":
            os.abort()
        if self.what == "hang":
            time.sleep(1000)
        return EightPointSolver().estimate(correspondences, rig, shutter)
"""


NOTHING: dict[str, list[float]] = {name: [] for name in ("left", "right", "stereo_0", "stereo_1", "tracks")}


def solve(*arguments: object, text: str = "") -> subprocess.CompletedProcess[str]:
    return run_here("solve", *arguments, text=text)


def answers(result: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def odd_card(folder: Path, what: str, extra: str = "") -> Path:
    (folder / "odd_plugin.py").write_text(PLUGIN)
    card = folder / f"{what}.toml"
    card.write_text(f"class = 'odd_plugin:Odd'\n{extra}\n[parameters]\nwhat = '{what}'\n")
    return card


def test_the_sample_is_printed_and_solved_away_from_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    sample = solve("--example")
    assert sample.returncode == 0 and json.loads(sample.stdout)["name"] == "example"
    (tmp_path / "problem.json").write_text(sample.stdout)
    result = solve("problem.json")
    assert result.returncode == 0 and result.stderr == ""
    assert "m per frame, of the middle of the baseline" in result.stdout
    assert "of 80 matches" in result.stdout


@pytest.mark.slow
def test_a_missing_readout_ratio_is_estimated_or_refused() -> None:
    """Good tracks of a turning rig determine it, 80 matches of the sample do not; global solvers need none."""
    rig = StereoRig(camera=PinholeCamera.centred(640, 480, 520.0), baseline=0.2)
    shutter = RollingShutter(height=480, readout_ratio=0.8)
    motion = TwistMotion(w=np.array([0.01, -0.03, 0.02]), d=np.array([0.1, 0.02, 0.05]))
    matches = rsbench.simulate(rig, shutter, motion, tracks=150, noise_px=0.05, seed=3).correspondences
    record = problem_record(Problem(name="p", correspondences=matches, rig=rig, known_shutter=shutter))
    without = {key: value for key, value in record.items() if key != "readout_ratio"}
    sample = json.loads(EXAMPLE.read_text())
    del sample["readout_ratio"]
    text = "\n".join(json.dumps(each) for each in (without, sample))
    found, open_ = answers(solve("-", "--json", text=text))
    assert found["success"] and found["motion_model"] == "twist"
    assert abs(found["readout_ratio"] - 0.8) < 3.0 * found["readout"]["readout_ratio_sigma"] < 0.2
    assert not open_["success"] and "cannot tell the readout ratio" in open_["reason"]
    (blind,) = answers(solve("-", "--json", "--solver", "gs-8pt", text=json.dumps(sample)))
    assert blind["success"] and "readout" not in blind and blind["readout_ratio"] is None


def test_many_problems_and_two_solvers_give_one_line_each(tmp_path: Path) -> None:
    sample = json.loads(EXAMPLE.read_text())
    lines = [json.dumps(sample | {"name": f"p{k}"}) for k in range(3)]
    lines[1] = json.dumps(sample | {"baseline": -1.0})
    few = sample | {"name": "few"} | NOTHING
    many = "\n".join([*lines, json.dumps(few)])
    result = solve(
        "-", "--solver", "rs-stereo-refined", "--solver", "gs-8pt", "--json", "--with", "noise", text=many
    )
    assert result.returncode == 2
    assert (
        result.stderr
        == "rsbench: error: stdin:2: baseline = -1.0: must be a positive number of metres, at most 1e+09\n"
    )
    found = answers(result)
    pairs = [(answer["name"], answer["solver"]) for answer in found]
    assert pairs == [(name, solver) for name in ("p0", "p2", "few") for solver in ("rs-stereo-refined", "gs-8pt")]
    assert [answer["success"] for answer in found] == [True] * 4 + [False] * 2
    assert all("noise_px" in answer and "covariance" not in answer for answer in found)
    # The same seed for each: neither the problems nor the solvers beside one change its answer.
    (tmp_path / "p0.json").write_text(lines[0])
    (alone,) = answers(solve(tmp_path / "p0.json", "--solver", "gs-8pt", "--json", "--with", "noise"))
    assert {**alone, "seconds": 0.0} == {**found[1], "seconds": 0.0}
    assert [found[0]["d"], found[1]["w"]] == [found[2]["d"], found[3]["w"]]


def test_a_problem_without_an_answer_is_exit_code_1(tmp_path: Path) -> None:
    sample = json.loads(EXAMPLE.read_text()) | NOTHING
    (tmp_path / "few.json").write_text(json.dumps(sample))
    result = solve(tmp_path, EXAMPLE, "--solver", "rs-stereo-refined", "--solver", "gs-8pt")
    assert result.returncode == 1
    rows = [line for line in result.stdout.splitlines() if "rs-stereo-refined" in line or "gs-8pt" in line]
    assert ["/80" in row or "/60" in row for row in rows] == [False, False, True, True]
    quiet = run_here("--quiet", "solve", tmp_path, EXAMPLE)
    assert quiet.returncode == 1
    first, second = (line.split("\t") for line in quiet.stdout.splitlines())
    assert first[1:4] == ["rs-stereo-refined", "-", "-"] and second[3].endswith(" m") and second[5].endswith("/80")


@pytest.mark.slow
def test_a_solver_that_misbehaves_fails_alone_and_leaves_the_answers_clean(tmp_path: Path) -> None:
    cards = [odd_card(tmp_path, what) for what in ("print", "exit", "crash")]
    cards.append(odd_card(tmp_path, "hang", "time_limit_s = 1.0"))
    options = [part for card in cards for part in ("--solver", card)]
    # In a process of its own: what its children print would not pass through this one's standard output.
    result = run_apart("solve", EXAMPLE, *options, "--solver", "gs-8pt", "--json")
    assert result.returncode == 1, result.stderr
    fine, left, crashed, hung, ours = answers(result)  # every line is an answer, whatever was printed
    assert fine["success"] and fine["w"] == ours["w"] and fine["inliers"] == ours["inliers"]
    assert not (left["success"] or crashed["success"] or hung["success"])
    assert "SystemExit" in left["reason"]
    assert "SIGABRT" in crashed["reason"] or "signal" in crashed["reason"]
    assert "1 s" in hung["reason"]


def test_a_solver_with_a_loop_of_its_own_is_not_wrapped(tmp_path: Path) -> None:
    card = odd_card(tmp_path, "own", "robust = 'own'")
    (answer,) = answers(solve(EXAMPLE, "--solver", card, "--json"))
    # Eight points on all matches, wrong ones too: one call, no samples.
    assert answer["success"] and answer["iterations"] == 0
    assert answer["inliers"] < answer["matches"] == 60


def test_an_interrupt_keeps_earlier_answers_and_ends_the_solvers_process(tmp_path: Path) -> None:
    card = odd_card(tmp_path, "hang")
    options = [EXAMPLE, "--solver", "gs-8pt", "--solver", card, "--json"]
    command = [sys.executable, "-m", "rsbench", "solve", *map(str, options)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        assert json.loads(process.stdout.readline())["solver"] == "gs-8pt"  # then the one that hangs
        process.send_signal(signal.SIGINT)
        # Both ends close only when no child holds them any more; the hanging solver would for 1000 s.
        assert process.stdout.read() == ""
        assert "interrupted; nothing is kept" in process.stderr.read()
        assert process.wait(60) == 130


def test_the_page_shows_what_the_example_prints() -> None:
    (shown,) = blocks(ROOT / "docs/how-to/solve.md", "text")
    number = re.compile(r"-?\d+\.\d+")
    printed = run_here("solve", EXAMPLE).stdout
    assert number.sub("#", shown) == number.sub("#", printed)
    found = [[float(each) for each in number.findall(text)] for text in (shown, printed)]
    assert found[0] == pytest.approx(found[1], rel=0.05, abs=0.002)


def test_the_motion_model_is_chosen_and_printed() -> None:
    """The sample is of the paper's model, which 80 matches do not tell from others; another is used on request."""
    text = run_here("solve", EXAMPLE)
    assert text.returncode == 0
    assert re.search(r"motion model: (linear|cannot tell, so (\w+) is used \(\2)", text.stdout)
    answer = json.loads(run_here("solve", EXAMPLE, "--motion-model", "twist", "--json").stdout)
    choice = answer["model_choice"]
    assert answer["motion_model"] == choice["used"] == "twist"
    assert json.loads(run_here("solve", EXAMPLE, "--solver", "gs-8pt", "--json").stdout)["model_choice"] is None
    assert_refused(run_here("solve", EXAMPLE, "--motion-model", "twsit"), "did you mean 'twist'")
    assert_refused(
        run_here("solve", EXAMPLE, "--motion-model", "auto", "--solver", "gs-8pt"),
        "use --solver rs-stereo-refined",
    )
