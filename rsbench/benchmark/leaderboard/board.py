"""A board: a folder of scored entries with their predictions; two boards can be merged.

    board.json                                 format of the board
    <protocol>/<split>/split.json              identity of the split, and properties of public problems
    <protocol>/<split>/entries/<method>/       predictions.jsonl, scores.csv, entry.json
        pictures/<problem>/NAME                depth maps or corrected frames, on tracks of pictures
        matches/NAME                           matches of the method, on tracks where it finds its own

An entry is written under another name and then renamed, so that it is never incomplete.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import lzma
import os
import re
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.images.store import identity_of
from rsbench.benchmark.leaderboard.inputs import split_record
from rsbench.benchmark.leaderboard.pictures import copy_files, file_bytes
from rsbench.benchmark.leaderboard.submissions import SUBMISSION_BYTES, read_submission
from rsbench.benchmark.leaderboard.track import ORACLE, Header, Split, Step, Submission
from rsbench.benchmark.leaderboard.tracks import TRACKS, track_of_id
from rsbench.benchmark.provenance import numeric_version
from rsbench.benchmark.statistics import share_interval
from rsbench.benchmark.trajectory_scores import METHODS
from rsbench.components.cards import list_cards, parse_card
from rsbench.core.errors import RsbenchError, naming
from rsbench.jobs.process_jobs import Workers
from rsbench.storage.files import read_table, write_bytes, write_json, write_table
from rsbench.storage.untrusted_files import NAME, parse_json, read_bytes, read_json
from rsbench.storage.work_folder import WORK, remove, work_folder

FORMAT = 1
RUN = "rsbench leaderboard run"
"""Command whose entries may be replaced; submitted entries are replaced only on request."""
ORACLES = "rsbench leaderboard oracles"
OWN = (RUN, ORACLES)
"""Commands that make entries of rsbench's own methods."""
FILES = ("predictions.jsonl", "scores.csv", "entry.json")
"""Files of an entry; the last one describes the others."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The keys of entry.json that are read."""

    format: int
    header: Header
    predictions_sha256: str
    fingerprint: str
    """Fingerprint of the split."""
    files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the pictures and matches of its answers, by their paths below the entry."""
    doubt: str = ""
    """Reason for doubts about the entry, see ``doubt_about``; empty if there are none."""
    accepted: str = ""
    """Reason why the keeper of the board accepted the entry in spite of doubts; empty if it was not accepted."""
    made: dict[str, Any] = field(default_factory=dict)
    """Provenance: ``command``, version, machine."""


@dataclass(frozen=True, kw_only=True)
class About:
    """The keys of split.json that are read."""

    protocol: str
    split: str
    fingerprint: str
    facts: dict[str, dict[str, float | str]]
    """Properties of each problem; empty for a secret split."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Scored:
    """An entry of a board."""

    folder: Path
    header: Header
    predictions_sha256: str
    scores: pd.DataFrame
    """One row for each problem, see ``Track.mark``."""
    files: dict[str, str]
    """SHA-256 of its pictures and matches, by paths below ``folder`` such as ``pictures/castle/left_1.exr``."""
    doubt: str
    """Reason for doubts, because of which it is not ranked; empty if there are none, or it was accepted."""
    handed_in: bool
    """Whether the answers were submitted as a file; if not, this board ran the method."""


def made_by(board: Path, split: Split, method: str) -> str:
    """Return the command that made an entry; ``RUN`` if there is no such entry."""
    path = place(board, split.track.id, split.name) / "entries" / method / FILES[2]
    if not path.is_file():
        return RUN
    made = read_json(path).get("made")
    return str(made.get("command", "")) if isinstance(made, dict) else ""


def move_entry(new: Path, folder: Path) -> None:
    """Move a finished entry from the work folder to its place; an old entry there is moved to the work folder."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.is_symlink() or folder.exists():
        os.replace(folder, new.with_name(f"{new.name}~"))  # entries cannot have this name
    os.replace(new, folder)


def place(board: Path, protocol: str, split: str) -> Path:
    """Return the folder of a split."""
    return board / protocol / split


def open_board(board: Path) -> None:
    """Create a board in an empty folder, or check an existing board.

    Raises:
        RsbenchError: the folder contains something else.
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
    """Write split.json, with properties of the problems if the split is public."""
    path = place(board, split.track.id, split.name) / "split.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = {truth.name: truth.facts for truth in split.truths} if split.public else {}
    write_json(path, {**split_record(split), "facts": facts})


def refuse_another(folder: Path, sha256: str, files: dict[str, str]) -> None:
    """Raise RsbenchError if the folder contains an entry with other predictions."""
    if not folder.is_dir():
        return
    there = read_json(folder / FILES[2])
    if (there.get("predictions_sha256"), there.get("files", {})) != (sha256, files):
        raise RsbenchError(
            f"{folder}: is an entry of that name with other predictions; rename the method, or replace the entry "
            "with --replace"
        )


def refuse_same_but_case(entries: Path, method: str) -> None:
    """Raise RsbenchError if a name differs from that of an entry only in case, which some file systems ignore."""
    for folder in _folders(entries):
        if folder.name != method and folder.name.lower() == method.lower():
            raise RsbenchError(
                f"method = {method!r}: differs from the entry {folder.name!r} in case alone; rename it"
            )


# Reading


def splits_of(board: Path) -> list[tuple[str, str]]:
    """Return the protocol and name of each split of a board, in the order of tracks.

    Raises:
        RsbenchError: the folder is not a board.
    """
    _check_board(board)
    found: list[tuple[str, str]] = []
    for protocol in (track.id for track in TRACKS.values()):
        found += [(protocol, folder.name) for folder in _folders(board / protocol)]
    return found


def about_split(folder: Path) -> About:
    """Read the split.json of a folder of a board.

    Raises:
        RsbenchError: the file is missing, or damaged.
    """
    path = folder / "split.json"
    if path.is_symlink() or not path.is_file():
        raise RsbenchError(f"{path}: must be a file of its own; submit an entry again, which makes it")
    return parse_card(About, read_json(path), str(path), extra="ignore")


def entries_of(board: Path, protocol: str, split: str) -> list[Scored]:
    """Read the entries of a split, sorted by name.

    Raises:
        RsbenchError: an entry is damaged.
    """
    return [read_entry(folder) for folder in _folders(place(board, protocol, split) / "entries")]


def _folders(folder: Path) -> Iterator[Path]:
    """Yield the subfolders with valid names, sorted; links are left out."""
    if folder.is_dir() and not folder.is_symlink():
        for path in sorted(folder.iterdir()):
            if NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                yield path


def read_entry(folder: Path) -> Scored:
    """Read an entry from its folder. Raises RsbenchError if it is damaged."""
    record = _read_record(folder)
    return Scored(
        folder=folder,
        header=record.header,
        predictions_sha256=record.predictions_sha256,
        scores=_read_scores(folder, record.header.protocol),
        files=record.files,
        doubt="" if record.accepted else record.doubt,
        handed_in=record.made.get("command") not in OWN,
    )


def _read_record(folder: Path) -> Recorded:
    """Read entry.json, and check it against the folder and the predictions of the entry."""
    for name in FILES:
        if (folder / name).is_symlink() or not (folder / name).is_file():
            raise RsbenchError(
                f"{folder / name}: must be a file of its own; remove the entry, and submit it again"
            )
    path = folder / FILES[2]
    record = parse_card(Recorded, read_json(path), str(path), extra="ignore")
    named = (record.header.protocol, record.header.split, record.header.method)
    if named != (folder.parents[2].name, folder.parents[1].name, folder.name):
        raise RsbenchError(f"{path}: header: is of {'/'.join(named)}, but the entry is in another folder")
    with naming(path):
        track_of_id(record.header.protocol).check_uses(record.header.uses)
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
    """Raise RsbenchError if the SHA-256 ``found`` of an entry's files differ from the recorded ``files``."""
    for name, digest in files.items():
        if found[name] != digest:
            raise RsbenchError(
                f"{folder / name}: has changed since it was scored; remove the entry, and submit it again"
            )


def rescore(
    board: Path, split: Split, workers: Workers = 1, step: Step = lambda word: None
) -> dict[str, list[str]]:
    """Score the stored predictions of a split again, without running a method. ``workers`` and ``step``: see
    ``Track.mark``.

    Returns:
        The columns that changed, by entry, for entries with different scores; all columns if there was no table.

    Raises:
        RsbenchError: stored predictions are invalid, or belong to another entry.
    """
    changed: dict[str, list[str]] = {}
    _check_board(board)
    with work_folder(board):
        folders = list(_folders(place(board, split.track.id, split.name) / "entries"))
        stored = [_stored(folder, split) for folder in folders]
        for folder, scores in zip(folders, split.track.mark(stored, split, workers, step, None), strict=True):
            if isinstance(scores, RsbenchError):
                raise scores
            old = pd.DataFrame()
            with contextlib.suppress(RsbenchError):
                old = _read_scores(folder, split.track.id)
            write_table(folder / FILES[1], scores)
            doubt, record = doubt_about(scores, _read_record(folder).header, split), read_json(folder / FILES[2])
            if record.get("doubt", "") != doubt:
                write_json(folder / FILES[2], {**record, "doubt": doubt})
            now = read_entry(folder).scores
            if columns := [str(name) for name in now if not now[name].equals(old.get(name, pd.Series()))]:
                changed[folder.name] = columns
    return changed


def accept(board: Path, protocol: str, split: str, method: str, reason: str) -> str:
    """Accept an entry in spite of doubts, so that it is ranked; returns the text of the doubts.

    Raises:
        RsbenchError: there is no such entry, or there are no doubts about it.
    """
    folder = place(board, protocol, split) / "entries" / method
    if not folder.is_dir():
        raise RsbenchError(f"{folder}: is no entry; rsbench leaderboard show --board {board} lists them")
    with work_folder(board):
        record = _read_record(folder)
        if not record.doubt:
            raise RsbenchError(f"{folder}: there are no doubts about it; it has a rank")
        write_json(folder / FILES[2], {**read_json(folder / FILES[2]), "accepted": reason})
    return record.doubt


def _stored(folder: Path, split: Split) -> Submission:
    """Read the predictions of an entry, and check its files against the recorded hashes."""
    record, path = _read_record(folder), folder / FILES[0]
    found = {name: hashlib.sha256(file_bytes(folder, name)).hexdigest() for name in record.files}
    check_files(folder, record.files, found)
    submission = read_submission(path, split)
    if submission.header != record.header:
        raise RsbenchError(f"{path}: its header is not that of {FILES[2]}; submit it again")
    return submission


# New entries: submissions are read, copied to a work folder, scored together, and renamed to their places.


class _Taken(NamedTuple):
    """A file of predictions that is being added to a board."""

    submission: Submission
    """The submission, with the work folder of the new entry as its folder."""
    data: bytes
    files: dict[str, str]
    """SHA-256 of its pictures and matches, as in ``Recorded``."""

    @property
    def identity(self) -> list[Any]:
        """Hashes of all data that determine its scores, apart from the split."""
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
    """Score a file of predictions, and store both on the board.

    Args:
        made: provenance for entry.json.
        replace: whether an entry of that name may be replaced.
        workers, step: see ``Track.mark``.

    Raises:
        RsbenchError: the file has a fault; an entry of that name has other predictions; the board cannot be
            written, or another command is using it.
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
    """Add several files as ``add`` does; they share intermediate results of the truth. ``replace`` is called with
    the name of a method.

    Raises:
        RsbenchError: as for ``add``; the valid files are added to the board first.
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
        kept, submissions = hidden / "scoring", [each.submission for each in taken]
        identities = [each.identity for each in taken]
        identity = identity_of(split=split.fingerprint, code=numeric_version(), files=identities)
        marked = split.track.mark(submissions, split, workers, step, (kept, identity))
        for each, scores in zip(taken, marked, strict=True):
            if isinstance(scores, RsbenchError):
                faults.append(scores)
            else:
                scored.append(_put(each, scores, split, made, entries))
        remove(kept)
    if faults:
        raise faults[0]
    return scored


def _read_all(files: Iterable[Path], split: Split) -> tuple[list[tuple[Submission, bytes]], list[RsbenchError]]:
    """Return the valid submissions with the content of their files, and the errors of the other files."""
    read, faults = list[tuple[Submission, bytes]](), list[RsbenchError]()
    for file in files:
        try:
            read.append((read_submission(file, split), read_bytes(file)))
        except RsbenchError as error:
            faults.append(error)
    return read, faults


def _put(taken: _Taken, scores: pd.DataFrame, split: Split, made: dict[str, Any], entries: Path) -> Scored:
    """Write an entry into its work folder, and move it to its place."""
    header, new = taken.submission.header, taken.submission.folder
    new.mkdir(parents=True, exist_ok=True)
    write_bytes(new / FILES[0], taken.data)
    write_table(new / FILES[1], scores)
    record = {
        "format": FORMAT,
        "header": asdict(header),
        "predictions_sha256": hashlib.sha256(taken.data).hexdigest(),
        "fingerprint": split.fingerprint,
        **({"files": taken.files} if taken.files else {}),
        "made": made,
        "doubt": doubt_about(scores, header, split),
    }
    write_json(new / FILES[2], record)
    move_entry(new, entries / header.method)
    return read_entry(entries / header.method)


# Merging


def merge(other: Path, board: Path) -> list[str]:
    """Copy the entries of another board that this one lacks; returns their names.

    Scores are copied unchanged: ``rescore`` checks them against the truth. Entries that the keeper of the other
    board accepted are in doubt again, until the keeper of this one decides.

    Raises:
        RsbenchError: entries with the same name have different predictions; a folder is not a board, or is
            damaged.
    """
    theirs = [
        (scored, place(board, protocol, split) / "entries" / scored.header.method)
        for protocol, split in splits_of(other)
        for scored in entries_of(other, protocol, split)
    ]
    splits = {scored.folder.parents[1]: about_split(scored.folder.parents[1]) for scored, _ in theirs}
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
                    write_json(about, asdict(splits[scored.folder.parents[1]]))
                move_entry(new, folder)
                copied.append("/".join(folder.parts[-4:-2]) + f"/{folder.name}")
    return copied


def _copy(scored: Scored, new: Path) -> None:
    """Copy the known files of an entry of another board, without its acceptance."""
    new.mkdir(parents=True)
    for name in FILES:
        write_bytes(new / name, read_bytes(scored.folder / name))
    if "accepted" in (record := read_json(new / FILES[2])):
        write_json(new / FILES[2], {key: value for key, value in record.items() if key != "accepted"})
    check_files(scored.folder, scored.files, copy_files(scored.folder, scored.files, new))


# Stored predictions: compressed, so that they can be scored again without running a method

SUFFIX = ".jsonl.xz"


def store(board: Path, protocol: str, split: str, out: Path, methods: Collection[str] | None = None) -> list[Path]:
    """Write the predictions of each entry of a split as ``<method>.jsonl.xz``; returns the files.

    ``methods``: names of the entries to write; by default all.

    Raises:
        RsbenchError: an entry is damaged, or a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    files = list[Path]()
    for entry in entries_of(board, protocol, split):
        if methods is not None and entry.header.method not in methods:
            continue
        data = read_bytes(entry.folder / FILES[0], SUBMISSION_BYTES)
        files.append(out / f"{entry.header.method}{SUFFIX}")
        write_bytes(files[-1], lzma.compress(data, preset=9))
    return files


def restore(
    stored: Path, split: Split, board: Path, part: Split | None = None, step: Step = lambda word: None
) -> list[Scored]:
    """Add the predictions that ``store`` wrote for this split to a board, scored by the current code.

    Args:
        part: the same split with fewer problems; if it is given, only these are scored.
        step: called with the name of each method.

    Raises:
        RsbenchError: there are no files, or a file is damaged or of another split.
    """
    files = sorted(stored.glob(f"*{SUFFIX}"))
    if not files:
        raise RsbenchError(f"{stored}: holds no predictions (*{SUFFIX})")
    made: dict[str, list[Path]] = {RUN: [], ORACLES: []}
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            data, path = _unpacked(file), Path(folder) / file.name.removesuffix(SUFFIX) / FILES[0]
            step(path.parent.name)
            path.parent.mkdir()
            write_bytes(path, data if part is None else _only(data, split, part, str(file)))
            header = read_submission(path, part or split).header
            made[ORACLES if ORACLE in header.uses else RUN].append(path)
        found = [add_all(board, paths, part or split, {"command": command}) for command, paths in made.items()]
    return [each for entries in found for each in entries]


def _only(data: bytes, split: Split, part: Split, where: str) -> bytes:
    """Restrict the predictions of a split to the problems of a part of it."""
    header, *answers = (parse_json(line, where) for line in data.decode().splitlines())
    if header.get("split") == split.name:
        header["split"] = part.name
    kept = [header, *(answer for answer in answers if answer.get("name") in part.by_name)]
    return "".join(f"{json.dumps(line)}\n" for line in kept).encode()


def _unpacked(file: Path) -> bytes:
    with naming(f"{file}: is no xz file", lzma.LZMAError):
        unpacker = lzma.LZMADecompressor()
        data = unpacker.decompress(read_bytes(file), SUBMISSION_BYTES)
        if not unpacker.eof:
            raise RsbenchError(f"{file}: is cut off, or larger than {SUBMISSION_BYTES} bytes")
    return data


COVERAGE = 0.999
"""Coverage of the interval that must exclude 0.5; it puts 1 of 2000 unbiased methods at the bound in doubt."""
_EXACT_SHARE = 0.1
"""Largest allowed share of problems in which an error is zero up to rounding."""
_ORACLES = (ORACLE, "cramer-rao", "constant", "uncorrected", "fusion-true")
_BUILT_IN = ("rs-stereo", "rs-stereo-auto", "sgm", "sweep", "fusion")
"""Names of former entries, in addition to those of cards."""


def outline(name: str) -> str:
    """Normalise a name, so that similar-looking names are equal: lower case, one separator, 0 = o, 1 = i = l."""
    return re.sub("[._-]+", "-", name.lower()).strip("-").translate(str.maketrans("01i", "oll"))


def refuse_reserved(header: Header, where: str) -> None:
    """Refuse a submission with the name of a method of rsbench, or one that uses the ground truth.

    Raises:
        RsbenchError: the name reads like one of rsbench's own, or ``uses`` names the truth.
    """
    method, kinds = header.method, ("solvers", "matchers", "correctors")
    own = {*_ORACLES, *_BUILT_IN, *METHODS, *(name for kind in kinds for name in list_cards(kind))}
    if outline(method) in {outline(name) for name in own}:
        raise RsbenchError(
            f"{where}: method = {method!r}: is the name of a method of rsbench, or looks like it; choose another, "
            f"such as '{method}-mine'"
        )
    if ORACLE in header.uses:
        raise RsbenchError(
            f"{where}: uses = {ORACLE!r}: only oracles of rsbench know the truth (rsbench leaderboard oracles); "
            "name the data that the method works on"
        )


def doubt_about(scores: pd.DataFrame, header: Header, split: Split) -> str:
    """Return the reason why an entry is in doubt, in one line; empty if it is not.

    An entry in doubt is more accurate than its data allow, and is not ranked until the board's keeper accepts it.
    Either an error is zero up to rounding in more than a tenth of the problems, or errors are below the Cramer-Rao
    bound of the inputs in ``header.uses``: the error of an unbiased method is below the median at the bound in at
    most half of the problems. Each error of a track is tested separately. If no bound is known, as for rendered
    frames, a submission of the true values plus a small error is not detected; the keeper must run the method.
    """
    if ORACLE in header.uses:
        return ""
    track = split.track
    for column, below in track.exact.items():
        exact = np.asarray(scores[column].to_numpy(dtype=np.float64) < below)
        if np.count_nonzero(exact) > _EXACT_SHARE * len(exact):
            return f"{column} is below {below:g}, exact but for rounding, in {_words(exact, 0.95)} of the problems"
    for name, medians in track.medians_at_bound(header.uses, split).items():
        known = np.isfinite(medians)
        nearer = scores[name].to_numpy(dtype=np.float64)[known] < medians[known]
        if share_interval(int(np.count_nonzero(nearer)), len(nearer), COVERAGE).low > 0.5:
            return (
                f"{name} is below the median at the Cramer-Rao bound of {' + '.join(header.uses)} in "
                f"{_words(nearer, COVERAGE)} of the problems; without bias it is so in half of them at most"
            )
    return ""


def _words(hits: NDArray[np.bool_], coverage: float) -> str:
    count = int(np.count_nonzero(hits))
    low, high = share_interval(count, len(hits), coverage)
    return f"{count / len(hits):.2f} [{low:.2f}, {high:.2f}]"
