"""Corrected frames by where things stand in them: what filters can do to a picture moves nothing.

A frame's noise, blur and vignetting are no matter of the shutter, yet they are most of what SSIM counts on a real
sensor. So windows of the frame and of the truth, blurred alike, are laid over each other where they correlate
most, and what counts is by how far they stand off. Dense flow would not do: on a noisy frame it errs by as much as
a corrected frame is off; nor phase correlation, which undoes the blur.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Sequence as Series
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
from rsbench.benchmark.leaderboard.true_pictures import VIEW, Asked, TruePictures
from rsbench.core.errors import RsbenchError
from rsbench.dataset.layout import exposed_file
from rsbench.dataset.sequence import Sequence
from rsbench.vision.quality import GAUSSIAN, Picture, ssim_map, to_unit, window_mask

LIMIT_PX = 2.0
"""A window that stands farther off has no part in the score."""
WINDOW_PX, _STEP_PX, _REACH_PX = 64, 32, 4
"""Side of a window, from one to the next, and how far it is looked for."""
_BLUR_PX = 3.0
"""Standard deviation of the blur of both pictures."""
_LOOK_PX = 2.0
"""Standard deviation of the blur under which pictures are compared: white noise is left with a seventh."""
_LOOK_CONSTANTS = 0.1
"""Factor of SSIM's constants: the blur takes contrast away, and beside the whole ones a tenth of it would do."""
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


class SeenCorrection(PlacedCorrection):
    """Rolling-shutter frames as a global shutter of the same sensor would have taken them."""

    name, id = "correction-3", "correction-3"
    title = "Corrected frames, by where things stand and how they look"
    scores = (
        Score(
            key="corrected",
            title="placed x picture",
            hint="the product of the two: what stands in its place and looks like the scene there",
            kind="share",
            better="higher",
        ),
        *(score for score in PlacedCorrection.scores if score.key == "placed"),
        Score(
            key="picture",
            title="picture",
            hint="SSIM of blurred images to what a global shutter of the same sensor shows, 0 where not drawn",
            kind="share",
            better="higher",
        ),
        *(score for score in PlacedCorrection.scores if score.key != "placed"),
    )
    error, error_title = "uncorrected", "1 - placed x picture"
    beside = ("placed", "picture", "failure")

    def asked(self, sequence: Sequence) -> tuple[Asked, ...]:
        """The truth is what the same sensor expects under a global shutter, without noise.

        Raises:
            RsbenchError: the dataset has a sensor and no such images.
        """
        asked = super().asked(sequence)
        if sequence.sensor is None:
            return asked
        if not sequence.exposed_twins:
            raise RsbenchError(
                f"{sequence.folder}: has no global-shutter images of its sensor, which {self.id} compares with; "
                "render the dataset again with exposed_twins = true in its card"
            )
        side, frame = VIEW
        return tuple(each._replace(file=exposed_file(side, frame + sequence.first, each.row)) for each in asked)

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], Numbers]:
        others, true = super().scorer(truth, pictures), TrueFrame.all_of(pictures)

        def scores_of(submission: Submission, success: bool) -> Numbers:
            folder, found = submission.folder / FOLDER, others(submission, success)
            drawn = [read_answer_frame(folder, truth, each) for each in pictures.asked] if success else None
            looks = 0.0 if drawn is None else seen_alike(true, drawn)
            both = found["placed"] * looks
            return {**found, "picture": looks, "corrected": both, "uncorrected": 1.0 - both}

        return scores_of


def seen_alike(truths: Series[TrueFrame], frames: Series[Frame]) -> float:
    """The mean over frames of the SSIM to their truth, both blurred, over their common pixels; at least 0.

    What is not drawn counts 0. The blur leaves a sensor's noise without weight, so that a filter gains nothing;
    contrast, colour, strong noise and holes that were filled with anything keep theirs.
    """
    return float(np.mean([_alike(*frame, true) for true, frame in zip(truths, frames, strict=True)]))


def _alike(image: NDArray[np.uint8], drawn: NDArray[np.bool_], true: TrueFrame) -> float:
    seen, wanted = (
        Picture(cv2.GaussianBlur(to_unit(each), (0, 0), _LOOK_PX)) for each in (image, true.picture.image)
    )
    windows = window_mask(drawn.shape, true.common)
    if not np.any(windows):
        return 1.0
    scores = np.mean(ssim_map(seen, wanted, GAUSSIAN, _LOOK_CONSTANTS), axis=-1)
    return max(0.0, float(np.mean(np.where(drawn, scores, 0.0)[windows])))


def placed(truths: Series[TrueFrame], frames: Series[Frame]) -> float:
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
