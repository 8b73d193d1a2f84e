"""A spline in place of a motion model: for two frames of a rig, and for two or more frames of one camera.

A hand that shakes follows no model of six or seven parameters. For a rig, the spline through two frames is
preferred where it raises the likelihood by more than its parameters are worth (G. Schwarz, Estimating the
dimension of a model, Annals of Statistics 1978); only parameters that the matches determine count. One camera
shows no length: that of its translation stays near where the search begins, and the prior, whose strength is
estimated, does not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from rsbench.capture.hypotheses import LEAST_SCALE_PX
from rsbench.capture.trajectory_estimate import Trajectory, TrajectoryOptions, estimate_trajectory
from rsbench.capture.trajectory_fit import Fit, covariance_band, first_curve, fit, normal_equations, right_tracks
from rsbench.capture.trajectory_spline import (
    NO_PRIOR,
    ContinuousMotion,
    Curve,
    NotDefiniteError,
    Prior,
    approximated,
    band_inner,
    covariance_between,
    motion_covariance,
    part,
    span_of,
)
from rsbench.capture.trajectory_tracks import Tails, TimedTracks, informative, pack_windows
from rsbench.components.motion_models import has_kernel, make_motion
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import small_sample_factor, spread_about, tempered
from rsbench.solvers.engine.packed import HeavyTailed, each_term, heavy_tailed, pack

_OF_A_MODEL = 6.0
"""Parameters of a motion model, at least."""
_FEWEST = 30
"""Tracks, or matches of one camera, from which on a spline is fitted to two frames."""
_KNOTS = 0.25
"""Frame periods between control poses."""
_DEPTHS = 3.0
"""Deviations of a disparity by which depth is observed: half of the disparities must be larger."""
_APART = 6.0
"""Squared deviations, in sum over the six, within which two splines are one."""
_MEDIAN = 4.35
"""Of chi-squared of five degrees of freedom."""
_SHARE, _SHARE_OF_VIDEO = 0.15, 0.5
"""Weight of a track beside the prior, and in the covariance, for two frames and for more. Two frames hardly show
rotations of rows that are alike in both: with a larger weight, common errors of tracks of a tenth of a pixel
turned it by degrees."""
_PRIOR = Prior(memory=0.25, smooth=1, rotation=1e-4, position=1e-2)
"""Of one camera, to begin with; its strength is estimated."""
_GAINED = 0.3
"""Mean gain in log-likelihood per match from which a spline of one camera replaces a motion model. Neighbours in
dense flow have common errors, so that many of them count for one; rendered motions of constant speed gave 0.1 at
most."""
_OPEN_PX = 0.15
"""Largest standard deviation, root mean square over the rows of a frame, of the image of a distant point: above
it, two frames leave undetermined how the camera shook."""
_ROWS = 24
_JUDGED_BY = 150
"""Matches of a window, about, by which the prior is estimated, and which of the others are right."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TwoFrameSpline:
    """The spline of two frames of a rig."""

    motion: ContinuousMotion
    """Of the body, metres."""
    covariance: FloatArray | None
    """(6, 6) of its w and d; None where the matches do not determine it."""
    noise_px: float
    inliers: BoolArray
    """Of the tracks."""
    probability: float
    """Of the spline, against the motion model."""
    unique: bool
    """Whether no other spline, from another start, explains the matches as well."""


def two_frame_spline(
    matches: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion, seed: int = 0
) -> TwoFrameSpline | None:
    """The spline beside a motion of the body by a model, where the matches ask for one.

    None where there are few tracks, no fit, no depth, or no trace of time in what the model leaves. Where the law
    is far off, a search from it alone ends beside the best spline: one from rest is made too. On a plane several
    splines explain the matches; their distance is in the covariance.

    Args:
        law: the motion of largest likelihood under a model, where the search begins.
    """
    window = informative(matches)
    if shutter.still or len(window.tracks) < _FEWEST or not _asks_for_one(window, rig, shutter, law):
        return None
    starts = [law, make_motion("linear", np.zeros(3), np.zeros(3))]
    splines = [_Spline.through(window, rig, shutter, start, seed) for start in starts]
    fitted = [each for each in splines if each is not None]
    if not fitted:
        return None
    tails = min((each.found.fit.tails for each in fitted), key=lambda each: each.scale)
    everything = np.ones(len(fitted[0].tracks))
    worths = np.array([each.worth(each.found.curve, each.determined, tails, everything) for each in fitted])
    spline = fitted[int(np.argmax(worths))]
    odds = tempered(np.exp(worths - worths.max()), 1.0 / _SHARE)
    motions = np.stack([np.concatenate([each.found.motion.w, each.found.motion.d]) for each in fitted])
    found, errors = spline.found, (spline.found.fit.tails, spline.found.fit.trust)
    theirs = approximated(law.body_from_world, span_of(1, shutter), _KNOTS)
    gain = spline.worth(found.curve, spline.determined, *errors) - spline.worth(theirs, _OF_A_MODEL, *errors)
    # The prior's strength is estimated from as many accelerations as the matches determine.
    factor = small_sample_factor(max(spline.determined - _OF_A_MODEL, 0.0), int(_OF_A_MODEL))
    covariance = motion_covariance(found.curve, covariance_band(found.fit, spline.tracks, _SHARE), 0.0)
    if covariance is not None:
        covariance = factor * covariance + _of_common_shifts(window, rig, shutter, law)
    apart = spread_about(motions[int(np.argmax(worths))], odds, motions)
    unique = covariance is not None and float(np.trace(np.linalg.solve(covariance, apart))) < _APART
    return TwoFrameSpline(
        motion=found.motion,
        covariance=None if covariance is None else covariance + apart,
        noise_px=found.noise_px,
        inliers=found.inliers[0],
        probability=float(scipy.special.expit(gain)),
        unique=unique,
    )


def dispersion_of_rows(matches: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion) -> float:
    """Factor on a motion's covariance for what rows show against its law, see ``Rows.dispersion``.

    Args:
        law: as of ``two_frame_spline``.
    """
    tailed = None if shutter.still else _under_law(informative(matches), rig, shutter, law)
    theta = None if tailed is None else tailed.theta(law.w, law.d)
    rows = None if tailed is None or theta is None else tailed.by_rows(theta)
    if tailed is None or theta is None or rows is None:
        return 1.0
    stated = tailed.stated(theta)
    return rows.dispersion(1.0 if stated is None else stated.shared)


def _asks_for_one(window: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion) -> bool:
    """Whether depth is observed, and rows contradict the law."""
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
    """Tracks with the distribution of their errors; None for few tracks, or a law without equations."""
    if len(window.tracks) < _FEWEST or not has_kernel(law.name):
        return None
    packed = pack(Correspondences(tracks=window.tracks), rig, shutter, law.name, motion_parameters=law.parameters)
    theta = packed.theta(law.w, law.d)
    squares = each_term(packed, theta).squares
    return heavy_tailed(packed, theta, max(float(np.sqrt(np.median(squares) / _MEDIAN)), LEAST_SCALE_PX))


def _of_common_shifts(window: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion) -> FloatArray:
    """(6, 6) what errors that all matches of a region share do to w and d, by the equations of a law nearby."""
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
    """Log-odds that lines are read from the opposite side, or frames are in the wrong order, for a rig that may
    shake.

    Minus infinity where either spline has no fit.

    Args:
        opposite: the shutter with the opposite scan.
        motion: where the search begins.
    """
    window = informative(matches)
    given, other = (_Spline.through(window, rig, each, motion, seed) for each in (shutter, opposite))
    if given is None or other is None:
        return -np.inf
    tails = min((each.found.fit.tails for each in (given, other)), key=lambda each: each.scale)
    everything = np.ones(len(given.tracks))
    here, there = (each.worth(each.found.curve, each.determined, tails, everything) for each in (given, other))
    return there - here


@dataclass(frozen=True, kw_only=True, eq=False)
class _Spline:
    """A spline, and the tracks that it was fitted to."""

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

    def worth(self, curve: Curve, parameters: float, tails: Tails, trust: FloatArray) -> float:
        """Log-likelihood of a spline, less half of log n for each parameter; except for a constant."""
        found = normal_equations(curve, self.tracks, tails, NO_PRIOR, trust, want=False)
        return -found.cost - 0.5 * parameters * float(np.log(len(self.tracks)))

    @property
    def determined(self) -> float:
        """Number of its parameters that the matches determine, not the prior (D. MacKay, see ``fit``)."""
        bands, prior = self.found.fit.equations.rough.bands, self.found.prior
        pairs = zip(bands, (prior.rotation, prior.position), strict=True)
        tied = [band_inner(self.found.covariance_band, band) / strength for band, strength in pairs]
        return 6.0 * (len(self.found.curve.p) - 1) - float(np.sum(tied))


# One camera


def camera_trajectory(
    windows: Sequence[FloatArray], motions: Sequence[Motion], rig: StereoRig, shutter: RollingShutter
) -> list[ContinuousMotion] | None:
    """The motion in each window, seen from the camera at its start, d of length 1; None without a fit.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, with outliers, of the frames 0 and 1, 1 and 2, ...; those that
            end where others begin are one track.
        motions: of each window, to begin with; d of any length.
        rig: its body is where the camera is, the left one.
        shutter: of the camera.
    """
    try:
        curve = _fitted(windows, motions, rig, shutter, _SHARE_OF_VIDEO)[0].curve
    except NotDefiniteError:
        return None
    found = [_window(curve, number, shutter) for number in range(len(windows))]
    moving = [each for each in found if each is not None]
    return moving if len(moving) == len(windows) else None


def camera_two_frame_spline(
    matches: FloatArray, law: Motion, rig: StereoRig, shutter: RollingShutter
) -> ContinuousMotion | None:
    """As ``camera_trajectory``, for two frames; None where a model is as good, or the shake is undetermined.

    Args:
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        law: the motion under the model that fits best.
        rig, shutter: as there.
    """
    if shutter.still or len(matches) < _FEWEST:
        return None
    try:
        found, tracks = _fitted([matches], [law], rig, shutter, _SHARE)
        inverse = covariance_band(found, tracks, _SHARE)
    except NotDefiniteError:
        return None
    theirs, each = approximated(law.body_from_world, span_of(1, shutter), _KNOTS), replace(tracks, share=1.0)
    own, other = (
        normal_equations(curve, each, found.tails, NO_PRIOR, found.trust, want=False).cost
        for curve in (found.curve, theirs)
    )
    gained = (other - own) / max(float(np.sum(found.trust)), 1.0)
    if gained < _GAINED or _open_px(found.curve, inverse, rig, shutter) > _OPEN_PX:
        return None
    return _window(found.curve, 0, shutter)


def _open_px(curve: Curve, inverse: FloatArray, rig: StereoRig, shutter: RollingShutter) -> float:
    """Standard deviation, px, root mean square over rows of frame 1, of a distant point moved to the middle
    row."""
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
) -> tuple[Fit, TimedTracks]:
    """A first fit to some of the matches shows which are right."""

    def packed(each: Sequence[FloatArray], right: Sequence[FloatArray] | None = None) -> TimedTracks:
        return pack_windows([Correspondences(left=one) for one in each], rig, shutter, right, share=share)

    few = packed([each[:: max(len(each) // _JUDGED_BY, 1)] for each in windows])
    first = fit(first_curve(motions, few, span_of(len(windows), shutter), _KNOTS), few, _PRIOR)
    tracks = packed(windows)
    trust = right_tracks(first, tracks)
    tracks = packed(windows, [trust[each] for each in tracks.members])
    return fit(first.curve, tracks, first.prior, False, first.tails), tracks


def _window(curve: Curve, number: int, shutter: RollingShutter) -> ContinuousMotion | None:
    """None where it does not move."""
    start, end = span_of(1, shutter)
    motion = ContinuousMotion.of(part(curve, number + start, number + end, float(number)))
    length = float(np.linalg.norm(motion.d))
    return motion.seen(np.eye(3), 1.0 / length) if length > 0.0 else None
