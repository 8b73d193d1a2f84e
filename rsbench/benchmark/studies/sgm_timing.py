"""Depth errors of semi-global matching when the two cameras do not read the same row at the same time.

The cameras of the rig have the same rotation, and the baseline is parallel to the rows. If the left camera sees a
point at (x, y) at the time of row y, the right camera projects it at that time to (x - f b / z, y), on the same
row. If the right camera reads this row at the same time, it sees the point there under any motion, so the pair is
rectified and ``disparity = f b / z`` is exact.

If the right camera reads row y' at another time, the point has moved by the image velocity u (px per frame period)
times the time difference D: to first order, ``x' = x - f b / z + u_x D`` and ``y' = y + u_y D``. For a delay of
delta frame periods, ``D = delta + h (y' - y)``, hence ``D = delta / (1 - h u_y)``. For readout from the bottom to
the top, ``D = h (H - 1 - y' - y)``, hence ``D = h (H - 1 - 2 y) / (1 + h u_y)``: zero in the middle row, and
almost the whole readout time at the upper and lower border. The disparity error is ``-u_x D``, and the
corresponding point lies ``u_y D`` rows away from the row that the matcher searches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.vision.stereo_depth import SgmOptions, stereo_disparity

DELAYS = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1)
"""Delays of the right camera, frame periods."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Times at which the right camera reads its rows."""

    delay: float = 0.0
    """Delay of the right camera, frame periods."""
    opposite: bool = False
    """Whether it reads from the bottom row to the top row."""

    @property
    def name(self) -> str:
        return "opposite" if self.opposite else f"delay-{self.delay:g}"

    def row_time(self, shutter: RollingShutter, y: FloatArray, frame: int) -> FloatArray:
        """Time (...) at which the right camera reads rows (...)."""
        rows = shutter.height - 1 - y if self.opposite else y
        return shutter.row_time(rows, frame) + self.delay

    def lag(self, shutter: RollingShutter, y: FloatArray, velocity_y: FloatArray) -> FloatArray:
        """Return the time (...) between the observations of a point by the left camera, in row y, and by the
        right camera."""
        if self.opposite:
            return (self.delay + shutter.h * (shutter.height - 1 - 2 * y)) / (1.0 + shutter.h * velocity_y)
        return self.delay / (1.0 - shutter.h * velocity_y)


TIMINGS = (*(Timing(delay=delay) for delay in DELAYS), Timing(opposite=True))


def right_row_poses(rig: StereoRig, shutter: RollingShutter, motion: Motion, timing: Timing) -> Pose:
    """``cam_from_world`` of every row of the right camera in frame 0, (height, 3, 3) and (height, 3)."""
    rows = np.arange(shutter.height, dtype=np.float64)
    return rig.cam_from_world(motion, timing.row_time(shutter, rows, 0), "right")


def predicted_shift(
    depth: NDArray[Any],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    timing: Timing,
) -> FloatArray:
    """Predict the disparity error and the vertical displacement of the corresponding point, (H, W, 2) px, for each
    pixel of the left camera's frame 0.

    ``depth`` (H, W) is the true depth of the left frame, m; the result is NaN where it is 0.
    """
    camera = rig.camera
    grid = camera.pixel_grid()
    z = np.where(depth > 0, depth, np.nan).astype(np.float64)[..., None]
    tau = shutter.row_time(grid[:, :1, 1], 0)
    in_left = z * camera.unproject(grid)
    _, t = rig.cam_from_world(motion, tau, "left")
    w_rate, t_rate = motion.velocity(tau)
    rate = np.cross(np.broadcast_to(w_rate, in_left.shape), in_left - t) + t_rate
    in_right = in_left + (rig.offset("right") - rig.offset("left"))
    velocity = (rate[..., :2] - in_right[..., :2] / z * rate[..., 2:]) / z * (camera.fx, camera.fy)
    lag = timing.lag(shutter, grid[..., 1], velocity[..., 1])
    return np.stack([-velocity[..., 0] * lag, velocity[..., 1] * lag], axis=-1)


def compare(
    left: NDArray[Any],
    right: NDArray[Any],
    depth: NDArray[np.float32],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    timing: Timing,
    options: SgmOptions | None = None,
) -> dict[str, Any]:
    """Measure and predict the errors of SGM on a left frame and a right frame with this timing.

    ``error_px``, ``predicted_px`` and ``unexplained_px`` (measured minus predicted) are medians of the absolute
    disparity error over the pixels with a disparity.
    """
    disparity = stereo_disparity(left, right, rig, "left", options)
    error = disparity - rig.disparity(depth)
    shift = predicted_shift(depth, rig, shutter, motion, timing)
    known = np.isfinite(error)
    surface = depth > 0
    measured, predicted = error[known], shift[known, 0]
    depth_error = np.abs(rig.depth(disparity[known]) - depth[known])
    return {
        "timing": timing.name,
        "delay": timing.delay,
        "opposite": timing.opposite,
        "coverage": float(np.mean(known[surface])),
        "error_px": float(np.median(np.abs(measured))),
        "predicted_px": float(np.median(np.abs(predicted))),
        "unexplained_px": float(np.median(np.abs(measured - predicted))),
        "vertical_px": float(np.nanmedian(np.abs(shift[surface, 1]))),
        "bad_1px": float(np.mean(np.abs(measured) > 1.0)),
        "depth_error_m": float(np.nanmedian(depth_error)),
        "over_2m": float(np.mean(depth_error > 2.0)),
    }
