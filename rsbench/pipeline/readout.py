"""The readout ratio of a rolling shutter from its own matches: one-dimensional search on the refined cost.

For every candidate ratio the motion is fitted by maximum likelihood; what is left of the squared errors is a
function of the ratio alone, whose minimum is the estimate and whose curvature gives its standard deviation.
The search also tries the ratio's negative, which is what frames in reversed order, or rows read from the bottom,
look like: both turn time around.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.engine.optimise import levenberg_marquardt
from rsbench.solvers.engine.packed import Packed, pack
from rsbench.solvers.refined import RefinedSolver

COARSE = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Ratios at which outliers are sorted out; between two of them the error of a match stays within its noise."""
_REACH = 0.3
_STEP = 0.02
_ITERATIONS = 30
_FREEDOM = 7
_LEAST_NOISE_PX = 0.02
_CLEARLY = 25.0


@dataclass(frozen=True, kw_only=True)
class ReadoutEstimate:
    """A readout ratio and how well the matches determine it."""

    readout_ratio: float
    """In [0, 1]."""
    sigma: float
    """Its standard deviation; inf when the matches say nothing about it."""
    matches: int
    """Pairs and tracks without outliers that it rests on."""

    def __str__(self) -> str:
        return f"{self.readout_ratio:.3f} +- {self.sigma:.3f}"


def estimate_readout_ratio(
    correspondences: Correspondences,
    rig: StereoRig,
    solver: RefinedSolver,
    options: RobustOptions,
    seed: int = 0,
) -> ReadoutEstimate | None:
    """Readout ratio of matches with outliers; None when no motion explains them at any ratio.

    ``sigma`` counts the noise that the residuals show; it says nothing about a wrong motion model.
    """
    height = rig.camera.height

    def robust(ratio: float) -> RobustEstimate:
        shutter = RollingShutter(height=height, readout_ratio=ratio)
        # A proposal far off may put a point next to a camera's plane, where its error overflows: an outlier.
        with np.errstate(invalid="ignore", over="ignore"):
            return estimate_motion(correspondences, rig, shutter, solver, options, np.random.default_rng(seed))

    tried = {ratio: robust(ratio) for ratio in COARSE}
    found = {ratio: result for ratio, result in tried.items() if result.estimate.success}
    if not found:
        return None
    ratio = min(found, key=lambda r: truncated_cost(correspondences, rig, r, solver, options, found[r]))
    profile = _Profile(correspondences, rig, solver, found[ratio])
    ratio = profile.minimum(ratio)
    again = robust(ratio)
    if again.estimate.success:  # outliers sorted out at nearly the right ratio
        profile = _Profile(correspondences, rig, solver, again)
        ratio = profile.minimum(ratio)
    return ReadoutEstimate(readout_ratio=ratio, sigma=profile.sigma(ratio), matches=profile.matches)


class _Profile:
    """Half the squared errors of the inliers as a function of the readout ratio, the motion fitted to each."""

    def __init__(
        self, correspondences: Correspondences, rig: StereoRig, solver: RefinedSolver, result: RobustEstimate
    ) -> None:
        self.inliers = select(correspondences, result)
        self.rig, self.solver = rig, solver
        self.start = np.concatenate([result.estimate.w, result.estimate.d])
        self.matches = len(self._packed(0.5).pairs) + len(self._packed(0.5).tracks)

    def _packed(self, ratio: float) -> Packed:
        shutter = RollingShutter(height=self.rig.camera.height, readout_ratio=ratio)
        return _measurements(self.inliers, self.rig, shutter, self.solver)

    def __call__(self, ratio: float) -> float:
        packed = self._packed(float(ratio))
        theta = packed.theta(self.start[:3], self.start[3:])
        fitted = levenberg_marquardt(packed.normal_equations, theta, _ITERATIONS, self.solver.max_translation_m)
        return fitted.cost

    def minimum(self, ratio: float) -> float:
        """The ratio of the smallest cost near ``ratio``."""
        bounds = (max(ratio - _REACH, 0.0), min(ratio + _REACH, 1.0))
        return float(minimize_scalar(self, bounds=bounds, method="bounded", options={"xatol": 1e-5}).x)

    def sigma(self, ratio: float) -> float:
        """Standard deviation by the curvature of the profile, with the noise that the residuals show."""
        middle = min(max(ratio, _STEP), 1.0 - _STEP)
        below, at, above = (self(middle + step) for step in (-_STEP, 0.0, _STEP))
        curvature = (below - 2.0 * at + above) / _STEP**2
        freedom = self._packed(middle).constraints - _FREEDOM
        if freedom <= 0 or curvature <= 0.0:
            return float("inf")
        return float(np.sqrt(2.0 * at / freedom / curvature))


def select(correspondences: Correspondences, result: RobustEstimate) -> Correspondences:
    """The temporal matches and tracks that a robust estimate kept."""
    return Correspondences(
        left=correspondences.left[result.inliers["left"]],
        right=correspondences.right[result.inliers["right"]],
        tracks=correspondences.tracks[result.inliers["tracks"]],
    )


def truncated_cost(
    correspondences: Correspondences,
    rig: StereoRig,
    ratio: float,
    solver: RefinedSolver,
    options: RobustOptions,
    result: RobustEstimate,
) -> float:
    """Sum over all matches of the squared error, px^2, cut off at the inlier threshold; inf after a failure."""
    if not result.estimate.success:
        return float("inf")
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=ratio)
    packed = _measurements(correspondences, rig, shutter, solver)
    theta = packed.theta(result.estimate.w, result.estimate.d)
    limit = options.threshold_px**2
    pairs = np.minimum(packed.pair_residuals(theta) ** 2, limit)
    # A track has five residuals where a pair has one.
    tracks = np.minimum(packed.track_squares(theta), 5.0 * limit)
    return float(np.sum(pairs) + np.sum(tracks))


def reversed_in_time(correspondences: Correspondences) -> Correspondences:
    """The matches with frame 0 and frame 1 exchanged."""
    return Correspondences(
        left=_swapped(correspondences.left),
        right=_swapped(correspondences.right),
        stereo_0=correspondences.stereo_1,
        stereo_1=correspondences.stereo_0,
        tracks=_swapped(correspondences.tracks),
    )


def _swapped(matches: FloatArray) -> FloatArray:
    half = matches.shape[1] // 2
    return np.concatenate([matches[:, half:], matches[:, :half]], axis=1)


def runs_backwards(
    correspondences: Correspondences,
    rig: StereoRig,
    ratio: float,
    backward_ratio: float,
    solver: RefinedSolver,
    options: RobustOptions,
    forward: RobustEstimate,
    seed: int = 0,
) -> bool:
    """Whether the frames in the opposite order, at ``backward_ratio``, fit clearly better than ``forward``.

    Clearly: a likelihood ratio of 5 standard deviations.
    """
    turned = reversed_in_time(correspondences)
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=backward_ratio)
    backward = estimate_motion(turned, rig, shutter, solver, options, np.random.default_rng(seed))
    if not backward.estimate.success:
        return False
    as_given = truncated_cost(correspondences, rig, ratio, solver, options, forward)
    in_reverse = truncated_cost(turned, rig, backward_ratio, solver, options, backward)
    variance = max(backward.estimate.noise_px or 0.0, _LEAST_NOISE_PX) ** 2
    return as_given - in_reverse > _CLEARLY * variance


def _measurements(
    correspondences: Correspondences, rig: StereoRig, shutter: RollingShutter, solver: RefinedSolver
) -> Packed:
    """All matches, of few tracks too, under the solver's motion model."""
    model, parameters = solver.motion_model, solver.motion_parameters
    return pack(correspondences, rig, shutter, model, solver.use_tracks, motion_parameters=parameters)
