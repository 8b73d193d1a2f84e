"""Epipolar geometry between two rows of one moving rolling-shutter camera.

Row ``y0`` of frame 0 and row ``y1`` of frame 1 of the same camera form an ordinary two-view pair with
R = R(tau1) R(tau0)^T and T = t(tau1) - R t(tau0) (paper, eq. 6, without its linearisation), so
``E = [T]x R`` and ``x1^T E x0 = 0``. The row times depend on the measured rows, which the exact Sampson error
takes into account.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, AlignedCamera, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, hat


def essential_matrix(pose: Pose) -> FloatArray:
    """Return E (..., 3, 3), with ``x1^T E x0 = 0``, for the pose ``cam1_from_cam0``."""
    return hat(pose.t) @ pose.R


def row_pair_pose(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, y0: ArrayLike, y1: ArrayLike
) -> Pose:
    """Return the pose from the camera at row ``y0`` of frame 0 to the camera at row ``y1`` of frame 1, batch
    (...).

    Poses here and below are in the body's axes, like the rays of ``rig.eye``.
    """
    return _pose_between(rig, motion, side, shutter.row_time(y0, 0), shutter.row_time(y1, 1))


def match_pose(rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, matches: FloatArray) -> Pose:
    """Return the relative poses between the times at which a camera reads the two ends of matches (n, 4)."""
    ends = (shutter.pixel_time(matches[:, 2 * frame : 2 * frame + 2], frame, side) for frame in FRAMES)
    return _pose_between(rig, motion, side, *ends)


def _pose_between(rig: StereoRig, motion: Motion, side: Side, tau0: FloatArray, tau1: FloatArray) -> Pose:
    R0, t0 = rig.eye_from_world(motion, tau0, side)
    R1, t1 = rig.eye_from_world(motion, tau1, side)
    R = R1 @ np.swapaxes(R0, -1, -2)
    return Pose(R, t1 - (R @ t0[..., None])[..., 0])


def epipolar_gradient(E: FloatArray, x0: FloatArray, x1: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Return the derivative (..., 4) of ``x1^T E x0`` by pixels (x0, y0, x1, y1); rays (..., 3) have z = 1."""
    line0 = (np.swapaxes(E, -1, -2) @ x1[..., None])[..., :2, 0]
    line1 = (E @ x0[..., None])[..., :2, 0]
    focal = np.array([camera.fx, camera.fy])
    return np.concatenate([line0 / focal, line1 / focal], axis=-1)


def rs_constraint(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, matches: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return ``x1^T E x0`` (n,) for matches (n, 4) x0, y0, x1, y1 and its total derivative (n, 4) by these pixels.

    Pixels are those of the distorted image. The derivative includes that a shifted pixel is read at another time.
    """
    eye = rig.eye(side)
    x0, x1 = eye.unproject(matches[:, :2]), eye.unproject(matches[:, 2:])
    tau0, tau1 = shutter.pixel_time(matches[:, :2], 0, side), shutter.pixel_time(matches[:, 2:], 1, side)
    R0, t0 = rig.eye_from_world(motion, tau0, side)
    R1, t1 = rig.eye_from_world(motion, tau1, side)
    R = R1 @ np.swapaxes(R0, -1, -2)
    Rt0 = _apply(R, t0)
    T, p = t1 - Rt0, _apply(R, x0)
    (w0, v0), (w1, v1) = motion.velocity(tau0), motion.velocity(tau1)
    value = np.einsum("...i,...i->...", x1, so3.cross(T, p))
    gradient = _by_pixels(epipolar_gradient(hat(T) @ R, x0, x1, rig.camera), eye, matches)
    # T = t1 - R t0 with dR/dtau1 = [w1]x R and dR/dtau0 = -R [w0]x.
    T_rate1, p_rate1 = v1 - so3.cross(w1, Rt0), so3.cross(w1, p)
    T_rate0, p_rate0 = _apply(R, so3.cross(w0, t0) - v0), -_apply(R, so3.cross(w0, x0))
    for columns, T_rate, p_rate in ((slice(0, 2), T_rate0, p_rate0), (slice(2, 4), T_rate1, p_rate1)):
        rate = so3.cross(T_rate, p) + so3.cross(T, p_rate)
        gradient[:, columns] += np.sum(x1 * rate, axis=-1)[:, None] * shutter.rate(side)
    return value, gradient


def _by_pixels(gradient: FloatArray, camera: PinholeCamera | AlignedCamera, matches: FloatArray) -> FloatArray:
    """Convert derivatives (n, ..., 4) by ideal pixels to derivatives by the pixels of matches (n, 4)."""
    if camera.is_ideal:
        return gradient
    L = [camera.ideal_by_pixel(matches[:, columns]) for columns in (slice(0, 2), slice(2, 4))]
    halves = zip(np.split(gradient, 2, axis=-1), L, strict=True)
    return np.concatenate([np.einsum("n...i,nij->n...j", half, each) for half, each in halves], axis=-1)


def rs_sampson_error(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, matches: FloatArray
) -> FloatArray:
    """Return the exact rolling-shutter Sampson error (n,), px, of matches (n, 4) x0, y0, x1, y1.

    It is the distance to the nearest exact match, to first order, with the sign of the constraint. It is zero if
    the gradient of the constraint vanishes. Hartley & Zisserman, 2nd ed., eq. 11.9.
    """
    value, gradient = rs_constraint(rig, shutter, motion, side, matches)
    norm = np.linalg.norm(gradient, axis=-1)
    return np.where(norm > 0.0, value / np.where(norm > 0.0, norm, 1.0), 0.0)


def _apply(R: FloatArray, x: FloatArray) -> FloatArray:
    return (R @ x[..., None])[..., 0]


def ray_depths(pose: Pose, x0: FloatArray, x1: FloatArray) -> FloatArray:
    """Return the depths (..., 2) along rays ``x0``, ``x1`` (..., 3) at which the two rays are closest.

    They are the least-squares solution of ``z1 x1 = z0 R x0 + T``, and NaN for parallel rays.
    """
    p = _apply(pose.R, x0)
    pp, yy, py = np.sum(p * p, axis=-1), np.sum(x1 * x1, axis=-1), np.sum(p * x1, axis=-1)
    pT, yT = np.sum(p * pose.t, axis=-1), np.sum(x1 * pose.t, axis=-1)
    determinant = pp * yy - py * py
    determinant = np.where(determinant > 1e-15 * pp * yy, determinant, np.nan)
    return np.stack([(py * yT - yy * pT) / determinant, (pp * yT - py * pT) / determinant], axis=-1)


def in_front(pose: Pose, x0: FloatArray, x1: FloatArray) -> np.ndarray:
    """Return whether both depths are positive (cheirality), (...) bool; False for parallel rays."""
    depths = ray_depths(pose, x0, x1)
    return np.all(np.where(np.isfinite(depths), depths, -1.0) > 0.0, axis=-1)
