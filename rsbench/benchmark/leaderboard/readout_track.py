"""The track that asks for the readout ratio."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, ClassVar

from rsbench.benchmark.leaderboard.answers import Answer
from rsbench.benchmark.leaderboard.frame_inputs import FrameTrack
from rsbench.benchmark.leaderboard.marking import last, named
from rsbench.benchmark.leaderboard.running import SolverTrack, seed_of_answer
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.track import FAILED, ORACLE, SECONDS, Row, Score
from rsbench.capture.estimate import conclude, examine
from rsbench.capture.scans import scans_of
from rsbench.capture.settle import known_of
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.core.track_building import join_stereo
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.registry import SolverEntry
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import RefinedSolver

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
