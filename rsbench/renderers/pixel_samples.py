"""Positions of the samples of a pixel, and their times within the exposure of its row.

A row collects light for a while about its row time. The exposure is cut into instants, midpoints of equal parts:
an exposed frame is the mean of the frames of its instants, up to the Monte Carlo error of seeing some in a pixel.
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
    """Offsets (samples, 2) from the pixel centre, in (-0.5, 0.5), px: the same in every pixel, never random.

    Cell (i, j) of a k x k grid holds one sample, shifted inside its cell by (j, i) / k of the cell: the canonical
    arrangement of multi-jittered sampling (Chiu, Shirley, Wang 1994; Kensler 2013) without the jitter. All x are
    distinct, and all y, so an upright edge has k*k grey levels, not k; feature positions depend on those.
    """
    k = math.isqrt(samples)
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(k), np.arange(k)))
    x = (i + (j + 0.5) / k) / k - 0.5
    y = (j + (i + 0.5) / k) / k - 0.5
    return np.stack([x, y], axis=-1).astype(np.float32)


def sky_points(samples: int, rays: int) -> NDArray[np.float32]:
    """Points (samples, rays, 3) on the unit sphere, evenly spread over all and over those of each sample.

    A Fibonacci lattice, whose heights go round the samples in steps of their golden section, so that no side of a
    pixel looks higher than another.
    """
    total = samples * rays
    height = 1.0 - (2.0 * np.arange(total) + 1.0) / total
    turn, level = _GOLDEN * np.arange(total), np.sqrt(1.0 - height**2)
    points = np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=-1).astype(np.float32)
    return points.reshape(rays, samples, 3).swapaxes(0, 1)[np.arange(samples) * golden_step(samples) % samples]


def facet_points(samples: int) -> NDArray[np.float32]:
    """Points (samples, 2) in the unit square, one for each sample of a pixel; of a single one the middle.

    Those of the sub-pixel grid, in another order: no side of a pixel has the facets of one side.
    """
    return subpixel_grid(samples)[np.arange(samples) * golden_step(samples) % samples] + np.float32(0.5)


def golden_step(count: int) -> int:
    """Coprime with ``count`` and near its golden section: neighbours are brought far apart."""
    golden = round(0.618 * count)
    return next(step for step in range(max(1, golden), 2 * count + 2) if math.gcd(step, count) == 1)


LEAST_INSTANTS = 64
"""A blur of 64 px is then drawn without gaps."""


def instant_count(samples: int) -> int:
    """Instants of an exposure that is seen by ``samples`` per pixel: a multiple of them, one part for each."""
    return samples * -(-LEAST_INSTANTS // samples)


def instant_times(tau: FloatArray, exposure: float, instants: int) -> FloatArray:
    """Times (instants, rows) of an exposure of length ``exposure`` about row times (rows); frame periods."""
    parts = (np.arange(instants) + 0.5) / instants - 0.5
    return tau + exposure * parts[:, None]


def instant_of(seed: Any, pixel: Any, sample: Any, samples: int, instants: int) -> Any:
    """Number of the instant that a sample of a pixel sees: a random one of its own part of the exposure.

    Which sample has which part changes from pixel to pixel, so that no corner of all pixels is seen first. All
    follow from (seed, pixel, sample) alone, as the random numbers of the path tracer do.
    """
    turn, salt = mi.sample_tea_32(seed, pixel)
    within, _ = mi.sample_tea_32(salt, sample)
    part = (sample * golden_step(samples) + turn % samples) % samples
    per_part = instants // samples
    return part * per_part + within % per_part
