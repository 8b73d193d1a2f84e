"""The track of trajectories of whole sequences, from the matches of successive frames.

An answer consists of poses at times chosen by the method; a cubic spline interpolates them. Rotations are scored
at lines of all frames, drift at the starts of the frames, and jitter by true points in corrected frames.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.inputs import read_inputs
from rsbench.benchmark.leaderboard.splits import WholeSequences
from rsbench.benchmark.leaderboard.track import (
    FAILED,
    LARGEST,
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
from rsbench.benchmark.trajectory_scores import (
    AUC_DEG,
    LINES,
    METHODS,
    Estimate,
    Given,
    TrueTrajectory,
    along,
    scored_times,
    trajectory_scores,
)
from rsbench.components.cards import choices
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.se3 import compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.spline_motion import TrajectoryMotion
from rsbench.jobs.process_jobs import Workers
from rsbench.pipeline.problem import Problem

_MOST_POSES = 500
"""Largest number of poses of rsbench's answers, because the lines of a file of answers have limited length."""
APART = 1e-5
"""Smallest time between two poses of an answer, frame periods. Rows are farther apart, and a spline through closer
poses may deviate arbitrarily."""
_UNIT = 1e-3
_REACH = 1e-6
"""Tolerance, frame periods, with which the poses must reach from the start of the first frame to that of the last
one."""
_INVERTED = 10.0
"""Poses are reported as inverted if inverting them reduces the error by at least this factor."""
_FAILURE = {
    **{f"{name}_{part}_deg": 180.0 for name in ("rows", "way") for part in ("median", "95")},
    **dict.fromkeys(AUC_DEG, 0.0),
    "rpe_deg": 180.0,
    **dict.fromkeys(("ate_mm", "rpe_mm", "jitter_px"), np.inf),
}
_SCORES = (
    Score(
        "auc_way",
        "AUC way",
        "area to 0.1 deg under the curve of the rotation of lines against the sequence's first one",
        "share",
        "higher",
    ),
    Score(
        "auc_rows",
        "AUC rows",
        "area to 0.02 deg, of lines against the first one of their frame",
        "share",
        "higher",
    ),
    FAILED,
    *(
        Score(f"{name}_{part}_deg", f"{name} {part} (deg)", hint, "median")
        for name, words in (("way", "of the sequence"), ("rows", "of its frame"))
        for part, hint in (
            ("median", f"median angle of lines against the first one {words}"),
            ("95", f"95 % quantile of the angle of lines against the first one {words}"),
        )
    ),
    Score("ate_mm", "ATE (mm)", "of the starts of frames, rigidly aligned, as evo", "median"),
    Score("rpe_mm", "RPE (mm)", "from frame to frame, as evo", "median"),
    Score("rpe_deg", "RPE (deg)", "from frame to frame, as evo", "median"),
    Score(
        "jitter_px",
        "jitter (px)",
        "mean acceleration of what true points are off in corrected frames, per squared frame period",
        "median",
    ),
    SECONDS,
)
Poses = tuple[tuple[float, float, float, float, float, float, float, float], ...]


@dataclass(frozen=True, kw_only=True)
class TrajectoryAnswer(Answer):
    """A trajectory, or a failure."""

    poses: Poses | None = None
    """Rows ``tau, tx, ty, tz, qx, qy, qz, qw``: time in frame periods, and ``world_from_body``."""
    metric: bool = False
    """Whether positions are in metres; if not, they are unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse_numbers("an answer is poses")
        if not self.success:
            return
        if self.poses is None or len(self.poses) < 2:
            raise ValueError("poses: a success needs two rows or more; for a failure give success = false")
        rows = self.rows
        if np.any(np.abs(rows) > LARGEST):
            raise ValueError(f"poses: numbers must lie within {LARGEST:g} of 0")
        if np.any(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1.0) > _UNIT):
            raise ValueError("poses: a quaternion is not of length 1; a row is tau, tx, ty, tz, qx, qy, qz, qw")
        apart = float(np.min(np.diff(rows[:, 0])))
        if 0.0 < apart < APART:
            raise ValueError(f"poses: two are {apart:g} frame periods apart: must be {APART:g} or more")
        _ = self.motion

    @property
    def rows(self) -> FloatArray:
        """Poses (n, 8) of a successful answer."""
        return np.array(self.poses or (), dtype=np.float64)

    @cached_property
    def motion(self) -> TrajectoryMotion:
        """Motion through the poses of a successful answer; ValueError if they do not define one."""
        rows = self.rows
        rows[:, 4:] /= np.linalg.norm(rows[:, 4:], axis=1, keepdims=True)
        poses = {"poses": rows}
        w, d = TrajectoryMotion.endpoint(poses) or (np.zeros(3), np.zeros(3))
        return TrajectoryMotion(w, d, **poses)


class TrajectoryTrack(Track):
    """A track of trajectories of whole rendered sequences."""

    answers = TrajectoryAnswer

    # Predictions

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        frames = truth.rendered.frames
        return answer_of(along(truth.motion, frames - 1), truth.shutter, frames)

    def example(self, split: Split) -> Mapping[str, Any]:
        frames = range(split.truths[0].rendered.frames)
        still = [[float(frame), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] for frame in frames]
        return {"poses": still, "metric": False}

    def check_files(self, submission: Submission, split: Split, most: int, hints: bool) -> Checked:
        """Check that the poses cover the sequence, whose length only the split knows."""
        faults, answered = list[str](), list[tuple[TrajectoryAnswer, Truth]]()
        for answer in submission.answers.values():
            truth = split.by_name[answer.name]
            assert isinstance(answer, TrajectoryAnswer)
            if not answer.success:
                continue
            answered.append((answer, truth))
            first, end, last_start = answer.rows[0, 0], answer.rows[-1, 0], truth.rendered.frames - 1
            if first > _REACH or end < last_start - _REACH:
                faults.append(
                    f"{submission.folder}: name = {answer.name!r}: poses reach from {first:g} to {end:g}: must "
                    f"reach from 0 to {last_start}, the starts of the first and the last frame"
                )
        inverted = sum(_is_inverted(*each) for each in answered) if hints and split.public and not faults else 0
        if 2 * inverted <= len(answered):
            return faults[:most], []
        words = (
            f"{submission.folder}: {inverted} of {len(answered)} trajectories are near to the truth inverted; "
            "poses are those of the body in the world"
        )
        return [], [words]

    # Running

    def runnable(self, card: str) -> Runnable:
        if card not in METHODS:
            raise RsbenchError(f"--entry {card}: no method of the track {self.name!r}{choices(card, METHODS)}")
        method = METHODS[card]
        header = {"uses": method.uses, "description": method.description, "motion_model": method.motion_model}
        return Runnable(card, True, card, header)

    def solver_of_jobs(self, inputs: Path, limits: Limits) -> Solve:
        windows = read_inputs(inputs, self)
        sequences = {
            name: list(each) for name, each in groupby(windows, lambda window: window.name.rpartition(".")[0])
        }

        def solve(job: Job) -> Iterator[list[dict[str, Any]]]:
            (name,), (target,) = job.problems, job.targets
            try:
                answer = _solve(target.card, name, sequences[name])
            except (RsbenchError, ValueError, ArithmeticError) as error:  # such as matches that determine nothing
                answer = {"success": False, "reason": " ".join(str(error).split())[:300]}
            yield [{"name": name, **answer}]

        return solve

    # Scores

    def mark(
        self, submissions: Sequence[Submission], split: Split, workers: Workers, step: Step, kept: Kept | None
    ) -> list[pd.DataFrame | RsbenchError]:
        rows: list[list[Row]] = [[] for _ in submissions]
        for truth in split.truths:
            true = TrueTrajectory.of(truth.rendered)
            for mine, submission in zip(rows, submissions, strict=True):
                mine.append(_row(truth, true, submission.answers.get(truth.name)))
            step(truth.name)
        return [pd.DataFrame(each) for each in rows]


def _is_inverted(answer: TrajectoryAnswer, truth: Truth) -> bool:
    """Return whether a trajectory is much closer to the truth if each pose is inverted."""
    tau = np.arange(float(truth.rendered.frames))
    found, true = (each.body_from_world(tau).R for each in (answer.motion, truth.motion))
    as_is, turned = (np.max(so3.angle(R @ np.swapaxes(true, 1, 2))) for R in (found, np.swapaxes(found, 1, 2)))
    return bool(_INVERTED * turned < as_is)


def _row(truth: Truth, true: TrueTrajectory, answer: Answer | None) -> Row:
    """Return the scores of an answer to one problem."""
    success = isinstance(answer, TrajectoryAnswer) and answer.success
    found = dict(_FAILURE)
    if isinstance(answer, TrajectoryAnswer) and success:
        estimate = along(answer.motion, truth.rendered.frames - 1, positions=answer.metric)
        found = trajectory_scores(true, estimate)
        del found["failed"]
    return score_row(truth, answer, success, {**found, "error": 1.0 - found["auc_way"]})


def answer_of(estimate: Estimate, shutter: RollingShutter, frames: int) -> dict[str, Any]:
    """Convert a trajectory to an answer, with poses at lines of all frames of the left camera.

    Raises:
        RsbenchError: a part of the trajectory is unknown.
    """
    lines = min(max(_MOST_POSES // frames, 2), LINES)
    rows = list[FloatArray]()
    for frame in range(frames):
        tau = scored_times(shutter, frame, lines) if shutter.readout_ratio > 0.0 else np.array([float(frame)])
        R, t = inverse(compose(estimate.within(frame, tau), estimate.start(frame)))
        if not (np.all(np.isfinite(R)) and np.all(np.isfinite(t))):
            raise RsbenchError(f"no motion from frame {frame} on: {estimate.failed} windows have none")
        rows.append(np.concatenate([tau[:, None], t, so3.quaternion(R)[:, [1, 2, 3, 0]]], axis=1))
    found = np.concatenate(rows)
    found = found[np.append(True, np.diff(found[:, 0]) > APART)]
    return {"poses": np.round(found, 10).tolist(), "metric": estimate.positions}


def _solve(method: str, name: str, windows: Sequence[Problem]) -> dict[str, Any]:
    first = windows[0]
    gyro = first.correspondences.gyro
    seed = int.from_bytes(hashlib.sha256(f"leaderboard {name} {method}".encode()).digest()[:4], "big")
    known = Given(
        rig=first.rig,
        shutter=first.shutter,
        matches=[replace(each.correspondences, gyro=np.zeros((0, 4))) for each in windows],
        gyro=gyro if len(gyro) else None,
        seed=seed,
    )
    began = time.perf_counter()
    estimate = METHODS[method].solve(known)
    seconds = round(time.perf_counter() - began, 4)
    if estimate is None:
        return {"success": False, "reason": "the dataset has no gyroscope (channel imu)", "seconds": seconds}
    return {**answer_of(estimate, first.shutter, len(windows) + 1), "seconds": seconds}


TRACKS: tuple[Track, ...] = (
    TrajectoryTrack(
        name="trajectory",
        id="trajectory-1",
        title="Trajectory of whole sequences from given matches",
        allowed=("left", "right", "links", "readout", "gyro"),
        given="matches of each two successive frames by rsbench's SIFT; samples of a gyroscope where the dataset "
        "has the channel imu",
        inputs=WholeSequences(),
        scores=_SCORES,
        error="error",
        error_title="1 - AUC way",
        exact={
            **dict.fromkeys(("way_median_deg", "way_95_deg", "rows_median_deg", "rows_95_deg", "rpe_deg"), 1e-6),
            **dict.fromkeys(("ate_mm", "rpe_mm"), 1e-5),
        },
        smoke_metrics=("auc_way", "auc_rows", "way_median_deg", "rows_median_deg", "ate_mm", "rpe_mm", "rpe_deg"),
    ),
)
