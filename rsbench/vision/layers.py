"""A static scene as a few planes: fitted to matches, assigned to pixels, and used to refine the camera's motion.

A plane is n (3,) with n . X = 1 for its points X in the world, which has the axes of the camera before it moves; 0
is the plane at infinity. In the camera of a line with pose R, t and centre c it is ``R n / (1 - n . c)``. The
product of this vector with a ray (u, v, 1) is the inverse depth there, so each pixel of a layer moves by the
homography of its two lines. A pixel gets the layer at which the other frame is most similar to it, with a penalty
on changes of the layer. If the other frame shows a nearer layer at the place of a pixel, the similarity there
means nothing, and the layer gets the cost of an unseen pixel. Which pixels are hidden follows from the layers of
both frames, so they are determined in rounds.

A match on a layer constrains the motion by more than its epipolar constraint: also by the position of its end
along the epipolar curve. The weight of that constraint depends on the thickness of the layer: the errors of a
match are those of its pixels and, along the curve, the parallax of a depth that scatters about the plane by the
layer's thickness. Both are estimated from the matches, so that exact planes give the motion all information of the
matches, and a scene without planes does not bias it. In addition to the given matches, pixels of a grid are
tracked between frames that were aligned by the layers, and the remaining displacements are used. Differences of
colour would instead count pixels with a slightly wrong layer as errors of the motion in any direction.

After Vasu, Mohan M. R., Rajagopalan, "Occlusion-aware rolling shutter rectification of 3D scenes", CVPR 2018, of
which we read only the abstract: the equations are ours. Semi-global aggregation replaces graph cuts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rsbench.components.motion_models import make_motion, model_name
from rsbench.core.arguments import check_ranges
from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import FRAMES, Side, StereoRig
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.flow import dense_flow, flow_depth
from rsbench.vision.images import resample
from rsbench.vision.plane_sweep import Comparer, aggregated
from rsbench.vision.reprojection import F32, reproject_pixels, reprojection_of
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
    """Options of the assignment of pixels to layers."""

    window: int = 5
    """Side, px, of the window in which frames are compared."""
    full_levels: float = 30.0
    """Difference of grey levels at which, and above which, two pixels count as completely different."""
    p1: int = 24
    """Cost of a step to the next layer; the largest cost of a pixel is 255."""
    p2: int = 96
    """Cost of a step to any other layer."""
    unseen: float = 0.2
    """Cost of a pixel that the other frame does not see, from 0 to 1 (completely different)."""
    rounds: int = 2
    """Number of rounds in which hidden pixels are determined from the layers of both frames."""

    def __post_init__(self) -> None:
        if self.window % 2 == 0:
            raise ValueError(f"window = {self.window}: must be odd")
        if self.p1 > self.p2:
            raise ValueError(f"p1 = {self.p1}: must not exceed p2, {self.p2}")
        check_ranges(self, _RANGES)


class MovingCamera(NamedTuple):
    """One camera of a rig and its motion."""

    rig: StereoRig
    """A rig whose body is at the camera."""
    shutter: RollingShutter
    side: Side
    motion: Motion

    @property
    def parallax_px(self) -> float:
        """Approximate displacement, px, of a point of inverse depth 1, in the unit of the motion, in a frame
        period."""
        return self.rig.sensor(self.side).fx * float(np.linalg.norm(self.motion.d))

    def row_poses(self, frame: int) -> Pose:
        """``cam_from_world`` (lines, 3, 3), (lines, 3)."""
        return row_poses(self.rig, self.shutter, self.motion, self.side, frame)

    def inverse_depths(self, planes: FloatArray, frame: int) -> F32:
        """Inverse depths (n, H, W) of planes (n, 3) at a frame's pixels, in the row's camera; NaN behind it."""
        seen = planes_seen(planes, self.row_poses(frame))  # (H, n, 3)
        rays = self.rig.sensor(self.side).unproject(self.rig.sensor(self.side).pixel_grid())
        rho = np.einsum("hnk,hwk->nhw", seen, rays)
        return np.where(rho >= 0.0, rho, np.nan).astype(np.float32)


def planes_seen(planes: FloatArray, pose: Pose) -> FloatArray:
    """Planes (n, 3) of the world in cameras of poses (..., 3, 3), (..., 3): (..., n, 3); NaN if the camera has
    passed the plane."""
    turned = planes @ np.swapaxes(pose.R, -1, -2)
    # c = -R^T t, so 1 - n . c = 1 + (R n) . t
    ahead = 1.0 + np.einsum("...nk,...k->...n", turned, pose.t)
    return turned / np.where(ahead > 0.0, ahead, np.nan)[..., None]


class Labelled(NamedTuple):
    """The layer of each pixel."""

    labels: tuple[Labels, Labels]
    """(H, W) number of the plane, of frames 0 and 1."""
    seen: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    """(H, W) whether the other frame sees the pixel too."""
    places: F32
    """(H, W, 2) places in frame 1 of the pixels of frame 0, px; NaN where it does not see them."""
    cost: float
    """Mean dissimilarity of all pixels, 0 to 1, without the penalty on changes of the layer."""


def label_pixels(
    greys: tuple[F32, F32], camera: MovingCamera, planes: FloatArray, options: LabelOptions, step_px: float
) -> Labelled:
    """Assign ``planes`` (n, 3), ordered from far to near, to the pixels of two grey frames (H, W).

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
    """Layers (H, W) after unseen pixels got the farther layer of the two seen pixels beside them.

    The object that hides a pixel lies along its parallax: the two pixels are in its row where ``across`` (H, W) is
    true, otherwise in its column, or in the other direction if there are none.
    """
    known = np.where(seen, labels, np.nan).astype(np.float32)
    in_row = np.fmin(*known_beside(known))
    in_column = np.fmin(*(side.T for side in known_beside(known.T)))
    first, second = np.where(across, in_row, in_column), np.where(across, in_column, in_row)
    found = np.where(np.isnan(first), second, first)
    return np.where(seen | np.isnan(found), labels, np.nan_to_num(found)).astype(np.int64)


class _Pair:
    """Dissimilarity of two frames for each layer, and the places of its pixels."""

    def __init__(
        self, greys: tuple[F32, F32], camera: MovingCamera, planes: FloatArray, options: LabelOptions, step: float
    ) -> None:
        self._options, self._camera = options, camera
        self._step = step / max(camera.parallax_px, np.finfo(np.float64).tiny)
        self._rhos = [camera.inverse_depths(planes, frame) for frame in FRAMES]
        axes = (camera.shutter.axis(camera.side),) * 2
        poses = [camera.row_poses(frame) for frame in FRAMES]
        self._maps = [
            reprojection_of(camera.rig.sensor(camera.side), poses[f], poses[1 - f], axes) for f in FRAMES
        ]
        self.costs = [np.zeros_like(rho) for rho in self._rhos]
        self._pixels = [np.zeros(rho.shape, dtype=np.int32) for rho in self._rhos]
        """(n, H, W) index of the other frame's pixel, counted along its rows, at the place of a layer; arbitrary
        if there is none."""
        self._there = [np.zeros_like(rho) for rho in self._rhos]
        """(n, H, W) inverse depth of the layer there."""
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
        """Dissimilarity (H, W), 0 to 1, NaN outside the frame: half from windows around the pixels, which
        distinguish layers, and half from single pixels, which show the side of a border."""
        seen = resample(greys[1 - frame], places)
        levels = np.abs(seen - greys[frame]) / np.float32(self._options.full_levels)
        unlike = np.float32(0.5) * comparer.compared(seen) + np.float32(0.25) * np.minimum(levels, np.float32(1.0))
        return np.where(np.isnan(places[..., 0]), np.float32(np.nan), unlike)

    def across(self, frame: int) -> NDArray[np.bool_]:
        """(H, W) whether parallax moves a pixel more along its row than along its column."""
        near, far = (self._landed(frame, self._rhos[frame][k])[0] for k in (-1, 0))
        direction = np.abs(near - far)
        return ~(direction[..., 1] > direction[..., 0])

    def places(self, labels: Labels) -> F32:
        """(H, W, 2) places in frame 1, px, of the pixels of frame 0 on their layers (H, W)."""
        return self._landed(0, np.take_along_axis(self._rhos[0], labels[None], axis=0)[0])[0]

    def smoothed(self, costs: list[F32]) -> tuple[Labels, Labels]:
        """Layers with the least sum of the costs (n, H, W) and of the penalty on changes, for both frames."""
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
    """Index (H, W), counted along the rows, of the pixel nearest to each place (H, W, 2); 0 for NaN."""
    height, width = places.shape[:2]
    known = np.where(np.isnan(places), np.float32(0.0), places)
    x, y = (np.clip(np.rint(known[..., k]).astype(np.int32), 0, most - 1) for k, most in ((0, width), (1, height)))
    return np.asarray(y * np.int32(width) + x, dtype=np.int32)


FEWEST = 5
"""Fewest matches of a layer."""
_ROUNDS = 30


@dataclass(frozen=True, kw_only=True)
class PlaneOptions:
    """Options of the number of layers."""

    most: int = 24
    """Largest number of layers, in addition to that at infinity."""
    thickness_px: float = 0.25
    """Layers are split until the parallax of their matches over a frame period scatters by no more than this, px
    (root mean square)."""

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
    """(m,) inverse depths in the camera before it moves, of matches (m, 4); 0 if their rays do not meet in front
    of it."""
    rig, shutter, side, motion = camera
    pixels = matches[:, :2]
    depth, _ = flow_depth(pixels, matches[:, 2:] - pixels, rig, shutter, motion, side, 0)
    near = np.isfinite(depth)
    pose = rig.cam_from_world(motion, shutter.pixel_time(pixels, 0, side), side)
    points = transform(inverse(pose), np.where(near, depth, 1.0)[:, None] * rig.sensor(side).unproject(pixels))
    ahead = near & (points[:, 2] > 0.0)
    return np.where(ahead, 1.0 / np.where(ahead, points[:, 2], 1.0), 0.0)


def grouped(values: FloatArray, options: PlaneOptions) -> FloatArray:
    """Centres, ascending, of groups of values (n,), px: the widest group is split until all are narrow enough.

    Medians instead of means are used to tolerate outliers. Groups of a few outliers, and groups that a layer at
    infinity includes within its width, are left out.
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
    """Centres that are the medians of the values nearest to them (Lloyd's iteration)."""
    for _ in range(_ROUNDS):
        offsets = _offsets(values, centres)
        moved = centres + [float(np.median(own)) if own.size else 0.0 for own in offsets]
        if np.array_equal(moved, centres):
            break
        centres = moved
    return centres


_GRID = 4
"""Distance between two tracked pixels, px."""
_TOGETHER = 9.0
"""Number of tracked pixels with equal errors: flow is estimated for patches of 8 px, and is smooth over larger
distances."""
_AROUND = np.ones((7, 7), np.uint8)
"""Radius, px, around a tracked pixel that must show its layer."""
_LEAST_NOISE_PX = 0.02
_MAD = 1.4826
"""Standard deviations in a median absolute deviation of normal errors."""
_LEAST_DEPTH = 1e-6
_STEPS = 30


class Followed(NamedTuple):
    """Matches on layers, all with the same accuracy."""

    matches: FloatArray
    """(n, 4) x0, y0, x1, y1 px."""
    layer: NDArray[np.int64]
    """(n,) number of the plane."""
    together: float = 1.0
    """Number of them with equal errors, which together count as one."""


def on_layers(matches: FloatArray, labelled: Labelled) -> Followed:
    """Those of the matches (n, 4) whose pixel in frame 0 lies within a layer that frame 1 sees."""
    height, width = labelled.labels[0].shape
    x, y = np.clip(np.rint(matches[:, :2]).astype(np.int64), 0, (width - 1, height - 1)).T
    inner = _inner(labelled)[y, x]
    return Followed(matches[inner], labelled.labels[0][y, x][inner])


def followed(greys: tuple[F32, F32], labelled: Labelled) -> Followed:
    """Matches of a grid of pixels of frame 0: the place by the layer of each, plus the remaining flow.

    Grey frames (H, W) are compared after they were aligned by the layers, so the flow is short and crosses no
    edge.
    """
    places, labels, seen = labelled.places, labelled.labels[0], labelled.seen[0]
    aligned = np.where(seen, resample(greys[1], places), greys[0])
    first, second = (np.clip(np.rint(grey), 0, 255).astype(np.uint8) for grey in (greys[0], aligned))
    left = dense_flow(first, second)
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
    """Ends of matches (n, 4) on planes (n, 3), one each; both ends at the times of their rows."""
    rig, shutter, side, motion = camera
    halves = matches[:, :2], matches[:, 2:]
    first, second = (rig.cam_from_world(motion, shutter.pixel_time(halves[f], f, side), side) for f in FRAMES)
    rays = rig.sensor(side).unproject(halves[0])
    rho = np.sum(planes_seen(planes[:, None], first)[:, 0] * rays, axis=-1)
    R, T = compose(second, inverse(first))
    point = (R @ rays[..., None])[..., 0] + rho[:, None] * T
    point[:, 2] = np.maximum(point[:, 2], _LEAST_DEPTH)
    focal = np.array([rig.sensor(side).fx, rig.sensor(side).fy])
    slope = focal * (T[:, :2] - point[:, :2] / point[:, 2:] * T[:, 2:]) / point[:, 2:]
    return _Ends(rig.sensor(side).project(point) - halves[1], slope)


def _split(ends: _Ends) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (n,) px across and along the epipolar curves, and the lengths (n,) of their slopes."""
    length = np.linalg.norm(ends.slope, axis=-1)
    direction = ends.slope / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    across = ends.off[:, 0] * direction[:, 1] - ends.off[:, 1] * direction[:, 0]
    return across, np.sum(ends.off * direction, axis=-1), length


class _Weights(NamedTuple):
    """Divisors (n,) px of the errors of matches."""

    across: FloatArray
    along: FloatArray


def _weights(given: Followed, camera: MovingCamera, planes: FloatArray) -> _Weights:
    """Weights by the errors of the matches at this motion and these planes."""
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
