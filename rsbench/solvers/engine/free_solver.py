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
from rsbench.solvers.eight_point import eight_point
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.free_descent import refine
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows, from_row, signed, squares

_MOST_TURN = 1.0
"""Radians in a frame; cameras that spin faster pass every match nearly, and fit what there is."""
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_QUICK, _FULL = 8, 100
"""Evaluations of a descent that is one of several or a step of a search, and of one whose end is told."""


@dataclass(frozen=True, kw_only=True)
class FreeVelocitySolver(Solver):
    """Linear on the left camera's matches, then least squares of the Sampson error of the same model."""

    refinement: Literal["none", "sampson"] = "sampson"
    """``sampson``: least squares of the Sampson errors of all matches at the end; ``none``: without."""

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
        """Motions of rows whose s = 0 is the principal point's, their signs open, or why there is none."""

    def starts(self, rows: Rows) -> list[FreeMotion]:
        """Other motions to descend from, of the same rows."""
        return []

    def matches_of(self, correspondences: Correspondences) -> FloatArray:
        """The matches (n, 4) that it uses, or (n, 8) with their affine frames."""
        return temporal_pairs(correspondences, "left")

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
        return self._estimated(self.matches_of(correspondences), rig, [])

    def _estimated(self, matches: FloatArray, rig: StereoRig, near: list[FreeMotion]) -> MotionEstimate:
        """From the linear solutions, those of smaller models, and motions from the first row that may be near."""
        found = self.from_equations(matches, rig)
        if self.refinement == "none" or len(matches) < self.least:
            return first_of(found, matches, rig)
        middle = self.starts(Rows.of(matches, rig.camera, rig.camera.cy))
        middle += [] if isinstance(found, str) else found
        if isinstance(found, str) and not (middle or near):
            return MotionEstimate.failed(found)
        begun = [*near, *(_at_first_row(each, rig.camera) for each in middle)]
        rows = Rows.of(matches, rig.camera, 0.0)
        # Noise may have spoiled a linear solution's velocities: each starts a descent with them and one without.
        ends = [self._refined(each, rows, _QUICK) for each in [*begun, *(each.at_rest() for each in begun)]]
        gentle = [end for end in ends if _turn(end[0], rig.camera) < _MOST_TURN] or ends
        best = min(_in_front([end for end, _ in gentle], rows), key=lambda k: gentle[k][1])
        return _reported(self._refined(gentle[best][0], rows, _FULL)[0], rows)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        matches = self.matches_of(sample)
        return [first_of(self.from_equations(matches, rig), matches, rig)]

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
        matches = self.matches_of(correspondences)
        rows = Rows.of(matches, rig.camera, 0.0)
        least = self.sample_sizes(correspondences)["left"]
        if len(rows.x) < least:
            return MotionEstimate.failed(f"{len(rows.x)} left matches, need {least}")
        rate = float(shutter.rate("left")[1]) * rig.camera.fy  # frame periods in a unit of s
        w, d = rate * motion.w, rate * motion.d
        start = FreeMotion(so3.exp(motion.w), np.array(motion.d), d, d, w, w)
        if quick or len(rows.x) < self.least:
            return _reported(self._refined(start, rows, _QUICK)[0], rows)
        return self._estimated(matches, rig, [start])

    def _refined(self, start: FreeMotion, rows: Rows, most: int) -> tuple[FreeMotion, float]:
        return refine(start, rows, turning=self.turning, most=most)

    def from_equations(self, matches: FloatArray, rig: StereoRig) -> list[FreeMotion] | str:
        """The linear solutions, s = 0 at the principal point: with most points in front first, by their errors."""
        frames = len(matches) if matches.shape[1] > 4 else 0
        short = self.spec.shortage({"left": len(matches), "affine": frames})
        if short is not None:
            return short.reason
        rows = Rows.of(matches, rig.camera, rig.camera.cy)
        found = self.linear(rows)
        if isinstance(found, str):
            return found
        finite = [each.of_unit_length() for each in found if all(np.all(np.isfinite(part)) for part in each)]
        order = sorted(range(len(finite)), key=lambda k: squares(finite[k], rows))
        front = set(_in_front(finite, rows))
        return [finite[k] for k in sorted(order, key=lambda k: k not in front)] or "no finite motion fits"


def without_velocities(rows: Rows) -> FreeMotion | None:
    """R and t of one essential matrix for all rows, of the eight-point algorithm; None where there are more."""
    E = eight_point(rows.x, rows.y)
    return None if E is None else at_rest_of(E, rows)


def at_rest_of(E: FloatArray, rows: Rows) -> FreeMotion:
    """R and t of an essential matrix (3, 3), those with more points in front; no velocities."""
    U, _, Vt = np.linalg.svd(E)
    R = U @ QUARTER @ Vt
    motion = FreeMotion(R * np.sign(np.linalg.det(R)), U[:, 2], *np.zeros((4, 3)))
    return max((signed(each, rows) for each in (motion, motion.twin())), key=lambda found: found[1])[0]


def _in_front(motions: list[FreeMotion], rows: Rows) -> list[int]:
    """Which have more than half as many points in front as any has: the twins of right motions have not."""
    fronts = [signed(each, rows)[1] for each in motions]
    return [k for k, front in enumerate(fronts) if 2 * front >= max(fronts)]


def _turn(motion: FreeMotion, camera: PinholeCamera) -> float:
    """Radians within a frame."""
    return max(float(np.linalg.norm(w)) for w in (motion.w0, motion.w1)) * camera.height / camera.fy


def first_of(found: list[FreeMotion] | str, matches: FloatArray, rig: StereoRig) -> MotionEstimate:
    """The first of linear solutions, as it is."""
    if isinstance(found, str):
        return MotionEstimate.failed(found)
    return _reported(_at_first_row(found[0], rig.camera), Rows.of(matches, rig.camera, 0.0))


def _at_first_row(motion: FreeMotion, camera: PinholeCamera) -> FreeMotion:
    return from_row(motion, -camera.cy / camera.fy)


def _reported(motion: FreeMotion, rows: Rows) -> MotionEstimate:
    motion, _ = signed(motion.of_unit_length(), rows)
    return motion_of(so3.log(motion.R), motion.t)


def motion_of(w: FloatArray, d: FloatArray) -> MotionEstimate:
    """w and d (3,) as an answer."""
    if not np.all(np.isfinite([*w, *d])):
        return MotionEstimate.failed("no finite motion fits")
    reason = "the length of d is not determined by one camera"
    return MotionEstimate(w=w, d=d, success=True, reason=reason)
