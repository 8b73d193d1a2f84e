"""Consistency checks of a recording: files, sizes, depth against poses, disparities, and matches in the images.

A few image pairs are matched, of both cameras at the same time and of one camera at successive times. Matches must
lie on epipolar lines, and given 3D points must project to their pixels. A lens, extrinsic or pose in the wrong
convention moves the lines by far more than the error of features.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.epipolar import essential_matrix
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import Side, View
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.pipeline.footage import read_frame
from rsbench.vision.features import Features, Gate, detect, match

_ROWS = 30
"""Iterations to find the row of a point; each multiplies the error by readout ratio times image speed."""
_TOLERANCE = 0.01
"""Tolerance of the relative depth difference: depth is interpolated, and text has four decimals."""
_TYPICAL = 2e-3
"""Threshold of the median relative difference; wrong poses, times or depth conventions exceed it."""
_SHARE = 0.8
_LEAST_DISPARITY_SHARE = 0.9


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Agreement of the depth maps of two successive frames."""

    side: Side
    frames: tuple[int, int]
    pixels: int
    """Compared pixels: those visible in both frames."""
    share: float
    """Share of these that agree within a hundredth."""
    typical: float
    """Median of the relative differences."""

    @property
    def fault(self) -> str:
        """The fault in one sentence; empty if there is none."""
        if self.pixels == 0 or (self.share >= _SHARE and self.typical <= _TYPICAL):
            return ""
        return (
            f"depth of {self.side} frames {self.frames[0]} and {self.frames[1]} do not agree under poses and row "
            f"times: {100 * self.share:.1f} % within {100 * _TOLERANCE:g} %, typically {self.typical:.1e} apart"
        )


def file_faults(recording: Recording, progress: Callable[[str], object] = str) -> Iterator[str]:
    """Yield a fault for each image that is unreadable or differs from its camera's size; calls ``progress``."""
    for path, side in (
        *((path, side) for (side, _), path in recording.images.items()),
        *((path, side) for (side, *_), path in (*recording.truths.items(), *recording.masks.items())),
    ):
        camera = recording.cameras[side]
        progress(path.name)
        try:
            height, width = read_frame(path).shape[:2]
        except RsbenchError as error:
            yield str(error)
            continue
        if (width, height) != (camera.width, camera.height):
            yield f"{path}: is {width} x {height} pixels, its camera {camera.width} x {camera.height}"


def disparity_faults(recording: Recording) -> Iterator[str]:
    """Yield a fault for each disparity map of another size, or whose pixels map outside the other image."""
    for (side, frame), read in recording.disparities.items():
        found, camera = read(), recording.cameras[side]
        if found.shape != (camera.height, camera.width):
            yield f"disparities of {side} frame {frame} are {found.shape[1]} x {found.shape[0]} pixels"
            continue
        other = recording.cameras["right" if side == "left" else "left"]
        shift = (found - (other.cx - camera.cx)) * (1.0 if side == "left" else -1.0)
        there = (np.arange(camera.width) - shift)[np.isfinite(found)]
        inside = float(np.mean((there >= -0.5) & (there <= other.width - 0.5))) if there.size else 0.0
        if inside < _LEAST_DISPARITY_SHARE:
            yield f"disparities of {side} frame {frame}: {100 * inside:.0f} % lead into the other image"


def agreements(recording: Recording) -> Iterator[Agreement]:
    """Compare successive depth maps of each camera, where poses and row times are known."""
    for side in recording.cameras:
        frames = sorted(frame for each, frame in recording.depths if each == side)
        if side not in recording.poses or side not in recording.shutters:
            continue
        for first, second in pairwise(frames):
            yield _agreement(recording, side, first, second)


def _agreement(recording: Recording, side: Side, first: int, second: int) -> Agreement:
    camera, shutter = recording.cameras[side], recording.shutters[side]
    pose_at = recording.poses[side]
    depth, other = recording.depths[side, first](), recording.depths[side, second]()
    seen = depth > 0.0
    pixels = camera.pixel_grid()[seen]
    in_camera = depth[seen][:, None] * camera.unproject(pixels)
    world = transform(inverse(pose_at(shutter.pixel_time(pixels, first, side))), in_camera)
    landed, points = pixels, world
    for _ in range(_ROWS):
        points = transform(pose_at(shutter.pixel_time(landed, second, side)), world)
        moved = camera.project(points)
        landed = np.where(np.isfinite(moved), moved, landed)
    inside = camera.contains(landed) & (points[:, 2] > 0.0)
    there = _sampled(other, landed[inside])
    difference = (there - points[inside, 2]) / points[inside, 2]
    difference = difference[
        np.isfinite(difference) & (difference > -10.0 * _TOLERANCE)
    ]  # excludes occluded points
    sizes = np.abs(difference)
    return Agreement(
        side=side,
        frames=(first, second),
        pixels=len(sizes),
        share=float(np.mean(sizes <= _TOLERANCE)) if len(sizes) else float("nan"),
        typical=float(np.median(sizes)) if len(sizes) else float("nan"),
    )


def _sampled(depth: FloatArray, pixels: FloatArray) -> FloatArray:
    """Interpolate depth (n,) at pixels (n, 2) in 1 / z, which is exact for planes; NaN next to unknown depth."""
    with np.errstate(divide="ignore"):
        near = np.where(depth > 0.0, 1.0 / depth, np.nan)
    where = pixels.astype(np.float32)[None]
    with np.errstate(divide="ignore"):
        found = 1.0 / cv2.remap(near, where, None, cv2.INTER_LINEAR, borderValue=float("nan"))[0]
    return np.asarray(found, dtype=np.float64)


Value = TypeVar("Value")
NEAR_PX = 3.0
"""Tolerance, px, of the distance from the line or pixel; features are accurate to one pixel."""
LOOKS = 4
"""Largest number of checked pairs of each kind, and of images with given points; spread over the recording."""
_FEWEST = 30
_SIGHT_SHARE = 0.5
"""Threshold of the share of matches or points that agree; a quarter of all matches may be wrong."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """Agreement of matches or given points in images with cameras and poses."""

    what: str
    count: int
    """Number of matches or points."""
    share: float
    """Share of these within ``NEAR_PX``."""
    typical: float
    """Median distance, px."""

    @property
    def fault(self) -> str:
        """The fault in one sentence; empty if there is none, or too few matches or points."""
        if self.count < _FEWEST or self.share >= _SIGHT_SHARE:
            return ""
        return (
            f"{self.what}: {100 * self.share:.0f} % within {NEAR_PX:g} px of where cameras and poses say, "
            f"typically {self.typical:.1f} px off: lens, extrinsics, poses or times are wrong, or rows are not "
            "read as assumed"
        )


def sights(recording: Recording) -> Iterator[Sight]:
    """Check matches of image pairs with known poses, and the projections of given points."""
    for (side, frame), read in _spread(list(recording.sightings.items())):
        pixels, points = read()
        landed = recording.cameras[side].project(transform(_camera_pose(recording, side, frame, pixels), points))
        yield _sight(f"points of {side} image {frame}", np.linalg.norm(landed - pixels, axis=-1))
    for a, b in _pairs(recording):
        try:
            pixels = _matches(recording.images[a], recording.images[b])
        except RsbenchError:  # reported by ``file_faults``
            continue
        found = _relative(recording, a, b, pixels)
        if found is not None:
            cameras = recording.cameras[a[0]], recording.cameras[b[0]]
            yield _sight(f"matches of {a[0]} {a[1]} and {b[0]} {b[1]}", epipolar_distance(found, pixels, *cameras))


def epipolar_distance(
    b_from_a: Pose, pixels: FloatArray, camera_a: PinholeCamera, camera_b: PinholeCamera
) -> FloatArray:
    """Return distances (n,) of matches (n, 4), x, y in a and b, from epipolar half-lines, undistorted px.

    Points in front of both cameras project to a half-line that begins at the point at infinity. The distance is
    the Sampson distance from the line, or at least that from this end if the match lies on the other half.
    """
    x0, x1 = camera_a.unproject(pixels[:, :2]), camera_b.unproject(pixels[:, 2:])
    E = essential_matrix(b_from_a)
    focal_a, focal_b = [camera_a.fx, camera_a.fy], [camera_b.fx, camera_b.fy]
    normal = (E @ x0[..., None])[..., 0]
    lines = (np.swapaxes(E, -1, -2) @ x1[..., None])[..., :2, 0] / focal_a, normal[..., :2] / focal_b
    value = np.abs(np.sum(x1 * normal, axis=-1))
    turned = (b_from_a.R @ x0[..., None])[..., 0]
    across = so3.cross(x1, turned)
    behind = np.sum(across * so3.cross(x1, np.broadcast_to(b_from_a.t, x1.shape)), axis=-1) > 0.0
    with np.errstate(invalid="ignore", divide="ignore"):  # without a translation there is no line
        off = value / np.linalg.norm(np.concatenate(lines, axis=-1), axis=-1)
        from_end = np.linalg.norm((x1 - turned / turned[:, 2:])[:, :2] * focal_b, axis=-1)
    return np.where(behind, np.maximum(off, from_end), off)


def _sight(what: str, distances: FloatArray) -> Sight:
    known = distances[np.isfinite(distances)]
    if not len(known):
        return Sight(what=what, count=0, share=np.nan, typical=np.nan)
    near = float(np.mean(known <= NEAR_PX))
    return Sight(what=what, count=len(known), share=near, typical=float(np.median(known)))


def _pairs(recording: Recording) -> Iterator[tuple[View, View]]:
    """Yield image pairs to match: of both cameras, and of successive frames if the frame period is known."""
    known = recording.images
    across = [k for side, k in known if side == "left" and ("right", k) in known]
    for k in _spread(across):
        yield ("left", k), ("right", k)
    for side in recording.poses if recording.frame_period_s is not None else ():
        for k in _spread([k for each, k in known if each == side and (side, k + 1) in known]):
            yield (side, k), (side, k + 1)


def _spread(values: list[Value]) -> list[Value]:
    """Select at most ``LOOKS`` of the values, evenly, including the first and the last."""
    chosen = np.unique(np.linspace(0, len(values) - 1, min(LOOKS, len(values))).astype(int))
    return [values[k] for k in chosen]


def _relative(recording: Recording, a: View, b: View, pixels: FloatArray) -> Pose | None:
    """Return ``b_from_a`` of matches at the times of their rows; None if it is unknown."""
    if {a[0], b[0]} <= recording.poses.keys():
        found = compose(
            _camera_pose(recording, *b, pixels[:, 2:]), inverse(_camera_pose(recording, *a, pixels[:, :2]))
        )
        if np.all(np.isfinite(found.t)):
            return found
    return recording.right_from_left if a[1] == b[1] else None


def _camera_pose(recording: Recording, side: Side, frame: int, pixels: FloatArray) -> Pose:
    """Return the poses of a camera at the times of pixels (n, 2); the frame's pose if the shutter is unknown."""
    shutter = recording.shutters.get(side)
    tau = np.full(len(pixels), float(frame)) if shutter is None else shutter.pixel_time(pixels, frame, side)
    return recording.poses[side](tau)


def _matches(a: Path, b: Path) -> FloatArray:
    """Match two images; return (n, 4) x, y in a and in b."""
    one, two = _features(a), _features(b)
    pairs = match(one, two, Gate(dx=(-np.inf, np.inf), dy=(-np.inf, np.inf)))
    return np.concatenate([one.points[pairs[:, 0]], two.points[pairs[:, 1]]], axis=1)


@lru_cache(maxsize=4)
def _features(path: Path) -> Features:
    return detect(read_frame(path))
