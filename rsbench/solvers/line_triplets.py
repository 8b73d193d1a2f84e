"""Stereo relative pose from three features, points or straight lines, each in three of the four images.

A. Vakhitov, V. Lempitsky, Y. Zheng, Stereo Relative Pose from Line and Point Feature Triplets, ECCV 2018, of a
global shutter. A line that both cameras of a frame see is where its two planes meet. The third image, of the other
frame, sees it in a plane of normal n, in which two points A and B of it lie after the motion:

    n . (R A + d + o) = n . (R B + d + o) = 0      (known in frame 0, seen in frame 1; o, where the camera stands)

and the inverse motion for lines that frame 1 knows; ``rsbench.solvers.triplets`` has the points. The equations are
solved as there: Newton's steps from no motion. The robust loop is here, since a sample has either kind: samples of
three among all, the house's RANSAC, then least squares of the reprojection errors of both kinds over all inliers,
each over the noise that its own errors show. A line whose image is within 10 degrees of the baseline's direction
has no depth, and is left out. Lines that are all parallel leave the shift along them open: a failure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple, final

import numpy as np
import scipy

from rsbench.core import so3
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.given import check_number, check_whole
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.levenberg_marquardt import levenberg_marquardt
from rsbench.solvers.engine.line_errors import (
    FREEDOM,
    LineErrors,
    line_normals,
    line_rays,
    stereo_ends,
    usable_lines,
)
from rsbench.solvers.engine.packed import Packed, inverse_definite, pack
from rsbench.solvers.engine.ransac import IntArray, RansacOptions, ransac
from rsbench.solvers.engine.stereo_points import stereo_points
from rsbench.solvers.triplets import (
    ALL,
    LONGEST,
    PATTERNS,
    Triplets,
    View,
    motion_of,
    newton,
    point_rows,
    with_depths,
)

_LEAST = 3
_SAMPLES = 10
"""At least, as in the house's loop."""
_QUICK, _FULL = 5, 50
_SIGMAS = 2.5
_TRACK_FREEDOM = 5
_SECOND_TRY = 3.0
_REFITS = 5
_NOISE_STEPS = 8
_RANGE = (0.2, 4.0)
"""Times the threshold, between which it follows the noise."""
_MAX_DIRECTION_SIGMA = 0.5
"""Share of the length of d: radians, as in the refined solvers."""
_MANY = 10
"""Inliers of a kind from which its noise is told."""


class Features(NamedTuple):
    """Points, then lines: what either frame knows of each, and what each image sees of it."""

    X: FloatArray
    """(2, n, 2, 3) two points by frame, metres, in the body as it is then; a point's are one."""
    c: FloatArray
    """(4, n, 2, 3) by image what they are at right angles to."""

    @classmethod
    def of(cls, tracks: FloatArray, lines: FloatArray, rig: StereoRig) -> Features:
        """Of tracks (m, 8) with depth in both frames and lines (n, 16) that are usable."""
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
        """Of features (..., n), each known in the frame that its view is not of."""
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
    """Points and lines of a rig: what RANSAC estimates a motion from, and least squares improves it on."""

    features: Features
    points: Packed
    lines: LineErrors
    rig: StereoRig
    noise: FloatArray
    """(2,) standard deviations of a coordinate of points and of lines, px."""

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

    @property
    def sample_size(self) -> tuple[int, ...]:
        return (_LEAST,)

    def generate(self, samples: IntArray) -> Iterator[list[MotionEstimate]]:
        with np.errstate(all="ignore"):
            found = [newton(self.features.triplets(samples, views, self.rig)) for views in PATTERNS]
        each = (zip(*pose, strict=True) for pose in found)
        for poses in zip(*each, strict=True):
            yield [model for model in (motion_of(Pose(*one)) for one in poses) if model.success]

    def squares(self, model: MotionEstimate) -> tuple[FloatArray, FloatArray]:
        """Of points and of lines, px^2."""
        with np.errstate(all="ignore"):
            tracks = self.points.track_squares(self.points.theta(model.w, model.d))
            lines = self.lines.squares(model.w, model.d) if len(self.lines.rays) else np.zeros(0)
        return np.where(tracks >= 0.0, tracks, np.inf), lines  # a point next to a camera's plane overflows

    def residuals(self, model: MotionEstimate) -> FloatArray:
        """In standard deviations: an inlier's is within ``_SIGMAS``, whichever it is."""
        squares = self.squares(model)
        scales = _SIGMAS / (self.noise * np.sqrt([_quantile(_TRACK_FREEDOM), _quantile(FREEDOM)]))
        return np.concatenate([np.sqrt(each) * scale for each, scale in zip(squares, scales, strict=True)])

    def refine(self, model: MotionEstimate, inliers: BoolArray) -> MotionEstimate | None:
        found = self.descent(model, inliers, _QUICK)
        return found if found.success else None

    def descent(self, model: MotionEstimate, inliers: BoolArray, most: int) -> MotionEstimate:
        """Least squares of the inliers' errors over their noise."""
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
            return MotionEstimate.failed("the points and lines leave the motion open, as parallel lines do")
        distance = float(np.median(np.linalg.norm(self.features.X[0, :, 0], axis=-1)))
        return _with_direction(motion_of(Pose(so3.exp(w), d)), covariance, distance)

    def told(self, model: MotionEstimate, least: float, most: float) -> _Problem:
        """With the noise that the errors of a motion's inliers show, of each kind by itself where it has many."""
        noise = self.noise.copy()
        for k, (squares, freedom) in enumerate(zip(self.squares(model), (_TRACK_FREEDOM, FREEDOM), strict=True)):
            for _ in range(_NOISE_STEPS):
                below = squares <= noise[k] ** 2 * _quantile(freedom)
                if np.count_nonzero(below) < _MANY:
                    break
                shown = np.sqrt(np.mean(squares[below]) / _truncated(freedom))
                noise[k] = np.clip(shown, least, most)
        return replace(self, noise=noise)


@final
@dataclass(frozen=True, kw_only=True)
class LineTripletSolver(Solver):
    """Samples of three points or lines in three images each; a card of it says ``robust = "own"``."""

    threshold_px: float = 0.625
    """Largest error of an inlier, of a pair's as in the house's loop; it then follows the noise of either kind."""
    confidence: float = 0.999
    """Probability with which RANSAC shall have seen a sample without outliers, 0 to 1."""
    max_iterations: int = 1000
    """Samples that RANSAC draws, at most."""

    def __post_init__(self) -> None:
        check_number("threshold_px", self.threshold_px, 1e-6)
        check_number("confidence", self.confidence, 1e-6, 1.0 - 1e-9)
        check_whole("max_iterations", self.max_iterations, _SAMPLES)

    spec = SolverSpec(
        needs=frozenset({"tracks"}),
        minimum={"tracks": _LEAST},
        metric=True,
        motion_model="linear",
        shutter="global",
        reference_point="body",
        reference="Vakhitov, Lempitsky, Zheng: Stereo Relative Pose from Feature Triplets, ECCV 2018",
        assumes="global shutter; a motion that is small beside the distance; lines may stand for tracks",
    )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        tracks, lines = with_depths(correspondences.tracks), correspondences.lines
        lines = lines[usable_lines(lines, rig)]
        # In one order, for the samples to be the same.
        tracks, lines = (rows[np.lexsort(rows.T)] for rows in (tracks, lines))
        count = len(tracks) + len(lines)
        if count < _LEAST:
            return MotionEstimate.failed(
                f"{len(tracks)} tracks with positive disparities and {len(lines)} lines with depth, need {_LEAST}"
            )
        problem = _Problem.of(tracks, lines, rig, self.threshold_px / _SIGMAS)
        if count == _LEAST:  # none to spare: no consensus could be told from chance
            return self._of_all(problem)
        reason = ""
        for factor in (1.0, _SECOND_TRY):
            wider = replace(problem, noise=factor * problem.noise)
            options = RansacOptions(
                threshold=_SIGMAS,
                confidence=self.confidence,
                min_iterations=_SAMPLES,
                max_iterations=self.max_iterations,
            )
            found = ransac(wider, options, np.random.default_rng(0))
            if found.model is not None:
                return self._concluded(wider, found.model)
            reason = reason or found.reason
        return MotionEstimate.failed(reason)

    def _of_all(self, problem: _Problem) -> MotionEstimate:
        every = np.arange(problem.num_data[0])
        views = [view for view in ALL for _ in every]
        with np.errstate(all="ignore"):
            start = motion_of(newton(problem.features.triplets(np.tile(every, 4), views, problem.rig)))
        return problem.descent(start, np.ones(len(every), dtype=np.bool_), _FULL) if start.success else start

    def _concluded(self, problem: _Problem, model: MotionEstimate) -> MotionEstimate:
        """Least squares of all inliers, until these stay the same, of the noise that they show."""
        least, most = (factor * self.threshold_px / _SIGMAS for factor in _RANGE)
        before = np.zeros(problem.num_data, dtype=np.bool_)
        for _ in range(_REFITS):
            problem = problem.told(model, least, most)
            inliers = problem.residuals(model) <= _SIGMAS
            if np.count_nonzero(inliers) < _LEAST or np.array_equal(inliers, before):
                break
            found = problem.descent(model, inliers, _FULL)
            if not found.success:
                return found
            model, before = found, inliers
        return model


def _with_direction(motion: MotionEstimate, covariance: FloatArray, distance: float) -> MotionEstimate:
    """The motion, and whether the direction of d is known, by the covariance (6, 6) of (w, d).

    Of lines that are nearly parallel d runs along them, farther than to what is seen, at the distance, metres.
    """
    length = float(np.linalg.norm(motion.d))
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    if not motion.success or sigma <= _MAX_DIRECTION_SIGMA * min(length, distance):
        return motion
    why = f"d is {length:.2g} m long and known to {sigma:.2g} m"
    return replace(motion, direction_known=False, reason=f"the direction of d is not determined: {why}")


@cache
def _quantile(freedom: int) -> float:
    """Of chi-squared, with the probability that a normal variable lies within ``_SIGMAS``."""
    return float(scipy.special.chdtri(freedom, scipy.special.chdtrc(1, _SIGMAS**2)))


@cache
def _truncated(freedom: int) -> float:
    """Mean of chi-squared below that."""
    quantile = _quantile(freedom)
    return freedom * float(scipy.special.chdtr(freedom + 2, quantile) / scipy.special.chdtr(freedom, quantile))
