"""Scores of pictures by parts of their pixels: by distance from the reference row, and by texture.

What a part is decides the truth alone, so that all entries are scored on the same pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray

WINDOW = 9
"""Pixels, of the square over which texture is measured."""
_MOST = 255.0
BoolArray = NDArray[np.bool_]


class Parting(NamedTuple):
    """A number of each pixel, and by which of its values pixels make up parts."""

    name: str
    title: str
    starts: tuple[float, ...]
    """Least value of each part, which figures write at it."""


PARTINGS = (
    Parting(
        name="rows",
        title="rows from the reference row, as a share of all (0.2: from there to 0.4)",
        starts=(0.0, 0.2, 0.4, 0.6, 0.8),
    ),
    Parting(
        name="texture",
        title=f"texture: deviation of grey levels within {WINDOW} px (2: from there to 5)",
        starts=(0.0, 2.0, 5.0, 10.0, 20.0),
    ),
)


def columns(score: str, parting: Parting) -> list[str]:
    """Of scores.csv, such as ``bad_1_rows_1``, in the order of the parts."""
    return [f"{score}_{parting.name}_{number}" for number in range(1, len(parting.starts) + 1)]


def parts_of(image: NDArray[np.uint8], row: int) -> Iterator[tuple[Parting, list[BoolArray]]]:
    """The pixels (H, W) of each part of a picture of row ``row``'s time.

    Args:
        image: (H, W, 3) what the texture is of.
        row: reference row.
    """
    height, width = image.shape[:2]
    away = np.broadcast_to(np.abs(np.arange(height) - row)[:, None] / height, (height, width))
    for parting, value in zip(PARTINGS, (away, texture(image)), strict=True):
        part = np.searchsorted(parting.starts, value, side="right") - 1
        yield parting, [part == number for number in range(len(parting.starts))]


def texture(image: NDArray[np.uint8]) -> FloatArray:
    """(H, W) standard deviation of the mean of the colours in a window around each pixel, 8-bit levels."""
    grey = _mean(image.astype(np.float64))
    mean, square = (
        cv2.blur(each, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT_101) for each in (grey, grey * grey)
    )
    return np.sqrt(np.maximum(square - mean * mean, 0.0))


Parts = dict[str, BoolArray]
"""Pixels (H, W) of each part, by column."""


def parts_within(score: str, image: NDArray[np.uint8], row: int, counted: BoolArray) -> Parts:
    """Of the ``counted`` pixels of a picture (H, W, 3) of row ``row``'s time, by the columns of a ``score``."""
    return {
        name: part & counted
        for parting, parts in parts_of(image, row)
        for name, part in zip(columns(score, parting), parts, strict=True)
    }


class SquareErrors:
    """Root mean squares of frames by part; what was not drawn is black."""

    def __init__(self, score: str) -> None:
        self._sums = {name: np.zeros(2) for parting in PARTINGS for name in columns(score, parting)}
        """Of squared errors, and how many."""

    def add(self, image: NDArray[np.uint8] | None, truth: NDArray[np.uint8], parts: Parts) -> None:
        """A frame (H, W, 3) and its ``parts_within``; None: a failure, which errs by all levels."""
        off = np.full(truth.shape, _MOST) if image is None else image.astype(np.float64) - truth
        squares = _mean(off * off)
        for name, part in parts.items():
            inside = squares[part]
            self._sums[name] += np.array([np.sum(inside), inside.size])

    def scores(self) -> dict[str, float]:
        """By column; NaN for a part without pixels."""
        return {name: math.sqrt(s / n) if n else math.nan for name, (s, n) in self._sums.items()}


def shares(parts: Parts, wrong: BoolArray) -> dict[str, float]:
    """Share of ``wrong`` (H, W) of each part, by column; NaN for one without pixels."""
    return {name: float(np.mean(wrong[part])) if np.any(part) else math.nan for name, part in parts.items()}


def _mean(image: FloatArray) -> FloatArray:
    """(H, W) of the colours of an image (H, W, 3) of whole numbers; numpy's mean takes far longer over so few."""
    return (image[..., 0] + image[..., 1] + image[..., 2]) / 3.0
