"""A still scene as a few planes, and which of them each pixel of two frames of one moving camera shows.

A plane is n (3,) with n . X = 1 for its points X in the world, the frame of the camera before it moves; 0 is the
plane at infinity. In the camera of a line with pose R, t and centre c it is ``R n / (1 - n . c)``, whose product
with a ray (u, v, 1) is the inverse depth there: so each pixel of a layer moves by the homography of its two lines.

A pixel shows the layer at which the other frame looks most like it, as smoothly as costs allow. Layers hide each
other: where the other frame shows a nearer one in the place of a pixel, its likeness there says nothing, and the
layer costs what an unseen pixel costs. Which pixels are hidden is known from the layers of both frames, so they
are found in rounds.

After Vasu, Mohan M. R., Rajagopalan, "Occlusion-aware rolling shutter rectification of 3D scenes", CVPR 2018, of
which the abstract alone was read: the equations are ours. Smoothness is ``semiglobal`` in place of graph cuts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_ranges
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import FRAMES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.matching_cost import Comparer
from rsbench.vision.reprojection import F32, reproject_pixels, reprojection_of
from rsbench.vision.resample import resample
from rsbench.vision.semiglobal import aggregated
from rsbench.vision.stereo_depth import known_beside

Labels = NDArray[np.int64]
_RANGES = {
    "window": (3, 51),
    "full_levels": (0.1, 255.0),
    "p1": (0, 4000),
    "p2": (0, 4000),
    "unseen": (0.0, 1.0),
    "rounds": (0, 20),
}


@dataclass(frozen=True, kw_only=True)
class LabelOptions:
    """How pixels are given to layers."""

    window: int = 5
    """Side, px, of the window in which frames are compared."""
    full_levels: float = 30.0
    """Grey levels of 256; pixels that differ by more are as unlike as can be."""
    p1: int = 24
    """What a step to the next layer costs, of 255, which the worst likeness costs."""
    p2: int = 96
    """What a step to any other layer costs."""
    unseen: float = 0.2
    """What a pixel that the other frame does not see costs, 0 to 1, the worst likeness."""
    rounds: int = 2
    """Times that hidden pixels are told by the layers of both frames."""

    def __post_init__(self) -> None:
        if self.window % 2 == 0:
            raise ValueError(f"window = {self.window}: must be odd")
        if self.p1 > self.p2:
            raise ValueError(f"p1 = {self.p1}: must not exceed p2, {self.p2}")
        check_ranges(self, _RANGES)


class MovingCamera(NamedTuple):
    """One camera of a rig and its motion."""

    rig: StereoRig
    """Its body is where the camera is."""
    shutter: RollingShutter
    side: Side
    motion: Motion

    @property
    def parallax_px(self) -> float:
        """px that a point of inverse depth 1, in the unit of the motion, moves in a frame period, about."""
        return self.rig.camera.fx * float(np.linalg.norm(self.motion.d))

    def row_poses(self, frame: int) -> Pose:
        """``cam_from_world`` (lines, 3, 3), (lines, 3)."""
        return row_poses(self.rig, self.shutter, self.motion, self.side, frame)

    def inverse_depths(self, planes: FloatArray, frame: int) -> F32:
        """Of planes (n, 3) at the pixels of a frame (n, H, W), in the row's own camera; NaN behind it."""
        seen = planes_seen(planes, self.row_poses(frame))  # (H, n, 3)
        rays = self.rig.camera.unproject(self.rig.camera.pixel_grid())
        rho = np.einsum("hnk,hwk->nhw", seen, rays)
        return np.where(rho >= 0.0, rho, np.nan).astype(np.float32)


def planes_seen(planes: FloatArray, pose: Pose) -> FloatArray:
    """Planes (n, 3) of the world in cameras of poses (..., 3, 3), (..., 3): (..., n, 3); NaN where passed."""
    turned = planes @ np.swapaxes(pose.R, -1, -2)
    # c = -R^T t, so 1 - n . c = 1 + (R n) . t
    ahead = 1.0 + np.einsum("...nk,...k->...n", turned, pose.t)
    return turned / np.where(ahead > 0.0, ahead, np.nan)[..., None]


class Labelled(NamedTuple):
    """Which layer each pixel shows."""

    labels: tuple[Labels, Labels]
    """(H, W) number of the plane, of frames 0 and 1."""
    seen: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    """(H, W) whether the other frame sees the pixel too."""
    places: F32
    """(H, W, 2) px in frame 1 that show the pixels of frame 0; NaN where it does not see them."""
    cost: float
    """Mean unlikeness of all pixels, 0 to 1, without the smoothness."""


def label_pixels(
    greys: tuple[F32, F32], camera: MovingCamera, planes: FloatArray, options: LabelOptions, step_px: float
) -> Labelled:
    """Layers of the pixels of two grey frames (H, W) among ``planes`` (n, 3), ordered from far to near.

    ``step_px`` is the parallax, px, by which a layer must be nearer to hide another one.
    """
    pair = _Pair(greys, camera, planes, options, step_px)
    labels = pair.smoothed(pair.costs)
    costs = pair.costs
    for _ in range(options.rounds):
        costs = pair.hidden(labels)
        labels = pair.smoothed(costs)
    chosen = [np.take_along_axis(costs[f], labels[f][None], axis=0)[0] for f in FRAMES]
    cost = float(np.mean(np.nan_to_num(np.stack(chosen), nan=options.unseen)))
    seen = np.isfinite(chosen[0]), np.isfinite(chosen[1])
    first, second = (_behind(labels[f], seen[f], pair.across(f)) for f in FRAMES)
    return Labelled((first, second), seen, np.where(seen[0][..., None], pair.places(labels[0]), np.nan), cost)


def _behind(labels: Labels, seen: NDArray[np.bool_], across: NDArray[np.bool_]) -> Labels:
    """Layers (H, W) where unseen pixels are of the farther one of the seen layers on their two sides.

    What hides a pixel lies along its parallax: sides are in its row where that is ``across`` (H, W), else in its
    column, or in the other where there are none.
    """
    known = np.where(seen, labels, np.nan).astype(np.float32)
    in_row = np.fmin(*known_beside(known))
    in_column = np.fmin(*(side.T for side in known_beside(known.T)))
    first, second = np.where(across, in_row, in_column), np.where(across, in_column, in_row)
    found = np.where(np.isnan(first), second, first)
    return np.where(seen | np.isnan(found), labels, np.nan_to_num(found)).astype(np.int64)


class _Pair:
    """Unlikeness of two frames for each layer, and where its pixels land."""

    def __init__(
        self, greys: tuple[F32, F32], camera: MovingCamera, planes: FloatArray, options: LabelOptions, step: float
    ) -> None:
        self._options, self._camera = options, camera
        self._step = step / max(camera.parallax_px, np.finfo(np.float64).tiny)
        self._rhos = [camera.inverse_depths(planes, frame) for frame in FRAMES]
        axes = (camera.shutter.axis(camera.side),) * 2
        poses = [camera.row_poses(frame) for frame in FRAMES]
        self._maps = [reprojection_of(camera.rig.camera, poses[f], poses[1 - f], axes) for f in FRAMES]
        self.costs = [np.zeros_like(rho) for rho in self._rhos]
        self._pixels = [np.zeros(rho.shape, dtype=np.int32) for rho in self._rhos]
        """(n, H, W) the other frame's pixel, counted along its rows, at which a layer lands; any if at none."""
        self._there = [np.zeros_like(rho) for rho in self._rhos]
        """(n, H, W) its inverse depth there."""
        for frame in FRAMES:
            comparer = Comparer(greys[frame], options.window)
            for k, rho in enumerate(self._rhos[frame]):
                places, factors = self._landed(frame, rho)
                self.costs[frame][k] = self._unlike(comparer, greys, frame, places)
                self._pixels[frame][k], self._there[frame][k] = _numbered(places), rho * factors

    def _landed(self, frame: int, rho: F32) -> tuple[F32, F32]:
        lines = np.indices(rho.shape, dtype=np.int32)[1 - self._camera.shutter.axis(self._camera.side)]
        return reproject_pixels(self._maps[frame], rho, lines)

    def _unlike(self, comparer: Comparer, greys: tuple[F32, F32], frame: int, places: F32) -> F32:
        """0 to 1 (H, W), NaN outside: half by the windows around pixels, which tell them apart, and half by the
        pixels alone, which tell on which side of a border they are."""
        seen = resample(greys[1 - frame], places)
        levels = np.abs(seen - greys[frame]) / np.float32(self._options.full_levels)
        unlike = np.float32(0.5) * comparer.compared(seen) + np.float32(0.25) * np.minimum(levels, np.float32(1.0))
        return np.where(np.isnan(places[..., 0]), np.float32(np.nan), unlike)

    def across(self, frame: int) -> NDArray[np.bool_]:
        """(H, W) where parallax moves a pixel rather along its row than along its column."""
        near, far = (self._landed(frame, self._rhos[frame][k])[0] for k in (-1, 0))
        way = np.abs(near - far)
        return ~(way[..., 1] > way[..., 0])

    def places(self, labels: Labels) -> F32:
        """(H, W, 2) px in frame 1 of the pixels of frame 0 on their layers (H, W)."""
        return self._landed(0, np.take_along_axis(self._rhos[0], labels[None], axis=0)[0])[0]

    def smoothed(self, costs: list[F32]) -> tuple[Labels, Labels]:
        """Layers of least cost (n, H, W) and smoothness, of both frames."""
        first, second = (self._winners(cost) for cost in costs)
        return first, second

    def _winners(self, costs: F32) -> Labels:
        known = np.where(np.isnan(costs), np.float32(self._options.unseen), costs)
        volume = np.moveaxis((np.float32(255.0) * known + np.float32(0.5)).astype(np.uint8), 0, -1)
        volume = np.ascontiguousarray(volume)
        return np.argmin(aggregated(volume, self._options.p1, self._options.p2), axis=-1)

    def hidden(self, labels: tuple[Labels, Labels]) -> list[F32]:
        """The costs (n, H, W) of both frames; NaN also where the other frame shows a nearer layer."""
        found = []
        for frame in FRAMES:
            there = np.take_along_axis(self._rhos[1 - frame], labels[1 - frame][None], axis=0)[0]
            hidden = there.ravel()[self._pixels[frame]] > self._there[frame] + self._step
            found.append(np.where(hidden, np.float32(np.nan), self.costs[frame]))
        return found


def _numbered(places: F32) -> NDArray[np.int32]:
    """The pixel (H, W), counted along the rows, that is nearest to each place (H, W, 2); 0 for NaN."""
    height, width = places.shape[:2]
    known = np.where(np.isnan(places), np.float32(0.0), places)
    x, y = (np.clip(np.rint(known[..., k]).astype(np.int32), 0, most - 1) for k, most in ((0, width), (1, height)))
    return np.asarray(y * np.int32(width) + x, dtype=np.int32)
