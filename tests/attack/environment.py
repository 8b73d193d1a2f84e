"""Hostile surroundings: the commands, as processes of their own, work or say in one line why not.

No home, one that cannot be written, closed and full streams, plain C text, names of other alphabets, data and
temporary folders that cannot be written, a working folder that is gone.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from attack.arena import Arena, contents
from attack.cases import Tally, commands, differing
from attack.tiny import ROOT

LIMIT_S = 300.0
"""Seconds after which a command hangs; a start on a busy machine takes ten."""
COMMANDS = ("generate", "evaluate", "simulate", "correct", "solve", "verify")
STRANGE = "Ünïcode 数据 with spaces"
_CAPBSET_DROP, _DAC_OVERRIDE = 24, 1
"""Of prctl: without this capability permissions bind root too."""


@dataclass(frozen=True, kw_only=True)
class Surrounding:
    """What differs from a plain start."""

    name: str
    environment: dict[str, str | None] = field(default_factory=dict)
    first: Callable[[], None] | None = None
    """Called in the new process before rsbench starts."""
    folder: str = ""
    """Below work/ and in/: where commands run, and where their data is."""
    locked: tuple[str, ...] = ()
    """Folders of the arena that cannot be written."""
    may_fail: bool = False
    """Whether an error in one line will do."""


def _close(*numbers: int) -> Callable[[], None]:
    def close() -> None:
        for number in numbers:
            os.close(number)

    return close


def _full(number: int) -> Callable[[], None]:
    return lambda: os.dup2(os.open("/dev/full", os.O_WRONLY), number)  # pyrefly: ignore[bad-return]


def _closed_pipe() -> None:
    reader, writer = os.pipe()
    os.dup2(writer, 1)
    os.close(writer)
    os.close(reader)


def _leave_nowhere() -> None:
    os.mkdir("gone")
    os.chdir("gone")
    os.rmdir("../gone")


SURROUNDINGS = (
    Surrounding(name="no HOME", environment={"HOME": None, "XDG_CACHE_HOME": None}),
    Surrounding(name="HOME that is not there", environment={"HOME": "/nonexistent/home"}),
    Surrounding(name="read-only HOME", locked=("home",)),
    Surrounding(name="LC_ALL=C", environment={"LC_ALL": "C", "LANG": None, "PYTHONUTF8": "0"}),
    Surrounding(
        name="LC_ALL=POSIX, strange names",
        environment={"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        folder=STRANGE,
    ),
    Surrounding(name="NO_COLOR, TERM=dumb", environment={"NO_COLOR": "1", "TERM": "dumb"}),
    Surrounding(name="strange names", folder=STRANGE),
    Surrounding(name="stdout closed", first=_close(1)),
    Surrounding(name="stderr closed", first=_close(2)),
    Surrounding(name="all streams closed", first=_close(0, 1, 2)),
    Surrounding(name="stdout full", first=_full(1), may_fail=True),
    Surrounding(name="stderr full", first=_full(2), may_fail=True),
    Surrounding(name="stdout a closed pipe", first=_closed_pipe, may_fail=True),
    Surrounding(name="read-only data", locked=("in",)),
    Surrounding(name="TMPDIR that is not there", environment={"TMPDIR": "/nonexistent/tmp"}),
    Surrounding(name="read-only TMPDIR", locked=("tmp",)),
    Surrounding(name="working folder gone", first=_leave_nowhere, may_fail=True),
    Surrounding(name="work/ read-only", locked=("work",), may_fail=True),
)


def attack(arena: Arena, expected: dict[str, dict[str, str]], pairs: list[tuple[Surrounding, str]]) -> Tally:
    """Run commands in surroundings; ``expected`` holds what each makes elsewhere, by its name."""
    tally = Tally()
    for surrounding, command in pairs:
        arena.clear()
        with _surrounded(arena, surrounding):
            _attempt(arena, surrounding, command, expected.get(command), tally)
    arena.clear()
    return tally


@contextmanager
def _surrounded(arena: Arena, surrounding: Surrounding) -> Iterator[None]:
    for base in (arena.work, arena.inputs) if surrounding.folder else ():
        (base / surrounding.folder).mkdir()
    if surrounding.folder:
        shutil.copytree(arena.inputs / "data", arena.inputs / surrounding.folder / "data")
    folders = [arena.root / name for name in surrounding.locked]
    modes = {path: path.stat().st_mode for folder in folders for path in (folder, *folder.rglob("*"))}
    try:
        for path, mode in modes.items():
            path.chmod(mode & ~(stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH))
        yield
    finally:
        for path, mode in modes.items():
            path.chmod(mode)
        if surrounding.folder:
            shutil.rmtree(arena.inputs / surrounding.folder)


def _attempt(
    arena: Arena, surrounding: Surrounding, command: str, expected: dict[str, str] | None, tally: Tally
) -> None:
    work, data = arena.work / surrounding.folder, arena.inputs / surrounding.folder / "data"
    out, where = work / "out", f"{surrounding.name}: {command}"
    outside = arena.outside(out)
    known = commands(arena.inputs, data, out)
    known |= {"solve": ("solve", ROOT / "examples" / "problem.json", "--json"), "verify": ("verify", data)}
    code, err = _run(arena, surrounding, list(map(str, known[command])), work)
    tally.count("runs")
    tally.count(f"exit code {code}")
    tally.check(code != -9, f"{where}: hung")
    tally.check("Traceback" not in err and "Exception ignored" not in err, f"{where}: traceback: {err[-300:]}")
    if code and surrounding.may_fail:
        lines = [line for line in err.splitlines() if "rsbench: error:" in line]
        silent = not surrounding.locked  # where nobody listens
        tally.check(
            code in (1, 2, 141) and (len(lines) == 1 or silent), f"{where}: exit code {code}: {err[-300:]}"
        )
    else:
        tally.check(code == 0, f"{where}: exit code {code}: {err[-300:]}")
    if code == 0 and expected is not None:
        found = contents(out)
        tally.check(found == expected, f"{where}: makes others: {differing(found, expected)}")
    now = arena.outside(out)
    tally.check(now == outside, f"{where}: outside --out: {differing(now, outside)}")


def _run(arena: Arena, surrounding: Surrounding, arguments: list[str], folder: Path) -> tuple[int, str]:
    def first() -> None:
        if os.geteuid() == 0 and surrounding.locked:
            ctypes.CDLL(None).prctl(_CAPBSET_DROP, _DAC_OVERRIDE, 0, 0, 0)
        if surrounding.first is not None:
            surrounding.first()

    try:
        result = subprocess.run(
            [sys.executable, "-m", "rsbench", "--quiet", *arguments],
            cwd=folder,
            env=arena.environment(surrounding.environment),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=LIMIT_S,
            preexec_fn=first,
        )
    except subprocess.TimeoutExpired as error:
        return -9, (error.stderr or b"").decode("utf-8", errors="replace")
    return result.returncode, result.stderr.decode("utf-8", errors="replace")
