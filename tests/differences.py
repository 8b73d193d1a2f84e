"""Derivatives by central differences, to hold those of formulas against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core.so3 import FloatArray


def derivatives(of: Callable[[FloatArray], ArrayLike], at: FloatArray, step: float) -> FloatArray:
    """(..., k) of a function by the k numbers of the last axis of ``at``."""
    ends = [(np.asarray(of(at + step * e)), np.asarray(of(at - step * e))) for e in np.eye(at.shape[-1])]
    return np.stack([(after - before) / (2.0 * step) for after, before in ends], axis=-1)
