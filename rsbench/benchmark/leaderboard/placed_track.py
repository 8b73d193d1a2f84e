"""Corrected frames by where things stand in them: what filters can do to a picture moves nothing.

A frame's noise, blur and vignetting are no matter of the shutter, yet they are most of what SSIM counts on a real
sensor. So windows of the frame and of the truth, blurred alike, are laid over each other where they correlate
most, and what counts is by how far they stand off. Dense flow would not do: on a noisy frame it errs by as much as
a corrected frame is off; nor phase correlation, which undoes the blur.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.correction_track import CorrectionTrack, Frame, TrueFrame
from rsbench.benchmark.leaderboard.marking import Numbers
from rsbench.benchmark.leaderboard.picture_files import FOLDER, read_answer_frame
from rsbench.benchmark.leaderboard.picture_parts import texture
from rsbench.benchmark.leaderboard.picture_running import CardChain
from rsbench.benchmark.leaderboard.splits import Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.track import Score
from rsbench.benchmark.leaderboard.true_pictures import TruePictures

LIMIT_PX = 2.0
"""A window that stands farther off has no part in the score."""
WINDOW_PX, _STEP_PX, _REACH_PX = 64, 32, 4
"""Side of a window, from one to the next, and how far it is looked for."""
_BLUR_PX = 3.0
"""Standard deviation of the blur of both pictures."""
_TEXTURE = 5.0
"""Grey levels by which the truth must deviate around a pixel that counts: elsewhere nothing tells where it is."""
_LEAST = 0.25
"""Share of a window's pixels that must count."""


class PlacedCorrection(CorrectionTrack):
    """Rolling-shutter frames as a global shutter would have taken them, ranked by geometry."""

    name, id = "correction-2", "correction-2"
    title = "Corrected frames, by where things stand"
    scores = (
        Score(
            key="placed",
            title="placed",
            hint="1 where textured common pixels stand right, 0 from 2 px on and where they are not drawn",
            kind="share",
            better="higher",
        ),
        *(score for score in CorrectionTrack.scores if not score.key.startswith("flip_")),
    )
    flips = False
    error, error_title = "misplaced", "1 - placed"
    smoke: ClassVar[tuple[str, ...]] = ()

    def chain(self, card: str) -> CardChain:
        return super().chain(card).choosing()

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], Numbers]:
        others, true = super().scorer(truth, pictures), TrueFrame.all_of(pictures)

        def scores_of(submission: Submission, success: bool) -> Numbers:
            folder = submission.folder / FOLDER
            drawn = [read_answer_frame(folder, truth, each) for each in pictures.asked] if success else None
            share = 0.0 if drawn is None else placed(true, drawn)
            return {**others(submission, success), "placed": share, "misplaced": 1.0 - share}

        return scores_of


def placed(truths: Sequence[TrueFrame], frames: Sequence[Frame]) -> float:
    """The mean over frames of the share of their textured common pixels that are drawn, each by its window's
    distance from its place: 1 at 0, 0 from ``LIMIT_PX`` on; 1 where no window has enough texture."""
    return float(np.mean([_placed(*frame, true) for true, frame in zip(truths, frames, strict=True)]))


def _placed(image: NDArray[np.uint8], drawn: NDArray[np.bool_], true: TrueFrame) -> float:
    truth = true.picture.image
    counted = true.common & (texture(truth) >= _TEXTURE)
    seen, wanted = (_blurred(each) for each in (image, truth))
    side = min(WINDOW_PX, *(size - 2 * _REACH_PX for size in counted.shape))
    score, total = 0.0, 0
    for y, x in product(*(range(_REACH_PX, size - side - _REACH_PX + 1, _STEP_PX) for size in counted.shape)):
        window = np.s_[y : y + side, x : x + side]
        count = int(np.count_nonzero(counted[window]))
        if count < _LEAST * side * side:
            continue
        around = seen[y - _REACH_PX : y + side + _REACH_PX, x - _REACH_PX : x + side + _REACH_PX]
        there = np.count_nonzero(counted[window] & drawn[window])
        score += there * max(0.0, 1.0 - _distance(around, wanted[window]) / LIMIT_PX)
        total += count
    return score / total if total else 1.0


def _distance(around: NDArray[np.float32], window: NDArray[np.float32]) -> float:
    """Of the place where a window is found from the middle of what is around it, px; infinite at the rim."""
    found = cv2.matchTemplate(around, window, cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(np.argmax(found)), found.shape)
    if not (0 < y < 2 * _REACH_PX and 0 < x < 2 * _REACH_PX):
        return math.inf
    down = _top(found[y - 1 : y + 2, x])
    across = _top(found[y, x - 1 : x + 2])
    return math.hypot(float(y) + down - _REACH_PX, float(x) + across - _REACH_PX)


def _top(three: NDArray[np.float32]) -> float:
    """Where the parabola through three neighbours is largest, from the middle one."""
    before, middle, after = map(float, three)
    bend = before - 2.0 * middle + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


def _blurred(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), dtype=np.float32)
