"""The layers of a scene from matches of two frames of one camera whose motion is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsbench.core.arguments import check_ranges
from rsbench.core.se3 import inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.vision.flow import flow_depth
from rsbench.vision.layers import MovingCamera

FEWEST = 5
"""Matches of a layer."""
_ROUNDS = 30


@dataclass(frozen=True, kw_only=True)
class PlaneOptions:
    """How many layers there are."""

    most: int = 24
    """Layers, beside that at infinity."""
    thickness_px: float = 0.25
    """Layers are split until their matches scatter by no more parallax over a frame period (root mean square)."""

    def __post_init__(self) -> None:
        check_ranges(self, {"most": (1, 64), "thickness_px": (1e-3, 1e3)})


def fronto_parallel(matches: FloatArray, camera: MovingCamera, options: PlaneOptions) -> FloatArray:
    """Planes (n, 3) that face the camera before it moves, from far to near, at the depths of matches (m, 4).

    The first one is at infinity. Without a translation, or with too few matches, it is the only one.
    """
    gain, far = camera.parallax_px, np.zeros((1, 3))
    if not gain > 0.0 or len(matches) < FEWEST:
        return far
    centres = grouped(_inverse_depths(matches, camera) * gain, options) / gain
    planes = np.zeros((len(centres), 3))
    planes[:, 2] = centres
    return np.concatenate([far, planes])


def _inverse_depths(matches: FloatArray, camera: MovingCamera) -> FloatArray:
    """(m,) in the camera before it moves, of matches (m, 4); 0 where their rays do not meet before it."""
    rig, shutter, side, motion = camera
    pixels = matches[:, :2]
    depth, _ = flow_depth(pixels, matches[:, 2:] - pixels, rig, shutter, motion, side, 0)
    near = np.isfinite(depth)
    pose = rig.cam_from_world(motion, shutter.pixel_time(pixels, 0, side), side)
    points = transform(inverse(pose), np.where(near, depth, 1.0)[:, None] * rig.camera.unproject(pixels))
    ahead = near & (points[:, 2] > 0.0)
    return np.where(ahead, 1.0 / np.where(ahead, points[:, 2], 1.0), 0.0)


def grouped(values: FloatArray, options: PlaneOptions) -> FloatArray:
    """Centres, ascending, of groups of values (n,), px: the widest group is split until all are thin enough.

    Medians in place of means keep strays out. Groups of a few strays, and what is no thicker than a layer at
    infinity would be, are left out.
    """
    centres = np.array([np.median(values)])
    while len(centres) < options.most:
        wide = np.array([np.sqrt(np.mean(own**2)) if own.size else 0.0 for own in _offsets(values, centres)])
        worst = int(np.argmax(wide))
        if wide[worst] <= options.thickness_px:
            break
        own = values[_nearest(values, centres) == worst]
        middle = 0.5 * (own.min() + own.max())
        halves = [np.median(own[own <= middle]), np.median(own[own > middle])]
        centres = _settled(values, np.concatenate([np.delete(centres, worst), halves]))
    counts = np.bincount(_nearest(values, centres), minlength=len(centres))
    return np.sort(centres[(counts >= FEWEST) & (centres > 0.5 * options.thickness_px)])


def _nearest(values: FloatArray, centres: FloatArray) -> NDArray[np.int64]:
    return np.argmin(np.abs(values[:, None] - centres), axis=1)


def _offsets(values: FloatArray, centres: FloatArray) -> list[FloatArray]:
    group = _nearest(values, centres)
    return [values[group == k] - centre for k, centre in enumerate(centres)]


def _settled(values: FloatArray, centres: FloatArray) -> FloatArray:
    """Centres that are the medians of what is nearest to them (Lloyd's iteration)."""
    for _ in range(_ROUNDS):
        offsets = _offsets(values, centres)
        moved = centres + [float(np.median(own)) if own.size else 0.0 for own in offsets]
        if np.array_equal(moved, centres):
            break
        centres = moved
    return centres
