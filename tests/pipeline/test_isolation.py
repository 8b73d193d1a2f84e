"""Other people's code in a child process: each way to go wrong is a failure with its reason, of nobody else."""

from __future__ import annotations

import functools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import LinearMotion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.isolation import IsolatedWorker
from rsbench.pipeline.plain_data import decode, encode
from rsbench.pipeline.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.eight_point import EightPointSolver
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.registry import SolverEntry, load_solver_entry

PLUGIN = """
import ctypes, dataclasses, os, signal, subprocess, sys, time

import numpy as np

from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.registry import load_solver


EIGHT_POINT = load_solver("gs-8pt")


class Mischief(Solver):
    spec = EIGHT_POINT.spec

    def __init__(self, what, note=""):
        self.what, self.note = what, note

    def estimate(self, correspondences, rig, shutter):
        good = EIGHT_POINT.estimate(correspondences, rig, shutter)
        if os.environ.get("MISCHIEF_SPARES_FEW") and len(correspondences.left) < 20:
            return good
        return getattr(self, "_" + self.what)(good)

    def _nothing(self, good):
        return good

    def _raise(self, good):
        raise ValueError("a matrix\\nis singular")

    def _tuple(self, good):
        return (good.w, good.d)

    def _none(self, good):
        return None

    def _nan(self, good):
        return MotionEstimate(w=good.w * np.nan, d=good.d, success=True)

    def _smuggled_nan(self, good):
        object.__setattr__(good, "w", good.w * np.nan)
        return good

    def _shape(self, good):
        return MotionEstimate(w=good.w[:2], d=good.d, success=True)

    def _covariance(self, good):
        return dataclasses.replace(good, covariance=np.full((6, 6), np.inf))

    def _reason(self, good):
        return dataclasses.replace(good, reason=3)

    def _sys_exit(self, good):
        sys.exit(3)

    def _os_exit(self, good):
        print("the end is near", file=sys.stderr)
        os._exit(1)

    def _crash(self, good):
        ctypes.string_at(0)

    def _kill(self, good):
        os.kill(os.getpid(), signal.SIGKILL)

    def _interrupt(self, good):
        raise KeyboardInterrupt

    def _loop(self, good):
        while True:
            pass

    def _hold(self, good):
        # A foreign function that never gives Python's lock back.
        ctypes.PyDLL(None).sleep(1000)

    def _print(self, good):
        print('{"success": true}', flush=True)
        os.system("echo from a shell")
        return good

    def _read(self, good):
        assert sys.stdin.read() == ""
        return good

    def _breed(self, good):
        child = subprocess.Popen(["sleep", "1000"])
        with open(self.note, "w") as file:
            file.write(f"{os.getpid()} {child.pid}")
        while True:
            time.sleep(1)

    def _fork(self, good):
        if os.fork() == 0:
            time.sleep(1000)
        os._exit(7)

    def _close(self, good):
        os.closerange(0, 100)
        return good
"""
RIG = StereoRig(camera=PinholeCamera.centred(640, 480, 500.0), baseline=0.2)
SHUTTER = RollingShutter(height=480, readout_ratio=0.0)


@pytest.fixture
def simulation() -> Simulation:
    motion = LinearMotion(np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.05, 0.12]))
    return simulate(RIG, SHUTTER, motion, SimulationOptions(pairs=40, noise_px=0.1), np.random.default_rng(0))


@pytest.fixture
def runner() -> Iterator[SolverRunner]:
    with SolverRunner() as runner:
        yield runner


def mischief(folder: Path, what: str, **parameters: str) -> SolverEntry:
    """An entry of a solver that does something wrong."""
    (folder / "mischief_plugin.py").write_text(PLUGIN)
    sys.modules.pop("mischief_plugin", None)
    lines = [f"{key} = '{value}'" for key, value in {"what": what, **parameters}.items()]
    card = folder / f"{what}.toml"
    card.write_text('class = "mischief_plugin:Mischief"\ntime_limit_s = 20\n[parameters]\n' + "\n".join(lines))
    entry = load_solver_entry(card)
    sys.modules.pop("mischief_plugin", None)
    return entry


WRONG = {
    "raise": "raised ValueError: a matrix is singular",
    "tuple": "returned a tuple, not a MotionEstimate",
    "none": "returned a NoneType, not a MotionEstimate",
    "nan": "raised ValueError: w of a motion estimate must be 3 finite numbers, got [nan nan nan]",
    "smuggled_nan": "returned w of a motion estimate must be 3 finite numbers, got [nan nan nan]",
    "covariance": "returned a covariance that is not 6 x 6 finite numbers",
    "reason": "returned reason = 3",
    "sys_exit": "raised SystemExit: 3",
    "os_exit": "ended its process with exit code 1; it last printed: the end is near",
    "crash": "killed by signal 11 (SIGSEGV)",
    "kill": "killed by signal 9 (SIGKILL)",
    "interrupt": "raised KeyboardInterrupt",
    "fork": "ended its process with exit code 7",
}


@pytest.mark.parametrize("what", WRONG)
def test_whatever_goes_wrong_is_a_failure_with_its_reason(
    tmp_path: Path, simulation: Simulation, runner: SolverRunner, what: str
) -> None:
    estimate, _ = runner.bare(mischief(tmp_path, what), simulation.correspondences, RIG, SHUTTER)
    assert not estimate.success and np.all(np.isnan(estimate.w))
    assert estimate.reason == WRONG[what]


@pytest.mark.parametrize("what", ["raise", "tuple", "os_exit"])
def test_inside_ransac_too(tmp_path: Path, simulation: Simulation, runner: SolverRunner, what: str) -> None:
    entry = mischief(tmp_path, what)
    rng = np.random.default_rng(0)
    answer = runner.robust(entry, simulation.correspondences, RIG, SHUTTER, RobustOptions(), rng)
    assert not answer.estimate.success and answer.estimate.reason == WRONG[what]
    assert not answer.inliers["left"].any() and len(answer.inliers["left"]) == 40


def test_a_good_solver_answers_as_it_does_at_home(
    tmp_path: Path, simulation: Simulation, runner: SolverRunner, capfd: pytest.CaptureFixture[str]
) -> None:
    """The built-in eight-point algorithm, called by another package, and run without any child."""
    c = simulation.correspondences
    expected = EightPointSolver().estimate(c, RIG, SHUTTER)
    for what in ("nothing", "print", "read"):
        entry = mischief(tmp_path, what)
        estimate, seconds = runner.bare(entry, c, RIG, SHUTTER)
        assert estimate.success, estimate.reason
        assert estimate.w.tobytes() == expected.w.tobytes() and estimate.d.tobytes() == expected.d.tobytes()
        assert 0.0 <= seconds < 10.0
        robust = runner.robust(entry, c, RIG, SHUTTER, RobustOptions(), np.random.default_rng(4))
        home = estimate_motion(c, RIG, SHUTTER, EightPointSolver(), RobustOptions(), np.random.default_rng(4))
        assert robust.estimate.w.tobytes() == home.estimate.w.tobytes()
        assert robust.iterations == home.iterations and robust.threshold_px == home.threshold_px
        for name, mask in home.inliers.items():
            np.testing.assert_array_equal(robust.inliers[name], mask)
    assert capfd.readouterr() == ("", "")


def test_built_in_solvers_run_here(simulation: Simulation, runner: SolverRunner) -> None:
    estimate, _ = runner.bare(load_solver_entry("gs-8pt"), simulation.correspondences, RIG, SHUTTER)
    assert estimate.success and not runner._workers


@pytest.mark.parametrize("what", ["loop", "hold", "breed"])
def test_a_limit_of_time_ends_it_with_its_children(tmp_path: Path, simulation: Simulation, what: str) -> None:
    note = tmp_path / "pids"
    entry = mischief(tmp_path, what, note=str(note))
    with SolverRunner(time_limit_s=1.0) as runner:
        for _ in range(2):  # a fresh child serves the next call
            estimate, _ = runner.bare(entry, simulation.correspondences, RIG, SHUTTER)
            assert estimate.reason == "took longer than 1 s"
            assert not note.exists() or not alive(note)


def test_a_failure_does_not_touch_the_next_problem(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MISCHIEF_SPARES_FEW", "1")
    c = simulation.correspondences
    few = type(c)(left=c.left[:15])
    entry = mischief(tmp_path, "os_exit")
    with SolverRunner() as runner:
        assert runner.bare(entry, few, RIG, SHUTTER)[0].success
        assert not runner.bare(entry, c, RIG, SHUTTER)[0].success
        assert runner.bare(entry, few, RIG, SHUTTER)[0].success


def alive(note: Path) -> list[int]:
    """Processes of a note that still run; they are given a moment to go."""
    pids = [int(pid) for pid in note.read_text().split()]
    end = time.monotonic() + 3.0
    while (running := [pid for pid in pids if _runs(pid)]) and time.monotonic() < end:
        time.sleep(0.02)
    return running


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


PARENT = """
import sys
from pathlib import Path
import numpy as np
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.solvers.engine.registry import load_solver_entry

rig = StereoRig(camera=PinholeCamera.centred(640, 480, 500.0), baseline=0.2)
points = np.random.default_rng(0).uniform(0, 400, (20, 4))
with SolverRunner() as runner:
    entry = load_solver_entry(sys.argv[1])
    runner.bare(entry, Correspondences(left=points), rig, RollingShutter(height=480, readout_ratio=0.0))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_outlives_its_parent(tmp_path: Path, end: signal.Signals) -> None:
    note = tmp_path / "pids"
    entry = mischief(tmp_path, "breed", note=str(note))
    assert entry.path is not None
    with subprocess.Popen([sys.executable, "-c", PARENT, str(entry.path)], stderr=subprocess.PIPE) as parent:
        deadline = time.monotonic() + 60.0
        while not (note.exists() and len(note.read_text().split()) == 2) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(note.read_text().split()) == 2
        parent.send_signal(end)
        parent.communicate(timeout=5.0)
    assert not alive(note)


def test_our_own_mistakes_stop(simulation: Simulation) -> None:
    with IsolatedWorker(functools.partial, math.sqrt) as worker:
        assert worker.call(4.0, limit_s=20.0).value == 2.0
        with pytest.raises(RuntimeError, match="in a child process"):
            worker.call("four", limit_s=20.0)
        assert worker.call(9.0, limit_s=20.0).value == 3.0


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        2.5,
        "text",
        [1, (2.0, None)],
        {"a": {"b": np.arange(6.0).reshape(2, 3)}, "tree": np.array(["x", "yz"])},
        np.zeros((0, 4)),
    ],
)
def test_plain_data_comes_back(value: Any) -> None:
    np.testing.assert_equal(decode(encode(value), {}), value)


def test_only_known_classes_are_made_and_by_their_constructors() -> None:
    estimate = MotionEstimate(w=np.arange(3.0), d=np.ones(3), success=True, noise_px=0.25)
    again = decode(encode(estimate), {"MotionEstimate": MotionEstimate})
    assert again.w.tobytes() == estimate.w.tobytes() and again.noise_px == 0.25
    with pytest.raises(ValueError, match="KeyError"):
        decode(encode(estimate), {})
    object.__setattr__(estimate, "w", np.full(3, np.nan))
    with pytest.raises(ValueError, match="finite"):
        decode(encode(estimate), {"MotionEstimate": MotionEstimate})
    for damaged in (b"", b"PK", encode(3)[:-30], os.urandom(100)):
        with pytest.raises(ValueError):
            decode(damaged, {})
    with pytest.raises(TypeError, match="plain data"):
        encode(np.array([object()]))
