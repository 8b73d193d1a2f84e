"""Global-shutter stereo relative pose from three features, each in three of the four images.

A. Vakhitov, V. Lempitsky, Y. Zheng, Stereo Relative Pose from Line and Point Feature Triplets, ECCV 2018. Stereo
in one frame gives a point in that frame's body; a third image shows it in the other frame:

    lambda x = R X + d + o      (known in frame 0, seen in frame 1)
    lambda x = R^T (Y - d) + o      (known in frame 1, seen in frame 0; o, where the camera stands).

Each point gives two equations, so three points give the motion. The paper's solvers are algebraic and find all
roots. Here Newton steps from zero motion find the root that successive frames have: for exact points in 95 of 100
samples at 2 degrees and 0.3 m, in 92 at 5 degrees and 0.5 m, in 72 at 15 degrees and 1 m. A sample ignores one of
the four images of a track; the final least squares of reprojection errors use all four.

A line that both cameras of a frame show is the intersection of two planes. A third image, of the other frame,
shows it in a plane with normal n, which contains two points A and B of the line after the motion:

    n . (R A + d + o) = n . (R B + d + o) = 0      (known in frame 0, seen in frame 1)

and likewise with the inverse motion for lines known in frame 1. A sample may have points and lines, so
``LineTripletSolver`` has its own robust loop: rsbench's RANSAC with samples of three features, then least squares
of the reprojection errors of both kinds over all inliers, each weighted by its estimated noise. A line whose image
is within 10 degrees of the baseline's direction has no depth and is not used. If all lines are parallel, the
translation along them is undetermined, and the solver fails.

A 3-D line has four unknowns in the least squares: at both end points in the left image of time 0, the displacement
across the observed line and the inverse depth. The line's images are nearly linear in them at any distance. An
error is the distance of an observed end point from the line's image. For a given motion, the four unknowns of each
line are eliminated by Gauss-Newton steps; its eight errors then have four degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, NamedTuple, final

import numpy as np

from rsbench.core import so3
from rsbench.core.arguments import check_number, check_whole
from rsbench.core.correspondences import BoolArray, Correspondences, stereo_points, with_depth
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray, cross, hat
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.levenberg_marquardt import levenberg_marquardt
from rsbench.solvers.engine.packed import TRACK_FREEDOM, Packed, inverse_definite, pack
from rsbench.solvers.engine.ransac import IntArray, RansacOptions, ransac
from rsbench.solvers.engine.robust_motion import SECOND_TRY, SIGMAS, quantile, truncated

View = tuple[Literal[0, 1], Side]
"""The third image of a feature: its frame, in which the feature's depth is not used, and its camera."""
_LEAST = 3
_STEPS = 8
_QUICK, _FULL = 10, 50
LONGEST = 100.0
"""Largest length of a translation, metres."""
PATTERNS: tuple[tuple[View, View, View], ...] = (
    ((1, "left"), (1, "right"), (0, "left")),
    ((1, "right"), (0, "left"), (0, "right")),
)
"""Third images of the three features of a sample: two of frame 1 and one of frame 0, and one and two."""
ALL: tuple[View, ...] = ((1, "left"), (1, "right"), (0, "left"), (0, "right"))
_COLUMNS: dict[View, int] = {(0, "left"): 0, (0, "right"): 2, (1, "left"): 4, (1, "right"): 6}


class Triplets(NamedTuple):
    """Features known in one frame and seen in a third image; each gives two equations c . P = 0; batches (...)."""

    X: FloatArray
    """(..., n, k, 3) k points of a feature, metres, in the body of the frame in which they are known."""
    c: FloatArray
    """(..., n, k, 2 / k, 3) vectors orthogonal to each point in the third image's camera: (1, 0, -x) and (0, 1,
    -y) for a point's ray (x, y, 1)."""
    offset: FloatArray
    """(..., n, 3) offset o of the third image's camera, metres."""
    backward: FloatArray
    """(..., n) bool: known in frame 1, seen in frame 0."""

    @classmethod
    def of(cls, tracks: FloatArray, views: Sequence[View], rig: StereoRig) -> Triplets:
        """Convert tracks (..., n, 8) with depth in both frames; ``views`` has the third image of each of n."""
        shape = (*tracks.shape[:-1], 3)
        X = [stereo_points(tracks.reshape(-1, 8)[:, columns:], rig).reshape(shape) for columns in (0, 4)]
        backward = np.array([frame == 0 for frame, _ in views])
        pixels = np.stack([tracks[..., k, c : c + 2] for k, c in enumerate(_COLUMNS[v] for v in views)], axis=-2)
        known = np.where(backward[:, None], X[1], X[0])
        return cls(
            known[..., None, :],
            point_rows(rig.camera.unproject(pixels))[..., None, :, :],
            np.broadcast_to([rig.offset(side) for _, side in views], shape),
            np.broadcast_to(backward, shape[:-1]),
        )


def point_rows(rays: FloatArray) -> FloatArray:
    """Vectors (..., 2, 3) orthogonal to rays (..., 3), z = 1."""
    out = np.zeros((*rays.shape[:-1], 2, 3))
    out[..., 0, 0] = out[..., 1, 1] = 1.0
    out[..., 2] = -rays[..., :2]
    return out


def newton(triplets: Triplets) -> Pose:
    """Motion (..., 3, 3), (..., 3) of n >= 3 features by Gauss-Newton steps (n = 3: Newton); NaN: undetermined."""
    X, c, offset, back = triplets.X, triplets.c, triplets.offset[..., None, :], triplets.backward[..., None, None]
    batch = X.shape[:-3]
    R: FloatArray = np.broadcast_to(np.eye(3), (*batch, 3, 3))
    d, eye, turned = np.zeros((*batch, 3)), np.eye(3), back[..., None]
    for _ in range(_STEPS):
        Q, inverse = R[..., None, None, :, :], np.swapaxes(R, -1, -2)[..., None, None, :, :]
        moved, rest = (Q @ X[..., None])[..., 0], X - d[..., None, None, :]
        P = np.where(back, (inverse @ rest[..., None])[..., 0], moved + d[..., None, None, :]) + offset
        by_turn = np.where(turned, inverse @ hat(rest), -hat(moved))
        by_shift = np.broadcast_to(np.where(turned, -inverse, eye), by_turn.shape)
        J = np.concatenate([by_turn, by_shift], axis=-1)
        # c . P = 0, divided by the depth.
        A = (c @ J) / P[..., 2:, None]
        e = (c @ P[..., None])[..., 0] / P[..., 2:]
        step = _step(A.reshape(*batch, -1, 6), e.reshape(*batch, -1))
        R, d = so3.exp(step[..., :3]) @ R, d + step[..., 3:]
    return Pose(R, d)


def _step(A: FloatArray, e: FloatArray) -> FloatArray:
    """Least-squares solution (..., 6) of A step = -e; NaN for singular systems."""
    At = np.swapaxes(A, -1, -2)
    square = A.shape[-2] == A.shape[-1]
    try:
        left, right = (A, e[..., None]) if square else (At @ A, At @ e[..., None])
        return -np.linalg.solve(left, right)[..., 0].astype(np.float64)
    except np.linalg.LinAlgError:
        if A.ndim == 2:
            return np.full(6, np.nan)
        return np.stack([_step(each, right) for each, right in zip(A, e, strict=True)])


@final
@dataclass(frozen=True, kw_only=True)
class TripletSolver(Solver):
    """Motion from samples of three points in three images each, then least squares of reprojection errors."""

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": _LEAST},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="Vakhitov, Lempitsky, Zheng: Stereo Relative Pose from Feature Triplets, ECCV 2018 (points)",
        assumes="global shutter; a motion that is small compared with the distance of the points",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        tracks = with_depths(correspondences.tracks)
        if len(tracks) < _LEAST:
            return MotionEstimate.failed(f"{len(tracks)} tracks with positive disparities, need {_LEAST}")
        four = np.tile(tracks, (4, 1))
        with np.errstate(all="ignore"):
            pose = newton(Triplets.of(four, [view for view in ALL for _ in tracks], rig))
        start = motion_of(pose)
        return self._refined(start, tracks, rig, _FULL) if start.success else start

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        return next(iter(self.propose_all([sample], rig, shutter)))

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        tracks = [with_depths(sample.tracks)[:_LEAST] for sample in samples]
        whole = [each for each in tracks if len(each) == _LEAST]
        stacked = np.stack(whole) if whole else np.zeros((0, _LEAST, 8))
        found = sample_motions(lambda views: Triplets.of(stacked, views, rig))
        few = MotionEstimate.failed(f"fewer than {_LEAST} points of a sample have positive disparity")
        return [next(found) if len(each) == _LEAST else [few] for each in tracks]

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        tracks = with_depths(correspondences.tracks)
        if len(tracks) < _LEAST:
            return self.estimate(correspondences, rig, shutter)
        return self._refined(motion, tracks, rig, _QUICK if quick else _FULL)

    def _refined(self, motion: MotionEstimate, tracks: FloatArray, rig: StereoRig, most: int) -> MotionEstimate:
        still = RollingShutter(height=rig.camera.height, readout_ratio=0.0)
        packed = pack(Correspondences(tracks=tracks), rig, still)
        end = levenberg_marquardt(packed.normal_equations, packed.theta(motion.w, motion.d), most, LONGEST)
        w, d = packed.motion(end.theta)
        return motion_of(Pose(so3.exp(w), d))


def with_depths(tracks: FloatArray) -> FloatArray:
    """The tracks (m, 8) among (n, 8) with a positive disparity in both frames."""
    near = with_depth(tracks)
    return near[near[:, 4] - near[:, 6] > 0.0]


def motion_of(pose: Pose) -> MotionEstimate:
    """The estimate with a given motion; a failure if it is not finite."""
    if not (np.all(np.isfinite(pose.R)) and np.all(np.isfinite(pose.t))):
        return MotionEstimate.failed("the points do not determine the motion")
    return MotionEstimate(w=so3.log(pose.R), d=pose.t, success=True, metric=True)


def sample_motions(triplets: Callable[[Sequence[View]], Triplets]) -> Iterator[list[MotionEstimate]]:
    """The motions of each sample of three features, by either pattern of the third images."""
    with np.errstate(all="ignore"):
        found = [newton(triplets(views)) for views in PATTERNS]
    for poses in zip(*(zip(*pose, strict=True) for pose in found), strict=True):
        yield [motion_of(Pose(*one)) for one in poses]


FREEDOM = 4
LEAST_SLOPE = np.sin(np.radians(10.0))
"""Sine of the smallest angle to the baseline; below it, a line's left and right planes nearly coincide."""
_RIDGE = 1e-12
"""Relative increase of the diagonal, so that the batch can be solved if one line has no depth."""


def line_rays(lines: FloatArray, rig: StereoRig) -> FloatArray:
    """Rays (..., 4, 2, 3) of the end points of lines (..., 16) in the images left 0, right 0, left 1, right 1."""
    return rig.camera.unproject(lines.reshape(*lines.shape[:-1], 4, 2, 2))


def line_normals(rays: FloatArray) -> FloatArray:
    """Normals (..., 4, 3) of the planes of image lines, (a, b, c) with a^2 + b^2 = 1; NaN for equal end points.

    The dot product with a ray is its distance from the line in units of the focal length.
    """
    n = cross(rays[..., 0, :], rays[..., 1, :])
    with np.errstate(invalid="ignore"):
        return np.asarray(n / np.hypot(n[..., 0], n[..., 1])[..., None])


def inverse_depths(rays: FloatArray, rig: StereoRig) -> FloatArray:
    """Inverse depths (..., 2, 2), 1 / m, of the end points in the left images, by frame and end."""
    normals = line_normals(rays)[..., 1::2, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.sum(normals[..., None, :] * rays[..., ::2, :, :], axis=-1)
        return np.asarray(along / (normals[..., None, 0] * rig.baseline))


def usable_lines(lines: FloatArray, rig: StereoRig) -> BoolArray:
    """Mask (n,) of lines whose stereo is not degenerate and which are in front of the cameras at both times."""
    rays = line_rays(lines, rig)
    steep = np.all(np.abs(line_normals(rays)[..., 0]) >= LEAST_SLOPE, axis=-1)
    return np.asarray(steep & np.all(inverse_depths(rays, rig) > 0.0, axis=(-2, -1)))


def stereo_ends(rays: FloatArray, rig: StereoRig) -> FloatArray:
    """Two points (..., 2, 2, 3) of each line by frame, metres, in the body at that time."""
    near = inverse_depths(rays, rig)
    return np.asarray(rays[..., ::2, :, :] / near[..., None] - rig.offset("left"))


class _State(NamedTuple):
    """Errors (n, 8), px, and their derivatives by the line (n, 8, 4) and by the motion (n, 8, 6): rotation from
    the left, translation; ``front``: whether the line is in front of all cameras."""

    r: FloatArray
    by_line: FloatArray
    by_motion: FloatArray
    front: BoolArray


@dataclass(frozen=True, kw_only=True, eq=False)
class LineErrors:
    """Reprojection errors of lines as a function of the motion."""

    rays: FloatArray
    """(n, 4, 2, 3) rays of the end points, see ``line_rays``."""
    across: FloatArray
    """(n, 3) direction in the left image of frame 0 across the line."""
    start: FloatArray
    """(n, 4) start of the unknowns: displacements across, 0, then inverse depths of both end points, 1 / m."""
    rig: StereoRig

    @classmethod
    def of(cls, lines: FloatArray, rig: StereoRig) -> LineErrors:
        """The errors of usable lines (n, 16)."""
        rays = line_rays(lines, rig)
        across = line_normals(rays)[:, 0] * [1.0, 1.0, 0.0]
        near = inverse_depths(rays, rig)[:, 0]
        return cls(rays=rays, across=across, start=np.concatenate([0.0 * near, near], axis=1), rig=rig)

    def only(self, wanted: BoolArray) -> LineErrors:
        """The lines selected by a mask (n,)."""
        return LineErrors(
            rays=self.rays[wanted], across=self.across[wanted], start=self.start[wanted], rig=self.rig
        )

    def squares(self, w: FloatArray, d: FloatArray, steps: int = 1) -> FloatArray:
        """Sums (n,) of squared errors, px^2, after ``steps`` steps per line; infinite behind a camera."""
        state = self._settled(so3.exp(w), d, steps)
        squares = np.sum(state.r**2, axis=1)
        return np.where(state.front & (squares >= 0.0), squares, np.inf)

    def normal_equations(
        self, w: FloatArray, d: FloatArray, steps: int = 3
    ) -> tuple[float, FloatArray, FloatArray]:
        """Half the sum of squares in px^2, its gradient (6,) and Gauss-Newton Hessian (6, 6) by (w, d)."""
        state = self._settled(so3.exp(w), d, steps)
        A = state.by_line
        J = state.by_motion.copy()
        J[..., :3] = J[..., :3] @ so3.left_jacobian(w)
        rest = J - A @ _solve(A, J)
        gradient, H = np.einsum("nij,ni->j", rest, state.r), np.einsum("nij,nik->jk", rest, J)
        return 0.5 * float(np.sum(state.r**2)), gradient, 0.5 * (H + H.T)

    def _settled(self, R: FloatArray, d: FloatArray, steps: int) -> _State:
        """The errors at the lines that fit all images best for a given motion."""
        unknowns = self.start
        for _ in range(steps):
            state = self._state(R, d, unknowns)
            unknowns = unknowns - _solve(state.by_line, state.r[..., None])[..., 0]
        return self._state(R, d, unknowns)

    def _state(self, R: FloatArray, d: FloatArray, unknowns: FloatArray) -> _State:
        n, focal = len(self.rays), np.array([self.rig.camera.fx, self.rig.camera.fy, np.inf])
        left, shift, near = self.rig.offset("left"), unknowns[:, :2], unknowns[:, 2:]
        at = self.rays[:, 0] + shift[..., None] * self.across[:, None]
        r, by_line, by_motion = np.zeros((n, 4, 2)), np.zeros((n, 4, 2, 4)), np.zeros((n, 4, 2, 6))
        front = np.all(near > 0.0, axis=1)
        for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
            Q, T = (R, d + self.rig.offset(side)) if frame else (np.eye(3), self.rig.offset(side))
            turned = (at - near[..., None] * left) @ Q.T
            ends = turned + near[..., None] * T
            front &= np.all(ends[..., 2] > 0.0, axis=1)
            m = cross(ends[:, 0], ends[:, 1])
            slope = m / focal
            h = np.sqrt(np.sum(slope**2, axis=-1))[:, None, None]
            seen = self.rays[:, k] / h
            r[:, k] = np.sum(seen * m[:, None], axis=-1)
            g = seen - r[:, k, :, None] * (slope / focal)[:, None] / h**2
            # Derivatives by the points a and b (n, ends, 3) that span the plane.
            by = (cross(ends[:, None, 1], g), cross(g, ends[:, None, 0]))
            for p in (0, 1):
                by_line[:, k, :, p] = np.sum(by[p] * (self.across @ Q.T)[:, None], axis=-1)
                by_line[:, k, :, 2 + p] = by[p] @ (T - Q @ left)
                if frame:
                    by_motion[:, k, :, :3] += cross(turned[:, None, p], by[p])
                    by_motion[:, k, :, 3:] += near[:, p, None, None] * by[p]
        return _State(r.reshape(n, 8), by_line.reshape(n, 8, 4), by_motion.reshape(n, 8, 6), front)


def _solve(A: FloatArray, b: FloatArray) -> FloatArray:
    """Least-squares solution (n, 4, k) of A (n, 8, 4) x = b (n, 8, k)."""
    At = np.swapaxes(A, -1, -2)
    N = At @ A
    diagonal = np.arange(N.shape[-1])
    N[:, diagonal, diagonal] *= 1.0 + _RIDGE
    N[:, diagonal, diagonal] += 1e-300
    return np.linalg.solve(N, At @ b).astype(np.float64)


_LINE_QUICK = 5
_REFITS = 5
_NOISE_STEPS = 8
_RANGE = (0.2, 4.0)
"""Limits of the adapted threshold, as factors on the given one."""
_MAX_DIRECTION_SIGMA = 0.5
"""Largest standard deviation of a known direction of d, radians, as in refined solvers."""
_MANY = 10
"""Fewest inliers of points or of lines for an estimate of their noise."""


class Features(NamedTuple):
    """Points, then lines: their positions known from each frame, and their equations in each image."""

    X: FloatArray
    """(2, n, 2, 3) two points of each feature by frame, metres, in the body at that time; a point's are equal."""
    c: FloatArray
    """(4, n, 2, 3) vectors orthogonal to these points, by image."""

    @classmethod
    def of(cls, tracks: FloatArray, lines: FloatArray, rig: StereoRig) -> Features:
        """Convert tracks (m, 8) with depth in both frames, and usable lines (n, 16)."""
        points = np.stack([stereo_points(tracks[:, at:], rig) for at in (0, 4)])
        rays = line_rays(lines, rig)
        normals = np.repeat(line_normals(rays)[:, :, None], 2, axis=2)
        seen = point_rows(rig.camera.unproject(tracks.reshape(-1, 4, 2)))
        ends = np.swapaxes(stereo_ends(rays, rig), 0, 1)
        return cls(
            np.concatenate([np.repeat(points[:, :, None], 2, axis=2), ends], axis=1),
            np.swapaxes(np.concatenate([seen, normals]), 0, 1),
        )

    def triplets(self, chosen: IntArray, views: Sequence[View], rig: StereoRig) -> Triplets:
        """Triplets of the chosen features (..., n), each known in the frame that is not its view's."""
        frames = np.array([frame for frame, _ in views])
        images = np.array([2 * frame + SIDES.index(side) for frame, side in views])
        offsets = np.array([rig.offset(side) for _, side in views])
        return Triplets(
            self.X[1 - frames, chosen],
            self.c[images, chosen][..., None, :],
            np.broadcast_to(offsets, (*chosen.shape, 3)),
            np.broadcast_to(frames == 0, chosen.shape),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Problem:
    """Points and lines of a rig, from which RANSAC and then least squares estimate the motion."""

    features: Features
    points: Packed
    lines: LineErrors
    rig: StereoRig
    noise: FloatArray
    """(2,) standard deviations of a coordinate of points and of lines, px."""
    sample_size = (_LEAST,)

    @classmethod
    def of(cls, tracks: FloatArray, lines: FloatArray, rig: StereoRig, noise_px: float) -> _Problem:
        still = RollingShutter(height=rig.camera.height, readout_ratio=0.0)
        return cls(
            features=Features.of(tracks, lines, rig),
            points=pack(Correspondences(tracks=tracks), rig, still),
            lines=LineErrors.of(lines, rig),
            rig=rig,
            noise=np.full(2, noise_px),
        )

    @property
    def num_data(self) -> tuple[int, ...]:
        return (len(self.points.tracks) + len(self.lines.rays),)

    def generate(self, samples: IntArray) -> Iterator[list[MotionEstimate]]:
        for models in sample_motions(lambda views: self.features.triplets(samples, views, self.rig)):
            yield [model for model in models if model.success]

    def squares(self, model: MotionEstimate) -> tuple[FloatArray, FloatArray]:
        """Squared errors of points and of lines, px^2."""
        with np.errstate(all="ignore"):
            tracks = self.points.track_squares(self.points.theta(model.w, model.d))
            lines = self.lines.squares(model.w, model.d) if len(self.lines.rays) else np.zeros(0)
        return np.where(tracks >= 0.0, tracks, np.inf), lines  # a point next to a camera's plane overflows

    def residuals(self, model: MotionEstimate) -> FloatArray:
        """(n,) errors in standard deviations; those of inliers, points or lines, are at most ``SIGMAS``."""
        squares = self.squares(model)
        scales = SIGMAS / (self.noise * np.sqrt([quantile(TRACK_FREEDOM), quantile(FREEDOM)]))
        return np.concatenate([np.sqrt(each) * scale for each, scale in zip(squares, scales, strict=True)])

    def refine(self, model: MotionEstimate, inliers: BoolArray) -> MotionEstimate | None:
        found = self.descent(model, inliers, _LINE_QUICK)
        return found if found.success else None

    def descent(self, model: MotionEstimate, inliers: BoolArray, most: int) -> MotionEstimate:
        """Minimise the inliers' squared errors, each weighted by its noise."""
        tracks, wanted = np.split(inliers, [len(self.points.tracks)])
        points, lines = self.points.only(tracks), self.lines.only(wanted)
        weights = self.noise**-2

        def evaluate(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
            parts = [points.normal_equations(theta)]
            if len(lines.rays):
                w, d = points.motion(theta)
                parts.append(lines.normal_equations(w, d))
            sums = [sum(k * part[i] for k, part in zip(weights, parts, strict=False)) for i in range(3)]
            return float(sums[0]), np.asarray(sums[1]), np.asarray(sums[2])

        with np.errstate(all="ignore"):
            end = levenberg_marquardt(evaluate, points.theta(model.w, model.d), most, LONGEST)
        w, d = points.motion(end.theta)
        covariance = inverse_definite(end.H) if np.all(np.isfinite(end.H)) else None
        if covariance is None:
            return MotionEstimate.failed(
                "the points and lines do not determine the motion (are all lines parallel?)"
            )
        distance = float(np.median(np.linalg.norm(self.features.X[0, :, 0], axis=-1)))
        return _with_direction(motion_of(Pose(so3.exp(w), d)), covariance, distance)

    def with_noise_of(self, model: MotionEstimate, least: float, most: float) -> _Problem:
        """The problem with the noise of points and of lines estimated from the inliers of a motion."""
        noise = self.noise.copy()
        for k, (squares, freedom) in enumerate(zip(self.squares(model), (TRACK_FREEDOM, FREEDOM), strict=True)):
            for _ in range(_NOISE_STEPS):
                below = squares <= noise[k] ** 2 * quantile(freedom)
                if np.count_nonzero(below) < _MANY:
                    break
                shown = np.sqrt(np.mean(squares[below]) / truncated(freedom))
                noise[k] = np.clip(shown, least, most)
        return replace(self, noise=noise)


@final
@dataclass(frozen=True, kw_only=True)
class LineTripletSolver(Solver):
    """Motion from samples of three points or lines in three images each; its card has ``robust = "own"``."""

    threshold_px: float = 0.625
    """Largest error of an inlier at the start, as of pairs in rsbench's robust loop; adapted to the noise."""
    confidence: float = 0.999
    """Required probability that RANSAC draws a sample without outliers, 0 to 1."""
    max_iterations: int = 1000
    """Largest number of RANSAC samples."""

    def __post_init__(self) -> None:
        check_number("threshold_px", self.threshold_px, 1e-6)
        check_whole("max_iterations", self.max_iterations, RansacOptions.min_iterations)
        self._options()

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": _LEAST},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="Vakhitov, Lempitsky, Zheng: Stereo Relative Pose from Feature Triplets, ECCV 2018",
        assumes="global shutter; a motion that is small compared with the distance; lines may replace tracks",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        tracks, lines = with_depths(correspondences.tracks), correspondences.lines
        lines = lines[usable_lines(lines, rig)]
        # Sort them, so that the samples do not depend on the order of the input.
        tracks, lines = (rows[np.lexsort(rows.T)] for rows in (tracks, lines))
        count = len(tracks) + len(lines)
        if count < _LEAST:
            return MotionEstimate.failed(
                f"{len(tracks)} tracks with positive disparities and {len(lines)} lines with depth, need {_LEAST}"
            )
        problem = _Problem.of(tracks, lines, rig, self.threshold_px / SIGMAS)
        if count == _LEAST:  # without further features, RANSAC has nothing to count
            return self._of_all(problem)
        reason = ""
        for factor in (1.0, SECOND_TRY):
            wider = replace(problem, noise=factor * problem.noise)
            found = ransac(wider, self._options(), np.random.default_rng(0))
            if found.model is not None:
                return self._concluded(wider, found.model)
            reason = reason or found.reason
        return MotionEstimate.failed(reason)

    def _options(self) -> RansacOptions:
        """The options of the search; checks the values."""
        return RansacOptions(threshold=SIGMAS, confidence=self.confidence, max_iterations=self.max_iterations)

    def _of_all(self, problem: _Problem) -> MotionEstimate:
        every = np.arange(problem.num_data[0])
        views = [view for view in ALL for _ in every]
        with np.errstate(all="ignore"):
            start = motion_of(newton(problem.features.triplets(np.tile(every, 4), views, problem.rig)))
        return problem.descent(start, np.ones(len(every), dtype=np.bool_), _FULL) if start.success else start

    def _concluded(self, problem: _Problem, model: MotionEstimate) -> MotionEstimate:
        """Repeat least squares over the inliers, with re-estimated noise, until the inliers stay the same."""
        least, most = (factor * self.threshold_px / SIGMAS for factor in _RANGE)
        before = np.zeros(problem.num_data, dtype=np.bool_)
        for _ in range(_REFITS):
            problem = problem.with_noise_of(model, least, most)
            inliers = problem.residuals(model) <= SIGMAS
            if np.count_nonzero(inliers) < _LEAST or np.array_equal(inliers, before):
                break
            found = problem.descent(model, inliers, _FULL)
            if not found.success:
                return found
            model, before = found, inliers
        return model


def _with_direction(motion: MotionEstimate, covariance: FloatArray, distance: float) -> MotionEstimate:
    """Decide by the covariance (6, 6) of (w, d) whether the direction of d is known.

    For nearly parallel lines, d diverges along them to more than the ``distance`` of the features, metres.
    """
    length = float(np.linalg.norm(motion.d))
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    if not motion.success or sigma <= _MAX_DIRECTION_SIGMA * min(length, distance):
        return motion
    why = f"d is {length:.2g} m long and known to {sigma:.2g} m"
    return replace(motion, direction_known=False, reason=f"the direction of d is not determined: {why}")
