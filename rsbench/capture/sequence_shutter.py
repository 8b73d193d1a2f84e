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
from typing import NamedTuple

import numpy as np
import scipy

from rsbench.capture.calibration import FOCAL, NO_ERRORS
from rsbench.capture.hypotheses import scans_of
from rsbench.capture.shutter_decision import OPPOSITE, shutter_found, shutter_of
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, TrajectoryOptions, noise_px
from rsbench.capture.trajectory_fit import Fit, choose, first_curve, fit, log_evidence, window_motions
from rsbench.capture.trajectory_spline import Curve, NotDefiniteError, make_curve, span_of
from rsbench.capture.trajectory_tracks import (
    Tails,
    TimedTracks,
    is_of_one_camera,
    pack_windows,
    thinned,
    thinned_chains,
)
from rsbench.capture.two_frame_estimate import CERTAIN, MAX_SIGMA, Candidate, Capture, nearly_global
from rsbench.core import so3
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.core.uncertainty import shared_error_factor, tiles, variance_factor

LONGEST = 12
"""Successive windows that are used, at most: more would reduce the error by less than noise leaves."""
SUCCESSIVE = 6
"""Windows by which ``shakes`` decides."""
_CHECKED_TRACKS = 200
"""Of each of them, at most."""
_FAR_BETTER = 0.8
"""Scale of the errors about a trajectory over that about motion models, below which these are wrong."""
_TOGETHER = tuple(Scanning(scan=scan) for scan in ("top", "bottom", "left", "right"))
_FIRST, _OTHERS, _COARSE, _LEAST = 0.6, (0.3, 0.85), 0.15, 0.02
"""Where the search starts, of one camera also there, its stride, and the least ratio of a rolling shutter."""
_KNOTS = 0.25
"""Frame periods between control poses to begin with: fine ones, because at a wrong ratio the trajectory is
rough."""
_WIDE = Tails(3.0, 0.3)
"""Errors, px, of the search for the right stride: with the errors of refined matches, a ratio that is far off fits
something else."""
_FEWEST, _SOME, _TRACKS = 15, 60, 150
"""Tracks of a window, about: fewest for an estimate, to estimate the scanning, and the ratio."""
_SHARE = 0.5
"""Weight of one camera's track beside the prior; common errors count in ``dispersion``."""
_COARSE_FOCAL, _FARTHEST = 0.3, 0.9
"""Stride of the search in the logarithm of the focal length, and how far it goes."""
_LEAST_SHARE = 0.2
"""Of the tracks must be right."""
_PRECISION = 1e12
_BEYOND, _SHARED = 2.5, 0.02
"""Variance over what common errors within tiles of the image explain, and error of a ratio that all flow of a
video has in common. Chosen on twelve warped hand-held videos of 320 x 240 px (seed 7)."""
_STEP, _STEP_FOCAL, _STEPS, _ROUGH_STEPS, _ROUNDS = 0.05, 0.1, 5, 2, 4
"""First differences of ratio and focal length, steps of Newton's method, and how often tails are learned."""
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
    focal_sigma: float = 0.0,
) -> Capture:
    """The shutter from one trajectory through successive windows, without motion models.

    Args: capture: the one under motion models, which is returned where no trajectory explains the tracks. windows:
    of the frames 0 and 1, 1 and 2, ... scannings: how the cameras may read; None: both alike, at once, from one of
    four sides, or as in ``capture``. focal_sigma: as of ``ratio_of_sequence``.
    """
    if scannings is None:
        best, scannings = capture.likeliest, _TOGETHER
        if best is not None and not best.scans.together and "global" not in astuple(best.scans):
            own = Scanning(scan=best.scans.left, right_scan=best.scans.right)  # pyrefly: ignore[bad-argument-type]
            scannings = (*_TOGETHER, own)
    found = ratio_of_sequence(windows, rig, scannings, seed, focal_sigma)
    if found is None:
        return capture
    candidate = Candidate(
        scans=scans_of(rig.shutter_of(found.scanning, 1.0)),
        probability=found.probability,
        ratio=found.ratio,
        sigma=found.sigma,
        delay=found.scanning.right_delay,
        delay_sigma=0.0,
        calibration=_shorter(1.0 - float(np.exp(-found.log_focal))),
        calibration_sigma=_shorter(found.log_focal_sigma * float(np.exp(-found.log_focal))),
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


def _shorter(share: float) -> tuple[float, ...]:
    """Errors of a calibration with focal lengths that are too short by this share."""
    return (*NO_ERRORS[:FOCAL], share, *NO_ERRORS[FOCAL + 1 :])


def shutter_of_sequence(windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> RollingShutter:
    """The shutter of cameras that read alike, from the first successive windows of any motion.

    Raises:
        NoMotionError: the matches do not determine it.
    """
    return shutter_found(capture_of_sequence(_nothing_of(windows), windows[:LONGEST], rig, None, seed), rig)


def capture_of_video(
    windows: Sequence[FloatArray],
    camera: PinholeCamera,
    scan: Scan | None,
    seed: int = 0,
    focal_sigma: float = 0.0,
) -> Capture | None:
    """The shutter of one camera from a trajectory through successive frames; None where none explains the matches.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, of the frames 0 and 1, 1 and 2, ...; with outliers.
        scan: as in ``known_alone``.
        focal_sigma: as of ``ratio_of_sequence``; the focal length is then among the errors of the calibration.
    """
    matches, scan = [Correspondences(left=each) for each in windows], scan or "top"
    scannings = Scanning(scan=scan), Scanning(scan=OPPOSITE[scan])
    rig = StereoRig.of_one(camera)
    found = capture_of_sequence(_nothing_of(matches), matches, rig, scannings, seed, focal_sigma)
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
    """Matches of tracks that are right."""
    of: int
    log_focal: float = 0.0
    """Logarithm of the focal length over the rig's."""
    log_focal_sigma: float = 0.0
    """0: it is known."""


def ratio_of_sequence(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    scannings: Sequence[Scanning],
    seed: int = 0,
    focal_sigma: float = 0.0,
) -> SequenceRatio | None:
    """How cameras read, by one of several scannings; None where no trajectory explains the tracks.

    Args:
        windows: of the frames 0 and 1, 1 and 2, ...; with outliers.
        seed: of the search for motions of single windows.
        focal_sigma: prior standard deviation of the logarithm of the focal length about the rig's; 0: it is given.
    """
    alone = is_of_one_camera(windows)
    if sum(len(each.left if alone else each.tracks) for each in windows) < _FEWEST * len(windows):
        return None
    fewer = thinned_chains if alone else thinned
    few, found = fewer(windows, _SOME), dict[int, tuple[float, _Place]]()
    # A spline that begins with motions under a wrong camera may stay where these lead it under any other.
    away = (-_COARSE_FOCAL, _COARSE_FOCAL) if focal_sigma else (0.0,)
    first = [_Place(_FIRST, 0.0), *(_Place(ratio, by) for ratio in _OTHERS if alone for by in away)]
    for number, scanning in enumerate(scannings):
        try:
            starts = [_Profile(few, rig, scanning, (each, seed), focal_sigma) for each in first]
            profile = max(starts, key=lambda each: each.at(each.start))
            place = profile.ascended(profile.climb(profile.start))
        except NotDefiniteError:
            continue
        found[number] = profile.comparable(place), place
    if not found:
        return None
    best = max(found, key=lambda each: found[each][0])
    try:
        profile = _Profile(fewer(windows, _TRACKS), rig, scannings[best], (found[best][1], seed), focal_sigma)
        top, covariance = profile.summit(profile.ascended(found[best][1]))
        dispersion = profile.dispersion(top, covariance)
    except NotDefiniteError:
        return None
    odds = sum(np.exp((each - found[best][0]) / dispersion) for each, _ in found.values())
    estimate = profile.stated(top, covariance * dispersion, 1.0 / float(odds))
    # A trajectory explains two or three wrong matches exactly, or all of them by a scale that is no noise.
    right = estimate.used >= _LEAST_SHARE * estimate.of and estimate.noise_px <= MOST_NOISE_PX
    return estimate if right else None


class _Place(NamedTuple):
    """Where evidence is evaluated."""

    ratio: float
    log_focal: float
    """As in ``SequenceRatio``."""


class _Profile:
    """Evidence of ratios and focal lengths, for the same tracks under the same tails."""

    def __init__(
        self,
        windows: Sequence[Correspondences],
        rig: StereoRig,
        scanning: Scanning,
        start: tuple[_Place, int],
        focal_sigma: float,
    ) -> None:
        """With a first fit at a place, from motions of the windows; ``start`` is this place and a seed."""
        self._windows, self._rig, self._scanning, self._focal_sigma = windows, rig, scanning, focal_sigma
        self._linked = [np.ones(len(each.left)) for each in windows] if is_of_one_camera(windows) else None
        # Dense flow errs together; features do not.
        flow = self._linked is not None
        self._share, self._beyond, self._shared = (_SHARE, _BEYOND, _SHARED) if flow else (1.0, 1.0, 0.0)
        self._fits = dict[_Place, Fit]()
        self._values = dict[_Place, float]()
        self.start = place = start[0]
        tracks, options = self._tracks(place), TrajectoryOptions()
        motions = window_motions(windows, self._rig_at(place), self._shutter(place.ratio), start[1])
        # The same knots whatever the ratio: what no track depends on adds the same to all.
        curve = first_curve(motions, tracks, span_of(len(windows), self._shutter(1.0)), _KNOTS)
        self._near = place, fit(curve, tracks, options.prior, True, _WIDE, np.ones(len(tracks)))

    def _shutter(self, ratio: float) -> RollingShutter:
        return self._rig.shutter_of(self._scanning, ratio)

    def _rig_at(self, place: _Place) -> StereoRig:
        if not place.log_focal:
            return self._rig
        longer, camera = float(np.exp(place.log_focal)), self._rig.camera
        return replace(self._rig, camera=replace(camera, fx=camera.fx * longer, fy=camera.fy * longer))

    def _tracks(self, place: _Place) -> TimedTracks:
        rig, shutter = self._rig_at(place), self._shutter(place.ratio)
        return pack_windows(self._windows, rig, shutter, self._linked, share=self._share)

    def _fit_near(self, place: _Place) -> tuple[_Place, Fit]:
        if not self._fits:
            return self._near
        near = min(self._fits, key=lambda other: float(np.hypot(*np.subtract(other, place))))
        return near, self._fits[near]

    def settle(self, place: _Place) -> None:
        """Take tails, right tracks and kind of prior from the fit at a place.

        Knots stay fine: smoothness is for the prior to decide, and coarse knots would enforce it.
        """
        self.at(place)
        tracks, (_, last) = self._tracks(place), self._fit_near(place)
        self._near = place, choose(fit(last.curve, tracks, last.prior, tails=last.tails), tracks, ())
        self._fits.clear()
        self._values.clear()

    def at(self, place: _Place) -> float:
        """Logarithm of evidence, and of the prior of the focal length."""
        if place not in self._values:
            near, start = self._fit_near(place)
            curve = _turning_less(start.curve, float(np.exp(place.log_focal - near.log_focal)))
            try:
                found = fit(curve, self._tracks(place), start.prior, True, start.tails, start.trust)
                prior = -0.5 * (place.log_focal / self._focal_sigma) ** 2 if self._focal_sigma else 0.0
                self._fits[place], self._values[place] = found, log_evidence(found, _PRECISION) + prior
            except NotDefiniteError:
                self._values[place] = _NOTHING
        return self._values[place]

    def climb(self, start: _Place) -> _Place:
        """From a place, by strides, to one with less evidence on all sides.

        Raises:
            NotDefiniteError: there is no fit at the first.
        """
        best = start
        if self.at(best) == _NOTHING:
            raise NotDefiniteError("no trajectory explains the tracks")
        strides = [(-_COARSE, 0.0), (_COARSE, 0.0)]
        strides += [(0.0, -_COARSE_FOCAL), (0.0, _COARSE_FOCAL)] if self._focal_sigma else []
        moved = True
        while moved:
            moved = False
            for ratio, log_focal in strides:
                while True:
                    other = _Place(float(np.clip(best.ratio + ratio, _LEAST, 1.0)), best.log_focal + log_focal)
                    if other == best or abs(other.log_focal) > _FARTHEST or self.at(other) <= self.at(best):
                        break
                    best, moved = other, bool(self._focal_sigma)
        return best

    def summit(self, start: _Place, steps: int = _STEPS) -> tuple[_Place, FloatArray]:
        """Where the evidence is largest, and its covariance (2, 2) there: Newton's method on differences.

        The second row and column are 0 where the focal length is known.
        """
        best, axes = start, 2 if self._focal_sigma else 1
        reach, H = np.array([_STEP, _STEP_FOCAL]), np.eye(2)
        for number in range(steps):
            middle = _Place(float(np.clip(best.ratio, _LEAST + reach[0], 1.0 - reach[0])), best.log_focal)

            def beside(a: int, b: int, middle: _Place = middle, reach: FloatArray = reach) -> float:
                return self.at(_Place(middle.ratio + a * reach[0], middle.log_focal + b * reach[1]))

            ahead, behind = (np.array([beside(k, 0), beside(0, k) if axes > 1 else 0.0]) for k in (1, -1))
            here = beside(0, 0)
            H = np.diag((2.0 * here - ahead - behind)[:axes] / reach[:axes] ** 2)
            if axes > 1:
                H[0, 1] = H[1, 0] = (ahead[0] + ahead[1] - here - beside(1, 1)) / (reach[0] * reach[1])
            values, vectors = np.linalg.eigh(H)
            H = (vectors * np.maximum(np.abs(values), 1.0)) @ vectors.T
            slope = ((ahead - behind)[:axes] / (2.0 * reach[:axes]))[:axes]
            step = np.linalg.solve(H, slope)
            step *= min(1.0, _COARSE / max(abs(step[0]), 1e-9), _COARSE_FOCAL / max(float(np.abs(step[-1])), 1e-9))
            there = _Place(
                float(np.clip(middle.ratio + step[0], _LEAST, 1.0)),
                float(np.clip(middle.log_focal + step[1], -_FARTHEST, _FARTHEST)) if axes > 1 else 0.0,
            )
            moved, sigma = np.abs(np.subtract(there, best))[:axes], np.sqrt(np.diagonal(np.linalg.inv(H)))
            best = there if self.at(there) >= here else middle
            reach = np.clip(np.append(sigma, _STEP_FOCAL)[:2], [0.002, 0.02], [0.1, 0.3])
            if number > 0 and np.all(moved < 0.3 * sigma):
                break
        out = np.zeros((2, 2))
        out[:axes, :axes] = np.linalg.inv(H)
        return best, out

    def ascended(self, place: _Place) -> _Place:
        """From a place to a summit, near which tails and right tracks are taken from the fit at it.

        Those of a fit that is far off, whose errors are large, have a flat evidence with other summits.
        """
        for _ in range(_ROUNDS):
            self.settle(place)
            last, place = place, self.summit(self.climb(place), _ROUGH_STEPS)[0]
            if abs(place.ratio - last.ratio) < _STEP and abs(place.log_focal - last.log_focal) < _STEP_FOCAL:
                break
        return place

    def comparable(self, place: _Place) -> float:
        """Logarithm of evidence with the normalisation of the tails, for profiles of the same tracks."""
        value, (_, found) = self.at(place), self._fit_near(place)
        tails, freedom = found.tails, self._tracks(place).freedom
        each = scipy.special.gammaln(0.5 * (tails.nu + freedom)) - scipy.special.gammaln(0.5 * tails.nu)
        each -= 0.5 * freedom * np.log(np.pi * tails.nu * tails.scale**2)
        wrong = -freedom * np.log(MOST_NOISE_PX)  # evenly spread, whatever the tails of the right ones
        return value + self._share * float(np.sum(np.where(found.trust > 0.0, each, wrong)))

    def dispersion(self, top: _Place, covariance: FloatArray) -> float:
        """Variance over that of the evidence: tracks of one part of the image have common errors."""
        axes, tracks = 2 if self._focal_sigma else 1, self._tracks(top)
        scores = np.zeros((len(tracks), axes))
        for axis in range(axes):
            step = float(np.sqrt(covariance[axis, axis])) * np.eye(2)[axis]
            ends, costs = list[float](), list[FloatArray]()
            for sign in (-1.0, 1.0):
                ratio, log_focal = np.add(top, sign * step)
                place = _Place(float(np.clip(ratio, _LEAST, 1.0)), float(log_focal))
                self.at(place)
                found = self._fit_near(place)[1]
                factor = 0.5 * self._share * found.trust * (found.tails.nu + tracks.freedom)
                spread = found.tails.nu * found.tails.scale**2
                costs.append(factor * np.log1p(found.equations.squares / spread))
                ends.append(place[axis])
            scores[:, axis] = (costs[1] - costs[0]) / (ends[1] - ends[0])
        inverse, groups = covariance[:axes, :axes], tiles(tracks.ends[tracks.starts[:-1], :2])
        shared = shared_error_factor(scores @ inverse, groups, inverse, axes)
        return self._beyond * shared * variance_factor(len(np.unique(groups)) - 1.0, axes)

    def _spans(self, place: _Place) -> FloatArray:
        """Windows that each track is seen through."""
        tracks = self._tracks(place)
        return np.maximum(np.round(np.diff(tracks.starts) / (1 if self._linked else 2)) - 1.0, 1.0)

    def stated(self, top: _Place, covariance: FloatArray, probability: float) -> SequenceRatio:
        """At a summit, with a covariance (2, 2) about it; the ratio is at most 1."""
        ratio, deviation = _within(top.ratio, float(np.hypot(np.sqrt(covariance[0, 0]), self._shared)))
        self.at(top)
        found = self._fit_near(top)[1]
        return SequenceRatio(
            scanning=self._scanning,
            probability=probability,
            ratio=ratio,
            sigma=deviation,
            noise_px=noise_px(found.tails),
            used=int(np.sum(self._spans(top)[found.trust > 0.0])),
            of=int(np.sum(self._spans(top))),
            log_focal=top.log_focal,
            log_focal_sigma=float(np.sqrt(covariance[1, 1])),
        )


def _within(ratio: float, sigma: float) -> tuple[float, float]:
    """Mean and standard deviation of a normal ratio that is known to be possible."""
    fine = np.linspace(_LEAST, 1.0, 981)
    density = np.exp(-0.5 * ((fine - ratio) / max(sigma, 1e-3)) ** 2)
    mean = float(density @ fine / np.sum(density))
    return mean, float(np.sqrt(density @ (fine - mean) ** 2 / np.sum(density)))


def _turning_less(curve: Curve, factor: float) -> Curve:
    """A spline with all turns divided by a factor, by which the focal length is longer."""
    if factor == 1.0:
        return curve
    return make_curve(curve.first, curve.interval, so3.exp(so3.log(curve.R) / factor), curve.p)
