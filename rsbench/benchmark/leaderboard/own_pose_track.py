"""The track of motions from frames alone: a method finds its own matches, and may hand them in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rsbench.benchmark.leaderboard.exporting import write_inputs, write_matches
from rsbench.benchmark.leaderboard.frame_inputs import FrameTrack, read_frames
from rsbench.benchmark.leaderboard.motion_tracks import MATCHES, MOTION, MotionTrack
from rsbench.benchmark.leaderboard.own_matches import FOLDER, match_files, match_scores, read_own_matches
from rsbench.benchmark.leaderboard.running import read_inputs, run_cards
from rsbench.benchmark.leaderboard.second_protocols import Choosing
from rsbench.benchmark.leaderboard.splits import Split
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.track import Limits, Row, Step
from rsbench.core.errors import RsbenchError
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_matches import find_matches_of_rig
from rsbench.pipeline.problem import Problem


class OwnPoseTrack(Choosing, FrameTrack, MotionTrack):
    """Of rendered frames; matches of the method's own may be handed in."""

    name, id = "pose-own", "pose-own-1"
    title = "Motion from rendered frames"
    allowed = ("left", "right", "links", "readout", "images")
    given = "the four rolling-shutter frames"
    own_matches = True
    scores = MOTION + MATCHES
    smoke_metrics = (*MotionTrack.smoke_metrics, "matches", "matches_1px")
    also_uses = ("images",)

    def steps(self, cards: Sequence[str], split: Split, limits: Limits) -> int:
        return super().steps(cards, split, limits) + len(split.truths)

    def run(
        self,
        cards: Sequence[str],
        split: Split,
        inputs: Path,
        work: Path,
        *,
        step: Step = lambda word: None,
        **options: Any,
    ) -> list[Path]:
        """Solvers get the matches that ``rsbench correct`` finds by default, and hand them in."""
        found, matched = list[Problem](), work / "matched"
        for problem in with_matches(read_inputs(inputs, self), inputs, CorrectionOptions()):
            found.append(problem)
            step(problem.name)
        write_inputs(replace(split, public=False), found, matched)
        files = run_cards(self, cards, split, matched, work, step=step, **options)
        for file in files:
            write_matches(found, file.parent / FOLDER)
        return files

    def files_of(self, submission: Submission, split: Split) -> Iterable[str]:
        return [f"{FOLDER}/{name}" for name in match_files(submission.folder)]

    def check_beside(
        self, submission: Submission, split: Split, most: int, hints: bool
    ) -> tuple[list[str], list[str]]:
        try:
            read_own_matches(submission.folder, split.by_name)
        except RsbenchError as error:
            return [str(error)], []
        return [], []

    def rows(self, submission: Submission, split: Split) -> list[Row]:
        rows, own = super().rows(submission, split), read_own_matches(submission.folder, split.by_name)
        for row, truth in zip(rows, split.truths, strict=True):
            assert truth.sequence is not None
            row |= match_scores(truth.sequence, None if own is None else own[truth.name])
        return rows


def with_matches(problems: Iterable[Problem], inputs: Path, options: CorrectionOptions) -> Iterator[Problem]:
    """Problems with what the features of the options find in their frames; nothing where these show no texture."""
    for problem in problems:
        images, scanning = read_frames(inputs, problem), problem.shutter.scanning
        try:
            matches = find_matches_of_rig(images, problem.rig, scanning, options)
        except RsbenchError:  # every solver fails such a problem, and says why
            matches = problem.correspondences
        yield replace(problem, correspondences=matches)
