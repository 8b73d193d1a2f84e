"""The readout ratio and scan of a rig or camera that shakes, from successive frames.

Such frames follow none of the motion models, and a ratio estimated under these is wrong (``shakes``). Two frames
do not show the ratio either: an arbitrary motion within the readout looks the same at any ratio. A sequence does:
the rig moves between readouts as it does within them, and at a wrong ratio it would have to change its speed with
every frame, at the frame rate. The ratio has a uniform prior, and its posterior is the evidence of the tracks:
their probability under a trajectory whose accelerations are as strong as the tracks show
(``trajectory_fit.log_evidence``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from rsbench.capture.hypotheses import scans_of
from rsbench.capture.shutter_decision import OPPOSITE, rig_of, shutter_found, shutter_of
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, TrajectoryOptions, noise_px
from rsbench.capture.trajectory_fit import Fit, choose, first_curve, fit, log_evidence, window_motions
from rsbench.capture.trajectory_spline import NotDefiniteError, span_of
from rsbench.capture.trajectory_tracks import Tails, TimedTracks, is_of_one_camera, pack_windows, thinned
from rsbench.capture.two_frame_estimate import (
    CERTAIN,
    MAX_SIGMA,
    Candidate,
    Capture,
    nearly_global,
)
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
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
        except NotDefiniteError:
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
    except NotDefiniteError:
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
            except NotDefiniteError:
                self._values[ratio] = _NOTHING
        return self._values[ratio]

    def climb(self, start: float) -> float:
        """From a ratio, by strides, to one with less evidence on both sides.

        Raises:
            NotDefiniteError: there is no fit at the first.
        """
        best = start
        if self.at(best) == _NOTHING:
            raise NotDefiniteError("no trajectory explains the tracks")
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


LONGEST = 12
"""Successive windows that are looked at, at most: what is left open then is less than what noise leaves."""
_TOGETHER = tuple(Scanning(scan=scan) for scan in ("top", "bottom", "left", "right"))


def capture_of_sequence(
    capture: Capture,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    scannings: Sequence[Scanning] | None = None,
    seed: int = 0,
) -> Capture:
    """The shutter from one trajectory through successive windows; motion models then have no part in it.

    Args:
        capture: what the motion models say, which is kept where no trajectory explains the tracks.
        windows: of the frames 0 and 1, 1 and 2, ...
        scannings: how the cameras may read; None: both alike, at once, from one of four sides, or as the motion
            models have it.
    """
    found = ratio_of_sequence(windows, rig, scannings or _scannings(capture), seed)
    if found is None:
        return capture
    candidate = _candidate(found, rig)
    # Nearly without a readout it is all the same where it begins.
    near = nearly_global(replace(capture, candidates=(replace(candidate, probability=1.0),)))
    candidate = candidate if near is None else near[0]
    doubt = ""
    if candidate.probability < CERTAIN or candidate.sigma > MAX_SIGMA:
        text = f"{candidate.ratio:.2f} +- {candidate.sigma:.2f}"
        doubt = f"{len(windows) + 1} frames in a row do not determine how fast: {text}"
    return replace(
        capture,
        candidates=(candidate,),
        models={},
        peaks={},
        reason=doubt,
        named=candidate.probability >= CERTAIN,
        windows=len(windows),
        matches=_matches(windows),
        used=found.used if is_of_one_camera(windows) else 2 * found.used,
        noise_px=found.noise_px,
    )


def shutter_of_sequence(windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> RollingShutter:
    """The shutter of cameras that read alike, from successive windows of any motion, of which some are looked at.

    Raises:
        NoMotionError: the matches do not tell it.
    """
    return shutter_found(capture_of_sequence(nothing_of(windows), windows[:LONGEST], rig, None, seed), rig)


def nothing_of(windows: Sequence[Correspondences]) -> Capture:
    """What is known of a shutter before anything is looked at."""
    pairs = [each.left if len(each.left) else each.tracks[:, [0, 1, 4, 5]] for each in windows]
    every = np.concatenate([*pairs, np.zeros((0, 4))])
    moved = float(np.median(np.linalg.norm(every[:, 2:] - every[:, :2], axis=1))) if len(every) else 0.0
    return Capture(
        candidates=(),
        models={},
        peaks={},
        reason="too few matches agree with any motion",
        named=False,
        windows=0,
        matches=0,
        used=0,
        noise_px=float("nan"),
        moved_px=moved,
    )


def _matches(windows: Sequence[Correspondences]) -> int:
    return sum(len(each.left) if is_of_one_camera(windows) else 2 * len(each.tracks) for each in windows)


def _scannings(capture: Capture) -> tuple[Scanning, ...]:
    best = capture.likeliest
    if best is None or best.scans.together or "global" in astuple(best.scans):
        return _TOGETHER
    return *_TOGETHER, Scanning(scan=best.scans.left, right_scan=best.scans.right)  # pyrefly: ignore[bad-argument-type]


def _candidate(found: SequenceRatio, rig: StereoRig) -> Candidate:
    shutter = found.scanning.shutter_of(rig.camera.width, rig.camera.height, 1.0)
    return Candidate(
        scans=scans_of(shutter),
        probability=found.probability,
        ratio=found.ratio,
        sigma=found.sigma,
        delay=found.scanning.right_delay,
        delay_sigma=0.0,
    )


SUCCESSIVE = 6
"""Windows that are looked at."""
_CHECKED_TRACKS = 200
"""Of each window, at most."""
_FAR_BETTER = 0.8
"""Scale of the errors about a trajectory over that about motion models, below which these are wrong."""


def shakes(capture: Capture, windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> bool:
    """Whether a trajectory through successive windows leaves far smaller errors than the motion models did."""
    best = capture.likeliest
    if best is None or not best.scans.rolls or "global" in (best.scans.left, best.scans.right):
        return False
    shutter, options = shutter_of(best, rig), TrajectoryOptions()
    few = [Correspondences(tracks=each.tracks[:: max(len(each.tracks) // _CHECKED_TRACKS, 1)]) for each in windows]
    tracks = pack_windows(few, rig, shutter)
    motions = window_motions(few, rig, shutter, seed)
    curve = first_curve(motions, tracks, span_of(len(few), shutter), options.intervals[0])
    try:
        found = fit(curve, tracks, options.prior)
    except NotDefiniteError:
        return False
    return found.tails.scale < _FAR_BETTER * capture.noise_px


def capture_along(
    windows: Sequence[FloatArray], camera: PinholeCamera, scan: Scan | None, seed: int = 0
) -> Capture | None:
    """What successive frames say along one way, however they shake; None where no way explains the matches.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, of the frames 0 and 1, 1 and 2, ...; with outliers.
        scan: as of ``known_alone``.
    """
    given, said = [Correspondences(left=each) for each in windows], scan or "top"
    scannings = Scanning(scan=said), Scanning(scan=OPPOSITE[said])
    found = capture_of_sequence(nothing_of(given), given, rig_of(camera), scannings, seed)
    return found if found.candidates else None
