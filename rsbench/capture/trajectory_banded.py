"""Banded symmetric matrices by columns: entry (j, i) of a band (n, width) is element (j + i, j) of the matrix."""

from __future__ import annotations

import numpy as np
import scipy

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray


class NotDefiniteError(ValueError):
    """A matrix without a Cholesky factor."""


def factor(band: FloatArray) -> FloatArray:
    """Lower Cholesky factor, a band.

    Raises:
        NotDefiniteError: there is none.
    """
    try:
        lower = scipy.linalg.cholesky_banded(band.T, lower=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise NotDefiniteError(str(error)) from None
    return np.ascontiguousarray(lower.T)


def solve(lower: FloatArray, right: FloatArray) -> FloatArray:
    """Solution (n, ...) for a right-hand side (n, ...)."""
    return np.asarray(scipy.linalg.cho_solve_banded((lower.T, True), right, check_finite=False))


def log_determinant(lower: FloatArray) -> float:
    """Of the matrix with this factor."""
    return 2.0 * float(np.sum(np.log(lower[:, 0])))


def inner(a: FloatArray, b: FloatArray) -> float:
    """Trace of the product of two bands."""
    return float(np.sum(a[:, 0] * b[:, 0]) + 2.0 * np.sum(a[:, 1:] * b[:, 1:]))


@compiled
def inverse_band(lower: FloatArray) -> FloatArray:
    """The elements of the inverse that lie in the band of the factor.

    K. Takahashi, J. Fagan, M. Chen, Formation of a sparse bus impedance matrix, PICA 1973: from the last column to
    the first, each from those below it.
    """
    n, width = lower.shape
    out, square, column = np.zeros((n, width)), np.zeros((width, width)), np.zeros(width)
    for j in range(n - 1, -1, -1):
        count = min(width, n - j)
        pivot = lower[j, 0]
        # square: the inverse's part of the rows and columns j + 1 .. j + count - 1
        for a in range(1, count):
            for b in range(a, count):
                square[a, b] = square[b, a] = out[j + a, b - a]
        diagonal = 1.0 / (pivot * pivot)
        for a in range(1, count):
            total = 0.0
            for b in range(1, count):
                total += square[a, b] * lower[j, b]
            column[a] = -total / pivot
        for a in range(1, count):
            out[j, a] = column[a]
            diagonal -= lower[j, a] * column[a] / pivot
        out[j, 0] = diagonal
    return out
