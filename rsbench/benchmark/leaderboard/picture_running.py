"""Running cards of stereo matchers and correctors: predictions first, each problem kept as soon as it is made.

A job is one problem, for all cards whose answer is not current: matchers share the motion, correctors the motion
and the depth. The seconds of an entry are those that it would have taken alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rsbench.benchmark.images.store import identity_of, read_record
from rsbench.benchmark.leaderboard.frame_inputs import read_frames
from rsbench.benchmark.leaderboard.picture_files import FOLDER
from rsbench.benchmark.leaderboard.running import jobs_done, read_inputs
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import submission_text
from rsbench.benchmark.leaderboard.track import Limits
from rsbench.benchmark.leaderboard.true_pictures import Asked
from rsbench.benchmark.provenance import numeric_version, processor
from rsbench.capture.settle import AUTO
from rsbench.components.plugins import Entry
from rsbench.core.errors import RsbenchError
from rsbench.jobs.isolation import use_one_thread
from rsbench.jobs.workers import Workers
from rsbench.pipeline.chain import Given
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.isolated_parts import Isolation
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.warm_up import warm_up
from rsbench.storage.files import write_bytes, write_json
from rsbench.storage.untrusted_files import check_name
from rsbench.storage.work_folder import remove

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.picture_track import PictureTrack


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
