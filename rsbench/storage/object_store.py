"""Object stores by URL, through fsspec (the extra ``rsbench[cloud]``); no other module imports it.

A store holds complete objects by name and has no locks, links or renaming. An object that is being
written becomes visible when it is complete, as on S3 and similar stores.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from rsbench.core.errors import RsbenchError
from rsbench.storage.files import check_out
from rsbench.storage.work_folder import temporary, user_cache

_URL = re.compile(r"[a-z][a-z0-9+.:-]+://")
_LOCAL = ("file", "local")
_TOKENS = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated", "created")
"""Keys of listings, by kind of store, whose value changes with an object's content."""


class Listed(NamedTuple):
    """An object in a listing."""

    size: int
    token: str
    """A text that changes with the content; empty if the store has none."""

    @property
    def state(self) -> str:
        return f"{self.size} {self.token}"


def path_or_url(out: str) -> Path | str:
    """A folder of this machine (also as ``file:///...``) or the URL of a store.

    Raises:
        RsbenchError: a URL that is not supported.
    """
    if not _URL.match(out):
        return Path(out)
    protocol, _, rest = out.partition("://")
    if protocol in _LOCAL:
        if not rest.startswith("/"):
            raise RsbenchError(f"{out}: must be an absolute path, such as {protocol}:///{rest}")
        return Path(rest[1:] if os.name == "nt" else rest)
    if "::" in out or not rest.strip("/") or re.search(r"[*?\[]", rest):
        raise RsbenchError(f"{shown(out)}: must be a plain URL, such as s3://bucket/folder")
    return out.rstrip("/")


def shown(url: str) -> str:
    """A URL for messages, without a password."""
    return re.sub(r"(?<=://)[^/@]*@", "", url)


class Store:
    """The objects below a URL; paths are relative to it, with slashes. All methods raise RsbenchError for errors
    of the store."""

    def __init__(self, url: str) -> None:
        """
        Raises:
            RsbenchError: fsspec or its package for this kind of store is not installed, or no such kind.
        """
        self.url = shown(url)
        try:
            from fsspec.core import url_to_fs
        except ImportError as error:
            raise RsbenchError(f"{self.url}: needs fsspec: pip install 'rsbench[cloud]'") from error
        with self._errors("open it"):
            self._fs, root = url_to_fs(url)
        self._root = root.rstrip("/")

    def listing(self, folder: str = "") -> dict[str, Listed]:
        """All objects below a folder, by one listing."""
        top = f"{self._root}/{folder}".rstrip("/")
        with self._errors("list it"):
            self._fs.invalidate_cache()
            found: dict[str, dict[str, Any]] = self._fs.find(top, detail=True)
            self._fs.invalidate_cache()  # hundreds of MB
        start = len(self._root.strip("/")) + 1
        return {
            name.strip("/")[start:]: _listed(each)
            for name, each in found.items()
            if each.get("type") != "directory" and not name.endswith("/")
        }

    def read(self, paths: Iterable[str], at_once: int = 256) -> Iterator[tuple[str, bytes]]:
        """Objects with their contents; ``at_once`` are requested together."""
        paths = list(paths)
        for first in range(0, len(paths), at_once):
            some = {self._full(path): path for path in paths[first : first + at_once]}
            with self._errors(f"read {paths[first]}"):
                contents = self._fs.cat(list(some))
            for full, content in contents.items():
                yield some[full], content

    def download(self, files: Mapping[str, Path]) -> None:
        """Copy objects to files of this machine, which are complete when this returns."""
        with self._errors(f"read {next(iter(files), '')}"):
            self._fs.get([self._full(path) for path in files], [str(file) for file in files.values()])

    def upload(self, files: Mapping[str, Path]) -> None:
        """Copy files of this machine, in any order; objects of the same path are replaced."""
        with self._errors(f"write {next(iter(files), '')}"):
            self._fs.put([str(path) for path in files.values()], [self._full(path) for path in files])

    def remove(self, path: str) -> None:
        """Remove an object, if it exists."""
        with self._errors(f"remove {path}"), suppress(FileNotFoundError):
            self._fs.rm_file(self._full(path))

    def _full(self, path: str) -> str:
        return f"{self._root}/{path}"

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        """Turn any error of a store into one line: the classes of different stores have no common base."""
        try:
            yield
        except Exception as error:
            words = " ".join(str(error).split()) or type(error).__name__
            raise RsbenchError(f"{self.url}: cannot {what}: {words}; {_remedy(error)}") from error


@lru_cache(maxsize=4)
def open_store(url: str) -> Store:
    """The store of a URL, opened once in this process; see ``Store``."""
    return Store(url)


def _listed(information: Mapping[str, Any]) -> Listed:
    token = next((information[key] for key in _TOKENS if information.get(key) is not None), "")
    return Listed(int(information.get("size") or 0), str(token))


def _remedy(error: Exception) -> str:
    if isinstance(error, ImportError):
        return "install the package of this kind of store, such as s3fs for s3"
    if isinstance(error, NotImplementedError | ValueError):
        return "choose another URL, such as s3://bucket/folder"
    if "redential" in f"{type(error)} {error}":
        return "give its package credentials (for s3: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE)"
    if isinstance(error, PermissionError):
        return "ask for the right to list, read and write there, or choose another URL"
    if isinstance(error, FileNotFoundError):
        return "make the bucket first, or choose another URL"
    return "check that the store can be reached; the same command continues there"


def cache_of(url: str) -> Path:
    """Local folder for the files and records of a store: in the user's cache, else a temporary folder.

    Raises:
        RsbenchError: neither can be written.
    """
    for base in (user_cache(), temporary()):
        if base is not None:
            with suppress(RsbenchError):
                check_out(base)
                return base / "stores" / key_of(url)
    raise RsbenchError("no folder for files in progress; set TMPDIR to one that can be written")


def key_of(url: str) -> str:
    """A short name for the records of a store."""
    return hashlib.sha256(url.encode()).hexdigest()[:16]
