"""Termination of a command by Ctrl-C or SIGTERM, or by an unexpected error.

A signal ends every command within two seconds, with a line on how to continue and exit code 130 or 143. It raises
``Stopped`` in the main thread, so that everything is closed in order. If the main thread is in a computation that
does not return to Python for seconds, a thread that is woken by the same signal ends the process. Child processes
end with it in any case (``rsbench.jobs.isolation``). SIGHUP is left to the system.

For an unexpected error, the user gets one line, and the traceback is written to a log.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import platform
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rsbench.core.version import __version__
from rsbench.storage.work_folder import temporary, user_cache

_PATIENCE_S = 1.0
_SPEECH_S = 0.3
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_RESUMES = "the same command resumes where it stopped"
_ADVICE = {
    "generate": _RESUMES,
    "evaluate": _RESUMES,
    "simulate": _RESUMES,
    "reproduce": _RESUMES,
    "demo": _RESUMES,
    "correct": "--out is as it was before",
    "export": "--out is as it was before",
    "solve": "nothing is kept; what was answered stays answered",
}
"""Text on what the user can do after an interruption, by command."""
_SHOW_CURSOR = "\x1b[?25h"


class Stopped(BaseException):
    """A signal to end was received; it is no ``KeyboardInterrupt``, for which typer prints its own message."""


def end_at_once(number: int, frame: FrameType | None = None) -> NoReturn:
    """End the process on a signal, without closing anything; the handler before a command begins."""
    with contextlib.suppress(OSError):
        os.write(2, f"{_ending()}\n".encode())
    os._exit(128 + number)


@contextmanager
def stoppable() -> Iterator[None]:
    """Run a whole command as the body, in the main thread; a signal ends it in order."""
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    # A signal that is ignored from the start, as in the background of a shell without job control, stays ignored.
    ours = [number for number, handler in before.items() if handler != signal.SIG_IGN]
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        received.append(number)
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_IGN)  # a second signal must not disturb the closing
        raise Stopped

    with _watched():
        try:
            for number in ours:
                signal.signal(number, stop)
            yield
        except BaseException:
            # Interrupted code may raise another error than ``Stopped``, as the import of a module does.
            if not received:
                raise
            _print_ending()
            sys.exit(128 + received[0])
        finally:
            for number in ours:
                signal.signal(number, before[number])


@contextmanager
def _watched() -> Iterator[None]:
    """Run a thread that ends the process when the main thread does not react to a signal."""
    if os.name != "posix":
        yield
        return
    hook, (reader, writer) = sys.unraisablehook, os.pipe()
    os.set_blocking(writer, False)
    done = threading.Event()
    threading.Thread(target=_watch, args=(reader, done), daemon=True).start()
    wakeup = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    # If ``Stopped`` cannot propagate, as in a destructor, the thread ends the process.
    sys.unraisablehook = lambda problem: None if problem.exc_type is Stopped else hook(problem)
    try:
        yield
    finally:
        done.set()
        sys.unraisablehook = hook
        signal.set_wakeup_fd(wakeup)
        os.close(writer)


def _watch(reader: int, done: threading.Event) -> None:
    """End the process ``_PATIENCE_S`` after a signal, unless ``done`` is set before."""
    with open(reader, "rb", buffering=0) as stream:
        while byte := stream.read(1):
            if byte[0] in _SIGNALS and not done.wait(_PATIENCE_S):
                speaker = threading.Thread(target=_print_ending, daemon=True)
                speaker.start()
                speaker.join(_SPEECH_S)  # the reader of stderr may block
                os._exit(128 + byte[0])


def _print_ending() -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # stderr may be closed
        cursor = _SHOW_CURSOR if sys.stderr.isatty() else ""
        sys.stderr.write(f"{cursor}{_ending()}\n")
        sys.stderr.flush()


def _ending() -> str:
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    return "; ".join(filter(None, ("interrupted", _ADVICE.get(command))))


EXIT_CODE = 70
"""EX_SOFTWARE of sysexits.h."""
_KEPT = 20


def describe(error: Exception) -> str:
    """Write the log of an unexpected error, and return one line about the error with the path of the log."""
    words = " ".join(traceback.format_exception_only(error)[-1].split())
    log = _write_log("".join(traceback.format_exception(error)))
    where = f"what led to it: {log}" if log is not None else "no log of it could be written"
    whose = "the system refused" if isinstance(error, OSError) else "a fault of rsbench, not yours"
    return f"{whose}: {words}; {where}"


def _write_log(text: str) -> Path | None:
    """Write a log to the user's cache or a temporary folder, and remove the oldest; None if neither works."""
    now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    system = f"rsbench {__version__}, Python {platform.python_version()}, {platform.platform()}"
    content = f"{now}\n{system}\n{sys.argv}\n\n{text}"
    for base in (user_cache(), temporary()):
        if base is None:
            continue
        folder = base / "faults"
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f"{now[:10]}-", suffix=".log", dir=folder)
            with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace", newline="\n") as file:
                file.write(content)
            for old in sorted(folder.glob("*.log"), key=lambda path: path.stat().st_mtime)[:-_KEPT]:
                old.unlink()
            return Path(name)
    return None
