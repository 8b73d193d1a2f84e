"""Pose errors of the benchmark. Every one has a worst value, which a failed estimate scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

    It does not depend on the lengths, however small or large they are. NaN when the true translation is zero (the
    direction does not exist); pi when only the estimate is zero.
    """
    (d_est, _), (d_gt, _) = _scaled(d_est), _scaled(d_gt)
    sine = np.linalg.norm(so3.cross(d_est, d_gt), axis=-1)
    cosine = np.sum(d_est * d_gt, axis=-1)
    error = np.arctan2(sine, cosine)
    error = np.where(np.any(d_est != 0.0, axis=-1), error, WORST_ANGLE)
    return np.where(np.any(d_gt != 0.0, axis=-1), error, np.nan)


def scale_error(d_est: ArrayLike, d_gt: ArrayLike) -> FloatArray:
    """e_s = abs(log(norm(d_est) / norm(d_gt))); infinite if the estimate is zero, NaN if the truth is zero."""
    (d_est, power_est), (d_gt, power_gt) = _scaled(d_est), _scaled(d_gt)
    est, gt = np.linalg.norm(d_est, axis=-1), np.linalg.norm(d_gt, axis=-1)
    ratio, power = est / np.where(gt > 0.0, gt, 1.0), power_est - power_gt
    # The part of the power of two that no float holds is added to the logarithm; it is 0 but for extreme lengths.
    near = np.clip(power, -1000, 1000)
    logarithm = np.log(np.ldexp(np.where(ratio > 0.0, ratio, 1.0), near)) + (power - near) * np.log(2.0)
    error = np.where(est > 0.0, np.abs(logarithm), WORST_SCALE)
    return np.where(gt > 0.0, error, np.nan)


def _scaled(d: ArrayLike) -> tuple[FloatArray, NDArray[np.int64]]:
    """Divide vectors (..., 3) by powers of two, so that their largest component is in [0.5, 1); return the
    exponents.

    Products of the scaled vectors neither overflow nor underflow, and scaling adds no rounding errors. A zero
    vector is unchanged.
    """
    d = np.asarray(d, dtype=np.float64)
    _, power = np.frexp(np.max(np.abs(d), axis=-1, initial=0.0))
    half = power // 2  # in two steps, for 2**1074 itself overflows
    return np.ldexp(np.ldexp(d, -half[..., None]), (half - power)[..., None]), np.asarray(power, dtype=np.int64)


def translation_of_offset(w: ArrayLike, d: ArrayLike, offset: ArrayLike) -> FloatArray:
    """Return the translation (..., 3) over one period of a camera at ``x_cam = x_body + offset``: d + offset - R
    offset.

    A single camera's essential matrix depends on this translation, so solvers of one camera are scored against it.
    """
    offset = np.asarray(offset, dtype=np.float64)
    return np.asarray(d, dtype=np.float64) + offset - so3.exp(w) @ offset
