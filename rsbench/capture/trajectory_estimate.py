"""Estimate the trajectory of a rig from the matches of successive frames, of a whole sequence or of a stream.

Two frames cannot reveal a shake that is the same in both; a sequence can, because its windows overlap. The
trajectory is the spline of largest posterior probability (``trajectory_fit``) given tracks with heavy-tailed
errors and a prior on accelerations, whose variance is estimated from the matches.

``stream_trajectory`` processes a sequence of any length, some frames at a time, in constant memory. Matches of
frames that are dropped are replaced by a quadratic cost of the remaining control poses (marginalisation: G.
Sibley, L. Matthies, G. Sukhatme, Sliding window filter with application to planetary landing, J. Field Robotics
2010). Knot interval and time constant of the prior come from the first frames; its variances are updated.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from rsbench.capture.trajectory_fit import (
    ANCHORED,
    Fit,
    anchored,
    choose,
    continued,
    covariance_band,
    first_curve,
    fit,
    normal_equations,
    right_tracks,
    window_motions,
)
from rsbench.capture.trajectory_gyro import Drift, GyroFound, GyroSteps, contradicts, gyro_steps
from rsbench.capture.trajectory_spline import (
    ContinuousMotion,
    Curve,
    Prior,
    covariance_between,
    evaluate,
    make_curve,
    motion_covariance,
    part,
    pose_covariance,
    span_of,
)
from rsbench.capture.trajectory_tracks import (
    Past,
    Tails,
    TimedTracks,
    informative,
    inverse_depths,
    pack_windows,
    thinned,
)
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.refined import LEAST_DEPTHS

_ONE_SIGMA = 0.8413447460685429
_FIRST_WINDOWS = 8
"""Number of first windows from which the knot interval and the prior are chosen."""
_FEWEST, _LEAST_SHARE = 15, 0.2
"""A window is supported by its own matches if it has at least this many inlier tracks, and this share of them."""
MOST_NOISE_PX = 10.0
"""Largest plausible noise: random tracks give some 20 px, and at that scale most of them would be inliers."""
_ADVANCE, _LAG = 6, 5
"""Number of windows that a stream returns at once, and number of later windows that it needs for them."""
_FAR = 1_000_000
_FIRST_TRACKS = 250
"""Approximate number of tracks per window from which knots and prior of a stream are chosen."""


@dataclass(frozen=True, kw_only=True)
class TrajectoryOptions:
    """Options for the estimation of a trajectory."""

    intervals: tuple[float, ...] = (1 / 2, 1 / 3, 1 / 4)
    """Candidate knot intervals, frame periods: fits start with the first and choose the one of most evidence."""
    prior: Prior = Prior(memory=0.5, smooth=2, rotation=1e-4, position=1e-4)  # noqa: RUF009
    """Prior at the start."""
    learn: bool = True
    """Whether the prior and the knot interval are estimated."""
    link: bool = True
    """Whether tracks that share a pixel in a frame are joined; otherwise this pixel counts twice."""
    share: float = 0.5
    """Weight of a track relative to the prior. Patches of neighbouring tracks overlap, so their errors are
    correlated: with a weight of 1, those of a steady hand would be estimated as accelerations."""
    seed: int = 0
    """Seed of the search for motions of single windows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """The estimated trajectory; the world is the body at time 0."""

    motion: ContinuousMotion
    """body_from_world at any time of the sequence, frame periods."""
    shutter: RollingShutter
    """The given or estimated shutter."""
    noise_px: float
    """Standard deviation of a coordinate: 68 % of the errors are below it."""
    nu: float
    """Degrees of freedom of the t distribution of the errors; with 30 it is nearly normal."""
    prior: Prior
    inliers: tuple[BoolArray, ...]
    """For each window, which of its tracks are inliers."""
    supported: BoolArray
    """(windows,) whether a window's own tracks support it; the others are interpolated by the spline."""
    depths: BoolArray
    """(windows,) whether disparities exceed their noise; otherwise the covariances do not describe the errors."""
    fit: Fit
    covariance_band: FloatArray
    """Covariance of the control poses, see ``trajectory_spline``."""
    gyro: GyroFound | None = None
    """Bias, noise and clock of a gyroscope; None: none was given."""

    @property
    def curve(self) -> Curve:
        """The spline."""
        return self.fit.curve

    @property
    def interval(self) -> float:
        """Frame periods between two control poses."""
        return self.motion.interval

    def window(self, number: int) -> Motion:
        """The motion relative to the body at the start of frame ``number``, which is its time 0."""
        return self.motion.from_time(float(number))

    def covariance(self, tau: ArrayLike) -> FloatArray:
        """Covariance (n, 6, 6) of the poses at times (n,), given the pose at time 0.

        It is that of small rotations about the body's axes, radians, and of the position in the world, metres.
        """
        return pose_covariance(self.curve, self.covariance_band, np.atleast_1d(tau))

    def covariance_between(self, start: float, tau: ArrayLike) -> FloatArray:
        """Covariance (n, 6, 6) of the poses at times (n,) within a period of ``start``, given the pose there.

        It is that of small rotations about the body's axes, radians, and of the position in the axes at ``start``,
        metres.
        """
        return covariance_between(self.curve, self.covariance_band, start, np.atleast_1d(tau))


def estimate_trajectory(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    motions: Sequence[Motion | None] | None = None,
    options: TrajectoryOptions | None = None,
    seed: int = 0,
    gyro: FloatArray | None = None,
) -> Trajectory:
    """Estimate the trajectory of a rig from matches with outliers.

    Args:
        windows: matches of the frames 0 and 1, 1 and 2, ...
        motions: start motion of each window; None: a robust search finds them.
        seed: seed of that search if ``options`` is None.
        gyro: (n, 4) samples as in ``Correspondences.gyro``, tau of the sequence; bias and noise are estimated.

    Raises:
        ValueError: there are no windows, or none has tracks.
    """
    options, windows = options or TrajectoryOptions(seed=seed), [informative(each) for each in windows]
    if not any(len(window.tracks) for window in windows):
        raise ValueError("a trajectory needs tracks: matches of both cameras over time")
    if motions is None:
        motions = window_motions(windows, rig, shutter, options.seed)
    state = _State(rig, shutter, options, None if gyro is None else gyro_steps(gyro))
    state.windows, state.motions = windows, list(motions)
    found, tracks = state.solve(at_once=True)
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
        depths=_depths(found, tracks, inliers, rig),
        fit=found,
        covariance_band=covariance_band(found, tracks),
        gyro=state.gyro_found(found),
    )


def noise_px(tails: Tails) -> float:
    """Standard deviation of a coordinate, px, by the share of normal errors below it (68 %)."""
    return tails.scale * float(scipy.special.stdtrit(tails.nu, _ONE_SIGMA))


def is_supported(inliers: BoolArray, tails: Tails) -> bool:
    """Whether the inliers among tracks (n,) suffice to support their window."""
    enough = np.count_nonzero(inliers) >= max(_FEWEST, _LEAST_SHARE * len(inliers))
    return bool(enough and noise_px(tails) <= MOST_NOISE_PX)


def _depths(found: Fit, tracks: TimedTracks, inliers: Sequence[BoolArray], rig: StereoRig) -> BoolArray:
    """Return for each window whether the median disparity of its inliers (m,) exceeds the noise, see
    ``LEAST_DEPTHS``; true without inliers."""
    disparities = (
        rig.camera.fx * rig.baseline * inverse_depths(found.curve, tracks.ends, tracks.starts, tracks.focal)
    )
    least = LEAST_DEPTHS * np.sqrt(2.0) * noise_px(found.tails)
    seen = [disparities[own[: len(mask)][mask]] for own, mask in zip(tracks.members, inliers, strict=True)]
    return np.array([len(each) == 0 or bool(np.median(each) >= least) for each in seen])


# Streams


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamedWindow:
    """The result for two successive frames of a stream, which later frames do not change."""

    number: int
    motion: ContinuousMotion
    """The motion relative to the body at the start of the first frame (time 0), valid for both frames."""
    body_from_world: Pose
    """The pose at that time; the world is the body at time 0 of the sequence."""
    inliers: BoolArray
    """(n,) which tracks are inliers."""
    covariance: FloatArray | None
    """(6, 6) covariance of w and d of ``motion``; None if no track spans a period, or without ``depths``."""
    apart: int
    """Distance, in windows, to the nearest supported window so far; 0: this window is supported."""
    depths: bool
    """Whether disparities exceed their noise, so that d has a length."""
    noise_px: float
    gyro: GyroFound | None
    """The current estimates for a gyroscope; None: there is none."""

    @property
    def supported(self) -> bool:
        """Whether the window's own tracks support it; otherwise the spline interpolates it."""
        return self.apart == 0


def stream_trajectory(
    windows: Iterable[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    seed: int = 0,
    options: TrajectoryOptions | None = None,
    gyro: FloatArray | None = None,
) -> Iterator[StreamedWindow]:
    """``estimate_trajectory`` for windows that arrive one after the other.

    Args:
        seed: seed of the search for motions of single windows if ``options`` is None.
        gyro: (n, 4) samples as in ``Correspondences.gyro``, with tau of the sequence.
    """
    options = options or TrajectoryOptions(seed=seed)
    state = _State(rig, shutter, options, None if gyro is None else gyro_steps(gyro))
    for window in windows:
        state.add(window, *window_motions([window], rig, shutter, options.seed))
        if len(state.windows) == _ADVANCE + _LAG:
            found, tracks = state.solve()
            yield from state.final(found, tracks, _ADVANCE)
            state.marginalise(found, tracks, _ADVANCE)
    if state.windows:
        yield from state.final(*state.solve(), len(state.windows))


class _State:
    """The current windows of a sequence or stream, and a quadratic cost in place of the dropped ones."""

    def __init__(
        self, rig: StereoRig, shutter: RollingShutter, options: TrajectoryOptions, gyro: GyroSteps | None
    ) -> None:
        self.rig, self.shutter, self.options = rig, shutter, options
        self.gyro = gyro
        """Samples of the current and of later windows."""
        self.rejected_gyro: GyroFound | None = None
        """A gyroscope that contradicted the matches."""
        self.windows, self.motions = list[Correspondences](), list[Motion | None]()
        self.first = self.fresh = 0
        self.curve: Curve | None = None
        self.past: Past | None = None
        self.fit: Fit | None = None
        self._supported = -_FAR
        """Number of the last supported window among the dropped ones."""

    def add(self, window: Correspondences, motion: Motion | None) -> None:
        self.windows.append(informative(window))
        self.motions.append(motion)
        self.fresh += 1

    def _pack(
        self,
        windows: Sequence[Correspondences],
        right: Sequence[FloatArray] | None = None,
        drift: Drift | None = None,
    ) -> TimedTracks:
        share = self.options.share
        tracks = pack_windows(windows, self.rig, self.shutter, right, self.first, self.past, share)
        if self.gyro is None:
            return tracks
        # Samples that were dropped are not used again, even if the clock estimate has moved since.
        shift = 0.0 if drift is None else drift.shift
        first = span_of(0, self.shutter)[0] - shift if self.curve is None else -np.inf
        last = span_of(self.first + len(windows), self.shutter)[1] - shift
        return replace(tracks, gyro=self.gyro.between(first, last))

    def solve(self, at_once: bool = False) -> tuple[Fit, TimedTracks]:
        """Fit the spline to all current windows; a gyroscope that contradicts the matches is dropped.

        ``at_once``: the windows are a whole sequence.
        """
        solved = self._solved_at_once if at_once else self._solved
        found, tracks = solved()
        if tracks.gyro is None or found.drift is None or not contradicts(tracks.gyro, found.drift):
            return found, tracks
        self.gyro, self.rejected_gyro = None, GyroFound.of(found.drift, used=False)
        self.past = None if self.past is None else self.past.without_gyro()
        self.fit = None if self.fit is None else replace(self.fit, drift=None)
        return solved()

    def gyro_found(self, found: Fit) -> GyroFound | None:
        """The estimates for a gyroscope; None: there is none."""
        return self.rejected_gyro if found.drift is None else GyroFound.of(found.drift)

    def _solved_at_once(self) -> tuple[Fit, TimedTracks]:
        """The spline fitted to a whole sequence, after a first fit to the first windows, and its tracks."""
        options, windows = self.options, self.windows
        found, tracks = self._first_fit(windows[:_FIRST_WINDOWS], options.intervals[0], options.prior)
        if options.learn:
            found = choose(found, tracks, options.intervals)
        if len(windows) > _FIRST_WINDOWS:
            found, tracks = self._first_fit(windows, found.curve.interval, found.prior, found.drift)
        if options.link:
            tracks = self._pack(windows, [found.trust[each] for each in tracks.members], found.drift)
            found = fit(found.curve, tracks, found.prior, options.learn, found.tails, drift=found.drift)
        return found, tracks

    def _first_fit(
        self, windows: Sequence[Correspondences], interval: float, prior: Prior, drift: Drift | None = None
    ) -> tuple[Fit, TimedTracks]:
        """A spline fitted to the first windows, without one to start from, and their tracks."""
        tracks, count = self._pack(windows, drift=drift), len(windows)
        curve = first_curve(self.motions[:count], tracks, span_of(count, self.shutter), interval)
        return fit(curve, tracks, prior, self.options.learn, drift=drift), tracks

    def _solved(self) -> tuple[Fit, TimedTracks]:
        """The spline fitted to a part of a stream, after a first fit to some tracks that selects the inliers."""
        count, options = len(self.windows), self.options
        few = thinned(self.windows, _FIRST_TRACKS)
        if self.curve is None or self.fit is None:
            found, tracks = self._first_fit(few, options.intervals[0], options.prior)
            found = choose(found, tracks, options.intervals) if options.learn else found
        else:
            start = self.first + count - self.fresh
            ahead = self.motions[count - self.fresh :]
            last = span_of(self.first + count, self.shutter)[1]
            curve = continued(self.curve, ahead, start, last) if ahead else self.curve
            before, tracks = self.fit, self._pack(few, drift=self.fit.drift)
            found = fit(curve, tracks, before.prior, options.learn, before.tails, drift=before.drift)
        tracks = self._pack(self.windows, drift=found.drift)
        trust = right_tracks(found, tracks)
        if options.link:
            tracks = self._pack(self.windows, [trust[each] for each in tracks.members], found.drift)
        return fit(found.curve, tracks, found.prior, options.learn, found.tails, drift=found.drift), tracks

    def final(self, found: Fit, tracks: TimedTracks, count: int) -> Iterator[StreamedWindow]:
        """The results for the first ``count`` windows."""
        start, end = span_of(1, self.shutter)
        inverse = covariance_band(found, tracks)
        pairs = zip(tracks.members, self.windows, strict=True)
        right = [found.trust[members][: len(each.tracks)] > 0.0 for members, each in pairs]
        own = [self.first + k for k, each in enumerate(right) if is_supported(each, found.tails)]
        supported = [self._supported, *own]
        seen = _depths(found, tracks, right, self.rig)
        for number in range(self.first, self.first + count):
            inliers, depths = right[number - self.first], bool(seen[number - self.first])
            yield StreamedWindow(
                number=number,
                motion=ContinuousMotion.of(part(found.curve, number + start, number + end, float(number))),
                body_from_world=evaluate(found.curve, float(number))[0],
                covariance=motion_covariance(found.curve, inverse, float(number)) if depths else None,
                depths=depths,
                inliers=inliers,
                apart=min(abs(number - each) for each in supported),
                noise_px=noise_px(found.tails),
                gyro=self.gyro_found(found),
            )
        self._supported = max(each for each in supported if each < self.first + count)

    def marginalise(self, found: Fit, tracks: TimedTracks, count: int) -> None:
        """Drop the first ``count`` windows and marginalise their matches."""
        right = [found.trust[each] for each in tracks.members[:count]]
        dropped = self._pack(self.windows[:count], right if self.options.link else None)
        trust = np.zeros(len(dropped))
        for members, each in zip(dropped.members, right, strict=True):
            trust[members] = each
        curve = found.curve
        stays = self.first + count + span_of(0, self.shutter)[0]
        drop = max(int(np.floor((stays - curve.first) / curve.interval + 1e-9)), 0)
        first = curve.first + drop * curve.interval
        if self.gyro is not None and tracks.gyro is not None and found.drift is not None:
            begun = first - found.drift.shift
            dropped = replace(dropped, gyro=tracks.gyro.begun_before(begun))
            self.gyro = self.gyro.between(begun, np.inf)
        self.past = _marginal(found, dropped, trust, drop)
        self.curve = make_curve(first, curve.interval, curve.R[drop:], curve.p[drop:])
        self.fit = found
        self.windows, self.motions = self.windows[count:], self.motions[count:]
        self.first, self.fresh = self.first + count, 0


def _marginal(found: Fit, dropped: TimedTracks, trust: FloatArray, drop: int) -> Past:
    """The quadratic cost of the control poses from number ``drop`` on, with the earlier ones eliminated."""
    curve, smooth, drift = found.curve, found.prior.smooth, found.drift
    equations = normal_equations(curve, dropped, found.tails, found.prior, trust, until=drop, drift=drift)
    band, border = anchored(equations, curve, dropped, ANCHORED), equations.border
    ends = dropped.span[1]
    if dropped.gyro is not None and drift is not None:
        ends = np.concatenate([ends, dropped.gyro.end + drift.shift])
    latest = np.floor((ends - curve.first) / curve.interval)
    known = 0 if dropped.past is None else len(dropped.past.p)
    count = min(max(int(np.max(latest, initial=0)) + 4, drop + smooth + 2, known), len(curve.p))
    m, size = 6 * drop, 6 * count
    H, gradient = np.zeros((size, size)), equations.gradient[:size]
    for i in range(band.shape[1]):
        rows = np.arange(max(size - i, 0))
        H[rows + i, rows] = H[rows, rows + i] = band[: len(rows), i]
    if border is not None:
        H = np.block([[H, border.mixed[:size]], [border.mixed[:size].T, border.corner]])
        gradient = np.concatenate([gradient, border.slope])
    solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(H[:m, :m]), np.column_stack([H[:m, m:], gradient[:m]]))
    reduced = H[m:, m:] - H[m:, :m] @ solved[:, :-1]
    return Past(
        R=curve.R[drop:count],
        p=curve.p[drop:count],
        gradient=gradient[m:] - H[m:, :m] @ solved[:, -1],
        H=0.5 * (reduced + reduced.T),
        errors=None if drift is None else drift.errors,
    )
