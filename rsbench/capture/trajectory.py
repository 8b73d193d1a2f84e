"""One way of a rig through a whole sequence, from the matches of all neighbouring frames.

Two frames do not show what both shake alike; a sequence does, for its windows overlap. The way is a spline
(``trajectory_spline``) of largest posterior probability (``trajectory_fit``) under tracks with heavy-tailed errors
(``trajectory_kernels``) and a prior of how hands shake, whose strength the matches say themselves
(``trajectory_prior``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_data import pack_windows
from rsbench.capture.trajectory_fit import Fit, fit, information
from rsbench.capture.trajectory_poses import blank_views, fill_views
from rsbench.capture.trajectory_prior import Prior
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve
from rsbench.capture.trajectory_start import first_curve, window_motions
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_ONE_SIGMA = 0.8413447460685429
_FEWEST, _LEAST_SHARE = 15, 0.2
"""Right tracks, and their share, from which on a window is supported by its own matches."""


@dataclass(frozen=True, kw_only=True)
class TrajectoryOptions:
    """How a trajectory is found."""

    interval: float = 0.5
    """Frame periods between two control poses."""
    prior: Prior = Prior(memory=2.0, smooth=2, rotation=1e-4, position=1e-4)  # noqa: RUF009
    """To begin with."""
    learn: bool = True
    """Whether the matches say its variances."""
    seed: int = 0
    """Of the search for motions of single windows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """What the rig did, seen from the body at time 0."""

    motion: ContinuousMotion
    """body_from_world at any time of the sequence, frame periods."""
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
    covariance_band: FloatArray
    """Of the control poses, see ``trajectory_banded``."""

    @property
    def interval(self) -> float:
        """Frame periods between two control poses."""
        return self.motion.interval

    def window(self, number: int) -> Motion:
        """The motion seen from the body at the start of a frame, which is time 0."""
        return self.motion.from_time(float(number))

    def covariance(self, tau: FloatArray) -> FloatArray:
        """Covariance (n, 6, 6) of the poses at times (n,), given that of time 0.

        Of small turns of the body about its own axes, radians, and of its position in the world, metres.
        """
        return pose_covariance(self.fit.curve, self.covariance_band, np.atleast_1d(tau))


def estimate_trajectory(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    motions: Sequence[Motion | None] | None = None,
    options: TrajectoryOptions | None = None,
) -> Trajectory:
    """The trajectory of a rig, from matches with outliers.

    Args:
        windows: of the frames 0 and 1, 1 and 2, ...
        motions: of each window, to begin with; None: they are searched.

    Raises:
        ValueError: no windows, or no tracks in any.
    """
    options = options or TrajectoryOptions()
    tracks = pack_windows(windows, rig, shutter)
    if len(tracks.window) == 0:
        raise ValueError("a trajectory needs tracks: matches of both cameras over time")
    if motions is None:
        motions = window_motions(windows, rig, shutter, options.seed)
    curve = first_curve(motions, tracks, time_span(len(windows), shutter), options.interval)
    found = fit(curve, tracks, options.prior, learn=options.learn)
    masks = tuple(found.trust[tracks.window == k] > 0.0 for k in range(len(windows)))
    enough = [np.count_nonzero(m) >= max(_FEWEST, _LEAST_SHARE * len(m)) for m in masks]
    return Trajectory(
        motion=ContinuousMotion.of(found.curve),
        noise_px=found.tails.scale * float(scipy.special.stdtrit(found.tails.nu, _ONE_SIGMA)),
        nu=found.tails.nu,
        prior=found.prior,
        inliers=masks,
        supported=np.array(enough),
        fit=found,
        covariance_band=banded.inverse_band(
            information(found.curve, tracks, found.tails, found.prior, found.trust)
        ),
    )


def time_span(windows: int, shutter: RollingShutter) -> tuple[float, float]:
    """From the first line to the last one of so many windows, time 0 within."""
    ends = [shutter.start(frame, side) for frame in (0, windows) for side in SIDES]
    return min(0.0, float(np.min(ends))), float(np.max(ends)) + shutter.readout_ratio


def pose_covariance(curve: Curve, inverse: FloatArray, taus: FloatArray) -> FloatArray:
    """Covariance (n, 6, 6) of poses at times (n,), from the inverse of the normal matrix in its band."""
    taus = np.clip(np.asarray(taus, dtype=np.float64), curve.first, curve.last)
    views = blank_views(len(taus))
    fill_views(curve, taus, views)
    by = np.zeros((len(taus), 6, 4, 6))
    by[:, :3, :, :3] = np.swapaxes(views.turn, 1, 2)
    by[:, 3:, :, 3:] = views.share[:, None, :, None] * np.eye(3)[:, None, :]
    by = by.reshape(len(taus), 6, 24)
    rows = 6 * views.index[:, None] + np.arange(24)
    low, high = np.minimum(rows[:, :, None], rows[:, None]), np.maximum(rows[:, :, None], rows[:, None])
    return np.asarray(by @ inverse[low, high - low] @ np.swapaxes(by, 1, 2))
