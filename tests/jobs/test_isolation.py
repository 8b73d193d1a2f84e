"""Other people's code in a child process: each kind of misbehaviour is a failure of its own with its reason."""

from __future__ import annotations

import functools
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from programs import is_running

from rsbench.benchmark.simulated.simulation import Simulation, SimulationOptions, simulate
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.jobs.isolation import IsolatedWorker, decode, encode
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import MotionEstimate, SolverEntry, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.essential_matrix import EightPointSolver

PLUGIN = """
import ctypes, dataclasses, os, signal, subprocess, sys, time

import numpy as np

from rsbench.solvers.engine.base import MotionEstimate, Solver
from rsbench.solvers.engine.base import load_solver


EIGHT_POINT = load_solver("gs-8pt")


class Mischief(Solver):
    spec = EIGHT_POINT.spec

    def __init__(self, acts, note=""):
        self.acts, self.note = acts, note

    def estimate(self, correspondences, rig, shutter):
        good = EIGHT_POINT.estimate(correspondences, rig, shutter)
        act = self.acts[len(correspondences.left) % len(self.acts)]
        return getattr(self, "_" + act)(good)

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
    return simulate(RIG, SHUTTER, motion, SimulationOptions(pairs=60, noise_px=0.1), np.random.default_rng(0))


@pytest.fixture
def runner() -> Iterator[SolverRunner]:
    with SolverRunner() as runner:
        yield runner


def mischief(folder: Path, *acts: str, note: str = "") -> SolverEntry:
    """An entry of a solver that does ``acts[n % len(acts)]`` when it is given n left pairs."""
    module = f"mischief_of_{folder.name}"  # a name of its own: a process keeps the modules that it has imported
    (folder / f"{module}.py").write_text(PLUGIN)
    card = folder / "mischief.toml"
    parameters = f'[parameters]\nacts = {list(acts)}\nnote = "{note}"'
    card.write_text(f'class = "{module}:Mischief"\ntime_limit_s = 60\n{parameters}')
    return load_solver_entry(card)


def first(simulation: Simulation, count: int) -> Correspondences:
    """So many left pairs, which choose the act."""
    return Correspondences(left=simulation.correspondences.left[:count])


WRONG = {
    "nothing": "",
    "raise": "raised ValueError: a matrix is singular",
    "tuple": "returned a tuple, not a MotionEstimate",
    "none": "returned a NoneType, not a MotionEstimate",
    "nan": "raised ValueError: w of a motion estimate must be 3 finite numbers, got [nan, nan, nan]",
    "smuggled_nan": "returned w of a motion estimate must be 3 finite numbers, got [nan, nan, nan]",
    "shape": "raised ValueError: w of a motion estimate must be 3 finite numbers, got",
    "covariance": "returned a covariance that is not 6 x 6 finite numbers",
    "reason": "returned reason = 3",
    "sys_exit": "raised SystemExit: 3",
    "interrupt": "raised KeyboardInterrupt",
    "print": "",
    "read": "",
}
DEADLY = {
    "os_exit": "ended its process with exit code 1; it last printed: the end is near",
    "crash": "killed by signal 11 (SIGSEGV)",
    "kill": "killed by signal 9 (SIGKILL)",
    "fork": "ended its process with exit code 7",
    "close": "closed its connection",
}
SLOW = ("loop", "hold", "breed")


def test_whatever_goes_wrong_is_a_failure_with_its_reason(
    tmp_path: Path, simulation: Simulation, runner: SolverRunner, capfd: pytest.CaptureFixture[str]
) -> None:
    """And what goes right is what the eight-point algorithm, which the plug-in calls, answers here."""
    entry = mischief(tmp_path, *WRONG)
    for k, (act, reason) in enumerate(WRONG.items()):
        given = first(simulation, 3 * len(WRONG) + k)
        estimate, seconds = runner.bare(entry, given, RIG, SHUTTER)
        assert estimate.success == (reason == ""), act
        assert estimate.reason.startswith(reason), act
        if estimate.success:
            expected = EightPointSolver().estimate(given, RIG, SHUTTER)
            assert estimate.reason == expected.reason
            assert estimate.w.tobytes() == expected.w.tobytes() and estimate.d.tobytes() == expected.d.tobytes()
            assert 0.0 <= seconds < 10.0
        else:
            assert np.all(np.isnan(estimate.w)) and np.isnan(seconds)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_a_process_that_ends_is_a_failure_of_that_problem_alone(
    tmp_path: Path, simulation: Simulation, runner: SolverRunner
) -> None:
    acts = ("nothing", *DEADLY)
    entry = mischief(tmp_path, *acts)
    for k, (act, reason) in enumerate(DEADLY.items(), start=1):
        assert runner.bare(entry, first(simulation, 5 * len(acts)), RIG, SHUTTER)[0].success
        estimate, _ = runner.bare(entry, first(simulation, 5 * len(acts) + k), RIG, SHUTTER)
        # A child whose pipe is closed soon ends too: on a busy machine that is seen first.
        reasons = (reason, "ended its process with exit code 1") if act == "close" else (reason,)
        assert not estimate.success and estimate.reason.startswith(reasons), act


@pytest.mark.slow
def test_a_limit_of_time_ends_it_with_its_children(tmp_path: Path, simulation: Simulation) -> None:
    note = tmp_path / "pids"
    entry = mischief(tmp_path, *SLOW, note=str(note))
    with SolverRunner(time_limit_s=0.6) as runner:
        for k in range(len(SLOW)):  # a fresh child serves the next one
            estimate, _ = runner.bare(entry, first(simulation, 10 * len(SLOW) + k), RIG, SHUTTER)
            assert estimate.reason == "took longer than 0.6 s"
    assert len(note.read_text().split()) == 2 and not alive(note)


def test_the_robust_loop_runs_there_as_it_does_here(
    tmp_path: Path, simulation: Simulation, runner: SolverRunner
) -> None:
    c = simulation.correspondences
    there = runner.robust(
        mischief(tmp_path, "nothing"), c, RIG, SHUTTER, RobustOptions(), np.random.default_rng(4)
    )
    here = estimate_motion(c, RIG, SHUTTER, EightPointSolver(), RobustOptions(), np.random.default_rng(4))
    assert there.estimate.w.tobytes() == here.estimate.w.tobytes()
    assert there.iterations == here.iterations and there.threshold_px == here.threshold_px
    assert there.counts == here.counts
    for name, mask in here.inliers.items():
        np.testing.assert_array_equal(there.inliers[name], mask)


def test_what_goes_wrong_inside_the_robust_loop_is_a_failure_too(
    tmp_path: Path, simulation: Simulation, runner: SolverRunner
) -> None:
    """Whether it does so in a minimal sample, of eight pairs, or later."""
    for acts in (("tuple",), ("os_exit", "nothing", *["os_exit"] * 5)):
        entry = mischief(tmp_path, *acts)
        rng = np.random.default_rng(0)
        answer = runner.robust(entry, simulation.correspondences, RIG, SHUTTER, RobustOptions(), rng)
        assert not answer.estimate.success and answer.estimate.reason == (WRONG | DEADLY)[acts[0]]
        assert not answer.inliers["left"].any() and len(answer.inliers["left"]) == 60


def test_built_in_solvers_run_here(simulation: Simulation, runner: SolverRunner) -> None:
    estimate, _ = runner.bare(load_solver_entry("gs-8pt"), simulation.correspondences, RIG, SHUTTER)
    assert estimate.success and not runner._workers


def alive(note: Path) -> list[int]:
    """Processes of a note that still run; they are given a moment to go."""
    pids = [int(pid) for pid in note.read_text().split()]
    end = time.monotonic() + 20.0
    while (running := [pid for pid in pids if is_running(pid)]) and time.monotonic() < end:
        time.sleep(0.02)
    return running


PARENT = """
import sys
from pathlib import Path
import numpy as np
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import load_solver_entry

rig = StereoRig(camera=PinholeCamera.centred(640, 480, 500.0), baseline=0.2)
points = np.random.default_rng(0).uniform(0, 400, (20, 4))
with SolverRunner() as runner:
    entry = load_solver_entry(sys.argv[1])
    runner.bare(entry, Correspondences(left=points), rig, RollingShutter(height=480, readout_ratio=0.0))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
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


def test_threads_get_the_answers_to_their_own_calls() -> None:
    """Both frames of a pair are matched at once, by one worker."""
    numbers = [float(number) for number in range(200)]
    with (
        IsolatedWorker(functools.partial, math.sqrt) as worker,
        ThreadPoolExecutor(8) as pool,
    ):
        answers = list(pool.map(lambda number: worker.call(number, limit_s=20.0).value, numbers))
    assert answers == [math.sqrt(number) for number in numbers]


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
