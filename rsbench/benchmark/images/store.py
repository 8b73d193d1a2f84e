"""Stored results, each with a hash (identity) of its inputs; a result is reused while this identity is unchanged.

A prediction is an artefact: a record, ``NAME.json``, and the files beside it whose names begin with ``NAME``. The
record is deleted before the files change and written after all of them, so an artefact with a record is
complete. Results that consist of JSON alone, such as scores, are stored by ``keep`` and read by ``kept``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rsbench.components.cards import parse_card
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import read_json, write_bytes, write_json
from rsbench.storage.work_folder import listed

_Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class _Record:
    identity: str
    success: bool
    reason: str


@dataclass(frozen=True, kw_only=True)
class _Matches(_Record):
    features: str
    matches: dict[str, int]


@dataclass(frozen=True, kw_only=True)
class _Motion(_Record):
    solver: str
    entry: str
    key: str
    w: _Vector | None
    d: _Vector | None
    metric: bool
    reference_point: Literal["body", "left"]
    motion_model: str
    motion_parameters: dict[str, Any]
    shutter: str
    uses: tuple[str, ...]
    inliers: dict[str, int]
    matches: dict[str, int]
    iterations: int
    seed: int

    def __post_init__(self) -> None:
        if self.success and (self.w is None or self.d is None):
            raise ValueError("a success without w and d")


@dataclass(frozen=True, kw_only=True)
class _Depth(_Record):
    matcher: str
    entry: str
    timed: bool


@dataclass(frozen=True, kw_only=True)
class _Correction(_Record):
    corrector: str
    solver: str
    matcher: str
    entries: dict[str, str]
    failures: dict[str, str] = field(default_factory=dict)
    """Reasons why the corrector failed on views such as ``left_0``."""


_KINDS: dict[str, type[_Record]] = {
    "matches": _Matches,
    "motion": _Motion,
    "seeds": _Motion,
    "depth": _Depth,
    "corrected": _Correction,
}


def is_whole(name: str, record: Mapping[str, Any]) -> bool:
    """Return whether a record has exactly the fields that its kind of artefact requires."""
    try:
        parse_card(_KINDS[name.partition("/")[0]], record, name)
    except RsbenchError:
        return False
    return True


SECONDS = "seconds.json"
"""File of the run times of a sequence's artefacts; they differ between runs, so no other file has run times."""


def identity_of(**parts: object) -> str:
    """Return a hash of everything that determines an artefact; the values must be JSON-ready."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, allow_nan=False).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Artefact:
    """A stored prediction, or the path of one that is not yet computed."""

    folder: Path
    """Folder of the sequence."""
    name: str
    """Name, such as ``motion/gs-8pt``."""
    identity: str

    @property
    def stem(self) -> Path:
        """Common path of the files, without suffixes."""
        return self.folder / self.name

    def file(self, end: str) -> Path:
        """Return the path of a file with an ending such as ``-inliers.npz``."""
        return self.stem.with_name(self.stem.name + end)

    def record(self) -> dict[str, Any] | None:
        """Return the stored record if it is current, otherwise None."""
        record = read_record(self.file(".json"))
        current = record is not None and record.get("identity") == self.identity and is_whole(self.name, record)
        return record if current else None

    def forget(self) -> None:
        """Mark the artefact as outdated, so that the next run computes it again."""
        self.file(".json").unlink(missing_ok=True)

    def start(self) -> None:
        """Prepare the artefact; must be called before its files are written."""
        self.stem.parent.mkdir(parents=True, exist_ok=True)
        self.forget()

    def finish(self, record: Mapping[str, Any], seconds: float | None = None) -> None:
        """Write the record, JSON-ready, and the run time; must be called when the files are complete."""
        if seconds is not None:
            write_json(self.folder / SECONDS, read_seconds(self.folder) | {self.name: round(seconds, 4)})
        write_json(self.file(".json"), {"identity": self.identity, **record})


def keep(path: Path, identity: str, content: object) -> None:
    """Store ``content``, which is JSON-ready except for NaN and infinity; ``kept`` reads it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    record = {"identity": identity, "sha256": _digest(content), "content": content}
    write_bytes(path, (json.dumps(record) + "\n").encode())


def kept(path: Path, identity: str) -> Any:
    """Read the content that ``keep`` stored with this identity; None if the file is missing, damaged or has
    another identity."""
    record = read_record(path) or {}
    content = record.get("content")
    current = record.get("identity") == identity and record.get("sha256") == _digest(content)
    return content if current else None


def resumed(
    names: Sequence[str],
    places: Mapping[str, tuple[Path, str]],
    make: Callable[[list[str]], Generator[tuple[str, Any], None, None]],
    step: Callable[[str], object],
) -> dict[str, Any]:
    """Return results by name: stored ones are read with ``kept``, the others are computed by ``make`` and stored.

    Args:
        names: of all results.
        places: file and identity of each, for ``kept``; empty: nothing is stored.
        make: yields the results of some names as they become ready; it is closed whatever happens.
        step: called with each name.
    """
    found = dict[str, Any]()
    for name in names:
        if name in places and (content := kept(*places[name])) is not None:
            found[name] = content
            step(name)
    with closing(make([name for name in names if name not in found])) as made:
        for name, content in made:
            if name in places:
                keep(*places[name], content)
            found[name] = content
            step(name)
    return found


def _digest(content: object) -> str:
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def read_record(path: Path) -> dict[str, Any] | None:
    """Read a stored record of any identity; None if it cannot be read."""
    try:
        return read_json(path)
    except RsbenchError:
        return None


def records_below(folder: Path, kind: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield names and complete records of all artefacts of a kind, such as ``motion``, sorted by name."""
    for path in listed(folder / kind, ".json"):
        record = read_record(path)
        if record is not None and is_whole(kind, record):
            yield path.stem, record


def read_seconds(folder: Path) -> dict[str, float]:
    """Read the run times, s, by the name of the artefact; values that are not numbers are omitted."""
    found = read_record(folder / SECONDS) or {}
    return {name: float(value) for name, value in found.items() if isinstance(value, int | float)}
