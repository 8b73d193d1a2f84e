"""The truth of channels that pair two pictures: where each pixel lies in the other one, and what became of it.

What is hidden is decided by rays, not by the other picture's depth map: that knows pixel centres only, so between
them, at every edge, it would have to guess.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rsbench.core.projection import ProjectionStatus, project_at, row_poses, rs_project, rs_project_near
from rsbench.core.se3 import inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channels import PairChannel, PixelClass
from rsbench.dataset.shots import FAR, Geometry, Shot, seen_by
from rsbench.renderers.segments import Surfaces

Blocked = Callable[[FloatArray, FloatArray], NDArray[np.bool_]]
"""Whether something stands before points (n, 3) seen from eyes (n, 3), world frame, metres."""
_BAND_ROWS = 8
"""Done at once: small enough for a core's cache."""
_TOLERANCE_PX = 1e-5
"""Residual of the row equation that needs no further step; stored values are rounded to 1e-3 px."""


class Rays(Protocol):
    """Rays through the scene of a sequence: ``renderers.segments.SceneRays`` is one."""

    def blocked(self, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]: ...
    def surfaces(self, eyes: FloatArray, points: FloatArray) -> Surfaces: ...


class PairTruth(NamedTuple):
    """Of the pixels of a source."""

    offset: FloatArray
    """(H, W, 2) x_target - x_source, px; NaN where the class is UNSOLVED or OUT_OF_VIEW."""
    classes: NDArray[np.uint8]
    """(H, W) of ``PixelClass``."""


class _Landed(NamedTuple):
    """Where points (n, 3) lie in a target."""

    pixels: FloatArray
    """(n, 2) px; NaN where it does not see them."""
    eyes: FloatArray
    """(n, 3) the camera's centre at that time, world frame; anything where it does not see them."""
    unsolved: NDArray[np.bool_]
    """(n,) whether it is not known if it sees them."""


def target_of(channel: PairChannel, source: Shot) -> Shot:
    """The picture in which a channel looks for the pixels of a rolling-shutter frame."""
    targets = {"disparity": source.other_side, "flow": source.other_frame, "gs_flow": source.other_shutter}
    return targets[channel]


def pair_truth(
    geometry: Geometry,
    source: Shot,
    target: Shot,
    depth: NDArray[np.float32],
    blocked: Blocked,
    rows: Sequence[int] | None = None,
) -> PairTruth:
    """Carry every pixel of a rolling-shutter frame into another picture.

    Args:
        geometry: of the sequence.
        source: the frame.
        target: the other picture.
        depth: (H, W) of the source, metres, 0 = sky, which is looked for at ``FAR``.
        blocked: see there; it is asked once.
        rows: these (H,) rows of the frame only, of which ``depth`` is; all by default.
    """
    shape, chosen = depth.shape, np.arange(geometry.shutter.height) if rows is None else np.asarray(rows)
    poses = row_poses(geometry.rig, geometry.shutter, geometry.motion, source.side, source.frame)
    find = _finder(geometry, source, target)
    grid = geometry.rig.camera.pixel_grid()[chosen]
    bands = []
    for first in range(0, len(chosen), _BAND_ROWS):
        band = slice(first, first + _BAND_ROWS)
        z = np.where(depth[band] > 0, depth[band], FAR)[..., None]
        x_in_cam = z * geometry.rig.camera.unproject(grid[band])
        X = (x_in_cam - poses.t[chosen[band], None]) @ poses.R[chosen[band]]
        bands.append((X.reshape(-1, 3), find(X, grid[band, :, 1])))
    X = np.concatenate([points for points, _ in bands])
    landed = _Landed(*(np.concatenate(each) for each in zip(*(found for _, found in bands), strict=True)))
    classes = _classes(X, landed, depth.ravel() == 0, blocked).reshape(shape)
    return PairTruth(landed.pixels.reshape(*shape, 2) - grid, classes)


def surface_truth(
    geometry: Geometry, source: Shot, depth: NDArray[np.float32], rays: Rays, rows: Sequence[int] | None = None
) -> Surfaces:
    """Normals (H, W, 3) and instances (H, W) of the pixels of a rolling-shutter frame; arguments as above."""
    chosen = np.arange(geometry.shutter.height) if rows is None else np.asarray(rows)
    poses = row_poses(geometry.rig, geometry.shutter, geometry.motion, source.side, source.frame)
    x_in_cam = depth[..., None] * geometry.rig.camera.unproject(geometry.rig.camera.pixel_grid()[chosen])
    points = (x_in_cam - poses.t[chosen, None]) @ poses.R[chosen]
    eyes = np.broadcast_to(inverse(poses).t[chosen, None], points.shape)
    solid = depth > 0
    normals, instances = np.zeros((*depth.shape, 3), dtype=np.float32), np.zeros(depth.shape, dtype=np.uint16)
    if np.any(solid):
        normals[solid], instances[solid] = rays.surfaces(eyes[solid], points[solid])
    return Surfaces(normals, instances)


def _classes(X: FloatArray, landed: _Landed, sky: NDArray[np.bool_], blocked: Blocked) -> NDArray[np.uint8]:
    """(n,) of ``PixelClass``."""
    inside = np.isfinite(landed.pixels[:, 0])
    hidden = np.zeros(len(X), dtype=np.bool_)
    hidden[inside] = blocked(landed.eyes[inside], X[inside])
    seen = np.where(
        sky,
        np.where(hidden, PixelClass.SKY_OCCLUDED, PixelClass.SKY),
        np.where(hidden, PixelClass.OCCLUDED, PixelClass.VISIBLE),
    )
    lost = np.where(landed.unsolved, PixelClass.UNSOLVED, PixelClass.OUT_OF_VIEW)
    return np.where(inside, seen, lost).astype(np.uint8)


Finder = Callable[[FloatArray, FloatArray], _Landed]
"""Of points (rows, W, 3) that rows (rows, W) of the source see."""


def _finder(geometry: Geometry, source: Shot, target: Shot) -> Finder:
    if target.shutter == "gs":
        return partial(_global, geometry, target)
    if target.frame == source.frame and geometry.rig.camera.lens is None:
        return partial(_beside, geometry, target)
    return partial(_rolling, _RowTable(geometry, target), target)


def _global(geometry: Geometry, target: Shot, X: FloatArray, rows: FloatArray) -> _Landed:
    seen = seen_by(geometry, target, X, rows)
    time = geometry.shutter.row_time(target.row, target.frame)
    eye = inverse(geometry.rig.cam_from_world(geometry.motion, time, target.side)).t
    return _landed(seen.pixels, np.broadcast_to(eye, X.shape), np.zeros(rows.shape, dtype=np.bool_))


def _beside(geometry: Geometry, target: Shot, X: FloatArray, rows: FloatArray) -> _Landed:
    """In the other camera, which sees a point with the same row at the same time."""
    time = geometry.shutter.row_time(rows[:, :1], target.frame)
    pose = geometry.rig.cam_from_world(geometry.motion, time, target.side)
    pixels = geometry.rig.camera.project(X @ np.swapaxes(pose.R[:, 0], -1, -2) + pose.t)
    pixels[~geometry.rig.camera.contains(pixels)] = np.nan
    return _landed(
        pixels, np.broadcast_to(inverse(pose).t, X.shape), np.abs(pixels[..., 1] - rows) > _TOLERANCE_PX
    )


def _landed(pixels: FloatArray, eyes: FloatArray, unsolved: NDArray[np.bool_]) -> _Landed:
    return _Landed(pixels.reshape(-1, 2), eyes.reshape(-1, 3), unsolved.ravel())


def _rolling(table: _RowTable, target: Shot, X: FloatArray, rows: FloatArray) -> _Landed:
    """One exact projection at a guess that is nearly always right; the rest is left to the solvers of ``core``."""
    rig, shutter, motion = table.geometry.rig, table.geometry.shutter, table.geometry.motion
    X = X.reshape(-1, 3)
    guess = table.guess(X, rows.ravel())
    pixels = project_at(rig, motion, target.side, shutter.row_time(guess, target.frame), X)[:, :2]
    pixels[~rig.camera.contains(pixels)] = np.nan
    unsolved = ~(np.abs(pixels[:, 1] - guess) <= _TOLERANCE_PX)
    for solve in (partial(rs_project_near, start_rows=guess[unsolved]), rs_project):
        if np.any(unsolved):
            found = solve(rig, shutter, motion, target.side, target.frame, X[unsolved])
            pixels[unsolved] = found.pixels
            unsolved[unsolved] = found.status == ProjectionStatus.NOT_CONVERGED
    return _Landed(pixels, table.eyes(pixels[:, 1]), unsolved)


class _RowTable:
    """The poses of all rows of a rolling-shutter frame, to look up between rows what need not be exact."""

    def __init__(self, geometry: Geometry, shot: Shot) -> None:
        self.geometry = geometry
        tau = geometry.shutter.row_time(np.arange(-1, geometry.shutter.height + 1), shot.frame)
        self._pose = geometry.rig.cam_from_world(geometry.motion, tau, shot.side)

    @cached_property
    def _cam_from_world(self) -> FloatArray:
        """(height + 2, 12), from row -1 on."""
        return np.concatenate([self._pose.R.reshape(-1, 9), self._pose.t], axis=1)

    @cached_property
    def _eyes(self) -> FloatArray:
        """(height + 2, 3) camera centres."""
        return inverse(self._pose).t

    def guess(self, X: FloatArray, rows: FloatArray) -> FloatArray:
        """Rows (n,) that see points (n, 3), about: a secant step from ``rows`` (n,)."""
        off = self._off(X, rows)
        nearer = rows + off
        left = self._off(X, nearer)
        with np.errstate(divide="ignore", invalid="ignore"):
            best = nearer - left * off / (left - off)
        return np.where(np.isfinite(best), best, rows)

    def _off(self, X: FloatArray, rows: FloatArray) -> FloatArray:
        """How far (n,) below its row each point is seen; NaN behind the camera."""
        pose = _between(self._cam_from_world, rows)
        x_in_cam = np.einsum("nij,nj->ni", pose[:, :9].reshape(-1, 3, 3), X) + pose[:, 9:]
        return np.asarray(self.geometry.rig.camera.project(x_in_cam)[:, 1] - rows)

    def eyes(self, rows: FloatArray) -> FloatArray:
        """Camera centres (n, 3) at rows (n,)."""
        return _between(self._eyes, rows)


def _between(table: FloatArray, rows: FloatArray) -> FloatArray:
    """Entries (n, k) of a table (height + 2, k) that starts at row -1, interpolated; any entry where NaN."""
    place = np.clip(np.nan_to_num(rows) + 1.0, 0.0, len(table) - 1.000001)
    below = place.astype(np.int64)
    first = table[below]
    return np.asarray(first + (place - below)[:, None] * (table[below + 1] - first))
