"""Compiled: the motion of a minimal sample from the coefficients of its generalised essential matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.free_kernels import free_from_row, free_in_front, free_terms
from rsbench.solvers.engine.free_minimum import descend

_UNKNOWNS = 11


@compiled
def propose(
    Rs: FloatArray,
    vectors: FloatArray,
    F: FloatArray,
    place: NDArray[np.int64],
    rows: FloatArray,
    focal: FloatArray,
    first: float,
    slowness: float,
    most: tuple[int, int],
    R: FloatArray,
    out: FloatArray,
) -> None:
    """R (3, 3) and vectors (5, 3) of a camera that does not turn within a frame, filled; most points in front.

    Args:
        Rs, vectors: (2, 3, 3), (2, 5, 3) where to descend from to the unit coefficients (21,) F.
        rows: (n, 6) with s = 0 at the principal point's row; ``first`` is that of the first row, which the motion
            starts from.
        slowness: of ``free_minimum``.
        most: evaluations of the descents to F, and of that of the Sampson errors, from no velocities; 0: none.
    """
    near_R, near = np.zeros((4, 3, 3)), np.zeros((4, 5, 3))
    for k in range(2):
        descend(Rs[k], vectors[k], _UNKNOWNS, most[0], 1e-28, rows[:0], focal, 0.0, F, place)
        _with_twin(Rs[k], vectors[k], near_R[2 * k : 2 * k + 2], near[2 * k : 2 * k + 2])
    best = _most_likely(near_R, near, rows, focal)
    free_from_row(near_R[best], near[best], first, R, out)
    moved = rows.copy()
    for m in range(len(rows)):
        moved[m, 4] -= first
        moved[m, 5] -= first
    if most[1] > 0:
        for i in range(1, 3):
            for j in range(3):
                out[i, j] = 0.0
        descend(R, out, _UNKNOWNS, most[1], 0.0, moved, focal, slowness, F[:0], place)
    if free_in_front(R, -out, moved) > free_in_front(R, out, moved):
        for i in range(3):
            for j in range(3):
                out[i, j] = -out[i, j]


@compiled
def _with_twin(R: FloatArray, vectors: FloatArray, out_R: FloatArray, out: FloatArray) -> None:
    """A motion and, by half a turn about its t, ``FreeMotion.twin``, filled."""
    for i in range(3):
        for j in range(3):
            out_R[0, i, j], out_R[1, i, j] = R[i, j], -R[i, j]
            for k in range(3):
                out_R[1, i, j] += 2.0 * vectors[0, i] * vectors[0, k] * R[k, j]
    for i in range(5):
        for j in range(3):
            out[0, i, j] = vectors[i, j]
            out[1, i, j] = vectors[i, j]


@compiled
def _most_likely(Rs: FloatArray, vectors: FloatArray, rows: FloatArray, focal: FloatArray) -> int:
    """Which motion has the least errors of those with more than half as many points in front as any has."""
    n = len(Rs)
    front, r, J = np.zeros(n, dtype=np.int64), np.zeros(len(rows)), np.zeros((0, 18))
    for k in range(n):
        front[k] = max(free_in_front(Rs[k], vectors[k], rows), free_in_front(Rs[k], -vectors[k], rows))
    best, least = 0, np.inf
    for k in range(n):
        if 2 * front[k] < np.max(front):
            continue
        free_terms(Rs[k], vectors[k], rows, focal, r, J)
        total = np.sum(r * r)
        if total < least:
            best, least = k, total
    return best
