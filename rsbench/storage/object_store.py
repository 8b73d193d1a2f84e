"""Object stores by URL, through fsspec (the extra ``rsbench[cloud]``); no other module imports it.

A store holds complete objects by name and has no locks, links or renaming. An object that is being
written becomes visible when it is complete, as on S3 and similar stores.

A command whose results go to a store works in a local folder, whose files are uploaded. The folder lies in the
user's cache. ``sent.json`` beside it records the completed and the pending transfers, so that a later command can
detect whether the folder is newer than the store or others changed the store. Files are uploaded in the order in
which they were written, so that a file that marks others as complete comes after them. Files of the hidden folder
that a later run can use are uploaded too, so that another machine can resume.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from rsbench.core.errors import RsbenchError
from rsbench.storage.files import HASHES, check_out, read_json, write_json
from rsbench.storage.work_folder import HIDDEN, LOCK, WORK, files_below, remove, temporary, user_cache, work_folder

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
    """Return a local folder (also given as ``file:///...``) or the URL of a store.

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
    """Return a URL without its password, for messages."""
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
        """Return all objects below a folder, from one listing."""
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
        """Yield objects with their contents; ``at_once`` of them are requested together."""
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
    """Return the store of a URL, which is opened once per process; see ``Store``."""
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
    """Return the local folder for files and records of a store: in the user's cache, else a temporary folder.

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
    """Return a short name for the records of a store."""
    return hashlib.sha256(url.encode()).hexdigest()[:16]


_BEAT_S = 30.0
_BROUGHT = 64
"""Files of one download request."""
_MARK = f"{HIDDEN}/{LOCK}"
"""Lock file, which marks a hidden folder as made by rsbench; empty in a store, which has no locks."""
_OF_THIS_MACHINE = (_MARK, HASHES)
_urls: dict[Path, str] = {}
"""URLs of the folders that are open in this process."""


class _Known(NamedTuple):
    """States of a local file and of its object when they were last equal."""

    here: str
    """Time and size of the file; empty: it was removed, and the object is to be removed."""
    there: str
    """Size and token of the object; empty: the upload is pending."""


class _Mirror:
    def __init__(self, store: Store, hidden: Path) -> None:
        self.folder = hidden / "results"
        self._store, self._work, self._record = store, hidden / WORK, hidden / "sent.json"
        self._known: dict[str, _Known] = {}
        try:
            self._known = {path: _Known(*known) for path, known in read_json(self._record).items()}
        except (RsbenchError, TypeError):  # missing or damaged: the state of the folder is unknown
            remove(self.folder)

    def bring(self) -> None:
        """Make the folder equal to the store, or only add missing files if the folder is newer than the store."""
        self.folder.mkdir(parents=True, exist_ok=True)
        here, there = self._here(), self._there()
        if self._is_ahead(here, there):
            wanted = there.keys() - self._known.keys() - here.keys()
        else:
            same = {path for path in there if self._known.get(path) == (here.get(path), there[path])}
            for path in here.keys() - same:
                self._drop(path)
            wanted = there.keys() - same
            self._known = {path: self._known[path] for path in same}
        self._save()
        due = sorted(wanted)
        for first in range(0, len(due), _BROUGHT):
            self._download(due[first : first + _BROUGHT], there)
        if (self.folder / HIDDEN).is_dir():
            (self.folder / _MARK).touch()
        (self._work / LOCK).touch()
        self._store.upload({_MARK: self._work / LOCK})  # fails early if the store cannot be written

    def send(self) -> None:
        """Make the store equal to the folder; the pending changes are recorded first."""
        here = self._here()
        due = [path for path, now in here.items() if not self._is_sent(path, now)]
        gone = sorted(self._known.keys() - here.keys())
        if not due and not gone:
            return
        self._known |= {path: _Known(here[path], "") for path in due}
        self._known |= {path: _Known("", self._known[path].there) for path in gone}
        self._save()
        self._remove(path for path in gone if not _is_hidden(path))  # outdated results must not mix with new ones
        for path in due:
            self._upload(path)
        self._remove(path for path in gone if _is_hidden(path))  # results that depend on them are uploaded now
        there = self._there()
        self._known |= {path: _Known(here[path], there[path]) for path in due if path in there}
        for path in {*gone, *(path for path in due if path not in there)}:
            del self._known[path]
        self._save()

    def keep_sending(self, done: threading.Event) -> None:
        """Upload periodically until ``done``; after an error retry, and ``finish`` raises the last one."""
        while not done.wait(_BEAT_S):
            with contextlib.suppress(RsbenchError, OSError):
                self.send()

    def finish(self) -> None:
        try:
            self.send()
            if not any(map(_is_hidden, self._known)):
                self._store.remove(_MARK)
        except RsbenchError as error:
            raise RsbenchError(
                f"{error}; results are kept in {self.folder}: the same command sends them"
            ) from error

    def _is_ahead(self, here: dict[str, str], there: dict[str, str]) -> bool:
        """Return whether, since both were equal, nobody else changed the store and no local files were removed."""
        return all(
            (known.there in ("", there.get(path)) or (not known.here and path not in there))
            and (not known.here or path in here)
            for path, known in self._known.items()
        )

    def _is_sent(self, path: str, now: str) -> bool:
        known = self._known.get(path)
        return known is not None and known.here == now and known.there != ""

    def _here(self) -> dict[str, str]:
        """Return time and size of each file of the folder, in the order of writing."""
        found: list[tuple[int, bool, str, int]] = []
        for path in filter(_travels, files_below(self.folder)):
            state = (self.folder / path).lstat()
            if stat.S_ISREG(state.st_mode):
                found.append((state.st_mtime_ns, path.endswith(".json"), path, state.st_size))
        return {path: f"{time} {size}" for time, _, path, size in sorted(found)}

    def _there(self) -> dict[str, str]:
        return {path: listed.state for path, listed in self._store.listing().items() if _travels(path)}

    def _save(self) -> None:
        write_json(self._record, dict(self._known))

    def _download(self, paths: list[str], there: dict[str, str]) -> None:
        """Download files; each appears complete or not at all."""
        partial = {path: self._work / str(number) for number, path in enumerate(paths)}
        self._store.download(partial)
        for path, file in partial.items():
            (self.folder / path).parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, self.folder / path)
            state = (self.folder / path).lstat()
            self._known[path] = _Known(f"{state.st_mtime_ns} {state.st_size}", there[path])
        self._save()

    def _upload(self, path: str) -> None:
        try:
            self._store.upload({path: self.folder / path})
        except RsbenchError:
            if (self.folder / path).exists():  # else the command has removed it meanwhile
                raise

    def _remove(self, paths: Iterable[str]) -> None:
        for path in paths:
            self._store.remove(path)

    def _drop(self, path: str) -> None:
        """Remove a local file, and folders that become empty, since commands may take them for damaged results."""
        (self.folder / path).unlink()
        with contextlib.suppress(OSError):
            for parent in Path(path).parents[:-1]:
                (self.folder / parent).rmdir()


def _is_hidden(path: str) -> bool:
    return path.startswith(f"{HIDDEN}/")


def _travels(path: str) -> bool:
    """Return whether a file is uploaded: it is complete, not a lock, and has a name that is valid everywhere."""
    *_, name = parts = path.split("/")
    own = path in _OF_THIS_MACHINE or path.startswith(f"{HIDDEN}/{WORK}/")
    plain = not {"", ".", ".."}.intersection(parts) and not re.search(r"[\\:]", path)
    return plain and not own and not (name.startswith(".") and name.endswith(".partial"))


@contextmanager
def mirrored(url: str) -> Iterator[Path]:
    """Yield a local folder with the results of a store, in which a command works as usual.

    Its files are uploaded while the command runs and when it ends, even after an error. Other objects in the store
    are not changed.

    Raises:
        RsbenchError: see ``Store`` and ``work_folder``; or the store refused results, which then stay in the
            local folder.
    """
    store, hidden = open_store(url), cache_of(url)
    with contextlib.ExitStack() as stack:
        with _called(hidden, store.url):
            stack.enter_context(work_folder(hidden, hidden))
        mirror, done = _Mirror(store, hidden), threading.Event()
        mirror.bring()
        thread = threading.Thread(target=mirror.keep_sending, args=(done,), daemon=True)
        thread.start()
        _urls[mirror.folder] = store.url
        try:
            with _called(mirror.folder, store.url):
                yield mirror.folder
        except BaseException:
            done.set()
            thread.join()
            with contextlib.suppress(RsbenchError, OSError):  # the command's own error is the one to report
                mirror.finish()
            raise
        finally:
            del _urls[mirror.folder]
        done.set()
        thread.join()
        mirror.finish()


@contextmanager
def _called(folder: Path, url: str) -> Iterator[None]:
    """Replace the folder by the URL in error messages."""
    try:
        yield
    except RsbenchError as error:
        error.args = (str(error).replace(str(folder), url),)
        raise


def name_of(path: Path) -> str:
    """Return the absolute path of a result, or its URL if it is uploaded to a store."""
    for folder, url in _urls.items():
        if path.is_relative_to(folder):
            return f"{url}/{path.relative_to(folder).as_posix()}"
    return str(path.resolve())
