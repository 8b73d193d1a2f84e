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
from rsbench.capture.shutter_decision import OPPOSITE, shutter_found, shutter_of
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, TrajectoryOptions, noise_px
from rsbench.capture.trajectory_fit import Fit, choose, first_curve, fit, log_evidence, window_motions
from rsbench.capture.trajectory_spline import NotDefiniteError, span_of
from rsbench.capture.trajectory_tracks import Tails, TimedTracks, is_of_one_camera, pack_windows, thinned
from rsbench.capture.two_frame_estimate import CERTAIN, MAX_SIGMA, Candidate, Capture, nearly_global
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray

LONGEST = 12
"""Successive windows that are used, at most: more would reduce the error by less than noise leaves."""
SUCCESSIVE = 6
"""Windows by which ``shakes`` decides."""
_CHECKED_TRACKS = 200
"""Of each of them, at most."""
_FAR_BETTER = 0.8
"""Scale of the errors about a trajectory over that about motion models, below which these are wrong."""
_TOGETHER = tuple(Scanning(scan=scan) for scan in ("top", "bottom", "left", "right"))
_FIRST, _COARSE, _LEAST = 0.6, 0.15, 0.02
"""Where the search starts, its stride, and the least ratio of a rolling shutter."""
_KNOTS = 0.25
"""Frame periods between control poses to begin with: fine ones, because at a wrong ratio the trajectory is
rough."""
_WIDE = Tails(3.0, 0.3)
"""Errors, px, of the search for the right stride: with the errors of refined matches, a ratio that is far off fits
something else."""
_FEWEST, _SOME, _TRACKS = 15, 60, 150
"""Tracks of a window, about: fewest for an estimate, to estimate the scanning, and the ratio."""
_SHARES_OF_ONE_CAMERA = 0.5, 0.15
"""Weight of a match of one camera's dense flow, to estimate the scanning, and the ratio: neighbours have common
errors. With a weight of 1, ratios of ten pieces of rendered video were off by 2.6 of their deviations (root of the
mean square)."""
_LEAST_SHARE = 0.2
"""Of the tracks must be right."""
_PRECISION = 1e12
_STEP, _STEPS, _ROUGH_STEPS = 0.05, 6, 2
_NODES = np.array([-2.5, -1.2, 0.0, 1.2, 2.5])
"""Deviations from the peak at which the evidence is summed."""
_NOTHING = -1e12
"""Logarithm of evidence where there is no fit."""


def shakes(capture: Capture, windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> bool:
    """Whether a trajectory through successive windows leaves far smaller errors than the motion models did.

    A spline follows any motion that is slow against its knots, whatever the ratio.
    """
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


def capture_of_sequence(
    capture: Capture,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    scannings: Sequence[Scanning] | None = None,
    seed: int = 0,
) -> Capture:
    """The shutter from one trajectory through successive windows, without motion models.

    Args: capture: the one under motion models, which is returned where no trajectory explains the tracks. windows:
    of the frames 0 and 1, 1 and 2, ... scannings: how the cameras may read; None: both alike, at once, from one of
    four sides, or as in ``capture``.
    """
    if scannings is None:
        best, scannings = capture.likeliest, _TOGETHER
        if best is not None and not best.scans.together and "global" not in astuple(best.scans):
            own = Scanning(scan=best.scans.left, right_scan=best.scans.right)  # pyrefly: ignore[bad-argument-type]
            scannings = (*_TOGETHER, own)
    found = ratio_of_sequence(windows, rig, scannings, seed)
    if found is None:
        return capture
    candidate = Candidate(
        scans=scans_of(rig.shutter_of(found.scanning, 1.0)),
        probability=found.probability,
        ratio=found.ratio,
        sigma=found.sigma,
        delay=found.scanning.right_delay,
        delay_sigma=0.0,
    )
    # Nearly without a readout it is all the same where it begins.
    near = nearly_global(replace(capture, candidates=(replace(candidate, probability=1.0),)))
    candidate, doubt = candidate if near is None else near[0], ""
    if candidate.probability < CERTAIN or candidate.sigma > MAX_SIGMA:
        text = f"{candidate.ratio:.2f} +- {candidate.sigma:.2f}"
        doubt = f"{len(windows) + 1} frames in a row do not determine how fast: {text}"
    alone = is_of_one_camera(windows)
    return Capture(
        candidates=(candidate,),
        reason=doubt,
        named=candidate.probability >= CERTAIN,
        windows=len(windows),
        matches=sum(len(each.left) if alone else 2 * len(each.tracks) for each in windows),
        used=found.used if alone else 2 * found.used,
        noise_px=found.noise_px,
        moved_px=capture.moved_px,
    )


def shutter_of_sequence(windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> RollingShutter:
    """The shutter of cameras that read alike, from the first successive windows of any motion.

    Raises:
        NoMotionError: the matches do not determine it.
    """
    return shutter_found(capture_of_sequence(_nothing_of(windows), windows[:LONGEST], rig, None, seed), rig)


def capture_of_video(
    windows: Sequence[FloatArray], camera: PinholeCamera, scan: Scan | None, seed: int = 0
) -> Capture | None:
    """The shutter of one camera from a trajectory through successive frames; None where none explains the matches.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, of the frames 0 and 1, 1 and 2, ...; with outliers.
        scan: as in ``known_alone``.
    """
    matches, scan = [Correspondences(left=each) for each in windows], scan or "top"
    scannings = Scanning(scan=scan), Scanning(scan=OPPOSITE[scan])
    found = capture_of_sequence(_nothing_of(matches), matches, StereoRig.of_one(camera), scannings, seed)
    return found if found.candidates else None


def _nothing_of(windows: Sequence[Correspondences]) -> Capture:
    """A capture before anything is estimated."""
    pairs = [each.left if len(each.left) else each.tracks[:, [0, 1, 4, 5]] for each in windows]
    every = np.concatenate([*pairs, np.zeros((0, 4))])
    moved = float(np.median(np.linalg.norm(every[:, 2:] - every[:, :2], axis=1))) if len(every) else 0.0
    return Capture(reason="too few matches agree with any motion", matches=0, moved_px=moved)


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceRatio:
    """A readout ratio from successive frames."""

    scanning: Scanning
    """The one of most evidence."""
    probability: float
    """Of the scanning, with equal prior probabilities."""
    ratio: float
    sigma: float
    noise_px: float
    used: int
    """Tracks that are right."""
    of: int


def ratio_of_sequence(
    windows: Sequence[Correspondences], rig: StereoRig, scannings: Sequence[Scanning], seed: int = 0
) -> SequenceRatio | None:
    """How cameras read, by one of several scannings; None where no trajectory explains the tracks.

    Args:
        windows: of the frames 0 and 1, 1 and 2, ...; with outliers.
        seed: of the search for motions of single windows.
    """
    alone = is_of_one_camera(windows)
    if sum(len(each.left if alone else each.tracks) for each in windows) < _FEWEST * len(windows):
        return None
    few, found = thinned(windows, _SOME), dict[int, tuple[float, float]]()
    rough, fine = _SHARES_OF_ONE_CAMERA if alone else (1.0, 1.0)
    for number, scanning in enumerate(scannings):
        try:
            profile = _Profile(few, rig, scanning, rough, (_FIRST, seed))
            ratio = profile.climb(_FIRST)
        except NotDefiniteError:
            continue
        found[number] = profile.at(ratio), ratio
    if not found:
        return None
    best = max(found, key=lambda each: found[each][0])
    others, ratio = sum(np.exp(found[each][0] - found[best][0]) for each in found), found[best][1]
    try:
        profile = _Profile(thinned(windows, _TRACKS), rig, scannings[best], fine, (ratio, seed))
        ratio = profile.peak(ratio, _ROUGH_STEPS)[0]
        profile.settle(ratio)
        estimate = profile.posterior(*profile.peak(ratio), 1.0 / float(others))
    except NotDefiniteError:
        return None
    # A trajectory explains two or three wrong matches exactly, or all of them by a scale that is no noise.
    right = estimate.used >= _LEAST_SHARE * estimate.of and estimate.noise_px <= MOST_NOISE_PX
    return estimate if right else None


class _Profile:
    """Evidence of ratios, for the same tracks under the same tails."""

    def __init__(
        self,
        windows: Sequence[Correspondences],
        rig: StereoRig,
        scanning: Scanning,
        share: float,
        start: tuple[float, int],
    ) -> None:
        """With a first fit at a ratio, from motions of the windows; ``start`` is this ratio and a seed."""
        self._windows, self._rig, self._share, self._scanning = windows, rig, share, scanning
        self._fits = dict[float, Fit]()
        self._values = dict[float, float]()
        tracks, options = self._tracks(start[0]), TrajectoryOptions()
        motions = window_motions(windows, rig, self._shutter(start[0]), start[1])
        # The same knots whatever the ratio: what no track depends on adds the same to all.
        curve = first_curve(motions, tracks, span_of(len(windows), self._shutter(1.0)), _KNOTS)
        self._near = fit(curve, tracks, options.prior, True, _WIDE, np.ones(len(tracks)))

    def _shutter(self, ratio: float) -> RollingShutter:
        return self._rig.shutter_of(self._scanning, ratio)

    def _tracks(self, ratio: float) -> TimedTracks:
        return pack_windows(self._windows, self._rig, self._shutter(ratio), share=self._share)

    def _fit_near(self, ratio: float) -> Fit:
        return self._fits[min(self._fits, key=lambda other: abs(other - ratio))]

    def settle(self, ratio: float) -> None:
        """Take tails, right tracks and kind of prior from the fit at a ratio.

        Knots stay fine: smoothness is for the prior to decide, and coarse knots would enforce it.
        """
        tracks, last = self._tracks(ratio), self._fit_near(ratio)
        self._near = choose(fit(last.curve, tracks, last.prior, tails=last.tails), tracks, ())
        self._fits.clear()
        self._values.clear()

    def at(self, ratio: float) -> float:
        """Logarithm of evidence."""
        if ratio not in self._values:
            start = self._fit_near(ratio) if self._fits else self._near
            try:
                found = fit(start.curve, self._tracks(ratio), start.prior, True, start.tails, start.trust)
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
        for sign in (-1.0, 1.0):
            while True:
                other = float(np.clip(best + sign * _COARSE, _LEAST, 1.0))
                if other == best or self.at(other) <= self.at(best):
                    break
                best = other
        return best

    def peak(self, start: float, steps: int = _STEPS) -> tuple[float, float]:
        """Where the evidence is largest, and its deviation: parabolas through three ratios, ever closer."""
        best, step = start, _STEP
        sigma = step
        for number in range(steps):
            low, high = max(best - step, _LEAST), min(best + step, 1.0)
            middle = 0.5 * (low + high)
            values = [self.at(each) for each in (low, middle, high)]
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

    def posterior(self, peak: float, sigma: float, probability: float) -> SequenceRatio:
        """Mean and standard deviation of the ratio over all ratios, by a curve without overshoot through
        values."""
        from scipy.interpolate import PchipInterpolator

        ratios = np.unique(np.clip(peak + sigma * _NODES, _LEAST, 1.0))
        values = np.array([self.at(each) for each in ratios])
        fine = np.linspace(ratios[0], ratios[-1], 601)
        curve = PchipInterpolator(ratios, values)(fine) if len(ratios) > 1 else np.full(len(fine), values[0])
        density = np.exp(curve - float(np.max(values)))
        total = float(np.trapezoid(density, fine))
        mean = float(np.trapezoid(density * fine, fine)) / total
        spread = float(np.sqrt(np.trapezoid(density * (fine - mean) ** 2, fine) / total))
        found = self._fit_near(mean)
        return SequenceRatio(
            scanning=self._scanning,
            probability=probability,
            ratio=mean,
            sigma=spread,
            noise_px=noise_px(found.tails),
            used=int(np.count_nonzero(found.trust)),
            of=len(found.trust),
        )
