"""What the solvers with free velocities of both frames share: all but their linear part."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.free_descent import refine
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, from_row, signed, squares

_QUICK, _FULL = 8, 100


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
    def linear(self, rows: Rows) -> list[FreeMotion] | str:
        """Motions that rows whose s = 0 is the principal point's may have, or why there is none; signs are open."""

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Other motions to descend from, of the same rows."""
        return []

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
        matches = temporal_pairs(correspondences, "left")
        found = self._linear(matches, rig)
        if isinstance(found, str):
            return MotionEstimate.failed(found)
        rows = Rows.of(matches, rig.camera, 0.0)
        found = [_at_first_row(each, rig.camera) for each in found]
        if self.refinement == "none":
            return _reported(found[0], rows)
        middle = Rows.of(matches, rig.camera, rig.camera.cy)
        others = _likely(self.starts(middle), middle)
        found += [_at_first_row(each, rig.camera) for each in others]
        # What a linear solution's velocities are worth is seen by the errors that a descent without them ends with.
        ends = [self._refined(each, rows, _FULL) for each in [found[0], *(each.at_rest() for each in found)]]
        best = min(_in_front([end for end, _ in ends], rows), key=lambda k: ends[k][1])
        return _reported(ends[best][0], rows)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        matches = temporal_pairs(sample, "left")
        found = self._linear(matches, rig)
        if isinstance(found, str):
            return [MotionEstimate.failed(found)]
        rows = Rows.of(matches, rig.camera, 0.0)
        return [_reported(_at_first_row(found[0], rig.camera), rows)]

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
        return _reported(self._refined(start, rows, _QUICK if quick else _FULL)[0], rows)

    def _refined(self, start: FreeMotion, rows: Rows, most: int) -> tuple[FreeMotion, float]:
        return refine(start, rows, turning=self.turning, most=most)

    def _linear(self, matches: FloatArray, rig: StereoRig) -> list[FreeMotion] | str:
        """The linear solutions that have points in front, the best first, with s = 0 at the principal point's."""
        short = self.spec.shortage({"left": len(matches)})
        if short is not None:
            return short.reason
        rows = Rows.of(matches, rig.camera, rig.camera.cy)
        found = self.linear(rows)
        return found if isinstance(found, str) else _likely(found, rows) or "no finite motion fits"


def _in_front(motions: list[FreeMotion], rows: Rows) -> list[int]:
    """Which have more than half as many points in front as any has: the twins of right motions have not."""
    fronts = [signed(each, rows)[1] for each in motions]
    return [k for k, front in enumerate(fronts) if 2 * front >= max(fronts)]


def _likely(motions: list[FreeMotion], rows: Rows) -> list[FreeMotion]:
    """Those of which enough points are in front, of the least errors first."""
    finite = [each.of_unit_length() for each in motions if all(np.all(np.isfinite(part)) for part in each)]
    return sorted((finite[k] for k in _in_front(finite, rows)), key=lambda each: squares(each, rows))


def _at_first_row(motion: FreeMotion, camera: PinholeCamera) -> FreeMotion:
    return from_row(motion, -camera.cy / camera.fy)


def _reported(motion: FreeMotion, rows: Rows) -> MotionEstimate:
    motion, _ = signed(motion.of_unit_length(), rows)
    w = so3.log(motion.R)
    if not np.all(np.isfinite([*w, *motion.t])):
        return MotionEstimate.failed("no finite motion fits")
    reason = "the length of d is not determined by one camera"
    return MotionEstimate(w=w, d=motion.t, success=True, reason=reason)
