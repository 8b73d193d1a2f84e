"""Folders of this user where rsbench may keep what it can make again, and what went wrong."""

from __future__ import annotations

import hashlib
import os
import platform
import stat
import sys
import tempfile
from pathlib import Path


def user_cache() -> Path | None:
    """The user's cache folder for rsbench, which need not exist; None without a home folder."""
    home = os.path.expanduser("~")
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "rsbench"
    if sys.platform == "win32" and os.environ.get("LOCALAPPDATA"):
        return Path(os.environ["LOCALAPPDATA"]) / "rsbench"
    if not os.path.isabs(home):  # no HOME, and no entry of this user
        return None
    return Path(home, "Library/Caches" if sys.platform == "darwin" else ".cache") / "rsbench"


def temporary() -> Path | None:
    """A folder that only this user can write: whoever writes there decides what is run."""
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
    """Names the CPU model: a home folder is often shared by machines that differ."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        known = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    except OSError:
        known = [platform.processor()]
    return hashlib.sha256("\n".join([platform.machine(), *known]).encode()).hexdigest()[:16]
