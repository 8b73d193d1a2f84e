"""The motion of a camera that looks at layers, by least squares of where its two frames show the same pixels.

A match on a layer says more of the motion than its epipolar constraint: how far along the epipolar curve its end
is. How much that counts depends on how thick the layer is: the errors of a match are those of its pixels and,
along the curve, the parallax of a depth that scatters about the plane by the layer's thickness. Both are found
from the matches, so that a scene of exact planes gives its motion with all that they say, and one that is none no
wrong one.

Beside the matches that are given, pixels of a grid are followed through frames that the layers have aligned: the
difference of colours that the layers leave, as lengths. As colours they would count pixels whose layer is a
little off as errors of the motion, whatever their direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rsbench.components.motion_models import make_motion, model_name
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES
from rsbench.core.se3 import compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.vision.flow import dense_flow
from rsbench.vision.layer_fit import FEWEST
from rsbench.vision.layers import Labelled, MovingCamera, planes_seen
from rsbench.vision.reprojection import F32
from rsbench.vision.resample import resample

_GRID = 4
"""px between two pixels that are followed."""
_TOGETHER = 9.0
"""Followed pixels that err alike: flow is that of patches of 8 px, and smooth beyond them."""
_AROUND = np.ones((7, 7), np.uint8)
"""px around one that must show its layer."""
_LEAST_NOISE_PX = 0.02
_MAD = 1.4826
"""Standard deviations in a median absolute deviation of normal errors."""
_LEAST_DEPTH = 1e-6
_STEPS = 30


class Followed(NamedTuple):
    """Matches of one accuracy, on layers."""

    matches: FloatArray
    """(n, 4) x0, y0, x1, y1 px."""
    layer: NDArray[np.int64]
    """(n,) number of the plane."""
    together: float = 1.0
    """How many of them err alike: so many count as one."""


def on_layers(matches: FloatArray, labelled: Labelled) -> Followed:
    """Those of matches (n, 4) whose pixel in frame 0 lies within a layer that frame 1 sees."""
    height, width = labelled.labels[0].shape
    x, y = np.clip(np.rint(matches[:, :2]).astype(np.int64), 0, (width - 1, height - 1)).T
    inner = _inner(labelled)[y, x]
    return Followed(matches[inner], labelled.labels[0][y, x][inner])


def followed(greys: tuple[F32, F32], labelled: Labelled) -> Followed:
    """Matches of pixels of frame 0 on a grid: where the layer takes each, and from there what flow is left.

    Grey frames (H, W) are compared once the layers have aligned them, so the flow is short and crosses no edge.
    """
    places, labels, seen = labelled.places, labelled.labels[0], labelled.seen[0]
    aligned = np.where(seen, resample(greys[1], places), greys[0])
    left = dense_flow(*(np.clip(np.rint(grey), 0, 255).astype(np.uint8) for grey in (greys[0], aligned)))
    inner = _inner(labelled)
    y, x = (_GRID * axis + _GRID // 2 for axis in np.indices([n // _GRID for n in labels.shape]).reshape(2, -1))
    y, x = y[inner[y, x]], x[inner[y, x]]
    by_x = 0.5 * (places[y, x + 1] - places[y, x - 1])
    by_y = 0.5 * (places[y + 1, x] - places[y - 1, x])
    ends = places[y, x] + left[y, x, :1] * by_x + left[y, x, 1:] * by_y
    matches = np.concatenate([np.stack([x, y], axis=1), ends], axis=1).astype(np.float64)
    return Followed(matches, labels[y, x], _TOGETHER)


def _inner(labelled: Labelled) -> NDArray[np.bool_]:
    """(H, W) whether all pixels around one of frame 0 show its layer, and frame 1 sees them; no border pixels."""
    numbers = labelled.labels[0].astype(np.uint8)
    seen = cv2.erode(labelled.seen[0].astype(np.uint8), _AROUND, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return (seen > 0) & (cv2.dilate(numbers, _AROUND) == cv2.erode(numbers, _AROUND))


def refined(sets: Sequence[Followed], camera: MovingCamera, planes: FloatArray) -> tuple[Motion, FloatArray]:
    """Motion, with d as long as before, and planes (p, 3) moved along their normals, by robust least squares.

    Planes at infinity, and those of few matches, stay. The motion keeps its model.
    """
    motion, length = camera.motion, float(np.linalg.norm(camera.motion.d))
    if not length > 0.0:
        return motion, planes
    counts = np.bincount(np.concatenate([each.layer for each in sets]), minlength=len(planes))
    free = np.flatnonzero(np.any(planes != 0.0, axis=1) & (counts >= FEWEST))
    weights = [_weights(each, camera, planes) for each in sets]
    across_d = np.linalg.svd(motion.d[None])[2][1:]
    name = model_name(type(motion))

    def made(x: FloatArray) -> tuple[Motion, FloatArray]:
        d = motion.d / length + x[3:5] @ across_d
        moved = planes.copy()
        moved[free] *= np.exp(x[5:])[:, None]
        return make_motion(name, motion.w + x[:3], length * d / np.linalg.norm(d), motion.parameters), moved

    def errors(x: FloatArray) -> FloatArray:
        moving, moved = made(x)
        seen = camera._replace(motion=moving)
        parts: list[FloatArray] = []
        for one, weight in zip(sets, weights, strict=True):
            across, along, _ = _split(_ends(one.matches, seen, moved[one.layer]))
            parts += [across / weight.across, along / weight.along]
        return np.concatenate(parts)

    if sum(len(one.layer) for one in sets) < FEWEST:
        return motion, planes
    found = least_squares(errors, np.zeros(5 + len(free)), loss="soft_l1", x_scale="jac", max_nfev=_STEPS)
    return made(found.x)


class _Ends(NamedTuple):
    """Where matches on their layers should end."""

    off: FloatArray
    """(n, 2) px, less where they do."""
    slope: FloatArray
    """(n, 2) px per step of inverse depth."""


def _ends(matches: FloatArray, camera: MovingCamera, planes: FloatArray) -> _Ends:
    """Of matches (n, 4) on planes (n, 3), one each; both ends at the times of the rows in which they are."""
    rig, shutter, side, motion = camera
    halves = matches[:, :2], matches[:, 2:]
    first, second = (rig.cam_from_world(motion, shutter.pixel_time(halves[f], f, side), side) for f in FRAMES)
    rays = rig.camera.unproject(halves[0])
    rho = np.sum(planes_seen(planes[:, None], first)[:, 0] * rays, axis=-1)
    R, T = compose(second, inverse(first))
    point = (R @ rays[..., None])[..., 0] + rho[:, None] * T
    point[:, 2] = np.maximum(point[:, 2], _LEAST_DEPTH)
    focal = np.array([rig.camera.fx, rig.camera.fy])
    slope = focal * (T[:, :2] - point[:, :2] / point[:, 2:] * T[:, 2:]) / point[:, 2:]
    return _Ends(rig.camera.project(point) - halves[1], slope)


def _split(ends: _Ends) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (n,) px across and along the epipolar curves, and the lengths (n,) of their slopes."""
    length = np.linalg.norm(ends.slope, axis=-1)
    way = ends.slope / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    across = ends.off[:, 0] * way[:, 1] - ends.off[:, 1] * way[:, 0]
    return across, np.sum(ends.off * way, axis=-1), length


class _Weights(NamedTuple):
    """What the errors of matches are divided by, (n,) px."""

    across: FloatArray
    along: FloatArray


def _weights(given: Followed, camera: MovingCamera, planes: FloatArray) -> _Weights:
    """From how far the matches miss at this motion and these planes."""
    layer = given.layer
    across, along, length = _split(_ends(given.matches, camera, planes[layer]))
    noise = max(_MAD * float(np.median(np.abs(across))), _LEAST_NOISE_PX) if len(layer) else _LEAST_NOISE_PX
    thickness = np.zeros(len(planes))
    for k in np.unique(layer[length > 0.0]):
        own = (layer == k) & (length > 0.0)
        off, typical = _MAD * float(np.median(np.abs(along[own] / length[own]))), float(np.median(length[own]))
        thickness[k] = max(off**2 - (noise / typical) ** 2, 0.0) ** 0.5
    few = given.together**0.5
    return _Weights(np.full(len(across), few * noise), few * np.hypot(noise, thickness[layer] * length))
