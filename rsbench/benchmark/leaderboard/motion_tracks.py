"""Tracks that ask for motions: from simulated matches, given matches, and matches of the method's own."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.doubt import medians_of
from rsbench.benchmark.leaderboard.frame_inputs import FrameTrack
from rsbench.benchmark.leaderboard.marking import last, named
from rsbench.benchmark.leaderboard.points_draws import POINTS_1, Draws
from rsbench.benchmark.leaderboard.running import SolverTrack, answer_problem
from rsbench.benchmark.leaderboard.splits import (
    Split,
    Truth,
    exact_problem,
    points_split,
    seed_of,
    simulated_problem,
)
from rsbench.benchmark.leaderboard.submissions import Submission, submission_text
from rsbench.benchmark.leaderboard.track import FAILED, ORACLE, SECONDS, Row, Score
from rsbench.benchmark.scoring import answered, pose_errors
from rsbench.benchmark.seeds import generator
from rsbench.benchmark.simulated.bound import Bound, Views, bound_of_point, motion_bound
from rsbench.benchmark.simulated.convention_errors import misreading
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion, TwistMotion
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.registry import SolverEntry
from rsbench.storage.files import write_bytes

AUC_DEG = (1, 5, 10)
"""Thresholds of the areas under the curve of max(e_R, e_T)."""
FLIP_DEG = 90.0
"""A direction that is wrong by more is the opposite one."""
SUCCESS_DEG = (1.0, 5.0)
"""A success errs by less in rotation and direction, as in the sweeps of simulated points."""
BOUND = "cramer-rao"
"""Name of the entry whose errors are drawn from the bound."""
_TIMES = 33
"""Row times, from the first row of frame 0 to the last of frame 1, at which poses are compared."""
MOTION = (
    *(
        Score(
            key=f"auc_{limit}",
            title=f"AUC@{limit}",
            hint=f"area under the curve of max(e_R, e_T) to {limit} deg",
            kind="share",
            better="higher",
        )
        for limit in (5, 1, 10)
    ),
    Score(
        key="within", title="success", hint="share with e_R < 1 deg and e_T < 5 deg", kind="share", better="higher"
    ),
    Score(key="flip", title="flips", hint="share with e_T above 90 deg", kind="share"),
    FAILED,
    Score(key="e_R_deg", title="e_R (deg)", hint="median angle of the rotation", kind="median"),
    Score(key="e_T_deg", title="e_T (deg)", hint="median angle of the translation", kind="median"),
    Score(key="e_row_deg", title="e_row (deg)", hint="median of the largest angle of a row's pose", kind="median"),
    Score(key="e_s", title="e_s", hint="median |log| of the length, where metres are claimed", kind="median"),
    Score(key="metres", title="metres", hint="median distance of d from the truth, where claimed", kind="median"),
    SECONDS,
)
MATCHES = (
    Score(key="matches", title="matches", hint="median number of own matches", kind="median", better="higher"),
    Score(
        key="matches_1px",
        title="right matches",
        hint="median share of own matches within 1 px of the truth",
        kind="median",
        better="higher",
    ),
)


@dataclass(frozen=True, kw_only=True)
class _Motion(Answer):
    """An answer where a motion is asked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("w", "d"):
            if self.success and getattr(self, name) is None:
                raise ValueError(f"{name}: a success needs three numbers; a failure says success = false")


class MotionTrack(SolverTrack):
    """The motion of a rig over one frame period."""

    scores = MOTION
    error, error_title = "error_deg", "max(e_R, e_T) in degrees"
    exact = MappingProxyType({"e_R_deg": 1e-5, "e_T_deg": 1e-5, "e_s": 1e-7, "metres": 1e-7})
    answers = _Motion
    smoke = ("rs-stereo-refined", "gs-stereo-tracks-scaled", ORACLE)
    smoke_metrics = ("e_R_deg", "e_T_deg", "e_s", "metres", "e_row_deg", "nees")
    example = MappingProxyType(
        {"w": [0.01, -0.02, 0.005], "d": [0.1, 0.0, 0.2], "metric": False, "reference_point": "left"}
    )

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        return {"w": truth.motion.w.tolist(), "d": truth.motion.d.tolist(), "metric": True}

    def notes(self, answers: Sequence[Answer], split: Split) -> Iterator[str]:
        if mistaken := _mistaken(answers, split):
            words, count = mistaken
            yield f"{count} of {len(answers)} motions are near to another reading of the truth: {words}"

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        return answer_problem(problem, entry, runner)

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        return [motion_row(truth, submission.answers.get(truth.name)) for truth in split.truths]


class PointsTrack(MotionTrack):
    """Of simulated matches."""

    name, id = "points", "points-1"
    title = "Motion from simulated matches"
    allowed = ("left", "right", "links", "readout")
    given = "tracks of random points, with noise and outliers"
    draws: ClassVar[Draws] = POINTS_1

    def split(self, data: Path | None, seed_file: Path | None = None, secret: bool = False) -> Split:
        if data is not None:
            raise RsbenchError(f"--data {data}: the problems of points are simulated; leave it out")
        if secret and seed_file is None:
            raise RsbenchError("--secret: of the track 'points' a --seed-file makes a secret split; leave it out")
        return points_split(self, seed_file, self.draws)

    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        seed = seed_of(seed_file)
        return (simulated_problem(seed, number, self.draws) for number in range(count))

    def medians_at_bound(self, uses: Collection[str], split: Split) -> Mapping[str, FloatArray]:
        pairs = "both" if {"left", "right"} <= set(uses) else "left"
        seen = "links" if "links" in uses else pairs
        return bound_medians(self.draws, split.seed, len(split.truths), seen)

    def oracles(self, split: Split, folder: Path) -> Iterator[Path]:
        yield from super().oracles(split, folder)
        path = folder / BOUND / "predictions.jsonl"
        path.parent.mkdir(parents=True)
        write_bytes(path, bound_text(split, split.seed, self.draws).encode())
        yield path


class PoseTrack(FrameTrack, MotionTrack):
    """Of rendered frames, with matches that are given."""

    name, id = "pose", "pose-1"
    title = "Motion from given matches of rendered frames"
    allowed = ("left", "right", "links", "readout")
    given = "matches of the frames by rsbench's SIFT"


def _mistaken(answers: Sequence[Answer], split: Split) -> tuple[str, int] | None:
    """The slip that explains most of the motions, and how many; None when no slip does."""
    found: Counter[str] = Counter()
    for answer in answers:
        truth = split.by_name[answer.name]
        given = *_vectors(answer), truth.motion.w, truth.motion.d
        words = misreading(*given, truth.rig, answer.reference_point)
        if words:
            found[words] += 1
    words, count = found.most_common(1)[0] if found else ("", 0)
    return (words, count) if 2 * count > len(answers) else None


def motion_row(truth: Truth, answer: Answer | None) -> Row:
    """Scores of an answer to one problem."""
    w, d = _vectors(answer)
    success = answer is not None and bool(answered(w, d, answer.success))
    point = "body" if answer is None else answer.reference_point
    metric = answer is not None and answer.metric
    errors = pose_errors(
        w,
        d,
        true_w=truth.motion.w,
        true_d=truth.motion.d,
        rig=truth.rig,
        success=success,
        metric=metric,
        reference_point=point,
    )
    found = {name: float(value) for name, value in errors.items()}
    worst = float(np.fmax(found["e_R_deg"], found["e_T_deg"]))
    return {
        **named(truth, success),
        **found,
        "metres": _metres(d, truth, point) if success and metric else math.nan if success else math.inf,
        "e_row_deg": _row_angle(w, truth) if success else 180.0,
        "error_deg": worst,
        **{f"auc_{limit}": max(0.0, 1.0 - worst / limit) for limit in AUC_DEG},
        "within": float(found["e_R_deg"] < SUCCESS_DEG[0] and not found["e_T_deg"] >= SUCCESS_DEG[1]),
        "flip": float(success and found["e_T_deg"] > FLIP_DEG),
        "nees": _nees(answer, w, d, truth) if answer is not None and success and metric else math.nan,
        **last(success, answer),
    }


def _vectors(answer: Answer | None) -> tuple[FloatArray, FloatArray]:
    if answer is None or answer.w is None or answer.d is None:
        return np.full(3, np.nan), np.full(3, np.nan)
    return np.array(answer.w), np.array(answer.d)


def _true_d(truth: Truth, point: str) -> FloatArray:
    if point == "body":
        return truth.motion.d
    return translation_of_offset(truth.motion.w, truth.motion.d, truth.rig.offset("left"))


def _metres(d: FloatArray, truth: Truth, point: str) -> float:
    return float(np.linalg.norm(d - _true_d(truth, point)))


def _row_angle(w: FloatArray, truth: Truth) -> float:
    """The largest angle between true poses of a row and those of an even turn by ``w``, degrees."""
    times = np.linspace(0.0, 1.0 + truth.shutter.readout_ratio, _TIMES)
    estimated = so3.exp(times[:, None] * w)
    true = truth.motion.body_from_world(times).R
    return float(np.rad2deg(np.max(so3.angle(estimated @ np.swapaxes(true, -1, -2)))))


def _nees(answer: Answer, w: FloatArray, d: FloatArray, truth: Truth) -> float:
    """Squared error of (w, d) by the covariance that was stated: on average 6 where that is right."""
    if answer.covariance is None:
        return math.nan
    error = np.concatenate([w - truth.motion.w, d - _true_d(truth, answer.reference_point)])
    values, vectors = np.linalg.eigh(np.array(answer.covariance))
    if not values[0] > 0.0:
        return math.inf
    return float(np.sum((vectors.T @ error) ** 2 / values))


# The bound


@lru_cache(maxsize=8)
def bound_medians(draws: Draws, seed: int, count: int, seen: str) -> Mapping[str, FloatArray]:
    """As of ``Track.medians_at_bound``, of the first problems: a bound takes as long as a solver.

    A method that names less data is compared with the bound of less; the readout ratio counts as known. The
    direction is that of the body, and of a method of the left camera alone that of this camera.
    """
    bounds = list[Bound]()
    views: Views = "four-view" if seen == "links" else "pairs"
    for number in range(count):
        problem, noise_px = exact_problem(seed, number, draws)
        tracks, motion = problem.correspondences.tracks, smooth(draws.motion(seed, number))
        given = Correspondences(left=track_pairs(tracks, "left")) if seen == "left" else problem.correspondences
        bound = motion_bound(given, problem.rig, problem.shutter, motion, noise_px, views)
        if seen == "left":  # one camera tells the direction of its own translation, not that of the body
            bound = bound_of_point(bound, motion, problem.rig.offset("left"))
        bounds.append(bound)
    return medians_of(bounds)


def smooth(motion: Motion) -> Motion:
    """For a bound: of a shaken motion the twist that it shakes about, whose bound is the same to 5 %.

    A derivative of a spline by its end takes a hundred times as long.
    """
    return TwistMotion(motion.w, motion.d) if isinstance(motion, SplineMotion) else motion


def bound_text(split: Split, seed: int, draws: Draws = POINTS_1) -> str:
    """Motions that err as little as the data allow, as a submission; ``seed`` is that of the split.

    Errors are drawn from the Cramer-Rao bound of the matches without the outliers: what an unbiased method that
    knows them, and uses all their links, could at best do.
    """
    header = {
        "protocol": split.track.id,
        "split": split.name,
        "method": BOUND,
        "uses": [ORACLE],
        "description": "The true motion with errors drawn from the Cramer-Rao bound of all that is no outlier",
    }
    return submission_text(header, _at_the_bound(split, seed, draws))


def _at_the_bound(split: Split, seed: int, draws: Draws) -> Iterator[dict[str, Any]]:
    for number, truth in enumerate(split.truths):
        exact, noise_px = exact_problem(seed, number, draws)
        bound = motion_bound(exact.correspondences, truth.rig, truth.shutter, smooth(truth.motion), noise_px)
        covariance = bound.covariance
        if covariance is None or not math.isfinite(bound.rotation):
            yield {"name": truth.name, "success": False, "reason": "the matches do not determine the motion"}
            continue
        error = np.linalg.cholesky(covariance) @ generator(seed, "leaderboard", BOUND, number).standard_normal(6)
        yield {
            "name": truth.name,
            "w": (truth.motion.w + error[:3]).tolist(),
            "d": (truth.motion.d + error[3:]).tolist(),
            "metric": True,
            "covariance": covariance.tolist(),
        }
