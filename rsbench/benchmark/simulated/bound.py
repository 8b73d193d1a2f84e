"""The Cramer-Rao bound of the motion from exact correspondences: the error of the best unbiased solver.

The unknown position of each point is eliminated from the derivatives of its rolling-shutter projections. These are
implicit functions, because a pixel that moves to another row is also read at another time.

One camera determines the length of d millions of times less well than the other parameters. The square of that
ratio in an information matrix would be below rounding. Therefore all computations use its root B, F = B^T B:
points are eliminated by orthogonal projections (Golub and Pereyra, SIAM J. Numer. Anal. 1973), and sums are QR
decompositions.

This module shares no code with the solvers.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np

from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.camera import inverse_2x2
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import match_pose, ray_depths
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import translation_of_offset
from rsbench.core.projection import back_project
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

Views = Literal["pairs", "three-view", "four-view"]
"""Use of the tracks: as unlinked left and right pairs; without the right image of frame 1; or complete."""
_STEP = 1e-3
_DIFFERENCES = (2 / 3, -1 / 12)
"""Weights of fourth-order central differences at 1 and 2 times ``_STEP`` (radians and metres), whose truncation
and rounding errors are 1e-13."""
_SINGULAR = 1e-11
"""Singular values below this share of the largest one count as 0. Undetermined directions have 1e-13; the least
determined ones observed had 1e-7."""
_OPEN = 3e-7
"""Singular values of a point below this share of its largest one count as 0; they belong to its position along a
ray without parallax."""
_FAR_M = 1e6


@dataclass(frozen=True, kw_only=True, eq=False)
class Bound:
    """Smallest root mean square errors of an unbiased solver; infinite if the data do not determine the value."""

    rotation_axes: FloatArray
    """Standard deviations (3,) of the rotation along its principal axes, radians, largest first."""
    direction_axes: FloatArray
    """Standard deviations (2,) of the direction of d, radians, largest first; meaningful only well below 1."""
    scale: float
    """Standard deviation of the length of d, relative to it."""
    root: FloatArray
    """(6, 6) root B of the Fisher information B^T B of (w, d)."""

    @property
    def information(self) -> FloatArray:
        """(6, 6) Fisher information of (w, d)."""
        return self.root.T @ self.root

    @property
    def rotation(self) -> float:
        """Root mean square of e_R, radians."""
        return float(np.linalg.norm(self.rotation_axes))

    @property
    def direction(self) -> float:
        """Root mean square of e_T, radians; meaningful only well below 1."""
        return float(np.linalg.norm(self.direction_axes))

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) covariance of (w, d); None if the data do not determine all of it."""
        scale = _scale(self.root)
        _, values, rows = np.linalg.svd(self.root / scale)
        if not values[-1] > _SINGULAR * values[0]:
            return None
        half = rows.T / scale[:, None] / values
        return half @ half.T


def motion_bound(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    noise_px: float,
    views: Views = "four-view",
) -> Bound:
    """Compute the bound for noise of ``noise_px`` on every coordinate, from exact (noise-free) correspondences.

    Args:
        correspondences: left and right pairs, and tracks; no match may be in two sets.
        motion: the true motion; its model and the model's own parameters count as known.
        views: the part of the tracks that a solver uses.
    """
    roots = []
    tracks = correspondences.tracks
    halves = {"left": tracks[:, [0, 1, 4, 5]], "right": tracks[:, [2, 3, 6, 7]]}
    for side in SIDES:
        matches = getattr(correspondences, side)
        if views == "pairs":
            matches = np.concatenate([matches, halves[side]])
        roots.append(_pair_root(matches, side, rig, shutter, motion))
    if views != "pairs":
        roots.append(_track_root(tracks, views, rig, shutter, motion))
    return bound_from_root(joined(*roots) / noise_px, motion.w, motion.d)


def bound_of_one_camera(
    matches: FloatArray, rig: StereoRig, shutter: RollingShutter, motion: Motion, noise_px: float
) -> Bound:
    """Compute the bound of the left camera's own motion from its exact matches (n, 4), as a rig of one camera with
    the same motion model.

    In a rig, its known position in the body would add information on the length, and less on the direction.
    """
    R, d = rig.own("left").R, translation_of_offset(motion.w, motion.d, rig.offset("left"))
    own = make_motion(motion.name, R @ motion.w, R @ d, motion.parameters)
    alone = StereoRig.of_one(rig.sensor("left"))
    return motion_bound(Correspondences(left=matches), alone, shutter, own, noise_px)


def joined(*roots: FloatArray) -> FloatArray:
    """Return the root (6, 6) of the sum of matrices with roots (n, 6): independent matches add information."""
    return np.asarray(np.linalg.qr(np.concatenate([np.zeros((6, 6)), *roots]), mode="r"))


def bound_from_root(root: FloatArray, w: FloatArray, d: FloatArray) -> Bound:
    """Compute the bound of (w, d), for any reference point, from the root (6, 6) of the Fisher information."""
    length = float(np.linalg.norm(d))
    J = so3.left_jacobian(w)
    rotation = _marginal_axes(root, J @ np.eye(6)[:3])
    if length == 0.0:
        return Bound(rotation_axes=rotation, direction_axes=np.full(2, np.inf), scale=np.inf, root=root)
    u = d / length
    along = np.concatenate([np.zeros(3), u])[None]
    across = np.hstack([np.zeros((2, 3)), np.linalg.svd(u[None])[2][1:]])
    return Bound(
        rotation_axes=rotation,
        direction_axes=_marginal_axes(root, across) / length,
        scale=float(_marginal_axes(root, along)[0]) / length,
        root=root,
    )


def _scale(root: FloatArray) -> FloatArray:
    """Return the lengths (6,) of the columns, as divisors; columns that are nearly 0 get the largest length."""
    lengths = np.linalg.norm(root, axis=0)
    most = float(np.max(lengths)) or 1.0
    return np.where(lengths > _SINGULAR * most, lengths, most)


def _marginal_axes(root: FloatArray, target: FloatArray) -> FloatArray:
    """Return the standard deviations (k,) of ``target @ (w, d)`` along its principal axes; infinite if the target
    is not orthogonal to the null space, so that the data do not determine it.

    Args:
        root: (6, 6) root of the information.
        target: (k, 6) linear functions.
    """
    scale = _scale(root)
    _, values, rows = np.linalg.svd(root / scale)
    weights = (target / scale) @ rows.T
    unknown = values <= _SINGULAR * max(float(values[0]), np.finfo(float).tiny)
    # Rounding adds small parts of the least determined directions to the null space.
    if np.any(np.abs(weights[:, unknown]) > 1e-3 * np.linalg.norm(weights)):
        return np.full(len(target), np.inf)
    known = ~unknown
    axes = np.linalg.svd(weights[:, known] / values[known], compute_uv=False)
    return np.concatenate([axes, np.zeros(len(target) - len(axes))], dtype=np.float64)


def _pair_root(
    matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter, motion: Motion
) -> FloatArray:
    if len(matches) == 0:
        return np.zeros((0, 6))
    pose, eye, axis = match_pose(rig, shutter, motion, side, matches), rig.eye(side), shutter.axis(side)
    x0, x1 = eye.unproject(matches[:, :2]), eye.unproject(matches[:, 2:])
    depth = ray_depths(pose, x0, x1)[:, 0]
    # Without parallax the depth is undetermined, and any depth gives the same information on the motion.
    depth = np.where(np.isfinite(depth) & (depth > 0.0), np.minimum(depth, _FAR_M), _FAR_M)
    depth = depth * rig.own_depth(side, matches[:, :2])
    points = back_project(rig, shutter, motion, side, 0, matches[:, :2], depth)
    ends: list[tuple[Side, int, FloatArray]] = [(side, k, matches[:, 2 * k + axis]) for k in FRAMES]
    return root_information(rig, shutter, motion, points, ends)


def _track_root(
    tracks: FloatArray, views: Views, rig: StereoRig, shutter: RollingShutter, motion: Motion
) -> FloatArray:
    if len(tracks) == 0:
        return np.zeros((0, 6))
    seen: list[tuple[Side, int, FloatArray]] = [
        (side, frame, tracks[:, 4 * frame + 2 * k + shutter.axis(side)])
        for frame in FRAMES
        for k, side in enumerate(SIDES)
    ]
    if rig.rectified and shutter.rows_together:
        disparity = np.maximum(tracks[:, 0] - tracks[:, 2], rig.camera.fx * rig.baseline / _FAR_M)
        points = back_project(rig, shutter, motion, "left", 0, tracks[:, :2], rig.depth(disparity))
    else:
        points = _triangulated(tracks, rig, shutter, motion)
    return root_information(rig, shutter, motion, points, seen if views == "four-view" else seen[:3])


def _triangulated(tracks: FloatArray, rig: StereoRig, shutter: RollingShutter, motion: Motion) -> FloatArray:
    """Return the points (n, 3) nearest to the four rays of exact tracks (n, 8), with camera poses at the times of
    the pixels."""
    A, b = np.zeros((len(tracks), 3, 3)), np.zeros((len(tracks), 3))
    for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
        pixels = tracks[:, 2 * k : 2 * k + 2]
        R, t = rig.eye_from_world(motion, shutter.pixel_time(pixels, frame, side), side)
        ray = rig.eye(side).unproject(pixels)
        across = np.eye(3) - ray[:, :, None] * ray[:, None] / np.sum(ray**2, axis=1)[:, None, None]
        M = np.swapaxes(R, 1, 2) @ across
        A, b = A + M @ R, b - (M @ t[:, :, None])[:, :, 0]
    return np.asarray(np.linalg.solve(A, b[:, :, None])[:, :, 0], dtype=np.float64)


def root_information(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    points: FloatArray,
    seen: list[tuple[Side, int, FloatArray]],
) -> FloatArray:
    """Return the root (m, 6) of the Fisher information of (w, d) for points (n, 3) of unknown position and a noise
    of 1 px.

    Args:
        seen: side, frame and the points' lines (n,) of each image; every image sees all points.
    """
    taus = [shutter.line_time(lines, frame, side) for side, frame, lines in seen]
    # Processes all images at once, because for few points the calls take longer than the arithmetic.
    everywhere = np.concatenate(taus), np.tile(points, (len(seen), 1))
    moved = np.split(np.stack([_derivative(motion, *everywhere, axis) for axis in np.eye(6)], axis=-1), len(seen))
    parts = [
        _projection_jacobian(rig, shutter, motion, points, side, tau, each)
        for (side, _, _), tau, each in zip(seen, taus, moved, strict=True)
    ]
    by_motion = np.concatenate([part[0] for part in parts], axis=1)
    by_point = np.concatenate([part[1] for part in parts], axis=1)
    axes, values, _ = np.linalg.svd(by_point, full_matrices=False)
    # Undetermined directions of a point lose no information.
    axes = axes * (values > _OPEN * values[:, :1])[:, None]
    # Project twice: the second projection removes the rounding errors of the first.
    for _ in range(2):
        by_motion = by_motion - axes @ (np.swapaxes(axes, 1, 2) @ by_motion)
    return by_motion.reshape(-1, 6)


def _projection_jacobian(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    points: FloatArray,
    side: Side,
    tau: FloatArray,
    moved: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (n, 2, 6) and (n, 2, 3) of the implicit projection by (w, d) and by the point.

    Args:
        tau: (n,) times at which the points are seen.
        moved: (n, 3, 6) derivatives of the points in the body at these times, by (w, d).
    """
    R, t = rig.eye_from_world(motion, tau, side)
    rotated = (R @ points[:, :, None])[:, :, 0]
    x = rotated + t
    w_rate, t_rate = motion.velocity(tau)
    velocity = so3.cross(w_rate, rotated) + t_rate
    camera, z = rig.camera, x[:, 2]
    if not (rig.rectified and shutter.plain):
        eye = rig.eye(side)
        P = np.stack([eye.velocity(x, np.broadcast_to(axis, x.shape)) for axis in np.eye(3)], axis=-1)
        follow = inverse_2x2(np.eye(2) - (P @ velocity[:, :, None]) * shutter.rate(side))
        return follow @ P @ moved, follow @ P @ R
    P = np.zeros((len(points), 2, 3))
    P[:, 0, 0], P[:, 0, 2] = camera.fx / z, -camera.fx * x[:, 0] / z**2
    P[:, 1, 1], P[:, 1, 2] = camera.fy / z, -camera.fy * x[:, 1] / z**2
    # A pixel moves by P dx + (P velocity) h dy, where dy is its own change of row: solve for dy, then insert it.
    drift = shutter.h * (P @ velocity[:, :, None])
    follow = np.eye(2) + drift * np.array([0.0, 1.0]) / (1.0 - drift[:, 1:])
    return follow @ P @ moved, follow @ P @ R


def _derivative(motion: Motion, tau: FloatArray, points: FloatArray, axis: FloatArray) -> FloatArray:
    """Return the derivative (n, 3) of points in the body at times (n,) by (w, d) along an axis (6,)."""

    def moved(step: float) -> FloatArray:
        w, d = motion.w + step * axis[:3], motion.d + step * axis[3:]
        end = motion.with_endpoint(w, d).body_from_world(tau)
        return (end.R @ points[:, :, None])[:, :, 0] + end.t

    steps = [(number * _STEP, factor) for number, factor in enumerate(_DIFFERENCES, start=1)]
    return sum((factor * (moved(step) - moved(-step)) for step, factor in steps), np.zeros(3)) / _STEP
