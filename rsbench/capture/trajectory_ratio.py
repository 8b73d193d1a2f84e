"""The readout ratio of a rig that shakes, from successive frames of it.

Frames of such a rig follow none of the motion models, and two of them show no ratio: an arbitrary motion within
the readout looks the same at any. A sequence shows it: the rig goes on between readouts as it did within them, and
at a wrong ratio it would have to change its speed with every frame, at the frames' own rate. The ratio is that of
most evidence: of the probability of the tracks under a trajectory whose accelerations are as strong as the tracks
say (``trajectory_fit.log_evidence``), with all ratios equally likely before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rsbench.capture import trajectory_banded as banded
from rsbench.capture.trajectory_choice import choose
from rsbench.capture.trajectory_data import TimedTracks, is_of_one_camera, pack_windows, thinned
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, TrajectoryOptions, noise_px
from rsbench.capture.trajectory_fit import Fit, fit, log_evidence
from rsbench.capture.trajectory_kernels import Tails
from rsbench.capture.trajectory_spline import span_of
from rsbench.capture.trajectory_start import first_curve, window_motions
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray

_FIRST, _COARSE, _LEAST = 0.6, 0.15, 0.02
"""Where the search starts, its stride, and the least ratio that counts as one."""
_KNOTS = 0.25
"""Frame periods between control poses to begin with: fine ones, for at a wrong ratio the way is rough."""
_WIDE = Tails(3.0, 0.3)
"""Errors, px, of the search for the right stride: under those that refined matches have, a ratio that is far off
is a fit of something else."""
_FEWEST, _SOME, _TRACKS = 15, 60, 150
"""Tracks of a window, about: below which nothing is told, to tell the scanning, and the ratio."""
_SHARES_ALONE = 0.5, 0.15
"""What a match of one camera's dense flow counts, to tell the scanning, and the ratio: neighbours err alike.
Counted for one each, ratios of ten pieces of rendered video were off by 2.6 of their deviations (root of the mean
square)."""
_LEAST_SHARE = 0.2
"""Of the tracks must be right."""
_PRECISION = 1e12
_STEP, _STEPS, _ROUGH_STEPS = 0.05, 6, 2
_NODES = np.array([-2.5, -1.2, 0.0, 1.2, 2.5])
"""Deviations from the peak at which the evidence is summed."""
_NOTHING = -1e12
"""Logarithm of evidence where there is no fit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceRatio:
    """What successive frames say of a readout ratio."""

    scanning: Scanning
    """Of those that were asked for, the one of most evidence."""
    probability: float
    """Of it, each as likely before."""
    ratio: float
    """Its mean."""
    sigma: float
    """Its standard deviation."""
    noise_px: float
    used: int
    """Tracks that are right."""
    of: int
    fit: Fit
    """Of a ratio near the mean."""


def ratio_of_sequence(
    windows: Sequence[Correspondences], rig: StereoRig, scannings: Sequence[Scanning], seed: int = 0
) -> SequenceRatio | None:
    """How cameras read that read in one of several ways; None where no trajectory explains the tracks.

    Args:
        windows: of the frames 0 and 1, 1 and 2, ...; with outliers.
        seed: of the search for motions of single windows.
    """
    alone = is_of_one_camera(windows)
    if sum(len(each.left if alone else each.tracks) for each in windows) < _FEWEST * len(windows):
        return None
    few, found = thinned(windows, _SOME), dict[int, tuple[float, float]]()
    rough, fine = _SHARES_ALONE if alone else (1.0, 1.0)
    for number, scanning in enumerate(scannings):
        profile = _Profile(few, rig, scanning, rough)
        try:
            profile.begin(_FIRST, seed)
            ratio = profile.climb(_FIRST)
        except banded.NotDefiniteError:
            continue
        found[number] = profile.at(ratio), ratio
    if not found:
        return None
    best = max(found, key=lambda each: found[each][0])
    others = sum(np.exp(found[each][0] - found[best][0]) for each in found)
    profile, ratio = _Profile(thinned(windows, _TRACKS), rig, scannings[best], fine), found[best][1]
    try:
        profile.begin(ratio, seed)
        profile.settle(_peak(profile, ratio, _ROUGH_STEPS)[0])
        told = _told(profile, *_peak(profile, profile.settled), 1.0 / float(others))
    except banded.NotDefiniteError:
        return None
    # Of wrong matches, a way explains two or three exactly, or all of them by a noise that is none.
    return told if told.used >= _LEAST_SHARE * told.of and told.noise_px <= MOST_NOISE_PX else None


class _Profile:
    """Evidence of ratios, of the same tracks under the same tails."""

    def __init__(
        self, windows: Sequence[Correspondences], rig: StereoRig, scanning: Scanning, share: float
    ) -> None:
        self._windows, self._rig, self._share = windows, rig, share
        self._fits = dict[float, Fit]()
        self._values = dict[float, float]()
        self._near: Fit | None = None
        self.scanning, self.settled = scanning, _FIRST

    def _shutter(self, ratio: float) -> RollingShutter:
        camera = self._rig.camera
        return self.scanning.shutter_of(camera.width, camera.height, ratio)

    def tracks(self, ratio: float) -> TimedTracks:
        return pack_windows(self._windows, self._rig, self._shutter(ratio), share=self._share)

    @property
    def near(self) -> Fit:
        """The fit that tails and tracks are taken from."""
        assert self._near is not None
        return self._near

    def begin(self, ratio: float, seed: int) -> None:
        """A first fit at a ratio, from motions of the windows."""
        shutter, options, tracks = self._shutter(ratio), TrajectoryOptions(), self.tracks(ratio)
        motions = window_motions(self._windows, self._rig, shutter, seed)
        # The same knots whatever the ratio: what no track feels adds the same to all.
        span = span_of(len(self._windows), self._shutter(1.0))
        curve = first_curve(motions, tracks, span, _KNOTS)
        self._near = fit(curve, tracks, options.prior, True, _WIDE, np.ones(len(tracks)))

    def settle(self, ratio: float) -> None:
        """Tails, tracks that are right and kind of prior, as they are at a ratio.

        Knots stay fine: that a way is smooth is for the prior to say, and coarse knots would say it at all costs.
        """
        tracks, last = self.tracks(ratio), self.fit_near(ratio)
        self._near = choose(fit(last.curve, tracks, last.prior, tails=last.tails), tracks, ())
        self._fits.clear()
        self._values.clear()
        self.settled = ratio

    def at(self, ratio: float) -> float:
        """Logarithm of evidence."""
        if ratio not in self._values:
            start = self.near
            if self._fits:
                start = self._fits[min(self._fits, key=lambda other: abs(other - ratio))]
            try:
                found = fit(start.curve, self.tracks(ratio), start.prior, True, start.tails, start.trust)
                self._fits[ratio], self._values[ratio] = found, log_evidence(found, _PRECISION)
            except banded.NotDefiniteError:
                self._values[ratio] = _NOTHING
        return self._values[ratio]

    def climb(self, start: float) -> float:
        """From a ratio, by strides, to one with less evidence on both sides.

        Raises:
            NotDefiniteError: there is no fit at the first.
        """
        best = start
        if self.at(best) == _NOTHING:
            raise banded.NotDefiniteError("no trajectory explains the tracks")
        for way in (-1.0, 1.0):
            while True:
                other = float(np.clip(best + way * _COARSE, _LEAST, 1.0))
                if other == best or self.at(other) <= self.at(best):
                    break
                best = other
        return best

    def fit_near(self, ratio: float) -> Fit:
        return self._fits[min(self._fits, key=lambda other: abs(other - ratio))]


def _peak(profile: _Profile, start: float, steps: int = _STEPS) -> tuple[float, float]:
    """Where the evidence is largest, and its deviation: parabolas through three ratios, ever closer."""
    best, step = start, _STEP
    sigma = step
    for number in range(steps):
        low, high = max(best - step, _LEAST), min(best + step, 1.0)
        middle = 0.5 * (low + high)
        values = [profile.at(each) for each in (low, middle, high)]
        half = 0.5 * (high - low)
        bend = (2.0 * values[1] - values[0] - values[2]) / half**2
        if bend <= 0.0:
            best = (low, middle, high)[int(np.argmax(values))]
            continue
        sigma = bend**-0.5
        moved = float(np.clip(middle + 0.5 * (values[2] - values[0]) / half / bend, _LEAST, 1.0))
        near = abs(moved - best) < 0.3 * sigma
        best, step = moved, float(np.clip(sigma, 0.002, 0.1))
        if near and number > 1:
            break
    return best, sigma


def _told(profile: _Profile, peak: float, sigma: float, probability: float) -> SequenceRatio:
    """Mean and deviation of the evidence over all ratios, each as likely before."""
    ratios = np.unique(np.clip(peak + sigma * _NODES, _LEAST, 1.0))
    values = np.array([profile.at(each) for each in ratios])
    top = float(np.max(values))
    fine = np.linspace(ratios[0], ratios[-1], 601)
    density = np.exp(_smooth(ratios, values, fine) - top)
    total = float(np.trapezoid(density, fine))
    mean = float(np.trapezoid(density * fine, fine)) / total
    spread = float(np.sqrt(np.trapezoid(density * (fine - mean) ** 2, fine) / total))
    found = profile.fit_near(mean)
    return SequenceRatio(
        scanning=profile.scanning,
        probability=probability,
        ratio=mean,
        sigma=spread,
        noise_px=noise_px(found.tails),
        used=int(np.count_nonzero(found.trust)),
        of=len(found.trust),
        fit=found,
    )


def _smooth(x: FloatArray, y: FloatArray, at: FloatArray) -> FloatArray:
    """A curve without overshoot through values (n,) at places (n,)."""
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(x, y)(at)) if len(x) > 1 else np.full(len(at), y[0])
