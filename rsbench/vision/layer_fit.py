"""Planes of a layered scene, and the motion of the camera that looks at it, from matches of its two frames.

A match on a layer says more of the motion than its epipolar constraint: where along the epipolar curve its end
is. How much more depends on how thick the layer is: the errors of a match are those of its keypoints plus, along
the curve, the parallax of a depth that scatters about the plane by the layer's thickness. That is found from the
matches themselves, so that a scene of exact planes gives its motion with all its matches, and one that is no
scene of planes not a wrong one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rsbench.arguments import check_ranges
from rsbench.core.motion import Motion
from rsbench.core.se3 import compose, inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.motions import make_motion, model_name
from rsbench.vision.flow import dense_flow, flow_depth
from rsbench.vision.layers import F32, Labelled, MovingCamera, planes_seen
from rsbench.vision.resample import resample

_GRID = 4
"""px between two pixels that are followed."""
_AROUND = np.ones((7, 7), np.uint8)
"""px around one that must show its layer."""
_LLOYD = 30
_FEWEST = 5
"""Matches of a layer."""
_LEAST_NOISE_PX = 0.02
_MAD = 1.4826
"""Standard deviations in a median absolute deviation of normal errors."""


@dataclass(frozen=True, kw_only=True)
class PlaneOptions:
    """How many layers there are."""

    most: int = 12
    """Layers, beside that at infinity."""
    thickness_px: float = 0.5
    """Layers are split until their matches scatter by no more parallax (root mean square), about."""

    def __post_init__(self) -> None:
        check_ranges(self, {"most": (1, 64), "thickness_px": (1e-3, 1e3)})


def followed(greys: tuple[F32, F32], labelled: Labelled) -> tuple[FloatArray, NDArray[np.int64]]:
    """Matches (n, 4) of pixels of frame 0 on a grid, and the layer (n,) of each.

    Each is where its layer takes it and from there what flow is left between the frames (H, W), grey: their
    colours are compared once the layers have aligned them, so the flow is short and follows no edge of a layer.
    """
    first, second = greys
    places, labels = labelled.places, labelled.labels[0]
    aligned = np.where(labelled.seen[0], resample(second, places), first)
    left = dense_flow(*(np.clip(np.rint(grey), 0, 255).astype(np.uint8) for grey in (first, aligned)))
    inner = cv2.erode(labelled.seen[0].astype(np.uint8), _AROUND) > 0
    numbers = labels.astype(np.uint8)
    inner &= cv2.dilate(numbers, _AROUND) == cv2.erode(numbers, _AROUND)
    y, x = (_GRID * axis + _GRID // 2 for axis in np.indices([n // _GRID for n in labels.shape]).reshape(2, -1))
    y, x = y[inner[y, x]], x[inner[y, x]]
    by_y, by_x = (np.stack([places[y + v, x + u] - places[y - v, x - u] for u, v in ([ (0, 1), (1, 0)])]) / 2.0)
    ends = places[y, x] + left[y, x, :1] * by_x + left[y, x, 1:] * by_y
    return np.concatenate([np.stack([x, y], axis=1), ends], axis=1).astype(np.float64), labels[y, x]


def px_of_inverse_depth(camera: MovingCamera) -> float:
    """px that a point of inverse depth 1 in the unit of the motion moves in a frame period, about."""
    return camera.rig.camera.fx * float(np.linalg.norm(camera.motion.d))


def fronto_parallel(matches: FloatArray, camera: MovingCamera, options: PlaneOptions) -> FloatArray:
    """Planes (n, 3) that face the camera before it moves, from far to near, at the depths of matches (m, 4).

    The first one is at infinity. Without a translation it is the only one.
    """
    gain = px_of_inverse_depth(camera)
    far = np.zeros((1, 3))
    if not gain > 0.0 or len(matches) < _FEWEST:
        return far
    pixels = matches[:, :2]
    depth, _ = flow_depth(
        pixels, matches[:, 2:] - pixels, camera.rig, camera.shutter, camera.motion, camera.side, 0
    )
    pose = camera.rig.cam_from_world(
        camera.motion, camera.shutter.pixel_time(pixels, 0, camera.side), camera.side
    )
    near = np.isfinite(depth)
    rays = camera.rig.camera.unproject(pixels)
    rho = np.zeros(len(matches))
    points = transform(inverse(pose), rays * np.where(near, depth, 1.0)[:, None])
    rho[near] = 1.0 / np.where(points[near, 2] > 0.0, points[near, 2], np.inf)
    centres = grouped(rho * gain, options) / gain
    planes = np.zeros((len(centres), 3))
    planes[:, 2] = centres
    return np.concatenate([far, planes])


def grouped(values: FloatArray, options: PlaneOptions) -> FloatArray:
    """Centres, in ascending order, of groups of values (n,): the widest is split until all are thin enough."""
    centres = np.array([np.median(values)])
    while True:
        group = np.argmin(np.abs(values[:, None] - centres), axis=1)
        wide = np.array([np.sqrt(np.mean((values[group == k] - c) ** 2)) if np.any(group == k) else 0.0
                         for k, c in enumerate(centres)])
        worst = int(np.argmax(wide))
        if wide[worst] <= options.thickness_px or len(centres) >= options.most:
            break
        own = values[group == worst]
        middle = 0.5 * (own.min() + own.max())
        centres = np.concatenate([np.delete(centres, worst), [np.median(own[own <= middle]), np.median(own[own > middle])]])
        centres = _lloyd(values, centres)
    group = np.argmin(np.abs(values[:, None] - centres), axis=1)
    kept = centres[np.bincount(group, minlength=len(centres)) >= _FEWEST]
    return np.sort(kept[kept > 0.5 * options.thickness_px])


def _lloyd(values: FloatArray, centres: FloatArray) -> FloatArray:
    for _ in range(_LLOYD):
        group = np.argmin(np.abs(values[:, None] - centres), axis=1)
        moved = np.array([np.median(values[group == k]) if np.any(group == k) else c for k, c in enumerate(centres)])
        if np.array_equal(moved, centres):
            break
        centres = moved
    return centres


class _Ends(NamedTuple):
    """Where matches on their layers should end, less where they do."""

    off: FloatArray
    """(n, 2) px."""
    slope: FloatArray
    """(n, 2) px per step of inverse depth."""


def _ends(matches: FloatArray, camera: MovingCamera, planes: FloatArray) -> _Ends:
    """Of matches (n, 4) on planes (n, 3), one each."""
    rig, shutter, side = camera.rig, camera.shutter, camera.side
    poses = [
        rig.cam_from_world(camera.motion, shutter.pixel_time(matches[:, 2 * f : 2 * f + 2], f, side), side)
        for f in (0, 1)
    ]
    rays = rig.camera.unproject(matches[:, :2])
    rho = np.sum(planes_seen(planes[:, None], poses[0])[:, 0] * rays, axis=-1)
    R, T = compose(poses[1], inverse(poses[0]))
    point = (R @ rays[..., None])[..., 0] + rho[:, None] * T
    z = np.where(point[:, 2] > 1e-6, point[:, 2], 1e-6)
    focal = np.array([rig.camera.fx, rig.camera.fy])
    flat = point[:, :2] / z[:, None]
    slope = focal * (T[:, :2] - flat * T[:, 2:]) / z[:, None]
    centre = np.array([rig.camera.cx, rig.camera.cy])
    return _Ends(focal * flat + centre - matches[:, 2:], slope)


class _Weights(NamedTuple):
    """What divides the errors of matches across and along their curves, (n,) px each."""

    across: FloatArray
    along: FloatArray


def _split(ends: _Ends) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (n,) across and along the epipolar curve, and the length (n,) of the slope."""
    length = np.linalg.norm(ends.slope, axis=-1)
    way = ends.slope / np.maximum(length, 1e-12)[:, None]
    along = np.sum(ends.off * way, axis=-1)
    across = ends.off[:, 0] * way[:, 1] - ends.off[:, 1] * way[:, 0]
    return across, along, length


def _weights(ends: _Ends, layer: NDArray[np.int64], count: int) -> _Weights:
    across, along, length = _split(ends)
    noise = max(_MAD * float(np.median(np.abs(across))), _LEAST_NOISE_PX)
    thick = np.zeros(count)
    for k in range(count):
        own = (layer == k) & (length > 0.0)
        if np.any(own):
            off = _MAD * float(np.median(np.abs(along[own]) / length[own]))
            thick[k] = max(off**2 - (noise / float(np.median(length[own]))) ** 2, 0.0) ** 0.5
    return _Weights(np.full(len(across), noise), np.hypot(noise, thick[layer] * length))


def refined(
    matches: FloatArray, layer: NDArray[np.int64], camera: MovingCamera, planes: FloatArray
) -> tuple[Motion, FloatArray]:
    """Motion, with d as long as before, and inverse depths of fronto-parallel planes (p, 3) by least squares.

    ``layer`` (n,) is the plane of each match (n, 4). Planes at infinity stay there. The motion keeps its model.
    """
    motion = camera.motion
    free = np.flatnonzero((planes[:, 2] > 0.0) & (np.bincount(layer, minlength=len(planes)) >= _FEWEST))
    length = float(np.linalg.norm(motion.d))
    if not length > 0.0:
        return motion, planes
    weights = _weights(_ends(matches, camera, planes[layer]), layer, len(planes))
    basis = np.linalg.svd(motion.d[None])[2][1:]
    unit, name = motion.d / length, model_name(type(motion))

    def made(x: FloatArray) -> tuple[Motion, FloatArray]:
        d = unit + x[3:5] @ basis
        moved = planes.copy()
        moved[free] *= np.exp(x[5:])[:, None]
        return make_motion(name, motion.w + x[:3], length * d / np.linalg.norm(d), motion.parameters), moved

    def errors(x: FloatArray) -> FloatArray:
        moving, moved = made(x)
        across, along, _ = _split(_ends(matches, camera._replace(motion=moving), moved[layer]))
        return np.concatenate([across / weights.across, along / weights.along])

    start = np.zeros(5 + len(free))
    found = least_squares(errors, start, loss="soft_l1", x_scale="jac", max_nfev=30)
    return made(found.x)
