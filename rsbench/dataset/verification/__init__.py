"""Verification of a dataset: every file is what the manifests say, and every channel agrees with the others."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rsbench import arguments
from rsbench.cards import card_path
from rsbench.dataset.files import read_json
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.dataset.verification import structure
from rsbench.dataset.verification.affine_checks import affine_faults
from rsbench.dataset.verification.channel_checks import channel_faults
from rsbench.dataset.verification.content import Comparison, Content, images_elsewhere, read_content, twin_faults
from rsbench.dataset.verification.findings import DepthAgreement, Progress, SequenceReport, finding
from rsbench.dataset.verification.hdr_checks import hdr_faults
from rsbench.dataset.verification.imu_checks import imu_faults
from rsbench.dataset.verification.landing import PAIRS
from rsbench.dataset.verification.match_checks import match_faults, matched_again
from rsbench.dataset.verification.poses import pose_faults
from rsbench.dataset.verification.rerender import Again, Rerender
from rsbench.dataset.verification.sensors import sensor_faults
from rsbench.dataset.verification.stacks import stack_faults
from rsbench.dataset.verification.surface_checks import surface_faults
from rsbench.dataset.verification.timing_checks import timing_faults
from rsbench.dataset.verification.track_checks import track_faults
from rsbench.dataset.verification.twin_checks import other_twin_faults, read_twins, with_twins
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
        ValueError: ``stride`` or ``rerender`` is none of the allowed.
        RsbenchError: no dataset.json, or one that is not a JSON object; no card of a scene where one was named.
    """
    arguments.check_whole("stride", stride, 1)
    arguments.check_one_of("rerender", rerender, ("no", "auto", "all"))
    manifest = read_json(folder / structure.DATASET)
    step = progress or (lambda name: None)
    listing = structure.Listing.of(folder, manifest)
    faults = tuple(structure.dataset_faults(listing))
    reports = [SequenceReport(name=structure.DATASET, faults=faults)] if faults else []
    again = None if rerender == "no" else Again(rerender, [card_path("scenes", path) for path in scenes])
    return reports + [verify_sequence(listing, name, stride, step, again) for name in listing.names]


def verification_steps(manifest: Mapping[str, Any]) -> int:
    """How often ``verify_dataset`` reports progress on the dataset of this dataset.json."""
    return _STEPS * len(structure.Listing.of(Path(), manifest).names)


def verify_sequence(
    listing: structure.Listing,
    name: str,
    stride: int = 1,
    step: Progress = lambda name: None,
    again: Again | None = None,
) -> SequenceReport:
    """Check one sequence of a dataset; the rest as of ``verify_dataset``."""
    faults = list(structure.file_faults(listing, name))
    agreements: list[DepthAgreement] = []
    notes: list[str] = []
    steps = _STEPS
    try:
        missing = {fault.removesuffix(": missing").removeprefix(f"{name}/") for fault in faults}
        sequence = read_sequence(listing.folder / name)
        faults += structure.sequence_faults(sequence, name, listing)
        faults += pose_faults(sequence)
        content = read_content(sequence, missing)
        faults += [*content.faults, *twin_faults(content)]
        faults += stack_faults(content, missing, stride)
        faults += sensor_faults(sequence, content.maps, content.pictures, missing)
        comparison = Comparison(content, stride)
        for agreement in comparison.pairs():
            agreements += [agreement] if agreement else []
            step(name)
            steps -= 1
        acquits = (lambda shot: False) if again is None else partial(again.is_right, content)
        faults += comparison.faults(images_elsewhere(partial(_others, listing, name)), acquits)
        notes += comparison.notes
        twins = read_twins(sequence, missing)
        faults += [*twins.faults, *other_twin_faults(content, twins, stride)]
        every = with_twins(content, twins)
        accused, cleared = _of_channels(every, stride, {*missing, *map(_file_of, faults)}, again)
        faults += accused
        notes += cleared
        if again is not None:
            other, note = again.check(every, {*missing, *map(_file_of, faults)})
            faults += other
            notes.append(note)
    except RsbenchError as error:
        faults.append(str(error))
    for _ in range(steps):
        step(name)
    return SequenceReport(
        name=name, faults=tuple(dict.fromkeys(faults)), agreements=tuple(agreements), notes=tuple(notes)
    )


def _of_channels(
    content: Content, stride: int, told: set[str], again: Again | None
) -> tuple[list[str], list[str]]:
    """Faults of channels, but for files that are told already; and notes: of the accused that are right, and more.

    Rays say nothing of what the pictures do not show, and so clear nobody of it.
    """
    faults: list[str] = []
    for found in _channel_checks(content, stride):
        faults += found({*told, *map(_file_of, faults)})
    unfound, notes = matched_again(content.sequence, {*told, *map(_file_of, faults)})
    cleared = again.cleared(content, set(map(_file_of, faults))) if again is not None and faults else set()
    notes += [finding(file, "others contradict it, and it is what is made again, all of it") for file in cleared]
    return [*(fault for fault in faults if _file_of(fault) not in cleared), *unfound], sorted(notes)


def _channel_checks(content: Content, stride: int) -> Iterator[Callable[[Collection[str]], Iterator[str]]]:
    """Each gives the faults of some channels, but for files that are told already."""
    sequence, maps = content.sequence, content.maps
    yield partial(timing_faults, sequence)
    yield partial(imu_faults, sequence)
    yield partial(channel_faults, sequence, maps, stride=stride)
    yield partial(track_faults, sequence, maps)
    yield partial(affine_faults, sequence, maps)
    yield partial(surface_faults, sequence, maps)
    yield partial(hdr_faults, sequence, content.pictures)
    yield partial(match_faults, sequence, maps)


def _file_of(fault: str) -> str:
    return fault.partition(": ")[0]


def _others(listing: structure.Listing, name: str) -> Iterator[Sequence]:
    """Some sequences, the nearest in the list first."""
    place = listing.names.index(name)
    near = sorted(range(len(listing.names)), key=lambda other: abs(other - place))[1 : _MOST_ELSEWHERE + 1]
    for other in near:
        with contextlib.suppress(RsbenchError):
            yield read_sequence(listing.folder / listing.names[other])
