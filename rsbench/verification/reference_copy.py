"""A dataset of rsbench's own card against its reference copy: the same bytes, or alike on another processor.

``cards/references/NAME.json``, of ``benchmarks/reference_copy.py``, holds of each sequence of the copy a digest of
what the left camera sees at time 0, with its depth and poses, and two figures. What else a sequence has is made of
the same scene, seed and motion, and is held against these by the other checks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rsbench.components.cards import choices, shipped_folder
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_dataset, read_dataset_manifest
from rsbench.storage.files import read_depth, read_json, read_png
from rsbench.storage.untrusted_files import inside

GREY, DEPTH = 0.1, 1e-4
"""How far the mean of the frame (grey levels) and the median of its depth (relative) may be from the copy's where
bytes differ. On another vector width a sample in a thousand meets the other side of an edge: 0.02 levels."""
SIDE, FRAME = "left", 0
_FILES = tuple(
    name.format(f"{SIDE}_{FRAME}") for name in ("rs/{}.png", "rs_clean/{}.png", "rs_depth/{}.exr", "poses/{}.csv")
)


def references() -> dict[str, Path]:
    """Datasets with a reference copy, by name."""
    folder = shipped_folder("cards/references", "_cards/references")
    return {path.stem: path for path in sorted(folder.glob("*.json"))}


def record_of(folder: Path, hashes: Mapping[str, str]) -> dict[str, Any]:
    """What the file of a reference copy holds of a sequence.

    Args:
        folder: of the sequence.
        hashes: SHA-256 of its files, by their paths in it.

    Returns:
        ``sha256`` of the hashes and paths of what the left camera sees; ``grey``, the mean of the frame, levels;
        ``depth``, the median of its depth, metres.
    """
    lines = [f"{hashes[name]}  {name}\n" for name in _FILES if name in hashes]
    depth = read_depth(inside(folder, _FILES[2]))
    return {
        "sha256": hashlib.sha256("".join(lines).encode()).hexdigest(),
        "grey": round(float(np.mean(read_png(inside(folder, _FILES[0])))), 4),
        "depth": round(float(np.median(depth[depth > 0])), 4),
    }


class Compared(NamedTuple):
    """A sequence and that of the reference copy."""

    name: str
    same: bool
    """Whether all bytes are equal."""
    fault: str = ""
    """What is not even alike, in one line."""


def against_reference(folder: Path) -> Iterator[Compared]:
    """Each sequence of a dataset and that of its reference copy.

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
