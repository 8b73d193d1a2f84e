"""Whether images agree with a recording's cameras and poses: matches on epipolar lines, points at their pixels.

A few pairs of images are matched: of the two cameras at one time, and of one camera at successive times. A lens,
an extrinsic or a pose that is read the wrong way round moves the lines by far more than features err.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

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

Value = TypeVar("Value")
NEAR_PX = 3.0
"""Distance from line or pixel within which a match or a point agrees; features err by less than one."""
LOOKS = 4
"""Pairs of each kind, and images whose points are projected, at most; spread over the recording."""
_FEWEST = 30
_SHARE = 0.5
"""Of matches and points, that agree at least: a quarter of all matches may be wrong."""


@dataclass(frozen=True, kw_only=True)
class Sight:
    """How what is seen in images agrees with cameras and poses."""

    what: str
    count: int
    """Matches or points."""
    share: float
    """Of them, within ``NEAR_PX``."""
    typical: float
    """Median distance, px."""

    @property
    def fault(self) -> str:
        """What is wrong with it; empty for nothing, and for too little to tell."""
        if self.count < _FEWEST or self.share >= _SHARE:
            return ""
        return (
            f"{self.what}: {100 * self.share:.0f} % within {NEAR_PX:g} px of where cameras and poses say, "
            f"typically {self.typical:.1f} px off: lens, extrinsics, poses or times are wrong, or rows are not "
            "read as said"
        )


def sights(recording: Recording) -> Iterator[Sight]:
    """Of pairs of images whose poses are known, and of points that the layout says are seen."""
    for (side, frame), read in _spread(list(recording.sightings.items())):
        pixels, points = read()
        landed = recording.cameras[side].project(transform(_pose(recording, side, frame, pixels), points))
        yield _sight(f"points of {side} image {frame}", np.linalg.norm(landed - pixels, axis=-1))
    for a, b in _pairs(recording):
        try:
            pixels = _matches(recording.images[a], recording.images[b])
        except RsbenchError:  # told by the check of files
            continue
        found = _relative(recording, a, b, pixels)
        if found is not None:
            cameras = recording.cameras[a[0]], recording.cameras[b[0]]
            yield _sight(f"matches of {a[0]} {a[1]} and {b[0]} {b[1]}", epipolar_distance(found, pixels, *cameras))


def epipolar_distance(
    b_from_a: Pose, pixels: FloatArray, camera_a: PinholeCamera, camera_b: PinholeCamera
) -> FloatArray:
    """Distance (n,) of matches (n, 4) x, y in a and in b from where they may be, px of images without lenses.

    That is half an epipolar line, on which points in front of both cameras lie: the Sampson distance from it, or
    for a match on the other half the distance from its end, where points at infinity are seen.
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
    with np.errstate(invalid="ignore", divide="ignore"):  # nothing moved: no line
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
    """Images to match: across the rig, and of successive times, where there are times."""
    known = recording.images
    across = [k for side, k in known if side == "left" and ("right", k) in known]
    for k in _spread(across):
        yield ("left", k), ("right", k)
    for side in recording.poses if recording.frame_period_s is not None else ():
        for k in _spread([k for each, k in known if each == side and (side, k + 1) in known]):
            yield (side, k), (side, k + 1)


def _spread(values: list[Value]) -> list[Value]:
    """At most ``LOOKS`` of them, the first and the last too."""
    chosen = np.unique(np.linspace(0, len(values) - 1, min(LOOKS, len(values))).astype(int))
    return [values[k] for k in chosen]


def _relative(recording: Recording, a: View, b: View, pixels: FloatArray) -> Pose | None:
    """``b_from_a`` of matches, each of the times of its own rows; None where it is not known."""
    if {a[0], b[0]} <= recording.poses.keys():
        found = compose(_pose(recording, *b, pixels[:, 2:]), inverse(_pose(recording, *a, pixels[:, :2])))
        if np.all(np.isfinite(found.t)):
            return found
    return recording.right_from_left if a[1] == b[1] else None


def _pose(recording: Recording, side: Side, frame: int, pixels: FloatArray) -> Pose:
    """Of a camera when it sees pixels (n, 2); all at once where nothing is said of rows."""
    shutter = recording.shutters.get(side)
    tau = np.full(len(pixels), float(frame)) if shutter is None else shutter.pixel_time(pixels, frame, side)
    return recording.poses[side](tau)


def _matches(a: Path, b: Path) -> FloatArray:
    """(n, 4) x, y in a and in b."""
    one, two = _features(a), _features(b)
    pairs = match(one, two, Gate(dx=(-np.inf, np.inf), dy=(-np.inf, np.inf)))
    return np.concatenate([one.points[pairs[:, 0]], two.points[pairs[:, 1]]], axis=1)


@lru_cache(maxsize=4)
def _features(path: Path) -> Features:
    return detect(read_frame(path))
