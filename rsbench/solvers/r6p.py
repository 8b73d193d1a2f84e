"""Absolute pose of a rolling-shutter frame from six points, whose depth is from the stereo pair of the frame
before.

C. Albl, Z. Kukelova, T. Pajdla, R6P: Rolling Shutter Absolute Camera Pose, CVPR 2015, assume constant angular and
linear velocity during the readout. With s the time since the first row,

    lambda x = (I + s [w']x) R X + C + s t'      (single linearisation)
    lambda x = (I + s [w']x) (I + [v]x) X + C + s t'      (double linearisation, R near the identity).

Six points give twelve equations. Z. Kukelova, C. Albl, A. Sugimoto, T. Pajdla, Linear Solution to the Minimal
Absolute Pose Rolling Shutter Problem, ACCV 2018, solve the double linearisation in a few linear steps, in which
the v in [w']x [v]x X is fixed to its value from the previous step. Here Newton steps are used, which also
linearise about the previous w'. They cost the same, and for cameras that rotate by 30 degrees within the frame
they converge in 9 of 10 samples instead of 6. The single linearisation (C. Albl, Z. Kukelova, V. Larsson, T.
Pajdla, Rolling Shutter Camera Absolute Pose, PAMI 2020, by a Groebner basis) is solved by the same steps, with v
applied to R after each step. Algebraic solvers give all solutions; this solver gives one, near its initial
orientation.

As published, P3P first rotates the points, so that R is near the identity. Samples are scored by the reprojection
errors for all twelve unknowns, not by the pose alone: with free velocities, the pose from six points may be far
off although pose and velocities together fit.

For coplanar points, one combination of unknowns is undetermined to first order. For a camera at rest that faces
the plane at distance Z, with s = a (y - y0), it is a pitch of 1 with a rise of Z and a speed of -Z / a along the
axis. Noise then determines it (compare C. Albl, A. Sugimoto, T. Pajdla, Degeneracies in Rolling Shutter SfM, ECCV
2016).

The points come from the stereo pair of frame 0, whose rows are read at different times too: see
``R6pSolver.frame_0``. All quantities are in the body's axes, so that C is the body's translation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, final

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import FRAME_1, Correspondences, stereo_points, with_depth
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, hat
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.ransac import BoolArray, IntArray, RansacOptions, ransac
from rsbench.solvers.poselib import P3pSolver, shortage_of_depth

_LEAST = 6
_STEPS = 6
"""Largest number of Newton steps; four suffice, up to rounding errors, if the camera rotates by a few degrees."""
_QUICK, _FULL = 4, 20
_SMALL = 1e-13
_OPEN = "the matches leave the pose and the velocity of frame 1 open"


class RowPose(NamedTuple):
    """Body pose at the first row of frame 1, ``R X + C``, and velocities per frame period; batch axes (...)."""

    R: FloatArray
    """(..., 3, 3)"""
    C: FloatArray
    """(..., 3)"""
    w: FloatArray
    """(..., 3) rad"""
    t: FloatArray
    """(..., 3)"""

    @property
    def finite(self) -> FloatArray:
        """Whether all values are finite, (...) bool."""
        whole = np.concatenate([self.R.reshape(*self.C.shape[:-1], 9), *self[1:]], axis=-1)
        return np.asarray(np.all(np.isfinite(whole), axis=-1))


class Resection(NamedTuple):
    """Points from frame 0 and their images in frame 1; batch axes (...)."""

    body: FloatArray
    """(..., n, 3) points in the body at the time when frame 0 reads them, metres."""
    tau0: FloatArray
    """(..., n) these times; 0 if motion during frame 0 is ignored."""
    x: FloatArray
    """(..., c, n, 3) rays of c cameras, z = 1."""
    s: FloatArray
    """(..., c, n) frame periods since the first row of frame 1."""
    offset: FloatArray
    """(c, 1, 3) offsets of the cameras, metres."""
    focal: FloatArray
    """(2,) focal lengths, px."""

    @classmethod
    def of(
        cls, tracks: FloatArray, rig: StereoRig, shutter: RollingShutter, sides: tuple[Side, ...], moved: bool
    ) -> Resection:
        """Convert tracks (n, 8) with depth; ``moved``: whether motion during frame 0 is modelled."""
        tau0 = shutter.pixel_time(tracks[:, :2], 0, "left")
        return cls(
            stereo_points(tracks, rig),
            tau0 if moved else 0.0 * tau0,
            np.stack([rig.camera.unproject(tracks[:, FRAME_1[side]]) for side in sides]),
            np.stack([shutter.pixel_time(tracks[:, FRAME_1[side]], 1, side) - 1.0 for side in sides]),
            np.stack([rig.offset(side) for side in sides])[:, None],
            np.array([rig.camera.fx, rig.camera.fy]),
        )

    def in_samples(self, count: int) -> Resection:
        """Split the points (n,) into samples (count, n / count)."""
        c = len(self.x)
        return self._replace(
            body=self.body.reshape(count, -1, 3),
            tau0=self.tau0.reshape(count, -1),
            x=np.swapaxes(self.x.reshape(c, count, -1, 3), 0, 1),
            s=np.swapaxes(self.s.reshape(c, count, -1), 0, 1),
        )

    def points(self, w: FloatArray, d: FloatArray) -> FloatArray:
        """Return the points (..., n, 3) at time 0 for a body motion R = exp(tau w), t = tau d; w, d (..., 3)."""
        tau = self.tau0[..., None]
        back = so3.exp(-tau * w[..., None, :])
        return np.asarray((back @ (self.body - tau * d[..., None, :])[..., None])[..., 0])


def newton_step(data: Resection, X: FloatArray, v: FloatArray, w: FloatArray) -> FloatArray:
    """Solve for v, C, w', t' (..., 12) from points X (..., n, 3), linearised about v and w' = ``w`` (..., 3).

    The result is NaN if the pose is undetermined.
    """
    X, v, w = X[..., None, :, :], v[..., None, None, :], w[..., None, None, :]
    s, swept = data.s[..., None, None], so3.cross(v, X)
    eye = np.broadcast_to(np.eye(3), (*data.s.shape, 3, 3))
    columns = np.concatenate([-(eye + s * hat(w)) @ hat(X), eye, -s * hat(X + swept), s * eye], axis=-1)
    rest = X + data.offset - s[..., 0] * so3.cross(w, swept)
    # The equations x P_z = P_x and y P_z = P_y are divided by the depth, so that residuals are errors of rays.
    A = (columns[..., :2, :] - data.x[..., :2, None] * columns[..., 2:, :]) / X[..., 2:, None]
    y = (data.x[..., :2] * rest[..., 2:] - rest[..., :2]) / X[..., 2:]
    batch = data.s.shape[:-2]
    return _solved(A.reshape(*batch, -1, 12), y.reshape(*batch, -1))


def _solved(A: FloatArray, y: FloatArray) -> FloatArray:
    """Return the least-squares solution (..., 12), of minimum norm if A is rank-deficient; NaN if the rank is
    below 6."""
    if A.shape[-2] == A.shape[-1]:
        try:
            return np.linalg.solve(A, y[..., None])[..., 0].astype(np.float64)
        except np.linalg.LinAlgError:
            pass
    flat = A.reshape(-1, *A.shape[-2:]), y.reshape(-1, y.shape[-1])
    found = np.full((len(flat[0]), 12), np.nan)
    for k, (each, right) in enumerate(zip(*flat, strict=True)):
        if np.all(np.isfinite(each)) and np.all(np.isfinite(right)):
            z, _, rank, _ = np.linalg.lstsq(each, right, rcond=1e-12)
            found[k] = z if rank >= _LEAST else np.nan
    return found.reshape(*A.shape[:-2], 12)


def linear_pose(data: Resection, turning: bool, R0: FloatArray) -> RowPose:
    """Return the pose after Newton steps; NaN if it is undetermined.

    Args:
        data: points and their images.
        turning: whether v is applied to R after each step and reset to zero (single linearisation).
        R0: (3, 3) initial R; the double linearisation is about it.
    """
    batch = data.body.shape[:-2]
    R: FloatArray = np.broadcast_to(R0, (*batch, 3, 3))
    z, v = np.zeros((*batch, 12)), np.zeros((*batch, 3))
    w, d = np.broadcast_to(so3.log(R0), v.shape), v
    for _ in range(_STEPS):
        X = (R[..., None, :, :] @ data.points(w, d)[..., None])[..., 0]
        before, z = z, newton_step(data, X, v, z[..., 6:9])
        turn, d = z[..., :3], z[..., 3:6]
        if turning:
            R = so3.exp(turn) @ R
        else:
            v = turn
        w = so3.log(so3.exp(v) @ R)
        if np.all(np.abs(z - before)[..., 3:] < _SMALL):
            break
    return RowPose(so3.exp(v) @ R, d, z[..., 6:9], z[..., 9:])


def errors(data: Resection, pose: RowPose, X: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return reprojection errors (m,) in px, infinite behind the cameras, and their derivatives (m, 12).

    At row time s, a point is at ``exp(s w') R X + C + s t'`` in the body. Derivatives are by a rotation that
    multiplies R from the left, C, w' and t'.
    """
    s = data.s[..., None, None]
    turn = so3.exp(s[..., 0] * pose.w)
    Q = X @ pose.R.T
    turned = (turn @ Q[..., None])[..., 0]
    P = turned + pose.C + s[..., 0] * pose.t + data.offset
    depth = np.where(P[..., 2:] > 0.0, P[..., 2:], np.nan)
    e = (P[..., :2] / depth - data.x[..., :2]) * data.focal
    eye = np.broadcast_to(np.eye(3), turn.shape)
    by_w = -s * (hat(turned) @ so3.left_jacobian(s[..., 0] * pose.w))
    J = np.concatenate([-(turn @ hat(Q)), eye, by_w, s * eye], axis=-1)
    J = (J[..., :2, :] - (P[..., :2] / depth)[..., None] * J[..., 2:, :]) * (data.focal / depth)[..., None]
    return np.nan_to_num(e.reshape(-1), nan=np.inf), J.reshape(-1, 12)


def refined(data: Resection, start: RowPose, most: int) -> RowPose:
    """Minimise ``errors`` by Gauss-Newton; in each step, points are moved to time 0 with the previous pose.

    Return the best pose found, which may be the start.
    """
    pose, best, lowest = start, start, np.inf
    for _ in range(most):
        e, J = errors(data, pose, data.points(so3.log(pose.R), pose.C))
        cost = float(e @ e)
        if not (np.isfinite(cost) and np.all(np.isfinite(J)) and cost <= 4.0 * lowest):
            break
        if cost < lowest:
            best, lowest = pose, cost
        step = -np.linalg.lstsq(J, e, rcond=1e-12)[0]
        pose = RowPose(so3.exp(step[:3]) @ pose.R, pose.C + step[3:6], pose.w + step[6:9], pose.t + step[9:])
        if np.all(np.abs(step[:6]) < _SMALL):
            return pose
    return best


class _Search:
    """Estimator for LO-RANSAC; models have all twelve unknowns and are scored by reprojection errors."""

    sample_size = (_LEAST,)

    def __init__(self, tracks: FloatArray, solver: R6pSolver, rig: StereoRig, shutter: RollingShutter) -> None:
        self.tracks, self.solver, self.rig, self.shutter = tracks, solver, rig, shutter
        self.R0 = solver.beginning(tracks, rig, shutter)
        self.data, self.num_data = self.of(tracks), (len(tracks),)

    def of(self, tracks: FloatArray, minimal: bool = False) -> Resection:
        """Convert tracks (n, 8) for the cameras used; minimal samples use the left camera alone."""
        sides: tuple[Side, ...] = ("left",) if minimal else self.solver.sides
        return Resection.of(tracks, self.rig, self.shutter, sides, self.solver.frame_0 == "moved")

    def linear(self, data: Resection) -> RowPose:
        with np.errstate(all="ignore"):
            return linear_pose(data, self.solver.linearisation == "single", self.R0)

    def generate(self, samples: IntArray) -> list[list[RowPose]]:
        found = self.linear(self.of(self.tracks[samples].reshape(-1, 8), minimal=True).in_samples(len(samples)))
        poses = (RowPose(*parts) for parts in zip(*found, strict=True))
        return [[pose] if pose.finite else [] for pose in poses]

    def residuals(self, model: RowPose) -> FloatArray:
        """Return the reprojection errors (n,), px, in the camera with the larger error."""
        with np.errstate(all="ignore"):
            e, _ = errors(self.data, model, self.data.points(so3.log(model.R), model.C))
            squares = np.sum(e.reshape(len(self.data.x), -1, 2) ** 2, axis=-1)
        return np.sqrt(np.max(squares, axis=0))

    def refine(self, model: RowPose, inliers: BoolArray) -> RowPose | None:
        return self.fit(inliers, model, _QUICK)

    def fit(self, inliers: BoolArray, start: RowPose | None, most: int) -> RowPose | None:
        """Fit a pose to all inliers, from a start if one is given; None if it is not finite."""
        data = self.of(self.tracks[inliers])
        if start is None or self.solver.refinement == "none":
            start = self.linear(data)
        if self.solver.refinement == "reprojection" and start.finite:
            with np.errstate(all="ignore"):
                start = refined(data, start, most)
        return start if start.finite else None


@final
@dataclass(frozen=True, kw_only=True)
class R6pSolver(Solver):
    """Pose from six points or more: Newton steps, then least squares of the exact reprojection error."""

    linearisation: Literal["double", "single"] = "double"
    """``single``: only the rotation within the frame is linearised; ``double``: R too."""
    frame_0: Literal["moved", "still"] = "moved"
    """``moved``: the points of each row of frame 0 are moved to time 0 with the current estimate of the motion (at
    constant velocity from frame to frame), until points and pose agree; ``still``: they are used as points of a
    map."""
    cameras_used: Literal["left", "both"] = "both"
    """Cameras whose pixels in frame 1 are used; minimal samples use only the left camera's."""
    refinement: Literal["none", "reprojection"] = "reprojection"
    """``reprojection``: final least squares of the reprojection errors of all inliers; ``none``: no refinement."""
    start: Literal["p3p", "still"] = "p3p"
    """Initial orientation: that of P3P for all matches, as published, or that of frame 0."""
    threshold_px: float = 4.0
    """Largest reprojection error of an inlier; it allows for noise of pixels and of points."""
    confidence: float = 0.999
    """Required probability that RANSAC draws a sample without outliers, 0 to 1."""
    max_iterations: int = 1000
    """Largest number of RANSAC samples."""
    lo_steps: int = 3
    """Number of refinements of each new best model of RANSAC; 0: refine only at the end."""

    def __post_init__(self) -> None:
        self._options()

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": _LEAST},
        metric=True,
        motion_model="linear",
        shutter="rolling",
        reference_point="body",
        reference="Albl, Kukelova, Pajdla: R6P, CVPR 2015; Kukelova et al., ACCV 2018; Albl et al., PAMI 2020",
        assumes="constant velocity; depth of frame 0 without noise; points beyond one plane",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        tracks = with_depth(correspondences.tracks)
        if short := shortage_of_depth(tracks, _LEAST):
            return short
        search = _Search(tracks, self, rig, shutter)
        best, inliers = None, np.ones(len(tracks), dtype=np.bool_)
        if len(tracks) > _LEAST:  # six always fit
            report = ransac(search, self._options(), np.random.default_rng(0))
            if report.model is None:
                return MotionEstimate.failed(f"{report.reason}; {_OPEN}")
            best, inliers = report.model, report.inliers
        return _reported(search.fit(inliers, best, _FULL) or best)

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the cameras whose pixels are used."""
        return SIDES if self.cameras_used == "both" else ("left",)

    def beginning(self, tracks: FloatArray, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
        """Return the initial R (3, 3); it is the identity if P3P fails."""
        if self.start == "still":
            return np.eye(3)
        pose = P3pSolver(threshold_px=self.threshold_px, cameras_used="left").estimate(
            Correspondences(tracks=tracks), rig, shutter
        )
        return so3.exp(pose.w) if pose.success else np.eye(3)

    def _options(self) -> RansacOptions:
        """Return the options of the search, which checks their values."""
        return RansacOptions(
            threshold=self.threshold_px,
            confidence=self.confidence,
            max_iterations=self.max_iterations,
            lo_steps=self.lo_steps,
        )


def _reported(pose: RowPose | None) -> MotionEstimate:
    if pose is None or not pose.finite:
        return MotionEstimate.failed(_OPEN)
    return MotionEstimate(w=so3.log(pose.R), d=pose.C, success=True, metric=True)
