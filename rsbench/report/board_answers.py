"""Pictures of answers for the leaderboard's pages: depth maps, corrected frames, and where they err."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.board import Scored
from rsbench.benchmark.leaderboard.pictures import PICTURES, TruePictures, read_answer_depth, read_answer_frame
from rsbench.benchmark.leaderboard.track import Truth
from rsbench.core.so3 import FloatArray
from rsbench.report.pictures import Image, colour_map

DEPTH_PX, FRAME_LEVELS = 3.0, 64.0
"""Errors that have the last colour: of disparity, and of the mean over the colours in 8-bit levels."""
_DIFFERENCE = f"difference, 0 (dark) to {FRAME_LEVELS:g} of 255 levels or more (bright); grey: not drawn"
ERRORS = {
    "depth": f"error, 0 (dark) to {DEPTH_PX:g} px of disparity or more (bright); grey: unknown, or no surface",
    "correction": _DIFFERENCE,
    "correction-mono": _DIFFERENCE,
}
Named = tuple[str, str, Image]
"""Stem of the file, words, picture."""


def true_images(track: str, pictures: TruePictures) -> Iterator[Named]:
    """The true pictures of a problem."""
    for each in pictures.requested:
        if track == "depth":
            yield each.stem, "true depth", _depth_image(pictures.depth(), pictures.depth())
        else:
            yield each.stem, f"true frame, {_row(each.stem)}", pictures.frame(each.row)


def answer_images(track: str, entry: Scored, truth: Truth) -> Iterator[Named]:
    """The pictures that an entry submitted for a problem, and their errors; nothing of a failure.

    Raises:
        RsbenchError: a picture is missing, or damaged.
    """
    pictures, method, folder = truth.pictures, entry.header.method, entry.folder / PICTURES
    scores = entry.scores
    assert pictures is not None
    if not bool(scores.loc[scores["problem"] == truth.name, "success"].all()):
        return
    for each in pictures.requested:
        if track == "depth":
            depth = read_answer_depth(folder, pictures, entry.header.png_unit_m)
            yield each.stem, method, _depth_image(depth, pictures.depth())
            yield f"{each.stem}-error", f"{method}, error", depth_error_image(depth, pictures)
        else:
            image, drawn = read_answer_frame(folder, pictures, each)
            words = f"{method}, {_row(each.stem)}"
            yield each.stem, words, image
            yield (
                f"{each.stem}-error",
                f"{words}, error",
                frame_error_image(image, drawn, pictures.frame(each.row)),
            )


def _row(stem: str) -> str:
    return f"{stem.rpartition('_')[2]} row"


def _depth_image(depth: NDArray[np.float32], truth: NDArray[np.float32]) -> Image:
    """Inverse depth in the range of the true one; unknown is grey."""
    low, high = np.quantile(1.0 / truth[truth > 0.0], [0.01, 0.99]) if np.any(truth > 0.0) else (0.0, 1.0)
    return colour_map(_inverse(depth), float(low), float(high))


def _inverse(depth: NDArray[np.float32]) -> FloatArray:
    """NaN where it is not known."""
    return np.divide(1.0, depth, where=depth > 0.0, out=np.full(depth.shape, np.nan))


def depth_error_image(depth: NDArray[np.float32], pictures: TruePictures) -> Image:
    """Error of the disparity, px, in colours."""
    rig = pictures.sequence.rig
    error = rig.camera.fx * rig.baseline * np.abs(_inverse(depth) - _inverse(pictures.depth()))
    return colour_map(error, 0.0, DEPTH_PX)


def frame_error_image(image: Image, drawn: NDArray[np.bool_], truth: Image) -> Image:
    """Mean difference of the three colours, in colours; grey where nothing was drawn."""
    error = np.mean(np.abs(image.astype(np.float64) - truth), axis=-1)
    return colour_map(np.where(drawn, error, np.nan), 0.0, FRAME_LEVELS)
