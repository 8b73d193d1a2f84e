"""Second protocols: several laws of motion, scores that separate, ratios that nobody guesses, one entry each."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from rsbench.benchmark.leaderboard.motion_tracks import MotionTrack, PointsTrack, PoseTrack, bound_medians
from rsbench.benchmark.leaderboard.points_draws import POINTS_2
from rsbench.benchmark.leaderboard.readout_track import AUC_READOUT, ReadoutTrack
from rsbench.benchmark.leaderboard.running import CHOOSES, SolverTrack, answer_problem
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import Submission, submission_text, template_header
from rsbench.benchmark.leaderboard.track import ORACLE, Row, Score
from rsbench.capture.hypotheses import MODELS
from rsbench.capture.settle import AUTO
from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.registry import SolverEntry, load_solver_entry
from rsbench.storage.files import write_bytes

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
_AUC_DEG = (0.1, 1.0)
"""Of e_R and of e_T: a rotation is known ten times as well."""
CONSTANT = "constant"
RIGHT = 0.1
"""Error of a readout ratio that counts as right."""
_GUESS = "The one ratio that, said of all sequences, has the best score"
_KEPT = ("within", "flip", "failure", "e_R_deg", "e_T_deg", "e_s", "seconds")
"""Scores of points-1 that are shown too."""


def nearness(over: FloatArray) -> FloatArray:
    """Of errors (...) over their medians at the bound: 1 up to 1, 0 from 100 on, even in the logarithm."""
    with np.errstate(divide="ignore"):
        return np.clip(1.0 - np.log10(over) / _DECADES, 0.0, 1.0)


class Choosing(SolverTrack):
    """A track whose entries assume a law of motion, or choose one."""

    def entry_of(self, card: str) -> SolverEntry:
        if card != CHOOSES:
            return load_solver_entry(card)
        entry = load_solver_entry("rs-stereo-refined")
        words = "The recommended solver under the motion model that the matches of the problem prefer"
        return replace(entry, name=CHOOSES, description=words, key=f"{entry.key} {AUTO}")

    def assumed(self, entry: SolverEntry) -> str:
        if entry.name == CHOOSES:
            return "chosen"
        spec = entry.solver.spec
        return "none" if spec.shutter == "global" else spec.motion_model


class SeveralLaws(Choosing):
    """A track whose rigs move by several laws."""

    parting = "motion"


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

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        return rounded(answer_problem(problem, entry, runner))

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


class LawsOfPoses(SeveralLaws, PoseTrack):
    """Of rendered frames of a dataset whose motions follow several laws, with matches that are given."""

    name, id = "pose-2", "pose-2"
    title = "Motion from given matches of rendered frames, under several laws of motion"
    smoke: ClassVar[tuple[str, ...]] = ()
    scores = (
        Score(
            key="auc_apart",
            title="AUC apart",
            hint="mean of AUC of e_R to 0.1 deg and of e_T to 1 deg",
            kind="share",
            better="higher",
        ),
        *(
            Score(key=key, title=title, hint=f"area under the curve of {title[4:]}", kind="share", better="higher")
            for key, title in (("auc_R", "AUC e_R to 0.1 deg"), ("auc_T", "AUC e_T to 1 deg"))
        ),
        *(score for score in MotionTrack.scores if score.key in _KEPT),
    )

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        return rounded(answer_problem(problem, entry, runner))

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        rows = super().rows(submission, split)
        for row, truth in zip(rows, split.truths, strict=True):
            R = max(0.0, 1.0 - row["e_R_deg"] / _AUC_DEG[0])
            T = R if math.isnan(row["e_T_deg"]) else max(0.0, 1.0 - row["e_T_deg"] / _AUC_DEG[1])
            row |= {"motion": truth.motion.name, "auc_apart": 0.5 * (R + T), "auc_R": R, "auc_T": T}
        return rows


class DrawnReadout(SeveralLaws, ReadoutTrack):
    """The readout ratio, of a dataset of which each sequence has one of its own."""

    name, id = "readout-2", "readout-2"
    title = "Readout ratio, drawn for each sequence, from given matches of rendered frames"
    smoke: ClassVar[tuple[str, ...]] = ()

    def split(self, data: Path | None, seed_file: Path | None = None, secret: bool = False) -> Split:
        found = super().split(data, seed_file, secret)
        ratios = Counter(truth.shutter.readout_ratio for truth in found.truths)
        ratio, count = ratios.most_common(1)[0]
        if count > 1:
            raise RsbenchError(
                f"{data}: {count} sequences have the readout ratio {ratio:g}, which a constant would win by: "
                f"{self.id} needs one for each, as the card laws draws them (readout_range)"
            )
        return found

    def models_of(self, entry: SolverEntry) -> tuple[str, ...]:
        return MODELS if entry.name == CHOOSES else super().models_of(entry)

    def oracles(self, split: Split, folder: Path) -> Iterator[Path]:
        yield from super().oracles(split, folder)
        path = folder / CONSTANT / "predictions.jsonl"
        path.parent.mkdir(parents=True)
        best = best_constant([truth.shutter.readout_ratio for truth in split.truths])
        header = {**template_header(split, CONSTANT), "uses": [ORACLE], "description": _GUESS}
        answers = ({"name": truth.name, "readout_ratio": best} for truth in split.truths)
        write_bytes(path, submission_text(header, answers).encode())
        yield path

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        rows = super().rows(submission, split)
        return [row | {"motion": truth.motion.name} for row, truth in zip(rows, split.truths, strict=True)]


class SkilledReadout(DrawnReadout):
    """The readout ratio with its deviation, scored so that a refusal is never worse than a guess."""

    name, id = "readout-3", "readout-3"
    title = "Readout ratio with its deviation, drawn for each sequence, from given matches of rendered frames"
    scores = (
        Score(
            key="skill",
            title="skill",
            hint="1 - CRPS over that of knowing only how the ratios are spread: 1 exact, 0 a refusal",
            kind="mean",
            better="higher",
        ),
        Score(
            key="right",
            title="right",
            hint="share of problems with a ratio within 0.1",
            kind="share",
            better="higher",
        ),
        Score(
            key="wrong", title="wrong", hint="share of problems with a ratio off by more than 0.1", kind="share"
        ),
        *(score for score in ReadoutTrack.scores if score.key != "auc_r02"),
    )
    beside = ("right", "wrong", "failure")
    states_sigma = True
    unknowns = 1

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        spread = spread_of([truth.shutter.readout_ratio for truth in split.truths])
        rows = super().rows(submission, split)
        for row, truth in zip(rows, split.truths, strict=True):
            answer = submission.answers.get(truth.name)
            row |= dict.fromkeys(("skill", "right", "wrong"), 0.0) | {"nees": math.nan}
            if answer is None or not answer.success or answer.readout_ratio is None:
                continue
            off, sigma = answer.readout_ratio - truth.shutter.readout_ratio, answer.readout_sigma
            row["skill"] = 1.0 - crps(off, sigma or 0.0) / spread
            row["right" if abs(off) <= RIGHT else "wrong"] = 1.0
            if sigma is not None:
                z = off / sigma if sigma > 0.0 else math.inf
                row["nees"] = z * z  # z ** 2 raises an error where it overflows
        return rows


def crps(error: float, sigma: float) -> float:
    """Continuous ranked probability score of a Gaussian; ``abs(error)`` where ``sigma`` is 0 or far smaller.

    It is the integrated squared distance of the Gaussian's distribution function from the step at the truth, by
    the closed form of Gneiting and Raftery (JASA 2007, section 4.2).
    """
    z = error / sigma if sigma > 0.0 else math.inf
    if math.isinf(z):
        return abs(error)
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return sigma * (z * math.erf(z / math.sqrt(2.0)) + 2.0 * density - 1.0 / math.sqrt(math.pi))


def spread_of(ratios: Sequence[float]) -> float:
    """The mean CRPS of the distribution of all ``ratios`` for each of them: half of their mean distance.

    No distribution that is stated for all of them alike has a lower mean. A single ratio has no spread: its value
    is that of ratios even from 0 to 1.
    """
    known = np.array(ratios)
    return 0.5 * float(np.mean(np.abs(known[:, None] - known))) or 1.0 / 6.0


def best_constant(ratios: Sequence[float]) -> float:
    """The guess that, said of all, has the largest AUC@0.1: a sum of tents is largest at the top of one."""
    known = np.array(ratios)
    tents = np.clip(1.0 - np.abs(known[:, None] - known) / AUC_READOUT["auc_r10"], 0.0, None)
    return float(known[np.argmax(np.sum(tents, axis=1))])
