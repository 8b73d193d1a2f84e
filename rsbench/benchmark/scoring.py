"""The contract of metrics, scores of predictions against the ground truth, and the rule for failures.

A metric takes a prediction beside the truth and returns columns of a table; a card or an entry point names it.
It is a class below ``PoseMetric``, ``DepthMetric`` or ``ImageMetric``, which says what it reads. It scores
predictions only; what a failed prediction scores, its columns say and ``score`` applies.

Simulated trials, image sequences and the studies all use it. A failure is a prediction that says so, that is
not finite, or that is not there: it scores the worst value of everything, is counted, and is never replaced by "no
motion".
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


WORST_POSE = {"e_R_deg": 180.0, "e_T_deg": 180.0, "e_s": WORST_SCALE}
"""Scores of a failed motion, by the name of the error."""


def answered(w: ArrayLike, d: ArrayLike, success: ArrayLike = True) -> NDArray[np.bool_]:
    """Whether estimates (..., 3), (..., 3) are answers: marked as successful (...), finite, and with a ``w`` whose
    square does not overflow."""
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
    """Errors (...) of estimated motions, as docs/explanation/conventions.md defines them; all arguments broadcast.

    Args:
        w, d: (..., 3) estimated motion over one frame period, rad and m (or any length where not ``metric``).
        true_w, true_d: (..., 3) true motion of the body, rad and m.
        rig: rig whose left camera is meant by ``reference_point = "left"``.
        success: (...) whether the estimates are marked as successful; see ``answered``.
        metric: (...) whether the length of ``d`` is in metres.
        reference_point: ``body`` or ``left``, the point whose translation ``d`` is; the truth is moved there.

    Returns:
        ``e_R_deg`` and ``e_T_deg`` (degrees) and ``e_s``. A failure scores 180, 180 and infinity. NaN where an
        error does not exist for any method: e_T where the true translation is zero; and for an estimate that
        did not fail, e_s where that is so or no metres are claimed.

    Raises:
        ValueError: no such reference point.
    """
    if reference_point not in ("body", "left"):
        raise ValueError(f"reference_point = {reference_point!r}: must be 'body' or 'left'")
    if reference_point == "left":
        true_d = translation_of_offset(true_w, true_d, rig.offset("left"))
    good = answered(w, d, success)
    # Failures hold NaN, which no formula may meet: no warning, no NaN that would vanish from a median.
    w, d = (np.where(good[..., None], value, 0.0) for value in (w, d))
    exists = np.any(np.asarray(true_d) != 0.0, axis=-1)
    e_R = np.where(good, rotation_error(w, true_w), WORST_ANGLE)
    e_T = np.where(good | ~exists, translation_error(d, true_d), WORST_ANGLE)
    claimed = np.where(np.asarray(metric, dtype=np.bool_), scale_error(d, true_d), np.nan)
    e_s = np.where(good, claimed, WORST_SCALE)
    return dict(zip(WORST_POSE, (np.rad2deg(e_R), np.rad2deg(e_T), e_s), strict=True))


def motion_errors(motion: Motion | None, truth: Motion, rig: StereoRig) -> dict[str, float]:
    """e_R_deg and e_T_deg of an estimated motion of the body; None is a failure, which scores the worst values."""
    nothing = np.full(3, np.nan)
    w, d = (nothing, nothing) if motion is None else (motion.w, motion.d)
    errors = pose_errors(w, d, true_w=truth.w, true_d=truth.d, rig=rig)
    return {name: float(errors[name]) for name in ("e_R_deg", "e_T_deg")}


def score(metric: MetricEntry, case: Case | None) -> dict[str, float]:
    """The columns of a metric for a prediction, or what a failed one (None) scores in them.

    Raises:
        RsbenchError: another package's metric raised or answered something else: one line with its name.
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
