"""Absolute pose on stereo depth as most people have it: P3P in the library's own robust loop.

The stereo pair of frame 0 gives the points, whose images in frame 1 give the pose: PoseLib's LO-RANSAC on those of
the left camera (M. Persson, K. Nordberg, Lambda Twist P3P, ECCV 2018), then least squares of the reprojection
errors of the inliers, of both cameras.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.given import check_number, check_whole
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.poselib_adapter import (
    MISSING,
    estimate_of,
    poselib_camera,
    poselib_module,
    poselib_pose,
)
from rsbench.solvers.engine.stereo_points import FRAME_1, stereo_points, with_depth

_LEAST = 10
"""Samples, as in rsbench's own robust loop."""
_BUNDLE = {"loss_type": "TRIVIAL", "max_iterations": 100, "gradient_tol": 1e-14, "step_tol": 1e-14}


@final
@dataclass(frozen=True, kw_only=True)
class P3pSolver(Solver):
    """PoseLib's robust absolute pose; a card of it says ``robust = "own"``."""

    cameras_used: Literal["left", "both"] = "both"
    """Whose pixels of frame 1 count in the end; the search is on the left camera's."""
    threshold_px: float = 4.0
    """Largest reprojection error of an inlier: beyond the noise of pixels and points, on a rolling shutter too."""
    confidence: float = 0.999
    """Probability with which RANSAC shall have seen a sample without outliers, 0 to 1."""
    max_iterations: int = 1000
    """Samples that RANSAC draws, at most."""

    def __post_init__(self) -> None:
        check_number("threshold_px", self.threshold_px, 0.0)
        check_number("confidence", self.confidence, 0.0, 1.0)
        check_whole("max_iterations", self.max_iterations, 1)

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": 4},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="Persson, Nordberg: Lambda Twist, ECCV 2018; PoseLib, estimate_absolute_pose",
        assumes="global shutter; depth of frame 0 without noise",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        poselib, tracks = poselib_module(), with_depth(correspondences.tracks)
        if poselib is None:
            return MotionEstimate.failed(MISSING)
        if len(tracks) < self.spec.minimum["tracks"]:
            least = self.spec.minimum["tracks"]
            return MotionEstimate.failed(f"{len(tracks)} tracks with positive disparity, need {least}")
        options = {
            "max_reproj_error": self.threshold_px,
            "success_prob": self.confidence,
            "min_iterations": _LEAST,
            "max_iterations": self.max_iterations,
        }
        offset = rig.offset("left")
        points, camera = stereo_points(tracks, rig) + offset, poselib_camera(rig.camera)
        pose, found = poselib.estimate_absolute_pose(tracks[:, 4:6], points, camera, options, _BUNDLE)
        if found["num_inliers"] < self.spec.minimum["tracks"]:
            return MotionEstimate.failed(f"no consensus: {found['num_inliers']} points fit one pose")
        R = np.array(pose.R)
        start = poselib_pose(poselib, R, np.array(pose.t) + R @ offset - offset)
        return estimate_of(self._refined(poselib, start, tracks, rig), self.spec.metric)

    def _refined(self, poselib: Any, start: Any, tracks: FloatArray, rig: StereoRig) -> Any:
        """PoseLib's pose of the body, from the pixels near it."""
        points, camera = stereo_points(tracks, rig), poselib_camera(rig.camera)
        sides: tuple[Side, ...] = SIDES if self.cameras_used == "both" else ("left",)
        near = [self._near(start, points, tracks[:, FRAME_1[side]], rig, side) for side in sides]
        end, _ = poselib.refine_generalized_absolute_pose(
            [tracks[mask, FRAME_1[side]] for side, mask in zip(sides, near, strict=True)],
            [points[mask] for mask in near],
            start,
            [poselib_pose(poselib, np.eye(3), rig.offset(side)) for side in sides],
            [camera] * len(sides),
            _BUNDLE,
        )
        return end

    def _near(self, pose: Any, points: FloatArray, pixels: FloatArray, rig: StereoRig, side: Side) -> BoolArray:
        """Mask (n,) of the pixels of frame 1 near which a pose of the body shows its points."""
        seen = points @ np.array(pose.R).T + np.array(pose.t) + rig.offset(side)
        front = seen[:, 2] > 0.0
        error = np.linalg.norm(rig.camera.project(np.where(front[:, None], seen, 1.0)) - pixels, axis=1)
        return front & (error <= self.threshold_px)
