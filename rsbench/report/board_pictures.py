"""Pictures of problems for the leaderboard's pages: small files beside them, of a dataset that is at hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rsbench.benchmark.leaderboard.splits import dataset_split
from rsbench.dataset.files import write_bytes
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.dataset.sequence import read_pairs
from rsbench.errors import RsbenchError
from rsbench.report.board_splits import Board
from rsbench.report.pictures import Image, encode_jpeg, shrink

_LONGEST, _QUALITY = 480, 80
"""Px, and of JPEG: 20 to 40 kB."""
_THUMB = 120
FRAMES = ("left_0", "left_1")
"""Rolling-shutter frames that are shown of each problem."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A picture of a page."""

    title: str
    file: str
    """Below the folder of the problem's pictures."""


class Album:
    """Writes the pictures of a split's problems into ``<id>/pictures/<problem>``."""

    def __init__(self, each: Board, out: Path, data: Sequence[Path]) -> None:
        self._sequences = sequences_of(each, data)
        self._folder = out / each.id / "pictures"
        self.prefix = f"{each.id}/pictures"

    def thumb(self, problem: str) -> str:
        """Path from the folder of the index, or nothing."""
        return f"{self.prefix}/{problem}/thumb.jpg" if problem in self._sequences else ""

    def frames(self, problem: str) -> list[Shown]:
        """The frames of the left camera, written, with a thumbnail of the first."""
        sequence = self._sequences.get(problem)
        if sequence is None:
            return []
        found = []
        for frame, name in enumerate(FRAMES):
            image = sequence.image("rs", "left", frame)
            if frame == 0:
                self._write(problem, "thumb.jpg", shrink(image, _THUMB))
            found.append(Shown(title=f"rolling-shutter frame {frame}", file=f"{name}.jpg"))
            self._write(problem, f"{name}.jpg", shrink(image, _LONGEST))
        return found

    def _write(self, problem: str, name: str, image: Image) -> None:
        path = self._folder / problem / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, encode_jpeg(image, _QUALITY))


def sequences_of(each: Board, data: Sequence[Path]) -> dict[str, Rendered]:
    """The rendered sequences of a public split, by the names of its problems; none where no dataset is its own.

    Raises:
        RsbenchError: a dataset cannot be read.
    """
    if not each.pages or each.facts.empty:
        return {}
    for folder in data:
        try:
            split = dataset_split(each.protocol, folder)
        except RsbenchError:
            if not (folder / "dataset.json").is_file():
                raise
            continue  # of cameras that this protocol does not ask
        if split.fingerprint == each.fingerprint:
            return {sequence.name: sequence for sequence in read_pairs(folder)}
    return {}
