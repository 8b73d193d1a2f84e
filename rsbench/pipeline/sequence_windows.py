"""The windows of a sequence: both images of two successive times, and what is refused of them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from rsbench.capture.calibration import RefusedFramesError
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side
from rsbench.pipeline.footage import FrameSource, check_alike
from rsbench.pipeline.frame_depth import Images

JUDGED = 3
"""First windows whose rig is looked at; when all of them are refused, so is the sequence."""


class Refusals:
    """Windows that were refused; when these are all that were seen first, or all, so is the sequence."""

    def __init__(self, source: FrameSource) -> None:
        self._source, self._count = source, 0
        self._last: RefusedFramesError | None = None

    def add(self, number: int, error: RefusedFramesError) -> None:
        """Window ``number`` was refused."""
        self._count, self._last = self._count + 1, error
        if number + 1 == JUDGED:
            self.end(JUDGED)

    def end(self, windows: int) -> None:
        """There are no more than ``windows``."""
        if self._last is not None and self._count == windows:
            raise RefusedFramesError(self._last.reason, f"{self._source.path}, frames 0 to {windows}")


def window_images(left: FrameSource, right: FrameSource) -> Iterator[Images]:
    for pair in itertools.pairwise(_both(left, right)):
        yield {(side, frame): both[side] for frame, both in enumerate(pair) for side in SIDES}


def _both(left: FrameSource, right: FrameSource) -> Iterator[dict[Side, NDArray[Any]]]:
    """Left and right image of every time, all alike."""
    first: NDArray[Any] | None = None
    number = -1
    for number, (a, b) in enumerate(itertools.zip_longest(left, right)):
        if a is None or b is None:
            shorter, longer = (left, right) if a is None else (right, left)
            raise RsbenchError(f"{shorter.path}: has {number} frames, fewer than {longer.path}")
        first = a if first is None else first
        check_alike({f"{left.path}, frame 0": first, f"{left.path}, frame {number}": a})
        check_alike({f"{left.path}, frame {number}": a, f"{right.path}, frame {number}": b})
        yield {"left": a, "right": b}
    if number < 1:
        raise RsbenchError(f"{left.path}: has {number + 1} frames; at least 2 are needed")
