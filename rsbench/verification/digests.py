"""Digests of a dataset: one SHA-256 for each sequence, of its files and of what sequence.json says of them."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.dataset.sequence_identity import hashes_in
from rsbench.storage.files import sha256
from rsbench.storage.untrusted_files import NAME, inside, read_text

_NOT_DIGESTED = ("made_by", "files")
"""Keys of sequence.json: versions, which may change while no byte of a file does, and hashes, taken here anew."""
_LINE = re.compile(rf"([0-9a-f]{{64}})  ({NAME.pattern})")


def digests(folder: Path) -> Iterator[tuple[str, str]]:
    """Name and digest of each sequence of a dataset, in its order.

    A digest is of the truth in sequence.json (motion, cameras, scene, renderer, seed), and of the path and content
    of each file that it lists: frames, depth, poses, channels. It knows no dates, versions or folders.

    Raises:
        RsbenchError: the dataset cannot be read, or has not a file that it lists.
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
    """A line for each sequence: digest, two spaces, name."""
    return "".join(f"{digest}  {name}\n" for name, digest in found.items())


def read_digests(path: Path) -> dict[str, str]:
    """Digests by the names of sequences, from a file of such lines.

    Raises:
        RsbenchError: it cannot be read, or a line is another.
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
    """What is other in a dataset than in a file of digests, a line for each sequence."""
    other = [
        f"{name}: {'has another digest' if name in known else 'is not in the file'}"
        for name, digest in found.items()
        if known.get(name) != digest
    ]
    return other + [f"{name}: is in the file and not in the dataset" for name in known if name not in found]
