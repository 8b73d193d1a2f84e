"""Deaths among many processes: a command, or any process that works for it here or on a cluster, is killed.

Commands run as users run them, with two workers. A run that loses a process other than its first goes on, and
makes what an undisturbed one makes, byte for byte; one that was killed leaves no process, and the same command, at
once, does that. On a cluster a machine is its nanny, its worker and the worker's children; one that is gone
altogether is started again before the next run.
"""

from __future__ import annotations

import contextlib
import ctypes
import signal
import subprocess
import sys
import time
import tomllib
import uuid
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from attack.arena import GRACE_S, LIMIT_S, Arena, contents, kill, parents
from attack.cases import Tally, differing, place
from attack.tiny import SWEEP, to_toml

MOST = 2
"""Kills of one run among those who work for it: a job that dies three times is given up, as it should be."""
SEQUENCES = 6
_MARK = "RSBENCH_ATTACK"
_PARENT_DEATH = 1  # PR_SET_PDEATHSIG of prctl


@dataclass(frozen=True, kw_only=True)
class Run:
    """A command at work, known by a mark in the environment of all that it starts."""

    process: subprocess.Popen[str]
    mark: str
    errors: Path

    def alive(self) -> list[int]:
        """Its processes, itself too."""
        return [pid for pid in parents() if self.mark in _read(pid, "environ")]


@dataclass(kw_only=True)
class Cluster:
    """A scheduler and two machines of one worker each, on this machine."""

    folder: Path
    machines: list[subprocess.Popen[bytes]] = field(default_factory=list)
    scheduler: subprocess.Popen[bytes] | None = None

    @property
    def file(self) -> Path:
        return self.folder / "scheduler.json"

    def mend(self) -> None:
        """Start what is not there."""
        if self.scheduler is None:
            self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
            while not self.file.exists():
                time.sleep(0.05)
        self.machines = [machine for machine in self.machines if machine.poll() is None]
        while len(self.machines) < 2:
            self.machines.append(self._start("worker", "--nthreads", "1", "--no-dashboard"))

    def members(self) -> list[int]:
        """All processes of the machines."""
        return [pid for machine in self.machines for pid in _tree(machine.pid)]

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(self.file)]
        with (self.folder / f"{arguments[0]}.log").open("ab") as log:
            return subprocess.Popen(
                command,
                stdout=log,
                stderr=log,
                cwd=self.folder,
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )

    def close(self) -> None:
        started = [*self.machines, *([self.scheduler] if self.scheduler else [])]
        kill([pid for process in started for pid in _tree(process.pid)])
        for process in started:
            process.wait()


def attack(arena: Arena, rng: np.random.Generator, count: int, on_cluster: bool) -> Tally:
    """Kill ``count`` processes of runs of ``generate``, ``simulate`` and ``evaluate``, in turn."""
    tally, kills, turn = Tally(), 0, 0
    with ExitStack() as stack:
        cluster = Cluster(folder=arena.root / "home") if on_cluster else None
        if cluster is not None:
            stack.callback(cluster.close)
        known = [(name, arguments, *_undisturbed(arena, arguments, cluster)) for name, arguments in _cases(arena)]
        while kills < count:
            name, arguments, expected, seconds = known[turn % len(known)]
            turn += 1
            place(arena)
            deaths = _killed_until_done(arena, arguments, cluster, rng, seconds, tally, min(MOST, count - kills))
            kills += len(deaths)
            found = contents(arena.work / "out")
            where = f"{name}, after {'; '.join(deaths) or 'nothing'}"
            tally.check(found == expected, f"{where}: differs in {differing(found, expected)}")
    tally.count("kills", kills)
    return tally


def _cases(arena: Arena) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Commands of several jobs that write to work/out."""
    card = tomllib.loads((arena.inputs / "tiny.toml").read_text("utf-8"))
    first = card["sequence"][0]
    card["sequence"] = [{**first, "name": f"number-{k}"} for k in range(SEQUENCES)]
    (arena.inputs / "crew.toml").write_text(to_toml(card), "utf-8")
    sweep: dict[str, Any] = {**SWEEP, "trials": 60}
    (arena.inputs / "crew-sweep.toml").write_text(to_toml(sweep), "utf-8")
    yield "generate", ("generate", arena.inputs / "crew.toml", "--out", "out")
    yield "simulate", ("simulate", arena.inputs / "crew-sweep.toml", "--out", "out")
    yield "evaluate", ("evaluate", arena.inputs / "data", "--out", "out", "--solver", "gs-8pt")


def _undisturbed(
    arena: Arena, arguments: tuple[object, ...], cluster: Cluster | None
) -> tuple[dict[str, str], float]:
    """What a command makes with one worker, and the seconds that it takes with two.

    Raises:
        RuntimeError: it fails, or the two differ.
    """
    results = []
    for how in (("--workers", 1), _crew(cluster)):
        place(arena)
        start = time.monotonic()
        run = _start(arena, (*arguments, *how))
        if run.process.wait():
            raise RuntimeError(f"{arguments[0]} undisturbed: {run.errors.read_text('utf-8')[-2000:]}")
        results.append((contents(arena.work / "out"), time.monotonic() - start))
    if results[0][0] != results[1][0]:
        raise RuntimeError(f"{arguments[0]}: two runs differ in {differing(results[0][0], results[1][0])}")
    return results[1]


def _crew(cluster: Cluster | None) -> tuple[object, ...]:
    if cluster is None:
        return ("--workers", 2)
    cluster.mend()
    return ("--scheduler", cluster.file)


def _start(arena: Arena, arguments: tuple[object, ...]) -> Run:
    mark, errors = f"{_MARK}={uuid.uuid4().hex}", arena.root / "home" / ".err"
    environment = arena.environment({_MARK: mark.partition("=")[2]})
    command = [sys.executable, "-m", "rsbench", "--quiet", *map(str, arguments)]
    with errors.open("w") as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=log, cwd=arena.work, env=environment, start_new_session=True, text=True
        )
    return Run(process=process, mark=mark, errors=errors)


def _killed_until_done(
    arena: Arena,
    arguments: tuple[object, ...],
    cluster: Cluster | None,
    rng: np.random.Generator,
    seconds: float,
    tally: Tally,
    most: int,
) -> list[str]:
    """Run a command, again after each death of its own, until it is done; in words, who was killed and when."""
    deaths = list[str]()
    while True:
        run = _start(arena, (*arguments, *_crew(cluster)))
        moments = sorted(rng.uniform(0.0, seconds, most - len(deaths)))
        code = _disturbed(run, moments, cluster, rng, deaths, tally)
        where = f"{arguments[0]}, after {'; '.join(deaths) or 'nothing'}"
        if code == -signal.SIGKILL:
            time.sleep(0.0 if rng.random() < 0.5 else GRACE_S)  # at once, or when all must have ended
            continue
        _check_end(run, code, where, tally)
        return deaths


def _disturbed(
    run: Run,
    moments: list[float],
    cluster: Cluster | None,
    rng: np.random.Generator,
    deaths: list[str],
    tally: Tally,
) -> int:
    """Kill somebody at each moment until the run ends; its exit code."""
    start = time.monotonic()
    for moment in moments:
        with contextlib.suppress(subprocess.TimeoutExpired):
            run.process.wait(max(moment - (time.monotonic() - start), 0.0))
        if run.process.poll() is not None:
            tally.count("came too late")
            break
        pid = _drawn(run, cluster, rng)
        who = _name(pid, run, cluster)
        kill([pid])
        deaths.append(f"{who} at {moment:.2f} s")
        tally.count(who)
        if pid == run.process.pid:
            break
    try:
        code = run.process.wait(LIMIT_S)
    except subprocess.TimeoutExpired:
        tally.check(False, f"hung after {'; '.join(deaths)}")
        kill(run.alive())
        return run.process.wait()
    if deaths:
        late = time.monotonic() + GRACE_S
        while (left := run.alive()) and time.monotonic() < late:
            time.sleep(0.05)
        tally.check(not left, f"after {'; '.join(deaths)}: {len(left)} processes left")
    return code


def _drawn(run: Run, cluster: Cluster | None, rng: np.random.Generator) -> int:
    """The command itself once in three times, else one of those who work for it."""
    others = [pid for pid in run.alive() if pid != run.process.pid] + (cluster.members() if cluster else [])
    if not others or rng.random() < 1.0 / 3.0:
        return run.process.pid
    return int(rng.choice(others))


def _name(pid: int, run: Run, cluster: Cluster | None) -> str:
    if pid == run.process.pid:
        return "the command"
    if cluster is None:
        return "a child"
    if pid in (machine.pid for machine in cluster.machines):
        return "a machine's nanny"
    return "a child on a machine" if "serve_parent" in _read(pid, "cmdline") else "a machine's worker"


def _check_end(run: Run, code: int, where: str, tally: Tally) -> None:
    tally.count("runs done")
    printed = run.errors.read_text("utf-8", errors="replace")
    tally.check(code == 0, f"{where}: exit code {code}, {printed[-300:]}")
    tally.check("Traceback" not in printed, f"{where}: traceback: {printed[-300:]}")


def _tree(pid: int) -> list[int]:
    """A process and all below it."""
    found, known = [pid], parents()
    for member in found:
        found += [other for other, parent in known.items() if parent == member]
    return found


def _end_with_parent() -> None:
    """In a child: no cluster outlives an attack that is killed."""
    ctypes.CDLL(None).prctl(_PARENT_DEATH, signal.SIGKILL)


def _read(pid: int, name: str) -> str:
    """A file of a process, which may be gone."""
    try:
        return Path(f"/proc/{pid}/{name}").read_text(errors="replace")
    except OSError:
        return ""
