"""dataset.json: the card of a dataset and the files of all of its sequences."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rsbench import __version__
from rsbench.core.rig import FRAMES
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.files import read_json, write_json
from rsbench.dataset.hashes import HashedFile
from rsbench.dataset.sequence import FORMAT, UNITS
from rsbench.errors import RsbenchError

Files = dict[str, HashedFile]
"""The files of a sequence by their paths below its folder, in the order of dataset.json."""


def write_manifest(card: DatasetCard, out: Path, made: Mapping[str, Files]) -> None:
    """Write dataset.json, unless it says this already; ``made``: the files of each sequence."""
    files = {
        f"{sequence.name}/{name}": {"sha256": file.sha256, "size": file.size}
        for sequence in card.sequence
        for name, file in made[sequence.name].items()
    }
    content = {
        "format": FORMAT,
        "name": card.name,
        "description": card.description,
        "rsbench": __version__,
        "mitsuba": version("mitsuba"),
        "units": UNITS,
        "card": _record(card),
        "sequences": [sequence.name for sequence in card.sequence],
        "files": files,
    }
    if not _stands(out / "dataset.json", content):
        write_json(out / "dataset.json", content)


def _record(card: DatasetCard) -> dict[str, Any]:
    """The card, complete; two frames are told by nothing, as before there could be more."""
    own = asdict(card)
    return own if card.frames > len(FRAMES) else {key: value for key, value in own.items() if key != "frames"}


def _stands(path: Path, content: dict[str, Any]) -> bool:
    """Whether a file holds this already; to read millions of lines is much faster than to write them."""
    try:
        return read_json(path) == json.loads(json.dumps(content))
    except RsbenchError:
        return False
