"""Protocols of motion under several laws: ranks by errors over the problem's bound, and one entry a method."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from rsbench.benchmark.leaderboard.motion_tracks import MotionTrack, PointsTrack, bound_medians
from rsbench.benchmark.leaderboard.points_draws import POINTS_2
from rsbench.benchmark.leaderboard.running import CHOOSES, SolverTrack, answer_problem
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.track import Row, Score
from rsbench.capture.settle import AUTO
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.registry import SolverEntry, load_solver_entry

SAME_METHOD: Mapping[str, str] = {
    "rs-r6p-single": "rs-r6p",
    "rs-stereo-iterated": "rs-stereo-iterated-metric",
    "rs-stereo-linear-symmetric": "rs-stereo-linear",
    "rs-stereo-tracks": "rs-stereo-refined",
}
"""Cards of ours that are left out, each with the entry that stands for its method: versions that answer alike cost
all others power, for the comparison of every pair is corrected for their number."""
OPEN_DEG = 10.0
"""Where the median error of the direction at the bound is larger, the rotation alone counts."""
_DECADES = 2.0
_KEPT = ("within", "flip", "failure", "e_R_deg", "e_T_deg", "e_s", "seconds")
"""Scores of points-1 that are shown too."""


def nearness(over: FloatArray) -> FloatArray:
    """Of errors (...) over their medians at the bound: 1 up to 1, 0 from 100 on, even in the logarithm."""
    with np.errstate(divide="ignore"):
        return np.clip(1.0 - np.log10(over) / _DECADES, 0.0, 1.0)


class SeveralLaws(SolverTrack):
    """A track whose rigs move by several laws, which entries assume or choose from."""

    parting = "motion"

    def entry_of(self, card: str) -> SolverEntry:
        if card != CHOOSES:
            return load_solver_entry(card)
        entry = load_solver_entry("rs-stereo-refined")
        words = "The recommended solver under the motion model that the matches of the problem prefer"
        return replace(entry, name=CHOOSES, description=words, key=f"{entry.key} {AUTO}")

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        return rounded(answer_problem(problem, entry, runner))

    def assumed(self, entry: SolverEntry) -> str:
        if entry.name == CHOOSES:
            return "chosen"
        spec = entry.solver.spec
        return "none" if spec.shutter == "global" else spec.motion_model


def rounded(answer: dict[str, Any]) -> dict[str, Any]:
    """With w and d to twelve digits, and a covariance to six: stored predictions are half as large."""
    for name, digits in (("w", 12), ("d", 12), ("covariance", 6)):
        if answer.get(name) is not None:
            found = np.asarray(answer[name])
            answer[name] = np.array([float(f"{x:.{digits}g}") for x in found.flat]).reshape(found.shape).tolist()
    return answer


class LawsOfPoints(SeveralLaws, PointsTrack):
    """Of simulated matches, of four kinds of rigs that move by five laws."""

    name, id = "points-2", "points-2"
    title = "Motion from simulated matches, under several laws of motion"
    draws = POINTS_2
    smoke: ClassVar[tuple[str, ...]] = ()
    scores = (
        Score(
            key="near_bound",
            title="near bound",
            hint="1 where e_R and e_T are at the Cramer-Rao bound, 0 from 100 times that on; mean of both",
            kind="share",
            better="higher",
        ),
        Score(key="near_R", title="near in R", hint="the same of e_R alone", kind="share", better="higher"),
        Score(key="near_T", title="near in T", hint="the same of e_T alone", kind="share", better="higher"),
        Score(key="over_R", title="e_R / bound", hint="median of e_R over its median at the bound", kind="median"),
        Score(key="over_T", title="e_T / bound", hint="median of e_T over its median at the bound", kind="median"),
        *(score for score in MotionTrack.scores if score.key in _KEPT),
    )
    error, error_title = "over_bound", "error over its median at the bound"

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        numbers = [int(truth.name[1:]) for truth in split.truths]
        bounds = bound_medians(self.draws, split.seed, max(numbers) + 1, "links")
        at_R, at_T = (bounds[key][numbers] for key in ("e_R_deg", "e_T_deg"))
        rows = super().rows(submission, split)
        for row, truth, R, T in zip(rows, split.truths, at_R, at_T, strict=True):
            over_R, over_T = row["e_R_deg"] / R, row["e_T_deg"] / T
            over = over_R, over_T if T <= OPEN_DEG else over_R
            near = nearness(np.array(over)) if row["success"] else np.zeros(2)
            row |= dict(
                zip(("near_bound", "near_R", "near_T"), [float(np.mean(near)), *near.tolist()], strict=True)
            )
            row |= {"over_bound": math.sqrt(over[0] * over[1]), "over_R": over_R, "over_T": over_T}
            row |= {"motion": truth.facts["motion"]}
        return rows
