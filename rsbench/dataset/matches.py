"""The channel ``matches``: what a feature matcher finds in two successive frames, labelled by the truth."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray
from rsbench.storage.files import save_arrays
from rsbench.storage.untrusted_files import load_arrays

MATCHED: dict[str, tuple[View, View]] = {
    "left": (("left", 0), ("left", 1)),
    "right": (("right", 0), ("right", 1)),
    "stereo_0": (("left", 0), ("right", 0)),
    "stereo_1": (("left", 1), ("right", 1)),
}
"""The pairs of pictures that a stereo solver uses of two successive frames, by their names in ``Correspondences``:
from which to which. Their order numbers them."""


class MatchClass(IntEnum):
    """What is true of a match."""

    UNSOLVED = 0
    """The row that sees the point could not be found."""
    RIGHT = 1
    """The other picture sees the point within ``Matching.bound_px`` of the second keypoint."""
    OCCLUDED = 2
    """The point is in view, but something nearer hides it: the match cannot be right."""
    OUT_OF_VIEW = 3
    """The point is beside the other picture or behind its camera."""
    NO_SURFACE = 4
    """The first keypoint sees the sky; what is true of it is true of its direction."""
    WRONG = 5
    """The other picture sees the point elsewhere."""


@dataclass(frozen=True, kw_only=True)
class Matching:
    """Who matches, and how near a right match is."""

    features: str = "sift"
    """Name of a feature matcher, or the path of its card."""
    bound_px: float = 3.0
    """Largest distance of the second keypoint from the true place in a match that counts as right."""

    def __post_init__(self) -> None:
        if not 0.0 < self.bound_px < np.inf:
            raise ValueError(f"bound_px = {self.bound_px}: must be a positive number of pixels")


class PairLabels(NamedTuple):
    """The matches of one pair of frames: see ``LabelledMatches``."""

    pixels: FloatArray
    depth: FloatArray
    truth: FloatArray
    error: FloatArray
    classes: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledMatches:
    """Matches (n), those of each pair of frames together, in the order of ``MATCHED``; tracks come first.

    Raises:
        ValueError: arrays of other shapes or types, or of values that cannot be.
    """

    sets: NDArray[np.uint8]
    """(n,) number of the pair of frames."""
    tracks: NDArray[np.int32]
    """(n,) number of the track through all four frames that the match is a part of; -1: of none."""
    pixels: FloatArray
    """(n, 2, 2) px of both keypoints, as the matcher gives them."""
    depth: FloatArray
    """(n,) z of what the first keypoint sees, in the camera of its own time, metres; 0 = no surface."""
    truth: FloatArray
    """(n, 2) px where the other picture sees that at its own time, hidden or not; NaN where it does not."""
    error: FloatArray
    """(n,) distance of the second keypoint from it, px; NaN likewise."""
    classes: NDArray[np.uint8]
    """(n,) of ``MatchClass``."""

    def __post_init__(self) -> None:
        n, f8, u1 = len(self.sets), np.dtype(np.float64), np.dtype(np.uint8)
        wanted = {"sets": ((n,), u1), "tracks": ((n,), np.dtype(np.int32)), "pixels": ((n, 2, 2), f8)}
        wanted |= {"depth": ((n,), f8), "truth": ((n, 2), f8), "error": ((n,), f8), "classes": ((n,), u1)}
        for name, (shape, kind) in wanted.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype != kind:
                raise ValueError(f"{name} is {value.dtype} of shape {value.shape}: {kind} of {shape} is needed")
        if np.any(np.diff(self.sets.astype(int)) < 0) or np.any(self.sets >= len(MATCHED)):
            raise ValueError(f"sets must grow from 0 to {len(MATCHED) - 1} at most")
        if not np.all(np.isfinite(self.pixels)) or not np.all(np.isfinite(self.depth) & (self.depth >= 0.0)):
            raise ValueError("pixels must be finite, and depth not negative")
        if np.any(self.classes > max(MatchClass)):
            raise ValueError(f"classes holds {np.max(self.classes)}: a match is of class 0 to {max(MatchClass)}")
        numbers = [self.tracks[(self.sets == k) & (self.tracks >= 0)] for k in range(len(MATCHED))]
        if any(not np.array_equal(each, np.arange(len(numbers[0]))) for each in numbers):
            raise ValueError("tracks must be numbered 0, 1, ... in each pair of frames, as many in each")

    def of_pair(self, number: int) -> PairLabels:
        """The matches of one pair of frames."""
        own = self.sets == number
        return PairLabels(*(getattr(self, name)[own] for name in PairLabels._fields))

    def correspondences(self, keep: NDArray[np.bool_] | None = None) -> Correspondences:
        """What a solver is given: all matches, or those of a mask (n,) and the tracks of which all parts are."""
        kept = np.ones(len(self.sets), dtype=np.bool_) if keep is None else keep
        rows = {name: self.pixels[(self.sets == k) & kept].reshape(-1, 4) for k, name in enumerate(MATCHED)}
        whole = (np.bincount(self.tracks[kept & (self.tracks >= 0)]) == len(MATCHED)).nonzero()[0]
        at = [self.pixels[(self.sets == k) & (self.tracks >= 0)][whole] for k in (2, 3)]
        return Correspondences(**rows, tracks=np.concatenate(at, axis=1).reshape(-1, 8))


def save_matches(path: Path, matches: LabelledMatches) -> None:
    """The arrays by their names."""
    save_arrays(path, {field.name: getattr(matches, field.name) for field in fields(matches)})


def read_matches(path: Path) -> LabelledMatches:
    """Raises RsbenchError as ``reading.load_arrays``, and for arrays that are no matches."""
    try:
        return LabelledMatches(**load_arrays(path))
    except (TypeError, ValueError) as error:
        raise RsbenchError(f"{path}: {error}") from error
