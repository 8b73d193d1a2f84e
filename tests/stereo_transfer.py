"""The stereo transfer in NumPy, an independent form of the compiled track residuals."""

from __future__ import annotations

import numpy as np

from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray


def rs_stereo_transfer(
    rig: StereoRig, shutter: RollingShutter, motion: Motion, stereo_0: FloatArray, stereo_1: FloatArray
) -> FloatArray:
    """Errors (n, 3) in pixels of stereo matches (n, 3) of frame 1 against those of frame 0 moved by ``motion``.

    A stereo match is x, y, disparity in the camera halfway between both, which sees a row when they do; it holds
    all that a rectified pair says about a point, however the rows are timed. Points at infinity are allowed.
    """
    tau0, tau1 = shutter.row_time(stereo_0[:, 1], 0), shutter.row_time(stereo_1[:, 1], 1)
    R0, t0 = motion.body_from_world(tau0)
    R1, t1 = motion.body_from_world(tau1)
    R = R1 @ np.swapaxes(R0, -1, -2)
    T = t1 - np.einsum("nij,nj->ni", R, t0)
    inverse_depth = stereo_0[:, 2:] / (rig.camera.fx * rig.baseline)
    p = np.einsum("nij,nj->ni", R, rig.camera.unproject(stereo_0[:, :2])) + inverse_depth * T
    disparity = stereo_0[:, 2] / np.where(p[:, 2] > 0.0, p[:, 2], np.nan)
    return stereo_1 - np.column_stack([rig.camera.project(p), disparity])
