"""What stands in a file of predictions: the header, and what answers of all tracks have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.core.so3 import FloatArray
from rsbench.storage.untrusted_files import check_name

if TYPE_CHECKING:
    from rsbench.benchmark.leaderboard.track import Track

LARGEST = 1e9
"""Number of w and d: larger ones are no motions, and their squares overflow."""
LEAST_D = 1e-9
"""Length of ``d`` in metres or units of the method's own; a shorter one is no direction, but for zero."""
_TEXT_CHARACTERS = 300
Vector = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Header:
    """The first line: which split it is about, what the method is and what it uses."""

    protocol: str
    """Identifier of the track's protocol, as ``rsbench leaderboard template`` prints it."""
    split: str
    """Name of the split that was solved."""
    method: str
    """Name of the method on the board: letters, digits, dots, dashes and underscores."""
    uses: tuple[str, ...]
    """What the method takes of what its protocol allows."""
    version: str = ""
    """Version of the method."""
    description: str = ""
    """What the method does."""
    authors: str = ""
    """Who made the method."""
    paper: str = ""
    """Where the method is published."""
    code: str = ""
    """Where its code is."""
    licence: str = ""
    """Licence of the code."""
    hardware: str = ""
    """Machine on which the seconds were measured."""
    tuned_on: str = ""
    """Data by which its parameters were chosen."""
    motion_model: Literal["linear", "twist", "inertial", "accelerated", "spline", "none", "chosen"] = "linear"
    """Motion model that the method assumes between the rows: ``none`` of a global shutter, ``chosen`` where the
    matches of a problem decide."""
    png_unit_m: float | None = None
    """Metres of one step of depth maps that are PNG files, above 0 and at most 1."""

    def __post_init__(self) -> None:
        try:
            check_name(self.method)
        except ValueError as error:
            raise ValueError(str(error).replace("name =", "method =", 1)) from error
        if self.png_unit_m is not None and not 0.0 < self.png_unit_m <= 1.0:
            raise ValueError(f"png_unit_m = {self.png_unit_m}: must be above 0 and at most 1 m")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, str) and (len(value) > _TEXT_CHARACTERS or not value.isprintable()):
                raise ValueError(f"{field.name}: must be one line of at most {_TEXT_CHARACTERS} characters")

    def check_uses(self, track: Track, where: str) -> None:
        """Raises RsbenchError when the method uses what its track does not give."""
        try:
            track.check_uses(self.uses)
        except ValueError as error:
            raise RsbenchError(f"{where}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One motion or failure, as ``rsbench solve --json`` prints it."""

    name: str
    """Name of the problem."""
    success: bool = True
    """Whether the method found an answer; a failure counts as the worst score."""
    reason: str = ""
    """Why it failed."""
    w: Vector | None = None
    """Rotation vector of one frame period, radians."""
    d: Vector | None = None
    """Translation of one frame period; metres where ``metric`` is true."""
    metric: bool = False
    """Whether the length of ``d`` is in metres."""
    reference_point: Literal["body", "left"] = "body"
    """Point whose translation ``d`` is: the middle of the baseline or the left camera."""
    direction_known: bool = True
    """Whether the direction of ``d`` means anything."""
    readout_ratio: float | None = None
    """Estimated readout ratio, 0 to 1, where the track asks it instead of a motion."""
    readout_sigma: float | None = None
    """Standard deviation of ``readout_ratio``, where it is stated."""
    covariance: tuple[tuple[float, ...], ...] | None = None
    """6 x 6 covariance of ``w`` and ``d``, symmetric."""
    seconds: float | None = None
    """Seconds that the method took for the problem."""

    def __post_init__(self) -> None:
        ratio = self.readout_ratio
        for name in ("w", "d"):
            if np.any(np.abs(np.array(getattr(self, name) or (0.0, 0.0, 0.0))) > LARGEST):
                raise ValueError(f"{name}: numbers must lie within {LARGEST:g} of 0")
        if self.d is not None and any(self.d) and not LEAST_D <= math.hypot(*self.d) <= LARGEST:
            raise ValueError(
                f"d: has length {math.hypot(*self.d):g}: must be 0, or from {LEAST_D:g} to {LARGEST:g}; scale it"
            )
        if ratio is not None and not 0.0 <= ratio <= 1.0:
            raise ValueError(f"readout_ratio = {ratio}: must lie in [0, 1]: readout time / frame period")
        if self.readout_sigma is not None and not 0.0 <= self.readout_sigma <= 1.0:
            raise ValueError(f"readout_sigma = {self.readout_sigma}: must lie in [0, 1]")
        if self.seconds is not None and self.seconds < 0.0:
            raise ValueError(f"seconds = {self.seconds}: must not be negative")
        if self.covariance is not None and (
            len(self.covariance) != 6 or any(len(row) != 6 for row in self.covariance)
        ):
            raise ValueError("covariance: must be 6 x 6 numbers, of w and d")
        if self.covariance is not None and not _symmetric(np.array(self.covariance)):
            raise ValueError("covariance: must be symmetric: both halves of it are asked")


def _symmetric(covariance: FloatArray) -> bool:
    """To 0.001 of the standard deviations of row and column: rounded numbers are, a triangle alone is not."""
    sizes = np.sqrt(np.abs(np.diag(covariance)))
    with np.errstate(over="ignore"):
        return bool(np.all(np.abs(covariance - covariance.T) <= 1e-3 * np.outer(sizes, sizes)))
