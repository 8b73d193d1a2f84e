"""The points of a pixel's samples: evenly spread in each dimension and each pair, and others in each pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.renderers.backend import start_backend
from rsbench.renderers.integrators import lane_sampler, reversed_bits, sobol

SAMPLES, DIMENSIONS = 16, 6


@pytest.fixture(scope="module")
def points() -> Any:
    """(pixels, dimensions, samples, 2) of 50 pixels, and (pixels, samples) of the single dimension after them."""
    start_backend()
    import mitsuba as mi

    if "scalar" in mi.variant():
        pytest.skip("whole numbers of the scalar variant are its own test")
    pixel, sample = np.divmod(np.arange(50 * SAMPLES), SAMPLES)
    sampler = lane_sampler()
    sampler.seed_lanes(mi.UInt32(3), mi.UInt32(pixel), mi.UInt32(sample))
    pairs = np.stack([np.array(sampler.next_2d()).T for _ in range(DIMENSIONS)])
    return pairs.reshape(DIMENSIONS, 50, SAMPLES, 2).swapaxes(0, 1), np.array(sampler.next_1d()).reshape(
        50, SAMPLES
    )


def test_the_second_coordinate_is_sobols() -> None:
    """Against its direction numbers, by the recurrence of the primitive polynomial x + 1."""
    for index in [*range(40), 12345, 0xDEADBEEF]:
        expected, direction, rest = 0, 1 << 31, index
        while rest:
            expected ^= direction * (rest & 1)
            rest, direction = rest >> 1, direction ^ (direction >> 1)
        assert sobol(reversed_bits(index)) == expected
        assert reversed_bits(index) == int(f"{index:032b}"[::-1], 2)


def test_every_elementary_interval_of_a_pixel_has_its_point(points: Any) -> None:
    """A (0, 4, 2)-net: one point in each of 16 boxes of every shape; so the mean of a step is exact to a box."""
    pairs, single = points
    for wide in (1, 2, 4, 8, 16):
        boxes = np.floor(pairs * [wide, SAMPLES // wide]).astype(int)
        number = np.sort(boxes[..., 0] * (SAMPLES // wide) + boxes[..., 1], axis=-1)
        assert np.all(number == np.arange(SAMPLES))
    assert np.all(np.sort(np.floor(SAMPLES * single), axis=-1) == np.arange(SAMPLES))


def test_pixels_and_dimensions_have_points_of_their_own(points: Any) -> None:
    """Means over pixels and correlations between dimensions are those of independent draws, to five deviations."""
    pairs, _ = points
    flat = pairs.reshape(-1, SAMPLES, 2)
    assert len(np.unique(flat[:, 0], axis=0)) == len(flat)
    first = pairs[:, :, 0]  # of the first sample of each pixel: nothing spreads these
    assert np.all(np.abs(first.mean(axis=0) - 0.5) < 5.0 / np.sqrt(12 * 50))
    columns = first.reshape(50, -1)
    off = np.corrcoef(columns, rowvar=False) - np.eye(columns.shape[1])
    assert np.max(np.abs(off)) < 5.0 / np.sqrt(50)


def test_numbers_depend_on_pixel_and_sample_alone() -> None:
    """Of some lanes in another order, as of a row that is rendered by itself."""
    start_backend()
    import mitsuba as mi

    found = []
    for pixel, sample in (([5, 9, 5], [0, 3, 7]), ([9, 5], [3, 7])):
        sampler = lane_sampler()
        sampler.seed_lanes(mi.UInt32(1), mi.UInt32(pixel), mi.UInt32(sample))
        sampler.next_2d(), sampler.next_1d()
        found.append(np.array(sampler.next_2d()).T)
    np.testing.assert_array_equal(found[0][1:], found[1])
