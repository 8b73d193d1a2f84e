"""World points of depth maps and where the images of a sequence see them, exactly: what a reconstruction holds."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.projection import ProjectionStatus, project_at, rs_project
from rsbench.core.se3 import Pose, inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.object_records import numbers_of
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import Images, View, first_pose, line_poses, views_in_time

_POINTS = 50_000
"""Of a sequence, nearly."""
_MOST_OF_AN_IMAGE = 2_000
_AROUND = 4
"""Frames before and after its own in which a point is looked for."""
_SAME = 2e-3
"""Share by which the depth of a point may differ from that of the surface that is seen there."""


class Points(NamedTuple):
    """Points (n) of the surfaces of one image."""

    world: FloatArray
    """(n, 3) m, in the world of the sequence."""
    pixels: NDArray[np.int64]
    """(n, 2) x, y."""
    colours: NDArray[np.uint8]
    """(n, 3) sRGB."""


class Observations(NamedTuple):
    """Which points of a list an image sees, and where."""

    index: NDArray[np.int64]
    """(m,)"""
    pixels: FloatArray
    """(m, 2) exact, not whole."""


class Surfaces(NamedTuple):
    """Points of all images of a sequence, each seen by two at least."""

    world: FloatArray
    """(n, 3)"""
    colours: NDArray[np.uint8]
    """(n, 3)"""
    seen: dict[View, Observations]
    """Indices into the points."""


def world_points(sequence: Sequence, view: View, images: Images, step: int) -> Points:
    """Points at the centres of every ``step``-th pixel in both directions, of what stands still and has depth."""
    depth = sequence.depth(images, view.side, view.frame)
    still = (depth > 0) & (numbers_of(sequence.labels(images, view.side, view.frame)) == 0)
    grid = np.zeros_like(still)
    grid[step // 2 :: step, step // 2 :: step] = True
    y, x = np.nonzero(still & grid)
    pixels = np.stack([x, y], axis=-1)
    colours = sequence.image(images, view.side, view.frame)[y, x]
    x_in_cam = depth[y, x, None].astype(np.float64) * sequence.rig.camera.unproject(pixels)
    return Points(transform(inverse(pixel_poses(sequence, view, images, pixels)), x_in_cam), pixels, colours)


def pixel_poses(sequence: Sequence, view: View, images: Images, pixels: NDArray[np.int64]) -> Pose:
    """``cam_from_world`` (n, 3, 3), (n, 3) at which an image sees whole pixels (n, 2)."""
    if images == "gs":
        still = first_pose(sequence, view)
        return Pose(*(np.broadcast_to(part, (len(pixels), *part.shape)) for part in still))
    lines = pixels[:, sequence.shutter.axis(view.side)]
    return Pose(*(part[lines] for part in line_poses(sequence, view)))


def observe(sequence: Sequence, view: View, images: Images, world: FloatArray) -> Observations:
    """Points (n, 3) that an image sees: inside it, not seen twice, and not behind what its depth shows."""
    rig, shutter, motion = sequence.rig, sequence.shutter, sequence.motion
    if images == "gs":
        start = shutter.start(view.frame, view.side)
        found = project_at(rig, motion, view.side, start, world)
        pixels, z = found[:, :2], found[:, 2]
        once = rig.camera.contains(np.nan_to_num(pixels, nan=-np.inf))
    else:
        rolling = rs_project(rig, shutter, motion, view.side, view.frame, world)
        pixels, z, once = rolling.pixels, rolling.depth, rolling.status == ProjectionStatus.SEEN
    index = np.flatnonzero(once)
    depth = sequence.depth(images, view.side, view.frame)
    index = index[_on_surface(depth, pixels[index], z[index])]
    return Observations(index, pixels[index])


def _on_surface(depth: NDArray[np.float32], pixels: FloatArray, z: FloatArray) -> NDArray[np.bool_]:
    """Whether a map (H, W) shows points at depths (n) at pixels (n, 2); on a plane 1 / z is linear."""
    height, width = depth.shape
    if min(height, width) < 2:
        return np.zeros(len(z), dtype=np.bool_)
    x0 = np.clip(np.floor(pixels[:, 0]), 0, width - 2).astype(np.int64)
    y0 = np.clip(np.floor(pixels[:, 1]), 0, height - 2).astype(np.int64)
    corners = np.stack([depth[y0 + j, x0 + i] for j in (0, 1) for i in (0, 1)], axis=-1).astype(np.float64)
    known = np.all(corners > 0, axis=-1)
    near = 1.0 / np.where(corners > 0, corners, 1.0)
    u, v = pixels[:, 0] - x0, pixels[:, 1] - y0
    upper = near[:, 0] + u * (near[:, 1] - near[:, 0])
    lower = near[:, 2] + u * (near[:, 3] - near[:, 2])
    return known & (np.abs(z * (upper + v * (lower - upper)) - 1.0) < _SAME)


def surfaces(sequence: Sequence, images: Images) -> Surfaces:
    """Points of the depth of every image, and every image near in time that sees them."""
    views = views_in_time(sequence)
    camera = sequence.rig.camera
    wanted = min(_MOST_OF_AN_IMAGE, max(_POINTS // len(views), 1))
    step = max(math.ceil(math.sqrt(camera.width * camera.height / wanted)), 1)
    worlds, colours, origins = list[FloatArray](), list[NDArray[np.uint8]](), list[NDArray[np.int64]]()
    for number, view in enumerate(views):
        points = world_points(sequence, view, images, step)
        worlds.append(points.world)
        colours.append(points.colours)
        origins.append(np.full(len(points.world), number, dtype=np.int64))
    world, origin = np.concatenate(worlds), np.concatenate(origins)
    frames = np.array([view.frame for view in views])[origin]
    seen = dict[View, Observations]()
    for view in views:
        near = np.flatnonzero(np.abs(frames - view.frame) <= _AROUND)
        found = observe(sequence, view, images, world[near])
        seen[view] = Observations(near[found.index], found.pixels)
    return _kept(Surfaces(world, np.concatenate(colours), seen))


def _kept(found: Surfaces) -> Surfaces:
    """Without the points that fewer than two images see."""
    counts = np.zeros(len(found.world), dtype=np.int64)
    for each in found.seen.values():
        np.add.at(counts, each.index, 1)
    keep = counts >= 2
    place = np.cumsum(keep) - 1
    seen = {
        view: Observations(place[each.index[keep[each.index]]], each.pixels[keep[each.index]])
        for view, each in found.seen.items()
    }
    return Surfaces(found.world[keep], found.colours[keep], seen)
