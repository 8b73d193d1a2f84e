"""Errors of a trajectory against the true one: rotation of rows, drift, and visible jitter.

ATE and RPE are those of evo (M. Grupp, github.com/MichaelGrupp/evo): root mean squares of the distance after the
rigid motion that fits best (S. Umeyama, PAMI 1991), and of the relative motion over one frame. Poses that a method
did not estimate are NaN and get the worst score.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np

from rsbench.capture.model_choice import AUTO
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.capture.trajectory_estimate import estimate_trajectory
from rsbench.components.motion_models import LinearMotion, TwistMotion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, stereo_points, with_depth
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.pose_errors import WORST_ANGLE
from rsbench.core.projection import back_project, rs_project
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.frame_capture import KnownCapture
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.frame_motion import find_motion
from rsbench.pipeline.sequence_correction import Window, on_one_trajectory

_INLIER_PX, _FEWEST, _DRAWS = 1.5, 6, 1000
"""Threshold, fewest inliers and samples of P3P in RANSAC."""


_UNKNOWN = Pose(np.full((3, 3), np.nan), np.full(3, np.nan))


def _stacked(poses: list[Pose]) -> Pose:
    """Poses (3, 3), (3,) as one with a leading axis (n, ...)."""
    return Pose(np.stack([each.R for each in poses]), np.stack([each.t for each in poses]))


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """An estimated trajectory; unknown poses are NaN."""

    windows: list[Motion | None]
    """Motions of each two successive frames, seen from the body at the start of the first one."""
    starts: Pose
    """(n, 3, 3), (n, 3) body_from_world at the starts of these windows."""
    positions: bool = True
    failed: int = 0

    def within(self, frame: int, tau: FloatArray) -> Pose:
        """Pose of the body at times (n,) of the sequence within a frame, from the body at the frame's start."""
        number = min(frame, len(self.windows) - 1)
        motion = self.windows[number]
        if motion is None:
            return _stacked([_UNKNOWN] * len(tau))
        moved = motion.body_from_world(tau - number)
        return compose(moved, inverse(motion.body_from_world(float(frame - number))))

    def start(self, frame: int) -> Pose:
        """body_from_world (3, 3), (3,) at the start of a frame."""
        number = min(frame, len(self.windows) - 1)
        first = Pose(self.starts.R[number], self.starts.t[number])
        if number == frame:
            return first
        motion = self.windows[number]
        return compose(_UNKNOWN if motion is None else motion.body_from_world(1.0), first)


def along(motion: Motion, count: int, positions: bool = True) -> Estimate:
    """One motion through all windows."""
    windows: list[Motion | None] = [motion.from_time(float(k)) for k in range(count)]
    return Estimate(windows=windows, starts=motion.body_from_world(np.arange(float(count))), positions=positions)


def chained(windows: list[Motion | None]) -> Estimate:
    """Independent motions, each starting at the end pose of the one before; poses after a failure are unknown."""
    starts = [Pose(np.eye(3), np.zeros(3))]
    for motion in windows[:-1]:
        starts.append(compose(_UNKNOWN if motion is None else motion.body_from_world(1.0), starts[-1]))
    return Estimate(windows=windows, starts=_stacked(starts), failed=sum(motion is None for motion in windows))


# Methods


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """Inputs of the methods."""

    rig: StereoRig
    shutter: RollingShutter
    matches: list[Correspondences]
    """Matches of the frames 0 and 1, 1 and 2, ..."""
    gyro: FloatArray | None = None
    """(n, 4) samples, as in ``Correspondences``."""
    seed: int = 0


def _trajectory(given: Given) -> Estimate:
    found = estimate_trajectory(given.matches, given.rig, given.shutter, seed=given.seed, gyro=given.gyro)
    return along(found.motion, len(given.matches))


def _correct(given: Given) -> Estimate:
    windows = (Window(images={}, pairs=None, found=None, matches=each) for each in given.matches)
    found = list(on_one_trajectory(windows, KnownCapture(rig=given.rig, shutter=given.shutter), given.seed, ""))
    motions = [None if each.found is None else each.found.motion for each in found]
    starts = _stacked([each.pose or _UNKNOWN for each in found])
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


def pnp_motion(tracks: FloatArray, rig: StereoRig) -> Motion | None:
    """The motion estimated from tracks (n, 8) as if the shutter were global; None on failure."""
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


class Method(NamedTuple):
    """A method that estimates trajectories."""

    solve: Callable[[Given], Estimate | None]
    """Returns None if an input that it needs is missing."""
    uses: tuple[str, ...]
    """The inputs of the leaderboard that it uses."""
    motion_model: str
    """Motion model that it assumes, as the header of a submission states it."""
    description: str


_MATCHES = ("left", "right", "links")
METHODS: dict[str, Method] = {
    "rs-trajectory": Method(
        lambda given: _trajectory(replace(given, gyro=None)),
        (*_MATCHES, "readout"),
        "spline",
        "One spline through all windows, as rsbench.estimate_trajectory",
    ),
    "rs-trajectory-streamed": Method(
        _correct, (*_MATCHES, "readout"), "spline", "The same some windows at a time, as rsbench correct does"
    ),
    "rs-trajectory-gyro": Method(
        lambda given: None if given.gyro is None else _trajectory(given),
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
        lambda given: chained([pnp_motion(each.tracks, given.rig) for each in given.matches]),
        _MATCHES,
        "none",
        "Stereo odometry of a global shutter: P3P in RANSAC of each window, refined; OpenCV",
    ),
    "gyro-integrated": Method(
        _gyro, ("gyro",), "spline", "The integral of the gyroscope, biases and all; no position"
    ),
    "no-motion": Method(
        lambda given: along(LinearMotion(np.zeros(3), np.zeros(3)), len(given.matches)),
        ("readout",),
        "none",
        "A rig that stands still",
    ),
}
"""Methods by their name on a leaderboard."""


LINES = 9
"""Lines of a frame that are scored."""
AUC_DEG = {"auc_way": 0.1, "auc_rows": 0.02}
"""Thresholds, degrees, of the areas under the curves of rotation errors relative to the first line of the
sequence (``auc_way``) and of the frame (``auc_rows``)."""
_POINTS_PX = 16
"""Distance between the points of the middle frame whose image paths are followed."""


def turn_errors(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Rotation errors (n,), radians, of rotations (n, 3, 3) body_from_world relative to the first one."""
    apart = estimate @ estimate[0].T @ truth[0] @ np.swapaxes(truth, 1, 2)
    known = np.all(np.isfinite(apart), axis=(1, 2))
    return np.where(known, so3.angle(np.where(known[:, None, None], apart, np.eye(3))), WORST_ANGLE)


def absolute_error(estimate: Pose, truth: Pose) -> float:
    """ATE, metres: of the positions of poses body_from_world (n, 3, 3), (n, 3), after rigid alignment."""
    found, true = inverse(estimate).t, inverse(truth).t
    if not np.all(np.isfinite(found)):
        return float("inf")
    a, b = found - np.mean(found, axis=0), true - np.mean(true, axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    turn = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt(np.mean(np.sum((a @ turn.T - b) ** 2, axis=1))))


def relative_errors(estimate: Pose, truth: Pose) -> tuple[float, float]:
    """RPE of poses body_from_world (n, 3, 3), (n, 3) from one to the next: metres and radians."""
    moved = compose(_steps(truth), inverse(_steps(estimate)))
    if not (np.all(np.isfinite(moved.R)) and np.all(np.isfinite(moved.t))):
        return float("inf"), WORST_ANGLE
    return _root_mean_square(np.linalg.norm(moved.t, axis=1)), _root_mean_square(so3.angle(moved.R))


def _steps(poses: Pose) -> Pose:
    """Relative poses of successive poses: (n - 1, 3, 3), (n - 1, 3)."""
    return compose(Pose(poses.R[1:], poses.t[1:]), inverse(Pose(poses.R[:-1], poses.t[:-1])))


def _root_mean_square(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def jitter(estimate: FloatArray, truth: FloatArray) -> float:
    """Mean acceleration of the error of points in corrected frames, px per squared frame period.

    Args:
        estimate: (frames, n, 2) pixels of points in corrected frames; NaN where the trajectory is unknown.
        truth: (frames, n, 2) pixels in global-shutter frames; NaN where a point is not visible.
    """
    seen = np.all(np.isfinite(truth), axis=-1)
    counted = seen[:-2] & seen[1:-1] & seen[2:]
    if not np.any(counted):
        return float("nan")
    off = np.diff(estimate - truth, n=2, axis=0)[counted]
    return float(np.mean(np.linalg.norm(off, axis=-1))) if np.all(np.isfinite(off)) else float("inf")


# Errors of a sequence


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueTrajectory:
    """The ground truth of a sequence for trajectories."""

    sequence: Sequence
    points: FloatArray
    """(n, 3) points in world coordinates."""
    estimate: Estimate

    @classmethod
    def of(cls, sequence: Sequence) -> TrueTrajectory:
        middle = sequence.frames // 2
        depth = sequence.depth("rs", "left", middle)[::_POINTS_PX, ::_POINTS_PX]
        grid = sequence.rig.camera.pixel_grid()[::_POINTS_PX, ::_POINTS_PX]
        geometry = sequence.rig, sequence.shutter, sequence.motion
        points = back_project(*geometry, "left", middle, grid[depth > 0.0], depth[depth > 0.0])
        return cls(sequence=sequence, points=points, estimate=along(sequence.motion, sequence.frames - 1))

    @cached_property
    def seen(self) -> list[tuple[FloatArray, FloatArray]]:
        """Per left frame, points (n, 3) in body axes at the times (n,) of their rows; NaN if not visible."""
        sequence, found = self.sequence, list[tuple[FloatArray, FloatArray]]()
        for frame in range(sequence.frames):
            seen = rs_project(sequence.rig, sequence.shutter, sequence.motion, "left", frame, self.points)
            rays = sequence.rig.camera.unproject(seen.pixels)
            tau = np.where(np.isfinite(seen.tau), seen.tau, float(frame))
            found.append((seen.depth[:, None] * rays - sequence.rig.offset("left"), tau))
        return found


def scored_times(shutter: RollingShutter, frame: int, count: int = LINES) -> FloatArray:
    """Times (count,) of lines of the left camera, evenly spaced from the first to the last line."""
    tau = np.sort(shutter.line_times(frame, "left"))
    return tau[np.round(np.linspace(0.0, len(tau) - 1.0, count)).astype(np.int64)]


def trajectory_scores(truth: TrueTrajectory, estimate: Estimate) -> dict[str, float]:
    """Scores of a trajectory; NaN for scores of positions if it has none."""
    sequence, frames = truth.sequence, range(truth.sequence.frames)
    rows, both = list[FloatArray](), [list[Pose](), list[Pose]()]
    for frame in frames:
        tau = scored_times(sequence.shutter, frame)
        poses = [each.within(frame, tau) for each in (estimate, truth.estimate)]
        rows.append(turn_errors(poses[0].R, poses[1].R))
        for kept, pose, each in zip(both, poses, (estimate, truth.estimate), strict=True):
            kept.append(compose(pose, each.start(frame)))
    whole = [np.concatenate([each.R for each in kept]) for kept in both]
    own = np.rad2deg(np.concatenate(rows))
    gone = np.rad2deg(turn_errors(*whole))
    found = {
        "rows_median_deg": float(np.median(own)),
        "rows_95_deg": float(np.quantile(own, 0.95)),
        "way_median_deg": float(np.median(gone)),
        "way_95_deg": float(np.quantile(gone, 0.95)),
        "auc_rows": float(np.mean(np.clip(1.0 - own / AUC_DEG["auc_rows"], 0.0, None))),
        "auc_way": float(np.mean(np.clip(1.0 - gone / AUC_DEG["auc_way"], 0.0, None))),
        "failed": float(estimate.failed),
    }
    starts = [_stacked([each.start(frame) for frame in frames]) for each in (estimate, truth.estimate)]
    metres, radians = relative_errors(*starts)
    found["rpe_deg"] = float(np.rad2deg(radians))
    known = {
        "ate_mm": 1e3 * absolute_error(*starts),
        "rpe_mm": 1e3 * metres,
        "jitter_px": jitter(*(_corrected_places(truth, each) for each in (estimate, truth.estimate))),
    }
    return {**found, **(known if estimate.positions else dict.fromkeys(known, np.nan))}


def _corrected_places(truth: TrueTrajectory, estimate: Estimate) -> FloatArray:
    """Pixels (frames, n, 2) of points in left frames that are corrected with a trajectory and the true depth."""
    rig, places = truth.sequence.rig, list[FloatArray]()
    for frame, (x, tau) in enumerate(truth.seen):
        at_start = transform(inverse(estimate.within(frame, tau)), x) + rig.offset("left")
        at_start[~np.isfinite(at_start[:, 2]) | (at_start[:, 2] <= 0.0)] = np.nan
        places.append(rig.camera.project(at_start))
    return np.stack(places)
