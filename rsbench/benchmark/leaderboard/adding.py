"""Submissions become entries of a board: read, copied aside, scored together, and renamed to their places."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from rsbench.benchmark.leaderboard.board import (
    FILES,
    FORMAT,
    OWN,
    Scored,
    move_entry,
    open_board,
    place,
    read_entry,
    refuse_another,
    refuse_same_but_case,
    write_split,
)
from rsbench.benchmark.leaderboard.doubt import doubt_about, refuse_reserved
from rsbench.benchmark.leaderboard.marking import mark_all
from rsbench.benchmark.leaderboard.picture_files import copy_files
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import Submission, read_submission
from rsbench.benchmark.leaderboard.track import Step
from rsbench.benchmark.provenance import numeric_version
from rsbench.core.errors import RsbenchError
from rsbench.jobs.workers import Workers
from rsbench.storage.files import write_bytes, write_json, write_table
from rsbench.storage.untrusted_files import read_bytes
from rsbench.storage.work_folder import WORK, remove, work_folder


class _Taken(NamedTuple):
    """A file of predictions that becomes an entry."""

    submission: Submission
    """In the folder where the entry is made."""
    data: bytes
    files: dict[str, str]
    """As of ``Recorded``."""

    @property
    def identity(self) -> list[Any]:
        """What decides its scores, but for the split."""
        return [hashlib.sha256(self.data).hexdigest(), sorted(self.files.items())]


def add(
    board: Path,
    predictions: Path,
    split: Split,
    made: dict[str, Any],
    *,
    replace: bool = False,
    workers: Workers = 1,
    step: Step = lambda word: None,
) -> Scored:
    """Score a file of predictions and keep both.

    Args:
        made: how it came about, for entry.json.
        replace: whether an entry of that name may be replaced.
        workers, step: see ``mark_all``.

    Raises:
        RsbenchError: the file is at fault; an entry of that name has other predictions; the board cannot be
            written, or another command is at work there.
    """
    (scored,) = add_all(
        board, [predictions], split, made, replace=lambda method: replace, workers=workers, step=step
    )
    return scored


def add_all(
    board: Path,
    files: Iterable[Path],
    split: Split,
    made: dict[str, Any],
    *,
    replace: Callable[[str], bool] = lambda method: True,
    workers: Workers = 1,
    step: Step = lambda word: None,
) -> list[Scored]:
    """``add`` for several files, which share what is found of the truth; ``replace`` is asked by the method.

    Raises:
        RsbenchError: as ``add``; where there are other files, after they are on the board.
    """
    read, faults = _read_all(files, split)
    if not read and faults:
        raise faults[0]
    scored = list[Scored]()
    with work_folder(board) as hidden:
        open_board(board)
        entries = place(board, split.track.id, split.name) / "entries"
        taken = list[_Taken]()
        for number, (submission, data) in enumerate(read):
            method, new = submission.header.method, hidden / WORK / str(number)
            if made.get("command") not in OWN:
                refuse_reserved(submission.header, str(submission.folder))
            refuse_same_but_case(entries, method)
            kept = copy_files(submission.folder, split.track.files_of(submission, split), new)
            if not replace(method):
                refuse_another(entries / method, hashlib.sha256(data).hexdigest(), kept)
            taken.append(_Taken(dataclasses.replace(submission, folder=new), data, kept))
        write_split(board, split)
        kept = _kept(hidden, taken, split)
        marked = mark_all([each.submission for each in taken], split, workers, step, kept)
        for each, scores in zip(taken, marked, strict=True):
            if isinstance(scores, RsbenchError):
                faults.append(scores)
            else:
                doubt = doubt_about(scores, each.submission.header, split)
                scored.append(_put(each, scores, _record(each, split, made) | {"doubt": doubt}, entries))
        remove(kept.parent)
    if faults:
        raise faults[0]
    return scored


def _kept(hidden: Path, taken: Sequence[_Taken], split: Split) -> Path:
    """Folder for scores of these predictions by this code; those of others, whose run was cut off, are removed."""
    of = [split.fingerprint, numeric_version(), *(each.identity for each in taken)]
    kept = hidden / "scoring" / hashlib.sha256(json.dumps(of).encode()).hexdigest()
    if not kept.is_dir():
        remove(kept.parent)
    return kept


def _read_all(files: Iterable[Path], split: Split) -> tuple[list[tuple[Submission, bytes]], list[RsbenchError]]:
    """Submissions with the content of their files, and what is wrong with the others."""
    read, faults = list[tuple[Submission, bytes]](), list[RsbenchError]()
    for file in files:
        try:
            read.append((read_submission(file, split), read_bytes(file)))
        except RsbenchError as error:
            faults.append(error)
    return read, faults


def _record(taken: _Taken, split: Split, made: dict[str, Any]) -> dict[str, Any]:
    """What entry.json says."""
    return {
        "format": FORMAT,
        "header": asdict(taken.submission.header),
        "predictions_sha256": hashlib.sha256(taken.data).hexdigest(),
        "fingerprint": split.fingerprint,
        **({"files": taken.files} if taken.files else {}),
        "made": made,
    }


def _put(taken: _Taken, scores: pd.DataFrame, record: dict[str, Any], entries: Path) -> Scored:
    """Write an entry aside, and rename it to its place."""
    new, folder = taken.submission.folder, entries / taken.submission.header.method
    new.mkdir(parents=True, exist_ok=True)
    write_bytes(new / FILES[0], taken.data)
    write_table(new / FILES[1], scores)
    write_json(new / FILES[2], record)
    move_entry(new, folder)
    return read_entry(folder)
