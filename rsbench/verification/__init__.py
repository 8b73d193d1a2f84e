"""Verification of a dataset: every file is what the manifests say, and every channel agrees with the others."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rsbench.components import arguments
from rsbench.components.cards import card_path
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.storage.files import read_json
from rsbench.verification import structure
from rsbench.verification.content import images_elsewhere
from rsbench.verification.findings import MISSING, DepthAgreement, Finding, Progress, SequenceReport, files_of
from rsbench.verification.imu_checks import imu_faults
from rsbench.verification.poses import pose_faults
from rsbench.verification.rerender import Again, Rerender
from rsbench.verification.timing_checks import timing_faults
from rsbench.verification.walk import STEPS, Walk

__all__ = [
    "DepthAgreement",
    "Finding",
    "Rerender",
    "SequenceReport",
    "verification_steps",
    "verify_dataset",
    "verify_sequence",
]

_MOST_ELSEWHERE = 8
"""Other sequences among whose images an exchanged one is looked for."""


def verify_dataset(
    folder: Path,
    stride: int = 1,
    progress: Progress | None = None,
    *,
    rerender: Rerender = "no",
    scenes: Collection[Path] = (),
) -> list[SequenceReport]:
    """Check every sequence of a dataset; faults are values, only an unreadable dataset raises.

    Args:
        folder: holds dataset.json.
        stride: compare every ``stride``-th pixel in both directions.
        progress: see ``Progress``; there are ``verification_steps`` in all.
        rerender: rows to render again where the scene can be built here.
        scenes: cards of scenes that are not rsbench's own, and mesh files of objects that move.

    Returns:
        One report per sequence; before them one named dataset.json where that has faults of its own.

    Raises:
        ValueError: ``stride`` or ``rerender`` is none of the allowed.
        RsbenchError: no dataset.json, or one that is not a JSON object; no card of a scene where one was named.
    """
    arguments.check_whole("stride", stride, 1)
    arguments.check_one_of("rerender", rerender, ("no", "auto", "all"))
    manifest = read_json(folder / structure.DATASET)
    step = progress or (lambda name: None)
    listing = structure.Listing.of(folder, manifest)
    faults = tuple(structure.dataset_faults(listing))
    reports = [SequenceReport(name=structure.DATASET, findings=faults)] if faults else []
    again = None if rerender == "no" else Again(rerender, *_cards_and_files(scenes))
    return reports + [verify_sequence(listing, name, stride, step, again) for name in listing.names]


def _cards_and_files(named: Collection[Path]) -> tuple[list[Path], list[Path]]:
    """Scene cards, and what is none by its name."""
    files = [path for path in named if path.suffix not in ("", ".toml")]
    return [card_path("scenes", path) for path in named if path not in files], files


def verification_steps(manifest: Mapping[str, Any]) -> int:
    """How often ``verify_dataset`` reports progress on the dataset of this dataset.json."""
    listing = structure.Listing.of(Path(), manifest)
    return _steps(listing) * len(listing.names)


def _steps(listing: structure.Listing) -> int:
    """Of each sequence."""
    frames = len(FRAMES) if isinstance(listing.card, Finding) else listing.card.frames
    return 1 + STEPS * (frames - 1)


def verify_sequence(
    listing: structure.Listing,
    name: str,
    stride: int = 1,
    step: Progress = lambda name: None,
    again: Again | None = None,
) -> SequenceReport:
    """Check one sequence of a dataset; the rest as of ``verify_dataset``."""
    faults = list(structure.file_faults(listing, name))
    walk: Walk | None = None
    steps = _steps(listing)

    def counted(sequence: str) -> None:
        nonlocal steps
        steps -= 1
        if steps >= 0:  # its frames may be more than the card says
            step(sequence)

    try:
        missing = {each.file.removeprefix(f"{name}/") for each in faults if each.words == MISSING}
        sequence = read_sequence(listing.folder / name)
        faults += structure.sequence_faults(sequence, name, listing)
        faults += pose_faults(sequence)
        faults += timing_faults(sequence, {*missing, *files_of(faults)})
        faults += imu_faults(sequence, {*missing, *files_of(faults)})
        elsewhere = images_elsewhere(sequence, partial(_others, listing, name))
        walk = Walk(sequence, missing, elsewhere, stride, again, faults)
        walk.go(counted)
    except RsbenchError as error:
        faults.append(Finding.of(error))
    for _ in range(steps):
        step(name)
    agreements, notes = ((), ()) if walk is None else (walk.agreements.values(), walk.notes)
    return SequenceReport(
        name=name,
        findings=tuple(dict.fromkeys(faults)),
        agreements=tuple(agreements),
        notes=tuple(notes),
    )


def _others(listing: structure.Listing, name: str) -> Iterator[Sequence]:
    """Some sequences, the nearest in the list first."""
    place = listing.names.index(name)
    near = sorted(range(len(listing.names)), key=lambda other: abs(other - place))[1 : _MOST_ELSEWHERE + 1]
    for other in near:
        with contextlib.suppress(RsbenchError):
            yield read_sequence(listing.folder / listing.names[other])
