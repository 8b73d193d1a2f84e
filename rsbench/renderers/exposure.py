"""Sample times of a pixel within the exposure of its row.

A row collects light for a while about its row time. The while is cut into instants, midpoints of equal parts: an
exposed frame is the mean of the frames of its instants, up to the Monte Carlo error of seeing some in a pixel.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rsbench.core.so3 import FloatArray
from rsbench.renderers.pixel_samples import golden_step

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
    import mitsuba as mi

    turn, salt = mi.sample_tea_32(seed, pixel)
    within, _ = mi.sample_tea_32(salt, sample)
    part = (sample * golden_step(samples) + turn % samples) % samples
    per_part = instants // samples
    return part * per_part + within % per_part
