"""What the linear solvers share: null vectors, and what is read out of them."""

from __future__ import annotations

import numpy as np

from rsbench.core import so3
from rsbench.core.so3 import FloatArray

ROUNDING = 1e-10
"""Below this, relative to the largest, a column norm or singular value is rounding. Exact data of the slowest and
flattest scenes stay above 1e-7; singular configurations below 1e-14."""


def null_vector(A: FloatArray, unit_columns: bool, rounding: float = ROUNDING) -> tuple[FloatArray | None, str]:
    """X (columns,) with A X = 0: the right singular vector of the smallest singular value; or why there is none.

    Args:
        A: (equations, columns).
        unit_columns: scale the columns to unit length first, which is another estimator wherever A has noise.
        rounding: what is rounding, relative to the largest column norm or singular value.
    """
    columns = A.shape[1]
    if len(A) < columns - 1:
        return None, f"{len(A)} equations for {columns} unknowns"
    norms = np.linalg.norm(A, axis=0)
    if not np.min(norms) > rounding * np.max(norms):
        return None, "an unknown has no influence on any match: the motion or the scene is degenerate"
    _, s, Vt = np.linalg.svd(A / norms, full_matrices=len(A) < columns)
    if not s[columns - 2] > rounding * s[0]:
        return None, "the linear system has more than one solution: degenerate motion, scene or readout ratio"
    if unit_columns:
        return Vt[-1] / norms, ""
    return np.linalg.svd(A, full_matrices=len(A) < columns)[2][-1], ""


def rotation_from_essential(E: FloatArray, d: FloatArray, symmetric: bool) -> FloatArray:
    """w (3,) from E = [d]x[w]x = w d^T - (d.w) I, by least squares over all nine entries or the symmetric part."""
    basis = np.eye(3)
    columns = np.stack([np.outer(e, d) - d[k] * np.eye(3) for k, e in enumerate(basis)])
    if symmetric:
        columns, E = columns + np.swapaxes(columns, 1, 2), E + E.T
    w, *_ = np.linalg.lstsq(columns.reshape(3, 9).T, E.reshape(9), rcond=None)
    return np.asarray(w, np.float64)


def scaled_translation(pairs: FloatArray, w: FloatArray, limit: float) -> FloatArray | None:
    """d (3,) in metres for a known rotation; None when the pairs do not hold its length.

    For a given w the exact constraint of the paper's motion is linear in d: ``m . d + beta = 0``; the smallest
    singular vector of [m, beta] gives d with its length.
    """
    n = len(pairs)
    x, y = np.column_stack([pairs[:, :2], np.ones(n)]), np.column_stack([pairs[:, 2:4], np.ones(n)])
    R = so3.exp((pairs[:, 5] - pairs[:, 4])[:, None] * w)
    normal = so3.cross((R @ x[:, :, None])[:, :, 0], y)
    back = (np.swapaxes(R, 1, 2) @ normal[:, :, None])[:, :, 0]
    m = pairs[:, 5:6] * normal - pairs[:, 4:5] * back
    beta = pairs[:, 6] * (normal[:, 0] - back[:, 0])
    norms = np.array([np.linalg.norm(m), np.linalg.norm(beta)])
    if not np.all(norms > 0.0):
        return None
    _, _, Vt = np.linalg.svd(np.column_stack([m / norms[0], beta / norms[1]]), full_matrices=n < 4)
    d, factor = Vt[-1, :3] / norms[0], Vt[-1, 3] / norms[1]
    if not abs(factor) * limit > np.linalg.norm(d):
        return None
    return d / factor
