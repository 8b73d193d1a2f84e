"""Translation of a rolling-shutter camera or rig whose rotation a gyroscope tells.

C.-R. Lee, J. H. Yoon, M.-G. Park, K.-J. Yoon, Gyroscope-Aided Relative Pose Estimation for Rolling Shutter
Cameras, 2019, take the angular velocity within the frames from a gyroscope, and the rotation between them, with
the translation, from five matches. Here the gyroscope tells that too. For known rotations the exact constraint of
a match,

    n . T = 0,   n = R x cross y,   T = tau1 d - tau0 R d + o - R o,   R = R(tau1) R(tau0)^T,

is linear in d: two matches of one camera (o = 0) fix its direction, three of a rig (o, where the camera stands)
its length too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
import scipy

from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.epipolar import in_front, row_pair_pose, rs_constraint
from rsbench.core.gyro_motion import GyroMotion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.linear_systems import ROUNDING
from rsbench.solvers.engine.packed import inverse_definite

_MAX_SCALE_SIGMA = 0.5
"""Relative standard deviation of the length of d above which it does not count as metric, as in ``refined``."""
_CONTRADICTED = 3.0
"""Times as many points in front of the cameras for -d as for d, beyond which d has no length."""


@final
@dataclass(frozen=True, kw_only=True)
class GyroSolver(Solver):
    """Linear least squares for d, then those of the exact Sampson error; the rotation is what the samples say.

    What the gyroscope has wrong stays wrong: w is its integral.
    """

    cameras_used: Literal["left", "both"] = "left"
    """The left camera's own translation without a length, or the rig's in metres."""
    refinement: Literal["none", "sampson"] = "sampson"
    """``sampson``: least squares of the Sampson errors of all matches at the end; ``none``: without."""

    @property
    def spec(self) -> SolverSpec:
        minimum: dict[MatchSet, int] = {"left": 2, "gyro": 2}
        if self._stereo:
            minimum["right"] = 1
        return SolverSpec(
            needs=frozenset(minimum),
            minimum=minimum,
            metric=self._stereo,
            motion_model="linear",
            shutter="rolling",
            cameras="lens",
            reference_point="body" if self._stereo else "left",
            reference="after Lee et al.: Gyroscope-Aided Relative Pose for Rolling Shutter Cameras, 2019",
            assumes="a gyroscope without bias and delay, aligned with the cameras; constant linear velocity",
        )

    @property
    def _stereo(self) -> bool:
        return self.cameras_used == "both"

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 2, "right": 1} if self._stereo else {"left": 2}

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        return self._solved(correspondences, rig, shutter, self.refinement == "sampson")

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return [self._solved(sample, rig, shutter, False)]

    def _solved(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, descend: bool
    ) -> MotionEstimate:
        sides: tuple[Side, ...] = SIDES if self._stereo else ("left",)
        matches = {side: temporal_pairs(correspondences, side) for side in sides}
        counts: dict[MatchSet, int] = {"gyro": len(correspondences.gyro)}
        for side in sides:
            counts[side] = len(matches[side])
        short = self.spec.shortage(counts)
        if short is not None:
            return short
        if not np.ptp(correspondences.gyro[:, 0]) > 0.0:
            return MotionEstimate.failed("all samples of the gyroscope have one time")
        about = rig if self._stereo else rig.about("left")
        motion = GyroMotion(correspondences.gyro, np.zeros(3))
        constraints = _Constraints.of(motion, about, shutter, matches)
        d, metric = _translation(constraints.m, constraints.beta)
        if d is None:
            return MotionEstimate.failed("the matches leave the direction of d open: degenerate motion or scene")
        sigma = np.inf
        if descend:
            d, sigma = constraints.refined(d)
        metric = metric and (not descend or sigma <= _MAX_SCALE_SIGMA)
        if not (np.all(np.isfinite(d)) and np.any(d)):
            return MotionEstimate.failed("no finite translation fits")
        # At last: a step of the descent may lead through zero to the other side.
        d, metric = _signed(motion, d, metric, about, shutter, matches)
        reason = "" if metric else "the length of d is not determined by these matches"
        d = d if self._stereo else d / np.linalg.norm(d)
        return MotionEstimate(w=motion.w, d=d, success=True, metric=metric, reason=reason)


def _translation(m: FloatArray, beta: FloatArray) -> tuple[FloatArray | None, bool]:
    """d (3,) and whether it has a length; None where its direction is open.

    The smallest singular vector of [m, beta], as in ``linear_systems.scaled_translation``; of m alone where
    nothing turns or one camera is asked.
    """
    sizes = np.linalg.norm(m), np.linalg.norm(beta)
    if not (np.isfinite(sizes[0]) and sizes[0] > 0.0):
        return None, False
    _, s, Vt = np.linalg.svd(m / sizes[0], full_matrices=len(m) < 3)
    direction = Vt[-1] if s[1] > ROUNDING * s[0] else None
    if not sizes[1] > ROUNDING * sizes[0]:
        return direction, False
    _, s, Vt = np.linalg.svd(np.column_stack([m / sizes[0], beta / sizes[1]]), full_matrices=len(m) < 4)
    factor = Vt[-1, 3] / sizes[1]
    if len(s) < 3 or not (s[2] > ROUNDING * s[0] and abs(factor) * 1e6 > np.linalg.norm(Vt[-1, :3]) / sizes[0]):
        return direction, False
    return np.asarray(Vt[-1, :3] / sizes[0] / factor), True


@dataclass(frozen=True)
class _Constraints:
    """The exact constraints at known rotations, ``m . d + beta = 0``, and their derivatives by the pixels.

    Both are affine in d: their values at no translation and at three unit ones say all.
    """

    m: FloatArray
    """(n, 3)"""
    beta: FloatArray
    """(n,)"""
    q: FloatArray
    """(n, 4, 3) factors of d in the derivatives by x0, y0, x1, y1."""
    q0: FloatArray
    """(n, 4)"""

    @classmethod
    def of(
        cls, motion: GyroMotion, rig: StereoRig, shutter: RollingShutter, matches: Mapping[Side, FloatArray]
    ) -> _Constraints:
        def at(d: FloatArray) -> tuple[FloatArray, FloatArray]:
            found = [rs_constraint(rig, shutter, motion.along(d), side, pairs) for side, pairs in matches.items()]
            return np.concatenate([value for value, _ in found]), np.concatenate([each for _, each in found])

        beta, q0 = at(np.zeros(3))
        units = [at(unit) for unit in np.eye(3)]
        m = np.stack([value - beta for value, _ in units], axis=-1)
        return cls(m, beta, np.stack([gradient - q0 for _, gradient in units], axis=-1), q0)

    def errors(self, d: FloatArray) -> FloatArray:
        """Sampson errors (n,), px."""
        norm = np.linalg.norm(self.q @ d + self.q0, axis=1)
        return np.asarray((self.m @ d + self.beta) / np.maximum(norm, 1e-300))

    def jacobian(self, d: FloatArray) -> FloatArray:
        """(n, 3) of ``errors`` by d."""
        gradient = self.q @ d + self.q0
        norm = np.maximum(np.linalg.norm(gradient, axis=1), 1e-300)[:, None]
        by_norm = np.einsum("ni,nij->nj", gradient, self.q) / norm
        return np.asarray((self.m - self.errors(d)[:, None] * by_norm) / norm)

    def refined(self, d: FloatArray) -> tuple[FloatArray, float]:
        """d of the least squares, and the relative standard deviation of its length."""
        if len(self.m) < 3:
            return d, np.inf
        end = scipy.optimize.least_squares(self.errors, d, self.jacobian, method="lm", max_nfev=50, xtol=1e-12)
        if not np.all(np.isfinite(end.x)):
            return d, np.inf
        J, freedom = self.jacobian(end.x), len(end.fun) - 3
        inverse = inverse_definite(J.T @ J)
        if inverse is None or freedom < 1:
            return end.x, np.inf
        variance = float(end.fun @ end.fun) / freedom
        return end.x, float(np.sqrt(variance * (end.x @ inverse @ end.x))) / float(end.x @ end.x)


def _signed(
    motion: GyroMotion,
    d: FloatArray,
    metric: bool,
    rig: StereoRig,
    shutter: RollingShutter,
    matches: Mapping[Side, FloatArray],
) -> tuple[FloatArray, bool]:
    """d or -d, whichever has more points in front of the cameras, and whether its length counts.

    A length has a sign of its own, which what the gyroscope has wrong may turn: one that most points contradict
    is none.
    """
    votes = []
    for each in (d, -d):
        count = 0
        for side, m in matches.items():
            pose = row_pair_pose(rig, shutter, motion.along(each), side, m[:, 1], m[:, 3])
            x, y = rig.camera.unproject(m[:, :2]), rig.camera.unproject(m[:, 2:])
            count += int(np.count_nonzero(in_front(pose, x, y)))
        votes.append(count)
    behind = votes[1] > (_CONTRADICTED * votes[0] if metric else votes[0])
    return (-d, False) if behind else (d, metric)
