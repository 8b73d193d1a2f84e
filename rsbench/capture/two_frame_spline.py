"""A spline in place of a motion model: for two frames of a rig, and for two or more frames of one camera.

A hand-held camera that shakes follows no model of six or seven parameters. For two frames of a rig, a spline is
preferred if it increases the likelihood by more than the penalty for its parameters (G. Schwarz, Estimating the
dimension of a model, Annals of Statistics 1978), of which only those that the matches determine count. For one
camera, the scale is unknown: the length of its translation stays near that at the start of the fit, and the prior,
whose variance is estimated, adapts to it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from rsbench.capture.hypotheses import LEAST_SCALE_PX
from rsbench.capture.trajectory_estimate import Trajectory, TrajectoryOptions, estimate_trajectory
from rsbench.capture.trajectory_fit import (
    ANCHORED,
    Fit,
    anchored,
    covariance_band,
    expected_equations,
    first_curve,
    first_curve_of_camera,
    fit,
    normal_equations,
    right_tracks,
    squared_errors,
)
from rsbench.capture.trajectory_spline import (
    NO_PRIOR,
    ContinuousMotion,
    Curve,
    NotDefiniteError,
    Prior,
    approximated,
    band_factor,
    band_form,
    band_inner,
    band_inverse,
    band_log_determinant,
    band_solve,
    covariance_between,
    log_prior,
    motion_covariance,
    motion_from,
    moved,
    part,
    roughness,
    span_of,
)
from rsbench.capture.trajectory_tracks import (
    REACH,
    Tails,
    TimedTracks,
    informative,
    noise_by_tile,
    pack_windows,
    thinned,
    thinned_chains,
)
from rsbench.components.motion_models import has_kernel, make_motion
from rsbench.core import so3
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import small_sample_factor, spread_about, tempered
from rsbench.solvers.engine.packed import HeavyTailed, each_term, heavy_tailed, pack

_MODEL_PARAMETERS = 6.0
"""Fewest parameters of a motion model."""
_FEWEST = 30
"""Fewest tracks, or matches of one camera, for a spline through two frames."""
_KNOTS = 0.25
"""Frame periods between control poses."""
_DEPTHS = 3.0
"""Depth is observed if the median disparity exceeds this many of its standard deviations."""
_APART = 6.0
"""Two splines are the same if the sum of squared normalised differences of the six parameters is below this."""
_MEDIAN = 0.87
"""Median of chi-squared with five degrees of freedom, divided by five."""
_SHARE, _SHARE_OF_VIDEO = 0.15, 0.5
"""Weight of a track relative to the prior, and in the covariance, for two frames and for more. Two frames hardly
determine rotations that are the same during both readouts: with a larger weight, correlated errors of a tenth of a
pixel rotated the spline by degrees."""
_PRIOR = Prior(memory=0.25, smooth=1, rotation=1e-4, position=1e-2)
"""Start value of the prior for one camera, whose variances are estimated."""
_LEAST_GAIN = 0.3
"""Least mean gain in log-likelihood per match for which a spline of one camera replaces a motion model. As errors
of dense flow are correlated, many matches count as one; rendered motions of constant speed gave at most 0.1."""
_MOST_UNDETERMINED_PX = 0.15
"""Largest standard deviation, px, of the image of a distant point, root mean square over the rows: above it, two
frames do not determine the shake of the camera."""
_SHAKES, _NO_SHAKE = tuple(np.geomspace(1e-3, 0.3, 5).tolist()), 1e-5
"""Standard deviations of accelerations, rad and m per frame period^2, of equally probable departures: from
those that move an image by half a pixel to those that rows always show; and of no departure."""
_MEMORIES = (0.25, 1.0)
"""Their memories, equally probable."""
_ROWS = 24
_FIRST_MATCHES, _FIRST_CHAINED = 150, 80
"""Approximate number of matches, of two frames and per window of more, from which the prior is estimated and the
inliers are chosen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoFrameSpline:
    """The spline of two frames of a rig."""

    motion: ContinuousMotion
    """Motion of the body, metres."""
    covariance: FloatArray | None
    """(6, 6) covariance of its w and d; None if the matches do not determine it."""
    noise_px: float
    inliers: BoolArray
    """(n,) which tracks are inliers."""
    probability: float
    """Probability of the spline compared with the motion model."""
    unique: bool
    """Whether fits from other starts give the same spline or explain the matches less well."""


def two_frame_spline(
    matches: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion, seed: int = 0
) -> TwoFrameSpline | None:
    """Fit a spline to two frames if the residuals of a motion model require one.

    None if there are few tracks, no fit, no observed depth, or no dependence of the residuals on the readout time.
    The fit starts at the motion model and, since that may be far off, at rest. If the scene is a plane, several
    splines explain the matches, and their distance is included in the covariance.

    Args:
        law: the motion of the body of largest likelihood under a model.
    """
    window = informative(matches)
    if shutter.still or len(window.tracks) < _FEWEST or not _needs_spline(window, rig, shutter, law):
        return None
    starts = [law, make_motion("linear", np.zeros(3), np.zeros(3))]
    splines = [_Spline.through(window, rig, shutter, start, seed) for start in starts]
    fitted = [each for each in splines if each is not None]
    if not fitted:
        return None
    tails = min((each.found.fit.tails for each in fitted), key=lambda each: each.scale)
    everything = np.ones(len(fitted[0].tracks))
    scores = np.array([each.score(each.found.curve, each.determined, tails, everything) for each in fitted])
    spline = fitted[int(np.argmax(scores))]
    odds = tempered(np.exp(scores - scores.max()), 1.0 / _SHARE)
    motions = np.stack([np.concatenate([each.found.motion.w, each.found.motion.d]) for each in fitted])
    found, errors = spline.found, (spline.found.fit.tails, spline.found.fit.trust)
    theirs = approximated(law.body_from_world, span_of(1, shutter), _KNOTS)
    gain = spline.score(found.curve, spline.determined, *errors) - spline.score(theirs, _MODEL_PARAMETERS, *errors)
    # Small samples: the prior's variance is estimated from the accelerations that the matches determine.
    factor = small_sample_factor(max(spline.determined - _MODEL_PARAMETERS, 0.0), int(_MODEL_PARAMETERS))
    covariance = motion_covariance(found.curve, covariance_band(found.fit, spline.tracks, _SHARE), 0.0)
    if covariance is not None:
        covariance = factor * covariance + _shared_error_covariance(window, rig, shutter, law)
    apart = spread_about(motions[int(np.argmax(scores))], odds, motions)
    unique = covariance is not None and float(np.trace(np.linalg.solve(covariance, apart))) < _APART
    return TwoFrameSpline(
        motion=found.motion,
        covariance=None if covariance is None else covariance + apart,
        noise_px=found.noise_px,
        inliers=found.inliers[0],
        probability=float(scipy.special.expit(gain)),
        unique=unique,
    )


class Departure(NamedTuple):
    """By how much a motion may depart from the motion model under which it was estimated."""

    scatter: float = 1.0
    """Variance of the motions that fit groups of rows best over that of errors common to a tile, which include the
    shifts that ``core.uncertainty`` assumes, at least 1."""
    covariance: FloatArray | float = 0.0
    """(6, 6) covariance of w and d due to shakes."""

    def of(self, covariance: FloatArray) -> FloatArray:
        """The covariance (6, 6) of w and d from that under the model."""
        return self.scatter * covariance + self.covariance


def departure(matches: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion) -> Departure:
    """By how much the motion of a rig may depart from a motion model, which the matches need not show.

    It departs by a spline with the prior of ``trajectory_spline``, of unknown variances and memory (``_SHAKES``,
    ``_MEMORIES``), or, with the same probability, not at all. One step from the model leads to the mean and
    covariance of w and d under each departure, and to its evidence (Laplace's approximation, with the likelihood
    where the step ends: two frames hardly determine rotations that are the same during both readouts, so steps may
    lead far off). The result is the covariance of their mixture about the model's motion, beyond that without a
    departure. Fewer than 30 tracks and pairs show nothing.

    Args:
        law: see ``two_frame_spline``.
    """
    window = informative(matches)
    tailed = None if shutter.still else _under_law(window, rig, shutter, law)
    theta = None if tailed is None else tailed.theta(law.w, law.d)
    if tailed is None or theta is None:
        return Departure()
    stated, rows = tailed.stated(theta), tailed.by_rows(theta)
    shared, by_shifts = (1.0, 1.0) if stated is None else (stated.shared, stated.by_shifts)
    scatter = 1.0 if rows is None else max(1.0, rows.square / rows.freedom / (shared * by_shifts))
    tracks = pack_windows([window], rig, shutter, share=1.0 / shared)
    curve, tails = approximated(law.body_from_world, span_of(1, shutter), _KNOTS), Tails(tailed.nu, tailed.scale)
    reach = tracks.freedom * (REACH * tails.scale) ** 2
    trust = (squared_errors(curve, tracks) <= reach).astype(np.float64)
    try:
        parts = [_departures(curve, tracks, tails, trust, memory) for memory in _MEMORIES]
    except NotDefiniteError:
        return Departure(scatter)
    logs, ends, covariances = (np.concatenate(each) for each in zip(*parts, strict=True))
    probability = scipy.special.expit(scipy.special.logsumexp(logs) - np.log(len(logs)))
    weights = probability * scipy.special.softmax(logs)
    return Departure(scatter, np.tensordot(weights, covariances, 1) + spread_about(np.zeros(6), weights, ends))


def _departures(
    curve: Curve, tracks: TimedTracks, tails: Tails, trust: FloatArray, memory: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """For n departures from a spline: the logarithm of the evidence of each over that of none, (n,), and by how
    much it moves w and d, (n, 6), and adds to their covariance, (n, 6, 6).

    Raises:
        NotDefiniteError: the tracks do not determine the spline.
    """
    slope = normal_equations(curve, tracks, tails, NO_PRIOR, trust).gradient
    data = expected_equations(curve, tracks, tails, NO_PRIOR, trust)
    rough, fixed = roughness(curve, memory, 1, data.band.shape[1]), anchored(data, curve, tracks, ANCHORED)
    logs, ends, covariances = list[float](), list[FloatArray](), list[FloatArray]()
    for rotation, position in [(_NO_SHAKE, _NO_SHAKE), *itertools.product(_SHAKES, _SHAKES)]:
        prior = Prior(memory, 1, rotation**2, position**2)
        tied = rough.bands[0] / prior.rotation + rough.bands[1] / prior.position
        lower = band_factor(fixed + tied)
        step = -band_solve(lower, slope)
        there = moved(curve, step)
        cost = normal_equations(there, tracks, tails, NO_PRIOR, trust, want=False).cost
        cost += 0.5 * (band_form(tied, step) + band_log_determinant(lower))
        logs.append(log_prior(curve, prior, rough) - cost)
        R, t = motion_from(there, 0.0)
        ends.append(np.concatenate([so3.log(R), t]))
        covariance = motion_covariance(curve, band_inverse(lower), 0.0)
        if covariance is None:
            raise NotDefiniteError("the band is too narrow")
        covariances.append(covariance)
    own = np.array(logs), np.array(ends), np.array(covariances)
    return tuple(each[1:] - each[0] for each in own)


def _needs_spline(window: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion) -> bool:
    """Whether depth is observed, and the rows contradict the motion model."""
    tailed = _under_law(window, rig, shutter, law)
    rows = None if tailed is None else tailed.by_rows(tailed.theta(law.w, law.d))
    if tailed is None or rows is None or not rows.contradict:
        return False
    ends = tailed.tracks
    disparities = rig.camera.fx * (ends[:, 0, 0] - ends[:, 1, 0]) if ends.ndim == 3 else ends[:, 2]
    return float(np.median(disparities)) >= _DEPTHS * tailed.scale * np.sqrt(2.0)


def _under_law(
    window: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion
) -> HeavyTailed | None:
    """The tracks with the distribution of their errors, and the pairs if there are few tracks; None if there are
    few of both or the model has no kernel."""
    if not has_kernel(law.name):
        return None
    matches = Correspondences(tracks=window.tracks) if len(window.tracks) >= _FEWEST else window
    packed = pack(matches, rig, shutter, law.name, motion_parameters=law.parameters)
    if len(packed.freedom) < _FEWEST:
        return None
    theta = packed.theta(law.w, law.d)
    squares = each_term(packed, theta).squares / packed.freedom
    return heavy_tailed(packed, theta, max(float(np.sqrt(np.median(squares) / _MEDIAN)), LEAST_SCALE_PX))


def _shared_error_covariance(
    window: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion
) -> FloatArray:
    """(6, 6) covariance of w and d due to errors common to all matches of a region, by a motion model nearby."""
    tailed = _under_law(window, rig, shutter, law)
    theta = None if tailed is None else tailed.theta(law.w, law.d)
    stated = None if tailed is None or theta is None else tailed.stated(theta)
    if tailed is None or theta is None or stated is None:
        return np.zeros((6, 6))
    J = tailed.motion_jacobian(theta)
    return np.asarray(J @ stated.shifted @ J.T)


def log_odds_of_opposite(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    opposite: RollingShutter,
    motion: Motion,
    seed: int = 0,
) -> float:
    """Log-odds that lines are read from the opposite side, or frames are in the wrong order, if the rig may shake.

    Minus infinity if either spline has no fit.

    Args:
        opposite: the shutter with the opposite scan.
        motion: start of both fits.
    """
    window = informative(matches)
    given, other = (_Spline.through(window, rig, each, motion, seed) for each in (shutter, opposite))
    if given is None or other is None:
        return -np.inf
    tails = min((each.found.fit.tails for each in (given, other)), key=lambda each: each.scale)
    everything = np.ones(len(given.tracks))
    here, there = (each.score(each.found.curve, each.determined, tails, everything) for each in (given, other))
    return there - here


@dataclass(frozen=True, kw_only=True, eq=False)
class _Spline:
    """A fitted spline and its tracks."""

    found: Trajectory
    tracks: TimedTracks

    @classmethod
    def through(
        cls, window: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion, seed: int
    ) -> _Spline | None:
        options = TrajectoryOptions(intervals=(_KNOTS,), link=False, share=_SHARE, seed=seed)
        try:
            found = estimate_trajectory([window], rig, shutter, [law], options)
        except (NotDefiniteError, ValueError):
            return None
        return cls(found=found, tracks=pack_windows([window], rig, shutter, share=TrajectoryOptions.share))

    def score(self, curve: Curve, parameters: float, tails: Tails, trust: FloatArray) -> float:
        """Log-likelihood of a spline minus half of log n per parameter, up to a constant (Schwarz's criterion)."""
        found = normal_equations(curve, self.tracks, tails, NO_PRIOR, trust, want=False)
        return -found.cost - 0.5 * parameters * float(np.log(len(self.tracks)))

    @property
    def determined(self) -> float:
        """Number of parameters that the matches determine, not the prior (see ``trajectory_fit``)."""
        bands, prior = self.found.fit.equations.rough.bands, self.found.prior
        pairs = zip(bands, (prior.rotation, prior.position), strict=True)
        tied = [band_inner(self.found.covariance_band, band) / strength for band, strength in pairs]
        return 6.0 * (len(self.found.curve.p) - 1) - float(np.sum(tied))


# One camera


def camera_trajectory(
    windows: Sequence[FloatArray],
    motions: Sequence[Motion],
    rig: StereoRig,
    shutter: RollingShutter,
    times: FloatArray | None = None,
) -> list[ContinuousMotion] | None:
    """Estimate the motion in each window relative to the camera at its start, with d of length 1; None: no fit.

    The unit of time of each motion is the time between the window's frames.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, with outliers, of the frames 0 and 1, 1 and 2, ...; matches
            that share a pixel in a frame are joined to one track.
        motions: start motion of each window, with d of any length.
        rig: a rig whose left camera is the camera and whose body is at this camera.
        shutter: shutter of the camera.
        times: (n + 1,) times of the frames' first lines, frame periods; None: one period apart.
    """
    times = np.arange(len(windows) + 1.0) if times is None else times
    try:
        curve = _fitted(windows, motions, rig, shutter, _SHARE_OF_VIDEO, times)[0].curve
    except NotDefiniteError:
        return None
    found = [_window(curve, *ends, shutter) for ends in itertools.pairwise(times.tolist())]
    moving = [each for each in found if each is not None]
    return moving if len(moving) == len(windows) else None


def camera_two_frame_spline(
    matches: FloatArray, law: Motion, rig: StereoRig, shutter: RollingShutter
) -> ContinuousMotion | None:
    """``camera_trajectory`` for two frames; None if a motion model fits as well, or the shake is undetermined.

    Args:
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        law: the motion under the best motion model.
        rig, shutter: see ``camera_trajectory``.
    """
    if shutter.still or len(matches) < _FEWEST:
        return None
    try:
        found, tracks = _fitted([matches], [law], rig, shutter, _SHARE, np.arange(2.0))
        inverse = covariance_band(found, tracks, _SHARE)
    except NotDefiniteError:
        return None
    theirs, each = approximated(law.body_from_world, span_of(1, shutter), _KNOTS), replace(tracks, share=1.0)
    own, other = (
        normal_equations(curve, each, found.tails, NO_PRIOR, found.trust, want=False).cost
        for curve in (found.curve, theirs)
    )
    gained = (other - own) / max(float(np.sum(found.trust)), 1.0)
    if gained < _LEAST_GAIN or _undetermined_px(found.curve, inverse, rig, shutter) > _MOST_UNDETERMINED_PX:
        return None
    return _window(found.curve, 0.0, 1.0, shutter)


def _undetermined_px(curve: Curve, inverse: FloatArray, rig: StereoRig, shutter: RollingShutter) -> float:
    """Standard deviation, px, of a distant point corrected to frame 1's middle row, rms over rows."""
    lines = np.linspace(0.0, shutter.height - 1.0, _ROWS)
    middle = float(shutter.time_after((shutter.height - 1) / 2, 1, "left"))
    taus = shutter.pixel_time(np.stack([np.zeros(_ROWS), lines], axis=-1), 1, "left")
    turns = covariance_between(curve, inverse, middle, taus)
    return rig.camera.fx * float(np.sqrt(np.mean(turns[:, 0, 0] + turns[:, 1, 1])))


def _fitted(
    windows: Sequence[FloatArray],
    motions: Sequence[Motion],
    rig: StereoRig,
    shutter: RollingShutter,
    share: float,
    times: FloatArray,
) -> tuple[Fit, TimedTracks]:
    """Fit the spline to the inliers, after a first fit to some of the matches that selects them."""

    def packed(each: Sequence[FloatArray], right: Sequence[FloatArray] | None = None) -> TimedTracks:
        matches = [Correspondences(left=one) for one in each]
        return pack_windows(matches, rig, shutter, right, share=share, times=times)

    matches, span = [Correspondences(left=each) for each in windows], span_of(float(times[-1]), shutter)
    if len(windows) > 1:
        some = [each.left for each in thinned_chains(matches, _FIRST_CHAINED)]
        few = packed(some, [np.ones(len(each)) for each in some])
        start = first_curve_of_camera(motions, few, span, _KNOTS, _PRIOR, times)
    else:
        few = packed([each.left for each in thinned(matches, _FIRST_MATCHES)])
        start = first_curve(motions, few, span, _KNOTS, times)
    first = fit(start, few, _PRIOR)
    tracks = packed(windows)
    trust = right_tracks(first, tracks)
    tracks = packed(windows, [trust[each] for each in tracks.members])
    if len(windows) > 1:
        tracks = tracks.with_noise(noise_by_tile(tracks, squared_errors(first.curve, tracks)))
    return fit(first.curve, tracks, first.prior, False, first.tails), tracks


def _window(curve: Curve, begin: float, end: float, shutter: RollingShutter) -> ContinuousMotion | None:
    """The motion in the window of frames at two times, with its length as unit and d of length 1; None: d is 0."""
    first, last = span_of(end - begin, shutter)
    own = part(curve, begin + first, begin + last, begin)
    own = own._replace(first=own.first / (end - begin), interval=own.interval / (end - begin))
    motion = ContinuousMotion.of(own)
    length = float(np.linalg.norm(motion.d))
    return motion.seen(np.eye(3), 1.0 / length) if length > 0.0 else None
