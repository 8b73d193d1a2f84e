"""Covariances of poses of a spline, from that of its control poses in a band."""

from __future__ import annotations

import numpy as np

from rsbench.capture.trajectory_poses import Views, blank_views, fill_views
from rsbench.capture.trajectory_spline import Curve, evaluate
from rsbench.core import so3
from rsbench.core.so3 import FloatArray


def pose_covariance(curve: Curve, inverse: FloatArray, taus: FloatArray) -> FloatArray:
    """Covariance (n, 6, 6) of poses at times (n,): turns of the body, radians, and its positions, metres.

    Args:
        inverse: of the normal matrix, in its band.
    """
    views, by = _derivatives(curve, taus)
    return np.asarray(by @ _block(inverse, views, views) @ np.swapaxes(by, 1, 2))


def covariance_between(curve: Curve, inverse: FloatArray, start: float, taus: FloatArray) -> FloatArray:
    """Covariance (n, 6, 6) of poses at times (n,), seen from the pose at another one.

    Raises:
        ValueError: a time so far away that the band does not hold what both have in common.
    """
    one, by_one = _derivatives(curve, np.full(len(taus), start))
    other, by = _derivatives(curve, taus)
    if 6 * (np.max(np.abs(other.index - one.index), initial=0) + 4) > inverse.shape[1]:
        raise ValueError(f"times that far from {start:g} have covariances of their own only")
    # R' = R R_s^T turns by dR - R' dR_s; q = R_s (p - p_s) moves by R_s (dp - dp_s) + dR_s x q.
    R, R_s = other.R, one.R
    relative = R @ np.swapaxes(R_s, 1, 2)
    q = (R_s @ (other.p - one.p)[..., None])[..., 0]
    A, B = np.zeros((len(taus), 6, 6)), np.zeros((len(taus), 6, 6))
    A[:, :3, :3], A[:, 3:, 3:] = np.eye(3), R_s
    B[:, :3, :3], B[:, 3:, :3], B[:, 3:, 3:] = -relative, -so3.hat(q), -R_s
    by, by_one = A @ by, B @ by_one
    cross = by @ _block(inverse, other, one) @ np.swapaxes(by_one, 1, 2)
    own = by @ _block(inverse, other, other) @ np.swapaxes(by, 1, 2)
    first = by_one @ _block(inverse, one, one) @ np.swapaxes(by_one, 1, 2)
    return np.asarray(own + first + cross + np.swapaxes(cross, 1, 2))


def _derivatives(curve: Curve, taus: FloatArray) -> tuple[Views, FloatArray]:
    """Poses at times (n,) and their derivatives (n, 6, 24) by the control poses that they feel."""
    taus = np.clip(np.asarray(taus, dtype=np.float64), curve.first, curve.last)
    views = blank_views(len(taus))
    fill_views(curve, taus, views)
    by = np.zeros((len(taus), 6, 4, 6))
    by[:, :3, :, :3] = np.swapaxes(views.turn, 1, 2)
    by[:, 3:, :, 3:] = views.share[:, None, :, None] * np.eye(3)[:, None, :]
    return views, by.reshape(len(taus), 6, 24)


def _block(inverse: FloatArray, a: Views, b: Views) -> FloatArray:
    """Covariances (n, 24, 24) of the control poses that times feel."""
    rows, columns = (6 * views.index[:, None] + np.arange(24) for views in (a, b))
    low = np.minimum(rows[:, :, None], columns[:, None])
    high = np.maximum(rows[:, :, None], columns[:, None])
    return inverse[low, high - low]


def motion_covariance(curve: Curve, inverse: FloatArray, start: float) -> FloatArray | None:
    """Covariance (6, 6) of w and d, of the motion over a period, seen from the body at its start."""
    (here, there), _, _ = evaluate(curve, np.array([start, start + 1.0]))
    R = here[1] @ here[0].T
    t = there[1] - R @ there[0]
    # w moves by J^-1 of a turn of the body about its own axes, and t = -R p by that turn and by p.
    by = np.zeros((6, 6))
    by[:3, :3] = np.linalg.inv(so3.left_jacobian(so3.log(R)))
    by[3:, :3], by[3:, 3:] = -so3.hat(t), -R
    try:
        between = covariance_between(curve, inverse, start, np.array([start + 1.0]))[0]
    except ValueError:  # the band is too narrow
        return None
    return np.asarray(by @ between @ by.T)
