"""Destinations of a generated dataset: a local folder or an object store."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.manifest import (
    CROISSANT,
    DATASET,
    Files,
    Plan,
    SceneHashes,
    check_same,
    croissant_of,
    hashes_in,
    manifest_of,
    says,
    wanted_files,
    write_manifest,
)
from rsbench.dataset.sequence import is_of_sequence
from rsbench.jobs.process_jobs import Cluster, Workers
from rsbench.storage.files import HASHES, FileHashes, HashedFile, read_json, sha256, write_json
from rsbench.storage.object_store import Listed, Store, cache_of, key_of, open_store
from rsbench.storage.work_folder import (
    HIDDEN,
    WORK,
    files_below,
    named,
    remove,
    temporary,
    unknown_files,
    work_folder,
)


@dataclass(frozen=True)
class FolderTarget:
    """Places finished sequences in a local folder; picklable, for processes that render them."""

    out: Path

    def work_folder(self) -> Path:
        """Return a folder on this machine in which sequences are rendered."""
        return self.out / HIDDEN / WORK

    def place(self, partial: Path, name: str) -> None:
        """Move a complete sequence from the work folder to its final name."""
        place = self.out / name
        if os.path.lexists(place):
            _refuse_unknown_files(place, "it is to be replaced")
            os.rename(place, partial.with_suffix(".old"))
        os.rename(partial, place)


class FolderDestination:
    """The folder of a dataset, locked for this command.

    ``hidden`` is a folder on this machine for data that later runs can reuse.
    """

    def __init__(self, out: Path, hidden: Path, rehash: bool) -> None:
        self.hidden, self.target = hidden, FolderTarget(out)
        self._out = out
        self._hashes = FileHashes(out, out / HASHES, rehash)

    def complete(
        self, sequences: Sequence[SequenceCard], plans: Mapping[str, Plan], scene_hashes: SceneHashes
    ) -> Iterator[tuple[str, Files]]:
        """Yield names and files of sequences that were rendered from the same plans and are unchanged since."""
        for sequence in sequences:
            files = self._complete(sequence, plans[sequence.name], scene_hashes)
            if files is not None:
                yield sequence.name, files
        self._hashes.flush()

    def learned(self, name: str) -> Files:
        """Return the files of a sequence that was just placed."""
        listed = read_json(self._out / name / "sequence.json")["files"]
        listed = {"sequence.json": sha256(self._out / name / "sequence.json"), **listed}
        files = {file: self._hashes.learn(f"{name}/{file}", digest) for file, digest in listed.items()}
        self._hashes.flush()
        return files

    def finish(self, card: DatasetCard, made: Mapping[str, Files]) -> None:
        """Write dataset.json unless its content is unchanged."""
        write_manifest(card, self._out, made)

    def _complete(self, sequence: SequenceCard, plan: Plan, scene_hashes: SceneHashes) -> Files | None:
        """Return the files of a sequence that has the same plan and whose bytes are unchanged, else None."""
        folder = self._out / sequence.name
        if not os.path.lexists(folder):
            return None
        if not (folder / "sequence.json").is_file():
            raise RsbenchError(
                f"{folder}: holds no sequence.json, so rsbench did not make it; move it away or choose another "
                "--out"
            )
        manifest = read_json(folder / "sequence.json")
        check_same(folder, manifest, plan, scene_hashes.of(sequence.scene))
        listed = hashes_in(manifest)
        files = {name: self._hashes.of(f"{sequence.name}/{name}") for name in listed if is_of_sequence(name)}
        damaged = [
            name
            for name in wanted_files(manifest, plan)
            if (found := files.get(name)) is None or found.sha256 != listed.get(name)
        ]
        if damaged:
            _refuse_unknown_files(folder, f"{named(damaged)} differs from what was written")
            return None
        own = self._hashes.of(f"{sequence.name}/sequence.json")
        return {"sequence.json": own, **files} if own else None  # pyrefly: ignore[bad-return]


def _refuse_unknown_files(folder: Path, why: str) -> None:
    """Raise RsbenchError unless all files of a folder that is to be removed were written by rsbench."""
    if folder.is_symlink():
        raise RsbenchError(f"{folder}: {why}, and it is a link: move it away, then run the same command again")
    if others := unknown_files(folder, is_of_sequence):
        raise RsbenchError(
            f"{folder}: {why}, but {named(others)} is not rsbench's: move it away, then run the same command again"
        )


_OBJECTS = "objects.jsonl"
_MANIFEST = "sequence.json"
_REHASHED = 8
"""Number of files that are hashed, and so in memory, at the same time."""
_MOST_CHILDREN = 1024
"""Largest number of processes on one machine of a cluster that write to one store."""


@dataclass(frozen=True)
class StoreTarget:
    """Places finished sequences in an object store, as ``FolderTarget`` does in a folder."""

    url: str
    work: Path | None
    """Work folder; None if each process has its own, because processes may run on other machines."""

    def work_folder(self) -> Path:
        return _own_work_folder(key_of(self.url)) if self.work is None else self.work

    def place(self, partial: Path, name: str) -> None:
        store = open_store(self.url)
        files = {f"{name}/{file}": partial / file for file in files_below(partial)}
        last = f"{name}/{_MANIFEST}"
        store.upload({path: file for path, file in files.items() if path != last})
        store.upload({last: files[last]})
        remove(partial)


class _Known(NamedTuple):
    """State of a sequence in the store when it was uploaded or first seen."""

    token: str
    """``Listed.state`` of its sequence.json: size and token."""
    sha256: str
    sizes: dict[str, int]
    manifest: Plan

    @property
    def files(self) -> Files:
        listed = {_MANIFEST: self.sha256, **hashes_in(self.manifest)}
        return {file: HashedFile(self.sizes[file], 0, 0, digest) for file, digest in listed.items()}


class StoreDestination:
    """A dataset in an object store, with the interface of ``FolderDestination``."""

    def __init__(self, store: Store, hidden: Path, target: StoreTarget, rehash: bool) -> None:
        self.hidden, self.target = hidden, target
        self._store, self._rehash = store, rehash
        if rehash:
            (hidden / _OBJECTS).unlink(missing_ok=True)
        self._lines = _read_lines(hidden / _OBJECTS)
        self._objects: dict[str, dict[str, Listed]] = {}
        self._has_dataset = False

    def complete(
        self, sequences: Sequence[SequenceCard], plans: Mapping[str, Plan], scene_hashes: SceneHashes
    ) -> Iterator[tuple[str, Files]]:
        self._list("", plans)
        self._has_dataset = "" in self._objects
        new = [name for name in plans if self._is_new(name)]
        self._learn(new, self._sizes_of_dataset() if new and self._has_dataset else {})
        for sequence in sequences:
            known = self._complete(sequence, plans[sequence.name], scene_hashes)
            if known is not None:
                yield sequence.name, known.files
        self._objects.clear()

    def learned(self, name: str) -> Files:
        self._list(name, [name])
        self._learn([name], {})
        known = self._known(name)
        if missing := [file for file in hashes_in(known.manifest) if file not in known.sizes]:
            raise RsbenchError(
                f"{self._store.url}/{name}: {named(missing)} is not there although it was sent; run the same "
                "command again"
            )
        return known.files

    def finish(self, card: DatasetCard, made: Mapping[str, Files]) -> None:
        content, work = manifest_of(card, made), self.hidden / WORK
        there = self._store.read([DATASET]) if self._has_dataset else ()
        if not any(says(data, content) for _, data in there):
            write_json(work / DATASET, content)
            write_json(work / CROISSANT, croissant_of(content, sha256(work / DATASET)))
            self._store.upload({CROISSANT: work / CROISSANT})
            self._store.upload({DATASET: work / DATASET})

    def _list(self, folder: str, names: Iterable[str]) -> None:
        """List the objects of these sequences in the store; dataset.json is listed under an empty name."""
        found = {name: dict[str, Listed]() for name in names}
        for path, listed in self._store.listing(folder).items():
            name, _, file = path.partition("/")
            if name in found:
                found[name][file] = listed
            elif path == DATASET:
                found[""] = {path: listed}
        self._objects = found

    def _is_new(self, name: str) -> bool:
        """Return whether the store has a sequence.json that is unread or has changed since it was read."""
        there = self._objects[name].get(_MANIFEST)
        return there is not None and (name not in self._lines or self._known(name).token != there.state)

    def _known(self, name: str) -> _Known:
        return _Known(*json.loads(self._lines[name])[1:])

    def _learn(self, names: Iterable[str], sizes: Mapping[tuple[str, str], int]) -> None:
        """Read each sequence.json and store its state; ``sizes`` by path and hash take precedence over the sizes
        that the store lists now."""
        with (self.hidden / _OBJECTS).open("a", encoding="utf-8", newline="\n") as stream:
            for path, data in self._store.read([f"{name}/{_MANIFEST}" for name in names]):
                name = path.partition("/")[0]
                objects = self._objects[name]
                manifest = _parsed(data, f"{self._store.url}/{path}")
                digest = hashlib.sha256(data).hexdigest()
                hashes = {_MANIFEST: digest, **hashes_in(manifest)}
                own = {
                    file: sizes.get((f"{name}/{file}", str(hashes.get(file))), there.size)
                    for file, there in objects.items()
                }
                state = objects.get(_MANIFEST, Listed(0, "")).state
                self._lines[name] = json.dumps([name, state, digest, own, manifest])
                stream.write(f"\n{self._lines[name]}\n")  # the line before may have been cut by a kill

    def _sizes_of_dataset(self) -> dict[tuple[str, str], int]:
        """Return file sizes by path and hash from dataset.json; empty if it cannot be read."""
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
            for _, data in self._store.read([DATASET]):
                files = json.loads(data)["files"].items()
                return {(path, str(file["sha256"])): int(file["size"]) for path, file in files}
        return {}

    def _complete(self, sequence: SequenceCard, plan: Plan, scene_hashes: SceneHashes) -> _Known | None:
        """Return a sequence that has the same plan and whose files have unchanged sizes, else None.

        With ``rehash``, the hashes of the files are compared too.
        """
        objects, place = self._objects[sequence.name], f"{self._store.url}/{sequence.name}"
        others = named(sorted(file for file in objects if not is_of_sequence(file)))
        if _MANIFEST not in objects:  # there is nothing, or an interrupted upload
            if others:
                raise RsbenchError(
                    f"{place}: holds {others}, which is not rsbench's: move it away or choose another --out"
                )
            return None
        known = self._known(sequence.name)
        check_same(place, known.manifest, plan, scene_hashes.of(sequence.scene))
        hashes, wanted = hashes_in(known.manifest), wanted_files(known.manifest, plan)
        damaged = [file for file in wanted if not self._is_whole(objects.get(file), known.sizes.get(file))]
        damaged += [file for file in wanted if not (isinstance(hashes.get(file), str) and is_of_sequence(file))]
        if self._rehash and not damaged:
            paths = {f"{sequence.name}/{file}": hashes[file] for file in wanted}
            contents = self._store.read(paths, at_once=_REHASHED)
            damaged = [path for path, data in contents if hashlib.sha256(data).hexdigest() != paths[path]]
        if not damaged:
            return known
        if others:
            raise RsbenchError(
                f"{place}: {named(damaged)} differs from what was written, but {others} is not rsbench's: move it "
                "away, then run the same command again"
            )
        self._store.remove(f"{sequence.name}/{_MANIFEST}")  # until it is whole again
        return None

    @staticmethod
    def _is_whole(there: Listed | None, size: int | None) -> bool:
        return there is not None and there.size == size


def _parsed(data: bytes, path: str) -> Plan:
    with contextlib.suppress(ValueError, RecursionError):
        content = json.loads(data)
        if isinstance(content, dict):
            return content
    raise RsbenchError(f"{path}: damaged, or not rsbench's: remove it, then run the same command again")


def _read_lines(path: Path) -> dict[str, str]:
    """Return the last line of each sequence: a JSON list of its name and the fields of ``_Known``."""
    lines = {}
    with contextlib.suppress(FileNotFoundError), path.open(encoding="utf-8", errors="replace") as stream:
        for line in stream:
            with contextlib.suppress(ValueError, TypeError, RecursionError):  # empty, cut, or not ours
                name, *known = json.loads(line)
                if len(known) == len(_Known._fields):
                    lines[name] = line
    return lines


def store_for(url: str, workers: Workers) -> Store:
    """Open the store of a URL for these workers.

    Raises:
        RsbenchError: see ``Store``, or several processes would use a store in this process's memory.
    """
    if url.startswith("memory:") and workers != 1:
        raise RsbenchError(f"--out {url}: lives in one process: without --workers and --scheduler")
    return open_store(url)


@contextmanager
def open_destination(
    out: Path | str, workers: Workers, rehash: bool
) -> Iterator[FolderDestination | StoreDestination]:
    """Open a folder, created if missing, or the store of a URL, locked against other commands on this machine.

    ``rehash`` reads every file again and ignores known hashes.

    Raises:
        RsbenchError: see ``store_for`` and ``work_folder``.
    """
    if isinstance(out, Path):
        with work_folder(out) as hidden:
            yield FolderDestination(out, hidden, rehash)
        return
    store, hidden = store_for(out, workers), cache_of(out)
    with work_folder(hidden, hidden):
        target = StoreTarget(out, None if isinstance(workers, Cluster) else hidden / WORK)
        yield StoreDestination(store, hidden, target, rehash)


_kept = contextlib.ExitStack()
"""Keeps the lock of the work folder until this process ends."""


@cache
def _own_work_folder(key: str) -> Path:
    """Lock and return the first free work folder on this machine; a killed process may have used it before."""
    base = (temporary() or Path(tempfile.mkdtemp())) / "stores" / key
    for number in range(_MOST_CHILDREN):
        place = base / str(number)
        with contextlib.suppress(RsbenchError):
            return _kept.enter_context(work_folder(place, place)) / WORK
    raise RsbenchError(f"{base}: cannot be written; set TMPDIR to a folder that can")
