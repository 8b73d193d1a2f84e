"""Tracks of the readout ratio, from given matches of rendered frames."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rsbench.benchmark.leaderboard.motion_tracks import CHOOSES, SolverTrack, seed_of_answer
from rsbench.benchmark.leaderboard.splits import Frames
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
    Track,
    Truth,
    score_row,
)
from rsbench.capture.hypotheses import MODELS, KnownInputs, scans_of
from rsbench.capture.shutter_decision import known_of
from rsbench.capture.two_frame_estimate import conclude, examine
from rsbench.core.correspondences import Correspondences, join_stereo, temporal_pairs
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.base import SolverEntry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import RefinedSolver

AUC_READOUT = {"auc_r10": 0.1, "auc_r02": 0.02}
"""Thresholds of the areas under the curve of the error, by the name of the column."""
CONSTANT = "constant"
RIGHT = 0.1
"""Largest error of a correct readout ratio."""
_MAX_SIGMA = 0.2
"""Largest standard deviation of a ratio that rsbench's entries submit; with a larger one they fail."""
_WORST = 1.0
"""Error of a failure: the largest possible error of a ratio."""
_READOUT = (
    *(
        Score(
            key,
            f"AUC@{limit:g}",
            f"area under the curve of the error of the readout ratio to {limit:g}",
            "share",
            "higher",
        )
        for key, limit in AUC_READOUT.items()
    ),
    FAILED,
    Score("e_readout", "error", "median error of the readout ratio", "median"),
    SECONDS,
)


@dataclass(frozen=True, kw_only=True)
class _Readout(Answer):
    """An answer that is a readout ratio."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.success and self.readout_ratio is None:
            raise ValueError("readout_ratio: a success needs it; for a failure give success = false")


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadoutTrack(SolverTrack):
    """The readout ratio, from given matches of rendered frames."""

    states_sigma: bool = False
    """Whether answers of rsbench's entries have the standard deviation of the ratio."""
    answers = _Readout

    def true_answer(self, truth: Truth) -> Mapping[str, Any]:
        return {"readout_ratio": truth.shutter.readout_ratio}

    def example(self, split: Split) -> Mapping[str, Any]:
        return {"readout_ratio": 0.5}

    def check_entry(self, entry: SolverEntry) -> None:
        solver = entry.solver
        if not isinstance(solver, RefinedSolver) or solver.spec.shutter != "rolling" or solver.one_camera:
            raise RsbenchError(
                f"solver {entry.name!r}: finds no readout ratio; rs-stereo-refined and its variants do"
            )
        super().check_entry(entry)

    def answer(self, problem: Problem, entry: SolverEntry, runner: SolverRunner) -> dict[str, Any]:
        """Return the readout ratio that fits the matches best; the solver is built in and needs no ``runner``."""
        solver = entry.solver
        assert isinstance(solver, RefinedSolver)
        matches, start = join_stereo(problem.correspondences).correspondences, time.perf_counter()
        if not solver.use_tracks:
            left, right = (temporal_pairs(matches, side) for side in SIDES)
            matches = Correspondences(left=left, right=right)
        scanning = problem.shutter.scanning
        models = MODELS if entry.name == CHOOSES else (solver.motion_model,)
        known = known_of(matches, problem.rig, KnownInputs(scanning=scanning, models=models))
        known = replace(known, scans=(scans_of(replace(problem.shutter, readout_ratio=1.0)),))
        seed = seed_of_answer(problem, entry)
        capture = conclude([examine(matches, problem.rig, known, RobustOptions(), seed)])
        seconds, best = round(time.perf_counter() - start, 6), capture.likeliest
        if best is None or not best.sigma <= _MAX_SIGMA:
            reason = f"cannot tell the readout ratio: {capture.reason}"[:300]
            return {"name": problem.name, "success": False, "reason": reason, "seconds": seconds}
        found = {"name": problem.name, "readout_ratio": best.ratio, "seconds": seconds}
        return found | ({"readout_sigma": best.sigma} if self.states_sigma else {})

    def row(self, truth: Truth, answer: Answer | None) -> Row:
        ratio = None if answer is None or not answer.success else answer.readout_ratio
        error = _WORST if ratio is None else abs(ratio - truth.shutter.readout_ratio)
        areas = {name: max(0.0, 1.0 - error / limit) for name, limit in AUC_READOUT.items()}
        return score_row(truth, answer, ratio is not None, {"e_readout": error, **areas})


def _add_skill_columns(rows: list[Row], submission: Submission, split: Split) -> None:
    """Add columns of readout-3, in which a failure has the score 0 and a wrong answer may score less."""
    spread = spread_of([truth.shutter.readout_ratio for truth in split.truths])
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


def crps(error: float, sigma: float) -> float:
    """Return the continuous ranked probability score of a Gaussian; ``abs(error)`` if ``sigma`` is negligible.

    It is the integral of the squared difference between the Gaussian's distribution function and a step at the
    truth, in the closed form of Gneiting and Raftery (JASA 2007, section 4.2).
    """
    z = error / sigma if sigma > 0.0 else math.inf
    if math.isinf(z):
        return abs(error)
    density = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return sigma * (z * math.erf(z / math.sqrt(2.0)) + 2.0 * density - 1.0 / math.sqrt(math.pi))


def spread_of(ratios: Sequence[float]) -> float:
    """Return the mean CRPS if the empirical distribution of all ``ratios`` is stated for each of them.

    It is half of their mean distance, and no other single distribution has a lower mean. If all ratios are equal,
    the value for ratios uniform in [0, 1] is returned.
    """
    known = np.array(ratios)
    return 0.5 * float(np.mean(np.abs(known[:, None] - known))) or 1.0 / 6.0


def best_constant(ratios: Sequence[float]) -> float:
    """Return the constant with the largest AUC@0.1; a sum of triangle functions has its maximum at a vertex."""
    known = np.array(ratios)
    tents = np.clip(1.0 - np.abs(known[:, None] - known) / AUC_READOUT["auc_r10"], 0.0, None)
    return float(known[np.argmax(np.sum(tents, axis=1))])


def _constant(split: Split, folder: Path) -> str:
    """Return a submission that answers the best constant for all problems."""
    best = best_constant([truth.shutter.readout_ratio for truth in split.truths])
    words = "The one ratio that, said of all sequences, has the best score"  # as on published boards
    header = {**template_header(split, CONSTANT), "uses": [ORACLE], "description": words}
    return submission_text(header, ({"name": truth.name, "readout_ratio": best} for truth in split.truths))


_SHARED: dict[str, Any] = {
    "allowed": ("left", "right", "links"),
    "given": "matches of the frames by rsbench's SIFT, without the readout ratio",
    "error": "e_readout",
    "error_title": "error of the readout ratio",
    "exact": {"e_readout": 1e-9},
    "smoke_metrics": ("e_readout",),
}
_DRAWN: dict[str, Any] = {
    "inputs": Frames(distinct_ratios=True),
    "parting": "motion",
    "choosing": True,
    "oracles": ((CONSTANT, _constant),),
}
TRACKS: tuple[Track, ...] = (
    ReadoutTrack(
        **_SHARED | _DRAWN,
        name="readout-3",
        id="readout-3",
        title="Readout ratio with its deviation, drawn for each sequence, from given matches of rendered frames",
        scores=(
            Score(
                "skill",
                "skill",
                "1 - CRPS over that of knowing only how the ratios are spread: 1 exact, 0 a refusal",
                "mean",
                "higher",
            ),
            Score("right", "right", "share of problems with a ratio within 0.1", "share", "higher"),
            Score("wrong", "wrong", "share of problems with a ratio off by more than 0.1", "share"),
            *(score for score in _READOUT if score.key != "auc_r02"),
        ),
        beside=("right", "wrong", "failure"),
        states_sigma=True,
        unknowns=1,
        more_columns=_add_skill_columns,
    ),
    ReadoutTrack(
        **_SHARED | _DRAWN,
        name="readout-2",
        id="readout-2",
        title="Readout ratio, drawn for each sequence, from given matches of rendered frames",
        scores=_READOUT,
    ),
    ReadoutTrack(
        **_SHARED,
        name="readout",
        id="readout-1",
        title="Readout ratio from given matches of rendered frames",
        inputs=Frames(),
        scores=_READOUT,
        smoke=("rs-stereo-refined", "rs-stereo-refined-pairs", ORACLE),
    ),
)
