"""The readout ratio of a rolling shutter from its own matches: search on the refined cost.

For every candidate ratio the motion is fitted by maximum likelihood; what is left of the squared errors is a
function of the ratio alone, whose minimum is the estimate. The search includes negative ratios: what frames in
reversed order, or rows read from the bottom, look like, for both turn time around.

A constant error of the disparity, as real calibrations have, looks like a readout ratio. It is fitted with the
ratio; how large it may be the row differences of the left-right matches tell, which come from the same
calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsbench.capture.readout_profile import (
    LEAST_NOISE_PX,
    Profile,
    in_order,
    measurements,
    ordered,
    reversed_in_time,
)
from rsbench.capture.rectification import row_pattern, without_offset
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

COARSE = (-1.0, -0.5, 0.0, 0.25, 0.5, 0.75, 1.0)
"""Ratios at which outliers are sorted out; between two of them the error of a match stays within its noise."""
_CLEARLY = 5.0
_EVIDENCE = 0.75
"""Squared errors in the opposite order over those in the given one, below which they count: at least 0.83 in real
frames in order, whose calibration errors may prefer either a little; at most 0.7 in rendered ones in reverse."""
LEAST_BACKWARDS = 0.25
"""Readout ratio from which on the order of the frames can be told: smaller ones are within the errors of rigs."""
_PRIOR_FACTOR = 2.0
"""Standard deviation of the disparity offset over the size of the row differences: rows show errors of roll and
pitch, and the error of yaw, which shifts disparities, is of their kind."""
_LEAST_PRIOR_PX = 0.1
"""Below this the rows agree so well that there is no offset to fit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadoutEstimate:
    """A readout ratio and the offset of the disparities, and how well the matches determine them."""

    signed_ratio: float
    """In [-1, 1]; below 0, by more than its uncertainty, time runs backwards in the frames."""
    disparity_offset: float = 0.0
    """Disparity as matched minus the true one, px."""
    covariance: FloatArray
    """(2, 2) of both; infinite where the matches say nothing of the ratio, 0 for an offset that is not fitted."""
    matches: int
    """Pairs and tracks without outliers that it rests on."""
    windows: int = 1
    """Pairs of times that it rests on."""

    @property
    def readout_ratio(self) -> float:
        """In [0, 1]: the nearest that a shutter can have."""
        return max(self.signed_ratio, 0.0)

    @property
    def sigma(self) -> float:
        """Standard deviation of the ratio."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of the offset, px."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def backwards(self) -> bool:
        """Whether the ratio is negative by far more than its uncertainty and the errors of real calibrations."""
        return self.signed_ratio < -max(LEAST_BACKWARDS, _CLEARLY * self.sigma)

    def __str__(self) -> str:
        return f"{self.signed_ratio:.3f} +- {self.sigma:.3f}"


def estimate_readout_ratio(
    correspondences: Correspondences,
    rig: StereoRig,
    solver: RefinedSolver,
    options: RobustOptions,
    seed: int = 0,
    disparity_offset: float | None = None,
) -> ReadoutEstimate | None:
    """Readout ratio of matches with outliers; None when no motion explains them at any ratio.

    ``covariance`` counts the noise that the residuals show, and that matches of one part of the image err
    together; it says nothing about a wrong motion model.

    Args:
        disparity_offset: known, px; None has it fitted.
    """
    prior = 0.0
    if disparity_offset is None:
        pattern = row_pattern(_stereo(correspondences), rig)
        prior = 0.0 if pattern is None else _PRIOR_FACTOR * pattern.systematic_px
    search = _Search(
        matches=correspondences,
        rig=rig,
        solver=solver,
        options=options,
        seed=seed,
        prior=prior if prior > _LEAST_PRIOR_PX else 0.0,
    )
    found = search.from_coarse(disparity_offset or 0.0)
    if found is not None and search.prior > 0.0:
        # The best of the coarse ratios may have been the best for a wrong offset.
        found = search.from_coarse(found[1])
    profile = None if found is None else search.profile(*found)
    if found is None or profile is None:
        return None
    ratio, offset = profile.minimum(*found)  # outliers sorted out at nearly the right ratio
    return ReadoutEstimate(
        signed_ratio=ratio,
        disparity_offset=offset,
        covariance=profile.covariance(ratio, offset),
        matches=profile.matches,
    )


def combined(estimates: Sequence[ReadoutEstimate]) -> ReadoutEstimate:
    """One shutter and one offset from those of several windows, at least one.

    The mean weighted by what each window knows. Its covariance counts the scatter of the windows about it, when
    that is larger than the windows say themselves, and not as if it were independent: they share the calibration.
    """
    weights = np.array([np.linalg.pinv(estimate.covariance) for estimate in estimates])
    values = np.array([[estimate.signed_ratio, estimate.disparity_offset] for estimate in estimates])
    covariance = np.linalg.pinv(np.sum(weights, axis=0))
    mean = covariance @ np.einsum("nij,nj->i", weights, values)
    scores = np.einsum("nij,nj->ni", weights, values - mean)
    scatter = covariance @ (scores.T @ scores) @ covariance * len(estimates)
    return ReadoutEstimate(
        signed_ratio=float(np.clip(mean[0], -1.0, 1.0)),
        disparity_offset=float(mean[1] if covariance[1, 1] > 0.0 else values[0, 1]),
        covariance=scatter if scatter[0, 0] > covariance[0, 0] else covariance,
        matches=sum(estimate.matches for estimate in estimates),
        windows=len(estimates),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """The robust motion of matches at any signed ratio and offset."""

    matches: Correspondences
    rig: StereoRig
    solver: RefinedSolver
    options: RobustOptions
    seed: int
    prior: float
    """Standard deviation of the offset, px; 0 leaves it where it is."""

    def from_coarse(self, offset: float) -> tuple[float, float] | None:
        """Ratio and offset of the smallest cost near the ratio of ``COARSE`` that explains the matches best."""
        tried = {ratio: self._robust(ratio, offset) for ratio in COARSE}
        found = {ratio: result for ratio, result in tried.items() if result[0].estimate.success}
        if not found:
            return None
        # One limit for all, that of the best fit: near outliers would outweigh what the ratio changes.
        threshold = min(result.threshold_px for result, _ in found.values())
        losses = {
            ratio: truncated_losses(matches, self.rig, abs(ratio), self.solver, threshold, result)
            for ratio, (result, matches) in found.items()
        }
        best, backward = (_least(losses, backward) for backward in (False, True))
        if best is None or (backward is not None and fits_far_better(losses[backward], losses[best])):
            best = backward
        assert best is not None
        profile = self.profile(best, offset)
        return None if profile is None else profile.minimum(best, offset)

    def _robust(self, ratio: float, offset: float) -> tuple[RobustEstimate, Correspondences]:
        """The estimate, and the matches in the order of time that it is of."""
        matches = ordered(without_offset(self.matches, offset), ratio)
        shutter = RollingShutter(height=self.rig.camera.height, readout_ratio=abs(ratio))
        rng = np.random.default_rng(self.seed)
        # A proposal far off may put a point next to a camera's plane, where its error overflows: an outlier.
        with np.errstate(invalid="ignore", over="ignore"):
            return estimate_motion(matches, self.rig, shutter, self.solver, self.options, rng), matches

    def profile(self, ratio: float, offset: float) -> Profile | None:
        """The cost of the matches that a motion explains at this ratio; None when there is none."""
        result, _ = self._robust(ratio, offset)
        if not result.estimate.success:
            return None
        motion = in_order(result.estimate.w, result.estimate.d, ratio)
        variance = max(result.estimate.noise_px or 0.0, LEAST_NOISE_PX) ** 2
        weight = variance / self.prior**2 if self.prior > 0.0 else np.inf
        return Profile(select(self.matches, result), self.rig, self.solver, motion, weight)


def _stereo(correspondences: Correspondences) -> FloatArray:
    """The left-right matches (n, 4) of both times; those of the tracks where there are no others."""
    pairs = np.concatenate([correspondences.stereo_0, correspondences.stereo_1])
    tracks = correspondences.tracks
    return pairs if len(pairs) else np.concatenate([tracks[:, :4], tracks[:, 4:]])


def _least(losses: dict[float, FloatArray], backward: bool) -> float | None:
    """The ratio of the smallest sum of losses, among the negative ones or the others; None when there are none."""
    ratios = [ratio for ratio in losses if (ratio < 0.0) == backward]
    return min(ratios, key=lambda ratio: float(np.sum(losses[ratio])), default=None)


def select(correspondences: Correspondences, result: RobustEstimate) -> Correspondences:
    """The temporal matches and tracks that a robust estimate kept."""
    return Correspondences(
        left=correspondences.left[result.inliers["left"]],
        right=correspondences.right[result.inliers["right"]],
        tracks=correspondences.tracks[result.inliers["tracks"]],
    )


def truncated_losses(
    correspondences: Correspondences,
    rig: StereoRig,
    ratio: float,
    solver: RefinedSolver,
    threshold_px: float,
    result: RobustEstimate,
) -> FloatArray:
    """Squared errors (n,) of all matches, px^2, cut off where an outlier begins, pairs before tracks."""
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=ratio)
    packed = measurements(correspondences, rig, shutter, solver)
    theta = packed.theta(result.estimate.w, result.estimate.d)
    limit = threshold_px**2
    # A track has five residuals where a pair has one.
    pairs = np.minimum(packed.pair_residuals(theta) ** 2, limit)
    return np.concatenate([pairs, np.minimum(packed.track_squares(theta), 5.0 * limit)])


def fits_far_better(losses: FloatArray, others: FloatArray) -> bool:
    """Whether truncated losses (n,) are far below others of the same matches; outliers of both say nothing."""
    told = losses != others
    return float(np.sum(losses[told])) < _EVIDENCE * float(np.sum(others[told]))


def runs_backwards(
    correspondences: Correspondences,
    rig: StereoRig,
    ratio: float,
    solver: RefinedSolver,
    options: RobustOptions,
    forward: RobustEstimate,
    seed: int = 0,
) -> bool:
    """Whether the frames in the opposite order fit far better than ``forward``, both at a readout ratio.

    That alone is no proof: at a wrong ratio either order may fit better.
    """
    turned = reversed_in_time(correspondences)
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=ratio)
    backward = estimate_motion(turned, rig, shutter, solver, options, np.random.default_rng(seed))
    if not backward.estimate.success:
        return False
    threshold = min(forward.threshold_px, backward.threshold_px)
    as_given = truncated_losses(correspondences, rig, ratio, solver, threshold, forward)
    return fits_far_better(truncated_losses(turned, rig, ratio, solver, threshold, backward), as_given)
