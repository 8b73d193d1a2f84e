"""Solvers that get part of the rotation from a sensor: a gyroscope (``GyroSolver``) or gravity
(``UprightSolver``).

C.-R. Lee, J. H. Yoon, M.-G. Park, K.-J. Yoon, Gyroscope-Aided Relative Pose Estimation for Rolling Shutter
Cameras, 2019, take the angular velocity within the frames from a gyroscope, and estimate the rotation between them
and the translation from five matches. Here the gyroscope gives the whole rotation. For known rotations, the exact
constraint of a match,

    n . T = 0,   n = R x cross y,   T = tau1 d - tau0 R d + o - R o,   R = R(tau1) R(tau0)^T,

is linear in d. Two matches of one camera (o = 0) determine the direction of d; three matches of a rig (o: offset
of the camera) determine its length too.

F. Fraundorfer, P. Tanskanen, M. Pollefeys, A Minimal Case Solution to the Calibrated Relative Pose Problem for
the Case of Two Known Orientation Angles, ECCV 2010, assume a global shutter. After the rays of both frames are
rotated such that gravity points along y, one angle of the rotation, about y, remains unknown. Three matches of one
camera determine this angle and the direction of the translation. For a rig, as a generalised camera with known
vertical, four matches determine the length of the translation too. The minimal solvers are PoseLib's. For many
matches of one camera,

    n . T = 0,   n = R x cross y,   R = A1^T R_y(angle) A0

is linear in T for each angle, so the best angle minimises the smallest eigenvalue of the sum of n n^T. The result
is refined by least squares of the Sampson error over the angle and d.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, final

import numpy as np
import scipy

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.epipolar import in_front, match_pose, rs_constraint
from rsbench.core.imu import GyroMotion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.levenberg_marquardt import Minimum, levenberg_marquardt
from rsbench.solvers.engine.packed import Packed, inverse_definite, pack
from rsbench.solvers.linear import ROUNDING
from rsbench.solvers.poselib import MISSING, poselib_module

_MAX_SCALE_SIGMA = 0.5
"""Relative standard deviation of the length of d above which it does not count as metric, as in ``refined``."""
_CONTRADICTED = 3.0
"""Ratio of the points in front of the cameras for -d to those for d, above which |d| is rejected."""


@dataclass(frozen=True, kw_only=True)
class SensorSolver(Solver):
    """Solver for one camera or both, with part of the rotation given by another sensor."""

    cameras_used: Literal["left", "both"] = "left"
    """``left``: motion of the left camera, up to scale; ``both``: motion of the rig, in metres."""

    @property
    def _stereo(self) -> bool:
        return self.cameras_used == "both"

    def _matches(self, correspondences: Correspondences) -> dict[Side, FloatArray]:
        sides: tuple[Side, ...] = SIDES if self._stereo else ("left",)
        return {side: temporal_pairs(correspondences, side) for side in sides}

    def _shortage(self, correspondences: Correspondences, sensor: MatchSet) -> MotionEstimate | None:
        """Return a failed estimate if there are too few matches or samples, else None."""
        counts = {side: len(matches) for side, matches in self._matches(correspondences).items()}
        return self.spec.shortage({**counts, sensor: len(getattr(correspondences, sensor))})


@final
@dataclass(frozen=True, kw_only=True)
class GyroSolver(SensorSolver):
    """Rotation from gyroscope samples; d by linear least squares, refined on the exact Sampson error.

    w is the integral of the gyroscope's samples, so its errors are not corrected.
    """

    refinement: Literal["none", "sampson"] = "sampson"
    """``sampson``: final least squares of the Sampson errors of all matches; ``none``: no refinement."""

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
            cameras="rig",
            reference_point="body" if self._stereo else "left",
            reference="after Lee et al.: Gyroscope-Aided Relative Pose for Rolling Shutter Cameras, 2019",
            assumes="a gyroscope without bias and delay, aligned with the cameras; constant linear velocity",
        )

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
        matches = self._matches(correspondences)
        if short := self._shortage(correspondences, "gyro"):
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
        # The sign is decided last, because a step of the descent may reverse d.
        d, metric = _signed(motion, d, metric, about, shutter, matches)
        reason = "" if metric else "the length of d is not determined by these matches"
        d = d if self._stereo else d / np.linalg.norm(d)
        return MotionEstimate(w=motion.w, d=d, success=True, metric=metric, reason=reason)


def _translation(m: FloatArray, beta: FloatArray) -> tuple[FloatArray | None, bool]:
    """Return d (3,), or None if its direction is undetermined, and whether its length is determined.

    d follows from the smallest singular vector of [m, beta], as in ``linear.scaled_translation``, or from that of
    m alone if beta vanishes (no rotation, or one camera) or the length is undetermined.
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
    """The exact constraints for known rotations, ``m . d + beta = 0``, and their derivatives by the pixels.

    Both are affine in d, so their values at zero and at three unit translations determine the coefficients.
    """

    m: FloatArray
    """(n, 3)"""
    beta: FloatArray
    """(n,)"""
    q: FloatArray
    """(n, 4, 3) coefficients of d in the derivatives by x0, y0, x1, y1, which are q d + q0."""
    q0: FloatArray
    """(n, 4) constant part of these derivatives."""

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
        """Return Sampson errors (n,), px."""
        norm = np.linalg.norm(self.q @ d + self.q0, axis=1)
        return np.asarray((self.m @ d + self.beta) / np.maximum(norm, 1e-300))

    def jacobian(self, d: FloatArray) -> FloatArray:
        """Return the derivative (n, 3) of ``errors`` by d."""
        gradient = self.q @ d + self.q0
        norm = np.maximum(np.linalg.norm(gradient, axis=1), 1e-300)[:, None]
        by_norm = np.einsum("ni,nij->nj", gradient, self.q) / norm
        return np.asarray((self.m - self.errors(d)[:, None] * by_norm) / norm)

    def refined(self, d: FloatArray) -> tuple[FloatArray, float]:
        """Return d from least squares of the Sampson errors, and the relative standard deviation of |d|."""
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
    """Choose d or -d by the points in front of the cameras, and return whether its length is valid.

    If the length is known, so is the sign, but errors of the gyroscope may reverse it. If most points contradict
    the sign, d is reversed and its length is rejected.
    """
    votes = []
    for each in (d, -d):
        count = 0
        for side, m in matches.items():
            pose, eye = match_pose(rig, shutter, motion.along(each), side, m), rig.eye(side)
            x, y = eye.unproject(m[:, :2]), eye.unproject(m[:, 2:])
            count += int(np.count_nonzero(in_front(pose, x, y)))
        votes.append(count)
    behind = votes[1] > (_CONTRADICTED * votes[0] if metric else votes[0])
    return (-d, False) if behind else (d, metric)


_DOWN = np.array([0.0, 1.0, 0.0])
_NO_GRAVITY = "no direction of gravity near the start of either frame"
_ANGLES = 90
_UPRIGHT_QUICK, _UPRIGHT_FULL = 8, 50
_LONGEST = 100.0
"""Largest length of d, metres, which the descent reaches if the pairs do not determine the length."""


class Uprights(NamedTuple):
    """Rotations (3, 3) of the rays of frames 0 and 1 that align gravity with y."""

    first: FloatArray
    second: FloatArray

    @classmethod
    def of(cls, gravity: FloatArray) -> Uprights | None:
        """Compute the rotations from the directions (n, 4) of gravity nearest to tau = 0 and 1.

        Return None if there is none within half a frame period of either time, or it has no finite length above 0.
        """
        turns = []
        for frame in (0.0, 1.0):
            near = gravity[np.argsort(np.abs(gravity[:, 0] - frame), kind="stable")[:1]]
            length = float(np.linalg.norm(near[:, 1:]))
            if not (len(near) and abs(near[0, 0] - frame) < 0.5 and 0.0 < length < np.inf):
                return None
            g = near[0, 1:] / length
            axis = so3.cross(g, _DOWN)
            sine = float(np.linalg.norm(axis))
            # If gravity points along -y, any horizontal axis will do.
            axis = axis / sine if sine > 0.0 else np.array([1.0, 0.0, 0.0])
            turns.append(so3.exp(np.arctan2(sine, g[1]) * axis))
        return cls(*turns)

    def rotation(self, angle: float) -> FloatArray:
        """Return the body's rotation (3, 3) from frame 0 to frame 1 for an angle about gravity."""
        return np.asarray(self.second.T @ so3.exp(angle * _DOWN) @ self.first)

    def angle(self, w: FloatArray) -> float:
        """Return the angle of the rotation nearest to exp([w]x) that is consistent with gravity."""
        R = self.second @ so3.exp(w) @ self.first.T
        return float(np.arctan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2]))


def best_angle(x: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
    """Return the angle and the direction of translation (3,) for upright rays x, y (n, 3) of one camera; n >= 4.

    The normal of a match is ``n = a + cos(angle) b + sin(angle) c``.
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
class UprightSolver(SensorSolver):
    """Minimal solvers of PoseLib for known vertical, then least squares over the remaining angle and d."""

    refinement: Literal["upright", "free"] = "upright"
    """``upright``: the given gravity is kept, with its errors; ``free``: all three angles are refined."""

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

    def sample_sizes(self, correspondences: Correspondences) -> Mapping[MatchSet, int]:
        return {"left": 2, "right": 2} if self._stereo else {"left": 3}

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        matches, up = self._given(correspondences)
        if short := self._shortage(correspondences, "gravity"):
            return short
        if up is None:
            return MotionEstimate.failed(_NO_GRAVITY)
        rays = [rig.camera.unproject(matches["left"][:, k : k + 2]) for k in (0, 2)]
        if not np.all(np.isfinite(rays)) or np.max(np.abs(rays)) > 1e6:
            return MotionEstimate.failed("matches too far away to compute with")
        angle, direction = best_angle(rays[0] @ up.first.T, rays[1] @ up.second.T)
        R, d = up.rotation(angle), up.second.T @ direction
        d = 0.5 * rig.baseline * (_sign(R, d, *rays) * d)
        return self._refined(up, R, d, correspondences, rig, _UPRIGHT_FULL)

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
        return self._refined(
            up, R, np.array(motion.d), correspondences, rig, _UPRIGHT_QUICK if quick else _UPRIGHT_FULL
        )

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        poselib, (matches, up) = poselib_module(), self._given(sample)
        if poselib is None:
            return [MotionEstimate.failed(MISSING)]
        if up is None:
            return [MotionEstimate.failed(_NO_GRAVITY)]
        places: list[list[FloatArray]] = [[], []]
        rays: list[list[FloatArray]] = [[], []]
        for side, pairs in matches.items():
            for k, turn in enumerate(up):
                x = rig.camera.unproject(pairs[:, 2 * k : 2 * k + 2]) @ turn.T
                rays[k].append(x / np.linalg.norm(x, axis=1, keepdims=True))
                places[k].append(np.tile(-turn @ rig.offset(side), (len(x), 1)))
        (x, y), (p, q) = [np.concatenate(each) for each in rays], [np.concatenate(each) for each in places]
        poses = poselib.gen_relpose_upright_4pt(p, x, q, y) if self._stereo else poselib.relpose_upright_3pt(x, y)
        found = []
        for pose in poses:
            R, t = np.array(pose.R), np.array(pose.t)
            sign = _sign(R, t + q - p @ R.T, x, y)
            if np.all(np.isfinite(R)) and np.all(np.isfinite(t)) and (sign > 0.0 or not self._stereo):
                w, d = so3.log(up.second.T @ R @ up.first), sign * (up.second.T @ t)
                found.append(MotionEstimate(w=w, d=d, success=True, metric=self._stereo))
        return found

    def _given(self, correspondences: Correspondences) -> tuple[dict[Side, FloatArray], Uprights | None]:
        return self._matches(correspondences), Uprights.of(correspondences.gravity)

    def _refined(
        self, up: Uprights, R: FloatArray, d: FloatArray, matches: Correspondences, rig: StereoRig, most: int
    ) -> MotionEstimate:
        """Minimise the Sampson error by least squares, starting from R (3, 3) and d (3,)."""
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
            return MotionEstimate.of_one_camera(w, d / np.linalg.norm(d))
        inverse, freedom = inverse_definite(end.H), len(descent.packed.pairs) - descent.unknowns
        metric = inverse is not None and freedom > 0
        if inverse is not None and metric:
            variance = 2.0 * end.cost / freedom * (d @ inverse[3:, 3:] @ d)
            metric = bool(np.sqrt(variance) <= _MAX_SCALE_SIGMA * (d @ d))
        if not metric:
            d = descent.packed.signed(w, d)  # if the length is undetermined, noise decides the sign of d
        reason = "" if metric else "the length of d is not determined by these matches"
        return MotionEstimate(w=w, d=d, success=True, metric=metric, reason=reason)


@dataclass(frozen=True, eq=False)
class _Descent:
    """Least squares over q: rotation angles q[:3] about ``axes``, applied after R, and translation d = q[3:].

    The axes are orthonormal rows.
    """

    packed: Packed
    R: FloatArray
    axes: FloatArray
    free: bool
    """Whether rotations about all axes are estimated, or only about the first one."""

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
    """Return orthonormal rows (3, 3), the first of which is the unit vector ``axis``."""
    rest: FloatArray = scipy.linalg.null_space(axis[None])
    return np.vstack([axis, rest.T])


def _sign(R: FloatArray, T: FloatArray, x: FloatArray, y: FloatArray) -> float:
    """Return -1 if -T puts more points of rays x, y (n, 3) in front than T (3,) or (n, 3), else 1."""
    front = [np.count_nonzero(in_front(Pose(R, each), x, y)) for each in (T, -T)]
    return 1.0 if front[0] >= front[1] else -1.0
