"""File operations of a process counted, and the k-th of them failing or deadly."""

from __future__ import annotations

import builtins
import functools
import io
import os
import resource
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

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


def read_log(log: Path) -> list[str]:
    """The operations that were counted."""
    return log.read_text("utf-8").splitlines()
