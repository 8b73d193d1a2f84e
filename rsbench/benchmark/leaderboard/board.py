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
import dataclasses
import hashlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.answers import Header
from rsbench.benchmark.leaderboard.exporting import split_record
from rsbench.benchmark.leaderboard.marking import mark
from rsbench.benchmark.leaderboard.own_matches import FOLDER as MATCHES
from rsbench.benchmark.leaderboard.own_matches import match_files
from rsbench.benchmark.leaderboard.picture_files import FOLDER as PICTURES
from rsbench.benchmark.leaderboard.picture_files import copy_files, file_bytes, find_picture
from rsbench.benchmark.leaderboard.protocols import PROTOCOLS, protocol_of_id
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import SUBMISSION_BYTES, Submission, read_submission
from rsbench.cards import parse_card
from rsbench.dataset.files import read_table, write_bytes, write_json, write_table
from rsbench.dataset.workplace import WORK, workplace
from rsbench.errors import RsbenchError
from rsbench.pipeline.crew import Workers
from rsbench.reading import NAME, read_bytes, read_json

FORMAT = 1
RUN = "rsbench leaderboard run"
"""Entries that were made by it may be made again; what people handed in is not replaced in silence."""
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


def add(
    board: Path,
    predictions: Path,
    split: Split,
    made: dict[str, Any],
    *,
    replace: bool = False,
    workers: Workers = 1,
) -> Scored:
    """Score a file of predictions and keep both.

    Args:
        made: how it came about, for entry.json.
        replace: whether an entry of that name may be replaced.
        workers: see ``mark``.

    Raises:
        RsbenchError: the file is at fault; an entry of that name has other predictions; the board cannot be
            written, or another command is at work there.
    """
    submission, data = read_submission(predictions, split), read_bytes(predictions)
    with workplace(board) as hidden:
        _open(board)
        folder = place(board, split.protocol.id, split.name) / "entries" / submission.header.method
        new = hidden / WORK / "entry"
        kept = copy_files(submission.folder, _files_of(submission, split), new)
        if not replace:
            _refuse_another(folder, hashlib.sha256(data).hexdigest(), kept)
        _write_split(board, split)
        submission = dataclasses.replace(submission, folder=new)
        _put(new, folder, _contents(submission, data, split, made, kept, workers))
    return _read_entry(folder)


def add_texts(board: Path, texts: Sequence[str], split: Split, made: dict[str, Any]) -> None:
    """``add`` for predictions that are no files yet; entries of their names are replaced."""
    with tempfile.TemporaryDirectory() as folder:
        for text in texts:
            path = Path(folder) / "predictions.jsonl"
            write_bytes(path, text.encode())
            add(board, path, split, made, replace=True)


def made_by(board: Path, split: Split, method: str) -> str:
    """The command that made an entry; ``RUN`` where there is none."""
    path = place(board, split.protocol.id, split.name) / "entries" / method / FILES[2]
    if not path.is_file():
        return RUN
    made = read_json(path).get("made")
    return str(made.get("command", "")) if isinstance(made, dict) else ""


def _files_of(submission: Submission, split: Split) -> Iterator[str]:
    """Paths of all that the answers hold beside their file."""
    if split.protocol.own_matches:
        yield from (f"{MATCHES}/{name}" for name in match_files(submission.folder))
    for truth in split.truths:
        answer = submission.answers.get(truth.name)
        if truth.pictures is not None and answer is not None and answer.success:
            for asked in truth.pictures.asked:
                found = find_picture(submission.folder / PICTURES, truth.name, asked, split.protocol.asks)
                yield f"{PICTURES}/{truth.name}/{found.name}"


def _contents(
    submission: Submission,
    data: bytes,
    split: Split,
    made: dict[str, Any],
    files: dict[str, str],
    workers: Workers,
) -> tuple[bytes, pd.DataFrame, dict[str, Any]]:
    record: dict[str, Any] = {
        "format": FORMAT,
        "header": asdict(submission.header),
        "predictions_sha256": hashlib.sha256(data).hexdigest(),
        "fingerprint": split.fingerprint,
        **({"files": files} if files else {}),
        "made": made,
    }
    return data, mark(submission, split, workers), record


def _put(new: Path, folder: Path, contents: tuple[bytes, pd.DataFrame, dict[str, Any]]) -> None:
    """Write an entry aside, and rename it to its place."""
    data, scores, record = contents
    new.mkdir(parents=True, exist_ok=True)
    write_bytes(new / FILES[0], data)
    write_table(new / FILES[1], scores)
    write_json(new / FILES[2], record)
    _move(new, folder)


def _move(new: Path, folder: Path) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.is_symlink() or folder.exists():
        os.replace(folder, new.with_name(f"{new.name}~"))  # no name of an entry
    os.replace(new, folder)


def place(board: Path, protocol: str, split: str) -> Path:
    """Folder of a split."""
    return board / protocol / split


def _open(board: Path) -> None:
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


def _write_split(board: Path, split: Split) -> None:
    path = place(board, split.protocol.id, split.name) / "split.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = {truth.name: truth.facts for truth in split.truths} if split.public else {}
    write_json(path, {**split_record(split), "facts": facts})


def _refuse_another(folder: Path, sha256: str, files: dict[str, str]) -> None:
    if not folder.is_dir():
        return
    there = read_json(folder / FILES[2])
    if (there.get("predictions_sha256"), there.get("files", {})) != (sha256, files):
        raise RsbenchError(
            f"{folder}: is an entry of that name with other predictions; rename the method, or replace the entry "
            "with --replace"
        )


# Reading


def splits_of(board: Path) -> list[tuple[str, str]]:
    """Protocols and names of the splits of a board, in the order of tracks.

    Raises:
        RsbenchError: it is no board.
    """
    _check_board(board)
    found: list[tuple[str, str]] = []
    for protocol in (each.id for each in PROTOCOLS.values()):
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
    return [_read_entry(folder) for folder in _folders(place(board, protocol, split) / "entries")]


def _folders(folder: Path) -> Iterator[Path]:
    """Folders below one whose names can be those of ours, sorted; links are none."""
    if folder.is_dir() and not folder.is_symlink():
        for path in sorted(folder.iterdir()):
            if NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                yield path


def _read_entry(folder: Path) -> Scored:
    record = _read_record(folder)
    return Scored(
        folder=folder,
        header=record.header,
        predictions_sha256=record.predictions_sha256,
        scores=_read_scores(folder, record.header.protocol),
        files=record.files,
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
    if hashlib.sha256(read_bytes(folder / FILES[0], SUBMISSION_BYTES)).hexdigest() != record.predictions_sha256:
        raise RsbenchError(
            f"{folder / FILES[0]}: has changed since it was scored; remove the entry, and submit it again"
        )
    return record


def _read_scores(folder: Path, protocol_id: str) -> pd.DataFrame:
    columns, protocol = ("problem", "scene", "success"), protocol_of_id(protocol_id)
    numbers = (*(score.key for score in protocol.scores), protocol.error)
    scores = read_table(folder / FILES[1], columns, numbers, dtype={"problem": str, "scene": str})
    shares = scores[list(protocol.of_kind("share"))].to_numpy()
    if scores["problem"].duplicated().any() or not np.all((shares >= 0.0) & (shares <= 1.0)):
        raise RsbenchError(f"{folder / FILES[1]}: is damaged; rsbench leaderboard rescore makes it again")
    return scores


# Merging, and scoring again


def merge(other: Path, board: Path) -> list[str]:
    """Copy the entries of another board that are not here yet; returns what was copied.

    Scores are copied as they are: ``rescore`` tells whether the truth agrees.

    Raises:
        RsbenchError: an entry of one name has two predictions; one of the boards is none, or damaged.
    """
    theirs = [
        (scored, place(board, protocol, split) / "entries" / scored.header.method)
        for protocol, split in splits_of(other)
        for scored in entries_of(other, protocol, split)
    ]
    told = {scored.folder.parents[1]: about_split(scored.folder.parents[1]) for scored, _ in theirs}
    copied = []
    with workplace(board) as hidden:
        _open(board)
        for scored, folder in theirs:
            _refuse_another(folder, scored.predictions_sha256, scored.files)
        for number, (scored, folder) in enumerate(theirs):
            if not folder.exists():
                new = hidden / WORK / str(number)
                _copy(scored, new)
                about = folder.parents[1] / "split.json"
                if not about.exists():
                    about.parent.mkdir(parents=True, exist_ok=True)
                    write_json(about, asdict(told[scored.folder.parents[1]]))
                _move(new, folder)
                copied.append("/".join(folder.parts[-4:-2]) + f"/{folder.name}")
    return copied


def _copy(scored: Scored, new: Path) -> None:
    """An entry of another board, and nothing else that lies in its folder."""
    new.mkdir(parents=True)
    for name in FILES:
        write_bytes(new / name, read_bytes(scored.folder / name))
    _check_files(scored.folder, scored.files, copy_files(scored.folder, scored.files, new))


def _check_files(folder: Path, files: dict[str, str], found: dict[str, str]) -> None:
    for name, digest in files.items():
        if found[name] != digest:
            raise RsbenchError(
                f"{folder / name}: has changed since it was scored; remove the entry, and submit it again"
            )


def rescore(board: Path, split: Split, workers: Workers = 1) -> dict[str, list[str]]:
    """Score the stored predictions of a split again; no method runs. ``workers``: see ``mark``.

    Returns:
        For each entry whose scores were others, the columns that changed; all of them where there was no table.

    Raises:
        RsbenchError: stored predictions are at fault, or not of the entry that they lie in.
    """
    changed: dict[str, list[str]] = {}
    _check_board(board)
    with workplace(board):
        for folder in _folders(place(board, split.protocol.id, split.name) / "entries"):
            record, path, old = _read_record(folder), folder / FILES[0], pd.DataFrame()
            with contextlib.suppress(RsbenchError):
                old = _read_scores(folder, split.protocol.id)
            stored = {name: hashlib.sha256(file_bytes(folder, name)).hexdigest() for name in record.files}
            _check_files(folder, record.files, stored)
            submission = read_submission(path, split)
            if submission.header != record.header:
                raise RsbenchError(f"{path}: its header is not that of {FILES[2]}; submit it again")
            write_table(folder / FILES[1], mark(submission, split, workers))
            now = _read_entry(folder).scores
            if columns := [str(name) for name in now if not now[name].equals(old.get(name, pd.Series()))]:
                changed[folder.name] = columns
    return changed
