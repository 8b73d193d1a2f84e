"""Maximum likelihood: the exact rolling-shutter Sampson error, minimised over the six parameters of the motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, final

import numpy as np

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.base import MatchSet, MotionEstimate, MotionModel, Solver
from rsbench.solvers.eight_point import decompose_essential, eight_point
from rsbench.solvers.iterated import scaled_translation, solve_reduced
from rsbench.solvers.optimise import Minimum, levenberg_marquardt
from rsbench.solvers.packed import Packed, pack

_SCREEN_ITERATIONS, _SCREEN_MATCHES = 6, 150


@final
@dataclass(frozen=True, kw_only=True)
class RefinedSolver(Solver):
    """Six-parameter descent on exact constraints, from several linear starts.

    Matches over time contribute their Sampson error, tracks the whitened error of their stereo pairs, which is
    the reprojection error of a bundle adjustment to first order and holds the metric scale. Starts: for
    tracks no motion at all (the first step is the linear stereo pose-from-points solution); for pairs the iterated
    linear solvers with 15, 11 and 9 unknowns and the eight-point algorithm. The sign of d comes from cheirality.
    """

    motion_model: MotionModel = "linear"
    """Interpolation between the rows: the paper's, or a constant twist."""
    use_tracks: bool = True
    """Off: tracks count as unlinked left and right matches, for a fair comparison with solvers of pairs."""
    iterations: int = 60
    max_translation_m: float = 50.0
    """Longest translation per frame period; pairs alone may not bound it."""
    max_scale_sigma: float = 0.5
    """Relative standard deviation of the length of d above which it does not count as metric."""
    max_direction_sigma: float = 0.5
    """Standard deviation of the direction of d (radians) above which it does not count as known."""

    name = "rs-stereo-refined"
    needs = frozenset[MatchSet]({"left", "right"})
    minimum: ClassVar[Mapping[MatchSet, int]] = MappingProxyType({"left": 7, "right": 7})
    metric = True
    shutter = "rolling"
    reference_point = "body"
    reference = "rsbench; maximum likelihood of the motion model of Wang, Fan, Dai, eq. 1-6 without linearisation"
    assumes = "constant velocity of the chosen motion model, Gaussian noise, no outliers"

    def __post_init__(self) -> None:
        if self.motion_model not in ("linear", "twist"):
            raise ValueError(f"motion_model must be 'linear' or 'twist', got {self.motion_model!r}")

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        packed = pack(correspondences, rig, shutter, self.motion_model, self.use_tracks)
        if len(packed.tracks) < 3:
            packed = pack(correspondences, rig, shutter, self.motion_model, use_tracks=False)
            for side, count in packed.pair_counts().items():
                if count < self.minimum[side]:
                    return MotionEstimate.failed(f"{count} {side} matches, need {self.minimum[side]}")
        best = self._descend(packed, rig)
        if best is None:
            return MotionEstimate.failed("no start found: degenerate motion or scene")
        return self.report(packed, best)

    def sample_sizes(self, correspondences: Correspondences) -> dict[MatchSet, int]:
        if self.use_tracks and len(correspondences.tracks) >= 3:
            return {"tracks": 3}
        return {"left": 4, "right": 4}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        packed = pack(sample, rig, shutter, self.motion_model, self.use_tracks)
        starts = [np.zeros(6)] if len(packed.tracks) >= 3 else linear_starts(packed, (9,), rig)
        minima = [self._minimise(packed, start, 5) for start in starts]
        return [_estimate(packed, minimum.theta) for minimum in minima if np.isfinite(minimum.cost)]

    def improve(
        self, motion: MotionEstimate, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        packed = pack(correspondences, rig, shutter, self.motion_model, self.use_tracks)
        return self.report(packed, self._checked(packed, packed.theta(motion.w, motion.d)))

    def _minimise(self, packed: Packed, theta: FloatArray, iterations: int) -> Minimum:
        return levenberg_marquardt(packed.normal_equations, theta, iterations, self.max_translation_m)

    def _descend(self, packed: Packed, rig: StereoRig) -> Minimum | None:
        if len(packed.tracks) >= 3:
            return self._minimise(packed, np.zeros(6), self.iterations)
        starts = linear_starts(packed, (15, 11, 9), rig)
        if not starts:
            return None
        screen = packed.subset(_SCREEN_MATCHES)
        screened = [self._minimise(screen, start, _SCREEN_ITERATIONS) for start in starts]
        chosen = min(screened, key=lambda minimum: minimum.cost)
        return self._checked(packed, chosen.theta)

    def _checked(self, packed: Packed, theta: FloatArray) -> Minimum:
        """Descent; when the points then lie behind the cameras, another from the opposite translation."""
        best = self._minimise(packed, theta, self.iterations)
        if len(packed.tracks) >= 3:
            return best
        flipped = np.concatenate([best.theta[:3], -best.theta[3:]])
        if packed.in_front(flipped) > packed.in_front(best.theta):
            return self._minimise(packed, flipped, self.iterations)
        return best

    def report(self, packed: Packed, best: Minimum) -> MotionEstimate:
        """Estimate with covariance and what the data leave open."""
        freedom = packed.constraints - 6
        variance = 2.0 * best.cost / freedom if freedom > 0 else np.nan
        w, d = packed.motion(best.theta)
        covariance = _covariance(packed, best, variance)
        length = float(np.linalg.norm(d))
        if covariance is None or length == 0.0:
            scale_sigma, direction_sigma = np.inf, np.inf
        else:
            C = covariance[3:, 3:]
            along = float(d @ C @ d) / length**2
            scale_sigma = np.sqrt(along) / length
            direction_sigma = np.sqrt(max(np.trace(C) - along, 0.0)) / length
        at_limit = float(np.linalg.norm(best.theta[3:])) >= 0.999 * self.max_translation_m
        # Tracks measure d in metres, however short it is; pairs only the direction of d well.
        linked = len(packed.tracks) >= 3
        metric = linked or (scale_sigma <= self.max_scale_sigma and not at_limit)
        direction_known = bool(direction_sigma <= self.max_direction_sigma)
        reasons = [] if metric else ["the length of d is not determined by these matches"]
        reasons += [] if direction_known else ["the direction of d is not determined: too little translation"]
        return MotionEstimate(
            w=w,
            d=d,
            success=True,
            metric=bool(metric),
            direction_known=direction_known,
            reason="; ".join(reasons),
            covariance=covariance,
            noise_px=float(np.sqrt(variance)) if np.isfinite(variance) else None,
        )


def _estimate(packed: Packed, theta: FloatArray) -> MotionEstimate:
    w, d = packed.motion(theta)
    return MotionEstimate(w=w, d=d, success=True, metric=True)


def _covariance(packed: Packed, best: Minimum, variance: float) -> FloatArray | None:
    scale = np.sqrt(np.maximum(np.diagonal(best.H), 1e-300))
    A = best.H / np.outer(scale, scale)
    if not np.isfinite(variance) or np.linalg.cond(A) > 1e14:
        return None
    J = packed.motion_jacobian(best.theta)
    return variance * J @ (np.linalg.inv(A) / np.outer(scale, scale)) @ J.T


def linear_starts(packed: Packed, families: tuple[int, ...], rig: StereoRig) -> list[FloatArray]:
    """Starting parameters (6,) from the pairs: iterated linear solvers, then eight points of the left camera."""
    step = max(1, len(packed.pairs) // (2 * _SCREEN_MATCHES))
    pairs = packed.pairs[::step]
    motions = []
    for unknowns in families:
        solution = solve_reduced(pairs, unknowns, 3)
        if not isinstance(solution, str):
            motions.append(solution)
    left = pairs[pairs[:, 6] > 0]
    if len(left) >= 8:
        ones = np.ones((len(left), 1))
        x0, x1 = np.hstack([left[:, :2], ones]), np.hstack([left[:, 2:4], ones])
        E = eight_point(x0, x1)
        if E is not None:
            pose, _ = decompose_essential(E, x0, x1)
            motions.append((so3.log(pose.R), pose.t))
    return [_signed_start(packed, pairs, w, d, rig) for w, d in motions]


def _signed_start(packed: Packed, pairs: FloatArray, w: FloatArray, d: FloatArray, rig: StereoRig) -> FloatArray:
    """Give a direction a plausible length (the paper's range of motions) and the sign of cheirality."""
    scaled = scaled_translation(pairs, w, 10.0 * rig.baseline)
    length = 0.5 * rig.baseline
    if scaled is not None:
        length = float(np.clip(np.linalg.norm(scaled), 0.1 * rig.baseline, 2.0 * rig.baseline))
    d = d / np.linalg.norm(d) * length
    front, back = (packed.in_front(packed.theta(w, sign * d)) for sign in (1.0, -1.0))
    return packed.theta(w, d if front >= back else -d)
