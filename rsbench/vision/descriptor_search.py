"""Nearest and second-nearest descriptors among candidates in a window, exhaustively and exactly.

SIFT descriptors are whole numbers up to 255 with a squared length below 2**24, so their products are exact in
float32 whatever the order of the sums: the result depends neither on the BLAS nor on its threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.so3 import FloatArray

_CHUNK = 256
F32 = NDArray[np.float32]
Found = tuple[NDArray[np.int64], F32, F32, NDArray[np.int64]]


def best_two(
    points_a: FloatArray,
    descriptors_a: F32,
    points_b: FloatArray,
    descriptors_b: F32,
    dx: tuple[float, float],
    dy: tuple[float, float],
) -> Found:
    """Best candidate in b of each of a, its and the runner-up's squared distance, and the best in a of each of b.

    Points (n, 2) must be sorted by y; the candidates b of a point a are those with b - a within ``dx`` and ``dy``
    (px, both ends included). Indices are -1 and distances inf where there is no candidate.
    """
    n, m = len(points_a), len(points_b)
    best, nearest = np.full(n, -1, dtype=np.int64), np.full(n, np.inf, dtype=np.float32)
    second, back = np.full(n, np.inf, dtype=np.float32), np.full(m, -1, dtype=np.int64)
    back_nearest = np.full(m, np.inf, dtype=np.float32)
    norms_a: F32 = np.asarray(np.sum(descriptors_a * descriptors_a, axis=1, dtype=np.float32))
    norms_b: F32 = np.asarray(np.sum(descriptors_b * descriptors_b, axis=1, dtype=np.float32))
    window = np.array([*dx, *dy], dtype=np.float64)
    for start in range(0, n, _CHUNK):
        stop = min(start + _CHUNK, n)
        low = int(np.searchsorted(points_b[:, 1], points_a[start, 1] + dy[0] - 1.0))
        high = int(np.searchsorted(points_b[:, 1], points_a[stop - 1, 1] + dy[1] + 1.0))
        if low >= high:
            continue
        products = descriptors_a[start:stop] @ descriptors_b[low:high].T
        _scan(
            products,
            norms_a,
            norms_b,
            points_a,
            points_b,
            start,
            low,
            window,
            best,
            nearest,
            second,
            back,
            back_nearest,
        )
    return best, nearest, second, back


@compiled
def _scan(
    products: F32,
    norms_a: F32,
    norms_b: F32,
    points_a: FloatArray,
    points_b: FloatArray,
    start: int,
    low: int,
    window: FloatArray,
    best: NDArray[np.int64],
    nearest: F32,
    second: F32,
    back: NDArray[np.int64],
    back_nearest: F32,
) -> None:
    """Update the results with one block of products, rows from ``start`` of a, columns from ``low`` of b."""
    rows, columns = products.shape
    for r in range(rows):
        i = start + r
        x, y = points_a[i, 0], points_a[i, 1]
        for c in range(columns):
            j = low + c
            distance = norms_a[i] + norms_b[j] - np.float32(2.0) * products[r, c]
            # Most candidates improve on nothing; where they lie matters for the others only.
            if distance >= second[i] and distance >= back_nearest[j]:
                continue
            dx, dy = points_b[j, 0] - x, points_b[j, 1] - y
            if dx < window[0] or dx > window[1] or dy < window[2] or dy > window[3]:
                continue
            if distance < nearest[i]:
                second[i] = nearest[i]
                nearest[i], best[i] = distance, j
            elif distance < second[i]:
                second[i] = distance
            if distance < back_nearest[j]:
                back_nearest[j], back[j] = distance, i
