"""What a track is: its question, what is given, what an answer is, how it is scored, run, and shown on a board.

Each track is one class below ``Track``; ``track_list`` has all. Its protocol, ``id``, never changes: what would
change scores is a protocol with another number.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import pandas as pd

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.components.cards import choices
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.jobs.workers import Workers
from rsbench.pipeline.problem import Problem

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.splits import Split, Truth
    from rsbench.benchmark.leaderboard.submissions import Submission
    from rsbench.benchmark.leaderboard.true_pictures import Asked, TruePictures
    from rsbench.dataset.sequence import Sequence

KNOWLEDGE = {
    "left": "matches over time of the left camera",
    "right": "matches over time of the right camera",
    "links": "which matches of the two cameras are of one point",
    "readout": "the readout ratio",
    "images": "the images, and with them matches of its own",
    "stereo": "images of the other camera",
    "time": "images of the other time",
    "gyro": "the angular rates of a gyroscope",
    "gravity": "the direction of gravity",
    "affine": "the affine frames of matches over time of the left camera",
    "truth": "the truth: an oracle, which has no rank",
}
"""What methods use, in the order of tables."""
ORACLE = "truth"
CHUNK = 10
"""Problems of one job."""
Kind = Literal["share", "mean", "median"]
Row = dict[str, Any]
Step = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Score:
    """A column of scores.csv that tables show."""

    key: str
    title: str
    hint: str
    """What it is, in a line."""
    kind: Kind
    """How problems are summed up: a ``share`` lies in [0, 1], a ``mean`` anywhere; both are means over scenes with
    an interval. A ``median`` is one over problems."""
    better: Literal["lower", "higher"] = "lower"

    @property
    def sign(self) -> float:
        """What makes more of it better."""
        return 1.0 if self.better == "higher" else -1.0


FAILED = Score(key="failure", title="failed", hint="share of problems without an answer", kind="share")
SECONDS = Score(key="seconds", title="s", hint="median time of a problem, as stated", kind="median")


class Limits(NamedTuple):
    """What a method may take for one problem, in a process that ends when it takes more; None: no limit."""

    seconds: float | None = None
    memory_mb: float | None = None

    @property
    def chunk(self) -> int:
        """Problems of one job: a job that takes too much is the failure of one problem."""
        return CHUNK if self == Limits() else 1


class Track(ABC):
    """One way of asking for motions, readout ratios or pictures."""

    name: ClassVar[str]
    """On the command line."""
    id: ClassVar[str]
    """Of its protocol; what submissions name."""
    title: ClassVar[str]
    allowed: ClassVar[tuple[str, ...]]
    """What of ``KNOWLEDGE`` it gives."""
    given: ClassVar[str]
    """The inputs, in words."""
    scores: ClassVar[tuple[Score, ...]]
    """Of its tables; methods are ranked by the first."""
    error: ClassVar[str]
    """The column of scores.csv that decides about the primary score."""
    error_title: ClassVar[str]
    """What figures call it."""
    exact: ClassVar[Mapping[str, float]]
    """Errors of scores.csv, each with the value below which the truth itself was submitted: no method is so near.
    Each is judged alone, so that a false part of an answer does not hide a true one."""
    answers: ClassVar[type[Answer]]
    """What a line of a file of predictions must hold."""
    pictures: ClassVar[bool] = False
    """Whether an answer is made of pictures beside the file of answers."""
    asks_rows: ClassVar[bool] = False
    """Whether pictures are of the times of rows."""
    own_matches: ClassVar[bool] = False
    """Whether matches may be handed in with motions."""
    rendered: ClassVar[bool] = False
    """Whether problems are rendered frames."""
    whole: ClassVar[bool] = False
    """Whether a problem is a whole sequence, of whose true depth scores are made."""
    beside: ClassVar[tuple[str, ...]] = ("failure",)
    """Shares and means that short tables show beside the primary score."""
    unknowns: ClassVar[int] = 6
    """Degrees of freedom of the column ``nees``, where answers state deviations."""
    parting: ClassVar[str] = ""
    """A column of scores.csv by whose values tables divide the primary score; empty: by none."""
    smoke: ClassVar[tuple[str, ...]] = ()
    """Entries of a smoke run: what rsbench has by default, the strongest that cost little, and oracles."""
    smoke_metrics: ClassVar[tuple[str, ...]]
    """Columns of scores that a smoke run compares."""

    # Inputs

    @abstractmethod
    def split(self, data: Path | None, seed_file: Path | None = None, secret: bool = False) -> Split:
        """The problems with their truth, of a dataset or a seed.

        Raises:
            RsbenchError: an option that the track does not take, or misses; the dataset or the seed is at fault.
        """

    @abstractmethod
    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        """What a method is given of the first ``count``, without images."""

    @property
    def gives_images(self) -> bool:
        """Whether the frames are given."""
        return "images" in self.allowed

    @property
    def gives_readout(self) -> bool:
        """Whether the readout ratio is given."""
        return "readout" in self.allowed

    # Predictions

    @abstractmethod
    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        """The truth as an answer, but for its name and its pictures."""

    @abstractmethod
    def write_truth(self, split: Split, folder: Path, file: str = "predictions.jsonl") -> Path:
        """Write the truth as a submission; returns its file of answers."""

    @abstractmethod
    def write_template(self, split: Split, path: Path) -> None:
        """Write an example without a fault: an answer to the first problem, and a failure for every other."""

    def files_of(self, submission: Submission, split: Split) -> Iterable[str]:
        """Paths of all that the answers hold beside their file."""
        return ()

    def check_beside(
        self, submission: Submission, split: Split, most: int, hints: bool
    ) -> tuple[list[str], list[str]]:
        """Faults of what lies beside a file, ``most`` at most, and with ``hints`` what may be meant."""
        return [], []

    def notes(self, answers: Series[Answer], split: Split) -> Iterator[str]:
        """What may be meant by the answers of a public split."""
        yield from ()

    @abstractmethod
    def load(self, cards: Series[str]) -> None:
        """Raises RsbenchError when a card is wrong, or is none of the track's kind."""

    @abstractmethod
    def steps(self, cards: Series[str], split: Split, limits: Limits) -> int:
        """How often ``run`` reports progress."""

    @abstractmethod
    def run(self, cards: Series[str], split: Split, inputs: Path, work: Path, **options: Any) -> list[Path]:
        """Run cards on exported inputs; returns for each a file of predictions in ``work``, ready to be submitted.

        ``options`` are ``workers``, ``limits`` and ``step``, as of ``running.run_cards``.
        """

    # Marking

    def asked(self, sequence: Sequence) -> tuple[Asked, ...]:
        """The pictures of an answer."""
        return ()

    def shown(self, sequence: Sequence) -> tuple[str, ...]:
        """Files of a sequence that methods see beside its frames."""
        return ()

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], dict[str, float]]:
        """Scores of the pictures of submissions to one problem, by whether it is none that failed."""
        raise NotImplementedError(f"track {self.name!r} asks for no pictures")

    @abstractmethod
    def mark(
        self, submissions: Series[Submission], split: Split, workers: Workers, step: Step, kept: Path | None
    ) -> list[pd.DataFrame | RsbenchError]:
        """See ``marking.mark_all``."""

    # The board

    @property
    def primary(self) -> Score:
        """By which methods are ranked."""
        return self.scores[0]

    @abstractmethod
    def oracles(self, split: Split, folder: Path) -> Iterator[Path]:
        """Files of predictions, below ``folder``, that show how much there is to gain: the truth, and others."""

    def medians_at_bound(self, uses: Collection[str], split: Split) -> Mapping[str, FloatArray]:
        """By column of scores.csv, the median (problems,) of errors at the Cramer-Rao bound of what a method uses.

        Infinite where its data say nothing; no columns where no bound is known.
        """
        return {}

    def of_kind(self, *kinds: Kind) -> tuple[str, ...]:
        """Keys of the scores of these kinds."""
        return tuple(score.key for score in self.scores if score.kind in kinds)

    def check_uses(self, uses: Collection[str]) -> None:
        """Raises ValueError when a method uses what does not exist, or what this protocol does not give."""
        for name in uses:
            if name not in KNOWLEDGE:
                raise ValueError(f"uses: {name!r} is unknown{choices(name, KNOWLEDGE)}")
            if name not in (*self.allowed, ORACLE):
                raise ValueError(
                    f"uses: {name!r} is not given by {self.id}, which gives {', '.join(self.allowed)}"
                )
        if not uses:
            raise ValueError(f"uses: must name what the method works on, of {', '.join(self.allowed)}")
        if len(set(uses)) < len(uses):
            raise ValueError("uses: names something twice; once is enough")
