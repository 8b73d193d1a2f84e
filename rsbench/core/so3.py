"""Rotations as matrices and rotation vectors; every function takes leading batch axes.

Small angles use Taylor series of the coefficient functions, so values and derivatives stay exact to rounding.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

_SMALL_ANGLE_SQUARED = 1e-4
"""Below 0.01 rad the Taylor series to theta^6 is exact to 1e-18, where closed forms lose digits."""


def hat(w: ArrayLike) -> FloatArray:
    """Skew matrix ``[w]x`` of shape (..., 3, 3), with ``[w]x @ x == cross(w, x)``, from (..., 3)."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def cross(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Cross product (..., 3), bitwise equal to ``np.cross``, which takes ten times as long for few vectors."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    out = np.zeros(a.shape if a.shape == b.shape else np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def _coefficients(theta2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 of the squared angle."""
    small = theta2 < _SMALL_ANGLE_SQUARED
    s = theta2
    series = (
        1 - s / 6 * (1 - s / 20 * (1 - s / 42)),
        0.5 - s / 24 * (1 - s / 30 * (1 - s / 56)),
        1 / 6 - s / 120 * (1 - s / 42 * (1 - s / 72)),
    )
    if np.all(small):
        return series
    t2 = np.where(small, 1.0, theta2)
    t = np.sqrt(t2)
    closed = np.sin(t) / t, 2 * np.sin(t / 2) ** 2 / t2, (t - np.sin(t)) / (t2 * t)
    a, b, c = (np.where(small, *each) for each in zip(series, closed, strict=True))
    return a, b, c


def exp(w: ArrayLike) -> FloatArray:
    """Rotation matrix (..., 3, 3) of the rotation vector ``w`` (..., 3), radians (Rodrigues)."""
    w = np.asarray(w, dtype=np.float64)
    a, b, _ = _coefficients(np.sum(w * w, axis=-1))
    W = hat(w)
    return np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W)


def _vee(R: FloatArray) -> FloatArray:
    """Vector (..., 3) whose ``hat`` is R - R^T, for R (..., 3, 3)."""
    return np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )


def log(R: ArrayLike) -> FloatArray:
    """Rotation vector (..., 3) in radians, norm in [0, pi], of the rotation matrix ``R`` (..., 3, 3)."""
    R = np.asarray(R, dtype=np.float64)
    vee = 0.5 * _vee(R)
    sine = np.linalg.norm(vee, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0))
    scale = np.where(sine > 1e-8, angle / np.where(sine > 1e-8, sine, 1.0), 1.0)
    near_pi = angle > np.pi - 0.1
    if not np.any(near_pi):
        return scale[..., None] * vee
    # sin(angle) vanishes at pi: near it the axis comes from the symmetric part (1 - cos) a a^T + cos I.
    cosine = np.where(near_pi, np.cos(angle), -1.0)[..., None, None]
    outer = (0.5 * (R + np.swapaxes(R, -1, -2)) - cosine * np.eye(3)) / (1.0 - cosine)
    column = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    axis = np.take_along_axis(outer, column[..., None, None], axis=-1)[..., 0]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-300)
    sign = np.where(np.sum(axis * vee, axis=-1) < 0.0, -1.0, 1.0)
    return np.where(near_pi[..., None], (sign * angle)[..., None] * axis, scale[..., None] * vee)


def left_jacobian(w: ArrayLike) -> FloatArray:
    """``J`` (..., 3, 3) with ``exp(w + dw) = exp(J dw) exp(w)`` to first order, and ``t(1) = J v`` of a twist."""
    w = np.asarray(w, dtype=np.float64)
    _, b, c = _coefficients(np.sum(w * w, axis=-1))
    W = hat(w)
    return np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W)


def angle(R: ArrayLike) -> FloatArray:
    """Rotation angle (...) in radians by atan2, exact down to 1e-15 where acos of the trace reads zero."""
    R = np.asarray(R, dtype=np.float64)
    return np.arctan2(np.linalg.norm(_vee(R), axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)


def quaternion(R: ArrayLike) -> FloatArray:
    """Unit quaternion (..., 4) as (w, x, y, z) with w >= 0, of the rotation matrix ``R`` (..., 3, 3)."""
    w = log(R)
    half = 0.5 * np.linalg.norm(w, axis=-1, keepdims=True)
    sinc = np.sinc(half / np.pi)
    return np.concatenate([np.cos(half), 0.5 * sinc * w], axis=-1)


def from_quaternion(q: ArrayLike) -> FloatArray:
    """Rotation matrix (..., 3, 3) of the quaternion (w, x, y, z) (..., 4); the norm of ``q`` does not matter."""
    given = np.asarray(q, dtype=np.float64)
    unit = given / np.linalg.norm(given, axis=-1, keepdims=True)
    W = hat(unit[..., 1:])
    return np.eye(3) + 2.0 * unit[..., :1, None] * W + 2.0 * (W @ W)
