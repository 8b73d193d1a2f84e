"""Where the samples of a pixel lie."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def subpixel_grid(samples: int) -> NDArray[np.float32]:
    """Offsets (samples, 2) from the pixel centre, in (-0.5, 0.5), px: the same in every pixel, never random.

    Cell (i, j) of a k x k grid holds one sample, shifted inside its cell by (j, i) / k of the cell: the canonical
    arrangement of multi-jittered sampling (Chiu, Shirley, Wang 1994; Kensler 2013) without the jitter. All x are
    distinct, and all y, so an upright edge has k*k grey levels, not k; feature positions depend on those.
    """
    k = math.isqrt(samples)
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(k), np.arange(k)))
    x = (i + (j + 0.5) / k) / k - 0.5
    y = (j + (i + 0.5) / k) / k - 0.5
    return np.stack([x, y], axis=-1).astype(np.float32)
