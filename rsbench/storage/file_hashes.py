"""Hashes of files, kept: what has the size and the times that it had when it was hashed is not read again."""

from __future__ import annotations

import contextlib
import json
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from rsbench.core.errors import RsbenchError
from rsbench.storage.files import sha256
from rsbench.storage.work_folder import HIDDEN

HASHES = f"{HIDDEN}/hashes.jsonl"
"""Where a folder of results keeps hashes, below it."""


class HashedFile(NamedTuple):
    """A file as it was when it was hashed."""

    size: int
    modified_ns: int
    changed_ns: int
    """Of its content, name, owner or permissions; no tool can set it."""
    sha256: str


class FileHashes:
    """SHA-256 of the files below a folder; new ones are appended to a file by ``flush``."""

    def __init__(self, root: Path, store: Path, rehash: bool = False) -> None:
        """
        Args:
            root: the folder.
            store: where hashes are kept; need not exist.
            rehash: forget what is kept.

        Raises:
            RsbenchError: the store is there and is no regular file: a named pipe, a link, a folder.
        """
        self._root, self._store = root, store
        if os.path.lexists(store) and not stat.S_ISREG(store.lstat().st_mode):
            raise RsbenchError(f"{store}: is not a regular file; remove it")
        if rehash:
            store.unlink(missing_ok=True)
        self._known = _read(store)
        self._new: list[str] = []

    def of(self, name: str) -> HashedFile | None:
        """A file by its path below the folder, with slashes; None when it is no file."""
        path = f"{self._root}/{name}"
        try:
            found = os.stat(path)
        except OSError:
            return None
        if not stat.S_ISREG(found.st_mode):
            return None
        state = found.st_size, found.st_mtime_ns, found.st_ctime_ns
        known = self._known.get(name)
        if known is None or known[:3] != state:
            known = self._keep(name, HashedFile(*state, sha256(Path(path))))
        return known

    def sha256(self, path: Path) -> str:
        """Of a file below the folder, by its path."""
        found = self.of(path.relative_to(self._root).as_posix())
        return sha256(path) if found is None else found.sha256

    def learn(self, name: str, digest: str) -> HashedFile:
        """Keep the hash of a file that was just written."""
        found = os.stat(f"{self._root}/{name}")
        return self._keep(name, HashedFile(found.st_size, found.st_mtime_ns, found.st_ctime_ns, digest))

    def flush(self) -> None:
        """Append what is new."""
        self.append(self.taken())

    def taken(self) -> list[str]:
        """What is new, for ``append`` of another process's: here it is not new any more."""
        lines = self._new
        self._new = []
        return lines

    def append(self, lines: Sequence[str]) -> None:
        """Keep lines of ``taken``."""
        self._known |= _parsed(lines)
        if lines:
            with self._store.open("a", encoding="utf-8", newline="\n") as stream:
                stream.write("\n" + "\n".join(lines) + "\n")  # the line before may have been cut by a kill

    def _keep(self, name: str, file: HashedFile) -> HashedFile:
        self._known[name] = file
        self._new.append(json.dumps([name, *file]))
        return file


def _read(store: Path) -> dict[str, HashedFile]:
    try:
        with store.open(encoding="utf-8", errors="replace") as stream:
            return _parsed(stream)
    except OSError:
        return {}


def _parsed(lines: Iterable[str]) -> dict[str, HashedFile]:
    known = dict[str, HashedFile]()
    for line in lines:
        with contextlib.suppress(ValueError, TypeError, RecursionError):  # empty, cut, or not ours
            name, size, modified, changed, digest = json.loads(line)
            known[name] = HashedFile(size, modified, changed, digest)
    return known
