"""Correspondences as arrays for the compiled residuals, models of their errors (normal or heavy-tailed), and
motions from minimal samples of tracks.

Rays are normalised (z = 1), and each measurement occurs once.

Feature positions in noisy images have errors of some tenths of a pixel, and about one in a hundred has more than a
pixel. If the errors follow a t distribution with nu degrees of freedom and scale s, a measurement with p residuals
and squared error q has the weight

    w = (nu + p) / (nu + q / s^2),

so that outliers get little weight without a threshold. s and nu maximise the likelihood. K. Lange, R. Little, J.
Taylor, Robust statistical modeling using the t distribution, JASA 1989.

This weight does not detect an outlier that pulls the motion so far that its own residual vanishes. Such a match
has a large leverage, i.e. share of the information of all measurements (the leverages sum to 6). If the leverage
is bounded, its residual remains large (Mallows weights; P. Huber, Robust Statistics, 1981, 7.2: up to 0.2 is
safe).

Outliers that lie within ten scales by chance do not belong to the tail of the t distribution and would bias both
its parameters and the motion. The errors are therefore modelled as a mixture of the t distribution and a uniform
one over the ball of ten scales; their proportion is estimated too (EM: A. Dempster, N. Laird, D. Rubin, J. Royal
Statistical Society B 1977; uniform outliers: P. Torr, A. Zisserman, MLESAC, 2000). Each measurement is weighted by
its probability of being an inlier.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads scipy.special at its first use, which takes as long as loading all else that a solver needs
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.components.motion_kernels import MotionKernel
from rsbench.components.motion_models import load_kernel, quick_law
from rsbench.core.correspondences import BoolArray, Correspondences, temporal_pairs, unlinked_pairs
from rsbench.core.rig import FRAMES, SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import Stated, stated_covariance
from rsbench.solvers.engine.residuals import BEHIND, count_in_front, pair_terms, track_terms


@dataclass(frozen=True, kw_only=True, eq=False)
class Packed:
    """Measurements of one problem."""

    pairs: FloatArray
    """(n, 7) or (n, 17), see ``residuals.pair_terms``."""
    tracks: FloatArray
    """(m, 8), see ``residuals.track_terms``, or (m, 4, 9), see ``residuals.timed_track_terms``."""
    row_checks: FloatArray
    """(m,) squared row differences within the stereo pairs of each track, px^2: chi-squared with 2 degrees of
    freedom. They are 0 for tracks (m, 4, 9), whose errors already include them."""
    focal: FloatArray
    h: float
    baseline: float
    kernel: MotionKernel
    """The kernel of the motion model."""
    apart: bool = False
    """Whether descents start from the solution of ``at_once``, because the two ends of stereo pairs are read at
    very different times."""

    @property
    def law(self) -> MotionKernel:
        """The kernel in the form that the compiled residuals take."""
        return quick_law(self.kernel)

    @property
    def freedom(self) -> FloatArray:
        """Number p of residuals of each measurement, (n + m,)."""
        return np.repeat([float(_PAIR_FREEDOM), float(TRACK_FREEDOM)], [len(self.pairs), len(self.tracks)])

    @property
    def constraints(self) -> int:
        """Number of scalar equations that depend on the motion."""
        return len(self.pairs) + (3 if self.tracks.ndim == 2 else 5) * len(self.tracks)

    @property
    def one_camera(self) -> bool:
        """Whether all measurements are pairs of one camera at the body's origin; these do not determine |v|."""
        return len(self.tracks) == 0 and not np.any(self.pairs[:, 6])

    @property
    def parameters(self) -> int:
        """Number of unknowns of the motion that the measurements determine."""
        return 5 if self.one_camera else 6

    def definite(self, theta: FloatArray, H: FloatArray) -> FloatArray:
        """Return H (6, 6), made positive definite along v if the pairs do not determine |v|; steps do not change.

        This assumes a kernel whose T is proportional to v, as for all motion models of rsbench.
        """
        length = float(np.linalg.norm(theta[3:]))
        if not self.one_camera or length == 0.0:
            return H
        out, u = H.copy(), theta[3:] / length
        out[3:, 3:] += np.trace(H[3:, 3:]) * np.outer(u, u)
        return out

    def pair_counts(self) -> dict[Side, int]:
        """Return the number of pairs of each camera."""
        left = int(np.count_nonzero(self.pairs[:, 6] >= 0.0))
        return {"left": left, "right": len(self.pairs) - left}

    def larger_side(self) -> FloatArray:
        """Return the pairs (n, 7) or (n, 17) of the camera that has more of them."""
        left = self.pairs[:, 6] >= 0.0
        return self.pairs[left if 2 * np.count_nonzero(left) >= len(left) else ~left]

    def subset(self, most: int) -> Packed:
        """Return about ``most`` evenly spaced pairs and as many tracks, for choosing among starting points."""
        step_p, step_t = max(1, len(self.pairs) // most), max(1, len(self.tracks) // most)
        return self._of(self.pairs[::step_p], self.tracks[::step_t], self.row_checks[::step_t])

    def at_once(self) -> Packed:
        """Shift the right camera's ends to where it would see them at the left one's times, to first order.

        Without this, a descent from zero motion finds no depth if points move by more than their disparity between
        the two readouts.
        """
        tracks = self.tracks.copy()
        left, right = tracks[:, ::2], tracks[:, 1::2]
        moved = right[:, 1, :3] - right[:, 0, :3]
        rate = moved[:, :2] / np.maximum(moved[:, 2:], _LEAST_DURATION)
        right[:, :, :2] += (left[:, :, 2] - right[:, :, 2])[:, :, None] * rate[:, None]
        right[:, :, 2] = left[:, :, 2]
        return replace(self, tracks=tracks)

    def only(self, wanted: BoolArray) -> Packed:
        """Select measurements by a mask (n + m,) over the pairs followed by the tracks."""
        pairs, tracks = np.split(wanted, [len(self.pairs)])
        return self._of(self.pairs[pairs], self.tracks[tracks], self.row_checks[tracks])

    def _of(self, pairs: FloatArray, tracks: FloatArray, row_checks: FloatArray) -> Packed:
        # The arrays must be contiguous: for others, the kernels would be compiled once more.
        same = {name: getattr(self, name) for name in ("focal", "h", "baseline", "kernel", "apart")}
        pairs, tracks = np.ascontiguousarray(pairs), np.ascontiguousarray(tracks)
        return Packed(pairs=pairs, tracks=tracks, row_checks=row_checks, **same)

    def normal_equations(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return half the sum of squares in px^2, its gradient (6,) and Gauss-Newton Hessian (6, 6)."""
        residuals, squares = np.zeros(len(self.pairs)), np.zeros(len(self.tracks))
        H, gradient = np.zeros((6, 6)), np.zeros(6)
        pair_terms(theta, self.law, self.pairs, self.focal, self.h, residuals, H, gradient, True)
        track_terms(theta, self.law, self.tracks, self.focal, self.h, self.baseline, squares, H, gradient, True)
        return 0.5 * float(residuals @ residuals + np.sum(squares)), gradient, self.definite(theta, H)

    def pair_residuals(self, theta: FloatArray) -> FloatArray:
        """Return the Sampson errors (n,) of the pairs, px."""
        residuals, unused = np.zeros(len(self.pairs)), (np.zeros((6, 6)), np.zeros(6))
        pair_terms(theta, self.law, self.pairs, self.focal, self.h, residuals, *unused, False)
        return residuals

    def track_squares(self, theta: FloatArray) -> FloatArray:
        """Return squared whitened errors (m,) of the tracks, row checks included: px^2, 5 degrees of freedom."""
        squares, unused = np.zeros(len(self.tracks)), (np.zeros((6, 6)), np.zeros(6))
        track_terms(theta, self.law, self.tracks, self.focal, self.h, self.baseline, squares, *unused, False)
        return np.where(squares >= BEHIND, BEHIND, squares + self.row_checks)

    def pair_costs(self, theta: FloatArray) -> FloatArray:
        """Return twice the contribution of each pair (n,) to the cost, px^2."""
        return self.pair_residuals(theta) ** 2

    def noise_variance(self, cost: float) -> float:
        """Estimate the variance (px^2) of a coordinate from the cost; 0 without more equations than unknowns."""
        freedom = self.constraints - self.parameters
        return 2.0 * cost / freedom if freedom > 0 else 0.0

    def stated(self, theta: FloatArray, cost: float, H: FloatArray) -> Stated | None:
        """Return the covariance (6, 6) of theta at the minimum, see ``core.uncertainty``; None if undefined."""
        inverse, variance = inverse_definite(H), self.noise_variance(cost)
        if inverse is None or self.constraints <= self.parameters:
            return None
        each = each_term(self, theta)
        if not variance > _EXACT_PX**2:
            return Stated(variance * inverse)
        return self._stated(theta, each, np.ones(len(each.squares)), inverse, variance * inverse, variance)

    def _stated(
        self,
        theta: FloatArray,
        each: Each,
        weights: FloatArray,
        inverse: FloatArray,
        information: FloatArray,
        variance: float,
    ) -> Stated:
        """Call ``stated_covariance`` with this ``variance`` (px^2); measurements lie at their rays in frame 0."""
        tracks = self.tracks[:, :2] if self.tracks.ndim == 2 else self.tracks[:, 0, :2]
        moved = list[FloatArray]()
        for shifted in self.shifted(_SHIFT_STEP_PX):
            there = each_term(shifted, theta)
            seen = (each.squares < BEHIND) & (there.squares < BEHIND)
            moved.append(np.where(seen[:, None], there.gradients - each.gradients, 0.0) / _SHIFT_STEP_PX)
        return stated_covariance(
            weights[:, None] * each.gradients,
            inverse,
            information,
            _leverages(self, theta, each, weights),
            np.concatenate([self.pairs[:, :2], tracks]),
            self.parameters,
            weights[:, None] * np.stack(moved),
            math.sqrt(variance),
        )

    def shifted(self, px: float) -> Iterator[Packed]:
        """Yield the measurements with some ends shifted: right ones of frame 0, of frame 1, or all of frame 1.

        They are shifted along x and then along y; a shift on which no measurement depends is left out.
        """
        timed, step = self.tracks.ndim == 3 or self.pairs.shape[1] == 17, px * np.eye(2)
        for ends, axis in product(((1,), (3,), (2, 3)), range(2)):
            pairs, tracks = self.pairs.copy(), self.tracks.copy()
            if 2 in ends:
                pairs[:, 2:4] += (
                    (pairs[:, 11:15].reshape(-1, 2, 2) if timed else np.eye(2)) @ step[axis] / self.focal
                )
            if self.tracks.ndim == 3:
                for end in ends:
                    tracks[:, end, :2] += tracks[:, end, 3:7].reshape(-1, 2, 2) @ step[axis] / self.focal
            elif 2 in ends:
                tracks[:, 3 + axis] += px
            elif axis == 1:  # both images have one row in common
                continue
            elif ends == (1,):
                tracks[:, 0] += 0.5 * px / self.focal[0]
                tracks[:, 2] -= px
            else:
                tracks[:, 3] += 0.5 * px
                tracks[:, 5] -= px
            yield replace(self, pairs=pairs, tracks=tracks)

    def in_front(self, theta: FloatArray) -> int:
        """Count the pairs whose point lies in front of both cameras."""
        return count_in_front(theta, self.law, self.pairs)

    def signed(self, w: FloatArray, d: FloatArray) -> FloatArray:
        """Return d or -d (3,), whichever puts more pairs in front of the cameras."""
        front, back = (self.in_front(self.theta(w, each)) for each in (d, -d))
        return d if front >= back else -d

    def theta(self, w: FloatArray, d: FloatArray) -> FloatArray:
        """Return the kernel's parameters (6,) for the motion (w, d)."""
        return self.kernel.theta(w, d)

    def motion(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``(w, d)`` for the kernel's parameters."""
        return self.kernel.motion(theta)

    def motion_jacobian(self, theta: FloatArray) -> FloatArray:
        """Return the derivative (6, 6) of (w, d) by the kernel's parameters."""
        return self.kernel.motion_jacobian(theta)


def inverse_definite(H: FloatArray) -> FloatArray | None:
    """Invert a positive definite matrix whose unknowns have different units; None if it is not definite."""
    scale = np.sqrt(np.maximum(np.diagonal(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    if not values[0] > 1e-12 * values[-1]:
        return None
    half = vectors / scale[:, None] / np.sqrt(values)
    return np.asarray(half @ half.T)


def pack(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    motion_model: str = "linear",
    use_tracks: bool = True,
    *,
    motion_parameters: Mapping[str, Any] | None = None,
) -> Packed:
    """Convert matches to the arrays of the compiled residuals.

    Args:
        motion_model: name of the motion model whose kernel gives the residuals.
        use_tracks: if False, tracks count as independent left and right pairs.
        motion_parameters: the model's own parameters.

    Raises:
        RsbenchError: the model does not exist or has no kernel.
        ValueError: there are tracks but the rig's origin is not the middle of the baseline, or a match lies at a
            pixel for which the lens has no ray.
    """
    kernel = load_kernel(motion_model, motion_parameters)
    tracks = correspondences.tracks if use_tracks else correspondences.tracks[:0]
    timed = not _rectified(rig, shutter)
    pairs = [np.zeros((0, 17 if timed else 7))]
    for side in SIDES:
        if use_tracks:
            matches = getattr(correspondences, side)[unlinked_pairs(correspondences, side)]
        else:
            matches = temporal_pairs(correspondences, side)
        if len(matches):
            pairs.append(pack_pairs(matches, side, rig, shutter))
    if len(tracks) and rig.origin != "middle":
        raise ValueError(f"tracks are measured about the middle of the baseline, not the {rig.origin} camera")
    camera, packed_tracks = rig.camera, (_pack_timed_tracks if timed else _pack_tracks)(tracks, rig, shutter)
    apart = timed and (not rig.aligned or shutter.right_readout_ratio is not None)
    checks = 0.5 * ((tracks[:, 1] - tracks[:, 3]) ** 2 + (tracks[:, 5] - tracks[:, 7]) ** 2)
    return Packed(
        pairs=np.concatenate(pairs),
        tracks=packed_tracks,
        row_checks=np.zeros(len(tracks)) if timed else checks,
        focal=np.array([camera.fx, camera.fy]),
        h=float(shutter.rate("left")[1]),
        baseline=rig.baseline,
        kernel=kernel,
        apart=apart and bool(np.any(np.abs(packed_tracks[:, ::2, 2] - packed_tracks[:, 1::2, 2]) > _APART)),
    )


def _rectified(rig: StereoRig, shutter: RollingShutter) -> bool:
    """Return whether the two ends of a left-right match lie on the same row and are read at the same time."""
    return rig.rectified and shutter.rows_together


def pack_pairs(matches: FloatArray, side: Side, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Convert matches (n, 4) of one camera to the pairs (n, 7) or (n, 17) of ``residuals.pair_terms``."""
    camera, ends = rig.eye(side), (matches[:, :2], matches[:, 2:])
    out = np.zeros((len(matches), 7 if _rectified(rig, shutter) else 17))
    out[:, :2], out[:, 2:4] = (camera.unproject(end)[:, :2] for end in ends)
    _check_rays(out[:, :4], rig)
    out[:, 4], out[:, 5] = (shutter.pixel_time(end, frame, side) for frame, end in enumerate(ends))
    out[:, 6] = rig.offset(side)[0]
    if out.shape[1] == 17:
        out[:, 7:11], out[:, 11:15] = (camera.ideal_by_pixel(end).reshape(-1, 4) for end in ends)
        out[:, 15:] = shutter.rate(side)
    return out


def _pack_timed_tracks(tracks: FloatArray, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Convert tracks (n, 8) to the tracks (n, 4, 9) of ``residuals.timed_track_terms``."""
    out = np.zeros((len(tracks), 4, 9))
    for k, (frame, side) in enumerate(product(FRAMES, SIDES)):
        end, eye = tracks[:, 2 * k : 2 * k + 2], rig.eye(side)
        out[:, k, :2], out[:, k, 2] = eye.unproject(end)[:, :2], shutter.pixel_time(end, frame, side)
        _check_rays(out[:, k, :2], rig)
        out[:, k, 3:7], out[:, k, 7:] = eye.ideal_by_pixel(end).reshape(-1, 4), shutter.rate(side)
    return out


def _check_rays(rays: FloatArray, rig: StereoRig) -> None:
    if not rig.rectified and np.any(np.isnan(rays)):
        raise ValueError(
            f"{np.count_nonzero(np.isnan(rays[:, 0]))} matches: the camera shows no ray at their pixels"
        )


def _pack_tracks(tracks: FloatArray, rig: StereoRig, shutter: RollingShutter) -> FloatArray:
    """Convert tracks (n, 8) of a rig whose rows are read together to those (n, 8) of ``residuals.track_terms``."""
    camera = rig.camera
    middle = 0.5 * (tracks[:, [0, 1, 4, 5]] + tracks[:, [2, 3, 6, 7]])
    out = np.zeros((len(tracks), 8))
    out[:, :2] = camera.unproject(middle[:, :2])[:, :2]
    out[:, 2], out[:, 5] = tracks[:, 0] - tracks[:, 2], tracks[:, 4] - tracks[:, 6]
    out[:, 3], out[:, 4] = middle[:, 2] - camera.cx, middle[:, 3] - camera.cy
    out[:, 6], out[:, 7] = (
        shutter.pixel_time(middle[:, 2 * frame : 2 * frame + 2], frame, "left") for frame in FRAMES
    )
    return out


class Each(NamedTuple):
    """Errors and derivatives of each measurement at one motion: pairs, then tracks, n in all."""

    squares: FloatArray
    """(n,) squared whitened errors, px^2."""
    gradients: FloatArray
    """(n, 6) gradients of half the squares."""
    hessians: FloatArray
    """(n, 6, 6) Gauss-Newton Hessians of half the squares."""


def each_term(packed: Packed, theta: FloatArray) -> Each:
    """Return the individual terms of ``Packed.normal_equations``; squares of tracks include their row checks."""
    pairs, count = len(packed.pairs), len(packed.pairs) + len(packed.tracks)
    squares, g, H = np.zeros(count), np.zeros((count, 6)), np.zeros((count, 6, 6))
    first, last, camera = slice(pairs), slice(pairs, None), (packed.focal, packed.h)
    _each_pair(theta, packed.law, packed.pairs, *camera, squares[first], H[first], g[first])
    squares[first] **= 2
    _each_track(theta, packed.law, packed.tracks, *camera, packed.baseline, squares[last], H[last], g[last])
    squares[last] += packed.row_checks
    return Each(squares, g, H)


@compiled
def _each_pair(
    theta: FloatArray,
    kernel: MotionKernel,
    pairs: FloatArray,
    focal: FloatArray,
    h: float,
    residuals: FloatArray,
    H: FloatArray,
    gradients: FloatArray,
) -> None:
    want = len(pairs) > 0  # a literal True would compile all of pair_terms once more
    for k in range(len(pairs)):
        pair_terms(theta, kernel, pairs[k : k + 1], focal, h, residuals[k : k + 1], H[k], gradients[k], want)


@compiled
def _each_track(
    theta: FloatArray,
    kernel: MotionKernel,
    tracks: FloatArray,
    focal: FloatArray,
    h: float,
    baseline: float,
    squares: FloatArray,
    H: FloatArray,
    gradients: FloatArray,
) -> None:
    want = len(tracks) > 0
    for k in range(len(tracks)):
        one = tracks[k : k + 1]
        track_terms(theta, kernel, one, focal, h, baseline, squares[k : k + 1], H[k], gradients[k], want)


_FEWEST = 30
"""Smallest number of measurements, five per parameter: fewer do not determine the distribution of the errors."""
_TAILS = (3.0, 5.0, 10.0, 30.0)
"""Candidates for nu: SIFT features under photon noise have about 3; 30 is practically a normal distribution."""
_REACH = 10.0
"""Error, in scales, beyond which a match is an outlier: its weight would be below 0.04."""
_FIRST_NU, _MIXTURE_STEPS, _MOST_RIGHT = 3.0, 4, 0.999
"""Initial nu, number of EM iterations for the mixture, and largest share of inliers within the ten scales."""
_SHIFT_STEP_PX = 1e-3
"""Step of numerical derivatives by the pixels of measurements, px."""
_EXACT_PX = 1e-7
"""Noise below which matches count as exact."""
_SAFE_LEVERAGE, _TIMES_THE_MEAN = 0.2, 3.0
_LEVERAGE_STEPS = 4
_SCALE_STEPS, _SCALE_FLAT = 50, 1e-4
_ONE_SIGMA = 0.5 * (1.0 + math.erf(1.0 / math.sqrt(2.0)))
_LEAST_SLOPE = 0.1
_LEAST_SCALE_PX = 1e-9
TRACK_FREEDOM, _PAIR_FREEDOM, _PARAMETERS = 5, 1, 6
_PARTS, _PART_TRACKS = 6, 10
"""Largest number of groups of rows whose motions are compared, and smallest number of tracks in each."""
_SHARED, _CHANCE, _PER_EXCESS = 1.5, 1e-3, 2.0
"""Dispersion that correlated errors of neighbours cause, significance level at which rows contradict a motion
model, and weight of their excess scatter; chosen on draws like those of the track points-2 (seeds 4000 to
4239)."""


class Rows(NamedTuple):
    """Result of testing whether one motion fits all groups of rows, see ``HeavyTailed.by_rows``."""

    square: float
    """Chi-squared statistic."""
    freedom: int

    def dispersion(self, shared: float) -> float:
        """Return a factor, at least 1, for a covariance already multiplied by ``shared`` for common errors.

        Scatter due to errors common to a group of rows counts once. If the camera departs from the motion model,
        the excess counts ``_PER_EXCESS`` times: the estimate has the information of all groups, but the error of
        one.
        """
        scatter = self.square / self.freedom
        return max(1.0, scatter, 1.0 + _PER_EXCESS * (scatter / shared - 1.0))

    @property
    def contradict(self) -> bool:
        """Whether no motion of the model fits all rows, even if errors of neighbours are correlated."""
        return self.square > _SHARED * float(scipy.special.chdtri(self.freedom, _CHANCE))


@dataclass(frozen=True, kw_only=True, eq=False)
class HeavyTailed(Packed):
    """Measurements of one problem, like ``Packed``, with heavy-tailed errors of known distribution."""

    nu: float
    scale: float
    """s, px."""
    trust: FloatArray
    """(n + m,) factors on the weights of pairs and tracks, at most 1: Mallows weight times inlier probability."""
    doubt: FloatArray | None = None
    """(n + m,) probability that each measurement is an outlier; None means 0."""

    def weights(self, squares: FloatArray) -> FloatArray:
        """Return the weights (n + m,) of the squared errors in iteratively reweighted least squares."""
        return self.trust * (self.nu + self.freedom) / (self.nu + squares / self.scale**2)

    def slopes(self, squares: FloatArray) -> FloatArray:
        """Return derivatives (n + m,) of weight times residual, averaged over directions of the residuals."""
        bend = 2.0 * squares / self.freedom / (self.nu * self.scale**2 + squares)
        return self.weights(squares) * (1.0 - bend)

    def normal_equations(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the negative log-likelihood times s^2, px^2, its gradient (6,) and its Hessian (6, 6).

        Each measurement counts in the Hessian by at least a tenth of its weight; far outliers would be negative.
        """
        each = each_term(self, theta)
        costs = 0.5 * self.trust * (self.nu + self.freedom) * np.log1p(each.squares / (self.nu * self.scale**2))
        weights = self.weights(each.squares)
        gradient = weights @ each.gradients
        H = np.tensordot(np.maximum(self.slopes(each.squares), _LEAST_SLOPE * weights), each.hessians, 1)
        return self.scale**2 * float(np.sum(costs)), gradient, self.definite(theta, H)

    def pair_costs(self, theta: FloatArray) -> FloatArray:
        """Return twice the contribution of each pair (n,) to the cost, px^2."""
        squares = self.pair_residuals(theta) ** 2
        trust = self.trust[: len(squares)] * (self.nu + _PAIR_FREEDOM)
        return trust * self.scale**2 * np.log1p(squares / (self.nu * self.scale**2))

    def noise_variance(self, cost: float) -> float:
        """Return the variance of a coordinate, px^2, disregarding tails: 68 % of the errors are below its root."""
        return (self.scale * float(scipy.special.stdtrit(self.nu, _ONE_SIGMA))) ** 2

    def stated(self, theta: FloatArray, cost: float = 0.0, H: FloatArray | None = None) -> Stated | None:
        """Return the covariance, which is valid for any distribution of the errors; None if it is undefined.

        See ``core.uncertainty``. The Hessian of the mixture is that of the t distribution minus the information
        that is lost because the inliers are not known for certain (T. Louis, J. Royal Statistical Society B 1982).
        A track is one measurement: correlated errors of its keypoints are counted together.
        """
        each, variance = each_term(self, theta), self.scale**2
        weights = self.weights(each.squares)
        bend = 2.0 * weights / (self.nu * variance + each.squares)
        if self.doubt is not None:
            tails = (self.nu + self.freedom) / (self.nu + each.squares / variance)
            bend += weights * self.doubt * tails / variance
        expected = self.trust * (self.nu + self.freedom) / (self.nu + self.freedom + 2.0)
        information = inverse_definite(self.definite(theta, np.tensordot(expected, each.hessians, 1)))
        A = np.tensordot(weights, each.hessians, 1) - (bend[:, None] * each.gradients).T @ each.gradients
        inverse = inverse_definite(self.definite(theta, A))
        if inverse is None or information is None:
            return None
        return self._stated(theta, each, weights, inverse, variance * information, self.noise_variance(0.0))

    def by_rows(self, theta: FloatArray) -> Rows | None:
        """Test whether the residuals of a motion model depend on the rows' readout time; None below 30 tracks.

        If the model is right, the step to the best motion of each group of rows, squared and normalised by its
        information, is chi-squared distributed; all groups but one have six degrees of freedom each (score test,
        C. Rao, Proc. Cambridge Philosophical Society 1948).
        """
        times = self.tracks[:, 0, 2] if self.tracks.ndim == 3 else self.tracks[:, 6]
        if len(times) < _FEWEST:
            return None
        each, pairs = each_term(self, theta), len(self.pairs)
        count = min(_PARTS, len(times) // _PART_TRACKS)
        parts = np.argsort(np.argsort(times, kind="stable"), kind="stable") * count // len(times)
        slopes = (self.weights(each.squares)[:, None] * each.gradients)[pairs:]
        expected = self.trust * (self.nu + self.freedom) / (self.nu + self.freedom + 2.0)
        square = 0.0
        for own in (parts == number for number in range(count)):
            slope = np.sum(slopes[own], axis=0)
            information = np.tensordot(expected[pairs:][own], each.hessians[pairs:][own], 1)
            square += float(slope @ np.linalg.pinv(information, hermitian=True) @ slope) / self.scale**2
        return Rows(square=square, freedom=6 * (count - 1))


def heavy_tailed(packed: Packed, theta: FloatArray, scale: float) -> HeavyTailed | None:
    """Estimate the distribution of the errors at a motion near the true one; None below 30 measurements.

    Args:
        scale: first guess of the scale s, px; measurements with errors beyond 10 scales are outliers.
    """
    each = each_term(packed, theta)
    freedom = packed.freedom
    means, right, nu = each.squares / freedom, np.ones(len(freedom)), _FIRST_NU
    for step in range(_MIXTURE_STEPS):
        near = means <= (_REACH * scale) ** 2
        if np.count_nonzero(near) < _FEWEST:
            return None
        q, p = each.squares[near], freedom[near]
        if step > 0:
            right[near] = _probability_right(q, p, nu, scale, float(np.mean(right[near])))
        count = right[near]
        nu, scale = t_distribution(q, p, scale, max(float(count @ p) - _PARAMETERS, 1.0), count=count)
    near = means <= (_REACH * scale) ** 2
    right = np.where(near, right, 0.0)[near]
    tailed = HeavyTailed(**vars(packed.only(near)), nu=nu, scale=scale, trust=right, doubt=1.0 - right)
    each = Each(*(part[near] for part in each))
    return replace(tailed, trust=right * _bounded(tailed, theta, each, tailed.weights(each.squares)))


def _probability_right(q: FloatArray, p: FloatArray, nu: float, scale: float, share: float) -> FloatArray:
    """Return the probability (n,) that each measurement within the ten scales is an inlier.

    Args:
        share: proportion of inliers among them.
    """
    gammaln = scipy.special.gammaln
    inside = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * (nu + p) * np.log1p(q / (nu * scale**2))
    outside = gammaln(0.5 * p + 1.0) - 0.5 * p * np.log(_REACH**2 * p / nu)  # one over the volume of the ball
    share = min(share, _MOST_RIGHT)
    return np.asarray(scipy.special.expit(inside - outside + np.log(share / (1.0 - share))))


def t_distribution(
    squares: FloatArray,
    p: FloatArray,
    scale: float,
    freedom: float,
    least: float = _LEAST_SCALE_PX,
    count: FloatArray | None = None,
) -> tuple[float, float]:
    """Return nu (one of ``_TAILS``) and s that maximise the likelihood.

    Args:
        squares: (n,) squared errors of measurements, px^2, of p (n,) residuals each.
        scale: first guess of s, px.
        freedom: number of residuals minus the number of fitted parameters.
        least: lower bound of s, px.
        count: (n,) weight of each measurement in the likelihood; None means 1.
    """
    count = np.ones(len(p)) if count is None else count
    found = [(nu, _scale(squares, p, nu, scale, freedom, least, count)) for nu in _TAILS]
    return max(found, key=lambda tails: _likelihood(squares, p, *tails, count))


def _scale(
    squares: FloatArray, p: FloatArray, nu: float, scale: float, freedom: float, least: float, count: FloatArray
) -> float:
    """Return the scale of maximum likelihood for a given nu.

    The parameter-expanded EM algorithm needs half the steps of plain EM: the mean of the weights at convergence is
    known, so each step divides by their present mean instead (C. Liu, D. Rubin, Y. Wu, Biometrika 1998).
    """
    mean = float(np.sum(count)) + (float(count @ p) - freedom) / nu
    for _ in range(_SCALE_STEPS):
        weights = count * (nu + p) / (nu + squares / scale**2)
        last, scale = scale, float(np.sqrt(weights @ squares / freedom * mean / np.sum(weights)))
        scale = max(scale, least)
        if abs(scale - last) <= _SCALE_FLAT * scale:
            break
    return scale


def _likelihood(squares: FloatArray, p: FloatArray, nu: float, scale: float, count: FloatArray) -> float:
    """Return the log-likelihood, without terms that are the same for all nu and scales."""
    gammaln = scipy.special.gammaln
    norm = gammaln(0.5 * (nu + p)) - gammaln(0.5 * nu) - 0.5 * p * np.log(nu * scale**2)
    return float(count @ (norm - 0.5 * (nu + p) * np.log1p(squares / (nu * scale**2))))


def _leverages(packed: Packed, theta: FloatArray, each: Each, weights: FloatArray) -> FloatArray:
    """Return each measurement's leverage (n,), the trace of H^-1 H_i with H the sum of the weighted Hessians H_i.

    The leverages sum to 6, or to 5 for one camera; they are 0 if H is singular.
    """
    inverse = inverse_definite(packed.definite(theta, np.tensordot(weights, each.hessians, 1)))
    if inverse is None:
        return np.zeros(len(weights))
    return weights * (each.hessians.reshape(-1, _PARAMETERS**2) @ inverse.ravel())


def _bounded(packed: Packed, theta: FloatArray, each: Each, weights: FloatArray) -> FloatArray:
    """Return factors (n,), at most 1, that reduce leverages to 0.2, or to three times the mean if that is more."""
    bound = min(max(_SAFE_LEVERAGE, _TIMES_THE_MEAN * _PARAMETERS / max(len(weights), 1)), 0.9)
    factors = np.ones(len(weights))
    for _ in range(_LEVERAGE_STEPS):
        share = np.minimum(_leverages(packed, theta, each, factors * weights), 0.999)
        high = share > bound
        if not np.any(high):
            break
        # With all other weights fixed, share / (1 - share) is proportional to the measurement's weight.
        factors[high] *= bound / (1.0 - bound) * (1.0 - share[high]) / share[high]
    return factors


_TRIPLE_DAMPING = 1e-4
_APART, _LEAST_DURATION = 0.05, 0.05
"""Frame periods between the two ends of a stereo pair above which ``Packed.apart`` is set, and shortest plausible
time from an end to the same end in the next frame (only wrong matches have less)."""


def solve_triples(packed: Packed, samples: NDArray[np.int64], iterations: int = 4) -> FloatArray:
    """Return motion parameters (b, 6) for samples (b, k) of k >= 3 tracks; NaN if a step is undetermined.

    Damped Gauss-Newton starts at zero motion, so that its first step is the linear stereo pose-from-points
    solution; if ``packed.apart``, it starts at the solution for the tracks of ``at_once``. A step that raises the
    cost is rejected and the damping grows.
    """
    out = np.zeros((len(samples), 6))
    for each in (packed.at_once(), packed) if packed.apart else (packed,):
        out[~np.all(np.isfinite(out), axis=1)] = 0.0
        _descend(each.tracks, samples, packed.law, packed.focal, packed.h, packed.baseline, iterations, out)
    return out


@compiled
def _descend(
    tracks: FloatArray,
    samples: NDArray[np.int64],
    kernel: MotionKernel,
    focal: FloatArray,
    h: float,
    baseline: float,
    iterations: int,
    out: FloatArray,
) -> None:
    size = samples.shape[1]
    want = size > 0  # a literal True would compile all of track_terms once more
    squares = np.zeros(size)
    H, gradient, theta, step = np.zeros((6, 6)), np.zeros(6), np.zeros(6), np.zeros(6)
    trial_H, trial_gradient = np.zeros((6, 6)), np.zeros(6)
    for s in range(len(samples)):
        chosen = tracks[samples[s]]
        H[:], gradient[:], damping = 0.0, 0.0, _TRIPLE_DAMPING
        for k in range(6):
            theta[k] = out[s, k]
        track_terms(theta, kernel, chosen, focal, h, baseline, squares, H, gradient, want)
        cost = _sum(squares)
        for _ in range(iterations):
            if not damped_step(H, gradient, damping, step):
                theta[:] = np.nan
                break
            trial = np.zeros(6)
            for k in range(6):
                trial[k] = theta[k] + step[k]
            trial_H[:], trial_gradient[:] = 0.0, 0.0
            track_terms(trial, kernel, chosen, focal, h, baseline, squares, trial_H, trial_gradient, want)
            if _sum(squares) <= cost:
                cost = _sum(squares)
                theta, H, trial_H, gradient, trial_gradient = trial, trial_H, H, trial_gradient, gradient
                damping *= 0.1
            else:
                damping *= 10.0
        # Elements are copied one by one, and arrays swapped above: the shape check of a slice copy takes a second
        # to compile.
        for k in range(6):
            out[s, k] = theta[k]


@compiled
def _sum(values: FloatArray) -> float:
    """Return ``values.sum()``; Numba's array functions, here and above, would load ``scipy.linalg``."""
    total = 0.0
    for k in range(len(values)):
        total += values[k]
    return total


@compiled
def damped_step(H: FloatArray, gradient: FloatArray, damping: float, step: FloatArray) -> bool:
    """Fill step (6,) with -(H + damping diag H)^-1 gradient, by Cholesky; False when H is singular."""
    n = len(step)
    L = np.zeros((n, n))
    for j in range(n):
        if not H[j, j] > 0.0:
            return False
        pivot = H[j, j] * (1.0 + damping)
        for k in range(j):
            pivot -= L[j, k] * L[j, k]
        if not pivot > 1e-14 * H[j, j]:
            return False
        L[j, j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            value = H[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / L[j, j]
    for i in range(n):
        value = -gradient[i]
        for k in range(i):
            value -= L[i, k] * step[k]
        step[i] = value / L[i, i]
    for m in range(n):
        i = n - 1 - m
        value = step[i]
        for k in range(i + 1, n):
            value -= L[k, i] * step[k]
        step[i] = value / L[i, i]
    return True
