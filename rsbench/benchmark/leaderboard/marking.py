"""Scores of a submission, one row for each problem of its split: by the one scorer, and by nothing else.

A problem without an answer is a failure, and a failure scores the worst value of everything.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.own_matches import match_scores, read_own_matches
from rsbench.benchmark.leaderboard.picture_files import FOLDER, read_answer_depth, read_answer_frame
from rsbench.benchmark.leaderboard.picture_marking import depth_scores, frame_scores
from rsbench.benchmark.leaderboard.protocols import (
    AUC_DEG,
    AUC_READOUT,
    FLIP_DEG,
    SUCCESS_DEG,
    protocol_of_id,
)
from rsbench.benchmark.leaderboard.scoring_workers import rows_of_workers
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.scoring import answered, pose_errors
from rsbench.core import so3
from rsbench.core.metrics import translation_of_offset
from rsbench.core.so3 import FloatArray
from rsbench.motions import make_motion
from rsbench.pipeline.crew import Workers

_TIMES = 33
"""Row times, from the first row of frame 0 to the last of frame 1, at which poses are compared."""
_WORST_READOUT = 1.0
"""Error of a failure: between the two ends of what a ratio can be."""
Row = dict[str, Any]


def mark(submission: Submission, split: Split, workers: Workers = 1) -> pd.DataFrame:
    """One row for each problem, in the order of the split; the columns are those of docs/submit.md.

    Args:
        submission: what was answered.
        split: the truth.
        workers: processes, which score pictures; the rest takes no time.

    Raises:
        RsbenchError: a picture is at fault, or the truth has changed since the split was read.
    """
    model, found = submission.header.motion_model, submission.answers
    if split.protocol.pictures and workers != 1:
        return pd.DataFrame(rows_of_workers(submission, split, workers))
    if split.protocol.pictures:
        return pd.DataFrame([picture_row(truth, submission) for truth in split.truths])
    if split.protocol.asks == "readout":
        return pd.DataFrame([_readout_row(truth, found.get(truth.name)) for truth in split.truths])
    rows = [_motion_row(truth, found.get(truth.name), model) for truth in split.truths]
    if split.protocol.own_matches:
        own = read_own_matches(submission.folder, split.by_name)
        for row, truth in zip(rows, split.truths, strict=True):
            assert truth.sequence is not None
            row |= match_scores(truth.sequence, None if own is None else own[truth.name])
    return pd.DataFrame(rows)


def picture_row(truth: Truth, submission: Submission) -> Row:
    """Of pictures, which are read here, one problem at a time."""
    answer, pictures, folder = submission.answers.get(truth.name), truth.pictures, submission.folder / FOLDER
    assert pictures is not None
    success = answer is not None and answer.success
    pictures.check()
    if protocol_of_id(submission.header.protocol).asks == "depth":
        depth = read_answer_depth(folder, truth, submission.header.png_unit_m) if success else None
        scores = depth_scores(pictures, depth)
    else:
        frames = [read_answer_frame(folder, truth, each) for each in pictures.asked] if success else None
        scores = frame_scores(pictures, frames)
    return {**_named(truth, success), **scores, **_last(success, answer)}


def _readout_row(truth: Truth, answer: Answer | None) -> Row:
    ratio = None if answer is None or not answer.success else answer.readout_ratio
    error = _WORST_READOUT if ratio is None else abs(ratio - truth.shutter.readout_ratio)
    return {
        **_named(truth, ratio is not None),
        "e_readout": error,
        **{name: max(0.0, 1.0 - error / limit) for name, limit in AUC_READOUT.items()},
        **_last(ratio is not None, answer),
    }


def _named(truth: Truth, success: bool) -> Row:
    return {"problem": truth.name, "scene": truth.scene, "success": success}


def _last(success: bool, answer: Answer | None) -> Row:
    seconds = math.nan if answer is None or answer.seconds is None else answer.seconds
    return {"failure": float(not success), "seconds": seconds}


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
        **_named(truth, success),
        **found,
        "metres": _metres(d, truth, point) if success and metric else math.nan if success else math.inf,
        "e_row_deg": _row_angle(w, d, truth, model) if success else 180.0,
        "error_deg": worst,
        **{f"auc_{limit}": max(0.0, 1.0 - worst / limit) for limit in AUC_DEG},
        "within": float(found["e_R_deg"] < SUCCESS_DEG[0] and not found["e_T_deg"] >= SUCCESS_DEG[1]),
        "flip": float(success and found["e_T_deg"] > FLIP_DEG),
        "nees": _nees(answer, w, d, truth) if answer is not None and success and metric else math.nan,
        **_last(success, answer),
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
