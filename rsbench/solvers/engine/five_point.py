"""Five matches of one rolling-shutter camera: all small rotations that they allow.

To first order in w the exact constraint of the paper's motion is linear in d, with rows that are linear in w:

    m(w) . d = 0,   m(w) = c + (a (x y^T - (x.y) I) - k1 [c]x) w,   c = x cross y, a = k3 - k1

Five rows have a common null vector d when all ten 3 x 3 minors vanish: ten cubics in w with 20 monomials, solved
by elimination and an action matrix. At phi = 0 this is the linearised global-shutter five-point problem. The
baseline is ignored, which costs |w| baseline / (2 |d|); what follows must put it right.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.vectors import cross, dot

IntArray = NDArray[np.int64]

_DEGREES = [
    *[(i, j, k) for i, j, k in itertools.product(range(4), repeat=3) if i + j + k == 3],
    *[(i, j, k) for total in (2, 1, 0) for i, j, k in itertools.product(range(3), repeat=3) if i + j + k == total],
]
"""Exponents of the 20 monomials: ten cubic ones, six quadratic, three linear, one."""
_INDEX = {degrees: index for index, degrees in enumerate(_DEGREES)}
_LINEAR = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))


def _sum(*degrees: tuple[int, int, int]) -> int:
    total = tuple(sum(column) for column in zip(*degrees, strict=True))
    return _INDEX[(total[0], total[1], total[2])]


_PRODUCT = np.array([[[_sum(a, b, c) for c in _LINEAR] for b in _LINEAR] for a in _LINEAR], dtype=np.int64)
"""Monomial (4, 4, 4) of the product of three among 1, w1, w2, w3."""
_TRIPLES = np.array(list(itertools.combinations(range(5), 3)), dtype=np.int64)
_TIMES_W1 = [_sum(degrees, (1, 0, 0)) for degrees in _DEGREES[10:]]
_UNIT = 0.1
"""Radians: the elimination works on w / 0.1, of order one."""
_MAX_ROTATION = 0.6


@compiled
def linear_rows(pairs: FloatArray, rows: FloatArray) -> None:
    """Fill rows (n, 3, 4) of m(w), the constant part and the factors of w1, w2, w3, from pairs (n, 7)."""
    for n in range(len(pairs)):
        x, y, k1 = (pairs[n, 0], pairs[n, 1], 1.0), (pairs[n, 2], pairs[n, 3], 1.0), pairs[n, 4]
        a, c = pairs[n, 5] - k1, cross(x, y)
        for i in range(3):
            rows[n, i, 0] = c[i]
            for j in range(3):
                rows[n, i, 1 + j] = a * x[i] * y[j]
            rows[n, i, 1 + i] -= a * dot(x, y)
            j, k = (i + 1) % 3, (i + 2) % 3
            rows[n, i, 1 + j] += k1 * c[k]
            rows[n, i, 1 + k] -= k1 * c[j]


@compiled
def _minors(rows: FloatArray, triples: IntArray, product: IntArray, out: FloatArray) -> None:
    """Coefficients (10, 20) of the determinants of three rows each."""
    for t in range(10):
        for s in range(6):
            i, j, k = ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2))[s]
            sign = 1.0 if s < 3 else -1.0
            for p in range(4):
                for q in range(4):
                    pq = sign * rows[triples[t, 0], i, p] * rows[triples[t, 1], j, q]
                    for r in range(4):
                        out[t, product[p, q, r]] += pq * rows[triples[t, 2], k, r]


def five_point(pairs: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """``(w, d)`` with a unit d of either sign, for every real small solution of pairs (5, 7) of one camera."""
    rows = np.zeros((5, 3, 4))
    linear_rows(pairs, rows)
    scaled = rows * np.array([1.0, _UNIT, _UNIT, _UNIT])
    scaled /= np.maximum(np.linalg.norm(scaled.reshape(5, 12), axis=1), 1e-300)[:, None, None]
    cubics = np.zeros((10, 20))
    _minors(scaled, _TRIPLES, _PRODUCT, cubics)
    try:
        reduced = np.linalg.solve(cubics[:, :10], cubics[:, 10:])
        action = np.zeros((10, 10))
        for row, target in enumerate(_TIMES_W1):
            if target < 10:
                action[row] = -reduced[target]
            else:
                action[row, target - 10] = 1.0
        if not np.all(np.isfinite(action)):
            return []
        values, vectors = np.linalg.eig(action)
    except np.linalg.LinAlgError:
        return []
    real = (np.abs(values.imag) < 1e-9 * (1.0 + np.abs(values.real))) & (np.abs(vectors[9]) > 1e-12)
    v = vectors[:, real].real
    w = _UNIT * v[8:5:-1] / v[9]
    w = w[:, np.linalg.norm(w, axis=0) < _MAX_ROTATION].T
    M = rows[:, :, 0] + np.einsum("nij,kj->kni", rows[:, :, 1:], w)
    _, axes = np.linalg.eigh(np.swapaxes(M, 1, 2) @ M)
    return list(zip(w, axes[:, :, 0], strict=True))
