"""Base class of the leaderboard's tracks, and their data: problems with truth, answers, submissions, scores.

A track is an instance of a subclass of ``Track``; each module of tracks has a list ``TRACKS`` at its end. Its
protocol, ``id``, never changes: a change that affects scores makes a new protocol with the next number.
"""

from __future__ import annotations

import hashlib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.pictures import RequestedPicture, TruePictures
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
"""Inputs that methods may use, in the order of tables."""
ORACLE = "truth"
CHUNK = 10
"""Number of problems of one job of a solver."""
PUBLIC_SEED = 1
"""Seed of the split ``dev``, whose truth is public."""
LARGEST = 1e9
"""Limit of the components of w and d; larger values are implausible, and their squares may overflow."""
LEAST_D = 1e-9
"""Smallest length of a nonzero ``d``, in metres or the method's own unit."""
_TEXT_CHARACTERS = 300
_ANNOUNCED = {
    "b7eafa489ffbd9d816c2edd44f5842bdf01306f286ab36dd2c0ef72aee05523b": "f88c896f00000000",
    "57af81babdeeb5d96992052241698c127f8a4e7fd716fc28f146bf858b8edb40": "7a998de400000000",
    "881e9e954f8a3cc3c1bd3d11fcca7277b3af27da058d3a2340487ac84d1e7c89": "292f151500000000",
    "792e3e2e7ccfbdaefda940050f3d95c9e814a517eb48c4e618b200bb37b608ee": "ba1e206a00000000",
    "8e3e498cc845d26180c700acbb98147069d89a2cc0280f297b8456638ca1239a": "0bc5964200000000",
    "ee83b3153351ba62775f40dedeba0d2bfeb9c8c036fe6eefa6332c92b9e48b29": (
        "382c1320481b8b75aae3ba87190f80b7d671d73c323961e95e6bee131c507e77"
    ),
    "c748fcf5effc5f5293eab32b091bd556929eb714be241a2195780639eef4adcf": (
        "d432b58dd04f4353f6ce0631db5740e63c994e6966abcb9824830ae6f98dcdce"
    ),
    "ef8f2047bab3cc3881709c6582c1f96567efb3aee8147bbbb2ae50873ce7ff39": (
        "9329dd1ab9a50dee717f6515e66785be690c95acbaa35d3c8856d4280ebc3272"
    ),
    "51ed76848fe56a6b53a86bc5749f9ac43490b4fa45135771edaacefb59155c66": (
        "5fc20df13a159989134fd315cb2af1df41a27ea634296d38d795f268e7dc6878"
    ),
    "250364f90e38c32b89e543ff73ff06f3e7cbee1238a122bc247413308eed2bf3": (
        "50ec84b75f8a7f5710e2227ee9fb963c3dd6024dc75f33cbdbcf119c4374a395"
    ),
}
"""Announced fingerprints of the splits of points and recordings, public and held-out, and of the motions of the
datasets ``laws`` and ``handheld``. The key is a hash of the truth rounded to nine digits, which is the same on all
processors."""
Kind = Literal["share", "mean", "median"]
Row = dict[str, Any]
Numbers = dict[str, float]
Step = Callable[[str], None]
Checked = tuple[list[str], list[str]]
"""Faults and likely mistakes, one line each."""
Kept = tuple[Path, str]
"""Folder of stored scores, and their identity."""
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Score:
    """A column of scores.csv that is shown in tables."""

    key: str
    title: str
    hint: str
    """Explanation in one line."""
    kind: Kind
    """How the values of all problems are summarised: ``share`` (values in [0, 1]) and ``mean`` are means over
    scenes with an interval; ``median`` is the median over problems."""
    better: Literal["lower", "higher"] = "lower"

    @property
    def sign(self) -> float:
        """1 or -1; after multiplication by it, larger values are better."""
        return 1.0 if self.better == "higher" else -1.0


FAILED = Score("failure", "failed", "share of problems without an answer", "share")
SECONDS = Score("seconds", "s", "median time of a problem, as stated", "median")


class Limits(NamedTuple):
    """Time and memory limits per problem; a process that exceeds them is ended. None: no limit."""

    seconds: float | None = None
    memory_mb: float | None = None


# Contents of a file of predictions


@dataclass(frozen=True, kw_only=True)
class Header:
    """The first line of a file of predictions: the split, the method and its inputs."""

    protocol: str
    """Identifier of the track's protocol, as ``rsbench leaderboard template`` prints it."""
    split: str
    """Name of the split that the predictions are for."""
    method: str
    """Name of the method on the board: letters, digits, dots, dashes and underscores."""
    uses: tuple[str, ...]
    """Names of the inputs that the method uses, out of those that the protocol gives."""
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
    """Machine on which the run times were measured."""
    tuned_on: str = ""
    """Data with which its parameters were chosen."""
    motion_model: Literal["linear", "twist", "inertial", "accelerated", "spline", "none", "chosen"] = "linear"
    """Motion model that the method assumes between the rows: ``none`` for a global shutter, ``chosen`` if it is
    selected by the matches of each problem."""
    png_unit_m: float | None = None
    """Depth, metres, of one grey level of depth maps that are PNG files, above 0 and at most 1."""

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
    """Whether the direction of ``d`` is determined."""
    readout_ratio: float | None = None
    """Estimated readout ratio, 0 to 1, on tracks of the readout ratio, which request no motion."""
    readout_sigma: float | None = None
    """Standard deviation of ``readout_ratio``, if it is stated."""
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
            raise ValueError("covariance: must be symmetric: give both halves of it")

    def refuse_numbers(self, instead: str) -> None:
        """Raise ValueError if the answer contains a motion, a readout ratio or a covariance."""
        for name in ("w", "d", "readout_ratio", "covariance"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: does not belong here; {instead}")


def _symmetric(covariance: FloatArray) -> bool:
    """Whether a covariance is symmetric to 0.001 of its standard deviations, which allows for rounded numbers."""
    sizes = np.sqrt(np.abs(np.diag(covariance)))
    with np.errstate(over="ignore"):
        return bool(np.all(np.abs(covariance - covariance.T) <= 1e-3 * np.outer(sizes, sizes)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Submission:
    """A valid file of predictions."""

    header: Header
    answers: Mapping[str, Answer]
    """Answers by the name of the problem."""
    folder: Path
    """Folder that contains the file and the pictures and matches of its answers."""


# Problems with their truth


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """One problem with its ground truth."""

    name: str
    rig: StereoRig
    shutter: RollingShutter
    motion: Motion
    scene: str
    """Name of the scene. Problems of a scene are not independent, so intervals are computed from scene means."""
    facts: dict[str, float | str]
    """Properties of the problem against which figures plot the scores."""
    sequence: Rendered | None = None
    """The rendered sequence with its ground truth; None for simulated points."""
    pictures: TruePictures | None = None
    """True pictures, on tracks whose answers are pictures."""
    given_rig: StereoRig | None = None
    """The rig that methods are given, if it is not the true one."""

    @property
    def rendered(self) -> Rendered:
        """The sequence, on tracks of rendered frames."""
        assert self.sequence is not None
        return self.sequence

    @property
    def shown(self) -> TruePictures:
        """The true pictures, on tracks whose answers are pictures."""
        assert self.pictures is not None
        return self.pictures


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """A set of problems of a track, with their ground truth."""

    track: Track
    label: str
    """``dev``, ``test``, or the name of the dataset."""
    public: bool
    """Whether the truth may be published."""
    truths: tuple[Truth, ...]
    seed: int = PUBLIC_SEED
    """Seed of simulated problems."""
    draws: Any = None
    """Distribution of simulated problems, a ``splits.Draws``; None for rendered frames."""

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the protocol, the rigs, the true motions, and the true pictures.

        It can be announced before a competition; with the seed or the dataset, anyone can verify it afterwards.
        """
        content = [self.track.id, *(_identity(truth) for truth in self.truths)]
        return _ANNOUNCED.get(_hash_of(_rounded(content))) or _hash_of(content)

    @property
    def name(self) -> str:
        """The label and the first eight digits of the fingerprint."""
        return f"{self.label}-{self.fingerprint[:8]}"

    @cached_property
    def by_name(self) -> dict[str, Truth]:
        return {truth.name: truth for truth in self.truths}


def _hash_of(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _rounded(content: Any) -> Any:
    """Round numbers to nine digits, because exp and sin differ in the last bit between processors."""
    if isinstance(content, float):
        return f"{content:.9g}"
    if isinstance(content, dict):
        return {key: _rounded(value) for key, value in content.items()}
    return [_rounded(each) for each in content] if isinstance(content, list | tuple) else content  # pyrefly: ignore


def _identity(truth: Truth) -> dict[str, Any]:
    problem = Problem(
        name=truth.name, correspondences=Correspondences(), rig=truth.rig, known_shutter=truth.shutter
    )
    motion = truth.motion
    if isinstance(
        motion, LaterMotion
    ):  # two frames of a longer sequence, identified by its motion and the time of the first frame
        moved = {"later": motion_record(motion.motion), "start": motion.start}
    else:
        moved = motion_record(motion)
    files = {} if truth.pictures is None else {"files": truth.pictures.files}
    given = {} if truth.given_rig is None else {"given": problem_record(replace(problem, rig=truth.given_rig))}
    return {**problem_record(problem), "motion": moved, **files, **given}


# Tracks


class Inputs(ABC):
    """The source of the problems of a track."""

    rendered: ClassVar[bool] = True
    """Whether the problems are rendered frames."""
    whole: ClassVar[bool] = False
    """Whether a problem is a whole sequence."""

    @abstractmethod
    def split(self, track: Track, data: Path | None, seed_file: Path | None, secret: bool) -> Split:
        """See ``Track.split``."""

    @abstractmethod
    def problems(self, track: Track, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        """See ``Track.problems``."""


class Runnable(NamedTuple):
    """A component that a track can run, loaded from its card."""

    name: str
    """Name of its entry."""
    built_in: bool
    key: object
    """All data that determine its answers, apart from the inputs; it can be written as JSON."""
    header: Mapping[str, Any]
    """Fields of the header of its file of predictions."""
    model: str = "linear"
    """Motion model whose code is compiled before the run."""


class Target(NamedTuple):
    """A card that a job runs, and the place of its answers."""

    card: str
    folder: Path
    """Folder of the predictions of the card."""
    identity: str
    """Identity of the answers of the job, see ``images.store.identity_of``."""
    record: Path
    """File in which these answers are stored, see ``images.store.keep``."""


class Job(NamedTuple):
    """Problems that one process solves with one card, or with several cards that share intermediate results."""

    problems: tuple[str, ...]
    targets: tuple[Target, ...]
    requested: tuple[RequestedPicture, ...] = ()

    def __str__(self) -> str:
        return f"{', '.join(target.folder.name for target in self.targets)}: problem {', '.join(self.problems)}"


Solve = Callable[[Job], Iterator[list[dict[str, Any]]]]
"""Function that solves a job, and yields the answers for each of its targets."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Track(ABC):
    """A task of the leaderboard: its inputs, the type of its answers, their scores, and the columns of its tables.

    The fields describe one track; a subclass implements what tracks with the same type of answer have in common.
    """

    name: str
    """Name on the command line."""
    id: str
    """Name of its protocol, which submissions state."""
    title: str
    allowed: tuple[str, ...]
    """Names of ``KNOWLEDGE``: the inputs that methods may use."""
    given: str
    """Description of the inputs."""
    inputs: Inputs
    scores: tuple[Score, ...]
    """Columns of its tables; methods are ranked by the first one."""
    error: str
    """The error column of scores.csv that belongs to the primary score; it selects the worst problems."""
    error_title: str
    """Title of this column in figures."""
    exact: Mapping[str, float]
    """Threshold of each error column that no method reaches: smaller errors show that the ground truth was
    submitted. Columns are tested separately, so that a wrong part of an answer does not hide an exact one."""
    beside: tuple[str, ...] = ("failure",)
    """Keys of the shares and means that short tables show next to the primary score."""
    parting: str = ""
    """A column of scores.csv; tables show the primary score separately for each of its values. Empty: none."""
    unknowns: int = 6
    """Degrees of freedom of the column ``nees``, if answers have covariances or standard deviations."""
    oracles: tuple[tuple[str, Callable[[Split, Path], str]], ...] = ()
    """Entries that use the truth, in addition to the truth itself: for each, its name and a function that writes
    its pictures into a folder, if there are any, and returns its file of answers."""
    smoke: tuple[str, ...] = ()
    """Entries of a smoke run: rsbench's defaults, fast strong methods, and oracles."""
    smoke_metrics: tuple[str, ...] = ()
    """Columns of scores that a smoke run compares."""
    answers: ClassVar[type[Answer]] = Answer
    """Type of a line of a file of predictions."""
    pictures: ClassVar[bool] = False
    """Whether an answer consists of pictures in addition to the file of answers. Cards that make them share
    intermediate results of a problem, so that one job runs all of them."""
    own_matches: ClassVar[bool] = False
    """Whether methods find matches themselves, and may submit them with the motions."""
    at_rows: ClassVar[bool] = False
    """Whether each picture is a frame corrected to the time of one row."""

    # Inputs

    def split(self, data: Path | None, seed_file: Path | None = None, secret: bool = False) -> Split:
        """Return the problems of a dataset or a seed, with their ground truth.

        Raises:
            RsbenchError: an option that the track does not take is given, or a required one is missing; the
                dataset or the seed is invalid.
        """
        return self.inputs.split(self, data, seed_file, secret)

    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        """Return the first ``count`` problems as they are given to methods, without images."""
        return self.inputs.problems(self, data, seed_file, count)

    @property
    def gives_images(self) -> bool:
        """Whether the frames are given."""
        return "images" in self.allowed

    @property
    def gives_readout(self) -> bool:
        """Whether the readout ratio is given."""
        return "readout" in self.allowed

    def requested(self, sequence: Rendered) -> tuple[RequestedPicture, ...]:
        """Return the pictures that an answer must contain."""
        return ()

    # Predictions

    @abstractmethod
    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        """Return the ground truth as an answer, without its name and pictures."""

    @abstractmethod
    def example(self, split: Split) -> Mapping[str, Any]:
        """Return an example answer to the first problem, for a template, without its name and pictures."""

    def draw_truth(self, split: Split, folder: Path) -> None:  # noqa: B027  most tracks have none
        """Write the true pictures, if any."""

    def draw_example(self, split: Split, folder: Path) -> None:  # noqa: B027
        """Write the pictures of ``example``, if any."""

    def files_of(self, submission: Submission, split: Split) -> Iterable[str]:
        """Return the paths of a submission's pictures and matches, relative to its folder."""
        return ()

    def check_files(self, submission: Submission, split: Split, most: int, hints: bool) -> Checked:
        """Return at most ``most`` faults of answers and their files, and with ``hints`` also likely mistakes."""
        return [], []

    def notes(self, answers: Sequence[Answer], split: Split) -> Iterator[str]:
        """Yield likely mistakes in submitted motions, by comparison with a public truth."""
        yield from ()

    # Running

    @abstractmethod
    def runnable(self, card: str) -> Runnable:
        """Load the component of a card; RsbenchError if the card is invalid, or does not fit the track."""

    def load(self, cards: Sequence[str]) -> dict[str, Runnable]:
        """Load the components of cards; returns them by card. Errors are those of ``runnable``."""
        return {card: self.runnable(card) for card in cards}

    def prepare(self, split: Split, inputs: Path, work: Path, step: Step, features: str | None) -> Path:
        """Return the folder of inputs for cards: ``inputs``, or one in ``work`` if they need additional inputs."""
        return inputs

    def copy_files(self, inputs: Path, folder: Path) -> None:  # noqa: B027
        """Copy from ``inputs`` the files that a submission has in addition to its answers, if there are any."""

    @abstractmethod
    def solver_of_jobs(self, inputs: Path, limits: Limits) -> Solve:
        """Return a function that solves jobs from exported inputs, in the process that runs the jobs."""

    def chunk(self, limits: Limits) -> int:
        """Return the number of problems per job: one if there are limits, so that a job that exceeds them is the
        failure of only one problem."""
        return 1

    # Scores

    @abstractmethod
    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Kept | None
    ) -> list[pd.DataFrame | RsbenchError]:
        """Score submissions, which share intermediate results of the truth; returns a table or an error for each.

        A table has one row for each problem, in the order of the split; docs/how-to/submit.md names the columns. A
        problem without an answer is a failure, and a failure gets the worst value of every score.

        Args:
            submissions: the answers.
            split: the truth.
            workers: processes that score pictures; other scores are computed in this process.
            step: called with the name of each problem whose pictures are scored.
            kept: folder and identity under which scores of pictures are stored, so that an interrupted run
                resumes; None: they are not stored.

        Raises:
            RsbenchError: the truth has changed since the split was read.
        """

    def medians_at_bound(self, uses: Collection[str], split: Split) -> Mapping[str, FloatArray]:
        """Return the median errors (problems,) at the Cramer-Rao bound of the inputs ``uses``, by error column.

        A median is infinite if the data do not determine the value; there are no columns if no bound is known.
        """
        return {}

    def part_of(self, truth: Truth) -> Row:
        """Return the column ``parting`` of a problem, if there is one: the property of this name, or else the
        name of the motion model."""
        return {self.parting: truth.facts.get(self.parting, truth.motion.name)} if self.parting else {}

    @property
    def primary(self) -> Score:
        """The score by which methods are ranked."""
        return self.scores[0]

    def of_kind(self, *kinds: Kind) -> tuple[str, ...]:
        """Return the keys of the scores of these kinds."""
        return tuple(score.key for score in self.scores if score.kind in kinds)

    def check_uses(self, uses: Collection[str]) -> None:
        """Raise ValueError if inputs are missing, repeated or unknown, or the protocol does not give them."""
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


def mark(submission: Submission, split: Split, workers: Workers = 1) -> pd.DataFrame:
    """Score one submission, see ``Track.mark``.

    Raises:
        RsbenchError: a picture is invalid, or the truth has changed since the split was read.
    """
    (found,) = split.track.mark([submission], split, workers, lambda word: None, None)
    if isinstance(found, RsbenchError):
        raise found
    return found


def score_row(truth: Truth, answer: Answer | None, success: bool, scores: Mapping[str, object]) -> Row:
    """Return a row of scores.csv: the problem, the scores of its answer, success and run time."""
    seconds = math.nan if answer is None or answer.seconds is None else answer.seconds
    row = {"problem": truth.name, "scene": truth.scene, "success": success, **scores}
    return {**row, "failure": float(not success), "seconds": seconds}
