"""The track that asks for the readout ratio."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from rsbench.benchmark.leaderboard.motion_tracks import SeveralLaws
from rsbench.benchmark.leaderboard.running import CHOOSES, SolverTrack, seed_of_answer
from rsbench.benchmark.leaderboard.splits import FrameTrack
from rsbench.benchmark.leaderboard.submissions import submission_text, template_header
from rsbench.benchmark.leaderboard.track import (
    FAILED,
    ORACLE,
    SECONDS,
    Answer,
    Row,
    Score,
    Split,
    Submission,
    Truth,
    last,
    named,
)
from rsbench.capture.hypotheses import MODELS, scans_of
from rsbench.capture.shutter_decision import known_of
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.core.correspondences import Correspondences, join_stereo, temporal_pairs
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.base import SolverEntry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import RefinedSolver
from rsbench.storage.files import write_bytes

AUC_READOUT = {"auc_r10": 0.1, "auc_r02": 0.02}
"""Thresholds of the areas under the curve of the error, by the name of the column."""
_MAX_SIGMA = 0.2
"""Standard deviation, at most, of a ratio that an entry of ours answers with."""
_WORST = 1.0
"""Error of a failure: between the two ends of what a ratio can be."""
_READOUT = (
    *(
        Score(
            key=key,
            title=f"AUC@{limit:g}",
            hint=f"area under the curve of the error of the readout ratio to {limit:g}",
            kind="share",
            better="higher",
        )
        for key, limit in AUC_READOUT.items()
    ),
    FAILED,
    Score(key="e_readout", title="error", hint="median error of the readout ratio", kind="median"),
    SECONDS,
)


@dataclass(frozen=True, kw_only=True)
class _Readout(Answer):
    """An answer where the readout ratio is asked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.success and self.readout_ratio is None:
            raise ValueError("readout_ratio: a success needs it; a failure says success = false")


class ReadoutTrack(FrameTrack, SolverTrack):
    """The readout ratio, from given matches of rendered frames."""

    name, id = "readout", "readout-1"
    title = "Readout ratio from given matches of rendered frames"
    allowed = ("left", "right", "links")
    given = "matches of the frames by rsbench's SIFT, without the readout ratio"
    scores = _READOUT
    error, error_title = "e_readout", "error of the readout ratio"
    exact = MappingProxyType({"e_readout": 1e-9})
    answers = _Readout
    states_sigma: ClassVar[bool] = False
    """Whether entries of ours state the deviation of their ratio."""
    smoke = ("rs-stereo-refined", "rs-stereo-refined-pairs", ORACLE)
    smoke_metrics = ("e_readout",)
    example = MappingProxyType({"readout_ratio": 0.5})

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        return {"readout_ratio": truth.shutter.readout_ratio}

    def check_entry(self, entry: SolverEntry) -> None:
        solver = entry.solver
        if not isinstance(solver, RefinedSolver) or solver.spec.shutter != "rolling" or solver.one_camera:
            raise RsbenchError(
                f"solver {entry.name!r}: finds no readout ratio; rs-stereo-refined and its variants do"
            )
        super().check_entry(entry)

    def models_of(self, entry: SolverEntry) -> tuple[str, ...]:
        """Motion models under which an entry looks for the ratio."""
        assert isinstance(entry.solver, RefinedSolver)
        return (entry.solver.motion_model,)

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        """The readout ratio that explains the matches best; it needs no ``runner``: the solver is one of ours."""
        solver = entry.solver
        assert isinstance(solver, RefinedSolver)
        matches, start = join_stereo(problem.correspondences).correspondences, time.perf_counter()
        if not solver.use_tracks:
            left, right = (temporal_pairs(matches, side) for side in SIDES)
            matches = Correspondences(left=left, right=right)
        scanning = problem.shutter.scanning
        known = known_of(matches, problem.rig, None, scanning, None, self.models_of(entry))
        known = replace(known, scans=(scans_of(replace(problem.shutter, readout_ratio=1.0)),))
        seed = seed_of_answer(problem, entry)
        capture = conclude([examine(matches, problem.rig, known, RobustOptions(), seed)])
        seconds, best = round(time.perf_counter() - start, 6), capture.likeliest
        if best is None or not best.sigma <= _MAX_SIGMA:
            reason = f"cannot tell the readout ratio: {capture.reason}"[:300]
            return {"name": problem.name, "success": False, "reason": reason, "seconds": seconds}
        found = {"name": problem.name, "readout_ratio": best.ratio, "seconds": seconds}
        return found | ({"readout_sigma": best.sigma} if self.states_sigma else {})

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        return [readout_row(truth, submission.answers.get(truth.name)) for truth in split.truths]


def readout_row(truth: Truth, answer: Answer | None) -> Row:
    """Scores of an answer to one problem."""
    ratio = None if answer is None or not answer.success else answer.readout_ratio
    error = _WORST if ratio is None else abs(ratio - truth.shutter.readout_ratio)
    return {
        **named(truth, ratio is not None),
        "e_readout": error,
        **{name: max(0.0, 1.0 - error / limit) for name, limit in AUC_READOUT.items()},
        **last(ratio is not None, answer),
    }


# Second protocols: several laws of motion, scores that separate, ratios that nobody guesses, one entry each.
CONSTANT = "constant"
RIGHT = 0.1
"""Error of a readout ratio that counts as right."""
_GUESS = "The one ratio that, said of all sequences, has the best score"


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
