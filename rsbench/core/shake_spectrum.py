"""How a hand shakes, by its power spectrum: bands of frequencies, each of its own strength, around a steady path.

In each band every rotation and translation is a sum of sines, one in each of as many equal parts of the band, with
random frequencies and phases: a Gaussian process of that flat spectrum as their number grows (S. Rice,
Mathematical Analysis of Random Noise, 1944). A longer shake begins as a shorter one does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsbench.core import given, se3, so3
from rsbench.core.se3 import Pose, compose
from rsbench.core.so3 import FloatArray

_SINES = 8
"""Of a band, for each axis."""
_FASTEST = 0.25
"""Cycles of a band for each interval of the control poses, at most: a cubic spline through four points of a sine
differs from it by less than 3 % of its size."""
_MOST_BANDS = 32
_LARGEST_DEG, _LARGEST_M = 45.0, 1e3


@dataclass(frozen=True, eq=False)
class ShakeSpectrum:
    """A steady path and the bands of the shake around it."""

    path: FloatArray
    """(6,) of one frame period: rotation vector, radians, and translation, metres."""
    bands: FloatArray
    """(n, 4) from and to, cycles per frame period, and standard deviations about and along each axis, radians and
    metres."""

    @classmethod
    def of(cls, record: Any, interval: float) -> ShakeSpectrum:
        """From ``path``, degrees and metres, and ``bands`` with degrees and metres, as a card has them.

        Args:
            interval: frame periods between the control poses that are to carry it.

        Raises:
            ValueError: another key, no such numbers, or a band too fast for the interval.
        """
        if not isinstance(record, Mapping) or set(record) != {"path", "bands"}:
            raise ValueError("spectrum must be a table with path and bands, and no other key")
        path, bands = (given.real_array(f"spectrum.{key}", record[key]) for key in ("path", "bands"))
        if path.shape != (6,) or not np.all(np.abs(path) < [180.0] * 3 + [_LARGEST_M] * 3):
            raise ValueError("spectrum.path must be 6 finite numbers: degrees (3) and metres (3) per frame period")
        if bands.ndim != 2 or bands.shape[1] != 4 or not 1 <= len(bands) <= _MOST_BANDS:
            raise ValueError(f"spectrum.bands must be 1 to {_MOST_BANDS} rows of 4: from, to, degrees, metres")
        most = _FASTEST / interval
        for row in bands.tolist():
            low, high, turn, shift = row
            if not (0.0 <= low < high <= most and 0.0 <= turn <= _LARGEST_DEG and 0.0 <= shift <= _LARGEST_M):
                raise ValueError(
                    f"spectrum.bands: {row}: must rise from 0 or more to at most {most:g} cycles per frame period "
                    f"(0.25 / interval), with standard deviations from 0 to {_LARGEST_DEG:g} deg and "
                    f"{_LARGEST_M:g} m"
                )
        turned = np.concatenate([np.deg2rad(path[:3]), path[3:]])
        return cls(turned, bands * [1.0, 1.0, np.pi / 180.0, 1.0])

    def control(self, times: FloatArray, interval: float, rng: np.random.Generator) -> FloatArray:
        """Control poses (n, 6), rotation vectors and translations, at times (n,) one interval apart.

        The spline of them passes where the sines are at those times.
        """
        low, high, turn, shift = self.bands.T[..., None, None]
        part, phase = np.moveaxis(rng.random((len(self.bands), 6, _SINES, 2)), -1, 0)
        frequency = low + (high - low) * (np.arange(_SINES) + part) / _SINES
        sigma = np.concatenate(
            [np.broadcast_to(turn, (len(turn), 3, 1)), np.broadcast_to(shift, (len(turn), 3, 1))], 1
        )
        # A cubic B-spline of a sine's samples is smaller by this factor where its pieces meet.
        kept = (2.0 + np.cos(2.0 * np.pi * frequency * interval)) / 3.0
        size = sigma * np.sqrt(2.0 / _SINES) / kept
        waves = np.sin(2.0 * np.pi * (frequency * times[:, None, None, None] + phase))
        shake = np.sum(size * waves, axis=(1, 3))
        steady = se3.log(Pose(so3.exp(self.path[:3]), self.path[3:]))
        R, t = compose(se3.exp(shake), se3.exp(times[:, None] * steady))
        return np.concatenate([so3.log(R), t], axis=1)
