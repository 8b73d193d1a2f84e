"""``rsbench simulate`` and ``generate`` stopped and killed for real: at once, with nothing left, and resumed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import bytes_below, run_here, sweep_card
from small_scenes import write_box_scene, write_small_card

from rsbench.storage.work_folder import HIDDEN, WORK

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

SLOW = """
import os, time
from rsbench.solvers.engine.base import Solver
from rsbench.solvers.engine.base import load_solver

EIGHT_POINT = load_solver("gs-8pt")

class Slow(Solver):
    spec = EIGHT_POINT.spec

    def estimate(self, correspondences, rig, shutter):
        time.sleep(float(os.environ["RSBENCH_TEST_PAUSE"]))
        return EIGHT_POINT.estimate(correspondences, rig, shutter)
"""
CARD = sweep_card(["gs-8pt", "{slow}"], noise_px=[0.0, 0.5, 1.0], trials=50, name="long")
STOP_S = 6.0
"""Seconds. On a free machine it takes at most 2, of the 3 that are promised; others may keep this one busy."""


class Run:
    """The command, and the processes that belong to it."""

    def __init__(self, what: str, card: Path, out: Path, pause: float = 0.0) -> None:
        self.mark = f"RSBENCH_TEST_MARK={out}-{time.monotonic_ns()}"
        name, _, value = self.mark.partition("=")
        environment = {**os.environ, "RSBENCH_TEST_PAUSE": str(pause), name: value}
        command = [sys.executable, "-m", "rsbench", what, str(card), "--out", str(out), "--workers", "2"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)

    def processes(self) -> set[int]:
        """All that carry the mark."""
        found = set()
        for path in Path("/proc").glob("[0-9]*/environ"):
            try:
                alive = path.with_name("stat").read_text().rpartition(")")[2].split()[0] != "Z"
                if alive and self.mark.encode() in path.read_bytes():
                    found.add(int(path.parent.name))
            except OSError:  # gone meanwhile
                continue
        return found

    def worker(self) -> int:
        """One of its direct children."""
        for pid in self.processes():
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1] == str(self.process.pid):
                return pid
        raise AssertionError("no worker")

    def wait_for(self, folder: Path, count: int, name: str = "trials-*.npz") -> None:
        end = time.monotonic() + 120.0
        while len(list(folder.glob(name))) < count:
            assert self.process.poll() is None and time.monotonic() < end
            time.sleep(0.02)

    def finish(self) -> str:
        """Its standard error."""
        return self.process.communicate(timeout=300.0)[1]


@pytest.mark.slow
def test_stopped_and_a_worker_killed_it_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "slow_plugin.py").write_text(SLOW)
    (tmp_path / "slow.toml").write_text('class = "slow_plugin:Slow"')
    card = tmp_path / "long.toml"
    card.write_text(CARD.format(slow=tmp_path / "slow.toml"))
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    # In this process, and one worker alone: the bytes depend on neither.
    result = run_here("simulate", card, "--out", undisturbed, "--workers", 1, RSBENCH_TEST_PAUSE="0")
    assert result.returncode == 0, result.stderr

    run = Run("simulate", card, out, 0.03)
    run.wait_for(out / HIDDEN / "chunks", 1)
    assert len(run.processes()) == 1 + 2 + 2  # workers, and the solver's own process of each
    os.kill(run.worker(), signal.SIGKILL)
    run.wait_for(out / HIDDEN / "chunks", 3)  # more than the other worker had begun
    stop(run, signal.SIGINT, 130)
    assert not (out / "summary.csv").exists()

    run = Run("simulate", card, out, 0.0)
    errors = run.finish()
    assert run.process.returncode == 0, errors
    of_the_run = ("seconds", "provenance.json")
    assert bytes_below(out, *of_the_run) == bytes_below(undisturbed, *of_the_run)


@pytest.mark.slow
def test_rendering_by_several_processes_ends_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    card = write_small_card(tmp_path, [write_box_scene(tmp_path, name) for name in "abcd"])
    # Large enough for a minute, and larger than the default limit of frames.
    monkeypatch.setenv("RSBENCH_LIMITS", "8")
    card.write_text(card.read_text().replace("width = 96", "width = 3000").replace("height = 64", "height = 3000"))
    run = Run("generate", card, tmp_path / "out")
    run.wait_for(tmp_path / "out" / HIDDEN / WORK, 2, "*")
    stop(run, signal.SIGTERM, 143)
    assert not (tmp_path / "out").exists()


def stop(run: Run, how: signal.Signals, code: int) -> None:
    """It ends at once, says how to go on, and leaves no process."""
    start = time.monotonic()
    run.process.send_signal(how)
    errors = run.finish()
    assert time.monotonic() - start < STOP_S
    assert run.process.returncode == code
    assert "interrupted; the same command resumes" in errors and "Traceback" not in errors
    while run.processes() and time.monotonic() - start < STOP_S:  # children of children see its end a moment later
        time.sleep(0.02)
    assert not run.processes()
