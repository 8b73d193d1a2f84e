"""Digests of a dataset, and its comparison with a reference copy."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.components.cards import choices, shipped_folder
from rsbench.core.errors import RsbenchError
from rsbench.dataset.manifest import hashes_in
from rsbench.dataset.sequence import Sequence, read_dataset, read_dataset_manifest
from rsbench.storage.files import read_depth, read_json, read_png, sha256
from rsbench.storage.untrusted_files import NAME, inside, read_text

_NOT_DIGESTED = ("made_by", "files")
"""Keys of sequence.json left out: versions, which may change while no file does, and hashes, computed anew."""
_LINE = re.compile(rf"([0-9a-f]{{64}})  ({NAME.pattern})")


def digests(folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the name and digest of each sequence of a dataset, in its order.

    A digest covers the ground truth in sequence.json (motion, cameras, scene, renderer, seed), and the path and
    content of each listed file: frames, depth, poses, channels. It does not depend on dates, versions or folders.

    Raises:
        RsbenchError: the dataset cannot be read, or a listed file is missing.
    """
    for sequence in read_dataset(folder):
        yield sequence.name, _digest(sequence)


def _digest(sequence: Sequence) -> str:
    truth = {key: value for key, value in sequence.manifest.items() if key not in _NOT_DIGESTED}
    whole = hashlib.sha256(json.dumps(truth, sort_keys=True).encode() + b"\n")
    for name in sorted(hashes_in(sequence.manifest)):
        path = inside(sequence.folder, name)
        if not path.is_file():
            raise RsbenchError(f"{path}: is in sequence.json and not in the folder; generate the sequence again")
        try:
            whole.update(f"{sha256(path)}  {name}\n".encode())
        except OSError as error:
            raise RsbenchError(f"{path}: cannot be read: {error.strerror}") from error
    return whole.hexdigest()


def text_of(found: Mapping[str, str]) -> str:
    """Return a line for each sequence: digest, two spaces, name."""
    return "".join(f"{digest}  {name}\n" for name, digest in found.items())


def read_digests(path: Path) -> dict[str, str]:
    """Read a file written by ``text_of``; returns the digests by sequence name.

    Raises:
        RsbenchError: the file cannot be read, a line has another form, or a name is repeated.
    """
    known = dict[str, str]()
    for number, line in enumerate(read_text(path).splitlines(), 1):
        match = _LINE.fullmatch(line)
        if match is None or match[2] in known:
            raise RsbenchError(
                f"{path}: line {number}: {line[:80]!r}: must be a SHA-256, two spaces and a sequence's name, once"
            )
        known[match[2]] = match[1]
    return known


def differences(found: Mapping[str, str], known: Mapping[str, str]) -> list[str]:
    """Describe how a dataset differs from a file of digests, with a line for each differing sequence."""
    other = [
        f"{name}: {'has another digest' if name in known else 'is not in the file'}"
        for name, digest in found.items()
        if known.get(name) != digest
    ]
    return other + [f"{name}: is in the file and not in the dataset" for name in known if name not in found]


GREY, DEPTH = 0.1, 1e-4
"""Tolerances if bytes differ from the copy's: of the mean of the frame (grey levels) and of its median depth
(relative). With another vector width, one sample in a thousand falls beyond an edge: 0.02 levels."""
SIDE, FRAME = "left", 0
_FILES = tuple(
    name.format(f"{SIDE}_{FRAME}") for name in ("rs/{}.png", "rs_clean/{}.png", "rs_depth/{}.exr", "poses/{}.csv")
)


def references() -> dict[str, Path]:
    """Return the files of the reference copies by dataset name."""
    folder = shipped_folder("cards/references", "_cards/references")
    return {path.stem: path for path in sorted(folder.glob("*.json"))}


def record_of(folder: Path, hashes: Mapping[str, str]) -> dict[str, Any]:
    """Return what the file of a reference copy records about a sequence.

    Args:
        folder: folder of the sequence.
        hashes: SHA-256 of its files, by their paths below the folder.

    Returns:
        ``sha256`` of the hashes and paths of the first left frame's files; ``grey``, the mean of that frame, grey
        levels; ``depth``, the median of its depth, metres.
    """
    lines = [f"{hashes[name]}  {name}\n" for name in _FILES if name in hashes]
    depth = read_depth(inside(folder, _FILES[2]))
    return {
        "sha256": hashlib.sha256("".join(lines).encode()).hexdigest(),
        "grey": round(float(np.mean(read_png(inside(folder, _FILES[0])))), 4),
        "depth": round(float(np.median(depth[depth > 0])), 4),
    }


class Compared(NamedTuple):
    """A sequence compared with the reference copy."""

    name: str
    same: bool
    """Whether all bytes are equal."""
    fault: str = ""
    """The first difference beyond the tolerances, in one line; "" if there is none."""


def against_reference(folder: Path) -> Iterator[Compared]:
    """Compare each sequence of a dataset with the reference copy.

    Raises:
        RsbenchError: the dataset cannot be read, or has no reference copy.
    """
    name, known = read_dataset_manifest(folder).name, references()
    if name not in known:
        raise RsbenchError(f"{folder}: dataset {name!r} has no reference copy{choices(name, known)}")
    wanted = read_json(known[name])["sequences"]
    for sequence in read_dataset(folder):
        yield Compared(sequence.name, *_compared(sequence, wanted.get(sequence.name)))


def _compared(sequence: Sequence, wanted: dict[str, Any] | None) -> tuple[bool, str]:
    if wanted is None:
        return False, "the reference copy has no such sequence"
    own = record_of(sequence.folder, sequence.manifest["files"])
    if own["sha256"] == wanted["sha256"]:
        return True, ""
    for key, file, most in (("grey", _FILES[0], GREY), ("depth", _FILES[2], DEPTH * wanted["depth"])):
        if not abs(own[key] - wanted[key]) <= most:
            return False, f"{file}: {key} {own[key]:.6g}, in the reference copy {wanted[key]:.6g}"
    return False, ""
