"""What a track is: its question, what is given, what an answer is, how it is scored, run, and shown on a board.

Each track is one class below ``Track``; ``track_list`` has all. Its protocol, ``id``, never changes: what would
change scores is a protocol with another number.
"""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.pictures import Asked, TruePictures
from rsbench.components.cards import choices
from rsbench.components.motion_models import motion_record
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import LaterMotion, Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.jobs.process_jobs import Workers
from rsbench.pipeline.problem import Problem, problem_record
from rsbench.storage.untrusted_files import check_name

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

    def notes(self, answers: Sequence[Answer], split: Split) -> Iterator[str]:
        """What may be meant by the answers of a public split."""
        yield from ()

    @abstractmethod
    def load(self, cards: Sequence[str]) -> None:
        """Raises RsbenchError when a card is wrong, or is none of the track's kind."""

    @abstractmethod
    def steps(self, cards: Sequence[str], split: Split, limits: Limits) -> int:
        """How often ``run`` reports progress."""

    @abstractmethod
    def run(self, cards: Sequence[str], split: Split, inputs: Path, work: Path, **options: Any) -> list[Path]:
        """Run cards on exported inputs; returns for each a file of predictions in ``work``, ready to be submitted.

        ``options`` are ``workers``, ``limits`` and ``step``, as of ``running.run_cards``.
        """

    # Marking

    def asked(self, sequence: Rendered) -> tuple[Asked, ...]:
        """The pictures of an answer."""
        return ()

    def shown(self, sequence: Rendered) -> tuple[str, ...]:
        """Files of a sequence that methods see beside its frames."""
        return ()

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], dict[str, float]]:
        """Scores of the pictures of submissions to one problem, by whether it is none that failed."""
        raise NotImplementedError(f"track {self.name!r} asks for no pictures")

    @abstractmethod
    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Path | None
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


# What stands in a file of predictions: the header, and what answers of all tracks have in common.

LARGEST = 1e9
"""Number of w and d: larger ones are no motions, and their squares overflow."""
LEAST_D = 1e-9
"""Length of ``d`` in metres or units of the method's own; a shorter one is no direction, but for zero."""
_TEXT_CHARACTERS = 300
Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Header:
    """The first line: which split it is about, what the method is and what it uses."""

    protocol: str
    """Identifier of the track's protocol, as ``rsbench leaderboard template`` prints it."""
    split: str
    """Name of the split that was solved."""
    method: str
    """Name of the method on the board: letters, digits, dots, dashes and underscores."""
    uses: tuple[str, ...]
    """What the method takes of what its protocol allows."""
    version: str = ""
    """Version of the method."""
    description: str = ""
    """What the method does."""
    authors: str = ""
    """Who made the method."""
    paper: str = ""
    """Where the method is published."""
    code: str = ""
    """Where its code is."""
    licence: str = ""
    """Licence of the code."""
    hardware: str = ""
    """Machine on which the seconds were measured."""
    tuned_on: str = ""
    """Data by which its parameters were chosen."""
    motion_model: Literal["linear", "twist", "inertial", "accelerated", "spline", "none", "chosen"] = "linear"
    """Motion model that the method assumes between the rows: ``none`` of a global shutter, ``chosen`` where the
    matches of a problem decide."""
    png_unit_m: float | None = None
    """Metres of one step of depth maps that are PNG files, above 0 and at most 1."""

    def __post_init__(self) -> None:
        try:
            check_name(self.method)
        except ValueError as error:
            raise ValueError(str(error).replace("name =", "method =", 1)) from error
        if self.png_unit_m is not None and not 0.0 < self.png_unit_m <= 1.0:
            raise ValueError(f"png_unit_m = {self.png_unit_m}: must be above 0 and at most 1 m")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, str) and (len(value) > _TEXT_CHARACTERS or not value.isprintable()):
                raise ValueError(f"{field.name}: must be one line of at most {_TEXT_CHARACTERS} characters")

    def check_uses(self, track: Track, where: str) -> None:
        """Raises RsbenchError when the method uses what its track does not give."""
        try:
            track.check_uses(self.uses)
        except ValueError as error:
            raise RsbenchError(f"{where}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One motion or failure, as ``rsbench solve --json`` prints it."""

    name: str
    """Name of the problem."""
    success: bool = True
    """Whether the method found an answer; a failure counts as the worst score."""
    reason: str = ""
    """Why it failed."""
    w: Vector | None = None
    """Rotation vector of one frame period, radians."""
    d: Vector | None = None
    """Translation of one frame period; metres where ``metric`` is true."""
    metric: bool = False
    """Whether the length of ``d`` is in metres."""
    reference_point: Literal["body", "left"] = "body"
    """Point whose translation ``d`` is: the middle of the baseline or the left camera."""
    direction_known: bool = True
    """Whether the direction of ``d`` means anything."""
    readout_ratio: float | None = None
    """Estimated readout ratio, 0 to 1, where the track asks it instead of a motion."""
    readout_sigma: float | None = None
    """Standard deviation of ``readout_ratio``, where it is stated."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """6 x 6 covariance of ``w`` and ``d``, symmetric."""
    seconds: float | None = None
    """Seconds that the method took for the problem."""

    def __post_init__(self) -> None:
        ratio = self.readout_ratio
        for name in ("w", "d"):
            if np.any(np.abs(np.array(getattr(self, name) or (0.0, 0.0, 0.0))) > LARGEST):
                raise ValueError(f"{name}: numbers must lie within {LARGEST:g} of 0")
        if self.d is not None and any(self.d) and not LEAST_D <= math.hypot(*self.d) <= LARGEST:
            raise ValueError(
                f"d: has length {math.hypot(*self.d):g}: must be 0, or from {LEAST_D:g} to {LARGEST:g}; scale it"
            )
        if ratio is not None and not 0.0 <= ratio <= 1.0:
            raise ValueError(f"readout_ratio = {ratio}: must lie in [0, 1]: readout time / frame period")
        if self.readout_sigma is not None and not 0.0 <= self.readout_sigma <= 1.0:
            raise ValueError(f"readout_sigma = {self.readout_sigma}: must lie in [0, 1]")
        if self.seconds is not None and self.seconds < 0.0:
            raise ValueError(f"seconds = {self.seconds}: must not be negative")
        if self.covariance is not None and (
            len(self.covariance) != 6 or any(len(row) != 6 for row in self.covariance)
        ):
            raise ValueError("covariance: must be 6 x 6 numbers, of w and d")
        if self.covariance is not None and not _symmetric(np.array(self.covariance)):
            raise ValueError("covariance: must be symmetric: both halves of it are asked")


def _symmetric(covariance: FloatArray) -> bool:
    """To 0.001 of the standard deviations of row and column: rounded numbers are, a triangle alone is not."""
    sizes = np.sqrt(np.abs(np.diag(covariance)))
    with np.errstate(over="ignore"):
        return bool(np.all(np.abs(covariance - covariance.T) <= 1e-3 * np.outer(sizes, sizes)))


# Scores of submissions, a row for each problem: by the one scorer of their track, and by nothing else.
#
# A problem without an answer is a failure, and a failure scores the worst value of everything. Pictures take
# longest: they are scored problem by problem, for what is found of the truth serves all entries, each problem in
# one process of one thread. A score does not depend on which process it comes from, or on the other entries: none
# draws at random, or adds in an order of its own.

Numbers = dict[str, float]


def mark(submission: Submission, split: Split, workers: Workers = 1) -> pd.DataFrame:
    """One row for each problem, in the order of the split; the columns are those of docs/how-to/submit.md.

    Args:
        submission: what was answered.
        split: the truth.
        workers: processes, which score pictures; the rest takes no time.

    Raises:
        RsbenchError: a picture is at fault, or the truth has changed since the split was read.
    """
    (found,) = mark_all([submission], split, workers)
    if isinstance(found, RsbenchError):
        raise found
    return found


def mark_all(
    submissions: Sequence[Submission],
    split: Split,
    workers: Workers = 1,
    step: Step = lambda word: None,
    kept: Path | None = None,
) -> list[pd.DataFrame | RsbenchError]:
    """``mark`` of several submissions, which share what is found of the truth; an error is that of one of them.

    Args:
        submissions, split, workers: as of ``mark``.
        step: called with the name of each problem whose pictures are scored.
        kept: folder for what is done of them, so that a run that is cut off goes on there.

    Raises:
        RsbenchError: the truth has changed since the split was read.
    """
    return split.track.mark(submissions, split, workers, step, kept)


def named(truth: Truth, success: bool) -> Row:
    """The first columns."""
    return {"problem": truth.name, "scene": truth.scene, "success": success}


def last(success: bool, answer: Answer | None) -> Row:
    """The last columns."""
    seconds = math.nan if answer is None or answer.seconds is None else answer.seconds
    return {"failure": float(not success), "seconds": seconds}


# The problems of a split with their truth: drawn from a seed, or those of a rendered dataset.
#
# A split is known by its name and a fingerprint of its truth. The fingerprint can be announced before a
# competition: whoever is told the seed or is given the dataset afterwards finds the same one.

PUBLIC_SEED = 1
"""Of the split ``dev``: its truth is known to everybody."""
_ANNOUNCED = {
    "b7eafa489ffbd9d816c2edd44f5842bdf01306f286ab36dd2c0ef72aee05523b": "f88c896f00000000",
    "57af81babdeeb5d96992052241698c127f8a4e7fd716fc28f146bf858b8edb40": "7a998de400000000",
    "881e9e954f8a3cc3c1bd3d11fcca7277b3af27da058d3a2340487ac84d1e7c89": "292f151500000000",
    "792e3e2e7ccfbdaefda940050f3d95c9e814a517eb48c4e618b200bb37b608ee": "ba1e206a00000000",
    "ee83b3153351ba62775f40dedeba0d2bfeb9c8c036fe6eefa6332c92b9e48b29": (
        "382c1320481b8b75aae3ba87190f80b7d671d73c323961e95e6bee131c507e77"
    ),
}
"""By the hash of the truth to nine digits, equal on all processors, the fingerprint that was announced: of the
public points, and of the motions of ``laws``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """The true motion of one problem, and what is known of it."""

    name: str
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    scene: str
    """Problems of one scene are not independent: intervals count scenes."""
    facts: dict[str, float | str]
    """What scores may be drawn against."""
    sequence: Rendered | None = None
    """Of rendered frames: where their truth lies."""
    pictures: TruePictures | None = None
    """Where pictures are asked."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """The truth of all problems of a track."""

    track: Track
    label: str
    """``dev``, ``test``, or the name of the dataset."""
    public: bool
    """Whether the truth may be told."""
    truths: tuple[Truth, ...]
    seed: int = PUBLIC_SEED
    """Of problems that are simulated."""

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the protocol, the rigs, the true motions, and what is seen where pictures are asked."""
        content = [self.track.id, *(_identity(truth) for truth in self.truths)]
        return _ANNOUNCED.get(hash_of(_rounded(content))) or hash_of(content)

    @property
    def name(self) -> str:
        """The label, and enough of the fingerprint that no two splits are taken for one."""
        return f"{self.label}-{self.fingerprint[:8]}"

    @cached_property
    def by_name(self) -> dict[str, Truth]:
        return {truth.name: truth for truth in self.truths}


def hash_of(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _rounded(content: Any) -> Any:
    """With numbers to nine digits: exp and sin differ in the last bit between processors."""
    if isinstance(content, float):
        return f"{content:.9g}"
    if isinstance(content, dict):
        return {key: _rounded(value) for key, value in content.items()}
    return [_rounded(each) for each in content] if isinstance(content, list | tuple) else content  # pyrefly: ignore


def _identity(truth: Truth) -> dict[str, Any]:
    problem = Problem(
        name=truth.name, correspondences=Correspondences(), rig=truth.rig, known_shutter=truth.shutter
    )
    seen = {} if truth.pictures is None else {"files": truth.pictures.files}
    return {**problem_record(problem), "motion": _motion_identity(truth.motion), **seen}


def _motion_identity(motion: Motion) -> dict[str, Any]:
    """Of a pair of frames in a longer way: the whole way, and where it begins."""
    if isinstance(motion, LaterMotion):
        return {"later": motion_record(motion.motion), "start": motion.start}
    return motion_record(motion)


# Predictions that anybody hands in: JSON lines, a header and an answer for each problem. A fault is a line.
#
# Nothing that stands there is believed: sizes are limited before anything is decoded, names are looked up among
# those of the split and are never paths, and numbers are finite. docs/how-to/submit.md is the format.


@dataclass(frozen=True, kw_only=True, eq=False)
class Submission:
    """A file without faults."""

    header: Header
    answers: Mapping[str, Answer]
    """By the name of the problem."""
    folder: Path
    """Of the file; what answers hold beside it lies there."""
