"""What the solvers with free velocities of both frames share: all but their linear part."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, from_row, refine, signed

_QUICK, _FULL = 8, 40


@dataclass(frozen=True, kw_only=True)
class FreeVelocitySolver(Solver):
    """Linear on the left camera's matches, then least squares of the Sampson error of the same model."""

    refinement: Literal["none", "sampson"] = "sampson"

    @property
    @abstractmethod
    def turning(self) -> bool:
        """Whether the camera turns within a frame."""

    @property
    @abstractmethod
    def least(self) -> int:
        """Fewest matches."""

    @property
    @abstractmethod
    def about(self) -> tuple[str, str]:
        """``reference`` and ``assumes`` of the spec."""

    @abstractmethod
    def linear(self, rows: Rows) -> FreeMotion | str:
        """Motion from rows whose s = 0 is the principal point's, or why there is none; the sign is open."""

    @property
    def spec(self) -> SolverSpec:
        reference, assumes = self.about
        return SolverSpec(
            needs=frozenset({"left"}),
            minimum={"left": self.least},
            metric=False,
            motion_model="linear",
            shutter="rolling",
            reference_point="left",
            reference=reference,
            assumes=assumes,
        )

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": self.least}

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        start = self._start(correspondences, rig)
        if isinstance(start, str):
            return MotionEstimate.failed(start)
        rows = Rows.of(temporal_pairs(correspondences, "left"), rig.camera, 0.0)
        if self.refinement == "sampson":
            start = refine(start, rows, turning=self.turning, most=_FULL)
        return self._reported(start, rows)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        start = self._start(sample, rig)
        if isinstance(start, str):
            return [MotionEstimate.failed(start)]
        return [self._reported(start, Rows.of(temporal_pairs(sample, "left"), rig.camera, 0.0))]

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        if self.refinement == "none":
            return self.estimate(correspondences, rig, shutter)
        rows = Rows.of(temporal_pairs(correspondences, "left"), rig.camera, 0.0)
        if len(rows.x) < self.least:
            return MotionEstimate.failed(f"{len(rows.x)} left matches, need {self.least}")
        rate = float(shutter.rate("left")[1]) * rig.camera.fy  # frame periods in a unit of s
        w, d = rate * motion.w, rate * motion.d
        start = FreeMotion(so3.exp(motion.w), np.array(motion.d), d, d, w, w)
        return self._reported(refine(start, rows, turning=self.turning, most=_QUICK if quick else _FULL), rows)

    def _start(self, correspondences: Correspondences, rig: StereoRig) -> FreeMotion | str:
        """The linear solution, from the first row."""
        matches = temporal_pairs(correspondences, "left")
        short = self.spec.shortage({"left": len(matches)})
        if short is not None:
            return short.reason
        found = self.linear(Rows.of(matches, rig.camera, rig.camera.cy))
        if isinstance(found, str):
            return found
        if not all(np.all(np.isfinite(part)) for part in found):
            return "no finite motion fits"
        return from_row(found.of_unit_length(), -rig.camera.cy / rig.camera.fy)

    def _reported(self, motion: FreeMotion, rows: Rows) -> MotionEstimate:
        motion = signed(motion.of_unit_length(), rows)
        w = so3.log(motion.R)
        if not np.all(np.isfinite([*w, *motion.t])):
            return MotionEstimate.failed("no finite motion fits")
        reason = "the length of d is not determined by one camera"
        return MotionEstimate(w=w, d=motion.t, success=True, reason=reason)
