"""Hits of rays through pixel centres: depth, object and gloss."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Hits(NamedTuple):
    """Of rows of a frame, each (rows, width)."""

    depth: NDArray[np.float32]
    """z in the camera of the row, metres; 0 = no surface."""
    labels: NDArray[np.uint8]
    """Number of the object that moves and is seen there, 0 = none; see ``carried.SHADED``."""
    gloss: NDArray[np.bool_]
    """Whether the surface is glossy."""

    @classmethod
    def none(cls, rows: int, width: int) -> Hits:
        """Nothing, to be filled."""
        shape = rows, width
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.bool_))
