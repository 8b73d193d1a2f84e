"""Tracks from pairwise matches: a match over time whose two ends are also ends of left-right matches."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import BEYOND_PX, JOIN_TOLERANCE_PX, Correspondences, repeated, unlinked_pairs
from rsbench.core.rig import SIDES, Side
from rsbench.core.so3 import FloatArray

_STEREO_HALF = {"stereo_0": slice(0, 4), "stereo_1": slice(4, 8)}
_RIVALS = 8
"""Left-right matches that may end at one point, beyond which the farthest are not looked at."""
_SAME_PX = 0.1 * JOIN_TOLERANCE_PX
"""Differences that decide between rivals; smaller ones are rounding, which shall decide nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Joined:
    """What ``join_stereo`` made."""

    correspondences: Correspondences
    """As given, with the tracks that were joined after those that were given."""
    alone: dict[str, int]
    """How many matches in ``stereo_0`` and ``stereo_1`` are part of no track."""

    @property
    def note(self) -> str:
        """One line about the left-right matches that are part of no track; empty when there are none."""
        sets = {name: len(getattr(self.correspondences, name)) for name in self.alone}
        parts = [f"{self.alone[name]} of {sets[name]} {name}" for name in sets if self.alone[name]]
        return f"{' and '.join(parts)} matches join no match over time: they were not used" if parts else ""


def join_stereo(correspondences: Correspondences) -> Joined:
    """Make tracks of the matches over time that have a left-right match at both ends.

    Ends are one point when neither coordinate differs by more than ``JOIN_TOLERANCE_PX``. A match is part of at
    most one track; of rivals the nearest join, whatever their order. The left matches' turn comes first, then that
    of the right ones. A track has the ends of its match over time as they are, and the other camera's ends of
    its left-right matches.
    """
    c = correspondences
    for side in SIDES:
        if len(c.stereo_0) and len(c.stereo_1):
            c = replace(c, tracks=np.concatenate([c.tracks, _joined_tracks(c, side)]))
    alone = {
        name: int(np.count_nonzero(~repeated(getattr(c, name), c.tracks[:, half])))
        for name, half in _STEREO_HALF.items()
    }
    return Joined(correspondences=c, alone=alone)


def _joined_tracks(c: Correspondences, side: Side) -> FloatArray:
    """Tracks (k, 8) from the matches of one camera that are in no track yet, in the order of those matches."""
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
    """Indices (k, 3) of the pairs (n, 4) and of the matches (m, 4) with the same first ends, each used once."""
    if not (len(pairs) and len(stereo_0) and len(stereo_1)):
        return np.zeros((0, 3), dtype=np.int64)
    distance_0, nearest_0 = _nearest(pairs[:, :2], stereo_0[:, :2])
    distance_1, nearest_1 = _nearest(pairs[:, 2:], stereo_1[:, :2])
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


def _nearest(points: FloatArray, ends: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Distances and indices (n, k) of the ends (m, 2) within the tolerance of points (n, 2); infinite for none."""
    from scipy.spatial import cKDTree  # see ``repeated``

    rivals = np.arange(1, min(_RIVALS, len(ends)) + 1)
    distance, index = cKDTree(ends).query(points, k=rivals, p=np.inf, distance_upper_bound=BEYOND_PX)
    return np.asarray(distance), np.asarray(index, dtype=np.int64)
