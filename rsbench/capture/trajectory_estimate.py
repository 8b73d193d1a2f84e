"""One way of a rig through a whole sequence, from the matches of all neighbouring frames.

Two frames do not show what both shake alike; a sequence does, for its windows overlap. The way is a spline
(``trajectory_spline``) of largest posterior probability (``trajectory_fit``) under tracks with heavy-tailed errors
(``trajectory_kernels``) and a prior of how hands shake, whose strength the matches say themselves
(``trajectory_prior``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rsbench.capture.trajectory_choice import approximated, choose
from rsbench.capture.trajectory_covariance import covariance_between, pose_covariance
from rsbench.capture.trajectory_data import TimedTracks, pack_windows, telling
from rsbench.capture.trajectory_fit import NORMAL, Fit, covariance_band, fit, information
from rsbench.capture.trajectory_gyro import Drift, GyroFound, GyroSteps, bordered_inverse, contradicts, gyro_steps
from rsbench.capture.trajectory_kernels import Tails
from rsbench.capture.trajectory_prior import Prior
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve, span_of
from rsbench.capture.trajectory_start import first_curve, window_motions
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_ONE_SIGMA = 0.8413447460685429
_JUDGED = 8
"""First windows, from which knots and prior are chosen."""
_FEWEST, _LEAST_SHARE = 15, 0.2
"""Right tracks, and their share, from which on a window is supported by its own matches."""
MOST_NOISE_PX = 10.0
"""Beyond which errors are no noise: random tracks leave some 20 px, and by that scale most of them are right."""


@dataclass(frozen=True, kw_only=True)
class TrajectoryOptions:
    """How a trajectory is found."""

    intervals: tuple[float, ...] = (1 / 2, 1 / 3, 1 / 4)
    """Frame periods between two control poses: those of most evidence are taken, the first ones to begin with."""
    prior: Prior = Prior(memory=0.5, smooth=2, rotation=1e-4, position=1e-4)  # noqa: RUF009
    """To begin with."""
    learn: bool = True
    """Whether the matches say the prior and the knots."""
    link: bool = True
    """Whether tracks that meet in a frame are one; without it their common ends count as two."""
    share: float = 0.5
    """What a track counts beside the prior. Patches of neighbouring tracks overlap and err alike: counted for one
    each, they take a still hand's common errors for accelerations."""
    seed: int = 0
    """Of the search for motions of single windows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrajectoryBound:
    """How well a trajectory can be known: covariances of its poses."""

    curve: Curve
    covariance_band: FloatArray
    """Of the control poses, see ``trajectory_banded``."""

    def covariance(self, tau: ArrayLike) -> FloatArray:
        """Covariance (n, 6, 6) of the poses at times (n,), given that of time 0.

        Of small turns of the body about its own axes, radians, and of its position in the world, metres.
        """
        return pose_covariance(self.curve, self.covariance_band, np.atleast_1d(tau))

    def covariance_between(self, start: float, tau: ArrayLike) -> FloatArray:
        """Covariance (n, 6, 6) of the poses at times (n,) within a period of ``start``, given the pose there.

        Of small turns of the body about its own axes, radians, and of its position in the axes of the body at
        ``start``, metres.
        """
        return covariance_between(self.curve, self.covariance_band, start, np.atleast_1d(tau))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory(TrajectoryBound):
    """What the rig did, seen from the body at time 0."""

    motion: ContinuousMotion
    """body_from_world at any time of the sequence, frame periods."""
    shutter: RollingShutter
    """Given or found."""
    noise_px: float
    """Of a coordinate, as of a normal error: two in three are below it."""
    nu: float
    """Degrees of freedom of the tails; 30 is as good as normal."""
    prior: Prior
    inliers: tuple[BoolArray, ...]
    """For each window, which of its tracks are right."""
    supported: BoolArray
    """(windows,) whether a window's own tracks carry it; elsewhere the spline bridges it."""
    fit: Fit
    gyro: GyroFound | None = None
    """What was found of a gyroscope; None: none was given."""

    @property
    def interval(self) -> float:
        """Frame periods between two control poses."""
        return self.motion.interval

    def window(self, number: int) -> Motion:
        """The motion seen from the body at the start of a frame, which is time 0."""
        return self.motion.from_time(float(number))


def estimate_trajectory(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    motions: Sequence[Motion | None] | None = None,
    options: TrajectoryOptions | None = None,
    seed: int = 0,
    gyro: FloatArray | None = None,
) -> Trajectory:
    """The trajectory of a rig, from matches with outliers.

    Args:
        windows: of the frames 0 and 1, 1 and 2, ...
        motions: of each window, to begin with; None: they are searched.
        seed: of that search, where there are no options.
        gyro: (n, 4) samples as of ``Correspondences.gyro``, tau of the sequence; bias and noise are found.

    Raises:
        ValueError: no windows, or no tracks in any.
    """
    options, windows = options or TrajectoryOptions(seed=seed), [telling(each) for each in windows]
    if not any(len(window.tracks) for window in windows):
        raise ValueError("a trajectory needs tracks: matches of both cameras over time")
    if motions is None:
        motions = window_motions(windows, rig, shutter, options.seed)
    given = _Given(windows, rig, shutter, motions, options, None if gyro is None else gyro_steps(gyro))
    found, tracks = given.fitted()
    if tracks.gyro is not None and found.drift is not None and contradicts(tracks.gyro, found.drift):
        drift = found.drift
        found, tracks = replace(given, gyro=None).fitted()
        return replace(_told(found, tracks, windows, shutter), gyro=GyroFound.of(drift, used=False))
    return _told(found, tracks, windows, shutter)


@dataclass(frozen=True)
class _Given:
    """What a trajectory is found of."""

    windows: Sequence[Correspondences]
    rig: StereoRig
    shutter: RollingShutter
    motions: Sequence[Motion | None]
    options: TrajectoryOptions
    gyro: GyroSteps | None

    def fitted(self) -> tuple[Fit, TimedTracks]:
        """The spline, and what it was fitted to."""
        options = self.options
        found, tracks = self._first(_JUDGED, options.intervals[0], options.prior)
        if options.learn:
            found = choose(found, tracks, options.intervals)
        if len(self.windows) > _JUDGED:
            found, tracks = self._first(len(self.windows), found.curve.interval, found.prior, found.drift)
        if options.link:
            right = [found.trust[each] for each in tracks.members]
            tracks = self._packed(len(self.windows), found.drift, right)
            found = fit(found.curve, tracks, found.prior, options.learn, found.tails, drift=found.drift)
        return found, tracks

    def _first(
        self, count: int, interval: float, prior: Prior, drift: Drift | None = None
    ) -> tuple[Fit, TimedTracks]:
        """The spline of so many windows, and their tracks."""
        tracks, motions = self._packed(count, drift), self.motions[:count]
        curve = first_curve(motions, tracks, span_of(len(motions), self.shutter), interval)
        return fit(curve, tracks, prior, self.options.learn, drift=drift), tracks

    def _packed(self, count: int, drift: Drift | None, right: Sequence[FloatArray] | None = None) -> TimedTracks:
        windows = self.windows[:count]
        tracks = pack_windows(windows, self.rig, self.shutter, right, share=self.options.share)
        if self.gyro is None:
            return tracks
        shift = 0.0 if drift is None else drift.shift
        first, last = span_of(len(windows), self.shutter)
        return replace(tracks, gyro=self.gyro.between(first - shift, last - shift))


def _told(
    found: Fit, tracks: TimedTracks, windows: Sequence[Correspondences], shutter: RollingShutter
) -> Trajectory:
    masks = tuple(found.trust[each] > 0.0 for each in tracks.members)
    inliers = tuple(mask[: len(window.tracks)] for mask, window in zip(masks, windows, strict=True))
    return Trajectory(
        motion=ContinuousMotion.of(found.curve),
        shutter=shutter,
        noise_px=noise_px(found.tails),
        nu=found.tails.nu,
        prior=found.prior,
        inliers=inliers,
        supported=np.array([is_supported(mask, found.tails) for mask in inliers]),
        fit=found,
        curve=found.curve,
        covariance_band=covariance_band(found, tracks),
        gyro=None if found.drift is None else GyroFound.of(found.drift),
    )


def noise_px(tails: Tails) -> float:
    """Of a coordinate, as of a normal error: two in three are below it."""
    return tails.scale * float(scipy.special.stdtrit(tails.nu, _ONE_SIGMA))


def is_supported(inliers: BoolArray, tails: Tails) -> bool:
    """Whether tracks (n,), some of them right, carry their window."""
    enough = np.count_nonzero(inliers) >= max(_FEWEST, _LEAST_SHARE * len(inliers))
    return bool(enough and noise_px(tails) <= MOST_NOISE_PX)


def trajectory_bound(
    motion: Motion,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    noise_px: float,
    interval: float = 0.5,
    prior: Prior | None = None,
) -> TrajectoryBound:
    """The Cramer-Rao bound of a trajectory, at the truth.

    Args:
        windows: the right matches, without outliers; those that meet in a frame are one track.
        noise_px: standard deviation of a coordinate, normal.
        interval: frame periods between the control poses, which are all that is unknown.
        prior: what is known beside (H. van Trees' bound); None: nothing.

    Raises:
        ValueError: the matches do not determine the trajectory.
    """
    everything = [np.ones(len(each)) for each in pack_windows(windows, rig, shutter).members]
    tracks = pack_windows(windows, rig, shutter, everything)
    curve = approximated(motion.body_from_world, span_of(len(windows), shutter), interval)
    told = information(curve, tracks, Tails(NORMAL, noise_px), prior, np.ones(len(tracks)))
    return TrajectoryBound(curve=curve, covariance_band=bordered_inverse(*told))
