"""A spline in place of a law of motion, of two frames whose matches ask for it.

A hand that shakes follows no law of six or seven numbers. The spline of ``trajectory_estimate`` through the two
frames is preferred where it raises the likelihood by more than its parameters are worth (G. Schwarz, Estimating
the dimension of a model, Annals of Statistics 1978); of these, those count that the matches determine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_choice import approximated
from rsbench.capture.trajectory_covariance import motion_covariance
from rsbench.capture.trajectory_data import TimedTracks, pack_windows, telling
from rsbench.capture.trajectory_estimate import Trajectory, TrajectoryOptions, estimate_trajectory
from rsbench.capture.trajectory_fit import covariance_band, normal_equations
from rsbench.capture.trajectory_kernels import Tails
from rsbench.capture.trajectory_prior import Prior
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve, span_of
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
        except (banded.NotDefiniteError, ValueError):
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
            banded.inner(found.covariance_band, band) / strength
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
