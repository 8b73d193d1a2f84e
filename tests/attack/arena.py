"""Commands in forked children of one warm process, watched from outside: how they ended, and what they left.

A start of rsbench costs seconds, a fork milliseconds. The warm process must have one thread (forks of others may
hang), so nothing is rendered in it: children start the renderer themselves.
"""

from __future__ import annotations

import builtins
import contextlib
import ctypes
import functools
import hashlib
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

GRACE_S = 3.0
"""Seconds in which the children of a process that was stopped or killed must end."""
LIMIT_S = 120.0
"""Seconds after which a command hangs: the longest of them takes ten on a free machine."""
MACHINE = ("seconds.json", "seconds.csv", "provenance.json", "hashes.jsonl")
"""Files that hold times, the date and the machine: the only ones that need not be the same again."""
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of prctl


@dataclass(frozen=True, kw_only=True)
class Ending:
    """What became of a command."""

    code: int
    """Exit code; minus the signal's number for one that a signal ended."""
    out: str
    err: str
    seconds: float
    orphans: int
    """Processes that outlived it."""
    peak_mb: float
    hung: bool

    @property
    def errors(self) -> list[str]:
        """Its lines that tell of errors."""
        return [line for line in self.err.splitlines() if "rsbench: error:" in line]

    @property
    def traceback(self) -> bool:
        return "Traceback" in self.err or "Traceback" in self.out


class Arena:
    """A folder with all that commands may see: home/, tmp/, in/, and work/, where they run and write."""

    def __init__(self, root: Path) -> None:
        self.root = root
        for name in ("home", "tmp", "work"):
            (root / name).mkdir(parents=True, exist_ok=True)
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_SUBREAPER, 1, 0, 0, 0):
            raise OSError(ctypes.get_errno(), "prctl")

    @property
    def inputs(self) -> Path:
        return self.root / "in"

    @property
    def work(self) -> Path:
        return self.root / "work"

    def environment(self, changes: Mapping[str, str | None]) -> dict[str, str]:
        """The variables of this process, with the arena's folders, and some that are changed or (None) absent."""
        own = {"HOME": str(self.root / "home"), "TMPDIR": str(self.root / "tmp"), "COLUMNS": "200"}
        everything = {**os.environ, **own, **changes}
        return {name: value for name, value in everything.items() if value is not None}

    def clear(self) -> None:
        """Empty what commands write."""
        for folder in (self.work, self.root / "tmp"):
            shutil.rmtree(folder)
            folder.mkdir()

    def outside(self, *allowed: Path) -> dict[str, str]:
        """Hashes of all files but those below ``allowed``, the home and the temporary folder."""
        skipped = (*allowed, self.root / "home", self.root / "tmp")
        return {
            str(path.relative_to(self.root)): _digest(path)
            for path in sorted(self.root.rglob("*"))
            if not any(path.is_relative_to(folder) for folder in skipped)
        }

    def run(
        self,
        arguments: Iterable[object],
        *,
        before: Callable[[], None] | None = None,
        stop: tuple[float, signal.Signals] | None = None,
        environment: Mapping[str, str | None] | None = None,
        limit_s: float = LIMIT_S,
    ) -> Ending:
        """Run ``rsbench`` with these arguments in work/; ``before`` is called in its process first.

        ``stop`` sends a signal after so many seconds.
        """
        streams = [self.root / "home" / name for name in (".out", ".err")]
        start = time.monotonic()
        sys.stdout.flush()
        stops = {signal.SIGINT, signal.SIGTERM}
        signal.pthread_sigmask(signal.SIG_BLOCK, stops)  # until the child is the command
        pid = os.fork()
        if pid == 0:
            _become(list(map(str, arguments)), self, streams, before, environment or {})
        signal.pthread_sigmask(signal.SIG_UNBLOCK, stops)
        code, peak_mb, hung = _wait(pid, start, stop, limit_s)
        seconds = time.monotonic() - start
        orphans = _bury()
        out, err = (path.read_text("utf-8", errors="replace") for path in streams)
        return Ending(code=code, out=out, err=err, seconds=seconds, orphans=orphans, peak_mb=peak_mb, hung=hung)


def _become(
    arguments: list[str],
    arena: Arena,
    streams: list[Path],
    before: Callable[[], None] | None,
    environment: Mapping[str, str | None],
) -> None:
    """In the child: be the command, and end."""
    code = 1
    try:
        os.setsid()
        for number, path in enumerate([Path(os.devnull), *streams]):
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(descriptor, number)
            os.close(descriptor)
        os.chdir(arena.work)
        variables = arena.environment(environment)
        os.environ.clear()
        os.environ.update(variables)
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # as ``main`` sets it at once
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
        code = command(arguments, before)
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:  # as the interpreter tells it
        with contextlib.suppress(BaseException):
            traceback.print_exc()
            sys.stderr.flush()
    finally:
        os._exit(code)


def command(arguments: list[str], before: Callable[[], None] | None) -> int:
    import tempfile

    from rsbench.__main__ import main
    from rsbench.cli import console

    tempfile.tempdir = None  # as in a new process
    console.be_quiet(False)
    sys.argv = ["rsbench", *arguments]
    if before is not None:
        before()
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def _wait(
    pid: int, start: float, stop: tuple[float, signal.Signals] | None, limit_s: float
) -> tuple[int, float, bool]:
    """Exit code, peak memory in MB, and whether it hung, even after the signal."""
    pause, end, hung = 0.002, start + limit_s, False
    while True:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), usage.ru_maxrss / 1024, hung
        now = time.monotonic()
        if stop is not None and now - start >= stop[0]:
            os.kill(pid, stop[1])
            stop, end = None, min(end, now + 20.0)
        if now > end:
            hung = True
            os.kill(pid, signal.SIGKILL)
        time.sleep(pause)


def _bury() -> int:
    """Wait for what the command left running, which is ours now; how many of them outlived the grace."""
    end = time.monotonic() + GRACE_S
    survivors: set[int] = set()
    while True:
        try:
            found, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return len(survivors)
        if not found:
            if time.monotonic() > end:
                survivors |= (alive := {pid for pid, parent in parents().items() if parent == os.getpid()})
                kill(alive)
            time.sleep(0.002)


def parents() -> dict[int, int]:
    """The parent of each process."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, IndexError):
            found[int(path.parent.name)] = int(path.read_text(errors="replace").rpartition(")")[2].split()[1])
    return found


def kill(pids: Iterable[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _digest(path: Path) -> str:
    if path.is_symlink():
        return f"link {os.readlink(path)}"
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"


def contents(folder: Path) -> dict[str, str]:
    """Hashes of all files of a result, hidden ones too.

    Left out are ``MACHINE``, the lock, seconds/ of sweeps, what motion.json and its page say of seconds, and the
    command on a page, which names ``--out``.
    """
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.name in MACHINE or name == ".rsbench/lock" or path.parent.name == "seconds" or not path.is_file():
            continue
        found[name] = _digest(path)
        if path.name == "motion.json":
            record = json.loads(path.read_text("utf-8"))
            record.pop("seconds", None)
            found[name] = json.dumps(record)
        elif path.name == "report.html":
            page = re.sub(r"&#34;(seconds&#34;: {[^}]*}|command&#34;: .*)", "", path.read_text("utf-8"))
            found[name] = hashlib.sha256(page.encode()).hexdigest()
    return found


OPERATIONS = (
    "replace",
    "rename",
    "mkdir",
    "unlink",
    "remove",
    "rmdir",
    "fsync",
    "link",
    "truncate",
    "scandir",
    "listdir",
)
"""Functions of ``os`` that count, beside opening a file by ``open``, ``io.open`` and ``os.open``."""
How = Literal["before", "after"]


@dataclass(frozen=True, kw_only=True)
class Trap:
    """What happens at operation ``number``, counted from 1; nothing for 0."""

    number: int = 0
    error: int | None = None
    """Number of the error that it raises; None: the process dies."""
    how: How = "before"
    """Whether the process dies before or after the operation."""


def set_trap(folders: Sequence[Path], log: Path, trap: Trap) -> None:
    """From now on, in this process, append each operation below ``folders`` to ``log``, and spring the trap."""
    watched = tuple(f"{folder}{os.sep}" for folder in folders)
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
    count = 0

    def wrap(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def wrapped(*arguments: Any, **options: Any) -> Any:
            nonlocal count
            path = _path_of(arguments, options)
            if path is None or not f"{path}{os.sep}".startswith(watched):
                return function(*arguments, **options)
            count += 1
            os.write(handle, f"{name} {path}\n".encode())
            if count != trap.number:
                return function(*arguments, **options)
            if trap.error is not None:
                raise OSError(trap.error, os.strerror(trap.error), path)
            if trap.how == "after":
                function(*arguments, **options)
            os.kill(os.getpid(), signal.SIGKILL)

        return wrapped

    opened = wrap("open", io.open)
    for module, name in ((builtins, "open"), (io, "open")):
        setattr(module, name, opened)
    os.open = wrap("os.open", os.open)
    for name in OPERATIONS:
        setattr(os, name, wrap(name, getattr(os, name)))


def _path_of(arguments: tuple[Any, ...], options: dict[str, Any]) -> str | None:
    """Absolute path that an operation is about; of a renaming, the old name."""
    place = arguments[0] if arguments else options.get("path", options.get("file", "."))
    if isinstance(place, int):
        try:
            return os.readlink(f"/proc/self/fd/{place}")
        except OSError:
            return None
    folder = options.get("dir_fd")
    base = os.readlink(f"/proc/self/fd/{folder}") if isinstance(folder, int) else os.getcwd()
    return os.path.abspath(os.path.join(base, os.fsdecode(place)))


def limit_files(size: int, deadly: bool) -> None:
    """From now on no file of this process grows above ``size`` bytes: it dies as it writes, or the write fails."""
    if deadly:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
