"""The contract of metrics: a prediction beside the truth in, columns of a table out; found by card or entry point.

A metric is a class below ``PoseMetric``, ``DepthMetric`` or ``ImageMetric``: which one says what it reads. It
scores predictions only; what a failed prediction scores, its columns say and ``scoring.score`` applies.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from rsbench.components import plugins
from rsbench.components.plugins import Entry, Kind, RunOptions
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray


@final
@dataclass(frozen=True, kw_only=True)
class Column:
    """One number that a metric computes. Raises ValueError on a name or direction that cannot be."""

    name: str
    """Name in score files: letters, digits and _, such as ``e_R_deg``."""
    better: Literal["lower", "higher"]
    worst: float
    """What a failed prediction scores; may be infinite."""
    unit: str = ""
    """Such as ``deg``; empty for a number without one."""
    title: str = ""
    """Heading in tables for people; the name when empty."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z]\w*", self.name, flags=re.ASCII):
            raise ValueError(f"column name {self.name!r}: must be letters, digits and _, beginning with a letter")
        if self.better not in ("lower", "higher"):
            raise ValueError(f"column {self.name}: better = {self.better!r}: must be 'lower' or 'higher'")
        if np.isnan(self.worst):
            raise ValueError(f"column {self.name}: worst must be a number")

    @property
    def heading(self) -> str:
        """Title with the unit."""
        title = self.title or self.name
        return f"{title} ({self.unit})" if self.unit else title


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class PoseCase:
    """An estimated motion over one frame period beside the true one."""

    w: FloatArray
    """(3,) estimated rotation vector, rad."""
    d: FloatArray
    """(3,) estimated translation of the reference point, m or of any length."""
    metric: bool
    """Whether ``d`` is in metres."""
    reference_point: str
    """``body`` or ``left``: the point of the rig whose translation ``d`` is."""
    truth: Motion
    """True motion of the body."""
    rig: StereoRig
    shutter: RollingShutter


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class DepthCase:
    """An estimated depth map beside the true one."""

    depth: NDArray[np.float32]
    """(H, W) z in the row's own camera, m; 0 unknown."""
    truth: NDArray[np.float32]
    """(H, W) the same, exact; 0 where there is no surface."""
    pixels: NDArray[np.bool_]
    """(H, W) those that count."""
    rig: StereoRig


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class ImageCase:
    """A corrected frame beside the global-shutter image."""

    image: NDArray[np.uint8]
    """(H, W, 3) sRGB; black where nothing was drawn."""
    truth: NDArray[np.uint8]
    pixels: NDArray[np.bool_]
    """(H, W) those that count."""


Case = PoseCase | DepthCase | ImageCase


class Metric(ABC):
    """What all metrics share; derive from one of the three below."""

    case: type[Case]

    @property
    @abstractmethod
    def columns(self) -> tuple[Column, ...]:
        """What it computes; a class attribute where the parameters do not change it."""

    @abstractmethod
    def compute(self, case: Any) -> Mapping[str, float]:
        """A value for each column, by its name; NaN where the truth leaves nothing to score."""


class PoseMetric(Metric):
    """Scores a motion."""

    case = PoseCase

    @abstractmethod
    def compute(self, case: PoseCase) -> Mapping[str, float]: ...


class DepthMetric(Metric):
    """Scores a depth map."""

    case = DepthCase

    @abstractmethod
    def compute(self, case: DepthCase) -> Mapping[str, float]: ...


class ImageMetric(Metric):
    """Scores a corrected frame."""

    case = ImageCase

    @abstractmethod
    def compute(self, case: ImageCase) -> Mapping[str, float]: ...


MetricEntry = Entry[Metric, RunOptions]
METRICS: Kind[Metric, RunOptions] = Kind(
    singular="metric",
    cards="metrics",
    base=Metric,
    options=RunOptions,
)


def load_metrics(names_or_paths: Iterable[str | Path]) -> tuple[MetricEntry, ...]:
    """Metrics by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: no such metric; one whose class or columns are wrong; two with one column.
    """
    entries = tuple(plugins.load_entry(METRICS, name) for name in names_or_paths)
    owners: dict[tuple[type[Case], str], MetricEntry] = {}
    for entry in entries:
        if not isinstance(entry.component, PoseMetric | DepthMetric | ImageMetric):
            raise RsbenchError(f"metric {entry.name!r}: must be below PoseMetric, DepthMetric or ImageMetric")
        for column in _columns(entry):
            other = owners.setdefault((entry.component.case, column.name), entry)
            if other is not entry:
                raise RsbenchError(
                    f"metric {entry.name!r}: column {column.name!r} is one of metric {other.name!r} too; "
                    "rename it, or leave one of them out"
                )
    return entries


def _columns(entry: MetricEntry) -> tuple[Column, ...]:
    """Its columns, checked: they are read in this process."""
    try:
        columns = entry.component.columns
    except Exception as error:
        if entry.built_in:
            raise
        raise RsbenchError(f"metric {entry.name!r}: columns: raised {type(error).__name__}: {error}") from error
    if not isinstance(columns, tuple) or not columns or not all(isinstance(c, Column) for c in columns):
        raise RsbenchError(f"metric {entry.name!r}: columns = {columns!r}: must be a tuple of Column, not empty")
    return columns
