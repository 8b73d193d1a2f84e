"""Scores of predictions against the ground truth, and the rule for failures.

Simulated trials, image sequences and the studies all use it. A failure is a prediction that says so, that is
not finite, or that is not there: it scores the worst value of everything, is counted, and is never replaced by "no
motion".
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.benchmark.metric_plugins import METRICS, Case, MetricEntry
from rsbench.components import plugins
from rsbench.core.arguments import LARGEST
from rsbench.core.errors import RsbenchError
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
from rsbench.core.so3 import FloatArray

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
        error does not exist, for nobody then: e_T where the true translation is zero; and for an estimate that
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
    try:
        return {name: float(found[name]) for name in names}
    except (TypeError, ValueError) as error:
        raise RsbenchError(f"metric {metric.name!r}: must return numbers: {error}") from error
