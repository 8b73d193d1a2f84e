"""How well any unbiased solver can do: the Cramer-Rao bound of the motion, from exact correspondences.

Every point adds three unknowns, its position, which are eliminated (Schur complement) from the information of its
implicit rolling-shutter projections: a row that moves is also read at another time. Nothing here is shared with
the solvers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.epipolar import ray_depths, row_pair_pose
from rsbench.core.motion import Motion
from rsbench.core.projection import back_project
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

Views = Literal["pairs", "three-view", "four-view"]
"""Tracks as unlinked left and right pairs; without the right image of frame 1; as they are."""
_STEP = 1e-6
_SINGULAR = 1e-12
_FAR_M = 1e6


@dataclass(frozen=True, kw_only=True, eq=False)
class Bound:
    """Root mean square errors that no unbiased solver undercuts; infinite where the data say nothing."""

    rotation_axes: FloatArray
    """Of the rotation (3,) along its principal axes, radians, largest first."""
    direction_axes: FloatArray
    """Of the direction of d (2,), radians, largest first; meaningful while well below 1."""
    scale: float
    """Of the length of d, relative to it."""
    information: FloatArray
    """(6, 6) Fisher information of (w, d)."""

    @property
    def rotation(self) -> float:
        """Of e_R, radians."""
        return float(np.linalg.norm(self.rotation_axes))

    @property
    def direction(self) -> float:
        """Of e_T, radians; meaningful while well below 1."""
        return float(np.linalg.norm(self.direction_axes))

    @property
    def direction_observable(self) -> bool:
        """Whether the direction of d is known better than to half a radian."""
        return self.direction <= 0.5

    @property
    def scale_observable(self) -> bool:
        """Whether the length of d is known better than to half of it."""
        return self.scale <= 0.5

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) of (w, d); None where the data leave something open."""
        scale = _scale(self.information)
        values, vectors = np.linalg.eigh(self.information / np.outer(scale, scale))
        if not values[0] > _SINGULAR * values[-1]:
            return None
        half = vectors / scale[:, None] / np.sqrt(values)
        return half @ half.T


def motion_bound(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    noise_px: float,
    views: Views = "four-view",
) -> Bound:
    """Bound for exact (noise-free) correspondences that will get noise of ``noise_px`` on every coordinate.

    Args:
        correspondences: left and right pairs, and tracks; no match may be in two sets.
        motion: the true motion; its model and the model's own parameters count as known.
        views: what a solver sees of the tracks.
    """
    F = np.zeros((6, 6))
    tracks = correspondences.tracks
    halves = {"left": tracks[:, [0, 1, 4, 5]], "right": tracks[:, [2, 3, 6, 7]]}
    for side in SIDES:
        matches = getattr(correspondences, side)
        if views == "pairs":
            matches = np.concatenate([matches, halves[side]])
        F += _pair_information(matches, side, rig, shutter, motion)
    if views != "pairs":
        F += _track_information(tracks, views, rig, shutter, motion)
    return bound_from_information(F / noise_px**2, motion.w, motion.d)


def bound_from_information(F: FloatArray, w: FloatArray, d: FloatArray) -> Bound:
    """Bound of the motion (w, d), of any point of the rig, from its Fisher information (6, 6)."""
    length = float(np.linalg.norm(d))
    J = so3.left_jacobian(w)
    rotation = _marginal_axes(F, J @ np.eye(6)[:3])
    if length == 0.0:
        return Bound(rotation_axes=rotation, direction_axes=np.full(2, np.inf), scale=np.inf, information=F)
    u = d / length
    along = np.concatenate([np.zeros(3), u])[None]
    across = np.hstack([np.zeros((2, 3)), np.linalg.svd(u[None])[2][1:]])
    return Bound(
        rotation_axes=rotation,
        direction_axes=_marginal_axes(F, across) / length,
        scale=float(_marginal_axes(F, along)[0]) / length,
        information=F,
    )


def _scale(F: FloatArray) -> FloatArray:
    """Factors (6,) that give F a unit diagonal, but for entries that are zero up to rounding."""
    diagonal = np.diagonal(F)
    return np.sqrt(np.maximum(diagonal, max(_SINGULAR * float(np.max(diagonal)), 1e-300)))


def _marginal_axes(F: FloatArray, target: FloatArray) -> FloatArray:
    """Standard deviations (k,) of ``target @ (w, d)`` along its principal axes; infinite when it touches the null
    space.

    Args:
        F: (6, 6) information.
        target: (k, 6).
    """
    scale = _scale(F)
    values, vectors = np.linalg.eigh(F / np.outer(scale, scale))
    weights = (target / scale) @ vectors
    unknown = values <= _SINGULAR * max(values[-1], 1e-300)
    # Rounding mixes up to 1e-5 of the weakest known directions into the null space of a pure translation.
    if np.any(np.abs(weights[:, unknown]) > 1e-3 * np.linalg.norm(weights)):
        return np.full(len(target), np.inf)
    known = ~unknown
    axes = np.linalg.svd(weights[:, known] / np.sqrt(values[known]), compute_uv=False)
    return np.concatenate([axes, np.zeros(len(target) - len(axes))], dtype=np.float64)


def _pair_information(
    matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter, motion: Motion
) -> FloatArray:
    if len(matches) == 0:
        return np.zeros((6, 6))
    pose = row_pair_pose(rig, shutter, motion, side, matches[:, 1], matches[:, 3])
    x0, x1 = rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])
    depth = ray_depths(pose, x0, x1)[:, 0]
    # Without parallax the depth is open; any says the same about the motion.
    depth = np.where(np.isfinite(depth) & (depth > 0.0), np.minimum(depth, _FAR_M), _FAR_M)
    points = back_project(rig, shutter, motion, side, 0, matches[:, :2], depth)
    return information(rig, shutter, motion, points, [(side, 0, matches[:, 1]), (side, 1, matches[:, 3])])


def _track_information(
    tracks: FloatArray, views: Views, rig: StereoRig, shutter: RollingShutter, motion: Motion
) -> FloatArray:
    if len(tracks) == 0:
        return np.zeros((6, 6))
    disparity = np.maximum(tracks[:, 0] - tracks[:, 2], rig.camera.fx * rig.baseline / _FAR_M)
    points = back_project(rig, shutter, motion, "left", 0, tracks[:, :2], rig.depth(disparity))
    seen: list[tuple[Side, int, FloatArray]] = [
        ("left", 0, tracks[:, 1]),
        ("right", 0, tracks[:, 3]),
        ("left", 1, tracks[:, 5]),
    ]
    if views == "four-view":
        seen.append(("right", 1, tracks[:, 7]))
    return information(rig, shutter, motion, points, seen)


def information(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    points: FloatArray,
    seen: list[tuple[Side, int, FloatArray]],
) -> FloatArray:
    """Fisher information (6, 6) of (w, d) at a noise of 1 px, for points (n, 3) of unknown position.

    Args:
        seen: for each image that sees all the points, its side, frame and their rows (n,).
    """
    parts = [_projection_jacobian(rig, shutter, motion, points, *view) for view in seen]
    by_motion = np.concatenate([part[0] for part in parts], axis=1)
    by_point = np.concatenate([part[1] for part in parts], axis=1)
    cross = np.swapaxes(by_point, 1, 2) @ by_motion
    # Directions in which a point is open are no loss: the pseudo-inverse leaves them out.
    gram = np.linalg.pinv(np.swapaxes(by_point, 1, 2) @ by_point, rcond=1e-13, hermitian=True)
    F = np.swapaxes(by_motion, 1, 2) @ by_motion - np.swapaxes(cross, 1, 2) @ gram @ cross
    return np.sum(F, axis=0)


def _projection_jacobian(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    points: FloatArray,
    side: Side,
    frame: int,
    rows: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (n, 2, 6) and (n, 2, 3) of the implicit projection by (w, d) and by the point."""
    tau = shutter.row_time(rows, frame)
    R, t = rig.cam_from_world(motion, tau, side)
    rotated = (R @ points[:, :, None])[:, :, 0]
    x = rotated + t
    w_rate, t_rate = motion.velocity(tau)
    velocity = so3.cross(w_rate, rotated) + t_rate
    columns = []
    for k in range(6):
        shift = _STEP * np.eye(6)[k]
        ends = [
            motion.with_endpoint(motion.w + s * shift[:3], motion.d + s * shift[3:]).body_from_world(tau)
            for s in (1.0, -1.0)
        ]
        moved = [(end.R @ points[:, :, None])[:, :, 0] + end.t for end in ends]
        columns.append((moved[0] - moved[1]) / (2 * _STEP))
    camera, z = rig.camera, x[:, 2]
    P = np.zeros((len(points), 2, 3))
    P[:, 0, 0], P[:, 0, 2] = camera.fx / z, -camera.fx * x[:, 0] / z**2
    P[:, 1, 1], P[:, 1, 2] = camera.fy / z, -camera.fy * x[:, 1] / z**2
    # Pixels move by P dx + (P velocity) h dy with their own row's dy: solve for dy, then insert it.
    drift = shutter.h * (P @ velocity[:, :, None])
    follow = np.eye(2) + drift * np.array([0.0, 1.0]) / (1.0 - drift[:, 1:])
    return follow @ P @ np.stack(columns, axis=-1), follow @ P @ R
