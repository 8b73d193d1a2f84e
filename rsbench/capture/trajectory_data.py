"""The matches of a sequence as rays with times: tracks over two frames or more, of both cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.trajectory_gyro import GyroSteps
from rsbench.capture.trajectory_kernels import END
from rsbench.core.correspondences import BEYOND_PX, BoolArray, Correspondences, unlinked_pairs
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

IntArray = NDArray[np.int64]
ENOUGH = 400
"""Tracks of a window from which on its pairs say little more, and take longer than all else."""
LONGEST = 5
"""Frames of a track: more would couple more control poses for little."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Past:
    """What matches that are gone say of the first control poses of a spline: a quadratic cost."""

    R: FloatArray
    """(k, 3, 3) the control poses about which it is known."""
    p: FloatArray
    """(k, 3)."""
    gradient: FloatArray
    """(6 k,), and where there is a gyroscope more, of its errors."""
    H: FloatArray
    """(6 k, 6 k), likewise."""
    errors: FloatArray | None = None
    """(m,) of the gyroscope, about which it is known."""

    def without_gyro(self) -> Past:
        """The same of the control poses alone, whatever the errors of a gyroscope are."""
        if self.errors is None:
            return self
        k = 6 * len(self.p)
        solved = np.linalg.solve(self.H[k:, k:], np.column_stack([self.H[k:, :k], self.gradient[k:]]))
        H = self.H[:k, :k] - self.H[:k, k:] @ solved[:, :-1]
        gradient = self.gradient[:k] - self.H[:k, k:] @ solved[:, -1]
        return Past(R=self.R, p=self.p, gradient=gradient, H=0.5 * (H + H.T))


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedTracks:
    """Tracks, as ``trajectory_kernels.add_tracks`` takes them."""

    ends: FloatArray
    """(e, 10)."""
    starts: IntArray
    """(n + 1,) first end of each track, and e."""
    members: tuple[IntArray, ...]
    """For each window, the track (m,) of each of its tracks, left pairs and right pairs that no track repeats."""
    focal: FloatArray
    """(2,) fx, fy, px."""
    past: Past | None = None
    """Of the tracks of earlier windows; None: the spline begins here, and the pose at time 0 is the world's."""
    share: float = 1.0
    """What a track counts beside the prior: less than 1 where errors of neighbouring tracks are alike."""
    gyro: GyroSteps | None = None
    """What a gyroscope says of the times that the spline lasts; None: there is none."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def freedom(self) -> FloatArray:
        """(n,) degrees of freedom of each track's error."""
        return 2.0 * np.diff(self.starts) - 3.0

    @property
    def span(self) -> tuple[FloatArray, FloatArray]:
        """Times (n,) of the earliest and the latest end of each track."""
        taus = self.ends[:, 2]
        return np.minimum.reduceat(taus, self.starts[:-1]), np.maximum.reduceat(taus, self.starts[:-1])


def thinned(windows: Sequence[Correspondences], count: int) -> list[Correspondences]:
    """About so many tracks of each window, and no pairs where there are as many as that; of one camera, pairs."""
    if is_of_one_camera(windows):
        return [Correspondences(left=each.left[:: max(len(each.left) // count, 1)]) for each in windows]
    few = [Correspondences(tracks=each.tracks[:: max(len(each.tracks) // count, 1)]) for each in windows]
    return [some if len(some.tracks) >= count else each for some, each in zip(few, windows, strict=True)]


def is_of_one_camera(windows: Sequence[Correspondences]) -> bool:
    """Whether there are matches of the left camera alone."""
    return not any(len(each.tracks) or len(each.right) for each in windows)


def telling(window: Correspondences) -> Correspondences:
    """What is looked at of a window: its tracks alone, where there are enough."""
    return Correspondences(tracks=window.tracks) if len(window.tracks) >= ENOUGH else window


def pack_windows(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    right: Sequence[FloatArray] | None = None,
    first: int = 0,
    past: Past | None = None,
    share: float = 1.0,
) -> TimedTracks:
    """The tracks of windows, and their pairs that no track repeats; window k is of the frames k and k + 1.

    Args:
        right: for each window, which of its members (m,) are right (not 0): of those, ones that meet in a frame
            are one track; None: none is linked to another.
        first: number of the first window.
        past: of those before.
        share: what a track counts beside the prior.
    """
    members = [np.zeros(0, dtype=np.int64) for _ in windows]
    ends, owners = list[FloatArray](), list[IntArray]()
    count = offset = 0
    for sides in (SIDES, SIDES[:1], SIDES[1:]):
        pixels = [_pixels(window, sides) for window in windows]
        known = [_known(right, k, len(members[k]), len(rows)) for k, rows in enumerate(pixels)]
        numbers, count = _numbered(pixels, known, offset)
        for k, own in enumerate(numbers):
            new = own >= 0 if k == 0 else ~np.isin(own, numbers[k - 1])
            for frame, chosen in ((0, new), (1, np.ones(len(own), dtype=np.bool_))):
                for i, side in enumerate(sides):
                    place = 2 * (frame * len(sides) + i)
                    ends.append(
                        pack_ends(pixels[k][chosen, place : place + 2], first + k + frame, side, rig, shutter)
                    )
                    owners.append(own[chosen])
            members[k] = np.concatenate([members[k], own])
        offset = count
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return TimedTracks(
        ends=np.ascontiguousarray(np.concatenate(ends)[order]),
        starts=np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))]).astype(np.int64),
        members=tuple(members),
        focal=np.array([rig.camera.fx, rig.camera.fy]),
        past=past,
        share=share,
    )


def _known(right: Sequence[FloatArray] | None, window: int, first: int, count: int) -> BoolArray:
    return np.zeros(count, dtype=np.bool_) if right is None else right[window][first : first + count] != 0.0


def _pixels(window: Correspondences, sides: Sequence[Side]) -> FloatArray:
    """Tracks (n, 8), or pairs (n, 4) that no track repeats."""
    if len(sides) == 2:
        return window.tracks
    pairs: FloatArray = getattr(window, sides[0])
    return pairs[unlinked_pairs(window, sides[0])]


def _numbered(pixels: Sequence[FloatArray], right: Sequence[BoolArray], first: int) -> tuple[list[IntArray], int]:
    """Numbers (n,) of the tracks that the rows of each window belong to, from ``first`` on, and the next number.

    A row that is right goes on with such a track of the window before that ends where it begins, if that has fewer
    than ``LONGEST`` frames.
    """
    out, count = list[IntArray](), first
    numbers, lengths, ends = (
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        pixels[0][:0, : pixels[0].shape[1] // 2],
    )
    for rows, known in zip(pixels, right, strict=True):
        half = rows.shape[1] // 2
        open_ = np.flatnonzero(lengths < LONGEST)
        met = _met(rows[:, :half], ends[open_], known)
        goes_on = met >= 0
        own, length = np.zeros(len(rows), dtype=np.int64), np.full(len(rows), 2, dtype=np.int64)
        before = open_[met[goes_on]]
        own[goes_on], length[goes_on] = numbers[before], lengths[before] + 1
        fresh = len(rows) - len(before)
        own[~goes_on] = count + np.arange(fresh)
        count += fresh
        out.append(own)
        numbers, lengths, ends = own[known], length[known], rows[known, half:]
    return out, count


def _met(begins: FloatArray, ends: FloatArray, known: BoolArray) -> IntArray:
    """For each place (n, c) the nearest of others (m, c) within the tolerance, each once; -1 for none."""
    out = -np.ones(len(begins), dtype=np.int64)
    if len(begins) == 0 or len(ends) == 0:
        return out
    from scipy.spatial import cKDTree  # takes as long to load as all else that a solver needs

    found = cKDTree(ends).query(begins, p=np.inf, distance_upper_bound=BEYOND_PX)
    distance, nearest = np.asarray(found[0]), np.asarray(found[1])
    order = np.argsort(distance, kind="stable")
    order = order[np.isfinite(distance[order]) & known[order]]
    _, firsts = np.unique(nearest[order], return_index=True)
    out[order[firsts]] = nearest[order[firsts]]
    return out


def pack_ends(pixels: FloatArray, frame: int, side: Side, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Ends (n, 10) of pixels (n, 2) of one image."""
    out = np.zeros((len(pixels), END))
    out[:, :2], out[:, 2] = rig.camera.unproject(pixels)[:, :2], shutter.pixel_time(pixels, frame, side)
    out[:, 3:7], out[:, 7:9] = rig.camera.ideal_by_pixel(pixels).reshape(-1, 4), shutter.rate(side)
    out[:, 9] = rig.offset(side)[0]
    return out
