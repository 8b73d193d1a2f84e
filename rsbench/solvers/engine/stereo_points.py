"""Points from the stereo pair of a frame: what absolute pose takes for a map."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import Side, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate

FRAME_1: dict[Side, slice] = {"left": slice(4, 6), "right": slice(6, 8)}
"""Columns of a track that hold its pixel in frame 1."""


def with_depth(tracks: FloatArray) -> FloatArray:
    """Tracks (m, 8) with a positive disparity in frame 0, of (n, 8)."""
    return tracks[tracks[:, 0] - tracks[:, 2] > 0.0]


def stereo_points(tracks: FloatArray, rig: StereoRig) -> FloatArray:
    """Points (n, 3), metres, of tracks (n, 8) with depth, in the body as it is when frame 0 reads their row."""
    depth = rig.depth(tracks[:, 0] - tracks[:, 2])
    return depth[:, None] * rig.camera.unproject(tracks[:, :2]) - rig.offset("left")


def propose_together(
    samples: Sequence[Correspondences],
    least: int,
    usable: Callable[[FloatArray], FloatArray],
    solve: Callable[[FloatArray], Iterable[list[MotionEstimate]]],
) -> list[list[MotionEstimate]]:
    """The motions of each sample, of all in one call of ``solve``, which takes tracks (b, least, 8).

    A sample with fewer tracks that are ``usable`` has failed.
    """
    tracks = [usable(sample.tracks)[:least] for sample in samples]
    whole = [each for each in tracks if len(each) == least]
    found = iter(solve(np.stack(whole)) if whole else ())
    few = MotionEstimate.failed(f"fewer than {least} points of a sample have positive disparity")
    return [next(found) if len(each) == least else [few] for each in tracks]
