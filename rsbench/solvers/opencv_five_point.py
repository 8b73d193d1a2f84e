"""OpenCV's essential matrix: what most people would call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.eight_point import decompose_essential
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec


@final
@dataclass(frozen=True, kw_only=True)
class OpenCvFivePointSolver(Solver):
    """``cv2.findEssentialMat`` and the decomposition with most points in front, on the left camera.

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
        short = self.spec.shortage({"left": len(matches)})
        if short is not None:
            return short
        motions = self._motions(matches, rig)
        return motions[0] if motions else MotionEstimate.failed("OpenCV found no essential matrix")

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return self._motions(temporal_pairs(sample, "left"), rig)

    def _motions(self, matches: FloatArray, rig: StereoRig) -> list[MotionEstimate]:
        """Of every essential matrix that OpenCV returns: several for five matches, one for more."""
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
        x0, x1 = rig.camera.unproject(matches[:, :2]), rig.camera.unproject(matches[:, 2:])
        out = []
        for E in stacked.reshape(-1, 3, 3):
            pose, front = decompose_essential(E, x0, x1)
            if front > 0:
                out.append(MotionEstimate(w=so3.log(pose.R), d=pose.t, success=True, reason="length of d unknown"))
        return out
