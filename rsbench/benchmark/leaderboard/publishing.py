"""Secret test splits of rendered frames: public inputs, a commitment, and the truth from the secret text.

A hash of the text, the fingerprint of the split, and a hash of all files of the keeper's dataset are announced.
When the text is published afterwards, anyone can verify that it is the announced one, that it gives the same
motions, and, by rendering again, the same frames and depth.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from rsbench.benchmark.leaderboard.inputs import check_place, write_frames, write_inputs
from rsbench.benchmark.leaderboard.splits import truth_of
from rsbench.benchmark.leaderboard.track import Split, Track
from rsbench.components.cards import card_path, parse_card
from rsbench.core.errors import RsbenchError
from rsbench.dataset.card import DatasetCard
from rsbench.dataset.generation import generate_dataset
from rsbench.dataset.secret_split import Secret, secret_card, write_scenes
from rsbench.dataset.sequence import Sequence, read_dataset_manifest, sequence_of
from rsbench.scenes.load import read_scene_card
from rsbench.storage.files import sha256, write_json
from rsbench.storage.untrusted_files import read_json
from rsbench.storage.work_folder import HIDDEN, files_below, work_folder

ANNOUNCEMENT = "announcement.json"
SCENES, DATA = "scenes", "data"
"""Subfolders of the keeper's folder."""
FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Announcement:
    """The properties of a secret split that are published before anybody submits."""

    format: int
    card: str
    """Name of the dataset card, and the hash of its file."""
    card_sha256: str
    protocol: str
    split: str
    fingerprint: str
    commitment: str
    """Hash of the secret text."""
    truth: str
    """Hash of the names and hashes of all files of the keeper's dataset."""
    made_by: dict[str, str]
    """Versions that rendered it: other versions may round differently."""
    files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the public files."""


def secret_of(track: Track, text: Secret) -> Secret:
    """Return the text from which the split of a track is drawn. A track of the readout ratio has its own split,
    because the inputs of other tracks reveal the ratio."""
    return text if track.gives_readout else Secret(text.digest("track", track.name).hex())


def drawn_split(track: Track, card: str, text: Secret) -> Split:
    """Return the split that ``publish`` makes, from the text only, without rendering.

    Raises:
        RsbenchError: the truth of the track must be rendered; see also ``secret_card``.
    """
    if track.pictures or track.inputs.whole:
        raise RsbenchError(f"track {track.name!r}: its truth is rendered; name the keeper's folder with --keep")
    drawn = secret_card(card, secret_of(track, text))
    pairs = [pair for each in _sequences(drawn) for pair in each.pairs()]
    return Split(track=track, label=drawn.name, public=False, truths=tuple(map(truth_of, pairs)))


def _sequences(card: DatasetCard) -> list[Sequence]:
    """Return the sequences of a card as if they were read after rendering."""
    names = {each.scene for each in card.sequence}
    scenes = {name: read_scene_card(card_path("scenes", name))[0].name for name in names}
    manifests = [card.manifest_of(each) | {"scene": {"name": scenes[each.scene]}} for each in card.sequence]
    return [sequence_of(json.loads(json.dumps(each)), Path(each["name"], "sequence.json")) for each in manifests]


def publish(
    track: Track,
    card: str,
    text: Secret,
    keep: Path,
    out: Path,
    *,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> Announcement:
    """Render a secret split into the keeper's folder, and write its inputs and the announcement into another one.

    If ``out`` already has an announcement, all files must equal the announced ones to the last byte, which proves
    that the published split is the announced one.

    Args:
        track: a track of frames.
        card: name or path of a dataset card.
        text: the secret.
        keep: folder for the scene cards and the dataset, which ``verify`` checks; an interrupted run resumes
            there.
        out: folder for the public files.
        workers: processes.
        progress: as for ``generate_dataset``.

    Raises:
        RsbenchError: the card cannot make a secret split; a folder contains something else; another split was
            announced.
    """
    secret, data = secret_of(track, text), keep / DATA
    drawn = secret_card(card, secret, keep / SCENES)
    write_scenes(card, secret, keep / SCENES)
    generate_dataset(drawn, data, workers=workers, progress=progress)
    split = track.split(data, secret=True)
    made = _announcement(split, card, text, data)
    announced = read_announcement(out) if (out / ANNOUNCEMENT).exists() else None
    if announced is not None:
        _check_same(announced, made, "card_sha256", "commitment", "fingerprint", "truth")
    check_place(split, out)
    with work_folder(out):
        if track.gives_images:
            write_frames(split, out)
        write_inputs(split, track.problems(data, None, len(split.truths)), out)
        names = [name for name in files_below(out) if name != ANNOUNCEMENT and not name.startswith(HIDDEN)]
        made = replace(made, files={name: sha256(out / name) for name in sorted(names)})
        if announced is None:
            write_json(out / ANNOUNCEMENT, vars(made))
        else:
            _check_same(announced, made, "files")
    return made


def _announcement(split: Split, card: str, text: Secret, data: Path) -> Announcement:
    """Return the announcement, without the hashes of the public files."""
    first, path = read_dataset_manifest(data).sequences[0], card_path("datasets", card)
    return Announcement(
        format=FORMAT,
        card=path.stem,
        card_sha256=sha256(path),
        protocol=split.track.id,
        split=split.name,
        fingerprint=split.fingerprint,
        commitment=text.commitment,
        truth=truth_hash(data),
        made_by=read_json(data / first / "sequence.json")["made_by"],
    )


def truth_hash(data: Path) -> str:
    """Return the SHA-256 of the names and hashes of all files of a dataset; it does not depend on the folder."""
    listed = {name: file.sha256 for name, file in read_dataset_manifest(data).files.items()}
    return hashlib.sha256(json.dumps(listed, sort_keys=True).encode()).hexdigest()


def read_announcement(folder: Path) -> Announcement:
    """Read the announcement in a public folder.

    Raises:
        RsbenchError: it is missing or damaged.
    """
    path = folder / ANNOUNCEMENT
    if not path.is_file():
        raise RsbenchError(
            f"{folder}: has no {ANNOUNCEMENT}: give the folder that rsbench leaderboard publish wrote"
        )
    found = parse_card(Announcement, read_json(path), str(path), extra="ignore")
    if found.format != FORMAT:
        raise RsbenchError(f"{path}: format = {found.format}: this version reads {FORMAT}")
    return found


def announced_split(announced: Announcement, track: Track, card: str, text: Secret, keep: Path | None) -> Split:
    """Return the announced split with its truth, drawn again from the text or read from the folder ``keep``.

    Raises:
        RsbenchError: the text, the split or the keeper's files differ from the announced ones.
    """
    if text.commitment != announced.commitment:
        raise RsbenchError("--seed-file: its text is not the announced one; take the file that publish was given")
    split = drawn_split(track, card, text) if keep is None else track.split(keep / DATA, secret=True)
    found = replace(announced, fingerprint=split.fingerprint)
    _check_same(
        announced, found if keep is None else replace(found, truth=truth_hash(keep / DATA)), "truth", "fingerprint"
    )
    return split


def _check_same(announced: Announcement, found: Announcement, *names: str) -> None:
    """Raise RsbenchError if one of the named values differs from the announced one."""
    for name in names:
        if getattr(announced, name) != getattr(found, name):
            raise RsbenchError(
                f"{ANNOUNCEMENT}: {name}: differs from the announced one: another text, card or dataset, "
                f"or other versions than {announced.made_by}"
            )
