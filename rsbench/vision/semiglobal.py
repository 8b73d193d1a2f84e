"""Semi-global aggregation of a volume of matching costs, and the depth hypothesis that wins in it.

Hirschmueller, "Stereo processing by semi-global matching and mutual information", PAMI 2008: along each direction
``L(p, k) = C(p, k) + min(L(q, k), L(q, k +- 1) + p1, min L(q) + p2) - min L(q)``, with q the pixel before p; the
sum over directions is least at the hypothesis of a pixel. OpenCV's own takes images, not costs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
U16 = NDArray[np.uint16]
_FAR = np.float32(1e9)


def aggregated(costs: U8, p1: int, p2: int) -> U16:
    """Sum (H, W, n) over the eight directions of the costs (H, W, n) of n hypotheses in order.

    ``p1`` and ``p2``, each at most 4000, are what steps by one and by more hypotheses cost.
    """
    total = np.zeros(costs.shape, dtype=np.uint16)
    for way in (1, -1):
        # Seen from the opposite corner, the same loops run the other way.
        _pass(costs[::way, ::way], total[::way, ::way], np.float32(p1), np.float32(p2))
    return total


def winners(total: U16) -> F32:
    """Hypothesis (H, W) of least cost, with the fraction of the parabola through it and its neighbours."""
    best = np.zeros(total.shape[:2], dtype=np.float32)
    _winners(total, best)
    return best


@compiled(error_model="numpy", fastmath={"nnan", "nsz"})
def _pass(costs: U8, total: U16, p1: np.float32, p2: np.float32) -> None:
    """Add the sums along the four directions that come from above and from the left."""
    height, width, n = costs.shape
    # One hypothesis of padding at both ends, and one pixel at both ends of a row.
    above, here = np.zeros((3, width + 2, n + 2), np.float32), np.zeros((3, width + 2, n + 2), np.float32)
    least_above, least_here = np.zeros((3, width + 2), np.float32), np.zeros((3, width + 2), np.float32)
    beside = np.zeros((2, n + 2), np.float32)
    for lines in (above, here):
        lines[:, :, 0], lines[:, :, n + 1] = _FAR, _FAR
    beside[:, 0], beside[:, n + 1] = _FAR, _FAR
    for y in range(height):
        beside[0, 1 : n + 1] = np.float32(0.0)
        least = np.float32(0.0)
        for x in range(width):
            cost, into = costs[y, x], total[y, x]
            least = _extend(cost, beside[x % 2], least, p1, p2, beside[1 - x % 2], into)
            for k in range(3):
                before = x + k  # the pixels above: to the left, straight, to the right
                least_here[k, x + 1] = _extend(
                    cost, above[k, before], least_above[k, before], p1, p2, here[k, x + 1], into
                )
        above, here = here, above
        least_above, least_here = least_here, least_above


@compiled(error_model="numpy", fastmath={"nnan", "nsz"}, inline="always")
def _extend(
    cost: U8, before: F32, least_before: np.float32, p1: np.float32, p2: np.float32, here: F32, into: U16
) -> np.float32:
    """One pixel further: fill ``here``, add it to ``into``, and return its least value."""
    least, jump = _FAR, least_before + p2
    for k in range(len(cost)):
        way = min(min(before[k + 1], jump), min(before[k], before[k + 2]) + p1)
        value = np.float32(cost[k]) + way - least_before
        here[k + 1] = value
        into[k] += np.uint16(np.int32(value))
        least = min(least, value)
    return least


@compiled(error_model="numpy")
def _winners(total: U16, best: F32) -> None:
    height, width, n = total.shape
    for y in range(height):
        for x in range(width):
            sums = total[y, x]
            k = 0
            for j in range(1, n):
                if sums[j] < sums[k]:
                    k = j
            offset = np.float32(0.0)
            if 0 < k < n - 1:
                before, here, after = np.float32(sums[k - 1]), np.float32(sums[k]), np.float32(sums[k + 1])
                bend = before - np.float32(2.0) * here + after
                if bend > 0.0:
                    offset = np.float32(0.5) * (before - after) / bend
            best[y, x] = np.float32(k) + offset
