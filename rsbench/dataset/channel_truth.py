"""The truth of channels that pair two pictures: where each pixel lies in the other one, and what became of it.

What is hidden is decided by rays, not by the other picture's depth map: that knows pixel centres only, so between
them, at every edge, it would have to guess.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from rsbench.core.geometry import Geometry
from rsbench.core.projection import row_poses
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.channels import Layer, PixelClass
from rsbench.dataset.row_search import Reprojected, find
from rsbench.dataset.views import FAR, ImageView, seen_from, times_at
from rsbench.renderers.visibility import Surfaces

Blocked = Callable[[FloatArray, FloatArray, FloatArray | None], NDArray[np.bool_]]
"""Whether something stands before points (n, 3) seen from eyes (n, 3), world frame, metres; at times (n,), given
where objects move."""


class Rays(Protocol):
    """Rays through the scene of a sequence: ``renderers.segments.SceneRays`` is one."""

    def blocked(
        self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None
    ) -> NDArray[np.bool_]: ...
    def surfaces(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> Surfaces: ...


class PairTruth(NamedTuple):
    """Of the pixels of a source."""

    offset: FloatArray
    """(H, W, 2) x_target - x_source, px; NaN where the class is UNSOLVED or OUT_OF_VIEW."""
    classes: NDArray[np.uint8]
    """(H, W) of ``PixelClass``."""


def target_of(layer: Layer, source: ImageView, frames: int) -> ImageView:
    """The picture in which a channel of a sequence of so many frames looks for the pixels of one of them."""
    twin = source.other_shutter._replace(row=layer.row)
    over_time = source.frame_before if layer.back else source.next_frame(frames)
    return {"disparity": source.other_side, "flow": over_time, "gs_flow": twin}[layer.channel]


class SeenSurfaces:
    """What the pixels of a rolling-shutter frame see, and from where.

    Args:
        geometry: of the sequence.
        source: the frame.
        depth: (H, W) of the frame, metres, 0 = sky, which is looked for at ``FAR``.
        rows: these (H,) rows of the frame only, of which ``depth`` is; all by default.
        numbers: (H, W) of the objects that move and are seen, 0 = none; none by default.
    """

    def __init__(
        self,
        geometry: Geometry,
        source: ImageView,
        depth: NDArray[np.float32],
        rows: Sequence[int] | None = None,
        numbers: NDArray[np.uint8] | None = None,
    ) -> None:
        camera, shutter = geometry.rig.camera, geometry.shutter
        self.geometry, self.source = geometry, source
        self.grid = camera.pixel_grid()[slice(None) if rows is None else np.asarray(rows)]
        self.sky = depth == 0
        self.numbers = numbers
        poses = row_poses(geometry.rig, shutter, geometry.motion, source.side, source.frame)
        self.points = np.where(self.sky, FAR, depth)[..., None] * camera.unproject(self.grid)
        """(H, W, 3) world frame, metres."""
        eyes = inverse(poses).t
        if shutter.axis(source.side) == 1:
            lines = self.grid[:, 0, 1].astype(np.int64)
            self.points -= poses.t[lines, None]
            self.points = self.points @ poses.R[lines]
            eyes = eyes[lines, None]
        else:
            self.points -= poses.t
            self.points = np.swapaxes(np.swapaxes(self.points, 0, 1) @ poses.R, 0, 1)
        self.eyes = np.broadcast_to(eyes, self.points.shape)
        """(H, W, 3) the camera's centres, world frame, metres."""

    @property
    def tau(self) -> FloatArray | None:
        """(H W) times of the pixels; None where nothing moves."""
        return times_at(self.geometry, self.source, self.grid).ravel() if self.geometry.objects else None


class Carried(NamedTuple):
    """The surfaces that the pixels of a source see, in another picture."""

    landed: Reprojected
    points: FloatArray
    """(H, W, 3) where they are when the target sees them, world frame, metres."""


def carry(surfaces: SeenSurfaces, target: ImageView) -> Carried:
    """Where another picture sees what every pixel of a rolling-shutter frame sees, hidden or not."""
    start = surfaces.grid[..., surfaces.geometry.shutter.axis(target.side)]
    landed = find(surfaces.geometry, target, surfaces.points, start)
    if surfaces.numbers is None or not surfaces.geometry.objects:
        return Carried(landed, surfaces.points)
    points = surfaces.points.copy()
    for number in np.unique(surfaces.numbers[surfaces.numbers > 0]):
        chosen = surfaces.numbers == number
        points[chosen], own = _landed_with(surfaces, target, int(number), chosen, start)
        for whole, part in zip(landed, own, strict=True):
            whole[chosen] = part
    return Carried(landed, points)


def pair_truth(surfaces: SeenSurfaces, target: ImageView, carried: Carried, blocked: Blocked) -> PairTruth:
    """What became of the pixels that ``carry`` carried into the target; ``blocked`` is asked once."""
    landed, points = carried
    return PairTruth(landed.pixels - surfaces.grid, _classes(surfaces, target, landed, points, blocked))


def _landed_with(
    surfaces: SeenSurfaces, target: ImageView, number: int, chosen: NDArray[np.bool_], start: FloatArray
) -> tuple[FloatArray, Reprojected]:
    """Where an object has its chosen points (n, 3) when the target sees them, world frame, and where it does."""
    geometry, thing = surfaces.geometry, surfaces.geometry.objects[number - 1]
    tau = times_at(geometry, surfaces.source, surfaces.grid[chosen])
    X = transform(inverse(thing.world_from_object(tau)), surfaces.points[chosen])
    # Each alone: its neighbours in the row may be other things.
    found = find(seen_from(geometry, number), target, X[:, None], start[chosen][:, None])
    there = thing.world_from_object(times_at(geometry, target, found.pixels[:, 0]))
    eyes = transform(there, found.eyes[:, 0])
    return transform(there, X), Reprojected(found.pixels[:, 0], eyes, found.unsolved[:, 0])


def surface_truth(surfaces: SeenSurfaces, rays: Rays) -> Surfaces:
    """Normals (H, W, 3) and instances (H, W) of the pixels of a rolling-shutter frame; 0 in the sky."""
    shape = surfaces.sky.shape
    normals, instances = rays.surfaces(surfaces.eyes.reshape(-1, 3), surfaces.points.reshape(-1, 3), surfaces.tau)
    normals, instances = normals.reshape(*shape, 3), instances.reshape(shape)
    normals[surfaces.sky], instances[surfaces.sky] = 0.0, 0
    return Surfaces(normals, instances)


def _classes(
    surfaces: SeenSurfaces, target: ImageView, landed: Reprojected, points: FloatArray, blocked: Blocked
) -> NDArray[np.uint8]:
    """(H, W) of ``PixelClass``; ``points`` (H, W, 3) where they are when the target sees them."""
    inside = np.isfinite(landed.pixels[..., 0])
    moves = bool(surfaces.geometry.objects)
    tau = times_at(surfaces.geometry, target, landed.pixels).ravel() if moves else None
    hidden = blocked(landed.eyes.reshape(-1, 3), points.reshape(-1, 3), tau).reshape(inside.shape)
    classes = np.where(hidden, np.uint8(PixelClass.OCCLUDED), np.uint8(PixelClass.VISIBLE))
    of_sky = np.where(hidden, np.uint8(PixelClass.SKY_OCCLUDED), np.uint8(PixelClass.SKY))
    classes[surfaces.sky] = of_sky[surfaces.sky]
    classes[~inside] = PixelClass.OUT_OF_VIEW
    classes[landed.unsolved] = PixelClass.UNSOLVED
    return classes
