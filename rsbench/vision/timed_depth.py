"""Depth from disparities whose two ends were seen at two times, by a rig whose motion is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rsbench.core.motion import Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter

F32 = NDArray[np.float32]
_CHUNK = 1 << 16


def timed_depth(
    depth: F32, rig: StereoRig, shutter: RollingShutter, motion: Motion, side: Side, frame: int
) -> F32:
    """Depth (H, W), metres, in each line's own camera, from that which a rig at rest would mean by its disparity.

    A pixel and its disparity say where the other camera saw the point; with a lens that is on another line, read
    at another time. The depth is that at which the other camera, where it was then, sees the point in that column.
    What is unknown (0) and infinitely far (inf) stays so; a point behind either camera becomes infinitely far.
    """
    camera, sign = rig.camera, 1.0 if side == "left" else -1.0
    other: Side = "right" if side == "left" else "left"
    out = depth.copy()
    y, x = np.nonzero((depth > 0.0) & np.isfinite(depth))
    poses, axis = row_poses(rig, shutter, motion, side, frame), shutter.axis(side)
    for start in range(0, len(y), _CHUNK):
        part = slice(start, start + _CHUNK)
        pixels = np.stack([x[part], y[part]], axis=-1)
        lines = pixels[:, axis]
        rays = camera.unproject(pixels)
        ends = camera.ideal.project(rays)
        ends[:, 0] -= sign * rig.disparity(depth[y[part], x[part]])
        tau = shutter.pixel_time(camera.lens_pixels(ends), frame, other)
        # Beyond what the lens shows there is no time: as if it were read with the pixel itself.
        tau = np.where(np.isnan(tau), shutter.pixel_time(pixels, frame, side), tau)
        R, t = compose(rig.cam_from_world(motion, tau, other), inverse(Pose(poses.R[lines], poses.t[lines])))
        column = camera.ideal.unproject(ends)[:, 0]
        turned = (R @ rays[..., None])[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (column * t[:, 2] - t[:, 0]) / (turned[:, 0] - column * turned[:, 2])
        ahead = np.isfinite(z) & (z > 0.0) & (turned[:, 2] * z + t[:, 2] > 0.0)
        out[y[part], x[part]] = np.where(ahead, z, np.inf)
    return out
