"""Point correspondences of a stereo rig over two frames, the input of solvers, and joining them to tracks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import arguments
from rsbench.core.camera import PinholeCamera, inverse_2x2
from rsbench.core.rig import SIDES, AlignedCamera, Side, StereoRig
from rsbench.core.so3 import FloatArray

BoolArray = NDArray[np.bool_]
JOIN_TOLERANCE_PX = 0.01
"""Two ends are the same keypoint if neither coordinate differs by more. The value is above rounding errors of
float32 and printed numbers, and below the noise of keypoints and the distance between two of them."""
BEYOND_PX = float(np.nextafter(JOIN_TOLERANCE_PX, 1.0))
_TRACK_HALF: dict[Side, list[int]] = {"left": [0, 1, 4, 5], "right": [2, 3, 6, 7]}
SET_COLUMNS = {"left": 4, "right": 4, "stereo_0": 4, "stereo_1": 4, "tracks": 8, "lines": 16}
"""Number of values per match in each set: pixel coordinates."""


def _none(columns: int) -> FloatArray:
    return np.zeros((0, columns))


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """Matches in pixels of the (distorted) images, one per row; missing sets are empty.

    A point may be in several sets: ``tracks`` are seen in all four images, and their halves may also be in the
    sets of pairs, where they are identified with ``JOIN_TOLERANCE_PX``. The order of matches has no meaning.
    """

    left: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) x0, y0, x1, y1: left image, frame 0 to frame 1 (the paper's I1-I3)."""
    right: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) x0, y0, x1, y1: right image, frame 0 to frame 1 (the paper's I2-I4)."""
    stereo_0: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) xl, yl, xr, yr: left to right in frame 0."""
    stereo_1: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) xl, yl, xr, yr: left to right in frame 1."""
    tracks: FloatArray = field(default_factory=lambda: _none(8))
    """(n, 8) xl0, yl0, xr0, yr0, xl1, yl1, xr1, yr1: one point in all four images."""
    covariance: FloatArray = field(default_factory=lambda: _none(3))
    """(n, 3) xx, xy, yy, px^2, of each row of ``tracks``: covariance of the alignment of its ends, as predicted
    from the images, up to a common scale. Empty if unknown."""
    lines: FloatArray = field(default_factory=lambda: _none(16))
    """(n, 16) two ends xa, ya, xb, yb in left 0, right 0, left 1, right 1: one straight line in all four images.
    Ends in different images need not be the same points."""
    affine: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) dx1/dx0, dx1/dy0, dy1/dx0, dy1/dy0: the affine frame of each row of ``left``, the map, to first
    order, of the pixels around a point from frame 0 to frame 1 of the (rolling-shutter) images. Empty if
    unknown."""
    gyro: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) tau, w: samples of a gyroscope, dR/dtau = [w]x R, rad per period."""

    gravity: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) tau, g: direction of gravity at that time, in the body's axes at that time; of any length."""

    def __post_init__(self) -> None:
        for name, columns in {**SET_COLUMNS, "affine": 4, "gyro": 4, "gravity": 4, "covariance": 3}.items():
            object.__setattr__(self, name, _matches(getattr(self, name), name, columns))
        for name, matches in (("affine", "left"), ("covariance", "tracks")):
            rows, count = len(getattr(self, name)), len(getattr(self, matches))
            if rows not in (0, count):
                raise ValueError(f"{name} has {rows} rows and {matches} {count}: one each, or none")
        flat = np.flatnonzero(~np.any(self.gravity[:, 1:], axis=1))
        if len(flat):
            raise ValueError(f"gravity[{flat[0]}] has no direction: gx, gy, gz are 0")


def _matches(value: ArrayLike, name: str, columns: int) -> FloatArray:
    rows = arguments.real_array(name, value)
    if rows.size == 0:
        return _none(columns)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name} must have {columns} numbers per match, got shape {rows.shape}")
    bad = np.flatnonzero(~np.all(np.abs(rows) <= arguments.LARGEST, axis=1))
    if len(bad):
        raise ValueError(f"{name}[{bad[0]}] must be finite numbers, got {rows[bad[0]].tolist()}")
    rows.setflags(write=False)
    return rows


SET_SIDES: dict[str, tuple[Side, ...]] = {
    "left": ("left", "left"),
    "right": ("right", "right"),
    "stereo_0": ("left", "right"),
    "stereo_1": ("left", "right"),
    "tracks": ("left", "right", "left", "right"),
    "lines": ("left", "left", "right", "right", "left", "left", "right", "right"),
}
"""The camera of each pixel of a match, in order, by set."""


def without_lens(correspondences: Correspondences, rig: StereoRig) -> Correspondences:
    """Convert the matches to ideal pixels, those of the rectified pair ``rig.ideal``.

    Raises:
        ValueError: a match, which the message names, lies at a pixel for which the lens has no ray.
    """
    if rig.rectified:
        return correspondences
    sets = {}
    for name, sides in SET_SIDES.items():
        rows: FloatArray = getattr(correspondences, name)
        ends = rows.reshape(-1, len(sides), 2).copy()
        for side in SIDES:
            own = [k for k, each in enumerate(sides) if each == side]
            ends[:, own] = rig.eye(side).ideal_pixels(ends[:, own])
        sets[name] = ends.reshape(rows.shape)
        lost = np.flatnonzero(np.any(np.isnan(sets[name]), axis=1))
        if len(lost):
            raise ValueError(f"{name}[{lost[0]}] = {rows[lost[0]].tolist()}: the lens shows no ray at this pixel")
    left, c = rig.eye("left"), correspondences
    covariance = _turned(c.covariance, left.ideal_by_pixel(c.tracks[:, :2]))
    return replace(c, **sets, affine=_ideal_affine(c.affine, c.left, left), covariance=covariance)


def lens_affine(affine: FloatArray, left: FloatArray, camera: PinholeCamera | AlignedCamera) -> FloatArray:
    """Convert affine frames (n, 4) from ideal pixels to pixels of the image; empty input stays empty.

    Args:
        left: (n, 4) the matches, in pixels of the image.
    """
    if len(affine) == 0:
        return affine
    by_0, by_1 = (camera.ideal_by_pixel(left[:, k : k + 2]) for k in (0, 2))
    return (inverse_2x2(by_1) @ affine.reshape(-1, 2, 2) @ by_0).reshape(-1, 4)


def lens_covariance(
    covariance: FloatArray, tracks: FloatArray, camera: PinholeCamera | AlignedCamera
) -> FloatArray:
    """Convert covariances (n, 3) from ideal pixels to pixels of the left image; empty input stays empty.

    Args:
        tracks: (n, 8) the tracks, in pixels of the images.
    """
    return _turned(covariance, inverse_2x2(camera.ideal_by_pixel(tracks[:, :2])))


def _turned(covariance: FloatArray, J: FloatArray) -> FloatArray:
    """Propagate covariances (n, 3) through linear maps (n, 2, 2)."""
    if len(covariance) == 0:
        return covariance
    full = J @ covariance[:, [0, 1, 1, 2]].reshape(-1, 2, 2) @ np.swapaxes(J, 1, 2)
    return full.reshape(-1, 4)[:, [0, 1, 3]]


def _ideal_affine(affine: FloatArray, left: FloatArray, camera: PinholeCamera | AlignedCamera) -> FloatArray:
    """Convert affine frames from pixels of the image to ideal pixels, the inverse of ``lens_affine``."""
    if len(affine) == 0:
        return affine
    by_0, by_1 = (camera.ideal_by_pixel(left[:, k : k + 2]) for k in (0, 2))
    return (by_1 @ affine.reshape(-1, 2, 2) @ inverse_2x2(by_0)).reshape(-1, 4)


def track_pairs(tracks: FloatArray, side: Side) -> FloatArray:
    """Return the matches over time (n, 4) of one camera that are part of tracks (n, 8)."""
    return tracks[:, _TRACK_HALF[side]]


def unlinked_pairs(correspondences: Correspondences, side: Side) -> BoolArray:
    """Return a mask of the left or right matches that are not part of a track, which has more information."""
    return ~repeated(getattr(correspondences, side), track_pairs(correspondences.tracks, side))


def temporal_pairs(correspondences: Correspondences, side: Side) -> FloatArray:
    """Return all matches over time (n, 4) of one camera, each once: those of tracks, then those in no track."""
    own: FloatArray = getattr(correspondences, side)
    rest = own[unlinked_pairs(correspondences, side)]
    return np.concatenate([track_pairs(correspondences.tracks, side), rest])


def repeated(rows: FloatArray, others: FloatArray) -> BoolArray:
    """Return a mask (n,) of the rows (n, c) that are also in ``others`` (m, c), within ``JOIN_TOLERANCE_PX``."""
    return np.isfinite(nearest_within(rows, others)[0][:, 0])


def nearest_within(points: FloatArray, others: FloatArray, count: int = 1) -> tuple[FloatArray, NDArray[np.int64]]:
    """Find, for points (n, c), the nearest of ``others`` (m, c) within ``JOIN_TOLERANCE_PX`` in every coordinate.

    SciPy's trees could do this, but loading them takes longer than a solve.

    Returns:
        Distances (n, count), the largest difference of a coordinate, in increasing order, infinite if there is no
        further neighbour; and indices (n, count), the lowest first for equal distances, 0 if there is none.
    """
    by_first = np.argsort(others[:, 0], kind="stable")
    others = others[by_first]
    begin, end = (
        np.searchsorted(others[:, 0], points[:, 0] + sign * 2.0 * JOIN_TOLERANCE_PX, side)
        for sign, side in ((-1.0, "left"), (1.0, "right"))
    )
    found = [(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
    for step in range(int(np.max(end - begin, initial=0))):
        point = np.nonzero(begin + step < end)[0]
        other = begin[point] + step
        apart = np.abs(points[point] - others[other]).max(axis=1)
        near = apart < BEYOND_PX
        found.append((apart[near], point[near], by_first[other[near]]))
    apart, point, other = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((other, apart, point))
    apart, point, other = apart[order], point[order], other[order]
    place = np.arange(len(point)) - np.searchsorted(point, point)
    kept = place < count
    distance, index = np.full((len(points), count), np.inf), np.zeros((len(points), count), dtype=np.int64)
    distance[point[kept], place[kept]], index[point[kept], place[kept]] = apart[kept], other[kept]
    return distance, index


_STEREO_HALF = {"stereo_0": slice(0, 4), "stereo_1": slice(4, 8)}
_RIVALS = 8
"""Largest number of left-right matches at one point that are considered, the nearest first."""
_SAME_PX = 0.1 * JOIN_TOLERANCE_PX
"""Distances and coordinates are rounded to this unit before candidates are compared, px."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """The result of ``join_stereo``."""

    correspondences: Correspondences
    """The given sets, with joined tracks after the given ones."""
    alone: dict[str, int]
    """Number of matches in ``stereo_0`` and ``stereo_1`` that are not part of a track."""

    @property
    def note(self) -> str:
        """One-line message about left-right matches that are not part of a track; empty if there are none."""
        sets = {name: len(getattr(self.correspondences, name)) for name in self.alone}
        parts = [f"{self.alone[name]} of {sets[name]} {name}" for name in sets if self.alone[name]]
        return f"{' and '.join(parts)} matches join no match over time: they were not used" if parts else ""


def join_stereo(correspondences: Correspondences) -> Joined:
    """Make tracks from matches over time that have a left-right match at both ends.

    Ends are the same keypoint if neither coordinate differs by more than ``JOIN_TOLERANCE_PX``. A match is part of
    at most one track. The nearest candidates are joined first, independent of the order of the input; left matches
    are joined before right ones. A track consists of the ends of its match over time and, for the other camera,
    those of its left-right matches.
    """
    c = correspondences
    for side in SIDES:
        if len(c.stereo_0) and len(c.stereo_1):
            joined = _joined_tracks(c, side)
            known = c.covariance if len(joined) == 0 else _none(3)  # those of joined tracks are not known
            c = replace(c, tracks=np.concatenate([c.tracks, joined]), covariance=known)
    alone = {
        name: int(np.count_nonzero(~repeated(getattr(c, name), c.tracks[:, half])))
        for name, half in _STEREO_HALF.items()
    }
    return Joined(correspondences=c, alone=alone)


def _joined_tracks(c: Correspondences, side: Side) -> FloatArray:
    """Return tracks (k, 8) from the matches of one camera that are not in a track yet, in their order."""
    pairs: FloatArray = getattr(c, side)[unlinked_pairs(c, side)]
    stereo = []
    for name, half in _STEREO_HALF.items():
        rows: FloatArray = getattr(c, name)
        rows = rows[~repeated(rows, c.tracks[:, half])]
        stereo.append(rows if side == "left" else rows[:, [2, 3, 0, 1]])  # this camera's end first
    chosen = _assign(pairs, *stereo)
    pairs, other_0, other_1 = (
        rows[k] for rows, k in zip([pairs, stereo[0][:, 2:], stereo[1][:, 2:]], chosen.T, strict=True)
    )
    parts = [pairs[:, :2], other_0, pairs[:, 2:], other_1]
    if side == "right":
        parts = [parts[1], parts[0], parts[3], parts[2]]
    return np.concatenate(parts, axis=1)


def _assign(pairs: FloatArray, stereo_0: FloatArray, stereo_1: FloatArray) -> NDArray[np.int64]:
    """Match both ends of pairs (n, 4) with first ends of left-right matches (m, 4) of frames 0 and 1, each used
    once.

    Return the indices (k, 3) of pair, match of frame 0 and match of frame 1.
    """
    distance_0, nearest_0 = nearest_within(pairs[:, :2], stereo_0[:, :2], _RIVALS)
    distance_1, nearest_1 = nearest_within(pairs[:, 2:], stereo_1[:, :2], _RIVALS)
    distance = distance_0[:, :, None] + distance_1[:, None, :]
    pair, j, k = np.nonzero(np.isfinite(distance))
    found = np.stack([pair, nearest_0[pair, j], nearest_1[pair, k]], axis=1)
    keys = [distance[pair, j, k][:, None], pairs[found[:, 0]], stereo_0[found[:, 1]], stereo_1[found[:, 2]]]
    order = np.lexsort(np.round(np.concatenate(keys, axis=1) / _SAME_PX).T[::-1])
    used: tuple[set[int], set[int], set[int]] = (set(), set(), set())
    kept = []
    for row in found[order].tolist():
        if all(index not in taken for index, taken in zip(row, used, strict=True)):
            kept.append(row)
            for index, taken in zip(row, used, strict=True):
                taken.add(index)
    return np.array(sorted(kept), dtype=np.int64).reshape(-1, 3)


def gyro_samples(samples: ArrayLike | None) -> FloatArray | None:
    """Check gyroscope samples (n, 4) like ``Correspondences``, which may raise ValueError; None stays None."""
    return None if samples is None else Correspondences(gyro=arguments.real_array("gyro", samples)).gyro


FRAME_1: dict[Side, slice] = {"left": slice(4, 6), "right": slice(6, 8)}
"""Columns of a track with its pixel in frame 1, by camera."""


def with_depth(tracks: FloatArray) -> FloatArray:
    """Return the tracks (m, 8) among (n, 8) that have a positive disparity in frame 0."""
    return tracks[tracks[:, 0] - tracks[:, 2] > 0.0]


def stereo_points(tracks: FloatArray, rig: StereoRig) -> FloatArray:
    """Triangulate tracks (n, 8) with depth: points (n, 3), metres, in the body at their time in frame 0."""
    depth = rig.depth(tracks[:, 0] - tracks[:, 2])
    return depth[:, None] * rig.camera.unproject(tracks[:, :2]) - rig.offset("left")
