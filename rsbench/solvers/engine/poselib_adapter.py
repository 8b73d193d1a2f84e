"""Global-shutter solvers of PoseLib: five points of the left camera, all pairs of the rig, pose from points.

V. Larsson et al., PoseLib. It minimises the Sampson or the reprojection error without robust loss here: a robust
loop around it throws outliers out, the same for every solver.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.eight_point import decompose_essential, eight_point
from rsbench.solvers.engine.base import MotionEstimate, Solver

_BUNDLE = {"loss_type": "TRIVIAL", "max_iterations": 100, "gradient_tol": 1e-14, "step_tol": 1e-14}
MISSING = "poselib is not installed: there is no wheel for this platform"
_NOT_FINITE = "poselib returned no finite pose"


class PoselibSolver(Solver):
    """A solver whose final estimate is one of PoseLib's refinements."""

    @abstractmethod
    def refined(
        self, poselib: Any, start: Any, correspondences: Correspondences, rig: StereoRig, options: dict[str, Any]
    ) -> Any:
        """The pose that PoseLib finds from a pose to start at; both are PoseLib's ``CameraPose``."""

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        poselib = poselib_module()
        if poselib is None:
            return MotionEstimate.failed(MISSING)
        start = poselib_pose(poselib, so3.exp(motion.w), motion.d)
        options = {**_BUNDLE, "max_iterations": 10} if quick else _BUNDLE
        return estimate_of(self.refined(poselib, start, correspondences, rig, options), self.spec.metric)


def poselib_module() -> Any:
    """The module, or None where it has no wheel."""
    try:
        import poselib
    except ImportError:
        return None
    return poselib


def poselib_camera(camera: PinholeCamera) -> dict[str, Any]:
    """As PoseLib names it; ValueError for a lens: it is given matches without one."""
    if camera.lens is not None:
        raise ValueError("PoseLib is given matches without a lens")
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }


def poselib_pose(poselib: Any, R: FloatArray, t: FloatArray) -> Any:
    pose = poselib.CameraPose()
    pose.R, pose.t = R, t
    return pose


def rig_extrinsics(poselib: Any, rig: StereoRig) -> list[Any]:
    return [poselib_pose(poselib, np.eye(3), rig.offset(side)) for side in SIDES]


def estimate_of(pose: Any, metric: bool) -> MotionEstimate:
    R, t = np.array(pose.R), np.array(pose.t)
    if not (np.all(np.isfinite(R)) and np.all(np.isfinite(t))):
        return MotionEstimate.failed(_NOT_FINITE)
    if not metric:
        t = t / max(float(np.linalg.norm(t)), 1e-300)
    reason = "" if metric else "the length of d is not determined by one camera"
    return MotionEstimate(w=so3.log(R), d=t, success=True, metric=metric, reason=reason)


def left_start(matches: FloatArray, rig: StereoRig) -> MotionEstimate:
    """Motion of the left camera, with a unit d, by the eight-point algorithm on matches (n, 4), n >= 8."""
    x0, x1 = rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])
    E = eight_point(x0, x1)
    if E is None:
        return MotionEstimate.failed("the matches fit more than one essential matrix: degenerate scene or motion")
    pose, _ = decompose_essential(E, x0, x1)
    return MotionEstimate(w=so3.log(pose.R), d=pose.t, success=True)


def five_point_motions(matches: FloatArray, rig: StereoRig) -> list[MotionEstimate]:
    """Motions of the camera of matches (5, 4): PoseLib's five-point solver, points in front."""
    poselib = poselib_module()
    if poselib is None:
        return [MotionEstimate.failed(MISSING)]
    if len(matches) < 5:
        return []
    rays = [rig.camera.unproject(matches[:5, k : k + 2]) for k in (0, 2)]
    unit = [ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays]
    motions = [estimate_of(pose, metric=False) for pose in poselib.relpose_5pt(*unit)]
    return [motion for motion in motions if motion.success]
