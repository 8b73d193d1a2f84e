"""The rolling shutter: the one function that turns an image row into a time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core.so3 import FloatArray


@dataclass(frozen=True, kw_only=True)
class RollingShutter:
    """Rows are read from the top, evenly, within ``readout_ratio`` of a frame period."""

    height: int
    """Number of rows."""
    readout_ratio: float
    """phi = T_a / (T_a + T_b) in [0, 1]; 0 is a global shutter (paper, section 2.2)."""

    def __post_init__(self) -> None:
        if self.height < 1:
            raise ValueError(f"shutter height must be at least 1 row, got {self.height}")
        if not (math.isfinite(self.readout_ratio) and 0.0 <= self.readout_ratio <= 1.0):
            raise ValueError(f"readout_ratio must lie in [0, 1], got {self.readout_ratio}")

    @property
    def h(self) -> float:
        """Time per row in frame periods (the paper's h = phi / N)."""
        return self.readout_ratio / self.height

    def row_time(self, y: ArrayLike, frame: ArrayLike) -> FloatArray:
        """Time tau in frame periods at which row ``y`` of frame ``frame`` is read.

        ``y`` is continuous: keypoints use it as it is, rendered rows at the integer row. Row 0 of frame k has
        tau = k exactly, so the global-shutter truth of a frame is the image at row 0's pose.
        """
        return np.asarray(frame, dtype=np.float64) + self.h * np.asarray(y, dtype=np.float64)
