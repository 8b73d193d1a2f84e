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
from rsbench.capture.trajectory_fit import Fit, normal_equations
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
_NEAR = 0.25
"""Frame periods between the control poses by which a law is told."""


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


def shaken_motion(
    matches: Correspondences, rig: StereoRig, shutter: RollingShutter, law: Motion, seed: int = 0
) -> Shaken | None:
    """The spline, beside a motion of the body by a law; None where there are few tracks, or none is found.

    Args:
        law: of largest likelihood, from which the search begins.
    """
    window, options = telling(matches), TrajectoryOptions(link=False, seed=seed)
    if shutter.readout_ratio == 0.0 or len(window.tracks) < _FEWEST:
        return None
    try:
        found = estimate_trajectory([window], rig, shutter, [law], options)
    except (banded.NotDefiniteError, ValueError):
        return None
    tracks = pack_windows([window], rig, shutter, share=options.share)
    theirs = approximated(law.body_from_world, span_of(1, shutter), _NEAR)
    gain = _log_likelihood(found.curve, found.fit, tracks) - _log_likelihood(theirs, found.fit, tracks)
    odds = gain - 0.5 * (_determined(found) - _OF_A_LAW) * float(np.log(len(tracks)))
    return Shaken(
        motion=found.motion,
        covariance=motion_covariance(found.curve, found.covariance_band, 0.0),
        noise_px=found.noise_px,
        inliers=found.inliers[0],
        probability=float(scipy.special.expit(odds)),
    )


def _log_likelihood(curve: Curve, found: Fit, tracks: TimedTracks) -> float:
    """Of the tracks that a fit takes for right, under the errors that it found; but for a constant."""
    return -normal_equations(curve, tracks, found.tails, _NO_PRIOR, found.trust, want=False).cost


def _determined(found: Trajectory) -> float:
    """Number of the spline's parameters that the matches determine, not the prior (D. MacKay, see ``fit``)."""
    fit, strengths = found.fit, (found.prior.rotation, found.prior.position)
    tied = [
        banded.inner(found.covariance_band, band) / strength
        for band, strength in zip(fit.equations.rough.bands, strengths, strict=True)
    ]
    return 6.0 * (len(found.curve.p) - 1) - float(np.sum(tied))
