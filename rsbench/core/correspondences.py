"""What solvers are given: point correspondences of a stereo rig over two frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import given
from rsbench.core.camera import PinholeCamera
from rsbench.core.lens import inverse_2x2
from rsbench.core.rig import Side
from rsbench.core.so3 import FloatArray

BoolArray = NDArray[np.bool_]
JOIN_TOLERANCE_PX = 0.01
"""Two ends are one point when neither coordinate differs by more: above the rounding of float32 and of printed
numbers, below the noise of keypoints and the distance between two of them."""
BEYOND_PX = float(np.nextafter(JOIN_TOLERANCE_PX, 1.0))

_TRACK_HALF: dict[Side, list[int]] = {"left": [0, 1, 4, 5], "right": [2, 3, 6, 7]}
SET_COLUMNS = {"left": 4, "right": 4, "stereo_0": 4, "stereo_1": 4, "tracks": 8, "lines": 16}
"""The sets of matches, and how many numbers a match of each has: pixels, two and two."""


def _none(columns: int) -> FloatArray:
    return np.zeros((0, columns))


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """Matches in pixels of the images, distorted as they are, one row each; sets that do not exist are empty.

    The sets may hold the same points: ``tracks`` are seen in all four images, and their halves may be
    repeated in the pairwise sets, where ``JOIN_TOLERANCE_PX`` tells them. The order of matches means nothing.
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
    lines: FloatArray = field(default_factory=lambda: _none(16))
    """(n, 16) two ends xa, ya, xb, yb in left 0, right 0, left 1, right 1: one straight line in all four images.
    The ends of one image are no points of another: the line alone is the same."""
    affine: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) dx1/dx0, dx1/dy0, dy1/dx0, dy1/dy0: the affine frame of each row of ``left``, how the pixels around a
    point of frame 0 lie in frame 1, to first order; of the images as they are, which a rolling shutter has
    distorted. Empty where it is not known."""
    gyro: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) tau, w: what a gyroscope says of the rotation between the rows, dR/dtau = [w]x R, rad per period."""

    gravity: FloatArray = field(default_factory=lambda: _none(4))
    """(n, 4) tau, g: which way things fall at that time, in the axes of the body as it is then; of any length."""

    def __post_init__(self) -> None:
        for name, columns in SET_COLUMNS.items():
            object.__setattr__(self, name, _matches(getattr(self, name), name, columns))
        for name in ("affine", "gyro", "gravity"):
            object.__setattr__(self, name, _matches(getattr(self, name), name, 4))
        if len(self.affine) not in (0, len(self.left)):
            raise ValueError(f"affine has {len(self.affine)} rows and left {len(self.left)}: one each, or none")
        flat = np.flatnonzero(~np.any(self.gravity[:, 1:], axis=1))
        if len(flat):
            raise ValueError(f"gravity[{flat[0]}] has no direction: gx, gy, gz are 0")


def _matches(value: ArrayLike, name: str, columns: int) -> FloatArray:
    rows = given.real_array(name, value)
    if rows.size == 0:
        return _none(columns)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name} must have {columns} numbers per match, got shape {rows.shape}")
    bad = np.flatnonzero(~np.all(np.abs(rows) <= given.LARGEST, axis=1))
    if len(bad):
        raise ValueError(f"{name}[{bad[0]}] must be finite numbers, got {rows[bad[0]].tolist()}")
    rows.setflags(write=False)
    return rows


def without_lens(correspondences: Correspondences, camera: PinholeCamera) -> Correspondences:
    """The matches as the camera without its lens has them, in ideal pixels.

    Raises:
        ValueError: a match at which the lens shows no ray; names it.
    """
    if camera.lens is None:
        return correspondences
    sets = {}
    for name, columns in SET_COLUMNS.items():
        rows: FloatArray = getattr(correspondences, name)
        sets[name] = camera.ideal_pixels(rows.reshape(-1, columns // 2, 2)).reshape(rows.shape)
        lost = np.flatnonzero(np.any(np.isnan(sets[name]), axis=1))
        if len(lost):
            raise ValueError(f"{name}[{lost[0]}] = {rows[lost[0]].tolist()}: the lens shows no ray at this pixel")
    return replace(correspondences, **sets, affine=_ideal_affine(correspondences, camera))


def lens_affine(affine: FloatArray, left: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Affine frames (n, 4) of pixels of the image from those of ideal pixels; none of none.

    Args:
        left: (n, 4) the matches, in pixels of the image.
    """
    if len(affine) == 0:
        return affine
    by_0, by_1 = _ideal_by_pixels(left, camera)
    return (inverse_2x2(by_1) @ affine.reshape(-1, 2, 2) @ by_0).reshape(-1, 4)


def _ideal_affine(correspondences: Correspondences, camera: PinholeCamera) -> FloatArray:
    """The inverse of ``lens_affine``."""
    if len(correspondences.affine) == 0:
        return correspondences.affine
    by_0, by_1 = _ideal_by_pixels(correspondences.left, camera)
    return (by_1 @ correspondences.affine.reshape(-1, 2, 2) @ inverse_2x2(by_0)).reshape(-1, 4)


def _ideal_by_pixels(left: FloatArray, camera: PinholeCamera) -> tuple[FloatArray, FloatArray]:
    return camera.ideal_by_pixel(left[:, :2]), camera.ideal_by_pixel(left[:, 2:])


def track_pairs(tracks: FloatArray, side: Side) -> FloatArray:
    """The matches over time (n, 4) of one camera in tracks (n, 8)."""
    return tracks[:, _TRACK_HALF[side]]


def unlinked_pairs(correspondences: Correspondences, side: Side) -> BoolArray:
    """Mask of the left or right matches that no track repeats: the tracks know more about those that it does."""
    return ~repeated(getattr(correspondences, side), track_pairs(correspondences.tracks, side))


def temporal_pairs(correspondences: Correspondences, side: Side) -> FloatArray:
    """All matches over time (n, 4) of one camera: its own, and the halves of tracks that they do not repeat."""
    own: FloatArray = getattr(correspondences, side)
    rest = own[unlinked_pairs(correspondences, side)]
    return np.concatenate([track_pairs(correspondences.tracks, side), rest])


def repeated(rows: FloatArray, others: FloatArray) -> BoolArray:
    """Mask (n,) of the matches (n, c) that are also among ``others`` (m, c), within ``JOIN_TOLERANCE_PX``."""
    if len(rows) == 0 or len(others) == 0:
        return np.zeros(len(rows), dtype=np.bool_)
    from scipy.spatial import cKDTree  # takes as long to load as all else that a solver needs

    distance, _ = cKDTree(others).query(rows, p=np.inf, distance_upper_bound=BEYOND_PX)
    return np.isfinite(distance)
