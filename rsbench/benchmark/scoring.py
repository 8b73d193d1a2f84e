"""The contract of metrics, scores of predictions against the ground truth, and the rule for failures.

A metric compares a prediction with the ground truth and returns columns of a table; a card or an entry point names
it. It is a subclass of ``PoseMetric``, ``DepthMetric`` or ``ImageMetric``, which defines its input. A metric only
scores successful predictions: ``score`` gives a failed one the ``worst`` value of each column.

Simulated trials, image sequences and the studies all use these rules. A prediction is a failure if it is marked as
failed, not finite, or missing. A failure gets the worst value of every score and is counted; it is never replaced
by "no motion".
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.components import plugins
from rsbench.components.plugins import Entry, Kind, RunOptions
from rsbench.core.arguments import LARGEST
from rsbench.core.errors import RsbenchError, naming
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import (
    WORST_ANGLE,
    WORST_SCALE,
    rotation_error,
    scale_error,
    translation_error,
    translation_of_offset,
)
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray


@final
@dataclass(frozen=True, kw_only=True)
class Column:
    """A number that a metric computes. Raises ValueError if a name, a direction or a worst value is invalid."""

    name: str
    """Name in score files: letters, digits and _, such as ``e_R_deg``."""
    better: Literal["lower", "higher"]
    worst: float
    """Score of a failed prediction; may be infinite."""
    unit: str = ""
    """Unit, such as ``deg``; empty for a dimensionless number."""
    title: str = ""
    """Heading in printed tables; if empty, the name is used."""

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
    """An estimated motion over one frame period and the true motion."""

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
    """An estimated depth map and the true one."""

    depth: NDArray[np.float32]
    """(H, W) estimated z in the camera at the pose of the pixel's row, m; 0 where unknown."""
    truth: NDArray[np.float32]
    """(H, W) true z, m; 0 where there is no surface."""
    pixels: NDArray[np.bool_]
    """(H, W) mask of the pixels that are scored."""
    rig: StereoRig


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class ImageCase:
    """A corrected frame and the true global-shutter image."""

    image: NDArray[np.uint8]
    """(H, W, 3) sRGB; black where nothing was drawn."""
    truth: NDArray[np.uint8]
    pixels: NDArray[np.bool_]
    """(H, W) mask of the pixels that are scored."""


Case = PoseCase | DepthCase | ImageCase


class Metric(ABC):
    """Base class of all metrics; derive from one of the three subclasses below."""

    case: type[Case]

    @property
    @abstractmethod
    def columns(self) -> tuple[Column, ...]:
        """Columns that the metric computes; a class attribute if they do not depend on parameters."""

    @abstractmethod
    def compute(self, case: Any) -> Mapping[str, float]:
        """Return a value for each column, by its name; NaN if the ground truth has nothing to score."""


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
    """Load metrics by the name of a card or entry point, or by the path of a card.

    Raises:
        RsbenchError: a metric does not exist, has an invalid class or columns, or shares a column with another.
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
    """Return the checked columns of a metric, which are read in this process."""
    try:
        columns = entry.component.columns
    except Exception as error:
        if entry.built_in:
            raise
        raise RsbenchError(f"metric {entry.name!r}: columns: raised {type(error).__name__}: {error}") from error
    if not isinstance(columns, tuple) or not columns or not all(isinstance(c, Column) for c in columns):
        raise RsbenchError(f"metric {entry.name!r}: columns = {columns!r}: must be a tuple of Column, not empty")
    return columns


WORST_POSE = {"e_R_deg": 180.0, "e_T_deg": 180.0, "e_s": WORST_SCALE}
"""Scores of a failed motion, by the name of the error."""


def answered(w: ArrayLike, d: ArrayLike, success: ArrayLike = True) -> NDArray[np.bool_]:
    """Return whether estimates (..., 3), (..., 3) are valid: marked as successful (...), finite, and with a ``w``
    whose square does not overflow."""
    finite = np.all(np.abs(w) <= LARGEST, axis=-1) & np.all(np.isfinite(d), axis=-1)
    return np.asarray(success, dtype=np.bool_) & finite


def pose_errors(
    w: ArrayLike,
    d: ArrayLike,
    *,
    true_w: ArrayLike,
    true_d: ArrayLike,
    rig: StereoRig,
    success: ArrayLike = True,
    metric: ArrayLike = True,
    reference_point: str = "body",
) -> dict[str, FloatArray]:
    """Compute errors (...) of motions as defined in docs/explanation/conventions.md; all arguments broadcast.

    Args:
        w, d: (..., 3) estimated motion over one frame period, rad and m (or an unknown unit if not ``metric``).
        true_w, true_d: (..., 3) true motion of the body, rad and m.
        rig: rig that contains the left camera of ``reference_point = "left"``.
        success: (...) whether the estimates are marked as successful; see ``answered``.
        metric: (...) whether the length of ``d`` is in metres.
        reference_point: ``body`` or ``left``, the point whose translation is ``d``; the truth is converted to it.

    Returns:
        ``e_R_deg`` and ``e_T_deg`` (degrees) and ``e_s``. A failure scores 180, 180 and infinity. If the true
        translation is zero, e_T is NaN for every method, and e_s is NaN for a successful estimate; e_s is also
        NaN for a successful estimate that is not ``metric``.

    Raises:
        ValueError: the reference point is unknown.
    """
    if reference_point not in ("body", "left"):
        raise ValueError(f"reference_point = {reference_point!r}: must be 'body' or 'left'")
    if reference_point == "left":
        true_d = translation_of_offset(true_w, true_d, rig.offset("left"))
    good = answered(w, d, success)
    # Failures may contain NaN; zeros avoid warnings in the formulas, and NaN that medians would later ignore.
    w, d = (np.where(good[..., None], value, 0.0) for value in (w, d))
    exists = np.any(np.asarray(true_d) != 0.0, axis=-1)
    e_R = np.where(good, rotation_error(w, true_w), WORST_ANGLE)
    e_T = np.where(good | ~exists, translation_error(d, true_d), WORST_ANGLE)
    claimed = np.where(np.asarray(metric, dtype=np.bool_), scale_error(d, true_d), np.nan)
    e_s = np.where(good, claimed, WORST_SCALE)
    return dict(zip(WORST_POSE, (np.rad2deg(e_R), np.rad2deg(e_T), e_s), strict=True))


def motion_errors(motion: Motion | None, truth: Motion, rig: StereoRig) -> dict[str, float]:
    """Return e_R_deg and e_T_deg of an estimated motion of the body; None, a failure, gets the worst scores."""
    nothing = np.full(3, np.nan)
    w, d = (nothing, nothing) if motion is None else (motion.w, motion.d)
    errors = pose_errors(w, d, true_w=truth.w, true_d=truth.d, rig=rig)
    return {name: float(errors[name]) for name in ("e_R_deg", "e_T_deg")}


def score(metric: MetricEntry, case: Case | None) -> dict[str, float]:
    """Return the columns of a metric for a prediction; a failed prediction (None) gets the worst values.

    Raises:
        RsbenchError: another package's metric raised an exception or returned invalid values; names the metric.
    """
    columns = metric.component.columns
    if case is None:
        return {column.name: column.worst for column in columns}
    with plugins.blame(METRICS, metric):
        found = metric.component.compute(case)
    names = [column.name for column in columns]
    if not isinstance(found, Mapping) or sorted(map(str, found)) != sorted(names):
        raise RsbenchError(f"metric {metric.name!r}: must return a value for each of {', '.join(names)}")
    with naming(f"metric {metric.name!r}: must return numbers", TypeError, ValueError):
        return {name: float(found[name]) for name in names}
