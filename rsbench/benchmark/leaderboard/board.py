"""A board: a folder of scored entries, kept with their predictions, that two people can merge.

    board.json                                    the format
    <protocol>/<split>/split.json                 which split it is; facts of its problems where those are public
    <protocol>/<split>/entries/<method>/predictions.jsonl, scores.csv, entry.json
    <protocol>/<split>/entries/<method>/pictures/<problem>/NAME   depth maps or corrected frames, where asked
    <protocol>/<split>/entries/<method>/matches/NAME              matches of its own, where it has some

An entry is written under another name and renamed, so that it is there whole or not at all.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.answers import Header
from rsbench.benchmark.leaderboard.doubt import doubt_about
from rsbench.benchmark.leaderboard.exporting import split_record
from rsbench.benchmark.leaderboard.marking import mark_all
from rsbench.benchmark.leaderboard.picture_files import file_bytes
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import SUBMISSION_BYTES, Submission, read_submission
from rsbench.benchmark.leaderboard.track import Step
from rsbench.benchmark.leaderboard.track_list import TRACKS, track_of_id
from rsbench.components.cards import parse_card
from rsbench.core.errors import RsbenchError
from rsbench.jobs.workers import Workers
from rsbench.storage.files import read_table, write_json, write_table
from rsbench.storage.untrusted_files import NAME, read_bytes, read_json
from rsbench.storage.work_folder import work_folder

FORMAT = 1
RUN = "rsbench leaderboard run"
"""Entries that were made by it may be made again; what people handed in is not replaced in silence."""
ORACLES = "rsbench leaderboard oracles"
OWN = (RUN, ORACLES)
"""Commands whose entries a board makes itself."""
FILES = ("predictions.jsonl", "scores.csv", "entry.json")
"""Of an entry; the last one says of the others what they are."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What entry.json must hold; it holds more."""

    format: int
    header: Header
    predictions_sha256: str
    fingerprint: str
    """Of the split."""
    files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the pictures and matches of its answers, by their paths below the entry."""
    doubt: str = ""
    """Why it is not believed, see ``doubt.doubt_about``; empty where nothing speaks against it."""
    accepted: str = ""
    """Why the keeper of the board ranks it all the same."""
    made: dict[str, Any] = field(default_factory=dict)
    """How it came about; ``command`` tells."""


@dataclass(frozen=True, kw_only=True)
class About:
    """What split.json must hold; it holds more."""

    protocol: str
    split: str
    fingerprint: str
    facts: dict[str, dict[str, float | str]]
    """Of each problem; none where they are secret."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """An entry of a board."""

    folder: Path
    header: Header
    predictions_sha256: str
    scores: pd.DataFrame
    """One row for each problem, see ``marking.mark``."""
    files: dict[str, str]
    """SHA-256 of its pictures and matches, by paths below ``folder`` such as ``pictures/castle/left_1.exr``."""
    doubt: str
    """Why it has no rank; empty where it has one."""
    handed_in: bool
    """Whether the answers came as a file; else the board ran the method itself."""


def made_by(board: Path, split: Split, method: str) -> str:
    """The command that made an entry; ``RUN`` where there is none."""
    path = place(board, split.track.id, split.name) / "entries" / method / FILES[2]
    if not path.is_file():
        return RUN
    made = read_json(path).get("made")
    return str(made.get("command", "")) if isinstance(made, dict) else ""


def move_entry(new: Path, folder: Path) -> None:
    """Rename what was made aside to its place; what was there goes aside."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.is_symlink() or folder.exists():
        os.replace(folder, new.with_name(f"{new.name}~"))  # no name of an entry
    os.replace(new, folder)


def place(board: Path, protocol: str, split: str) -> Path:
    """Folder of a split."""
    return board / protocol / split


def open_board(board: Path) -> None:
    """Make a board of a folder that is empty or is one.

    Raises:
        RsbenchError: the folder holds something else.
    """
    path = board / "board.json"
    if path.is_file():
        _check_board(board)
        return
    if any(each.name != ".rsbench" for each in board.iterdir()):
        raise RsbenchError(f"{board}: is no board (no board.json) and not empty; choose another --board")
    write_json(path, {"format": FORMAT})


def _check_board(board: Path) -> None:
    path = board / "board.json"
    if not path.is_file():
        raise RsbenchError(f"{board}: is no board (no board.json); rsbench leaderboard submit makes one")
    if (found := read_json(path).get("format")) != FORMAT:
        raise RsbenchError(f"{path}: format = {found!r}: must be {FORMAT}")


def write_split(board: Path, split: Split) -> None:
    """The split.json of a board, with facts of the problems where those are public."""
    path = place(board, split.track.id, split.name) / "split.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = {truth.name: truth.facts for truth in split.truths} if split.public else {}
    write_json(path, {**split_record(split), "facts": facts})


def refuse_another(folder: Path, sha256: str, files: dict[str, str]) -> None:
    """Raises RsbenchError where an entry is there that has other predictions."""
    if not folder.is_dir():
        return
    there = read_json(folder / FILES[2])
    if (there.get("predictions_sha256"), there.get("files", {})) != (sha256, files):
        raise RsbenchError(
            f"{folder}: is an entry of that name with other predictions; rename the method, or replace the entry "
            "with --replace"
        )


def refuse_same_but_case(entries: Path, method: str) -> None:
    """Raises RsbenchError where an entry has the name in other case: one folder on some systems, two on others."""
    for folder in _folders(entries):
        if folder.name != method and folder.name.lower() == method.lower():
            raise RsbenchError(
                f"method = {method!r}: differs from the entry {folder.name!r} in case alone; rename it"
            )


# Reading


def splits_of(board: Path) -> list[tuple[str, str]]:
    """Protocols and names of the splits of a board, in the order of tracks.

    Raises:
        RsbenchError: it is no board.
    """
    _check_board(board)
    found: list[tuple[str, str]] = []
    for protocol in (track.id for track in TRACKS.values()):
        found += [(protocol, folder.name) for folder in _folders(board / protocol)]
    return found


def about_split(folder: Path) -> About:
    """What the split.json of a folder of a board says.

    Raises:
        RsbenchError: it is not there, or damaged.
    """
    path = folder / "split.json"
    if path.is_symlink() or not path.is_file():
        raise RsbenchError(f"{path}: must be a file of its own; submit an entry again, which makes it")
    return parse_card(About, read_json(path), str(path), extra="ignore")


def entries_of(board: Path, protocol: str, split: str) -> list[Scored]:
    """Entries of a split, by name.

    Raises:
        RsbenchError: an entry is damaged.
    """
    return [read_entry(folder) for folder in _folders(place(board, protocol, split) / "entries")]


def _folders(folder: Path) -> Iterator[Path]:
    """Folders below one whose names can be those of ours, sorted; links are none."""
    if folder.is_dir() and not folder.is_symlink():
        for path in sorted(folder.iterdir()):
            if NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                yield path


def read_entry(folder: Path) -> Scored:
    """An entry from its folder. Raises RsbenchError when it is damaged."""
    record = _read_record(folder)
    return Scored(
        folder=folder,
        header=record.header,
        predictions_sha256=record.predictions_sha256,
        scores=_read_scores(folder, record.header.protocol),
        files=record.files,
        doubt="" if record.accepted else record.doubt,
        handed_in=record.made.get("command") not in (RUN, ORACLES),
    )


def _read_record(folder: Path) -> Recorded:
    """What an entry says of itself, which must be true of where it lies and of its predictions."""
    for name in FILES:
        if (folder / name).is_symlink() or not (folder / name).is_file():
            raise RsbenchError(
                f"{folder / name}: must be a file of its own; remove the entry, and submit it again"
            )
    path = folder / FILES[2]
    record = parse_card(Recorded, read_json(path), str(path), extra="ignore")
    named = (record.header.protocol, record.header.split, record.header.method)
    if named != (folder.parents[2].name, folder.parents[1].name, folder.name):
        raise RsbenchError(f"{path}: header: names {'/'.join(named)}, which is not where it lies")
    record.header.check_uses(track_of_id(record.header.protocol), str(path))
    if hashlib.sha256(read_bytes(folder / FILES[0], SUBMISSION_BYTES)).hexdigest() != record.predictions_sha256:
        raise RsbenchError(
            f"{folder / FILES[0]}: has changed since it was scored; remove the entry, and submit it again"
        )
    return record


def _read_scores(folder: Path, protocol_id: str) -> pd.DataFrame:
    columns, track = ("problem", "scene", "success"), track_of_id(protocol_id)
    numbers = (*(score.key for score in track.scores), track.error)
    scores = read_table(folder / FILES[1], columns, numbers, dtype={"problem": str, "scene": str})
    shares = scores[list(track.of_kind("share"))].to_numpy()
    means = scores[list(track.of_kind("mean"))].to_numpy(dtype=np.float64)
    right = np.all((shares >= 0.0) & (shares <= 1.0)) and np.all(np.isfinite(means)) and not scores.empty
    if "nees" in scores and not pd.api.types.is_numeric_dtype(scores["nees"]):
        right = False
    if scores["problem"].duplicated().any() or not right:
        raise RsbenchError(f"{folder / FILES[1]}: is damaged; rsbench leaderboard rescore makes it again")
    return scores


# Scoring again


def check_files(folder: Path, files: dict[str, str], found: dict[str, str]) -> None:
    """Raises RsbenchError where the SHA-256 ``found`` of an entry's files are not those that it says."""
    for name, digest in files.items():
        if found[name] != digest:
            raise RsbenchError(
                f"{folder / name}: has changed since it was scored; remove the entry, and submit it again"
            )


def rescore(
    board: Path, split: Split, workers: Workers = 1, step: Step = lambda word: None
) -> dict[str, list[str]]:
    """Score the stored predictions of a split again; no method runs. ``workers`` and ``step``: see ``mark_all``.

    Returns:
        For each entry whose scores were others, the columns that changed; all of them where there was no table.

    Raises:
        RsbenchError: stored predictions are at fault, or not of the entry that they lie in.
    """
    changed: dict[str, list[str]] = {}
    _check_board(board)
    with work_folder(board):
        folders = list(_folders(place(board, split.track.id, split.name) / "entries"))
        stored = [_stored(folder, split) for folder in folders]
        for folder, scores in zip(folders, mark_all(stored, split, workers, step), strict=True):
            if isinstance(scores, RsbenchError):
                raise scores
            old = pd.DataFrame()
            with contextlib.suppress(RsbenchError):
                old = _read_scores(folder, split.track.id)
            write_table(folder / FILES[1], scores)
            _write_doubt(folder, doubt_about(scores, _read_record(folder).header, split))
            now = read_entry(folder).scores
            if columns := [str(name) for name in now if not now[name].equals(old.get(name, pd.Series()))]:
                changed[folder.name] = columns
    return changed


def accept(board: Path, protocol: str, split: str, method: str, reason: str) -> str:
    """Rank an entry that is in doubt, because the keeper of the board says so; returns the doubt.

    Raises:
        RsbenchError: there is no such entry, or nothing speaks against it.
    """
    folder = place(board, protocol, split) / "entries" / method
    if not folder.is_dir():
        raise RsbenchError(f"{folder}: is no entry; rsbench leaderboard show --board {board} lists them")
    with work_folder(board):
        record = _read_record(folder)
        if not record.doubt:
            raise RsbenchError(f"{folder}: nothing speaks against it; it has a rank")
        write_json(folder / FILES[2], {**read_json(folder / FILES[2]), "accepted": reason})
    return record.doubt


def _write_doubt(folder: Path, doubt: str) -> None:
    record = read_json(folder / FILES[2])
    if record.get("doubt", "") != doubt:
        write_json(folder / FILES[2], {**record, "doubt": doubt})


def _stored(folder: Path, split: Split) -> Submission:
    """The predictions of an entry, which must be those that were handed in."""
    record, path = _read_record(folder), folder / FILES[0]
    found = {name: hashlib.sha256(file_bytes(folder, name)).hexdigest() for name in record.files}
    check_files(folder, record.files, found)
    submission = read_submission(path, split)
    if submission.header != record.header:
        raise RsbenchError(f"{path}: its header is not that of {FILES[2]}; submit it again")
    return submission
