"""Destinations of a generated dataset: a local folder, or an object store (``store_destination``)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.layout import is_of_sequence
from rsbench.dataset.manifest import Files, write_manifest
from rsbench.dataset.scene_hashes import SceneHashes
from rsbench.dataset.sequence_identity import Plan, check_same, hashes_in, wanted_files
from rsbench.jobs.process_jobs import Workers
from rsbench.storage.files import HASHES, FileHashes, read_json, sha256
from rsbench.storage.work_folder import HIDDEN, WORK, named, unknown_files, work_folder


class Target(Protocol):
    """Where sequences go; picklable, for processes that make them."""

    def work_folder(self) -> Path:
        """A folder of this machine in which sequences come into being."""
        ...

    def place(self, partial: Path, name: str) -> None:
        """Put a complete sequence, a folder in the workplace, under its name; the folder is gone then."""
        ...


class Destination(Protocol):
    """A place of a dataset in which this command alone works."""

    @property
    def hidden(self) -> Path:
        """A folder of this machine for what a later run can use."""
        ...

    @property
    def target(self) -> Target: ...

    def complete(
        self, sequences: Sequence[SequenceCard], plans: Mapping[str, Plan], scene_hashes: SceneHashes
    ) -> Iterator[tuple[str, Files]]:
        """Names and files of the sequences that were made from the same plans and are as they were then."""
        ...

    def learned(self, name: str) -> Files:
        """The files of a sequence that was just placed."""
        ...

    def finish(self, card: DatasetCard, made: Mapping[str, Files]) -> None:
        """Write dataset.json, unless it says this already."""
        ...


@dataclass(frozen=True)
class FolderTarget:
    """A ``Target``."""

    out: Path

    def work_folder(self) -> Path:
        return self.out / HIDDEN / WORK

    def place(self, partial: Path, name: str) -> None:
        place = self.out / name
        if os.path.lexists(place):
            _refuse_unknown_files(place, "it is to be replaced")
            os.rename(place, partial.with_suffix(".old"))
        os.rename(partial, place)


class FolderDestination:
    """A ``Destination``."""

    def __init__(self, out: Path, hidden: Path, rehash: bool) -> None:
        self.hidden, self.target = hidden, FolderTarget(out)
        self._out = out
        self._hashes = FileHashes(out, out / HASHES, rehash)

    def complete(
        self, sequences: Sequence[SequenceCard], plans: Mapping[str, Plan], scene_hashes: SceneHashes
    ) -> Iterator[tuple[str, Files]]:
        for sequence in sequences:
            files = self._complete(sequence, plans[sequence.name], scene_hashes)
            if files is not None:
                yield sequence.name, files
        self._hashes.flush()

    def learned(self, name: str) -> Files:
        listed = read_json(self._out / name / "sequence.json")["files"]
        listed = {"sequence.json": sha256(self._out / name / "sequence.json"), **listed}
        files = {file: self._hashes.learn(f"{name}/{file}", digest) for file, digest in listed.items()}
        self._hashes.flush()
        return files

    def finish(self, card: DatasetCard, made: Mapping[str, Files]) -> None:
        write_manifest(card, self._out, made)

    def _complete(self, sequence: SequenceCard, plan: Plan, scene_hashes: SceneHashes) -> Files | None:
        """The files of a sequence that was made from the same plan and has the bytes it had then; else None."""
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
    """What is to be removed must be rsbench's own, to the last file."""
    if folder.is_symlink():
        raise RsbenchError(f"{folder}: {why}, and it is a link: move it away, then run the same command again")
    if others := unknown_files(folder, is_of_sequence):
        raise RsbenchError(
            f"{folder}: {why}, but {named(others)} is not rsbench's: move it away, then run the same command again"
        )


@contextmanager
def folder_destination(out: Path, rehash: bool) -> Iterator[FolderDestination]:
    """A folder, made if missing, in which this command alone works; ``rehash`` forgets the hashes that it keeps.

    Raises:
        RsbenchError: see ``work_folder``.
    """
    with work_folder(out) as hidden:
        yield FolderDestination(out, hidden, rehash)


@contextmanager
def open_destination(out: Path | str, workers: Workers, rehash: bool) -> Iterator[Destination]:
    """A folder, or the store of a URL, for a run of so many processes."""
    if isinstance(out, Path):
        with folder_destination(out, rehash) as folder:
            yield folder
    else:
        from rsbench.dataset.store_destination import store_destination

        with store_destination(out, workers, rehash) as store:
            yield store
