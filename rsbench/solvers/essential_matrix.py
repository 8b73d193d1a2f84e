"""Essential matrices of the left camera: the normalised eight-point algorithm, with which the paper compares, and
OpenCV's five-point algorithm, which is the most widely used.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.epipolar import in_front
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec

_ROUNDING = 1e-10
DEGENERATE = "the matches fit more than one essential matrix: degenerate scene or motion"


def rays_of(matches: FloatArray, rig: StereoRig) -> tuple[FloatArray, FloatArray]:
    """Return rays (n, 3), z = 1, of both ends of matches (n, 4) of one camera."""
    return rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])


def normalising_transform(x: FloatArray) -> FloatArray:
    """Return the similarity (3, 3) that centres points (n, 2) and scales their mean distance to sqrt(2)."""
    centre = np.mean(x, axis=0)
    distance = float(np.mean(np.linalg.norm(x - centre, axis=1)))
    scale = np.sqrt(2.0) / distance if distance > 0.0 else 1.0
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])


def eight_point(x0: FloatArray, x1: FloatArray) -> FloatArray | None:
    """Return the matrix E (3, 3) with ``x1^T E x0 = 0`` for rays (n, 3) with z = 1; None for degenerate rays.

    Hartley, In Defense of the Eight-Point Algorithm, PAMI 1997.
    """
    T0, T1 = normalising_transform(x0[:, :2]), normalising_transform(x1[:, :2])
    rows = (x1 @ T1.T)[:, :, None] * (x0 @ T0.T)[:, None, :]
    E = null_essential(rows.reshape(-1, 9))
    return None if E is None else T1.T @ E @ T0


def null_essential(rows: FloatArray) -> FloatArray | None:
    """Solve homogeneous equations (m, 9) for the entries, row by row, of a matrix (3, 3); None if not unique."""
    _, s, Vt = np.linalg.svd(rows, full_matrices=len(rows) < 9)
    return Vt[-1].reshape(3, 3) if s[7] > _ROUNDING * s[0] else None


def decompose_essential(E: FloatArray, x0: FloatArray, x1: FloatArray) -> tuple[Pose, int]:
    """Return the one of E's four poses ``cam1_from_cam0``, with unit t, that has most points in front; and their
    number.

    Points are given by their rays (n, 3).
    """
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.linalg.det(U), Vt * np.linalg.det(Vt)
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    best, most = Pose(np.eye(3), U[:, 2]), -1
    for R in (U @ W @ Vt, U @ W.T @ Vt):
        for t in (U[:, 2], -U[:, 2]):
            count = int(np.count_nonzero(in_front(Pose(R, t), x0, x1)))
            if count > most:
                best, most = Pose(R, t), count
    return best, most


@final
@dataclass(frozen=True, kw_only=True)
class EightPointSolver(Solver):
    """Eight-point algorithm for the left camera, which ignores the rolling shutter; d is up to scale."""

    spec = SolverSpec(
        needs=frozenset({"left"}),
        minimum={"left": 8},
        metric=False,
        motion_model="linear",
        shutter="global",
        reference_point="left",
        reference="Hartley: In Defense of the Eight-Point Algorithm, PAMI 1997",
        assumes="global shutter; a scene that is not planar; translation",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches = temporal_pairs(correspondences, "left")
        if short := self.spec.shortage({"left": len(matches)}):
            return short
        x0, x1 = rays_of(matches, rig)
        E = eight_point(x0, x1)
        if E is None:
            return MotionEstimate.failed(DEGENERATE)
        pose, front = decompose_essential(E, x0, x1)
        if front == 0:
            return MotionEstimate.failed("no match lies in front of both cameras")
        return MotionEstimate(w=so3.log(pose.R), d=pose.t, success=True, reason="length of d unknown")


@final
@dataclass(frozen=True, kw_only=True)
class OpenCvFivePointSolver(Solver):
    """``cv2.findEssentialMat`` for the left camera, and the decomposition with most points in front.

    OpenCV keeps the best five-point model and does not refine it on the others.
    """

    threshold_px: float = 1.0
    """Inlier threshold of OpenCV's own RANSAC, which it always runs."""
    confidence: float = 0.999
    """Probability with which RANSAC shall have seen a sample without outliers, 0 to 1."""

    spec = SolverSpec(
        needs=frozenset({"left"}),
        minimum={"left": 6},
        metric=False,
        motion_model="linear",
        shutter="global",
        reference_point="left",
        reference="OpenCV findEssentialMat; Nister: An efficient solution to the five-point problem, PAMI 2004",
        assumes="global shutter; translation",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches = temporal_pairs(correspondences, "left")
        if short := self.spec.shortage({"left": len(matches)}):
            return short
        motions = self._motions(matches, rig)
        return motions[0] if motions else MotionEstimate.failed("OpenCV found no essential matrix")

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self._motions(temporal_pairs(sample, "left"), rig)

    def _motions(self, matches: FloatArray, rig: StereoRig) -> list[MotionEstimate]:
        """Motions of every essential matrix that OpenCV returns: several for five matches, one for more."""
        import cv2

        try:
            stacked, _ = cv2.findEssentialMat(
                np.ascontiguousarray(matches[:, :2]),
                np.ascontiguousarray(matches[:, 2:]),
                rig.camera.K,
                method=cv2.RANSAC,
                prob=self.confidence,
                threshold=self.threshold_px,
            )
        except cv2.error:  # degenerate matches trip its assertions
            return []
        if stacked is None or stacked.size % 9 or not np.all(np.isfinite(stacked)):
            return []
        x0, x1 = rays_of(matches, rig)
        out = []
        for E in stacked.reshape(-1, 3, 3):
            pose, front = decompose_essential(E, x0, x1)
            if front > 0:
                out.append(MotionEstimate(w=so3.log(pose.R), d=pose.t, success=True, reason="length of d unknown"))
        return out
