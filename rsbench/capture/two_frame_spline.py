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

from rsbench.capture.trajectory_estimate import Trajectory, TrajectoryOptions, estimate_trajectory
from rsbench.capture.trajectory_fit import Fit, covariance_band, first_curve, fit, normal_equations, right_tracks
from rsbench.capture.trajectory_spline import (
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
from rsbench.capture.trajectory_tracks import Tails, TimedTracks, pack_windows, telling
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_NO_PRIOR = Prior(1.0, 1, np.inf, np.inf)
_OF_A_LAW = 6.0
"""Parameters of a law, at least."""
_FEWEST = 30
"""Tracks, from which on a spline is tried."""
_KNOTS = 0.25
"""Frame periods between control poses."""
_SHARE = 0.15
"""What a track counts beside the prior, and in the covariance. What rows of both frames shake alike hardly shows:
tracks that err together by a tenth of a pixel, counted for more, turned it by degrees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shaken:
    """The spline of two frames."""

    motion: ContinuousMotion
    """Of the body, metres."""
    covariance: FloatArray | None
    """(6, 6) of its w and d; None where the matches do not determine it."""
    noise_px: float
    inliers: BoolArray
    """Of the tracks."""
    probability: float
    """That the rig moved so, and not by the law."""


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
        """Logarithm of the likelihood of a spline, less half of log n for each parameter; but for a constant."""
        found = normal_equations(curve, self.tracks, tails, _NO_PRIOR, trust, want=False)
        return -found.cost - 0.5 * parameters * float(np.log(len(self.tracks)))

    @property
    def determined(self) -> float:
        """Number of its parameters that the matches determine, not the prior (D. MacKay, see ``fit``)."""
        found = self.found
        tied = [
            band_inner(found.covariance_band, band) / strength
            for band, strength in zip(
                found.fit.equations.rough.bands, (found.prior.rotation, found.prior.position), strict=True
            )
        ]
        return 6.0 * (len(found.curve.p) - 1) - float(np.sum(tied))


def shaken_motion(
    matches: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion, seed: int = 0
) -> Shaken | None:
    """The spline, beside a motion of the body by a law; None where there are few tracks, or none is found.

    Args:
        law: of largest likelihood, from which the search begins.
    """
    window = telling(matches)
    if shutter.readout_ratio == 0.0 or len(window.tracks) < _FEWEST:
        return None
    spline = _Spline.through(window, rig, shutter, law, seed)
    if spline is None:
        return None
    found, errors = spline.found, (spline.found.fit.tails, spline.found.fit.trust)
    theirs = approximated(law.body_from_world, span_of(1, shutter), _KNOTS)
    odds = spline.worth(found.curve, spline.determined, *errors) - spline.worth(theirs, _OF_A_LAW, *errors)
    return Shaken(
        motion=found.motion,
        covariance=motion_covariance(found.curve, covariance_band(found.fit, spline.tracks, _SHARE), 0.0),
        noise_px=found.noise_px,
        inliers=found.inliers[0],
        probability=float(scipy.special.expit(odds)),
    )


def log_odds_of_opposite(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    opposite: RollingShutter,
    motion: Motion,
    seed: int = 0,
) -> float:
    """Of the lines being read from the opposite side, or of frames in the wrong order, of a rig that may shake.

    Minus infinity where a spline is not found: that says nothing.

    Args:
        opposite: the shutter that is read so.
        motion: from which the search begins.
    """
    window = telling(matches)
    said, other = (_Spline.through(window, rig, each, motion, seed) for each in (shutter, opposite))
    if said is None or other is None:
        return -np.inf
    tails = min((each.found.fit.tails for each in (said, other)), key=lambda each: each.scale)
    everything = np.ones(len(said.tracks))
    here, there = (each.worth(each.found.curve, each.determined, tails, everything) for each in (said, other))
    return there - here


_PRIOR = Prior(memory=0.25, smooth=1, rotation=1e-4, position=1e-2)
"""To begin with; its strength follows the matches."""
_SHARE_OF_VIDEO = 0.5
"""What a track counts beside the prior, see ``TrajectoryOptions``: of many frames, and of two, where tracks that
err together turn what hardly anything else holds."""
_GAINED = 0.3
"""Logarithm of the likelihood that a match of two frames must gain, in the mean, for a way in place of a law.
Neighbours err alike in dense flow, so that many of them count for one; of rendered motions by laws of constant
speed it was 0.1 at most."""
_OPEN_PX = 0.15
"""Deviation, root mean square, of where turns of the rows of a frame put what is far: above, two frames leave open
how they shook."""
_ROWS = 24
_JUDGED_BY = 150
"""Matches of a window, about, by which the prior is found, and which of the others are right."""


def trajectory_alone(
    windows: Sequence[FloatArray], motions: Sequence[Motion], rig: StereoRig, shutter: RollingShutter
) -> list[ContinuousMotion] | None:
    """The motion in each window, seen from the camera at its start, d of length 1; None where none is found.

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
    ways = [each for each in found if each is not None]
    return ways if len(ways) == len(windows) else None


def way_of_two(
    matches: FloatArray, law: Motion, rig: StereoRig, shutter: RollingShutter
) -> ContinuousMotion | None:
    """As ``trajectory_alone`` of two frames; None where a law is as good, or they leave open which way it was.

    Args:
        matches: (n, 4) x0, y0, x1, y1, px, with outliers.
        law: the motion by the law that fits best.
        rig, shutter: as there.
    """
    if shutter.readout_ratio == 0.0 or len(matches) < _FEWEST:
        return None
    try:
        found, tracks = _fitted([matches], [law], rig, shutter, _SHARE)
        inverse = covariance_band(found, tracks, _SHARE)
    except NotDefiniteError:
        return None
    theirs = approximated(law.body_from_world, span_of(1, shutter), _KNOTS)
    each = replace(tracks, share=1.0)
    costs = [
        normal_equations(curve, each, found.tails, _NO_PRIOR, found.trust, want=False).cost
        for curve in (found.curve, theirs)
    ]
    gained = (costs[1] - costs[0]) / max(float(np.sum(found.trust)), 1.0)
    if gained < _GAINED or _open_px(found.curve, inverse, rig, shutter) > _OPEN_PX:
        return None
    return _window(found.curve, 0, shutter)


def _open_px(curve: Curve, inverse: FloatArray, rig: StereoRig, shutter: RollingShutter) -> float:
    """Root mean square deviation, px, of where rows of frame 1 put what is far at the time of its middle row."""
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
    """Some of the matches say first which are right."""

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
    if not length > 0.0:
        return None
    return motion.seen(np.eye(3), 1.0 / length)
