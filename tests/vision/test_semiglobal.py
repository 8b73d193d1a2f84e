"""Semi-global aggregation against its definition, pixel by pixel."""

from __future__ import annotations

import numpy as np

from rsbench.vision.semiglobal import aggregated, winners


def _by_definition(costs: np.ndarray, p1: float, p2: float) -> np.ndarray:
    height, width, _ = costs.shape
    total = np.zeros(costs.shape)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        path = np.zeros(costs.shape)
        for y in range(height)[:: 1 if dy >= 0 else -1]:
            for x in range(width)[:: 1 if dx >= 0 else -1]:
                path[y, x] = costs[y, x]
                if 0 <= y - dy < height and 0 <= x - dx < width:
                    before = path[y - dy, x - dx]
                    beside = np.pad(before, 1, constant_values=np.inf)
                    steps = np.minimum(beside[:-2], beside[2:]) + p1
                    path[y, x] += np.minimum(np.minimum(before, before.min() + p2), steps) - before.min()
        total += path
    return total


def test_sums_are_those_of_the_definition() -> None:
    costs = np.random.default_rng(0).integers(0, 255, (7, 9, 6), dtype=np.uint8)
    np.testing.assert_array_equal(aggregated(costs, 10, 60), _by_definition(costs, 10, 60))
    # The largest sums that the penalties allow still fit.
    np.testing.assert_array_equal(aggregated(costs, 4000, 4000), _by_definition(costs, 4000, 4000))


def test_the_winner_is_the_minimum_of_a_parabola() -> None:
    at = np.array([[2.25, 3.5, 0.0, 6.0]])
    total = np.round(1000.0 + 100.0 * (np.arange(7) - at[..., None]) ** 2).astype(np.uint16)
    np.testing.assert_allclose(winners(total), at, atol=1e-6)
