"""Scores of a submission, one row for each problem of its split: by the one scorer, and by nothing else.

A problem without an answer is a failure, and a failure scores the worst value of everything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.own_matches import match_scores, read_own_matches
from rsbench.benchmark.leaderboard.protocols import (
    AUC_DEG,
    AUC_READOUT,
    FLIP_DEG,
    SUCCESS_DEG,
)
from rsbench.benchmark.leaderboard.scoring_workers import Row, last, named, rows_of_workers
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.scoring import answered, pose_errors
from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.so3 import FloatArray
from rsbench.jobs.workers import Workers

_TIMES = 33
"""Row times, from the first row of frame 0 to the last of frame 1, at which poses are compared."""
_WORST_READOUT = 1.0
"""Error of a failure: between the two ends of what a ratio can be."""
Step = Callable[[str], None]


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
    if not split.protocol.pictures:
        return [pd.DataFrame(_rows(submission, split)) for submission in submissions]
    marked, names = dict[str, list[Row | str]](), [truth.name for truth in split.truths]
    for name, rows in rows_of_workers(submissions, split, workers, kept):
        marked[name] = rows
        step(name)
    tables = list[pd.DataFrame | RsbenchError]()
    for rows in zip(*(marked[name] for name in names), strict=True):
        faults = [row for row in rows if isinstance(row, str)]
        tables.append(RsbenchError(faults[0]) if faults else pd.DataFrame(list(rows)))
    return tables


def _rows(submission: Submission, split: Split) -> list[Row]:
    """Of what holds no pictures."""
    model, found = submission.header.motion_model, submission.answers
    if split.protocol.asks == "readout":
        return [_readout_row(truth, found.get(truth.name)) for truth in split.truths]
    rows = [_motion_row(truth, found.get(truth.name), model) for truth in split.truths]
    if split.protocol.own_matches:
        own = read_own_matches(submission.folder, split.by_name)
        for row, truth in zip(rows, split.truths, strict=True):
            assert truth.sequence is not None
            row |= match_scores(truth.sequence, None if own is None else own[truth.name])
    return rows


def _readout_row(truth: Truth, answer: Answer | None) -> Row:
    ratio = None if answer is None or not answer.success else answer.readout_ratio
    error = _WORST_READOUT if ratio is None else abs(ratio - truth.shutter.readout_ratio)
    return {
        **named(truth, ratio is not None),
        "e_readout": error,
        **{name: max(0.0, 1.0 - error / limit) for name, limit in AUC_READOUT.items()},
        **last(ratio is not None, answer),
    }


def _motion_row(truth: Truth, answer: Answer | None, model: str) -> Row:
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
        "e_row_deg": _row_angle(w, d, truth, model) if success else 180.0,
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


def _row_angle(w: FloatArray, d: FloatArray, truth: Truth, model: str) -> float:
    """The largest angle between estimated and true poses of a row, degrees."""
    times = np.linspace(0.0, 1.0 + truth.shutter.readout_ratio, _TIMES)
    estimated = make_motion(model, w, d).body_from_world(times).R
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
