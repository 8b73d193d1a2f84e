"""Unexpected errors: one line for the user, and the traceback in a log."""

from __future__ import annotations

import contextlib
import datetime
import os
import platform
import sys
import tempfile
import traceback
from pathlib import Path

from rsbench.core.version import __version__
from rsbench.storage.caches import temporary, user_cache

EXIT_CODE = 70
"""EX_SOFTWARE of sysexits.h."""
_KEPT = 20


def describe(error: Exception) -> str:
    """One line about an error that is not the user's, with the log that tells more."""
    words = " ".join(traceback.format_exception_only(error)[-1].split())
    log = _write_log("".join(traceback.format_exception(error)))
    where = f"what led to it: {log}" if log is not None else "no log of it could be written"
    whose = "the system refused" if isinstance(error, OSError) else "a fault of rsbench, not yours"
    return f"{whose}: {words}; {where}"


def _write_log(text: str) -> Path | None:
    """Where the user may write, never in the current folder; the oldest logs go."""
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
