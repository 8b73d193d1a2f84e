"""Tracks of motions: from simulated matches, from given matches of frames, and from frames alone.

If methods find matches themselves, they may submit these too: ``matches/left.csv`` and similar files beside the
file of answers, with the columns of the matches that ``export pose`` writes. The true second pixel of a match is
the projection of the scene point at its first pixel into the other frame. It is computed from the true depth,
interpolated between pixels by a plane, and from the true motion, with each pixel at the time of its own row.
"""

from __future__ import annotations

import hashlib
import math
import os
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.deviations import NOT_STATED, log_score, stated, vague_log_densities
from rsbench.benchmark.leaderboard.inputs import read_frames, read_inputs, write_inputs
from rsbench.benchmark.leaderboard.pictures import check_own
from rsbench.benchmark.leaderboard.recorded import RecordedPoints
from rsbench.benchmark.leaderboard.splits import POINTS_1, POINTS_2, Draws, Frames, SimulatedPoints, exact_problem
from rsbench.benchmark.leaderboard.submissions import method_header, submission_text
from rsbench.benchmark.leaderboard.track import (
    CHUNK,
    FAILED,
    LARGEST,
    LEAST_D,
    ORACLE,
    SECONDS,
    Answer,
    Checked,
    Job,
    Kept,
    Limits,
    Row,
    Runnable,
    Score,
    Solve,
    Split,
    Step,
    Submission,
    Track,
    Truth,
    score_row,
)
from rsbench.benchmark.scoring import answered, pose_errors
from rsbench.benchmark.simulated.bound import Bound, Views, bound_of_one_camera, motion_bound
from rsbench.benchmark.simulated.contract import misreading
from rsbench.benchmark.simulated.trials import Information, enter
from rsbench.capture.model_choice import AUTO
from rsbench.components.motion_models import TwistMotion
from rsbench.components.seeds import generator
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, track_pairs
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import SplineMotion, TrajectoryMotion
from rsbench.dataset.point_channels import MATCHED, arranged, looks, seen_near
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.dataset.views import FAR
from rsbench.jobs.process_jobs import Workers
from rsbench.pipeline.answer import Extra, solve_problem
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import COLUMNS, Problem
from rsbench.solvers.engine.base import SolverEntry, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.storage.files import read_table, write_bytes
from rsbench.storage.untrusted_files import read_bytes
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.stereo_matcher import between_pixels

CHOOSES = "rs-stereo-auto"
"""Name of the entry that selects the motion model by the matches, as ``rsbench solve`` does."""
AUC_DEG = (1, 5, 10)
"""Thresholds of the areas under the curve of max(e_R, e_T)."""
FLIP_DEG = 90.0
"""A larger error of the direction counts as a flipped sign."""
SUCCESS_DEG = (1.0, 5.0)
"""Limits of the errors of rotation and direction for a success, as in the sweeps of simulated points."""
BOUND = "cramer-rao"
"""Name of the entry whose errors are drawn from the bound."""
OPEN_DEG = 10.0
"""If the median error of the direction at the bound is larger, only the rotation counts."""
MATCHES = "matches"
"""Folder of a method's own matches, beside the file of answers."""
_EXTRAS: tuple[Extra, ...] = ("covariance",)
_USES: dict[Information, tuple[str, ...]] = {
    "left pairs": ("left",),
    "left and right pairs": ("left", "right"),
    "linked pairs": ("left", "right", "links"),
    "tracks": ("left", "right", "links"),
}
_ANSWER_KEYS = (
    *("name", "success", "reason", "w", "d", "metric", "reference_point", "direction_known", "covariance"),
    "seconds",
)
"""Keys of the answers of ``solve_problem`` that are stored."""
_TIMES = 33
"""Number of times, from the first row of frame 0 to the last row of frame 1, at which poses are compared."""
_DECADES = 2.0
_AREAS_DEG = (0.1, 1.0)
"""Thresholds of the areas under the curves of e_R and e_T in pose-2; rotations are ten times as accurate."""
_DRAWS = 4000
"""Number of errors that are drawn at a bound: their median is then accurate to 3 %."""
_RIGHT_PX = 1.0
"""Largest distance of the second pixel of a correct match from the truth."""
_MATCH_FILES = tuple(f"{key}.csv" for key in COLUMNS)
_LARGEST_PX = 1e6
"""Limit of coordinates, px: larger than any image."""
_MOTION = (
    *(
        Score(
            f"auc_{limit}",
            f"AUC@{limit}",
            f"area under the curve of max(e_R, e_T) to {limit} deg",
            "share",
            "higher",
        )
        for limit in (5, 1, 10)
    ),
    Score("within", "success", "share with e_R < 1 deg and e_T < 5 deg", "share", "higher"),
    Score("flip", "flips", "share with e_T above 90 deg", "share"),
    FAILED,
    Score("e_R_deg", "e_R (deg)", "median angle of the rotation", "median"),
    Score("e_T_deg", "e_T (deg)", "median angle of the translation", "median"),
    Score("e_row_deg", "e_row (deg)", "median of the largest angle of a row's pose", "median"),
    Score("e_s", "e_s", "median |log| of the length, where metres are claimed", "median"),
    Score("metres", "metres", "median distance of d from the truth, where claimed", "median"),
    SECONDS,
)
_OWN_MATCHES = (
    Score("matches", "matches", "median number of own matches", "median", "higher"),
    Score(
        "matches_1px", "right matches", "median share of own matches within 1 px of the truth", "median", "higher"
    ),
)


# Solvers as entries


@dataclass(frozen=True, kw_only=True, eq=False)
class SolverTrack(Track):
    """A track whose cards are solvers, and whose answers are numbers in the file of answers alone."""

    choosing: bool = False
    """Whether there is an entry ``CHOOSES``, and every header has the motion model of its solver."""
    more_columns: Callable[[list[Row], Submission, Split], None] | None = None
    """Function that adds columns to the rows of a submission."""
    also_uses: ClassVar[tuple[str, ...]] = ()
    """Inputs that every entry uses in addition to those of its solver."""

    @abstractmethod
    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        """Return the answer of a solver to a problem, as a line of a submission."""

    @abstractmethod
    def row(self, truth: Truth, answer: Answer | None) -> Row:
        """Return the scores of an answer to one problem."""

    def chunk(self, limits: Limits) -> int:
        return CHUNK if limits == Limits() else 1

    def entry_of(self, card: str) -> SolverEntry:
        """Load the solver of a card; RsbenchError if it does not exist."""
        if card != CHOOSES or not self.choosing:
            return load_solver_entry(card)
        entry = load_solver_entry("rs-stereo-refined")
        words = "The recommended solver under the motion model that the matches of the problem prefer"
        tuned_on = f"spline added 26 November 2026, after points-2 was seen; {entry.options.tuned_on}"
        options = replace(entry.options, tuned_on=tuned_on)
        return replace(entry, name=CHOOSES, description=words, key=f"{entry.key} {AUTO}", options=options)

    def check_entry(self, entry: SolverEntry) -> None:
        """Raise RsbenchError if a solver does not fit the track."""
        with naming(f"solver {entry.name!r}"):
            self.check_uses(uses_of(entry, self.gives_readout))

    def runnable(self, card: str) -> Runnable:
        entry = self.entry_of(card)
        self.check_entry(entry)
        spec = entry.solver.spec
        model = spec.motion_model if spec.motion_model in ("linear", "twist") else "linear"
        if self.choosing:
            model = "none" if spec.shutter == "global" else spec.motion_model
        header = {
            "uses": (*uses_of(entry, self.gives_readout), *self.also_uses),
            "description": entry.description,
            "paper": spec.reference,
            "motion_model": "chosen" if entry.name == CHOOSES and self.choosing else model,
            **{key: value for key in ("code", "tuned_on") if (value := getattr(entry.options, key))},
        }
        key = [entry.key, entry.options.deciding, asdict(RobustOptions())]
        return Runnable(entry.name, entry.built_in, key, header, spec.motion_model)

    def solver_of_jobs(self, inputs: Path, limits: Limits) -> Solve:
        runner = SolverRunner(time_limit_s=limits.seconds, single_thread=True, memory_mb=limits.memory_mb)
        problems = {problem.name: problem for problem in read_inputs(inputs, self)}

        def solve(job: Job) -> Iterator[list[dict[str, Any]]]:
            for target in job.targets:
                entry = self.entry_of(target.card)
                yield [self.answer(problems[name], entry, runner) for name in job.problems]

        return solve

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        """Return the scores of each problem."""
        rows = [self.row(each, submission.answers.get(each.name)) | self.part_of(each) for each in split.truths]
        if self.more_columns is not None:
            self.more_columns(rows, submission, split)
        return rows

    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Kept | None
    ) -> list[pd.DataFrame | RsbenchError]:
        return [pd.DataFrame(self.rows(submission, split)) for submission in submissions]


def uses_of(entry: SolverEntry, readout: bool = True) -> tuple[str, ...]:
    """Return the inputs that a solver declares; ``readout``: whether the track gives the readout ratio."""
    rolling = entry.solver.spec.shutter == "rolling" and readout
    return _USES[enter(entry).information] + (("readout",) if rolling else ())


def seed_of_answer(problem: Problem, entry: SolverEntry) -> int:
    """Return a seed from the names of problem and solver, so that answers do not depend on order or workers."""
    text = f"leaderboard {problem.name} {entry.name}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def rounded(answer: dict[str, Any]) -> dict[str, Any]:
    """Round w and d to twelve digits, and a covariance to six: stored predictions are half as large."""
    for name, digits in (("w", 12), ("d", 12), ("covariance", 6)):
        if answer.get(name) is not None:
            found = np.asarray(answer[name])
            answer[name] = np.array([float(f"{x:.{digits}g}") for x in found.flat]).reshape(found.shape).tolist()
    return answer


# Motions


@dataclass(frozen=True, kw_only=True)
class _Motion(Answer):
    """An answer that is a motion."""

    motion_model: str = ""
    """Motion model that the method selected, if it selects one."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("w", "d"):
            if self.success and getattr(self, name) is None:
                raise ValueError(f"{name}: a success needs three numbers; for a failure give success = false")


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionTrack(SolverTrack):
    """The motion of a rig over one frame period."""

    rounds: bool = False
    """Whether answers of rsbench's entries are rounded, so that stored predictions are half as large."""
    answers = _Motion

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        return {"w": truth.motion.w.tolist(), "d": truth.motion.d.tolist(), "metric": True}

    def example(self, split: Split) -> Mapping[str, Any]:
        return {"w": [0.01, -0.02, 0.005], "d": [0.1, 0.0, 0.2], "metric": False, "reference_point": "left"}

    def notes(self, answers: Sequence[Answer], split: Split) -> Iterator[str]:
        found = Counter[str | None]()
        for answer in answers:
            truth = split.by_name[answer.name]
            given = *_vectors(answer), truth.motion.w, truth.motion.d
            found[misreading(*given, truth.rig, answer.reference_point)] += 1
        del found[None]  # right, or wrong in no common manner
        for words, count in found.most_common(1):
            if 2 * count > len(answers):
                yield f"{count} of {len(answers)} motions are near to another reading of the truth: {words}"

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        seed, model = seed_of_answer(problem, entry), AUTO if entry.name == CHOOSES else None
        found = solve_problem(problem, entry, RobustOptions(), runner, seed, _EXTRAS, model)
        kept = {key: found[key] for key in (*_ANSWER_KEYS, *(["motion_model"] if model else []))}
        if found["success"]:
            length = math.hypot(*found["d"])
            if max(length, *map(abs, found["w"])) > LARGEST:
                return {"name": problem.name, "success": False, "reason": f"w or d goes beyond {LARGEST:g}"}
            if length < LEAST_D:
                kept["d"] = [0.0, 0.0, 0.0]  # the rig stands still
        kept |= {"seconds": round(found["seconds"], 6), "reason": str(found["reason"])[:300]}
        return rounded(kept) if self.rounds else kept

    def row(self, truth: Truth, answer: Answer | None) -> Row:
        chosen = {"chosen": getattr(answer, "motion_model", "")} if self.choosing else {}
        return motion_row(truth, answer) | chosen

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        rows = super().rows(submission, split)
        vague = vague_log_densities([truth.motion for truth in split.truths])
        for row, at_truth in zip(rows, vague, strict=True):
            row["log_score"] = log_score(row.pop("log_density"), float(at_truth))
        return rows

    def medians_at_bound(self, uses: Collection[str], split: Split) -> Mapping[str, FloatArray]:
        if split.draws is None:
            return {}
        pairs = "both" if {"left", "right"} <= set(uses) else "left"
        seen = "links" if "links" in uses else pairs
        return bound_medians(split.draws, split.seed, len(split.truths), seen)


def motion_row(truth: Truth, answer: Answer | None) -> Row:
    """Return the scores of an answer to one problem."""
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
    metres = math.nan if success else math.inf
    if success and metric:
        metres = float(np.linalg.norm(d - _true_d(truth, point)))
    nees, log_density = NOT_STATED
    if answer is not None and answer.covariance is not None and success and metric:
        error = np.concatenate([w - truth.motion.w, d - _true_d(truth, point)])
        nees, log_density = stated(error, np.array(answer.covariance))
    scores = {
        **found,
        "metres": metres,
        "e_row_deg": _row_angle(w, truth) if success else 180.0,
        "error_deg": worst,
        **{f"auc_{limit}": max(0.0, 1.0 - worst / limit) for limit in AUC_DEG},
        "within": float(found["e_R_deg"] < SUCCESS_DEG[0] and not found["e_T_deg"] >= SUCCESS_DEG[1]),
        "flip": float(success and found["e_T_deg"] > FLIP_DEG),
        "nees": nees,
        "log_density": log_density,
    }
    return score_row(truth, answer, success, scores)


def _vectors(answer: Answer | None) -> tuple[FloatArray, FloatArray]:
    if answer is None or answer.w is None or answer.d is None:
        return np.full(3, np.nan), np.full(3, np.nan)
    return np.array(answer.w), np.array(answer.d)


def _true_d(truth: Truth, point: str) -> FloatArray:
    if point == "body":
        return truth.motion.d
    return translation_of_offset(truth.motion.w, truth.motion.d, truth.rig.offset("left"))


def _row_angle(w: FloatArray, truth: Truth) -> float:
    """Return the largest angle, degrees, between the true rotation at a row and a uniform rotation by ``w``."""
    times = np.linspace(0.0, 1.0 + truth.shutter.readout_ratio, _TIMES)
    estimated = so3.exp(times[:, None] * w)
    true = truth.motion.body_from_world(times).R
    return float(np.rad2deg(np.max(so3.angle(estimated @ np.swapaxes(true, -1, -2)))))


# The bound


@lru_cache(maxsize=8)
def bound_medians(draws: Draws, seed: int, count: int, seen: str) -> Mapping[str, FloatArray]:
    """Compute ``Track.medians_at_bound`` of the first ``count`` problems for Gaussian errors; cached, as it is
    slow.

    ``seen`` is ``left``, ``both`` or ``links``, the matches that a method uses; the readout ratio counts as given.
    The direction is that of the body's translation, or of the left camera's if only this camera is used.
    """
    bounds = list[Bound]()
    views: Views = "four-view" if seen == "links" else "pairs"
    for number in range(count):
        problem, noise_px = exact_problem(seed, number, draws)
        tracks, motion = problem.correspondences.tracks, smooth(draws.motion(seed, number))
        rig, shutter = problem.rig, problem.shutter
        if seen == "left":
            bounds.append(bound_of_one_camera(track_pairs(tracks, "left"), rig, shutter, motion, noise_px))
        else:
            bounds.append(motion_bound(problem.correspondences, rig, shutter, motion, noise_px, views))
    errors = np.abs(generator(0, "leaderboard", "doubt").standard_normal((_DRAWS, 3)))
    return {
        "e_R_deg": np.array([_median(bound.rotation_axes, errors) for bound in bounds]),
        "e_T_deg": np.array([_median(bound.direction_axes, errors) for bound in bounds]),
    }


def smooth(motion: Motion) -> Motion:
    """Return a smooth motion for a bound: a spline or a path through poses is replaced by the twist with the same
    end pose. For a vibrating spline this changes the bound by less than 5 %.

    The derivatives of a spline by its end pose are 100 times slower, and a path through given poses has none.
    """
    return TwistMotion(motion.w, motion.d) if isinstance(motion, SplineMotion | TrajectoryMotion) else motion


def _median(axes: FloatArray, draws: FloatArray) -> float:
    if not np.all(np.isfinite(axes)):
        return np.inf
    lengths = np.sqrt(np.sum((axes * draws[:, : len(axes)]) ** 2, axis=1))
    return float(np.rad2deg(np.median(lengths)))


def bound_text(split: Split, folder: Path) -> str:
    """Return a submission of motions with the smallest errors that the data allow.

    The errors are drawn from the Cramer-Rao bound of all inliers: the best possible result of an unbiased method
    that knows the outliers and uses all links.
    """
    words = "The true motion with errors drawn from the Cramer-Rao bound of all that is no outlier"
    return submission_text(method_header(split, BOUND, [ORACLE], words), _at_the_bound(split))


def _at_the_bound(split: Split) -> Iterator[dict[str, Any]]:
    draws, seed = split.draws, split.seed
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


# Columns of protocols 2


def nearness(over: FloatArray) -> FloatArray:
    """Return the scores of ratios (...) of errors to their medians at the bound: 1 for ratios up to 1, 0 from a
    ratio of 100 on, and linear in the logarithm between them."""
    with np.errstate(divide="ignore"):
        return np.clip(1.0 - np.log10(over) / _DECADES, 0.0, 1.0)


def _add_bound_columns(rows: list[Row], submission: Submission, split: Split) -> None:
    """Add the columns of points-2: errors divided by their medians at the Cramer-Rao bound."""
    numbers = [int(truth.name[1:]) for truth in split.truths]
    bounds = bound_medians(split.draws, split.seed, max(numbers) + 1, "links")
    at_R, at_T = (bounds[key][numbers] for key in ("e_R_deg", "e_T_deg"))
    for row, R, T in zip(rows, at_R, at_T, strict=True):
        over_R, over_T = row["e_R_deg"] / R, row["e_T_deg"] / T
        over = over_R, over_T if T <= OPEN_DEG else over_R
        near = nearness(np.array(over)) if row["success"] else np.zeros(2)
        row |= {"near_bound": float(np.mean(near)), "near_R": float(near[0]), "near_T": float(near[1])}
        row |= {"over_bound": math.sqrt(over[0] * over[1]), "over_R": over_R, "over_T": over_T}


def add_area_columns(rows: list[Row], submission: Submission, split: Split) -> None:
    """Add the columns of pose-2: separate areas under the curves of rotation and direction."""
    for row, truth in zip(rows, split.truths, strict=True):
        R = max(0.0, 1.0 - row["e_R_deg"] / _AREAS_DEG[0])
        T = R if math.isnan(row["e_T_deg"]) else max(0.0, 1.0 - row["e_T_deg"] / _AREAS_DEG[1])
        row |= {"motion": truth.motion.name, "auc_apart": 0.5 * (R + T), "auc_R": R, "auc_T": T}


def _add_match_columns(rows: list[Row], submission: Submission, split: Split) -> None:
    """Add the columns of pose-own: number of the method's own matches, and share of correct ones."""
    own = read_own_matches(submission.folder, split.by_name)
    for row, truth in zip(rows, split.truths, strict=True):
        row |= match_scores(truth.rendered, None if own is None else own[truth.name])


# Motions from frames, with matches of the method's own


class OwnMatchesTrack(MotionTrack):
    """A track of motions from rendered frames; a method may submit its own matches."""

    own_matches = True
    also_uses = ("images",)

    def prepare(self, split: Split, inputs: Path, work: Path, step: Step, features: str | None) -> Path:
        """Add the matches of ``sift-refined``, or of the matcher ``features``, to the inputs of solvers."""
        options = CorrectionOptions(features=load_features(features)) if features else CorrectionOptions()
        found = list[Problem]()
        for problem in read_inputs(inputs, self):
            images, scanning = read_frames(inputs, problem), problem.shutter.scanning
            try:
                matches = find_matches_of_rig(images, problem.rig, scanning, options)
            except RsbenchError:  # frames without texture: every solver fails, because it has no matches
                matches = problem.correspondences
            found.append(replace(problem, correspondences=matches))
            step(problem.name)
        write_inputs(replace(split, public=False), found, work / "matched")
        return work / "matched"

    def copy_files(self, inputs: Path, folder: Path) -> None:
        (folder / MATCHES).mkdir(parents=True, exist_ok=True)
        for name in _MATCH_FILES:
            if (inputs / name).is_file():
                write_bytes(folder / MATCHES / name, read_bytes(inputs / name))

    def files_of(self, submission: Submission, split: Split) -> Iterable[str]:
        return [f"{MATCHES}/{name}" for name in match_files(submission.folder)]

    def check_files(self, submission: Submission, split: Split, most: int, hints: bool) -> Checked:
        try:
            read_own_matches(submission.folder, split.by_name)
        except RsbenchError as error:
            return [str(error)], []
        return [], []


def match_files(beside: Path) -> list[str]:
    """Return the names of the files of matches beside a file of answers.

    Raises:
        RsbenchError: ``matches`` contains other files, is empty, or is no folder but a file or link.
    """
    folder = beside / MATCHES
    if not os.path.lexists(folder):
        return []
    found = sorted(os.listdir(folder)) if folder.is_dir() else []
    for name in found:
        if name not in _MATCH_FILES:
            raise RsbenchError(f"{folder / name}: does not belong here; there are: {', '.join(_MATCH_FILES)}")
        check_own(beside, f"{MATCHES}/{name}")
    if not found:
        raise RsbenchError(f"{folder}: must be a folder with some of {', '.join(_MATCH_FILES)}, no link")
    return found


def read_own_matches(beside: Path, problems: Mapping[str, Truth]) -> dict[str, Correspondences] | None:
    """Read a method's own matches, by the name of the problem; None if there is no folder of matches.

    Raises:
        RsbenchError: a file is not such a table, names an unknown problem, or has more matches of a problem than
            its images have pixels; see also ``match_files``.
    """
    names = match_files(beside)
    tables = {name.removesuffix(".csv"): _table(beside / MATCHES / name, problems) for name in names}
    if not tables:
        return None
    found: dict[str, dict[str, FloatArray]] = {problem: {} for problem in problems}
    for key, table in tables.items():
        for problem, rows in table.groupby("name", sort=False):
            camera = problems[str(problem)].rig.camera
            if len(rows) > (most := camera.width * camera.height):
                raise RsbenchError(
                    f"{beside / MATCHES / key}.csv: {len(rows)} matches of {problem}: more than pixels, {most}"
                )
            found[str(problem)][key] = rows[COLUMNS[key].split(", ")].to_numpy(dtype=np.float64)
    return {problem: Correspondences(**sets) for problem, sets in found.items()}


def _table(path: Path, problems: Mapping[str, Truth]) -> pd.DataFrame:
    columns = COLUMNS[path.stem].split(", ")
    table = read_table(path, ("name",), columns, dtype={"name": str}, keep_default_na=False, na_values=["nan"])
    if others := sorted({*map(str, table.columns)} - {"name", *columns}):
        raise RsbenchError(
            f"{path}: the column {others[0][:100]!r} does not belong here; there are: name, {', '.join(columns)}"
        )
    for name in table["name"].unique():
        if name not in problems:
            raise RsbenchError(f"{path}: name = {str(name)[:100]!r}: is no problem of the split")
    wrong = ~np.all(np.abs(table[columns].to_numpy(dtype=np.float64)) < _LARGEST_PX, axis=1)
    if np.any(wrong):
        raise RsbenchError(f"{path}:{int(np.argmax(wrong)) + 2}: must hold finite pixels below {_LARGEST_PX:g}")
    return table


def match_scores(sequence: Rendered, matches: Correspondences | None) -> dict[str, float]:
    """Return the number of distinct matches of a problem and the share of correct ones.

    NaN if the method submits no matches at all; a problem without matches has the share 0.
    """
    if matches is None:
        return {"matches": math.nan, "matches_1px": math.nan}
    found = arranged(matches)
    errors = [
        match_errors(sequence, views, np.unique(found.pixels[found.sets == number].reshape(-1, 4), axis=0))
        for number, views in enumerate(MATCHED.values())
    ]
    right = np.concatenate(errors) <= _RIGHT_PX
    return {"matches": float(len(right)), "matches_1px": float(np.mean(right)) if len(right) else 0.0}


def match_errors(sequence: Rendered, views: tuple[View, View], rows: FloatArray) -> FloatArray:
    """Return distances (n,), px, of the second pixels of matches (n, 4) from the true ones; infinite without one.

    A pixel without a surface shows a point at infinity.
    """
    source, target = views
    disparity = np.nan_to_num(sequence.rig.disparity(sequence.depth("rs", *source))).astype(np.float32)
    there = between_pixels(disparity, rows[:, :2]).astype(np.float64)
    far = np.where(there > 0.0, sequence.rig.depth(np.where(there > 0.0, there, 1.0)), FAR)
    eyes, ahead = looks(sequence, source, rows[:, :2])
    truth, _, _ = seen_near(sequence, target, eyes + far[:, None] * (ahead - eyes), rows[:, 2:])
    error = np.linalg.norm(rows[:, 2:] - truth, axis=1)
    return np.where(np.isfinite(error) & np.isfinite(there), error, np.inf)


# Fields of the tracks


_SHOWN_TOO = tuple(
    score
    for score in _MOTION
    if score.key in ("within", "flip", "failure", "e_R_deg", "e_T_deg", "e_s", "seconds")
)
"""Scores of protocols 1 that protocols 2 show too."""
_SHARED: dict[str, Any] = {
    "error": "error_deg",
    "error_title": "max(e_R, e_T) in degrees",
    "exact": {"e_R_deg": 1e-5, "e_T_deg": 1e-5, "e_s": 1e-7, "metres": 1e-7},
    "smoke_metrics": ("e_R_deg", "e_T_deg", "e_s", "metres", "e_row_deg", "nees"),
}
_SMOKE = ("rs-stereo-refined", "gs-stereo-tracks-scaled", ORACLE)
_POINTS: dict[str, Any] = {
    "allowed": ("left", "right", "links", "readout"),
    "given": "tracks of random points, with noise and outliers",
    "oracles": ((BOUND, bound_text),),
}
_POSES: dict[str, Any] = {
    "allowed": ("left", "right", "links", "readout"),
    "given": "matches of the frames by rsbench's SIFT",
    "inputs": Frames(),
}
_SEVERAL_MODELS: dict[str, Any] = {"parting": "motion", "choosing": True, "rounds": True}


def pose_fields(inputs: Frames) -> dict[str, Any]:
    """Return the fields of a track of motions from given matches of frames under several motion models."""
    scores = (
        Score("auc_apart", "AUC apart", "mean of AUC of e_R to 0.1 deg and of e_T to 1 deg", "share", "higher"),
        *(
            Score(key, title, f"area under the curve of {title[4:]}", "share", "higher")
            for key, title in (("auc_R", "AUC e_R to 0.1 deg"), ("auc_T", "AUC e_T to 1 deg"))
        ),
        *_SHOWN_TOO,
    )
    return _SHARED | _POSES | _SEVERAL_MODELS | {"inputs": inputs, "scores": scores}


_BOUNDED: dict[str, Any] = (
    _SHARED
    | _POINTS
    | _SEVERAL_MODELS
    | {
        "error": "over_bound",
        "error_title": "error over its median at the bound",
        "scores": (
            Score(
                "near_bound",
                "near bound",
                "1 where e_R and e_T are at the Cramer-Rao bound, 0 from 100 times that on; mean of both",
                "share",
                "higher",
            ),
            Score("near_R", "near in R", "the same of e_R alone", "share", "higher"),
            Score("near_T", "near in T", "the same of e_T alone", "share", "higher"),
            Score("over_R", "e_R / bound", "median of e_R over its median at the bound", "median"),
            Score("over_T", "e_T / bound", "median of e_T over its median at the bound", "median"),
            *_SHOWN_TOO,
        ),
        "more_columns": _add_bound_columns,
    }
)


TRACKS: tuple[Track, ...] = (
    MotionTrack(
        **_BOUNDED,
        name="points-2",
        id="points-2",
        title="Motion from simulated matches, under several laws of motion",
        inputs=SimulatedPoints(POINTS_2),
    ),
    MotionTrack(
        **_BOUNDED | {"parting": "recording"},
        name="points-recorded",
        id="points-recorded-1",
        title="Motion from simulated matches on recorded trajectories",
        inputs=RecordedPoints(),
    ),
    MotionTrack(
        **_SHARED | _POINTS,
        name="points",
        id="points-1",
        title="Motion from simulated matches",
        inputs=SimulatedPoints(POINTS_1),
        scores=_MOTION,
        smoke=_SMOKE,
    ),
    MotionTrack(
        **pose_fields(Frames()),
        name="pose-2",
        id="pose-2",
        title="Motion from given matches of rendered frames, under several laws of motion",
        more_columns=add_area_columns,
    ),
    MotionTrack(
        **_SHARED | _POSES,
        name="pose",
        id="pose-1",
        title="Motion from given matches of rendered frames",
        scores=_MOTION,
        smoke=_SMOKE,
    ),
    OwnMatchesTrack(
        **_SHARED | {"smoke_metrics": (*_SHARED["smoke_metrics"], "matches", "matches_1px")},
        name="pose-own",
        id="pose-own-1",
        title="Motion from rendered frames",
        allowed=("left", "right", "links", "readout", "images"),
        given="the four rolling-shutter frames",
        inputs=Frames(),
        scores=_MOTION + _OWN_MATCHES,
        smoke=_SMOKE,
        choosing=True,
        more_columns=_add_match_columns,
    ),
)
