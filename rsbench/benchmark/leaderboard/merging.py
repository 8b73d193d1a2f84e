"""Merge two boards."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rsbench.benchmark.leaderboard.board import (
    FILES,
    Scored,
    about_split,
    check_files,
    entries_of,
    move_entry,
    open_board,
    place,
    refuse_another,
    splits_of,
)
from rsbench.benchmark.leaderboard.picture_files import copy_files
from rsbench.storage.files import write_bytes, write_json
from rsbench.storage.untrusted_files import read_bytes, read_json
from rsbench.storage.work_folder import WORK, work_folder


def merge(other: Path, board: Path) -> list[str]:
    """Copy the entries of another board that are not here yet; returns what was copied.

    Scores are copied as they are: ``rescore`` tells whether the truth agrees. What the keeper of the other board
    accepted is in doubt again: the keeper of this one decides.

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
    with work_folder(board) as hidden:
        open_board(board)
        for scored, folder in theirs:
            refuse_another(folder, scored.predictions_sha256, scored.files)
        for number, (scored, folder) in enumerate(theirs):
            if not folder.exists():
                new = hidden / WORK / str(number)
                _copy(scored, new)
                about = folder.parents[1] / "split.json"
                if not about.exists():
                    about.parent.mkdir(parents=True, exist_ok=True)
                    write_json(about, asdict(told[scored.folder.parents[1]]))
                move_entry(new, folder)
                copied.append("/".join(folder.parts[-4:-2]) + f"/{folder.name}")
    return copied


def _copy(scored: Scored, new: Path) -> None:
    """An entry of another board, and nothing else that lies in its folder."""
    new.mkdir(parents=True)
    for name in FILES:
        write_bytes(new / name, read_bytes(scored.folder / name))
    if "accepted" in (record := read_json(new / FILES[2])):
        write_json(new / FILES[2], {key: value for key, value in record.items() if key != "accepted"})
    check_files(scored.folder, scored.files, copy_files(scored.folder, scored.files, new))
