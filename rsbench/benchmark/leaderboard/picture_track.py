"""Tracks whose answers are pictures: depth maps or corrected frames beside the file of answers.

A job runs all cards without a current answer on one problem: matchers share the motion, correctors share motion
and depth. The run time of an entry is the time that it would take alone.

Pictures are scored problem by problem in single-threaded processes, because all entries share intermediate results
of the truth. A score depends neither on the process nor on other entries: nothing is random, and the order of sums
is fixed.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pandas as pd

from rsbench.benchmark.images.store import resumed
from rsbench.benchmark.leaderboard.inputs import read_frames, read_inputs
from rsbench.benchmark.leaderboard.pictures import PICTURES, RequestedPicture, TruePictures, find_picture
from rsbench.benchmark.leaderboard.submissions import method_header, submission_text
from rsbench.benchmark.leaderboard.track import (
    Answer,
    Checked,
    Job,
    Kept,
    Limits,
    Numbers,
    Row,
    Runnable,
    Solve,
    Split,
    Step,
    Submission,
    Track,
    Truth,
    score_row,
)
from rsbench.capture.model_choice import AUTO
from rsbench.components.plugins import Entry
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import ONE_THREAD, use_one_thread
from rsbench.jobs.process_jobs import Workers, run_jobs
from rsbench.pipeline.chain import Given
from rsbench.pipeline.frame_depth import CorrectionOptions, Images
from rsbench.pipeline.isolated_chain import Isolation
from rsbench.pipeline.problem import Problem
from rsbench.storage.files import write_bytes
from rsbench.storage.untrusted_files import read_bytes
from rsbench.storage.work_folder import remove

Draw = Callable[[TruePictures, Path], None]
"""Function that writes the pictures of one problem into a folder."""


class CardChain(NamedTuple):
    """The pipeline that runs a card: a matcher, or a corrector with the default solver and matcher."""

    options: CorrectionOptions
    entry: Entry[Any, Any]
    """The loaded component of the card."""
    key: object
    """All data that determine its answers, apart from the inputs."""
    uses: tuple[str, ...]
    """Inputs that it uses, names of ``KNOWLEDGE``."""
    reference: str = ""
    """Where the method is published."""

    def choosing(self) -> CardChain:
        """Return the same chain, which selects the motion model by the matches, as ``rsbench correct`` does."""
        options = replace(self.options, motion_model=AUTO)
        return self._replace(options=options, key=options.key)


class SharedWork:
    """A problem whose pictures are made, and the intermediate results that entries share."""

    def __init__(self, problem: Problem, images: Images, requested: tuple[RequestedPicture, ...]) -> None:
        self.problem, self.images, self.requested = problem, images, requested
        self.known = Given()
        """Estimates from the frames of the rig."""
        self.left: Given | None = None
        """Estimates from the frames of the left camera only; None: not estimated yet."""
        self.spent: dict[str, float] = {}
        """Run time of each step, seconds."""


@dataclass(frozen=True, kw_only=True)
class PictureAnswer(Answer):
    """An answer with pictures beside the file."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_numbers("an answer is pictures, and its line has the name")


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureTrack(Track):
    """Depth maps or corrected frames of rendered sequences."""

    answers = PictureAnswer
    pictures = True
    part_score: ClassVar[str]
    """Prefix of the columns with scores of parts of the pixels, see ``pictures.PARTINGS``."""
    part_title: ClassVar[str]
    """Title of these scores in figures."""

    # Methods of each kind of picture

    @abstractmethod
    def read(self, submission: Submission, pictures: TruePictures) -> Any:
        """Read the pictures of an answer. Raises RsbenchError if one cannot be read."""

    @abstractmethod
    def hints(self, drawn: Any, pictures: TruePictures, public: bool) -> Iterable[str]:
        """Return likely mistakes in the result of ``read``, which is compared with the truth if it is public."""

    @abstractmethod
    def truth_of(self, pictures: TruePictures) -> Any:
        """Return the part of the truth of a problem that ``scores_of`` needs."""

    @abstractmethod
    def scores_of(self, true: Any, drawn: Any | None) -> Numbers:
        """Score the result of ``read`` (None: a failure) against the result of ``truth_of``."""

    @abstractmethod
    def draw(self, pictures: TruePictures, place: Path) -> None:
        """Write example pictures for a template."""

    @abstractmethod
    def chain(self, card: str) -> CardChain:
        """Return the chain of a card; RsbenchError if the card does not exist."""

    @abstractmethod
    def make(self, work: SharedWork, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        """Run a chain and write its pictures into a new folder; returns the answer without its name."""

    # Predictions

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        return {}

    def example(self, split: Split) -> Mapping[str, Any]:
        return {}

    def draw_truth(self, split: Split, folder: Path) -> None:
        _draw_all(split.truths, folder, _copy_truth)

    def draw_example(self, split: Split, folder: Path) -> None:
        _draw_all(split.truths[:1], folder, self.draw)

    def files_of(self, submission: Submission, split: Split) -> Iterator[str]:
        for truth in split.truths:
            answer = submission.answers.get(truth.name)
            if answer is not None and answer.success:
                for each in truth.shown.requested:
                    found = find_picture(submission.folder / PICTURES, truth.name, each)
                    yield f"{PICTURES}/{truth.name}/{found.name}"

    def check_files(self, submission: Submission, split: Split, most: int, hints: bool) -> Checked:
        """Check each picture, reading it once; a secret truth is not used."""
        answered = [answer.name for answer in submission.answers.values() if answer.success]
        folder = submission.folder / PICTURES
        faults, found = list(islice(_strange_files(folder, split, answered), most)), Counter[str]()
        for name in answered:
            if len(faults) >= most:
                break
            pictures = split.by_name[name].shown
            try:
                drawn = self.read(submission, pictures)
                found.update(self.hints(drawn, pictures, split.public) if hints else ())
            except RsbenchError as error:
                faults.append(str(error))
        notes = [
            f"{folder}: {count} of {len(answered)} answers look like something else: {words}"
            for words, count in found.items()
            if 2 * count > len(answered)
        ]
        return faults, notes

    # Running

    def runnable(self, card: str) -> Runnable:
        chain = self.chain(card)
        entry, header = chain.entry, {"uses": chain.uses, "paper": chain.reference}
        return Runnable(entry.name, entry.built_in, chain.key, header | {"description": entry.description})

    def solver_of_jobs(self, inputs: Path, limits: Limits) -> Solve:
        problems = {problem.name: problem for problem in read_inputs(inputs, self)}
        isolation = Isolation(time_limit_s=limits.seconds, memory_mb=limits.memory_mb)
        chains = dict[str, CorrectionOptions]()  # lives as long as this process

        def solve(job: Job) -> Iterator[list[dict[str, Any]]]:
            (name,) = job.problems
            work = SharedWork(problems[name], read_frames(inputs, problems[name]), job.requested)
            for target in job.targets:
                if target.card not in chains:
                    chains[target.card] = isolation.chain(self.chain(target.card).options)
                remove(place := target.folder / PICTURES / name)
                yield [{"name": name, **self.make(work, chains[target.card], place)}]

        return solve

    # Scores

    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Kept | None
    ) -> list[pd.DataFrame | RsbenchError]:
        names = list(split.by_name)
        places = {name: (kept[0] / f"{name}.json", kept[1]) for name in names} if kept else {}
        marked = resumed(names, places, partial(_rows_of, submissions, split, workers), step)
        tables = list[pd.DataFrame | RsbenchError]()
        for rows in zip(*(marked[name] for name in names), strict=True):
            faults = [row for row in rows if isinstance(row, str)]
            tables.append(RsbenchError(faults[0]) if faults else pd.DataFrame(list(rows)))
        return tables


def _rows_of(
    submissions: Sequence[Submission], split: Split, workers: Workers, names: list[str]
) -> Generator[tuple[str, list[Row | str]], None, None]:
    """Yield the name and ``picture_rows`` of each finished problem; one worker runs in this process."""
    if workers == 1:
        yield from ((name, picture_rows(split, name, submissions)) for name in names)
        return
    with closing(run_jobs(_serve_rows, names, workers, ONE_THREAD, tuple(submissions), split)) as ready:
        for name, outcome in ready:
            if not outcome.success:
                raise RsbenchError(f"problem {name}: {outcome.reason}" if outcome.ended else outcome.reason)
            yield name, outcome.value


def _serve_rows(submissions: Sequence[Submission], split: Split) -> Callable[[str], list[Row | str]]:
    use_one_thread()
    return lambda name: picture_rows(split, name, submissions)


def picture_rows(split: Split, name: str, submissions: Sequence[Submission]) -> list[Row | str]:
    """Read and score the pictures of a problem; returns, for each submission, the scores or the fault in it.

    Raises:
        RsbenchError: the truth has changed since the split was read.
    """
    truth, track = split.by_name[name], split.track
    assert isinstance(track, PictureTrack)
    truth.shown.check()
    true = track.truth_of(truth.shown)
    rows = list[Row | str]()
    for submission in submissions:
        answer = submission.answers.get(truth.name)
        success = answer is not None and answer.success
        try:
            scores = track.scores_of(true, track.read(submission, truth.shown) if success else None)
            rows.append(score_row(truth, answer, success, scores) | track.part_of(truth))
        except RsbenchError as error:
            rows.append(str(error))
    return rows


def _strange_files(folder: Path, split: Split, answered: Collection[str]) -> Iterator[str]:
    """Yield a message for each file below ``pictures`` that does not belong to an answer."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for place in sorted(folder.iterdir()):
        truth = split.by_name.get(place.name)
        if truth is None:
            yield f"{place}: is no problem of {split.name}: folders have the names of problems"
            continue
        if place.is_symlink() or not place.is_dir():
            yield f"{place}: must be a folder of its own, no link"
            continue
        if place.name not in answered:
            yield f"{place}: has pictures, but no line in the file of answers; add one, or remove them"
        names = {f"{each.stem}{suffix}" for each in truth.shown.requested for suffix in each.suffixes}
        for path in sorted(place.iterdir()):
            if path.name not in names:
                yield f"{path}: does not belong here; there are: {', '.join(sorted(names))}"


def drawn_oracle(name: str, uses: str, description: str, draw: Draw) -> tuple[str, Callable[[Split, Path], str]]:
    """Return an entry of ``Track.oracles`` whose pictures are written by the function ``draw``."""
    return name, partial(_drawn_answers, name, uses, description, draw)


def _drawn_answers(name: str, uses: str, description: str, draw: Draw, split: Split, folder: Path) -> str:
    _draw_all(split.truths, folder, draw)
    header = {**method_header(split, name, [uses], description), "code": "rsbench"}
    return submission_text(header, ({"name": truth.name} for truth in split.truths))


def _draw_all(truths: Sequence[Truth], folder: Path, draw: Draw) -> None:
    for truth in truths:
        place = folder / PICTURES / truth.name
        place.mkdir(parents=True, exist_ok=True)
        draw(truth.shown, place)


def _copy_truth(pictures: TruePictures, place: Path) -> None:
    for each in pictures.requested:
        path = pictures.path(each)
        write_bytes(place / f"{each.stem}{path.suffix}", read_bytes(path))
