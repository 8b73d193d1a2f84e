"""What tracks share that ask for pictures: files beside the answers, chains that draw, scores of each problem."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.frame_inputs import FrameTrack
from rsbench.benchmark.leaderboard.marking import rows_of_workers
from rsbench.benchmark.leaderboard.picture_files import FOLDER, find_picture, strange_files
from rsbench.benchmark.leaderboard.picture_running import CardChain, Making, load_chains, run_picture_cards
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission, submission_text, template_header, truth_text
from rsbench.benchmark.leaderboard.track import ORACLE, Limits, Row, Step
from rsbench.benchmark.leaderboard.true_pictures import TruePictures
from rsbench.core.errors import RsbenchError
from rsbench.jobs.workers import Workers
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import read_bytes

Draw = Callable[[TruePictures, Path], None]
"""Writes the pictures of one problem into a folder."""


@dataclass(frozen=True, kw_only=True)
class PictureAnswer(Answer):
    """An answer whose pictures lie beside the file."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("w", "d", "readout_ratio", "covariance"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: is not asked; an answer is pictures, and its line says the name")


class PictureTrack(FrameTrack):
    """Depth maps or corrected frames of rendered sequences."""

    allowed = ("readout", "images", "stereo", "time")
    given = "the four rolling-shutter frames"
    pictures = True
    answers = PictureAnswer
    part_score: ClassVar[str]
    """Beginning of the columns of scores of parts of the pixels, see ``picture_parts``."""
    part_title: ClassVar[str]
    """What figures call these."""
    others: ClassVar[tuple[tuple[str, str, str, Draw], ...]]
    """Oracles beside the truth: name, what it uses, description, pictures."""

    # Of each kind of picture

    @abstractmethod
    def hints(
        self, folder: Path, truth: Truth, png_unit_m: float | None, split: Split, wanted: bool
    ) -> Iterable[str]:
        """Reads the pictures of an answer, which may raise, and says what they look like."""

    @abstractmethod
    def draw_example(self, pictures: TruePictures, place: Path) -> None:
        """Pictures for a template."""

    @abstractmethod
    def chain(self, card: str) -> CardChain:
        """What a card runs in."""

    @abstractmethod
    def make(self, making: Making, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        """Write the pictures of a chain into a new folder; the answer, but for its name."""

    # Predictions

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        return {}

    def write_truth(self, split: Split, folder: Path, file: str = "predictions.jsonl") -> Path:
        return _write(split, folder, truth_text(split), _truth, file)

    def write_template(self, split: Split, path: Path) -> None:
        first, *rest = split.truths
        failures = ({"name": truth.name, "success": False, "reason": "not tried"} for truth in rest)
        header = {**template_header(split), "uses": ["images"]}
        assert first.pictures is not None
        place = path.parent / FOLDER / first.name
        place.mkdir(parents=True, exist_ok=True)
        self.draw_example(first.pictures, place)
        write_bytes(path, submission_text(header, iter([{"name": first.name}, *failures])).encode())

    def files_of(self, submission: Submission, split: Split) -> Iterator[str]:
        for truth in split.truths:
            answer = submission.answers.get(truth.name)
            if truth.pictures is not None and answer is not None and answer.success:
                for asked in truth.pictures.asked:
                    found = find_picture(submission.folder / FOLDER, truth.name, asked)
                    yield f"{FOLDER}/{truth.name}/{found.name}"

    def check_beside(
        self, submission: Submission, split: Split, most: int, hints: bool
    ) -> tuple[list[str], list[str]]:
        """Each picture is read once; a secret truth is not looked at."""
        answered = [answer.name for answer in submission.answers.values() if answer.success]
        folder, unit = submission.folder / FOLDER, submission.header.png_unit_m
        faults, found = list(islice(strange_files(folder, split, answered), most)), Counter[str]()
        for name in answered:
            if len(faults) >= most:
                break
            truth = split.by_name[name]
            try:
                found.update(self.hints(folder, truth, unit, split, hints))
            except RsbenchError as error:
                faults.append(str(error))
        notes = [
            f"{folder}: {count} of {len(answered)} answers look like something else: {words}"
            for words, count in found.items()
            if 2 * count > len(answered)
        ]
        return faults, notes

    def load(self, cards: Sequence[str]) -> None:
        load_chains(cards, self)

    def steps(self, cards: Sequence[str], split: Split, limits: Limits) -> int:
        return len(split.truths)

    def run(self, cards: Sequence[str], split: Split, inputs: Path, work: Path, **options: Any) -> list[Path]:
        return run_picture_cards(self, cards, split, inputs, work, **options)

    # Marking

    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Path | None
    ) -> list[pd.DataFrame | RsbenchError]:
        marked, names = dict[str, list[Row | str]](), [truth.name for truth in split.truths]
        for name, rows in rows_of_workers(submissions, split, workers, kept):
            marked[name] = rows
            step(name)
        tables = list[pd.DataFrame | RsbenchError]()
        for rows in zip(*(marked[name] for name in names), strict=True):
            faults = [row for row in rows if isinstance(row, str)]
            tables.append(RsbenchError(faults[0]) if faults else pd.DataFrame(list(rows)))
        return tables

    # The board

    def oracles(self, split: Split, folder: Path) -> Iterator[Path]:
        yield self.write_truth(split, folder / ORACLE)
        for method, uses, description, draw in self.others:
            header = {
                "protocol": self.id,
                "split": split.name,
                "method": method,
                "uses": [uses],
                "description": description,
                "code": "rsbench",
            }
            text = submission_text(header, ({"name": truth.name} for truth in split.truths))
            yield _write(split, folder / method, text, draw)


def _write(split: Split, folder: Path, text: str, draw: Draw, file: str = "predictions.jsonl") -> Path:
    for truth in split.truths:
        assert truth.pictures is not None
        place = folder / FOLDER / truth.name
        place.mkdir(parents=True, exist_ok=True)
        draw(truth.pictures, place)
    write_bytes(folder / file, text.encode())
    return folder / file


def _truth(pictures: TruePictures, place: Path) -> None:
    for each in pictures.asked:
        path = pictures.path(each)
        write_bytes(place / f"{each.stem}{path.suffix}", read_bytes(path))
