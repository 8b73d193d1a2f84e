"""Trajectories from the matches of each two frames: ours, windows, a global shutter's, a gyroscope's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from rsbench.capture.calibration import NO_ERRORS
from rsbench.capture.model_choice import AUTO
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.capture.trajectory_estimate import estimate_trajectory
from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, stereo_points, with_depth
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import find_motion
from rsbench.pipeline.sequence_correction import Window, on_one_trajectory

_INLIER_PX, _FEWEST, _DRAWS = 1.5, 6, 1000
"""Of P3P in RANSAC: threshold, fewest inliers, and samples."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """The trajectory of an entry; poses are NaN where it has none."""

    windows: list[Motion | None]
    """Of each two successive frames, seen from the body at the start of the first one."""
    starts: Pose
    """(n, 3, 3), (n, 3) body_from_world at the starts of these windows."""
    positions: bool = True
    failed: int = 0

    def within(self, frame: int, tau: FloatArray) -> Pose:
        """Of the body at times (n,) of the sequence within a frame, from the body at the start of the frame."""
        number = min(frame, len(self.windows) - 1)
        motion = self.windows[number]
        if motion is None:
            return Pose(np.full((len(tau), 3, 3), np.nan), np.full((len(tau), 3), np.nan))
        moved = motion.body_from_world(tau - number)
        return compose(moved, inverse(motion.body_from_world(float(frame - number))))

    def start(self, frame: int) -> Pose:
        """body_from_world (3, 3), (3,) at the start of a frame."""
        number = min(frame, len(self.windows) - 1)
        first = Pose(self.starts.R[number], self.starts.t[number])
        if number == frame:
            return first
        motion = self.windows[number]
        end = Pose(np.full((3, 3), np.nan), np.full(3, np.nan)) if motion is None else motion.body_from_world(1.0)
        return compose(end, first)


def along(motion: Motion, count: int, positions: bool = True) -> Estimate:
    """One motion through all windows."""
    windows: list[Motion | None] = [motion.from_time(float(k)) for k in range(count)]
    return Estimate(windows=windows, starts=motion.body_from_world(np.arange(float(count))), positions=positions)


def chained(windows: list[Motion | None]) -> Estimate:
    """Independent motions, each beginning where the one before ends; after a failure nobody knows where."""
    unknown = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
    starts = [Pose(np.eye(3), np.zeros(3))]
    for motion in windows[:-1]:
        starts.append(compose(unknown if motion is None else motion.body_from_world(1.0), starts[-1]))
    stacked = Pose(np.stack([each.R for each in starts]), np.stack([each.t for each in starts]))
    return Estimate(windows=windows, starts=stacked, failed=sum(motion is None for motion in windows))


# Methods


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What methods are given."""

    rig: StereoRig
    shutter: RollingShutter
    matches: list[Correspondences]
    """Of the frames 0 and 1, 1 and 2, ..."""
    gyro: FloatArray | None = None
    """(n, 4) samples, as in ``Correspondences``."""
    seed: int = 0


def _trajectory(given: Given) -> Estimate:
    found = estimate_trajectory(given.matches, given.rig, given.shutter, seed=given.seed)
    return along(found.motion, len(given.matches))


def _trajectory_gyro(given: Given) -> Estimate | None:
    if given.gyro is None:
        return None
    found = estimate_trajectory(given.matches, given.rig, given.shutter, seed=given.seed, gyro=given.gyro)
    return along(found.motion, len(given.matches))


def _correct(given: Given) -> Estimate:
    options = CorrectionOptions(motion_model=AUTO, seed=given.seed)
    windows = (Window(images={}, pairs=None, found=None, matches=each) for each in given.matches)
    found = list(on_one_trajectory(windows, given.rig, given.shutter, options, NO_ERRORS))
    motions = [None if each.found is None else each.found.motion for each in found]
    unknown = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
    poses = [each.pose or unknown for each in found]
    starts = Pose(np.stack([each.R for each in poses]), np.stack([each.t for each in poses]))
    return Estimate(windows=motions, starts=starts, failed=sum(motion is None for motion in motions))


def _windows(model: str | None) -> Callable[[Given], Estimate]:
    def solve(given: Given) -> Estimate:
        options, motions = CorrectionOptions(motion_model=model, seed=given.seed), list[Motion | None]()
        for matches in given.matches:
            try:
                found = find_motion(matches, given.rig, given.shutter, options, splines=False)
                motions.append(found.motion)
            except NoMotionError:
                motions.append(None)
        return chained(motions)

    return solve


def _global_shutter(given: Given) -> Estimate:
    return chained([pnp_motion(each.tracks, given.rig) for each in given.matches])


def pnp_motion(tracks: FloatArray, rig: StereoRig) -> Motion | None:
    """The motion that tracks (n, 8) show to a global shutter; None where there is none."""
    tracks = with_depth(rig.camera.ideal_pixels(tracks.reshape(-1, 4, 2)).reshape(-1, 8))
    rig = rig.ideal
    if len(tracks) < _FEWEST:
        return None
    points = stereo_points(tracks, rig) + rig.offset("left")
    pixels, K = np.ascontiguousarray(tracks[:, 4:6]), rig.camera.K
    cv2.setRNGSeed(0)
    good, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, K, None, iterationsCount=_DRAWS, reprojectionError=_INLIER_PX, flags=cv2.SOLVEPNP_P3P
    )
    if not good or inliers is None or len(inliers) < _FEWEST:
        return None
    right = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[right], pixels[right], K, None, turn, shift)
    w, offset = turn[:, 0], rig.offset("left")
    return TwistMotion(w, shift[:, 0] + so3.exp(w) @ offset - offset)


def _gyro(given: Given) -> Estimate | None:
    if given.gyro is None:
        return None
    return along(GyroMotion(given.gyro, np.zeros(3)), len(given.matches), positions=False)


def _rolling(given: Given) -> Estimate:
    return along(LinearMotion(np.zeros(3), np.zeros(3)), len(given.matches))


class Method(NamedTuple):
    """A way to a trajectory."""

    solve: Callable[[Given], Estimate | None]
    """None where it is not given what it needs."""
    uses: tuple[str, ...]
    """Of what the leaderboard gives."""
    motion_model: str
    """That it assumes, as the header of a submission says it."""
    description: str


_MATCHES = ("left", "right", "links")
METHODS: dict[str, Method] = {
    "rs-trajectory": Method(
        _trajectory,
        (*_MATCHES, "readout"),
        "spline",
        "One spline through all windows, as rsbench.estimate_trajectory",
    ),
    "rs-trajectory-streamed": Method(
        _correct, (*_MATCHES, "readout"), "spline", "The same some windows at a time, as rsbench correct does"
    ),
    "rs-trajectory-gyro": Method(
        _trajectory_gyro,
        (*_MATCHES, "readout", "gyro"),
        "spline",
        "The same spline through the samples of a gyroscope too, whose bias and clock are found",
    ),
    "windows-auto": Method(
        _windows(AUTO),
        (*_MATCHES, "readout"),
        "chosen",
        "Each window by itself, under the motion model that its matches prefer",
    ),
    "windows-linear": Method(
        _windows(None), (*_MATCHES, "readout"), "linear", "Each window by itself, under the paper's motion model"
    ),
    "gs-vo": Method(
        _global_shutter,
        _MATCHES,
        "none",
        "Stereo odometry of a global shutter: P3P in RANSAC of each window, refined; OpenCV",
    ),
    "gyro-integrated": Method(
        _gyro, ("gyro",), "spline", "The integral of the gyroscope, biases and all; no position"
    ),
    "no-motion": Method(_rolling, ("readout",), "none", "A rig that stands still"),
}
"""By the name on a board."""
