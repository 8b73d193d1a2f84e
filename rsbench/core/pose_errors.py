"""Pose errors of the benchmark. Every one has a worst value, which a failed estimate scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.so3 import FloatArray

WORST_ANGLE = np.pi
WORST_SCALE = np.inf


def rotation_error(w_est: ArrayLike, w_gt: ArrayLike) -> FloatArray:
    """e_R in radians: angle of R_est R_gt^T over one frame period; rotation vectors (..., 3)."""
    R_est, R_gt = so3.exp(w_est), so3.exp(w_gt)
    return so3.angle(R_est @ np.swapaxes(R_gt, -1, -2))


def translation_error(d_est: ArrayLike, d_gt: ArrayLike) -> FloatArray:
    """e_T in radians, in [0, pi]: signed angle between translations (..., 3) of the same point of the rig.

    NaN when the true translation is zero (the direction does not exist); pi when only the estimate is zero.
    """
    d_est, d_gt = np.asarray(d_est, dtype=np.float64), np.asarray(d_gt, dtype=np.float64)
    sine = np.linalg.norm(so3.cross(d_est, d_gt), axis=-1)
    cosine = np.sum(d_est * d_gt, axis=-1)
    error = np.arctan2(sine, cosine)
    error = np.where(np.any(d_est != 0.0, axis=-1), error, WORST_ANGLE)
    return np.where(np.any(d_gt != 0.0, axis=-1), error, np.nan)


def scale_error(d_est: ArrayLike, d_gt: ArrayLike) -> FloatArray:
    """e_s = abs(log(norm(d_est) / norm(d_gt))); infinite when the estimate is zero, NaN when the truth is."""
    est = np.linalg.norm(np.asarray(d_est, dtype=np.float64), axis=-1)
    gt = np.linalg.norm(np.asarray(d_gt, dtype=np.float64), axis=-1)
    ratio = est / np.where(gt > 0.0, gt, 1.0)
    error = np.where(est > 0.0, np.abs(np.log(np.where(ratio > 0.0, ratio, 1.0))), WORST_SCALE)
    return np.where(gt > 0.0, error, np.nan)


def translation_of_offset(w: ArrayLike, d: ArrayLike, offset: ArrayLike) -> FloatArray:
    """Translation (..., 3) over one period of the camera at ``x_cam = x_body + offset``: d + offset - R offset.

    This is what a single camera's essential matrix holds, so the mono baseline is scored against it.
    """
    offset = np.asarray(offset, dtype=np.float64)
    return np.asarray(d, dtype=np.float64) + offset - so3.exp(w) @ offset
