"""The trajectory of a rig through a sequence, from the matches of neighbouring frames: at once, or as a stream.

Two frames do not show a shake that is the same in both; a sequence does, for its windows overlap. The trajectory
is a spline of largest posterior probability (``trajectory_fit``) under tracks with heavy-tailed errors and a prior
on accelerations, whose strength is estimated from the matches.

``stream_trajectory`` takes a sequence without end, some frames at a time, in constant memory. Matches that leave
the memory are kept as a quadratic cost of the control poses that stay (marginalisation: G. Sibley, L. Matthies, G.
Sukhatme, Sliding window filter with application to planetary landing, J. Field Robotics 2010). Knots and the
memory of the prior are those of the first frames; its variances are updated.
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
from rsbench.capture.trajectory_tracks import Past, Tails, TimedTracks, informative, pack_windows, thinned
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_ONE_SIGMA = 0.8413447460685429
_JUDGED = 8
"""First windows, from which knots and prior are chosen."""
_FEWEST, _LEAST_SHARE = 15, 0.2
"""Right tracks, and their share, from which on a window is supported by its own matches."""
MOST_NOISE_PX = 10.0
"""Larger errors are no noise: random tracks leave some 20 px, and at that scale most of them count as right."""
_ADVANCE, _LAG = 6, 5
"""Windows that leave a stream together, and later windows that they wait for."""
_FAR = 1_000_000
_JUDGED_BY = 250
"""Tracks of a window, about, by which knots and prior of a stream are chosen."""


@dataclass(frozen=True, kw_only=True)
class TrajectoryOptions:
    """How a trajectory is estimated."""

    intervals: tuple[float, ...] = (1 / 2, 1 / 3, 1 / 4)
    """Frame periods between two control poses: the first one to begin with, then those of most evidence."""
    prior: Prior = Prior(memory=0.5, smooth=2, rotation=1e-4, position=1e-4)  # noqa: RUF009
    """To begin with."""
    learn: bool = True
    """Whether the prior and the knots are estimated."""
    link: bool = True
    """Whether tracks that meet in a frame are one; without it their common ends count as two."""
    share: float = 0.5
    """Weight of a track beside the prior. Patches of neighbouring tracks overlap and have common errors: with a
    weight of 1, the common errors of a still hand are estimated as accelerations."""
    seed: int = 0
    """Of the search for motions of single windows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """What the rig did, seen from the body at time 0."""

    motion: ContinuousMotion
    """body_from_world at any time of the sequence, frame periods."""
    shutter: RollingShutter
    """Given or estimated."""
    noise_px: float
    """Of a coordinate, as of a normal error: two in three are below it."""
    nu: float
    """Degrees of freedom of the tails; 30 is as good as normal."""
    prior: Prior
    inliers: tuple[BoolArray, ...]
    """For each window, which of its tracks are right."""
    supported: BoolArray
    """(windows,) whether a window's own tracks support it; elsewhere the spline bridges it."""
    fit: Fit
    covariance_band: FloatArray
    """Of the control poses, see ``trajectory_spline``."""
    gyro: GyroFound | None = None
    """What was estimated of a gyroscope; None: none was given."""

    @property
    def curve(self) -> Curve:
        """The spline."""
        return self.fit.curve

    @property
    def interval(self) -> float:
        """Frame periods between two control poses."""
        return self.motion.interval

    def window(self, number: int) -> Motion:
        """The motion seen from the body at the start of a frame, which is time 0."""
        return self.motion.from_time(float(number))

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
        motions: of each window, to begin with; None: a search finds them.
        seed: of that search, where there are no options.
        gyro: (n, 4) samples as of ``Correspondences.gyro``, tau of the sequence; bias and noise are estimated.

    Raises:
        ValueError: no windows, or no tracks in any.
    """
    options, windows = options or TrajectoryOptions(seed=seed), [informative(each) for each in windows]
    if not any(len(window.tracks) for window in windows):
        raise ValueError("a trajectory needs tracks: matches of both cameras over time")
    if motions is None:
        motions = window_motions(windows, rig, shutter, options.seed)
    inputs = _Inputs(windows, rig, shutter, motions, options, None if gyro is None else gyro_steps(gyro))
    found, tracks = inputs.fitted()
    used = None if found.drift is None else GyroFound.of(found.drift)
    if tracks.gyro is not None and found.drift is not None and contradicts(tracks.gyro, found.drift):
        used = GyroFound.of(found.drift, used=False)
        found, tracks = replace(inputs, gyro=None).fitted()
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
        covariance_band=covariance_band(found, tracks),
        gyro=used,
    )


@dataclass(frozen=True)
class _Inputs:
    """What a trajectory is estimated from."""

    windows: Sequence[Correspondences]
    rig: StereoRig
    shutter: RollingShutter
    motions: Sequence[Motion | None]
    options: TrajectoryOptions
    gyro: GyroSteps | None

    def fitted(self) -> tuple[Fit, TimedTracks]:
        """The spline, and the tracks that it was fitted to."""
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
        """The spline of the first windows, and their tracks."""
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


def noise_px(tails: Tails) -> float:
    """Of a coordinate, as of a normal error: two in three are below it."""
    return tails.scale * float(scipy.special.stdtrit(tails.nu, _ONE_SIGMA))


def is_supported(inliers: BoolArray, tails: Tails) -> bool:
    """Whether tracks (n,), some of them right, support their window."""
    enough = np.count_nonzero(inliers) >= max(_FEWEST, _LEAST_SHARE * len(inliers))
    return bool(enough and noise_px(tails) <= MOST_NOISE_PX)


# Streams


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamedWindow:
    """Two successive frames of a sequence; every value is final."""

    number: int
    motion: ContinuousMotion
    """Seen from the body at the start of the first frame, which is time 0; right for both frames."""
    body_from_world: Pose
    """Of that time; the world is the body at time 0 of the sequence."""
    inliers: BoolArray
    """(n,) which tracks are right."""
    covariance: FloatArray | None
    """(6, 6) of w and d of ``motion``; None where no track spans a period."""
    apart: int
    """Windows to the nearest supported one of those seen so far; 0: this one is supported."""
    noise_px: float
    gyro: GyroFound | None
    """What is known of a gyroscope by then; None: there is none."""

    @property
    def supported(self) -> bool:
        """Whether its own tracks support it; else the spline bridges it."""
        return self.apart == 0


def stream_trajectory(
    windows: Iterable[Correspondences],
    rig: StereoRig,
    shutter: RollingShutter,
    seed: int = 0,
    options: TrajectoryOptions | None = None,
    gyro: FloatArray | None = None,
) -> Iterator[StreamedWindow]:
    """As ``estimate_trajectory``, for windows that come one after the other.

    Args:
        seed: of the search for motions of single windows, where there are no options.
        gyro: (n, 4) samples as of ``Correspondences.gyro``, tau of the sequence.
    """
    options = options or TrajectoryOptions(seed=seed)
    state = _State(rig, shutter, options, None if gyro is None else gyro_steps(gyro))
    for window in windows:
        state.add(window, *window_motions([window], rig, shutter, options.seed))
        if len(state.windows) == _ADVANCE + _LAG:
            found, tracks = state.solve()
            yield from state.final(found, tracks, _ADVANCE)
            state.leave(found, tracks, _ADVANCE)
    if state.windows:
        yield from state.final(*state.solve(), len(state.windows))


class _State:
    """The memory of a stream: the windows since the last that left, and a summary of those that have left."""

    def __init__(
        self, rig: StereoRig, shutter: RollingShutter, options: TrajectoryOptions, gyro: GyroSteps | None
    ) -> None:
        self.rig, self.shutter, self.options = rig, shutter, options
        self.gyro = gyro
        """Of the windows in memory and of later ones."""
        self.unlike: GyroFound | None = None
        """One that contradicted the matches."""
        self.windows, self.motions = list[Correspondences](), list[Motion | None]()
        self.first = self.fresh = 0
        self.curve: Curve | None = None
        self.past: Past | None = None
        self.fit: Fit | None = None
        self._supported = -_FAR
        """Number of the last supported window of those that have left."""

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
        # Samples that have left with earlier windows are not used again, wherever a clock puts them by now.
        shift = 0.0 if drift is None else drift.shift
        first = span_of(0, self.shutter)[0] - shift if self.curve is None else -np.inf
        last = span_of(self.first + len(windows), self.shutter)[1] - shift
        return replace(tracks, gyro=self.gyro.between(first, last))

    def solve(self) -> tuple[Fit, TimedTracks]:
        """The spline of all windows in memory; a gyroscope that contradicts the matches is dropped."""
        found, tracks = self._solved()
        if tracks.gyro is None or found.drift is None or not contradicts(tracks.gyro, found.drift):
            return found, tracks
        self.gyro, self.unlike = None, GyroFound.of(found.drift, used=False)
        self.past = None if self.past is None else self.past.without_gyro()
        self.fit = None if self.fit is None else replace(self.fit, drift=None)
        return self._solved()

    def _solved(self) -> tuple[Fit, TimedTracks]:
        """A first fit to some of the tracks shows which are right."""
        count, options = len(self.windows), self.options
        few = thinned(self.windows, _JUDGED_BY)
        if self.curve is None or self.fit is None:
            tracks = self._pack(few)
            curve = first_curve(self.motions, tracks, span_of(count, self.shutter), options.intervals[0])
            found = fit(curve, tracks, options.prior, options.learn)
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
        """The first ``count`` windows."""
        start, end = span_of(1, self.shutter)
        inverse = covariance_band(found, tracks)
        pairs = zip(tracks.members, self.windows, strict=True)
        right = [found.trust[members][: len(each.tracks)] > 0.0 for members, each in pairs]
        own = [self.first + k for k, each in enumerate(right) if is_supported(each, found.tails)]
        supported = [self._supported, *own]
        for number in range(self.first, self.first + count):
            yield StreamedWindow(
                number=number,
                motion=ContinuousMotion.of(part(found.curve, number + start, number + end, float(number))),
                body_from_world=evaluate(found.curve, float(number))[0],
                covariance=motion_covariance(found.curve, inverse, float(number)),
                inliers=right[number - self.first],
                apart=min(abs(number - each) for each in supported),
                noise_px=noise_px(found.tails),
                gyro=self.unlike if found.drift is None else GyroFound.of(found.drift),
            )
        self._supported = max(each for each in supported if each < self.first + count)

    def leave(self, found: Fit, tracks: TimedTracks, count: int) -> None:
        """Drop the first ``count`` windows, except for what they determine of those that stay."""
        right = [found.trust[each] for each in tracks.members[:count]]
        gone = self._pack(self.windows[:count], right if self.options.link else None)
        trust = np.zeros(len(gone))
        for members, each in zip(gone.members, right, strict=True):
            trust[members] = each
        curve = found.curve
        stays = self.first + count + span_of(0, self.shutter)[0]
        drop = max(int(np.floor((stays - curve.first) / curve.interval + 1e-9)), 0)
        first = curve.first + drop * curve.interval
        if self.gyro is not None and tracks.gyro is not None and found.drift is not None:
            begun = first - found.drift.shift
            gone = replace(gone, gyro=tracks.gyro.begun_before(begun))
            self.gyro = self.gyro.between(begun, np.inf)
        self.past = _marginal(found, gone, trust, drop)
        self.curve = make_curve(first, curve.interval, curve.R[drop:], curve.p[drop:])
        self.fit = found
        self.windows, self.motions = self.windows[count:], self.motions[count:]
        self.first, self.fresh = self.first + count, 0


def _marginal(found: Fit, gone: TimedTracks, trust: FloatArray, drop: int) -> Past:
    """What tracks determine of the control poses from number ``drop`` on, whatever those before are."""
    curve, smooth, drift = found.curve, found.prior.smooth, found.drift
    equations = normal_equations(curve, gone, found.tails, found.prior, trust, until=drop, drift=drift)
    band, border = anchored(equations, curve, gone, ANCHORED), equations.border
    ends = gone.span[1]
    if gone.gyro is not None and drift is not None:
        ends = np.concatenate([ends, gone.gyro.end + drift.shift])
    latest = np.floor((ends - curve.first) / curve.interval)
    known = 0 if gone.past is None else len(gone.past.p)
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
