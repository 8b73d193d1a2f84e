"""dataset.json: the card of a dataset and the files of all of its sequences."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.core.version import __version__
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.croissant import CROISSANT, croissant_of
from rsbench.dataset.sequence import FORMAT, UNITS
from rsbench.storage.files import HashedFile, sha256, write_json
from rsbench.storage.untrusted_files import read_bytes

DATASET = "dataset.json"
Files = dict[str, HashedFile]
"""The files of a sequence by their paths below its folder, in the order of dataset.json."""


def write_manifest(card: DatasetCard, out: Path, made: Mapping[str, Files]) -> None:
    """Write dataset.json and croissant.json where they do not say this already; ``made``: files of sequences."""
    content = manifest_of(card, made)
    _write(out / DATASET, content)
    _write(out / CROISSANT, croissant_of(content, sha256(out / DATASET)))


def _write(path: Path, content: dict[str, Any]) -> None:
    try:
        stands = says(read_bytes(path), content)
    except RsbenchError:
        stands = False
    if not stands:
        write_json(path, content)


def manifest_of(card: DatasetCard, made: Mapping[str, Files]) -> dict[str, Any]:
    """The content of dataset.json; ``made`` as of ``write_manifest``."""
    files = {
        f"{sequence.name}/{name}": {"sha256": file.sha256, "size": file.size}
        for sequence in card.sequence
        for name, file in made[sequence.name].items()
    }
    return {
        "format": FORMAT,
        "name": card.name,
        "description": card.description,
        "license": card.license,
        "rsbench": __version__,
        "mitsuba": version("mitsuba"),
        "units": UNITS,
        "card": _record(card),
        "sequences": [sequence.name for sequence in card.sequence],
        "files": files,
    }


def says(data: bytes, content: dict[str, Any]) -> bool:
    """Whether a file holds this already; to read millions of lines is much faster than to write them."""
    try:
        return bool(json.loads(data) == json.loads(json.dumps(content)))
    except (ValueError, RecursionError):
        return False


def _record(card: DatasetCard) -> dict[str, Any]:
    """The card, complete; two frames are told by nothing, as before there could be more."""
    own = asdict(card)
    return own if card.frames > len(FRAMES) else {key: value for key, value in own.items() if key != "frames"}
