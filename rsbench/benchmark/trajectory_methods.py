"""Trajectories from the matches of each two frames: ours, windows, a global shutter's, a gyroscope's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from rsbench.capture.calibration_errors import NO_ERRORS
from rsbench.capture.settle import AUTO, NoMotionError
from rsbench.capture.trajectory_estimate import estimate_trajectory
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.gyro_motion import GyroMotion
from rsbench.core.motion import LinearMotion, Motion, TwistMotion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_motion import find_motion
from rsbench.pipeline.sequence_trajectory import Window, on_one_trajectory
from rsbench.solvers.engine.stereo_points import stereo_points, with_depth

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
class Problem:
    """What methods are given."""

    rig: StereoRig
    shutter: RollingShutter
    matches: list[Correspondences]
    """Of the frames 0 and 1, 1 and 2, ..."""
    gyro: FloatArray | None = None
    """(n, 4) samples, as in ``Correspondences``."""
    seed: int = 0


def _trajectory(problem: Problem) -> Estimate:
    found = estimate_trajectory(problem.matches, problem.rig, problem.shutter, seed=problem.seed)
    return along(found.motion, len(problem.matches))


def _correct(problem: Problem) -> Estimate:
    options = CorrectionOptions(motion_model=AUTO, seed=problem.seed)
    windows = (Window(images={}, pairs=None, found=None, matches=each) for each in problem.matches)
    found = list(on_one_trajectory(windows, problem.rig, problem.shutter, options, NO_ERRORS))
    motions = [None if each.found is None else each.found.motion for each in found]
    unknown = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))
    poses = [each.pose or unknown for each in found]
    starts = Pose(np.stack([each.R for each in poses]), np.stack([each.t for each in poses]))
    return Estimate(windows=motions, starts=starts, failed=sum(motion is None for motion in motions))


def _windows(model: str | None) -> Callable[[Problem], Estimate]:
    def solve(problem: Problem) -> Estimate:
        options, motions = CorrectionOptions(motion_model=model, seed=problem.seed), list[Motion | None]()
        for matches in problem.matches:
            try:
                motions.append(find_motion(matches, problem.rig, problem.shutter, options).motion)
            except NoMotionError:
                motions.append(None)
        return chained(motions)

    return solve


def _global_shutter(problem: Problem) -> Estimate:
    return chained([pnp_motion(each.tracks, problem.rig) for each in problem.matches])


def pnp_motion(tracks: FloatArray, rig: StereoRig) -> Motion | None:
    """The motion that tracks (n, 8) show to a global shutter; None where there is none."""
    tracks = with_depth(tracks)
    if len(tracks) < _FEWEST:
        return None
    points = stereo_points(tracks, rig) + rig.offset("left")
    pixels, K = rig.camera.ideal_pixels(tracks[:, 4:6]), rig.camera.ideal.K
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


def _gyro(problem: Problem) -> Estimate | None:
    if problem.gyro is None:
        return None
    return along(GyroMotion(problem.gyro, np.zeros(3)), len(problem.matches), positions=False)


def _rolling(problem: Problem) -> Estimate:
    return along(LinearMotion(np.zeros(3), np.zeros(3)), len(problem.matches))


METHODS: dict[str, Callable[[Problem], Estimate | None]] = {
    "trajectory": _trajectory,
    "correct": _correct,
    "auto": _windows(AUTO),
    "linear": _windows(None),
    "gs-vo": _global_shutter,
    "gyro": _gyro,
    "rolling": _rolling,
}
"""By name; None where a method is not given what it needs."""
