"""Pictures of problems for the leaderboard's pages: small files beside them, of a dataset that is at hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rsbench.benchmark.leaderboard.track import Split
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import read_pairs
from rsbench.report.board_answers import ERRORS, Named, answer_images, true_images
from rsbench.report.board_splits import Board
from rsbench.report.pictures import encode_jpeg, shrink
from rsbench.storage.files import write_bytes

_LONGEST, _QUALITY = 400, 78
"""Px, and of JPEG: 10 to 35 kB."""
_THUMB = 120
_MOST_BYTES = 11_000_000
"""Of all pictures of a site, which stays below 15 MB."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A picture of a page."""

    title: str
    file: str
    """Below the folder of the problem's pictures."""


class Album:
    """Writes the pictures of a split's problems into ``<id>/pictures/<problem>``."""

    def __init__(self, each: Board, out: Path, data: Sequence[Path]) -> None:
        self._each = each
        self._split, folder = _at_hand(each, data)
        self._sequences = {} if folder is None else {sequence.name: sequence for sequence in read_pairs(folder)}
        self._out, self.prefix = out, f"{each.id}/pictures"
        self.allowance = _MOST_BYTES
        """Bytes of the pictures of a problem."""

    def __len__(self) -> int:
        """How many problems it shows."""
        return len(self._sequences)

    @property
    def errors(self) -> str:
        """What the colours of error maps mean; nothing where there are none."""
        return ERRORS.get(self._each.track.name, "") if self._sequences else ""

    def thumb(self, problem: str) -> str:
        """Path from the folder of the index, or nothing."""
        return f"{self.prefix}/{problem}/thumb.jpg" if problem in self._sequences else ""

    def pictures(self, problem: str) -> list[Shown]:
        """Frames, truth and answers, written, with a thumbnail; of the last entries if there is room."""
        if problem not in self._sequences:
            return []
        left, found = self.allowance, list[Shown]()
        for group in self._groups(problem):
            pictures = [
                (stem, words, encode_jpeg(shrink(image, _LONGEST), _QUALITY)) for stem, words, image in group
            ]
            left -= sum(len(data) for _, _, data in pictures)
            if left < 0:
                break
            for stem, words, data in pictures:
                found.append(Shown(title=words, file=f"{stem}.jpg"))
                self._write(problem, f"{stem}.jpg", data)
        return found

    def compared(self, problem: str) -> tuple[int, int]:
        """Which pictures stand at the divider first: the frame as it was and the best answer, or two frames."""
        truth = None if self._split is None else self._split.by_name[problem]
        return (0, 1) if truth is None or truth.pictures is None else (1, 2 + len(truth.pictures.requested))

    def _groups(self, problem: str) -> Iterator[list[Named]]:
        """What stands or falls together: frames with the truth, then each entry, the best first."""
        assert self._split is not None
        sequence, truth, track = self._sequences[problem], self._split.by_name[problem], self._each.track.name
        frames = [sequence.image("rs", "left", frame) for frame in (0, 1)]
        self._write(problem, "thumb.jpg", encode_jpeg(shrink(frames[0], _THUMB), _QUALITY))
        first = [(f"left_{k}", f"rolling-shutter frame {k}", image) for k, image in enumerate(frames)]
        if truth.pictures is None:
            yield first
            return
        yield [
            *first,
            *((f"true-{stem}", words, image) for stem, words, image in true_images(track, truth.pictures)),
        ]
        for line in self._each.by_score:
            method = line.scored.header.method
            answer = answer_images(track, line.scored, truth)
            yield [(f"{method}/{stem}", words, image) for stem, words, image in answer]

    def _write(self, problem: str, name: str, data: bytes) -> None:
        path = self._out / self.prefix / problem / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, data)


def albums(boards: Sequence[Board], out: Path, data: Sequence[Path]) -> list[Album]:
    """One for each split; together they keep below the bound."""
    found = [Album(each, out, data) for each in boards]
    for album in found:
        album.allowance = _MOST_BYTES // max(sum(map(len, found)), 1)
    return found


def _at_hand(each: Board, data: Sequence[Path]) -> tuple[Split | None, Path | None]:
    """A public split with its dataset, where that is at hand.

    Raises:
        RsbenchError: there is no dataset in a folder.
    """
    if each.pages and not each.facts.empty:
        for folder in data:
            try:
                split = each.track.split(folder)
            except RsbenchError:
                if not (folder / "dataset.json").is_file():
                    raise
                continue  # of cameras that this track does not ask
            if split.fingerprint == each.fingerprint:
                return split, folder
    return None, None
