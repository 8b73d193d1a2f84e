"""Verification of a dataset: every file is what the manifests say, and every channel agrees with the others."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from rsbench.cards import card_path
from rsbench.dataset.files import read_json
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.dataset.verification import structure
from rsbench.dataset.verification.content import Comparison, images_elsewhere, read_content, twin_faults
from rsbench.dataset.verification.findings import DepthAgreement, Progress, SequenceReport
from rsbench.dataset.verification.poses import pose_faults
from rsbench.dataset.verification.rerender import Again, Rerender
from rsbench.dataset.verification.sensors import sensor_faults
from rsbench.dataset.verification.shots import PAIRS
from rsbench.errors import RsbenchError

__all__ = [
    "DepthAgreement",
    "Rerender",
    "SequenceReport",
    "verification_steps",
    "verify_dataset",
    "verify_sequence",
]

_STEPS = 1 + len(PAIRS)
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
        scenes: cards of scenes that are not rsbench's own.

    Returns:
        One report per sequence; before them one named dataset.json where that has faults of its own.

    Raises:
        RsbenchError: no dataset.json, or one that is not a JSON object; no card of a scene where one was named.
    """
    manifest = read_json(folder / structure.DATASET)
    step = progress or (lambda name: None)
    faults = tuple(structure.dataset_faults(folder, manifest))
    reports = [SequenceReport(name=structure.DATASET, faults=faults)] if faults else []
    again = None if rerender == "no" else Again(rerender, [card_path("scenes", path) for path in scenes])
    for name in structure.sequence_names(manifest):
        reports.append(verify_sequence(folder, name, manifest, stride, step, again))
    return reports


def verification_steps(manifest: Mapping[str, Any]) -> int:
    """How often ``verify_dataset`` reports progress on the dataset of this dataset.json."""
    return _STEPS * len(structure.sequence_names(manifest))


def verify_sequence(
    folder: Path,
    name: str,
    manifest: Mapping[str, Any],
    stride: int = 1,
    step: Progress = lambda name: None,
    again: Again | None = None,
) -> SequenceReport:
    """Check one sequence of the dataset in ``folder``, whose dataset.json holds ``manifest``."""
    faults = list(structure.file_faults(folder, name, manifest.get("files")))
    agreements: list[DepthAgreement] = []
    notes: list[str] = []
    steps = _STEPS
    try:
        missing = {fault.removesuffix(": missing").removeprefix(f"{name}/") for fault in faults}
        sequence = read_sequence(folder / name)
        faults += structure.sequence_faults(sequence, name, structure.card_of(manifest))
        faults += pose_faults(sequence)
        content = read_content(sequence, missing)
        faults += [*content.faults, *twin_faults(content)]
        faults += sensor_faults(sequence, content.maps, content.pictures, missing)
        comparison = Comparison(content, stride)
        for agreement in comparison.pairs():
            agreements += [agreement] if agreement else []
            step(name)
            steps -= 1
        faults += comparison.faults(images_elsewhere(_others(folder, name, manifest)))
        if again is not None:
            found, note = again.check(content, {fault.partition(": ")[0] for fault in faults})
            faults += found
            notes.append(note)
    except RsbenchError as error:
        faults.append(str(error))
    for _ in range(steps):
        step(name)
    return SequenceReport(
        name=name, faults=tuple(dict.fromkeys(faults)), agreements=tuple(agreements), notes=tuple(notes)
    )


def _others(folder: Path, name: str, manifest: Mapping[str, Any]) -> list[Sequence]:
    found = []
    for other in structure.sequence_names(manifest):
        try:
            found += [read_sequence(folder / other)] if other != name else []
        except RsbenchError:
            continue
    return found[:_MOST_ELSEWHERE]
