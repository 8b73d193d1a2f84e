"""What the probes of earlier processes found, kept in the user's cache folder so that start-up costs nothing.

Only good news is kept: a failure may be cured by the next start, and probing again costs a fraction of a second.
Nothing here may fail: without a home folder or with a read-only one there is simply no memory.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

_MAXIMUM_ENTRIES = 64


def cache_file() -> Path | None:
    """Where verdicts are kept; None when the user has no home folder."""
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    try:
        base = Path(chosen) if chosen else Path.home() / ".cache"
    except RuntimeError:
        return None
    return base / "rsbench" / "probes.json" if base.is_absolute() else None


def recall(key: str) -> str | None:
    """The version that a successful probe reported, or None."""
    return _read().get(key)


def remember(key: str, version: str) -> None:
    """Store a successful probe; silently does nothing where nothing can be written."""
    file = cache_file()
    if file is None:
        return
    entries = {**_read(), key: version}
    kept = dict(list(entries.items())[-_MAXIMUM_ENTRIES:])
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=file.parent, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as stream:
            json.dump(kept, stream, indent=1)
        os.replace(name, file)
    except OSError:
        return


def _read() -> dict[str, str]:
    file = cache_file()
    try:
        content = json.loads(file.read_text(encoding="utf-8")) if file is not None else {}
    except (OSError, ValueError):
        return {}
    if not isinstance(content, dict):
        return {}
    return {key: value for key, value in content.items() if isinstance(value, str)}
