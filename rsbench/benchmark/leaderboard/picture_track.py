"""Running cards of stereo matchers and correctors: predictions first, each problem kept as soon as it is made.

A job is one problem, for all cards whose answer is not current: matchers share the motion, correctors the motion
and the depth. The seconds of an entry are those that it would have taken alone.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pandas as pd

from rsbench.benchmark.images.store import identity_of, read_record
from rsbench.benchmark.leaderboard.inputs import read_frames, read_inputs
from rsbench.benchmark.leaderboard.pictures import FOLDER, Asked, TruePictures, find_picture
from rsbench.benchmark.leaderboard.running import jobs_done
from rsbench.benchmark.leaderboard.splits import FrameTrack
from rsbench.benchmark.leaderboard.submissions import submission_text, template_header, truth_text
from rsbench.benchmark.leaderboard.track import (
    ORACLE,
    Answer,
    Limits,
    Row,
    Split,
    Step,
    Submission,
    Truth,
    last,
    named,
)
from rsbench.benchmark.provenance import numeric_version, processor
from rsbench.capture.model_choice import AUTO
from rsbench.components.plugins import Entry
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import THREAD_VARIABLES, EntryFailure, decode, encode, use_one_thread
from rsbench.jobs.process_jobs import Workers, run_jobs
from rsbench.pipeline.chain import Given
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.isolated_parts import Isolation
from rsbench.pipeline.problem import Problem
from rsbench.solvers.refined import warm_up
from rsbench.storage.files import write_bytes, write_json
from rsbench.storage.untrusted_files import check_name, read_bytes
from rsbench.storage.work_folder import remove


class CardChain(NamedTuple):
    """What a card of a track runs in."""

    options: CorrectionOptions
    entry: Entry[Any, Any]
    """The component that the card names."""
    key: object
    """What decides an answer."""
    uses: tuple[str, ...]
    """Of ``KNOWLEDGE``."""
    reference: str = ""
    """Where the method is published."""

    def choosing(self) -> CardChain:
        """With the motion model that the matches prefer: what ``rsbench correct`` does."""
        options = replace(self.options, motion_model=AUTO)
        return self._replace(options=options, key=options.key)


class _Job(NamedTuple):
    problem: str
    asked: tuple[Asked, ...]
    cards: tuple[tuple[str, Path, str], ...]
    """Card, folder of its predictions, identity of the answer."""

    def __str__(self) -> str:
        return f"problem {self.problem}"


def load_chains(cards: Sequence[str], track: PictureTrack) -> dict[str, CardChain]:
    """The chain that each card runs in: a matcher, or a corrector with our default solver and matcher.

    Raises:
        RsbenchError: no such card, or two of one name.
    """
    chains: dict[str, CardChain] = {}
    names: dict[str, str] = {}
    for card in dict.fromkeys(cards):
        chains[card] = track.chain(card)
        name = chains[card].entry.name
        try:
            check_name(name)
        except ValueError as error:
            raise RsbenchError(f"entry {card}: {error}") from error
        if names.setdefault(name, card) != card:
            raise RsbenchError(
                f"--entry {card} and --entry {names[name]}: both have the name {name!r}; rename one"
            )
    return chains


def run_picture_cards(
    track: PictureTrack,
    cards: Sequence[str],
    split: Split,
    inputs: Path,
    work: Path,
    *,
    workers: Workers = 1,
    limits: Limits = Limits(),  # noqa: B008  it is a constant
    step: Callable[[str], None] = lambda word: None,
) -> list[Path]:
    """Run matchers or correctors on exported inputs; returns for each a file of answers, ready to be submitted.

    Raises:
        RsbenchError: no such card; processes died each time over the same problems: what is done is kept.
    """
    chains = load_chains(cards, track)
    folders = {card: work / chain.entry.name for card, chain in chains.items()}
    jobs: list[_Job] = []
    for truth in split.truths:
        due = tuple(
            (card, folders[card], identity)
            for card, chain in chains.items()
            if _answer(folders[card], truth.name, identity := _identity(chain, split, truth, limits)) is None
        )
        assert truth.pictures is not None
        parts = [due] if limits == Limits() and due else [(each,) for each in due]
        jobs += [_Job(truth.name, truth.pictures.asked, part) for part in parts]
        if not due:
            step(truth.name)
    left = Counter(job.problem for job in jobs)

    def limited(job: _Job) -> bool:
        """Those of others are limited in processes of their own, whose start takes a while."""
        return all(chains[card].entry.built_in for card, _, _ in job.cards)

    for job in jobs_done(partial(_serve, track), jobs, workers, inputs, limits, _fail, limited):
        left[job.problem] -= 1
        if left[job.problem] == 0:
            step(job.problem)
    return [_joined(chain, split, folders[card], limits) for card, chain in chains.items()]


def _fail(job: _Job, reason: str) -> None:
    """Keep that nothing was answered within the limits."""
    for _, folder, identity in job.cards:
        remove(folder / FOLDER / job.problem)
        _keep(folder, job.problem, identity, {"success": False, "reason": reason})


def _keep(folder: Path, problem: str, identity: str, answer: dict[str, Any]) -> None:
    path = folder / "answers" / f"{problem}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, {"identity": identity, "answer": {"name": problem, **answer}})


def _identity(chain: CardChain, split: Split, truth: Truth, limits: Limits) -> str:
    """Of one answer: whatever decides it, and nothing of the other problems."""
    assert truth.pictures is not None
    return identity_of(
        source=numeric_version(),
        chain=chain.key,
        protocol=split.track.id,
        split=split.fingerprint,
        problem=truth.name,
        limits=list(limits),
    )


def _answer(folder: Path, problem: str, identity: str) -> dict[str, Any] | None:
    """What was answered, when it is current."""
    record = read_record(folder / "answers" / f"{problem}.json")
    if record is None or record.get("identity") != identity or not isinstance(record.get("answer"), dict):
        return None
    answer: dict[str, Any] = record["answer"]
    return answer


def _joined(chain: CardChain, split: Split, folder: Path, limits: Limits) -> Path:
    """The answers of a card as one submission."""
    entry = chain.entry
    header: dict[str, Any] = {
        "protocol": split.track.id,
        "split": split.name,
        "method": entry.name,
        "uses": chain.uses,
        "description": entry.description[:300],
        "paper": chain.reference[:300],
        "code": "rsbench" if entry.built_in else "",
        "hardware": f"{processor()}, 1 thread"[:300],
    }
    found = (_answer(folder, truth.name, _identity(chain, split, truth, limits)) for truth in split.truths)
    path = folder / "predictions.jsonl"
    write_bytes(path, submission_text(header, (each for each in found if each is not None)).encode())
    return path


# In the child


def _serve(track: PictureTrack, inputs: Path, limits: Limits) -> Callable[[_Job], None]:
    use_one_thread()
    warm_up()
    problems = {problem.name: problem for problem in read_inputs(inputs, track)}
    isolation = Isolation(time_limit_s=limits.seconds, memory_mb=limits.memory_mb)
    chains = dict[str, CorrectionOptions]()  # as long as this process

    def run(job: _Job) -> None:
        problem = problems[job.problem]
        made = Making(problem, read_frames(inputs, problem), job.asked)
        for card, folder, identity in job.cards:
            if card not in chains:
                chains[card] = isolation.chain(track.chain(card).options)
            place = folder / FOLDER / job.problem
            remove(folder / "answers" / f"{job.problem}.json")
            remove(place)
            answer = track.make(made, chains[card], place)
            _keep(folder, job.problem, identity, answer)

    return run


class Making:
    """The pictures of one problem, and what several entries share."""

    def __init__(self, problem: Problem, images: Images, asked: tuple[Asked, ...]) -> None:
        self.problem, self.images, self.asked = problem, images, asked
        self.given = Given()
        self.alone: Given | None = None
        """What the frames of the asked camera alone tell; None: not looked for yet."""
        self.spent: dict[str, float] = {}


# What tracks share that ask for pictures: files beside the answers, chains that draw, scores of each problem.

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


# Scores of submissions, a row for each problem: by the one scorer of their track, and by nothing else.
#
# A problem without an answer is a failure, and a failure scores the worst value of everything. Pictures take
# longest: they are scored problem by problem, for what is found of the truth serves all entries, each problem in
# one process of one thread. A score does not depend on which process it comes from, or on the other entries: none
# draws at random, or adds in an order of its own.


def rows_of_workers(
    submissions: Sequence[Submission], split: Split, workers: Workers, kept: Path | None = None
) -> Iterator[tuple[str, list[Row | str]]]:
    """``picture_rows`` of each problem by its name, as they become ready; with one worker, in this process.

    A folder ``kept`` holds those of a run that was cut off, and gets those that are new.

    Raises:
        RsbenchError: as it does; or a process ended each time over the same problem.
    """
    names = list[str]()
    for truth in split.truths:
        if kept is not None and (path := kept / truth.name).is_file():
            yield truth.name, decode(read_bytes(path), {})
        else:
            names.append(truth.name)
    for name, rows in _rows_of(submissions, split, workers, names):
        if kept is not None:
            kept.mkdir(parents=True, exist_ok=True)
            write_bytes(kept / name, encode(rows))
        yield name, rows


def _rows_of(
    submissions: Sequence[Submission], split: Split, workers: Workers, names: list[str]
) -> Iterator[tuple[str, list[Row | str]]]:
    if workers == 1:
        for name in names:
            yield name, picture_rows(split, name, submissions)
        return
    outcomes = run_jobs(
        _serve_scores, names, workers, dict.fromkeys(THREAD_VARIABLES, "1"), tuple(submissions), split
    )
    with closing(outcomes) as ready:
        for name, outcome in ready:
            if not outcome.success:
                raise RsbenchError(f"problem {name}: {outcome.reason}" if outcome.ended else outcome.reason)
            yield name, outcome.value


def _serve_scores(submissions: Sequence[Submission], split: Split) -> Callable[[str], list[Row | str]]:
    use_one_thread()

    def run(name: str) -> list[Row | str]:
        try:
            return picture_rows(split, name, submissions)
        except RsbenchError as error:
            raise EntryFailure(str(error)) from error

    return run


def picture_rows(split: Split, name: str, submissions: Sequence[Submission]) -> list[Row | str]:
    """Of each submission the scores of its pictures, which are read here, or what is at fault with them.

    Raises:
        RsbenchError: the truth has changed since the split was read.
    """
    truth, track = split.by_name[name], split.track
    assert truth.pictures is not None
    truth.pictures.check()
    scores_of = track.scorer(truth, truth.pictures)
    rows = list[Row | str]()
    for submission in submissions:
        answer = submission.answers.get(truth.name)
        success = answer is not None and answer.success
        try:
            scores = scores_of(submission, success)
        except RsbenchError as error:
            rows.append(str(error))
        else:
            rows.append({**named(truth, success), **scores, **last(success, answer)})
    return rows


# Pictures that anybody hands in: beside a file of answers, ``pictures/PROBLEM/NAME.png``.
#
# Names are looked up, never taken from what was handed in, and no link is followed. The size of an image is known
# from its header, before anything is decoded.


def strange_files(folder: Path, split: Split, answered: Collection[str]) -> Iterator[str]:
    """A line for each thing below ``pictures`` that is no picture of an answer."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for place in sorted(folder.iterdir()):
        truth = split.by_name.get(place.name)
        if truth is None or truth.pictures is None:
            yield f"{place}: is no problem of {split.name}: folders have the names of problems"
            continue
        if place.is_symlink() or not place.is_dir():
            yield f"{place}: must be a folder of its own, no link"
            continue
        if place.name not in answered:
            yield f"{place}: has pictures, but no line in the file of answers says so; add one, or remove them"
        names = {f"{asked.stem}{suffix}" for asked in truth.pictures.asked for suffix in asked.suffixes}
        for path in sorted(place.iterdir()):
            if path.name not in names:
                yield f"{path}: is not asked; there are: {', '.join(sorted(names))}"
