"""Private folders of rsbench: the user's cache, temporary folders, and the hidden folder in a folder of results.

``.rsbench/lock`` is locked while a command works in a folder of results, and records its process and host.
Results are written to ``.rsbench/work`` and renamed when complete. Everything in the hidden folder belongs to
rsbench, and only there does rsbench remove whole folders: folders elsewhere are moved there first, after a check
that rsbench wrote every file in them.

The system frees the lock when its process ends, however it ends. If the file system has no locks, or none across
hosts, the owner's record is valid for ``_DEAD_S`` after it was last renewed.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from rsbench.core.errors import RsbenchError


def user_cache() -> Path | None:
    """The user's cache folder for rsbench, which may not exist yet; None without a home folder."""
    home = os.path.expanduser("~")
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "rsbench"
    if sys.platform == "win32" and os.environ.get("LOCALAPPDATA"):
        return Path(os.environ["LOCALAPPDATA"]) / "rsbench"
    if not os.path.isabs(home):  # no HOME, and the user is unknown
        return None
    return Path(home, "Library/Caches" if sys.platform == "darwin" else ".cache") / "rsbench"


def temporary() -> Path | None:
    """Return a temporary folder that only this user can write, because compiled code is loaded from it."""
    try:
        if sys.platform == "win32":
            return Path(tempfile.gettempdir()) / "rsbench"
        folder = Path(tempfile.gettempdir()) / f"rsbench-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return folder
        return Path(tempfile.mkdtemp(prefix="rsbench-"))
    except OSError:
        return None


def cpu_key() -> str:
    """Return a key of the CPU model, because different machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        known = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:
        known = [platform.processor()]
    return hashlib.sha256("\n".join([platform.machine(), *known]).encode()).hexdigest()[:16]


HIDDEN = ".rsbench"
"""Name of the hidden folder; it may be deleted when no command runs."""
WORK = "work"
"""Name of the folder in it for incomplete results; empty at the start of each command."""
LOCK = "lock"
"""Name of the locked file in it; a folder without it was not made by rsbench."""
_BEAT_S = 15.0
_TRIES = 100
_DEAD_S = 90.0
"""Age of the owner's record, s, above which its process counts as ended; NFS may delay changes by 60 s."""


@contextmanager
def work_folder(out: Path, hidden: Path | None = None) -> Iterator[Path]:
    """Lock ``out`` for this command; yields the hidden folder, with an empty folder ``WORK`` in it.

    Args:
        out: folder of the results, made if missing when the hidden folder lies in it.
        hidden: ``out/.rsbench`` when None.

    Raises:
        RsbenchError: another command works there, or the folder cannot be written.
    """
    refuse_url(out)
    hidden = out / HIDDEN if hidden is None else hidden
    fresh = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    descriptor = _take(out, hidden)
    done = threading.Event()
    threading.Thread(target=_beat, args=(hidden / LOCK, done), daemon=True).start()
    try:
        remove(hidden / WORK)
        (hidden / WORK).mkdir()
        yield hidden
    finally:
        done.set()
        _leave(hidden, descriptor, fresh)


def refuse_url(out: Path) -> None:
    """Raise RsbenchError if a path is a converted URL."""
    if re.match(r"[a-z][a-z0-9+.-]+:/", out.as_posix()):
        url = out.as_posix().replace(":/", "://", 1)
        raise RsbenchError(f"{url}: is a URL, which this command does not take there; give a folder")


def remove(path: Path) -> None:
    """Remove a file or folder in a hidden folder, if it exists; a link is removed, not followed."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)


def unknown_files(folder: Path, ours: Callable[[str], bool]) -> list[str]:
    """Return the relative paths below a folder that are not regular files of rsbench, sorted, with slashes.

    A link is always unknown; an empty folder is not listed.
    """
    found: list[str] = []
    for place, folders, files in os.walk(folder, onerror=_raise):
        here = Path(place).relative_to(folder)
        links = [name for name in folders if (Path(place) / name).is_symlink()]
        for name in [*files, *links]:
            path = (here / name).as_posix()
            if not ours(path) or not stat.S_ISREG((folder / path).lstat().st_mode):
                found.append(path)
    return sorted(found)


def listed(folder: Path, suffix: str = "") -> list[Path]:
    """Return the content of a folder with this suffix, sorted; empty if the folder is missing.

    Raises:
        OSError: the folder cannot be listed, which ``Path.glob`` would ignore.
    """
    try:
        return sorted(path for path in folder.iterdir() if path.name.endswith(suffix))
    except FileNotFoundError:
        return []


def files_below(folder: Path) -> list[str]:
    """Return the relative paths of all files below a folder, with slashes, sorted.

    Raises:
        OSError: a folder cannot be listed, which ``Path.rglob`` would ignore.
    """
    walked = os.walk(folder, onerror=_raise)
    paths = [Path(place, name).relative_to(folder).as_posix() for place, _, names in walked for name in names]
    return sorted(paths)


def _raise(error: OSError) -> NoReturn:
    raise error


def named(paths: list[str], most: int = 3) -> str:
    """Format the first paths as text, with the number of the others."""
    more = f" and {len(paths) - most} more" if len(paths) > most else ""
    return ", ".join(paths[:most]) + more


def _take(out: Path, hidden: Path) -> int:
    """Lock the file and return its descriptor."""
    for tries in range(_TRIES, 0, -1):
        try:
            hidden.mkdir(parents=True, exist_ok=True)
            _refuse_foreign(hidden)
            flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
            descriptor = os.open(hidden / LOCK, flags, 0o644)
        except OSError as error:
            gone = isinstance(error, FileNotFoundError | FileExistsError) and not hidden.is_file()
            if gone and tries > 1:  # its last owner has just removed it
                continue
            raise RsbenchError(f"{out}: cannot be written: {error.strerror}; choose another folder") from error
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise RsbenchError(f"{hidden / LOCK}: is not a regular file; remove it")
            _claim(out, descriptor)
            if _is_at(hidden / LOCK, descriptor):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    raise RsbenchError(f"{out}: other commands keep locking it; choose another folder")


def _refuse_foreign(hidden: Path) -> None:
    names = {path.name for path in hidden.iterdir()}
    if hidden.is_symlink() or (names and LOCK not in names):
        raise RsbenchError(f"{hidden}: is not a folder that rsbench made; move it away or choose another folder")


def _claim(out: Path, descriptor: int) -> None:
    """Lock the open file and write the owner's record."""
    locked = _lock(descriptor)
    owner, age = _owner(descriptor), time.time() - os.fstat(descriptor).st_mtime
    other_host = owner.get("host", platform.node()) != platform.node()
    if locked is False or (owner and age < _DEAD_S and (locked is None or other_host)):
        seen = "" if locked is False else f", seen there {max(age, 0.0):.0f} s ago"
        who = f"process {owner.get('pid', '?')} on {owner.get('host', 'this machine')}"
        raise RsbenchError(
            f"{out}: {who} is at work there since {owner.get('since', 'just now')}{seen} "
            f"({owner.get('command', 'rsbench')}); wait for it, or choose another folder"
        )
    record = {
        "pid": os.getpid(),
        "host": platform.node(),
        "since": time.strftime("%Y-%m-%d %H:%M:%S %z"),
        "command": " ".join([Path(sys.argv[0]).name.replace("__main__.py", "rsbench"), *sys.argv[1:]])[:200],
    }
    os.ftruncate(descriptor, 0)
    os.lseek(descriptor, 0, os.SEEK_SET)
    os.write(descriptor, json.dumps(record).encode())


def _lock(descriptor: int) -> bool | None:
    """Lock the file until its descriptor is closed; returns whether that succeeded, None without locks."""
    if sys.platform == "win32":
        return None
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _owner(descriptor: int) -> dict[str, Any]:
    """The owner's record; empty when the owner has finished or has not written yet."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    try:
        content = json.loads(os.read(descriptor, 4096))
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _is_at(path: Path, descriptor: int) -> bool:
    """Whether the open file still has this path."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _beat(lock: Path, done: threading.Event) -> None:
    while not done.wait(_BEAT_S):
        with contextlib.suppress(OSError):
            os.utime(lock)


def _leave(hidden: Path, descriptor: int, fresh: list[Path]) -> None:
    """Free the lock; remove the hidden folder if it has nothing for a later run, and then empty ``fresh`` folders,
    the innermost first."""
    with contextlib.suppress(OSError):
        remove(hidden / WORK)
        os.ftruncate(descriptor, 0)
        if [path.name for path in hidden.iterdir()] == [LOCK]:
            (hidden / LOCK).unlink()
            hidden.rmdir()
        for folder in fresh:
            folder.rmdir()
    os.close(descriptor)
