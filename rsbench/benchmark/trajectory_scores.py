"""How far a trajectory is from the true one: rotation of rows, drift, and what a viewer sees of it.

ATE and RPE are those of evo (M. Grupp, github.com/MichaelGrupp/evo): root mean squares of the distance after the
rigid motion that fits best (S. Umeyama, PAMI 1991), and of the relative motion over one frame. What a trajectory
does not know is NaN in it; it scores the worst value of everything.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rsbench.benchmark.trajectory_methods import Estimate, along
from rsbench.core import so3
from rsbench.core.pose_errors import WORST_ANGLE
from rsbench.core.projection import back_project, rs_project
from rsbench.core.se3 import Pose, compose, inverse, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence

LINES = 9
"""Of a frame that are scored."""
AUC_DEG = {"auc_way": 0.1, "auc_rows": 0.02}
"""Thresholds of the areas under the curves of errors of lines against the sequence's and the frame's first one."""
_POINTS_PX = 16
"""Between points of the middle frame whose ways are followed."""


def turn_errors(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Angles (n,), radians, by which rotations (n, 3, 3) body_from_world are off, each against the first one."""
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
    """Each pose seen from the one before: (n - 1, 3, 3), (n - 1, 3)."""
    return compose(Pose(poses.R[1:], poses.t[1:]), inverse(Pose(poses.R[:-1], poses.t[:-1])))


def _root_mean_square(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def jitter(estimate: FloatArray, truth: FloatArray) -> float:
    """Mean acceleration, px per squared frame period, by which points shake in corrected frames.

    Args:
        estimate: (frames, n, 2) places of points in corrected frames; NaN where the trajectory is not known.
        truth: likewise in frames of a global shutter; NaN where a point is not seen.
    """
    seen = np.all(np.isfinite(truth), axis=-1)
    counted = seen[:-2] & seen[1:-1] & seen[2:]
    if not np.any(counted):
        return float("nan")
    off = np.diff(estimate - truth, n=2, axis=0)[counted]
    return float(np.mean(np.linalg.norm(off, axis=-1))) if np.all(np.isfinite(off)) else float("inf")


# Of a sequence


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueTrajectory:
    """What trajectories of a sequence are compared with."""

    sequence: Sequence
    points: FloatArray
    """(n, 3) of the world."""
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
        """Of each left frame: the points (n, 3) in the body when they are seen, NaN where not, and when (n,)."""
        sequence, found = self.sequence, list[tuple[FloatArray, FloatArray]]()
        for frame in range(sequence.frames):
            seen = rs_project(sequence.rig, sequence.shutter, sequence.motion, "left", frame, self.points)
            rays = sequence.rig.camera.unproject(seen.pixels)
            tau = np.where(np.isfinite(seen.tau), seen.tau, float(frame))
            found.append((seen.depth[:, None] * rays - sequence.rig.offset("left"), tau))
        return found


def scored_times(shutter: RollingShutter, frame: int, count: int = LINES) -> FloatArray:
    """Times (count,) of lines of the left camera, even from the first to the last one."""
    tau = np.sort(shutter.line_times(frame, "left"))
    return tau[np.round(np.linspace(0.0, len(tau) - 1.0, count)).astype(np.int64)]


def trajectory_scores(truth: TrueTrajectory, estimate: Estimate) -> dict[str, float]:
    """Scores of a trajectory; NaN where it says nothing of it."""
    sequence, frames = truth.sequence, range(truth.sequence.frames)
    rows, way = list[FloatArray](), [list[Pose](), list[Pose]()]
    for frame in frames:
        tau = scored_times(sequence.shutter, frame)
        poses = [each.within(frame, tau) for each in (estimate, truth.estimate)]
        rows.append(turn_errors(poses[0].R, poses[1].R))
        for kept, pose, each in zip(way, poses, (estimate, truth.estimate), strict=True):
            kept.append(compose(pose, each.start(frame)))
    whole = [np.concatenate([each.R for each in kept]) for kept in way]
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
    starts = [_starts(each, len(frames)) for each in (estimate, truth.estimate)]
    metres, radians = relative_errors(*starts)
    found["rpe_deg"] = float(np.rad2deg(radians))
    known = {
        "ate_mm": 1e3 * absolute_error(*starts),
        "rpe_mm": 1e3 * metres,
        "jitter_px": _jitter(truth, estimate),
    }
    return {**found, **(known if estimate.positions else dict.fromkeys(known, np.nan))}


def _starts(estimate: Estimate, frames: int) -> Pose:
    poses = [estimate.start(frame) for frame in range(frames)]
    return Pose(np.stack([each.R for each in poses]), np.stack([each.t for each in poses]))


def _jitter(truth: TrueTrajectory, estimate: Estimate) -> float:
    both = [_corrected_places(truth, each) for each in (estimate, truth.estimate)]
    return jitter(*both)


def _corrected_places(truth: TrueTrajectory, estimate: Estimate) -> FloatArray:
    """Where points (frames, n, 2) stand in left frames corrected with a trajectory and their true depth, px."""
    rig, places = truth.sequence.rig, list[FloatArray]()
    for frame, (x, tau) in enumerate(truth.seen):
        at_start = transform(inverse(estimate.within(frame, tau)), x) + rig.offset("left")
        at_start[~np.isfinite(at_start[:, 2]) | (at_start[:, 2] <= 0.0)] = np.nan
        places.append(rig.camera.project(at_start))
    return np.stack(places)
