"""Points from the stereo pair of frame 0: what absolute pose takes for a map."""

from __future__ import annotations

from rsbench.core.rig import StereoRig
from rsbench.core.so3 import FloatArray


def with_depth(tracks: FloatArray) -> FloatArray:
    """Tracks (m, 8) with a positive disparity in frame 0, of (n, 8)."""
    return tracks[tracks[:, 0] - tracks[:, 2] > 0.0]


def stereo_points(tracks: FloatArray, rig: StereoRig) -> FloatArray:
    """Points (n, 3), metres, of tracks (n, 8) with depth, in the body as it is when frame 0 reads their row."""
    depth = rig.depth(tracks[:, 0] - tracks[:, 2])
    return depth[:, None] * rig.camera.unproject(tracks[:, :2]) - rig.offset("left")
