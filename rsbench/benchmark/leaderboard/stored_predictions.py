"""Predictions of a board's entries, compressed, so that anybody can score them again without running a method."""

from __future__ import annotations

import lzma
import tempfile
from pathlib import Path

from rsbench.benchmark.leaderboard.adding import add_all
from rsbench.benchmark.leaderboard.board import FILES, ORACLES, RUN, Scored, entries_of
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import SUBMISSION_BYTES, read_submission
from rsbench.benchmark.leaderboard.track import ORACLE
from rsbench.core.errors import RsbenchError
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import read_bytes

SUFFIX = ".jsonl.xz"


def store(board: Path, protocol: str, split: str, out: Path) -> list[Path]:
    """Write the predictions of each entry of a split as ``<method>.jsonl.xz``; returns the files.

    Raises:
        RsbenchError: an entry is damaged, or a file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    files = list[Path]()
    for entry in entries_of(board, protocol, split):
        data = read_bytes(entry.folder / FILES[0], SUBMISSION_BYTES)
        files.append(out / f"{entry.header.method}{SUFFIX}")
        write_bytes(files[-1], lzma.compress(data, preset=9))
    return files


def restore(stored: Path, split: Split, board: Path) -> list[Scored]:
    """Entries of a board from what ``store`` wrote of this split, scored by the code of today.

    Raises:
        RsbenchError: there is nothing, or a file is damaged or of another split.
    """
    files = sorted(stored.glob(f"*{SUFFIX}"))
    if not files:
        raise RsbenchError(f"{stored}: holds no predictions (*{SUFFIX})")
    made: dict[str, list[Path]] = {RUN: [], ORACLES: []}
    with tempfile.TemporaryDirectory() as folder:
        for file in files:
            data, path = _unpacked(file), Path(folder) / file.name.removesuffix(SUFFIX) / FILES[0]
            path.parent.mkdir()
            write_bytes(path, data)
            made[ORACLES if ORACLE in read_submission(path, split).header.uses else RUN].append(path)
        found = [add_all(board, paths, split, {"command": command}) for command, paths in made.items()]
    return [each for entries in found for each in entries]


def _unpacked(file: Path) -> bytes:
    try:
        unpacker = lzma.LZMADecompressor()
        data = unpacker.decompress(read_bytes(file), SUBMISSION_BYTES)
        if not unpacker.eof:
            raise RsbenchError(f"{file}: is cut off, or larger than {SUBMISSION_BYTES} bytes")
    except lzma.LZMAError as error:
        raise RsbenchError(f"{file}: is no xz file: {error}") from error
    return data
