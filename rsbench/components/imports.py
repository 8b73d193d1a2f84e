"""Classes by ``package.module:Class``, installed or beside a card; what others' code raises becomes one line."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from rsbench.components.identity import file_hash, with_neighbours
from rsbench.core.errors import RsbenchError

IMPORT_LIMIT = "RSBENCH_IMPORT_LIMIT_S"
"""Variable of the environment: seconds in which another package's module must be imported."""
_LIMIT_S = 60.0
_POSIX = os.name == "posix"
_IMPORTED = 173
"""Exit code of a process in which a module was tried, that no module is likely to choose."""
_COMMAND = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from rsbench.components.imports import import_and_end; "
    "import_and_end(sys.argv[2], float(sys.argv[3]), int(sys.argv[4]))"
)
_expendable = False
_beside_cards: dict[str, tuple[Path, str]] = {}
"""Modules that were imported from beside a card: file, and its hash when it was imported."""
_threads: list[threading.Thread] = []
"""Those that others' code started."""
_folders: list[str] = []
"""Folders of cards on ``sys.path``, the last used first."""


@contextlib.contextmanager
def blaming(where: str, what: str) -> Iterator[None]:
    """What others' code raises becomes one line with its name; what it prints stays out of answers on stdout.

    Threads that it starts do not keep the command from ending, see ``abandoned_threads``.
    """
    before = set(threading.enumerate())
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except RecursionError:  # whoever closed the circle says so
        raise
    except (Exception, SystemExit) as error:
        text = str(error).partition("\n")[0] if isinstance(error, RsbenchError) else in_words(error)
        raise RsbenchError(f"{where}: {what}: {text}") from error
    finally:
        _threads.extend(each for each in threading.enumerate() if each not in before and not each.daemon)


def in_words(error: BaseException) -> str:
    """Type and text of an error, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def import_target(target: str, folder: Path | None, where: str) -> object:
    """What ``package.module:Class`` names; modules in a folder are found too."""
    module, _, name = target.partition(":")
    if not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RsbenchError(f"{where}: must be 'package.module:Class'")
    with blaming(where, "cannot be imported"):
        if folder is None or module.partition(".")[0] == "rsbench":
            try_import(module)
            return getattr(importlib.import_module(module), name)
        return getattr(_import_beside(module, folder.resolve()), name)


def abandoned_threads() -> bool:
    """Whether threads run that others' code started, and for which Python would wait at its end."""
    return any(thread.is_alive() for thread in _threads)


def try_import(module: str, version: str = "") -> None:
    """Import another package's module in a process of its own first, so that it cannot end or stop this one.

    What it raises there is left to the import here. Each version of a module is tried once, and none that is
    rsbench's own, or imported already.

    Raises:
        ImportError: what became of the process.
    """
    if _expendable or module.partition(".")[0] == "rsbench" or module in sys.modules:
        return
    if fate := _fate(module, version):
        raise ImportError(f"importing {module} {fate}")


@functools.cache
def _fate(module: str, version: str) -> str:
    limit_s, path = _import_limit(), json.dumps([str(entry) for entry in sys.path])
    with lifeline() as line:
        process = subprocess.Popen(
            [sys.executable, "-c", _COMMAND, path, module, str(limit_s), str(line)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # its own process group
            pass_fds=(line,) if _POSIX else (),
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return f"took longer than {limit_s:g} s ({IMPORT_LIMIT} allows more)"
        finally:
            if _POSIX:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
    return "" if code == _IMPORTED else ending(code)


def _import_limit() -> float:
    text = os.environ.get(IMPORT_LIMIT, "")
    with contextlib.suppress(ValueError):
        if math.isfinite(limit_s := float(text or _LIMIT_S)) and limit_s > 0.0:
            return limit_s
    raise RsbenchError(f"{IMPORT_LIMIT} = {text!r}: must be a positive number of seconds")


def import_and_end(module: str, limit_s: float, line: int) -> NoReturn:
    """In a process of its own: import a module, and say by the exit code that this came to an end."""
    if _POSIX:
        signal.alarm(math.ceil(limit_s) + 1)  # should the parent be gone by then, where ``end_with`` does nothing
        end_with(line)
    with contextlib.suppress(BaseException):
        importlib.import_module(module)
    os._exit(_IMPORTED)


@contextlib.contextmanager
def lifeline() -> Iterator[int]:
    """A descriptor for a child to inherit and to give to ``end_with``; -1 where there are none."""
    if not _POSIX:
        yield -1
        return
    reader, writer = os.pipe()
    try:
        yield reader
    finally:
        os.close(reader)
        os.close(writer)


def end_with(line: int) -> None:
    """In a child that leads its group: let Linux kill the group when the parent is gone.

    Even while code that holds Python's lock loops, and whatever the parent's end was: the other end of the pipe is
    closed then.
    """
    if sys.platform == "linux":
        import fcntl
        import select

        with contextlib.suppress(OSError):
            fcntl.fcntl(line, fcntl.F_SETOWN, -os.getpgrp())
            fcntl.fcntl(line, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(line, fcntl.F_SETFL, fcntl.fcntl(line, fcntl.F_GETFL) | os.O_ASYNC)
            if select.select([line], [], [], 0.0)[0]:  # it was gone before
                os.killpg(os.getpgrp(), signal.SIGKILL)


def import_untried() -> None:
    """From now on nothing is tried first: this process is one that others' code may end."""
    global _expendable
    _expendable = True


def ending(code: int) -> str:
    """How a process ended, by its exit code."""
    if code >= 0:
        return f"ended its process with exit code {code}"
    try:
        return f"killed by signal {-code} ({signal.Signals(-code).name})"
    except ValueError:
        return f"killed by signal {-code}"


def search(card: Path) -> None:
    """Find modules beside a card too, in child processes as well, whatever in it names them."""
    _put_on_path(str(card.parent.resolve()))


def _import_beside(module: str, folder: Path) -> object:
    """Import a module that is installed or lies in a folder.

    The folder stays on the path, after everything that is installed, for what is imported later, in child
    processes too. A module that changed since it was imported is imported anew.
    """
    _put_on_path(str(folder))
    _forget_changed(folder)
    importlib.invalidate_caches()
    first = folder / module.partition(".")[0]
    beside = next((path for path in (first.with_suffix(".py"), first / "__init__.py") if path.is_file()), None)
    if beside is not None:
        _refuse_other(first.name, beside)
    try_import(module, "".join(file_hash(file) for file in with_neighbours(beside)) if beside is not None else "")
    before = set(sys.modules)
    found = importlib.import_module(module)
    for name in set(sys.modules) - before:
        file = _file_of(name)
        if file is not None and file.is_relative_to(folder):
            _beside_cards[name] = file, file_hash(file)
    for file in with_neighbours(beside) if beside is not None else ():
        if file.parent == folder and file.stem in sys.modules:
            _refuse_other(file.stem, file)
    return found


def _put_on_path(folder: str) -> None:
    """At the end of the path, before the folders of other cards."""
    if folder in sys.path and folder not in _folders:
        return
    if folder in _folders:
        _folders.remove(folder)
    sys.path[:] = [entry for entry in sys.path if entry not in (folder, *_folders)] + [folder, *_folders]
    _folders.insert(0, folder)


def _forget_changed(folder: Path) -> None:
    """Drop the modules of a folder when the file of one of them changed."""
    mine = {name: file for name, (file, _) in _beside_cards.items() if file.is_relative_to(folder)}
    if any(not file.is_file() or file_hash(file) != _beside_cards[name][1] for name, file in mine.items()):
        for name in mine:
            del _beside_cards[name]
            sys.modules.pop(name, None)


def _refuse_other(name: str, beside: Path) -> None:
    """A module beside a card must not be taken for one of the same name from elsewhere."""
    if name in sys.modules:
        other = _file_of(name)
    else:
        spec = importlib.util.find_spec(name)
        other = Path(spec.origin).resolve() if spec is not None and spec.has_location and spec.origin else None
    if other is not None and other != beside.resolve():
        raise ImportError(f"module {name!r} is taken by {other}: rename the one beside the card")


def _file_of(module: str) -> Path | None:
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).resolve() if file else None


@contextlib.contextmanager
def signals_later() -> Iterator[None]:
    """Let handlers of Ctrl-C and SIGTERM run after the block.

    Native code may crash when they raise while it is imported, as Mitsuba now and then did.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread alone
        return
    came = list[int]()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    held = {number: handler for number, handler in before.items() if callable(handler)}
    for number in held:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)
