"""Relative pose of a camera or a rig whose two angles to gravity are known, of a global shutter.

F. Fraundorfer, P. Tanskanen, M. Pollefeys, A Minimal Case Solution to the Calibrated Relative Pose Problem for the
Case of Two Known Orientation Angles, ECCV 2010: with the rays of both frames turned until things fall along y,
what is left of the rotation is one angle about y, and three matches of one camera give it and the direction of the
translation. On a rig, as a generalised camera of known vertical, four matches give the length of the translation
too. The minimal solvers are PoseLib's. Of many matches of one camera,

    n . T = 0,   n = R x cross y,   R = A1^T R_y(angle) A0

is linear in T for each angle: the best angle is where the smallest eigenvalue of the sum of n n^T has its minimum.
From there, least squares of the Sampson error in the angle and d.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, final

import numpy as np
import scipy

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.epipolar import in_front
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.levenberg_marquardt import Minimum, levenberg_marquardt
from rsbench.solvers.engine.packed import Packed, inverse_definite, pack
from rsbench.solvers.engine.poselib_adapter import MISSING, poselib_module

_DOWN = np.array([0.0, 1.0, 0.0])
_ANGLES = 90
_QUICK, _FULL = 8, 50
_LONGEST = 100.0
"""Metres: pairs whose length is open run there."""
_MAX_SCALE_SIGMA = 0.5
"""Relative standard deviation of the length of d above which it does not count as metric, as in ``refined``."""


class Uprights(NamedTuple):
    """Turns (3, 3) of the rays of frame 0 and 1 until things fall along y."""

    first: FloatArray
    second: FloatArray

    @classmethod
    def of(cls, gravity: FloatArray) -> Uprights | None:
        """Of the directions (n, 4) nearest to tau = 0 and 1; None where one is missing or has no length."""
        turns = []
        for frame in (0.0, 1.0):
            near = gravity[np.argsort(np.abs(gravity[:, 0] - frame), kind="stable")[:1]]
            length = float(np.linalg.norm(near[:, 1:]))
            if not (len(near) and abs(near[0, 0] - frame) < 0.5 and 0.0 < length < np.inf):
                return None
            g = near[0, 1:] / length
            axis = so3.cross(g, _DOWN)
            sine = float(np.linalg.norm(axis))
            # Where it points up, any horizontal axis is as good.
            axis = axis / sine if sine > 0.0 else np.array([1.0, 0.0, 0.0])
            turns.append(so3.exp(np.arctan2(sine, g[1]) * axis))
        return cls(*turns)

    def rotation(self, angle: float) -> FloatArray:
        """(3, 3) of the body of frame 1 from frame 0."""
        return np.asarray(self.second.T @ so3.exp(angle * _DOWN) @ self.first)

    def angle(self, w: FloatArray) -> float:
        """That of the nearest rotation."""
        R = self.second @ so3.exp(w) @ self.first.T
        return float(np.arctan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2]))


def best_angle(x: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
    """The angle, and the direction of the translation (3,), of upright rays x, y (n, 3) of one camera; n >= 4.

    The turned normal is ``n = a + cos b + sin c``.
    """
    flat, along = x * [1.0, 0.0, 1.0], x * _DOWN
    parts = np.stack([so3.cross(each, y) for each in (along, flat, so3.cross(_DOWN, flat))])
    products = np.einsum("ank,bnl->abkl", parts, parts)

    def smallest(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
        f = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)
        values, vectors = np.linalg.eigh(np.einsum("...a,...b,abkl->...kl", f, f, products))
        return values[..., 0], vectors[..., 0]

    step = 2.0 * np.pi / _ANGLES
    grid: FloatArray = np.arange(_ANGLES, dtype=np.float64) * step - np.pi
    middle = grid[np.argmin(smallest(grid)[0])]
    found = scipy.optimize.minimize_scalar(
        lambda angle: float(smallest(np.array(angle))[0]),
        bounds=(middle - step, middle + step),
        method="bounded",
        options={"xatol": 1e-9},
    )
    return float(found.x), smallest(np.array(found.x))[1]


@final
@dataclass(frozen=True, kw_only=True)
class UprightSolver(Solver):
    """PoseLib's minimal solvers of known vertical; least squares in what gravity leaves open."""

    cameras_used: Literal["left", "both"] = "left"
    """The left camera's own motion without a length, or the rig's in metres."""
    refinement: Literal["upright", "free"] = "upright"
    """Whether what gravity has wrong stays wrong in the end, or the last least squares turn all three angles."""

    @property
    def spec(self) -> SolverSpec:
        minimum: dict[MatchSet, int] = {"left": 5, "gravity": 2}
        if self._stereo:
            minimum["right"] = 2
        fraundorfer = "Fraundorfer, Tanskanen, Pollefeys, ECCV 2010"
        return SolverSpec(
            needs=frozenset(minimum),
            minimum=minimum,
            metric=self._stereo,
            motion_model="linear",
            shutter="global",
            reference_point="body" if self._stereo else "left",
            reference=f"PoseLib, gen_relpose_upright_4pt; after {fraundorfer}" if self._stereo else fraundorfer,
            assumes="global shutter; gravity without noise; translation"
            + ("; rotation that moves the baseline, for the scale" if self._stereo else ""),
        )

    @property
    def _stereo(self) -> bool:
        return self.cameras_used == "both"

    @property
    def _sides(self) -> tuple[Side, ...]:
        return SIDES if self._stereo else ("left",)

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 2, "right": 2} if self._stereo else {"left": 3}

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches, up = self._given(correspondences)
        counts: dict[MatchSet, int] = {"gravity": len(correspondences.gravity)}
        for side in self._sides:
            counts[side] = len(matches[side])
        short = self.spec.shortage(counts)
        if short is not None:
            return short
        if up is None:
            return MotionEstimate.failed("no direction of gravity near the start of either frame")
        rays = [rig.camera.unproject(matches["left"][:, k : k + 2]) for k in (0, 2)]
        if not np.all(np.isfinite(rays)) or np.max(np.abs(rays)) > 1e6:
            return MotionEstimate.failed("matches too far away to compute with")
        angle, direction = best_angle(rays[0] @ up.first.T, rays[1] @ up.second.T)
        d = _signed(up.rotation(angle), up.second.T @ direction, *rays)
        return self._refined(up, up.rotation(angle), 0.5 * rig.baseline * d, correspondences, rig, _FULL)

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        matches, up = self._given(correspondences)
        if up is None or sum(len(each) for each in matches.values()) < 5:
            return self.estimate(correspondences, rig, shutter)
        R = so3.exp(motion.w) if self.refinement == "free" else up.rotation(up.angle(motion.w))
        return self._refined(up, R, np.array(motion.d), correspondences, rig, _QUICK if quick else _FULL)

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        poselib, (matches, up) = poselib_module(), self._given(sample)
        if poselib is None:
            return [MotionEstimate.failed(MISSING)]
        if up is None:
            return [MotionEstimate.failed("no direction of gravity near the start of either frame")]
        places: list[list[FloatArray]] = [[], []]
        rays: list[list[FloatArray]] = [[], []]
        for side in self._sides:
            for k, turn in enumerate(up):
                x = rig.camera.unproject(matches[side][:, 2 * k : 2 * k + 2]) @ turn.T
                rays[k].append(x / np.linalg.norm(x, axis=1, keepdims=True))
                places[k].append(np.tile(-turn @ rig.offset(side), (len(x), 1)))
        (x, y), (p, q) = [np.concatenate(each) for each in rays], [np.concatenate(each) for each in places]
        poses = poselib.gen_relpose_upright_4pt(p, x, q, y) if self._stereo else poselib.relpose_upright_3pt(x, y)
        found = []
        for pose in poses:
            R, t = np.array(pose.R), np.array(pose.t)
            T = t + q - p @ R.T
            front = [np.count_nonzero(in_front(Pose(R, each), x, y)) for each in (T, -T)]
            if np.all(np.isfinite(R)) and np.all(np.isfinite(t)) and (front[0] >= front[1] or not self._stereo):
                w, d = so3.log(up.second.T @ R @ up.first), up.second.T @ t
                d = d if front[0] >= front[1] else -d
                found.append(MotionEstimate(w=w, d=d, success=True, metric=self._stereo))
        return found

    def _given(self, correspondences: Correspondences) -> tuple[dict[Side, FloatArray], Uprights | None]:
        matches = {side: temporal_pairs(correspondences, side) for side in self._sides}
        return matches, Uprights.of(correspondences.gravity)

    def _refined(
        self, up: Uprights, R: FloatArray, d: FloatArray, matches: Correspondences, rig: StereoRig, most: int
    ) -> MotionEstimate:
        """Least squares of the Sampson error from R (3, 3) and d (3,); without a length, d keeps its own."""
        about = rig if self._stereo else rig.about("left")
        pairs = Correspondences(**self._given(matches)[0])
        packed = pack(pairs, about, RollingShutter(height=rig.camera.height, readout_ratio=0.0))
        if len(packed.pairs) < 4 or not np.any(d):
            return MotionEstimate.failed("the matches leave the direction of d open")
        axes = np.eye(3) if self.refinement == "free" else _about(up.second.T @ _DOWN)
        descent = _Descent(packed, R, axes, free=self.refinement == "free")
        end = descent.minimum(d, most)
        if packed.in_front(descent.theta(end.theta)) < 0.5 * len(packed.pairs):
            other = descent.minimum(-end.theta[3:], most)
            if packed.in_front(descent.theta(other.theta)) > packed.in_front(descent.theta(end.theta)):
                end = other
        return self._reported(descent, end)

    def _reported(self, descent: _Descent, end: Minimum) -> MotionEstimate:
        w, d = descent.packed.motion(descent.theta(end.theta))
        if not (np.all(np.isfinite([*w, *d])) and np.any(d)):
            return MotionEstimate.failed("no finite motion fits")
        if not self._stereo:
            reason = "the length of d is not determined by one camera"
            return MotionEstimate(w=w, d=d / np.linalg.norm(d), success=True, reason=reason)
        inverse, freedom = inverse_definite(end.H), len(descent.packed.pairs) - descent.unknowns
        metric = inverse is not None and freedom > 0
        if inverse is not None and metric:
            variance = 2.0 * end.cost / freedom * (d @ inverse[3:, 3:] @ d)
            metric = bool(np.sqrt(variance) <= _MAX_SCALE_SIGMA * (d @ d))
        if not metric:
            # Noise alone gives a sign to a length that is open.
            front = [descent.packed.in_front(descent.packed.theta(w, each)) for each in (d, -d)]
            d = d if front[0] >= front[1] else -d
        reason = "" if metric else "the length of d is not determined by these matches"
        return MotionEstimate(w=w, d=d, success=True, metric=metric, reason=reason)


@dataclass(frozen=True, eq=False)
class _Descent:
    """Least squares of pairs in turns q[:3] about axes (rows, orthonormal) after a rotation, and in d = q[3:]."""

    packed: Packed
    R: FloatArray
    axes: FloatArray
    free: bool
    """Whether all axes count, or the first alone."""

    @property
    def unknowns(self) -> int:
        return 6 if self.free else 4

    def theta(self, q: FloatArray) -> FloatArray:
        return self.packed.theta(so3.log(so3.exp(q[:3] @ self.axes) @ self.R), q[3:])

    def minimum(self, d: FloatArray, most: int) -> Minimum:
        return levenberg_marquardt(self._evaluate, np.concatenate([np.zeros(3), d]), most, _LONGEST)

    def _evaluate(self, q: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        theta, turn = self.theta(q), q[:3] @ self.axes
        cost, gradient, H = self.packed.normal_equations(theta)
        M = np.eye(6)
        M[:3, :3] = np.linalg.solve(so3.left_jacobian(theta[:3]), so3.left_jacobian(turn) @ self.axes.T)
        gradient, H = M.T @ gradient, M.T @ H @ M
        if not self.free:
            gradient[1:3], H[1:3], H[:, 1:3] = 0.0, 0.0, 0.0
            H[1, 1] = H[2, 2] = H[0, 0]
        return cost, gradient, H


def _about(axis: FloatArray) -> FloatArray:
    """Orthonormal rows (3, 3) whose first is a unit vector."""
    rest: FloatArray = scipy.linalg.null_space(axis[None])
    return np.vstack([axis, rest.T])


def _signed(R: FloatArray, d: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """d or -d, whichever has more points in front of the camera."""
    front = [np.count_nonzero(in_front(Pose(R, each), x, y)) for each in (d, -d)]
    return d if front[0] >= front[1] else -d
