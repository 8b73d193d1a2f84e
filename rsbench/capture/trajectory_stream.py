"""The trajectory of a sequence without end: some frames at a time, in memory that stays the same.

What matches say that leave the memory is kept as a quadratic cost of the control poses that stay (marginalisation:
G. Sibley, L. Matthies, G. Sukhatme, Sliding window filter with application to planetary landing, J. Field Robotics
2010). Knots and the memory of the prior are those of the first frames; its variances follow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from rsbench.capture.trajectory_choice import choose
from rsbench.capture.trajectory_covariance import motion_covariance
from rsbench.capture.trajectory_data import Past, TimedTracks, pack_windows, telling, thinned
from rsbench.capture.trajectory_estimate import TrajectoryOptions, is_supported, noise_px
from rsbench.capture.trajectory_fit import (
    ANCHORED,
    Fit,
    covariance_band,
    fit,
    held,
    normal_equations,
    right_tracks,
)
from rsbench.capture.trajectory_gyro import Drift, GyroFound, GyroSteps, contradicts, gyro_steps
from rsbench.capture.trajectory_spline import ContinuousMotion, Curve, evaluate, make_curve, part, span_of
from rsbench.capture.trajectory_start import continued, first_curve, window_motions
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray

_ADVANCE, _LAG = 6, 5
"""Windows that leave together, and those behind them that they wait for."""
_FAR = 1_000_000
_JUDGED_BY = 250
"""Tracks of a window, about, by which knots and prior are chosen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StreamedWindow:
    """Two successive frames of a sequence; all that is said of them is final."""

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
    """Windows to the nearest one that its own tracks carry, of those seen so far; 0: it is one itself."""
    noise_px: float
    gyro: GyroFound | None
    """What is known of a gyroscope by then; None: there is none."""

    @property
    def supported(self) -> bool:
        """Whether its own tracks carry it; else the spline bridges it."""
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
            yield from state.told(found, tracks, _ADVANCE)
            state.leave(found, tracks, _ADVANCE)
    if state.windows:
        yield from state.told(*state.solve(), len(state.windows))


class _State:
    """What is remembered: the windows since the last that left, and what those said that have."""

    def __init__(
        self, rig: StereoRig, shutter: RollingShutter, options: TrajectoryOptions, gyro: GyroSteps | None
    ) -> None:
        self.rig, self.shutter, self.options = rig, shutter, options
        self.gyro = gyro
        """Of the windows that are remembered and of later ones."""
        self.unlike: GyroFound | None = None
        """One that contradicted the matches."""
        self.windows, self.motions = list[Correspondences](), list[Motion | None]()
        self.first = self.fresh = 0
        self.curve: Curve | None = None
        self.past: Past | None = None
        self.fit: Fit | None = None
        self._carried = -_FAR
        """Number of the last window that its own tracks carry, of those that have left."""

    def add(self, window: Correspondences, motion: Motion | None) -> None:
        self.windows.append(telling(window))
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
        # What has left with earlier windows is no more looked at, wherever a clock puts it by now.
        shift = 0.0 if drift is None else drift.shift
        first = span_of(0, self.shutter)[0] - shift if self.curve is None else -np.inf
        last = span_of(self.first + len(windows), self.shutter)[1] - shift
        return replace(tracks, gyro=self.gyro.between(first, last))

    def solve(self) -> tuple[Fit, TimedTracks]:
        """The spline of all that is remembered; a gyroscope that contradicts the matches is forgotten."""
        found, tracks = self._solved()
        if tracks.gyro is None or found.drift is None or not contradicts(tracks.gyro, found.drift):
            return found, tracks
        self.gyro, self.unlike = None, GyroFound.of(found.drift, used=False)
        self.past = None if self.past is None else self.past.without_gyro()
        self.fit = None if self.fit is None else replace(self.fit, drift=None)
        return self._solved()

    def _solved(self) -> tuple[Fit, TimedTracks]:
        """Some of the tracks say first which are right."""
        count, options = len(self.windows), self.options
        few = thinned(self.windows, _JUDGED_BY)
        if self.curve is None or self.fit is None:
            found = self._begun(few)
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

    def _begun(self, few: Sequence[Correspondences]) -> Fit:
        """The first spline: some of the tracks say which knots and which prior."""
        options, tracks = self.options, self._pack(few)
        curve = first_curve(self.motions, tracks, span_of(len(few), self.shutter), options.intervals[0])
        found = fit(curve, tracks, options.prior, options.learn)
        return choose(found, tracks, options.intervals) if options.learn else found

    def told(self, found: Fit, tracks: TimedTracks, count: int) -> Iterator[StreamedWindow]:
        """The first so many windows."""
        start, end = span_of(1, self.shutter)
        inverse = covariance_band(found, tracks)
        windows = enumerate(self.windows)
        right = [found.trust[tracks.members[k]][: len(each.tracks)] > 0.0 for k, each in windows]
        carried = [
            self._carried,
            *(self.first + k for k, each in enumerate(right) if is_supported(each, found.tails)),
        ]
        for k in range(count):
            number = self.first + k
            yield StreamedWindow(
                number=number,
                motion=ContinuousMotion.of(part(found.curve, number + start, number + end, float(number))),
                body_from_world=evaluate(found.curve, float(number))[0],
                covariance=motion_covariance(found.curve, inverse, float(number)),
                inliers=right[k],
                apart=min(abs(number - each) for each in carried),
                noise_px=noise_px(found.tails),
                gyro=self.unlike if found.drift is None else GyroFound.of(found.drift),
            )
        self._carried = max(each for each in carried if each < self.first + count)

    def leave(self, found: Fit, tracks: TimedTracks, count: int) -> None:
        """Forget the first so many windows, but for what they say of those that stay."""
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
    """What tracks say of the control poses from number ``drop`` on, whatever those before are."""
    curve, smooth, drift = found.curve, found.prior.smooth, found.drift
    equations = normal_equations(curve, gone, found.tails, found.prior, trust, until=drop, drift=drift)
    band, border = held(equations, curve, gone, ANCHORED), equations.border
    ends = gone.span[1]
    if gone.gyro is not None and drift is not None:
        ends = np.concatenate([ends, gone.gyro.end + drift.shift])
    latest = np.floor((ends - curve.first) / curve.interval)
    known = 0 if gone.past is None else len(gone.past.p)
    count = min(max(int(np.max(latest, initial=0)) + 4, drop + smooth + 2, known), len(curve.p))
    m, size = 6 * drop, 6 * count
    H, gradient = _dense(band, size), equations.gradient[:size]
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


def _dense(band: FloatArray, size: int) -> FloatArray:
    """The first rows and columns (size, size) of a matrix."""
    H = np.zeros((size, size))
    for i in range(band.shape[1]):
        rows = np.arange(max(size - i, 0))
        H[rows + i, rows] = H[rows, rows + i] = band[: len(rows), i]
    return H
