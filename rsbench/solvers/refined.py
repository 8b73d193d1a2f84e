"""Maximum-likelihood solver: it minimises the exact rolling-shutter Sampson error over the six motion parameters.

Minimal samples of a robust search have three tracks or, without tracks, five matches of one camera, for which all
solutions with a small rotation are found. To first order in w, the exact constraint of the paper's motion is
linear in d, with coefficients that are linear in w:

    m(w) . d = 0,   m(w) = c + (a (x y^T - (x.y) I) - k1 [c]x) w,   c = x cross y, a = k3 - k1

Five such rows have a common null vector d if all ten 3 x 3 minors vanish. These are ten cubic equations in w with
20 monomials, solved by elimination and an action matrix. For a readout time of zero, this is the linearised
global-shutter five-point problem. The baseline is ignored; the resulting relative error, |w| baseline / (2 |d|),
is corrected by the refinement.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.imports import source_version
from rsbench.components.motion_kernels import cross, dot
from rsbench.components.motion_models import has_kernel, load_kernel, motion_model
from rsbench.core import so3
from rsbench.core.arguments import check_whole, keep_plain
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, temporal_pairs
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import FEWEST_PER_PARAMETER
from rsbench.solvers.engine.base import MatchSet, MotionEstimate, Solver, SolverSpec
from rsbench.solvers.engine.levenberg_marquardt import Minimum, levenberg_marquardt
from rsbench.solvers.engine.packed import Packed, each_term, heavy_tailed, pack, pack_pairs, solve_triples
from rsbench.solvers.essential_matrix import decompose_essential, eight_point
from rsbench.solvers.linear import pair_rays, scaled_translation, solve_reduced

IntArray = NDArray[np.int64]
_DEGREES = [
    *[(i, j, k) for i, j, k in itertools.product(range(4), repeat=3) if i + j + k == 3],
    *[(i, j, k) for total in (2, 1, 0) for i, j, k in itertools.product(range(3), repeat=3) if i + j + k == total],
]
"""Exponents of the 20 monomials: ten cubic, six quadratic and three linear ones, and the constant."""
_INDEX = {degrees: index for index, degrees in enumerate(_DEGREES)}
_LINEAR = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))


def _sum(*degrees: tuple[int, int, int]) -> int:
    total = tuple(sum(column) for column in zip(*degrees, strict=True))
    return _INDEX[(total[0], total[1], total[2])]


_PRODUCT = np.array([[[_sum(a, b, c) for c in _LINEAR] for b in _LINEAR] for a in _LINEAR], dtype=np.int64)
"""Index (4, 4, 4) of the monomial that is the product of three factors among 1, w1, w2, w3."""
_TRIPLES = np.array(list(itertools.combinations(range(5), 3)), dtype=np.int64)
_TIMES_W1 = [_sum(degrees, (1, 0, 0)) for degrees in _DEGREES[10:]]
_UNIT = 0.1
"""Unit of w in the elimination, radians, so that its values are of order one."""
_MAX_ROTATION = 0.6


@compiled
def linear_rows(pairs: FloatArray, rows: FloatArray) -> None:
    """Fill rows (n, 3, 4): m(w) of pairs (n, 7), as constant part and coefficients of w1, w2, w3."""
    for n in range(len(pairs)):
        x, y, k1 = (pairs[n, 0], pairs[n, 1], 1.0), (pairs[n, 2], pairs[n, 3], 1.0), pairs[n, 4]
        a, c = pairs[n, 5] - k1, cross(x, y)
        for i in range(3):
            rows[n, i, 0] = c[i]
            for j in range(3):
                rows[n, i, 1 + j] = a * x[i] * y[j]
            rows[n, i, 1 + i] -= a * dot(x, y)
            j, k = (i + 1) % 3, (i + 2) % 3
            rows[n, i, 1 + j] += k1 * c[k]
            rows[n, i, 1 + k] -= k1 * c[j]


@compiled
def _minors(rows: FloatArray, triples: IntArray, product: IntArray, out: FloatArray) -> None:
    """Add the coefficients (10, 20) of the determinants of all triples of rows to ``out``."""
    for t in range(10):
        for s in range(6):
            i, j, k = ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2))[s]
            sign = 1.0 if s < 3 else -1.0
            for p in range(4):
                for q in range(4):
                    pq = sign * rows[triples[t, 0], i, p] * rows[triples[t, 1], j, q]
                    for r in range(4):
                        out[t, product[p, q, r]] += pq * rows[triples[t, 2], k, r]


def five_point(pairs: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return all real ``(w, d)`` with small w for pairs (5, 7) of one camera; d has length 1 and any sign."""
    rows = np.zeros((5, 3, 4))
    linear_rows(pairs, rows)
    scaled = rows * np.array([1.0, _UNIT, _UNIT, _UNIT])
    scaled /= np.maximum(np.linalg.norm(scaled.reshape(5, 12), axis=1), 1e-300)[:, None, None]
    cubics = np.zeros((10, 20))
    _minors(scaled, _TRIPLES, _PRODUCT, cubics)
    try:
        reduced = np.linalg.solve(cubics[:, :10], cubics[:, 10:])
        action = np.zeros((10, 10))
        for row, target in enumerate(_TIMES_W1):
            if target < 10:
                action[row] = -reduced[target]
            else:
                action[row, target - 10] = 1.0
        if not np.all(np.isfinite(action)):
            return []
        values, vectors = np.linalg.eig(action)
    except np.linalg.LinAlgError:
        return []
    real = (np.abs(values.imag) < 1e-9 * (1.0 + np.abs(values.real))) & (np.abs(vectors[9]) > 1e-12)
    v = vectors[:, real].real
    w = _UNIT * v[8:5:-1] / v[9]
    w = w[:, np.linalg.norm(w, axis=0) < _MAX_ROTATION].T
    M = rows[:, :, 0] + np.einsum("nij,kj->kni", rows[:, :, 1:], w)
    _, axes = np.linalg.eigh(np.swapaxes(M, 1, 2) @ M)
    return list(zip(w, axes[:, :, 0], strict=True))


_SCREEN_ITERATIONS, _SCREEN_MATCHES = 6, 150
_LONGEST_START = 2.0
"""Largest initial length of d for pairs, in baselines."""
_REWEIGHTINGS = (5, 5)
"""Largest number of steps in each round of minimisation, after which the error distribution is re-estimated."""
_LEAST_IN_FRONT = 0.75
_AS_GOOD, _APART = 3.0, 25.0
"""Two motions fit equally well if their costs differ by less than the first, in standard deviations of the
difference; they are different if their squared distance, normalised by its covariance, is above the second."""
_NOISIER = 10.0
"""Ratio of the noise levels above which the motion with the larger one does not explain the matches."""
_NEARLY_PLANAR = 0.15
"""Largest residual of a homography, relative to the flow, for which its motions are tried as starts; for scenes
that are not planar it is 0.2 and more."""
LEAST_DEPTHS = 0.7
"""Smallest ratio of the median disparity to its standard deviation for which a covariance is stated. Below it,
errors of a point are not described by a linearisation: only half of the stated 95 % ellipsoids contained the
truth."""
_MOST_NOISE_PX = 1.5
"""Largest noise, px, at which pairs alone have a stated covariance. Features are located more precisely, so above
it, the motion model or most matches are wrong, and without tracks neither is noticed otherwise."""
NO_DEPTHS = "no deviation can be stated: disparities are smaller than their noise"
_LEAST_NOISE_PX = 0.01
"""Lower bound of the noise, px, in tests of what data determine; exact data have no residuals."""


@final
@dataclass(frozen=True, kw_only=True)
class RefinedSolver(Solver):
    """Minimisation over all six parameters with exact constraints, from several linear solutions.

    The cost has the Sampson error of matches over time, and the whitened error of tracks, which is to first order
    the reprojection error of bundle adjustment and determines the metric scale. With tracks, the descent starts at
    zero motion (the first step is the linear stereo pose-from-points solution). With pairs alone, it starts from
    the iterated linear solvers with 15, 11 and 9 unknowns, the eight-point algorithm and the motions of a
    homography; the sign of d comes from cheirality.
    """

    motion_model: str = "linear"
    """Interpolation between the rows: a motion model that has a kernel."""
    motion_parameters: dict[str, Any] = field(default_factory=dict, hash=False)
    """Parameters of the motion model; absent ones have its defaults."""
    use_tracks: bool = True
    """If false, tracks count as separate left and right matches, to compare fairly with solvers of pairs."""
    use_pairs: bool = True
    """If false, only tracks are used, at least three."""
    one_camera: bool = False
    """Use only the left camera's matches over time and estimate its motion, with d up to scale."""
    shutter: Literal["rolling", "global"] = "rolling"
    """``global``: assume a readout time of zero, to measure the effect of the rolling shutter."""
    iterations: int = 60
    """Largest number of Levenberg-Marquardt steps."""
    max_translation_m: float = 50.0
    """Largest translation per frame period, metres; pairs alone may not bound it."""
    max_scale_sigma: float = 0.5
    """Relative standard deviation of |d| above which an estimate from pairs is not metric."""
    max_direction_sigma: float = 0.5
    """Standard deviation of the direction of d (radians) above which it counts as unknown."""
    max_rotation_sigma: float = 0.2
    """Standard deviation of the rotation (radians) above which the estimate fails."""

    def __post_init__(self) -> None:
        load_kernel(self.motion_model, self.motion_parameters)
        if not (self.use_tracks or self.use_pairs):
            raise ValueError("use_tracks and use_pairs cannot both be off")
        if self.one_camera and not self.use_pairs:
            raise ValueError("one_camera: uses pairs, so use_pairs cannot be off")
        check_whole("iterations", self.iterations, 1, 10_000)
        keep_plain(self)

    @property
    def inner_keys(self) -> tuple[str, ...]:
        """Source version of the motion model if it belongs to another package."""
        model = motion_model(self.motion_model)
        return () if model.__module__.partition(".")[0] == "rsbench" else (source_version(model),)

    @property
    def spec(self) -> SolverSpec:
        minimum: dict[MatchSet, int] = {"left": 7, "right": 7} if self.use_pairs else {"tracks": 3}
        if self.one_camera:
            minimum = {"left": 8}
        return SolverSpec(
            needs=frozenset(minimum),
            minimum=minimum,
            metric=not self.one_camera,
            motion_model=self.motion_model,
            motion_parameters=self.motion_parameters,
            shutter=self.shutter,
            cameras="rig",
            reference_point="left" if self.one_camera else "body",
            reference="rsbench; maximum likelihood of Wang, Fan, Dai, eq. 1-6 without linearisation",
            assumes="constant velocity of the chosen motion model, Gaussian noise, no outliers",
        )

    def packed(self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter) -> Packed:
        """Pack the measurements that this solver uses, with the shutter that it assumes."""
        if self.shutter == "global":
            shutter = shutter.at_once()
        if not self.use_pairs:
            correspondences = Correspondences(tracks=correspondences.tracks)
        if self.one_camera:
            correspondences, rig = Correspondences(left=temporal_pairs(correspondences, "left")), rig.about("left")
        linked = self.use_tracks and len(correspondences.tracks) >= 3
        return pack(
            correspondences,
            rig,
            shutter,
            self.motion_model,
            use_tracks=linked,
            motion_parameters=self.motion_parameters,
        )

    def estimate(
        self, correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter
    ) -> MotionEstimate:
        packed = self.packed(correspondences, rig, shutter)
        counts: dict[MatchSet, int] = {**packed.pair_counts(), "tracks": len(correspondences.tracks)}
        if len(packed.tracks) == 0 and (short := self.spec.shortage(counts)):
            return short
        best = self._descend(packed, rig)
        if best is None:
            return MotionEstimate.failed("no start found: degenerate motion or scene")
        return self.report(packed, *self._settle(packed, best, rig))

    def sample_sizes(self, correspondences: Correspondences) -> dict[MatchSet, int]:
        """Return three tracks or, if there are fewer, five matches of the camera that has more of them."""
        if self.one_camera:
            return {"left": 5}
        if not self.use_pairs or (self.use_tracks and len(correspondences.tracks) >= 3):
            return {"tracks": 3}
        return {"left": 5} if len(correspondences.left) >= len(correspondences.right) else {"right": 5}

    def propose(self, sample: Correspondences, rig: StereoRig, shutter: RollingShutter) -> list[MotionEstimate]:
        (found,) = self.propose_all([sample], rig, shutter)
        return found

    def propose_all(
        self, samples: Sequence[Correspondences], rig: StereoRig, shutter: RollingShutter
    ) -> Iterable[list[MotionEstimate]]:
        size = 0 if self.one_camera else len(samples[0].tracks)
        if not self.use_pairs or (self.use_tracks and size >= 3):
            together = Correspondences(tracks=np.concatenate([sample.tracks for sample in samples]))
            packed = self.packed(together, rig, shutter)
            thetas = solve_triples(packed, np.arange(len(together.tracks)).reshape(-1, size))
            return (_finite(packed, [theta]) for theta in thetas)
        together = samples[0]
        if len(samples) > 1:  # each has matches of one camera
            left, right = (np.concatenate([getattr(sample, side) for sample in samples]) for side in SIDES)
            together = Correspondences(left=left, right=right)
        packed = self.packed(together, rig, shutter)
        parts = np.split(packed.pairs, len(samples))
        return (self._propose_pairs(replace(packed, pairs=each), rig) for each in parts)

    def _propose_pairs(self, packed: Packed, rig: StereoRig) -> list[MotionEstimate]:
        length = 0.5 * rig.baseline
        return _finite(
            packed, [packed.theta(w, packed.signed(w, length * d)) for w, d in five_point(packed.pairs)]
        )

    def improve(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        quick: bool = False,
    ) -> MotionEstimate:
        packed = self.packed(correspondences, rig, shutter)
        start = packed.theta(motion.w, motion.d)
        if not quick:
            return self.report(packed, *self._settle(packed, self._checked(packed, start), rig))
        w, d = packed.motion(self._minimise(packed, start, _SCREEN_ITERATIONS).theta)
        return MotionEstimate(w=w, d=d, success=True)

    def weigh(
        self,
        motion: MotionEstimate,
        correspondences: Correspondences,
        rig: StereoRig,
        shutter: RollingShutter,
        noise_px: float,
    ) -> MotionEstimate | None:
        if self.shutter == "global":
            return None  # Its residuals are not just noise if the matches have a rolling shutter.
        packed = self.packed(correspondences, rig, shutter)
        theta = packed.theta(motion.w, motion.d)
        tailed = heavy_tailed(packed, theta, noise_px)
        for iterations in _REWEIGHTINGS:
            if tailed is not None:
                theta = self._minimise(tailed, theta, iterations).theta
                tailed = heavy_tailed(packed, theta, tailed.scale)
        if tailed is None:
            return None
        return self.report(tailed, *self._settle(tailed, self._checked(tailed, theta), rig))

    def _minimise(self, packed: Packed, theta: FloatArray, iterations: int) -> Minimum:
        return levenberg_marquardt(
            packed.normal_equations,
            theta,
            iterations,
            self.max_translation_m,
            inverse_length=len(packed.tracks) == 0,
        )

    def _descend(self, packed: Packed, rig: StereoRig) -> Minimum | None:
        if len(packed.tracks) > 0:
            tracks, start = replace(packed, pairs=packed.pairs[:0]), np.zeros(6)
            if packed.apart:
                start = self._minimise(tracks.at_once(), start, self.iterations).theta
            return self._checked(packed, self._minimise(tracks, start, self.iterations).theta)
        starts = linear_starts(packed, rig)
        if not starts:
            return None
        screen = packed.subset(_SCREEN_MATCHES)
        screened = [self._minimise(screen, start, _SCREEN_ITERATIONS) for start in starts]
        chosen = min(screened, key=lambda minimum: minimum.cost)
        return self._checked(packed, chosen.theta)

    def _checked(self, packed: Packed, theta: FloatArray) -> Minimum:
        """Minimise from a start; if more points are in front for -d, minimise again from there."""
        if len(packed.tracks) > 0:
            return self._minimise(packed, theta, self.iterations)
        # Screening with fewer matches may have left |d| at its limit, where the cost is flat.
        length, most = float(np.linalg.norm(theta[3:])), _LONGEST_START * packed.baseline
        start = np.concatenate([theta[:3], theta[3:] * (most / max(length, most))])
        best = self._minimise(packed, start, self.iterations)
        flipped = np.concatenate([best.theta[:3], -best.theta[3:]])
        if packed.in_front(flipped) > packed.in_front(best.theta):
            return self._minimise(packed, flipped, self.iterations)
        return best

    def _settle(self, packed: Packed, best: Minimum, rig: StereoRig) -> tuple[Minimum, bool]:
        """Return the best minimum, also among those of a planar scene, and whether another fits equally well."""
        if len(packed.tracks) > 0:
            return best, False
        starts = [_signed_start(packed, packed.pairs, w, d, rig) for w, d in planar_motions(packed.larger_side())]
        found = sorted([best, *(self._checked(packed, start) for start in starts)], key=lambda each: each.cost)
        lowest, variance = found[0], max(packed.noise_variance(found[0].cost), _LEAST_NOISE_PX**2)
        for other in found[1:]:
            step = other.theta - lowest.theta
            if step @ lowest.H @ step > _APART * variance and _as_good(packed, lowest, other):
                return lowest, True
        return lowest, False

    def report(self, packed: Packed, best: Minimum, rival: bool = False) -> MotionEstimate:
        """Return the estimate with its covariance and with what the data leave undetermined.

        ``rival``: whether another motion fits equally well.
        """
        variance = packed.noise_variance(best.cost)
        if rotation_sigma(best.H, max(variance, _LEAST_NOISE_PX**2)) > self.max_rotation_sigma:
            return MotionEstimate.failed("the rotation is not determined: degenerate matches")
        w, d = packed.motion(best.theta)
        stated, covariance = packed.stated(best.theta, best.cost, best.H), None
        if stated is not None:
            J = packed.motion_jacobian(best.theta)
            covariance = J @ stated.covariance @ J.T
        if packed.one_camera:
            d, covariance = _of_unit_length(d, covariance)
        scale_sigma, direction_sigma = _translation_sigmas(d, covariance)
        at_limit = float(np.linalg.norm(best.theta[3:])) >= 0.999 * self.max_translation_m
        # Tracks give d in metres even if it is short; pairs give only its direction accurately.
        linked = len(packed.tracks) > 0
        known = scale_sigma <= self.max_scale_sigma and not at_limit and not packed.one_camera
        metric = linked or known
        # Without parallax, noise is fitted by a translation, but then half of the points are behind the cameras.
        # Tracks with negative disparities (points beyond infinity) would be fitted by the opposite motion.
        disparity = _disparity(packed) if linked else 0.0
        in_front = (
            disparity >= 0.0 if linked else packed.in_front(best.theta) >= _LEAST_IN_FRONT * len(packed.pairs)
        )
        direction_known = in_front and direction_sigma <= self.max_direction_sigma and not rival
        reasons = [] if metric else ["the length of d is not determined by these matches"]
        if linked and disparity < LEAST_DEPTHS * np.sqrt(2.0 * variance):
            covariance = None
            reasons.append(NO_DEPTHS)
        elif stated is not None and stated.count < FEWEST_PER_PARAMETER * packed.parameters:
            covariance = None
            reasons.append(f"no deviation can be stated: {stated.count:.0f} effective matches are too few")
        elif not linked and variance > _MOST_NOISE_PX**2:
            covariance = None
            reasons.append(f"no deviation can be stated: the motion fits matches only to {variance**0.5:.1f} px")
        if not direction_known:
            why = "another motion explains these matches as well (a plane)" if rival else "too little translation"
            why = why if in_front or not linked else "most disparities are negative: calibrate the rig again"
            reasons.append(f"the direction of d is not determined: {why}")
        return MotionEstimate(
            w=w,
            d=d,
            success=True,
            metric=metric,
            direction_known=direction_known,
            reason="; ".join(reasons),
            covariance=covariance,
            noise_px=float(np.sqrt(variance)) if packed.constraints > packed.parameters else None,
        )


def _disparity(packed: Packed) -> float:
    """Return the median disparity of the tracks, px."""
    ends = packed.tracks
    return float(np.median(ends[:, 2] if ends.ndim == 2 else packed.focal[0] * (ends[:, 0, 0] - ends[:, 1, 0])))


def _finite(packed: Packed, thetas: Iterable[FloatArray]) -> list[MotionEstimate]:
    motions = [packed.motion(theta) for theta in thetas if np.all(np.isfinite(theta))]
    return [MotionEstimate(w=w, d=d, success=True) for w, d in motions]


def _as_good(packed: Packed, best: Minimum, other: Minimum) -> bool:
    """Return whether the pairs do not prefer one of two motions significantly.

    Q. Vuong, Likelihood ratio tests for model selection and non-nested hypotheses, Econometrica 1989. His test is
    inconclusive if a few pairs cause nearly all of the difference; a motion with much more noise is then worse.
    """
    least = max(packed.noise_variance(best.cost), _LEAST_NOISE_PX**2)
    if packed.noise_variance(other.cost) > _NOISIER**2 * least:
        return False
    excess = packed.pair_costs(other.theta) - packed.pair_costs(best.theta)
    return float(np.sum(excess)) <= _AS_GOOD * float(np.std(excess)) * np.sqrt(len(excess))


def rotation_sigma(H: FloatArray, variance: float) -> float:
    """Return the standard deviation (radians) of the rotation about its worst axis, with d marginalised."""
    H_dd = H[3:, 3:]
    values, vectors = np.linalg.eigh(H_dd)
    keep = values > 1e-12 * max(values[-1], 1e-300)
    coupling = vectors[:, keep].T @ H[3:, :3]
    S = H[:3, :3] - coupling.T @ (coupling / values[keep, None])
    least = float(np.linalg.eigvalsh(S)[0])
    return float(np.sqrt(variance / least)) if least > 1e-12 * float(np.trace(H[:3, :3])) else np.inf


def _of_unit_length(d: FloatArray, covariance: FloatArray | None) -> tuple[FloatArray, FloatArray | None]:
    """Return the direction of d, and the covariance (6, 6) of rotation and direction."""
    length = max(float(np.linalg.norm(d)), 1e-300)
    u, P = d / length, np.eye(6)
    P[3:, 3:] = (np.eye(3) - np.outer(u, u)) / length
    return u, None if covariance is None else P @ covariance @ P.T


def _translation_sigmas(d: FloatArray, covariance: FloatArray | None) -> tuple[float, float]:
    """Return the relative standard deviation of |d|, and the standard deviation of its direction in radians."""
    length = float(np.linalg.norm(d))
    if covariance is None or length == 0.0:
        return np.inf, np.inf
    C = covariance[3:, 3:]
    along = max(float(d @ C @ d), 0.0) / length**2
    return float(np.sqrt(along)) / length, float(np.sqrt(max(np.trace(C) - along, 0.0))) / length


def linear_starts(packed: Packed, rig: StereoRig) -> list[FloatArray]:
    """Return starting parameters (6,) from pairs.

    They come from the iterated linear solvers, the eight-point algorithm for the left camera and a homography.
    """
    step = max(1, len(packed.pairs) // (2 * _SCREEN_MATCHES))
    pairs = packed.pairs[::step]
    solutions = [solve_reduced(pairs, unknowns, 3) for unknowns in (15, 11, 9)]
    motions = [solution for solution in solutions if not isinstance(solution, str)]
    left = pairs[pairs[:, 6] >= 0.0]
    if len(left) >= 8:
        x0, x1 = pair_rays(left)
        E = eight_point(x0, x1)
        if E is not None:
            pose, _ = decompose_essential(E, x0, x1)
            motions.append((so3.log(pose.R), pose.t))
    motions += planar_motions(packed.larger_side())
    return [_signed_start(packed, pairs, w, d, rig) for w, d in motions]


def planar_motions(pairs: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the motions ``(w, d)``, with d up to scale and sign, from the homography of pairs (n, 7) of one
    camera.

    The list is empty if the scene is far from planar. For a planar scene, the linear systems of the other starts
    lose rank. O. Faugeras, F. Lustman, Motion and structure from motion in a piecewise planar environment, 1988.
    """
    if len(pairs) < 4:
        return []
    import cv2

    x, y = np.ascontiguousarray(pairs[:, :2]), np.ascontiguousarray(pairs[:, 2:4])
    H, _ = cv2.findHomography(x, y, 0)
    if H is None or not np.all(np.isfinite(H)):
        return []
    missed = np.linalg.norm(cv2.perspectiveTransform(x[:, None], H)[:, 0] - y)
    if not missed <= _NEARLY_PLANAR * np.linalg.norm(y - x):
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    lengths = [float(np.linalg.norm(t)) for t in translations]
    return [
        (so3.log(R), t[:, 0])
        for R, t, length in zip(rotations, translations, lengths, strict=True)
        if length > 0.0
    ]


def _signed_start(packed: Packed, pairs: FloatArray, w: FloatArray, d: FloatArray, rig: StereoRig) -> FloatArray:
    """Return a start with a plausible length of d (the paper's range of motions) and its sign by cheirality."""
    scaled = scaled_translation(pairs, w, 10.0 * rig.baseline)
    length = 0.5 * rig.baseline
    if scaled is not None:
        length = float(np.clip(np.linalg.norm(scaled), 0.1 * rig.baseline, _LONGEST_START * rig.baseline))
    return packed.theta(w, packed.signed(w, d / np.linalg.norm(d) * length))


def warm_up(motion_models: Iterable[str] = ("linear",)) -> None:
    """Compile the solvers' code for these motion models, or load it from the cache on disk.

    Call this before starting workers, so that they find the code on disk, and in each worker before measuring
    time. Nothing is compiled for a model without a kernel.

    Raises:
        RsbenchError: there is no such motion model.
    """
    rig = StereoRig(camera=PinholeCamera.centred(64, 64, 60.0), baseline=1.0)
    shutter = RollingShutter(height=64, readout_ratio=0.5)
    x, y = np.linspace(5.0, 50.0, 8), np.linspace(50.0, 10.0, 8) ** 1.1 / 2.0
    tracks = np.column_stack([x + 4.0, y, x, y, x + 5.0, y + 1.0, x + 0.8, y + 1.0])
    pairs = tracks[:, [0, 1, 4, 5]] + 0.25
    matches = Correspondences(left=pairs, right=pairs, tracks=tracks)
    theta = np.array([0.01, 0.0, 0.0, 0.1, 0.0, 0.0])
    for model in [name for name in motion_models if has_kernel(name)]:
        packed = pack(matches, rig, shutter, model)
        packed.normal_equations(theta)
        packed.in_front(theta)
        each_term(packed, theta)
        solve_triples(packed, np.arange(6).reshape(2, 3))
    five_point(pack_pairs(pairs, "left", rig, shutter)[:5])
