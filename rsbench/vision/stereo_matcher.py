"""The contract of stereo matchers, dense disparity of a rectified pair, and how they are found by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench import plugins
from rsbench.arguments import check_ideal
from rsbench.core.rig import SIDES, StereoRig
from rsbench.errors import RsbenchError
from rsbench.plugins import Entry, Kind, RunOptions

F32 = NDArray[np.float32]


class StereoMatcher(ABC):
    """Dense disparity of the two images of one time; a frozen dataclass, whose fields a card may set."""

    @abstractmethod
    def disparities(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Disparity ``x_left - x_right`` (H, W), px, on the left image's pixels and on the right image's.

        Images (H, W) or (H, W, 3) RGB; NaN is unknown, 0 and what noise puts below it infinitely far. Rows are
        rectified in a rolling-shutter pair too, for both cameras read a row at the same time. ``rig`` gives focal
        length and baseline to a matcher that limits its search.
        """


MatcherEntry = Entry[StereoMatcher, RunOptions]
STEREO_MATCHERS: Kind[StereoMatcher, RunOptions] = Kind(
    singular="matcher",
    cards="matchers",
    base=StereoMatcher,
    options=RunOptions,
)


def load_matcher(name_or_path: str | Path) -> MatcherEntry:
    """A stereo matcher by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: no such matcher, two of that name, or its card or class is wrong.
    """
    return plugins.load_entry(STEREO_MATCHERS, name_or_path)


def find_disparities(
    entry: MatcherEntry, left: NDArray[np.uint8], right: NDArray[np.uint8], rig: StereoRig
) -> tuple[F32, F32]:
    """What a matcher makes of a pair, checked: float32 (H, W) each, finite or NaN.

    Raises:
        RsbenchError: another package's matcher raised, or answered something else: one line with its name.
    """
    where = f"{STEREO_MATCHERS.singular} {entry.name!r}"
    check_ideal(rig, where)
    with plugins.blame(STEREO_MATCHERS, entry):
        answer = entry.component.disparities(left, right, rig)
    if not isinstance(answer, tuple) or len(answer) != len(SIDES):
        raise RsbenchError(f"{where}: must return two arrays, left and right, got {type(answer).__name__}")
    first, second = (
        _checked(disparity, left.shape[:2], f"{where}: {side} disparity")
        for side, disparity in zip(SIDES, answer, strict=True)
    )
    return first, second


def _checked(disparity: object, size: tuple[int, ...], where: str) -> F32:
    if not isinstance(disparity, np.ndarray) or not np.issubdtype(disparity.dtype, np.floating):
        kind = disparity.dtype if isinstance(disparity, np.ndarray) else type(disparity).__name__
        raise RsbenchError(f"{where}: must be an array of floating point numbers, got {kind}")
    if disparity.shape != size:
        raise RsbenchError(f"{where}: must have the image's shape {size}, got {disparity.shape}")
    infinite = np.isinf(disparity)
    if np.any(infinite):
        raise RsbenchError(f"{where}: {np.count_nonzero(infinite)} values are infinite; NaN is unknown")
    known = disparity[~np.isnan(disparity)]
    if known.size and np.median(known) < 0.0:
        raise RsbenchError(f"{where}: is mostly below 0, such as {known.min()}; disparity is x_left - x_right")
    return np.asarray(disparity, dtype=np.float32)
