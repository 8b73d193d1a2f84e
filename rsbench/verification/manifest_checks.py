"""Check dataset.json, its card, each sequence.json and the folders against each other."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from reprlib import repr as shortened
from typing import Any

from rsbench.components.cards import list_cards, load_card, parse_card
from rsbench.core.errors import RsbenchError
from rsbench.core.version import __version__
from rsbench.dataset.card import DatasetCard, SequenceCard
from rsbench.dataset.manifest import CROISSANT, DATASET, croissant_of, says
from rsbench.dataset.sequence import FORMATS, UNITS, Sequence, files_of, format_of, sequence_manifest
from rsbench.renderers.options import RendererOptions
from rsbench.scenes.load import read_scene_card
from rsbench.storage.files import read_json, sha256
from rsbench.storage.untrusted_files import NAME, inside, read_bytes
from rsbench.storage.work_folder import files_below
from rsbench.verification.findings import MISSING, Finding

_TEXTS = ("name", "description", "rsbench", "mitsuba")
_MOST_NAMES = 5
"""Number of files that one finding names."""
MOST_MISSING = 100
"""Number of sequences without a folder that are reported one by one."""
_SAME = 1e-12
"""Relative tolerance of numbers that were computed from the same card: a thousand rounding errors."""


@dataclass(frozen=True, eq=False)
class Listing:
    """The content of a dataset.json, sorted once for all of its sequences."""

    folder: Path
    manifest: Mapping[str, Any]
    card: DatasetCard | Finding
    """The card, or a finding if it cannot be parsed."""
    names: tuple[str, ...]
    """Valid names of sequences, each once; none leads out of the dataset's folder."""
    files: Mapping[str, Mapping[str, object]]
    """Entries of ``files`` by sequence name, then by path below the sequence's folder."""
    planned: Mapping[str, SequenceCard]
    """Sequences of the card by name."""

    @classmethod
    def of(cls, folder: Path, manifest: Mapping[str, Any]) -> Listing:
        card = _card_of(manifest)
        names, files = manifest.get("sequences"), manifest.get("files")
        good = [name for name in names if is_name(name)] if isinstance(names, list) else []
        below: dict[str, dict[str, object]] = {name: {} for name in good}
        for path, entry in files.items() if isinstance(files, dict) else ():
            name, _, relative = path.partition("/")
            if name in below and _stays_inside(path):
                below[name][relative] = entry
        made = {} if isinstance(card, Finding) else {sequence.name: sequence for sequence in card.sequence}
        return cls(folder, manifest, card, tuple(below), below, made)


def is_name(name: object) -> bool:
    """Return whether a card may give this name to a sequence; such a name is never a path."""
    return isinstance(name, str) and NAME.fullmatch(name) is not None


def dataset_faults(listing: Listing) -> Iterator[Finding]:
    """Find faults of dataset.json as a whole."""
    manifest, card = listing.manifest, listing.card
    if manifest.get("format") not in FORMATS or isinstance(manifest.get("format"), bool):
        yield Finding(DATASET, f"format = {manifest.get('format')!r}: {FORMATS[0]} or {FORMATS[1]} is needed")
    for key in _TEXTS:
        if not isinstance(manifest.get(key), str):
            yield Finding(DATASET, f"{key} = {manifest.get(key)!r}: a text is needed")
    if manifest.get("units") != UNITS:
        yield Finding(DATASET, f"units = {manifest.get('units')!r}: {UNITS} is needed")
    yield from _name_faults(manifest.get("sequences"))
    yield from _listing_faults(listing)
    yield from _croissant_faults(listing)
    if isinstance(card, Finding):
        yield card
        return
    for key, value in (("name", card.name), ("description", card.description), ("license", card.license)):
        if manifest.get(key, card.license) != value:  # data of rsbench 0.1 do not name their licence
            yield Finding(DATASET, f"{key} = {manifest.get(key)!r}, its card says {value!r}")
    kind = max(format_of(card.rig_of(each), card.shutter_for(each)) for each in card.sequence)
    if manifest.get("format") in FORMATS and manifest["format"] != kind:
        yield Finding(DATASET, f"format = {manifest['format']}, its card makes {kind}")
    made = [sequence.name for sequence in card.sequence]
    if manifest.get("sequences") != made:
        yield Finding(
            DATASET, f"sequences = {shortened(manifest.get('sequences'))}, its card makes {shortened(made)}"
        )


def _name_faults(names: object) -> Iterator[Finding]:
    if not isinstance(names, list) or not names:
        yield Finding(DATASET, f"sequences = {names!r}: a list of names is needed")
        return
    wrong = [shortened(name) for name in names if not is_name(name)]
    if wrong:
        yield Finding(DATASET, f"sequences: not the name of a folder in it: {_some(wrong)}")
    twice = [shortened(name) for name, count in Counter(map(str, names)).items() if count > 1]
    if twice:
        yield Finding(DATASET, f"sequences: named twice: {_some(twice)}")


def missing_sequences(listing: Listing) -> dict[str, Finding | None]:
    """Find sequences without a folder, or with an empty one, in the order of the list.

    The first ``MOST_MISSING`` have a finding each; the last of these gives the number of the others.
    """
    found: dict[str, Finding | None] = dict.fromkeys(name for name in listing.names if _is_empty(listing, name))
    more = len(found) - MOST_MISSING
    for number, name in enumerate(islice(found, MOST_MISSING), start=1):
        rest = f"; {more} more sequences of {DATASET} are missing likewise" if more > 0 else ""
        words = f"{MISSING}: no such folder in the dataset, or an empty one"
        found[name] = Finding(f"{name}/", words + (rest if number == MOST_MISSING else ""))
    return found


def _is_empty(listing: Listing, name: str) -> bool:
    try:
        with os.scandir(f"{listing.folder}/{name}") as entries:
            return next(entries, None) is None
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False  # the reader says why


def _listing_faults(listing: Listing) -> Iterator[Finding]:
    """Compare ``files`` with the sequences and the disk; the content of files is checked with their sequence."""
    folder, files = listing.folder, listing.manifest.get("files")
    if not isinstance(files, dict):
        yield Finding(DATASET, f"files = {files!r}: a table of paths is needed")
        return
    strange = [path for path in files if path.partition("/")[0] not in listing.files or not _stays_inside(path)]
    if strange:
        yield Finding(DATASET, f"files lists what belongs to none of its sequences: {_some(strange)}")
    there = {path for path in files_below(folder) if not _hidden(Path(path))}
    extra = sorted(there - {DATASET, CROISSANT, *files})
    if extra:
        yield Finding(DATASET, f"lies there but is not listed in files: {_some(extra)}")


def _croissant_faults(listing: Listing) -> Iterator[Finding]:
    """Compare croissant.json with dataset.json, if it exists and this version of rsbench made the dataset."""
    path = listing.folder / CROISSANT
    if not path.is_file() or listing.manifest.get("rsbench") != __version__:
        return
    try:
        wanted = croissant_of(listing.manifest, sha256(listing.folder / DATASET))
        if not says(read_bytes(path), wanted):
            yield Finding(CROISSANT, f"does not describe {DATASET}: run rsbench generate again, which writes it")
    except (RsbenchError, KeyError, TypeError, ValueError):
        yield Finding(CROISSANT, f"cannot be compared with {DATASET}, which lacks what it describes")


def _stays_inside(path: str) -> bool:
    return (
        not {"", ".", ".."} & set(path.split("/")) and not PurePosixPath(path).is_absolute() and "\\" not in path
    )


def _hidden(path: Path) -> bool:
    """Return whether a part starts with a dot: files of the system or a running job, which no reader opens."""
    return any(part.startswith(".") for part in path.parts)


def _some(names: list[str]) -> str:
    left = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {left} more" if left > 0 else "")


def _card_of(manifest: Mapping[str, Any]) -> DatasetCard | Finding:
    """Parse the card of dataset.json; return a finding if it cannot be parsed."""
    card = manifest.get("card")
    if not isinstance(card, dict):
        return Finding(DATASET, f"card = {card!r}: the card of the dataset is needed")
    try:
        return parse_card(DatasetCard, card, f"{DATASET}: card")
    except RsbenchError as error:
        return Finding.of(error)


def file_faults(listing: Listing, name: str) -> Iterator[Finding]:
    """Check that the files of a sequence exist, are listed in both manifests, and match their checksums."""
    folder, listed, below = listing.folder, listing.files[name], f"{name}/"
    own, needed, fault = _own_files(folder / name)
    if fault:
        yield fault
    for relative in sorted({"sequence.json", *needed, *own, *listed}):
        entry = listed.get(relative)
        if relative not in own and relative != "sequence.json" and not fault:
            yield Finding(f"{below}sequence.json", f"files does not list {relative}")
        if entry is None and (own or not fault):
            yield Finding(below + relative, "not listed in dataset.json")
        elif entry is not None:
            yield from _content_faults(folder, below + relative, entry, own.get(relative))


def _own_files(folder: Path) -> tuple[dict[str, object], tuple[str, ...], Finding | None]:
    """Return ``files`` of a sequence.json, the files that it must have, and a finding if it is faulty."""
    try:
        manifest = read_json(inside(folder, "sequence.json"))
    except RsbenchError as error:
        return {}, (), Finding.of(error)
    files, needed = manifest.get("files"), files_of(manifest)
    if not isinstance(files, dict) or not files:
        return (
            {},
            needed,
            Finding(f"{folder.name}/sequence.json", f"files = {files!r}: a table of sha256 is needed"),
        )
    strange = [path for path in files if not _stays_inside(path)]
    if strange:
        fault = Finding(f"{folder.name}/sequence.json", f"files lists paths that leave it: {_some(strange)}")
        return {path: digest for path, digest in files.items() if path not in strange}, needed, fault
    return files, needed, None


def _content_faults(folder: Path, name: str, entry: object, own: object) -> Iterator[Finding]:
    try:
        path = inside(folder, name)
    except RsbenchError as error:
        yield Finding.of(error)
        return
    if not path.is_file():
        yield Finding(name, MISSING)
        return
    if not isinstance(entry, dict) or not isinstance(entry.get("size"), int) or "sha256" not in entry:
        yield Finding(DATASET, f"files: {name} = {entry!r}: size and sha256 are needed")
        return
    size = path.stat().st_size
    digest = sha256(path) if size == entry["size"] else ""
    if digest != entry["sha256"]:
        what = f"content differs from its checksum in {DATASET}"
        yield Finding(name, what if digest else f"{what}: {size} bytes, it says {entry['size']}")
    elif own is not None and digest != own:
        yield Finding(name, f"content differs from its checksum in {name.partition('/')[0]}/sequence.json")


def sequence_faults(sequence: Sequence, name: str, listing: Listing) -> Iterator[Finding]:
    """Check that sequence.json is consistent with itself, its folder's name and the card."""
    file, manifest = "sequence.json", sequence.manifest
    expected = sequence_manifest(
        name=name,
        rig=sequence.rig,
        shutter=sequence.shutter,
        motion=sequence.motion,
        frame_period_s=sequence.frame_period_s,
        frames=sequence.frames,
        moves=bool(sequence.moving),
    )
    for key, value in expected.items():
        if not _equal(manifest.get(key), value):
            yield Finding(file, f"{key} = {manifest.get(key)!r}, the rest of it makes {value!r}")
    if not 0 < sequence.frame_period_s < math.inf:
        yield Finding(file, f"frame_period_s = {sequence.frame_period_s}: a positive number is needed")
    made_by = manifest.get("made_by")
    for key in ("rsbench", "mitsuba", "drjit", "variant"):
        if not isinstance(made_by, dict) or not isinstance(made_by.get(key), str):
            yield Finding(file, f"made_by: {key} is missing")
    if isinstance(listing.card, DatasetCard) and name in listing.planned:
        yield from _card_faults(manifest, listing.card, listing.planned[name])


def _card_faults(manifest: Mapping[str, Any], card: DatasetCard, sequence: SequenceCard) -> Iterator[Finding]:
    """Compare sequence.json with its card, as far as that is possible without building the scene."""
    made = manifest.get("made_by")
    same_version = isinstance(made, dict) and made.get("rsbench") == __version__
    planned = dict.fromkeys(
        ("sensor", "channels", "imu", "twins", "exposed_twins", "frames", "moving")
    ) | card.manifest_of(sequence)
    planned["seed"] = card.seed_of(sequence)
    start = None if sequence.start is None else asdict(sequence.start)
    scene: dict[str, Any] = {"viewpoint": sequence.viewpoint, "start": start}
    # The built-in cards of another version may have other values.
    if same_version and sequence.scene in list_cards("scenes"):
        built_in, _ = read_scene_card(list_cards("scenes")[sequence.scene])
        scene |= {"name": built_in.name}
        if sequence.viewpoint in built_in.viewpoints:
            scene |= asdict(built_in.viewpoints[sequence.viewpoint])
    options: dict[str, Any] = {}
    if same_version and card.renderer in list_cards("renderers"):
        options = load_card(RendererOptions, "renderers", card.renderer).record
        # `generate --full-frames` replaces these two.
        options = {key: value for key, value in options.items() if key not in ("method", "full_frames")}
    for key, value in planned.items():
        if not _equal(manifest.get(key), value):
            yield Finding("sequence.json", f"{key} = {manifest.get(key)!r}, the card in {DATASET} makes {value!r}")
    for table, wanted in (("scene", scene), ("renderer", options)):
        stored = manifest.get(table)
        if not isinstance(stored, dict):
            yield Finding("sequence.json", f"{table} = {stored!r}: a table is needed")
            continue
        for key, value in wanted.items():
            if not _equal(stored.get(key), value):
                what = f"{table}.{key} = {stored.get(key)!r}, the card in {DATASET} makes {value!r}"
                yield Finding("sequence.json", what)


def _equal(stored: object, expected: object) -> bool:
    """Return whether a JSON value equals an expected one, numbers up to rounding; a boolean is not a number."""
    if isinstance(expected, Mapping):
        if not isinstance(stored, Mapping) or stored.keys() != expected.keys():
            return False
        return all(_equal(stored[key], value) for key, value in expected.items())
    if isinstance(expected, (list, tuple)):
        return isinstance(stored, list) and len(stored) == len(expected) and all(map(_equal, stored, expected))
    if isinstance(expected, bool) or isinstance(stored, bool) or not isinstance(expected, int | float):
        return type(stored) is type(expected) and stored == expected
    return isinstance(stored, int | float) and math.isclose(stored, expected, rel_tol=_SAME, abs_tol=1e-15)
