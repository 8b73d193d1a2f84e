"""Positions of the samples of a pixel, and their times within the exposure of its row.

A row is exposed for a time interval centred on its row time. The interval is sampled at instants, the midpoints of
equal parts. An exposed frame is the mean of the frames at its instants, up to a Monte Carlo error, because each
pixel samples only some of them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray
from rsbench.renderers.mitsuba_modules import mi

_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


def subpixel_grid(samples: int) -> NDArray[np.float32]:
    """Return offsets (samples, 2) from the pixel centre, in (-0.5, 0.5), px: the same in every pixel, not random.

    Cell (i, j) of a k x k grid holds one sample, shifted inside its cell by (j, i) / k of the cell: the canonical
    arrangement of multi-jittered sampling (Chiu, Shirley, Wang 1994; Kensler 2013) without the jitter. All x are
    distinct, and all y, so a vertical edge has k*k grey levels, not k, which improves the positions of features.
    """
    k = math.isqrt(samples)
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(k), np.arange(k)))
    x = (i + (j + 0.5) / k) / k - 0.5
    y = (j + (i + 0.5) / k) / k - 0.5
    return np.stack([x, y], axis=-1).astype(np.float32)


def sky_points(samples: int, rays: int) -> NDArray[np.float32]:
    """Return points (samples, rays, 3) on the unit sphere, evenly spread in total and within each sample.

    The points form a Fibonacci lattice. Its heights are assigned to the samples in steps of the golden section, so
    that no side of a pixel has higher points than another.
    """
    total = samples * rays
    height = 1.0 - (2.0 * np.arange(total) + 1.0) / total
    turn, level = _GOLDEN * np.arange(total), np.sqrt(1.0 - height**2)
    points = np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=-1).astype(np.float32)
    return points.reshape(rays, samples, 3).swapaxes(0, 1)[np.arange(samples) * golden_step(samples) % samples]


def facet_points(samples: int) -> NDArray[np.float32]:
    """Return points (samples, 2) in the unit square, one for each sample of a pixel; the centre for one sample.

    They are the points of the sub-pixel grid in another order, so that they do not correlate with positions in the
    pixel.
    """
    return subpixel_grid(samples)[np.arange(samples) * golden_step(samples) % samples] + np.float32(0.5)


def golden_step(count: int) -> int:
    """Return a step coprime with ``count`` near its golden section, which moves neighbours far apart."""
    golden = round(0.618 * count)
    return next(step for step in range(max(1, golden), 2 * count + 2) if math.gcd(step, count) == 1)


LEAST_INSTANTS = 64
"""Least number of instants: a blur of 64 px then has no gaps."""


def instant_count(samples: int) -> int:
    """Return the number of instants of an exposure for ``samples`` per pixel: a multiple of ``samples``."""
    return samples * -(-LEAST_INSTANTS // samples)


def instant_times(tau: FloatArray, exposure: float, instants: int) -> FloatArray:
    """Return times (instants, rows) of an exposure of length ``exposure`` around row times, in frame periods."""
    parts = (np.arange(instants) + 0.5) / instants - 0.5
    return tau + exposure * parts[:, None]


def instant_of(seed: Any, pixel: Any, sample: Any, samples: int, instants: int) -> Any:
    """Return the instant of a sample of a pixel: a random one in the sample's part of the exposure.

    The assignment of parts to samples varies between pixels, so that time does not correlate with the position in
    the pixel. The result depends only on (seed, pixel, sample), like the random numbers of the path tracer.
    """
    turn, salt = mi.sample_tea_32(seed, pixel)
    within, _ = mi.sample_tea_32(salt, sample)
    part = (sample * golden_step(samples) + turn % samples) % samples
    per_part = instants // samples
    return part * per_part + within % per_part
