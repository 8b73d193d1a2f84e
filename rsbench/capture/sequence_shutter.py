"""Estimate the readout ratio and scan of a shaking rig or camera from successive frames.

Such frames follow none of the motion models, and a ratio estimated under these is wrong (``shakes``). Two frames
do not determine the ratio, since an arbitrary motion within the readout fits equally well at any ratio. A sequence
does: the rig moves alike between and during readouts, and at a wrong ratio it would have to change its speed with
every frame. The ratio has a uniform prior, so its posterior is proportional to the evidence of the tracks
(``trajectory_fit.log_evidence``): their probability under a trajectory whose acceleration variance is estimated.
"""

from __future__ import annotations

import copy
import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
import scipy

from rsbench.capture.calibration import FOCAL, NO_ERRORS
from rsbench.capture.hypotheses import scans_of
from rsbench.capture.shutter_decision import OPPOSITE, shutter_found, shutter_of
from rsbench.capture.trajectory_estimate import MOST_NOISE_PX, TrajectoryOptions, noise_px
from rsbench.capture.trajectory_fit import (
    ANCHORED,
    DAMPING,
    SHORT,
    Equations,
    Fit,
    anchored,
    choose,
    estimate_variances,
    first_curve,
    fit,
    log_evidence,
    normal_equations,
    right_tracks,
    squared_errors,
    straight_curves,
    variances,
    window_motions,
)
from rsbench.capture.trajectory_gyro import Border, bordered_step
from rsbench.capture.trajectory_spline import (
    Curve,
    NotDefiniteError,
    band_factor,
    band_solve,
    from_pose_at,
    make_curve,
    moved,
    span_of,
)
from rsbench.capture.trajectory_tracks import (
    Tails,
    TimedTracks,
    is_of_one_camera,
    noise_by_tile,
    observed,
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
from rsbench.core.uncertainty import shared_error_factor, spread_about, tempered, tiles, variance_factor
from rsbench.solvers.engine.levenberg_marquardt import descend

_Start = TypeVar("_Start")
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
LONGEST = 12
"""Most successive windows that are used; further ones would hardly reduce the error."""
SUCCESSIVE = 6
"""Number of windows that ``shakes`` needs."""
_CHECKED_TRACKS = 200
"""Number of tracks per window that ``shakes`` uses, at most."""
_FAR_BETTER = 0.8
"""If a trajectory's error scale divided by the motion models' is below this, the motion models are wrong."""
_TOGETHER = tuple(Scanning(scan=scan) for scan in ("top", "bottom", "left", "right"))
_FIRST, _OTHERS, _COARSE, _LEAST = 0.6, (0.3, 0.85), 0.15, 0.02
"""Start ratio of the search, more start ratios for one camera, step, and least ratio of a rolling shutter."""
_KNOTS = 0.25
"""Frame periods between control poses at the start; small, as the trajectory is rough at a wrong ratio."""
_WIDE = Tails(3.0, 0.3)
"""Error distribution, px, of the first fits: with the small errors of refined matches, a fit at a ratio that is
far off would treat correct tracks as outliers."""
_FEWEST, _SOME, _TRACKS = 15, 60, 150
"""Approximate tracks per window: fewest for an estimate, number for the scanning, and number for the ratio."""
_SHARE = 0.5
"""Weight of one camera's track relative to the prior; ``dispersion`` accounts for correlated errors."""
_COARSE_FOCAL = 0.3
"""Step of the search in the logarithm of the focal length."""
_LIMITS, _LARGEST = np.array([1.0, 0.9, 0.1, 0.1]), np.array([_COARSE, _COARSE_FOCAL, 0.02, 0.02])
"""Largest absolute values of ratio, log focal length and principal point (image widths), and largest steps."""
_LITTLE_WEIGHT = 4.0
"""Relative noise of tracks that a fit is to use little."""
_STRAIGHT = (0.01 * SHORT) ** 2
"""Variance of the acceleration of nearly uniform translations: changes of the speed by 1 % in a frame period."""
_LEAST_SHARE = 0.2
"""Least share of inliers among the tracks."""
_PRECISION = 1e12
_EXTRA_VARIANCE, _SHARED = 1.5, 0.008
"""Factor on the variance for errors beyond those correlated within image tiles, and error of the ratio common to
all flow of a video. Chosen on 15 warped hand-held videos (``benchmarks/uncalibrated_video.py``, seed 100) and four
of ``benchmarks/phone_video.py`` with even times; errors of 36 others are 0.83 deviations (root mean square)."""
_ROUNDS, _NEAR_PLACE = 4, np.array([0.05, 0.1])
"""Most choices of the kind of prior, and changes of ratio and log focal length after which none follows."""
_ROUGH, _REFINED = 3, 2
"""Number of starts from which the place is fitted, and number of these for which the fit is then refined."""
_STEPS, _STEPS_BESIDE, _LARGEST_STEP = 4, 4, np.array([0.05, 0.1])
"""Most Newton steps to the largest evidence, steps of the spline at each place, and largest step of a place."""
_REACH = np.array([[0.002, 0.01], [0.02, 0.04]])
"""Smallest and largest steps of the differences of the evidence."""
_FIXED_ROUNDS, _FREE_ROUNDS, _STEPS_A_ROUND = 15, 25, 2
"""Most rounds under the wide error distribution and under the tracks' own, and steps in each."""
_FLAT_COST, _FLAT_VARIANCE, _FLAT_EVIDENCE, _FLAT_PLACE = 1e-3, 0.05, 0.1, np.array([0.002, 0.005])
"""Changes below which the joint fit has converged: cost; variances, relative; evidence; ratio and focal length."""
_ROUGHLY = 5.0
"""Factor on the last ones under the wide error distribution."""


def shakes(capture: Capture, windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> bool:
    """Whether a trajectory through successive windows fits them with far smaller errors than the motion models.

    At any ratio, a spline follows all motion that is slow compared with its knots.
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
    times: FloatArray | None = None,
    centre_sigma: float = 0.0,
) -> Capture:
    """Estimate the shutter from one trajectory through successive windows, without motion models.

    Args:
        capture: the estimate by motion models, which is returned if no trajectory explains the tracks.
        windows: matches of the frames 0 and 1, 1 and 2, ...
        scannings: candidates; None: both cameras synchronous and from one of four sides, or as in ``capture``.
        focal_sigma, times, centre_sigma: see ``ratio_of_sequence``.
    """
    if scannings is None:
        best, scannings = capture.likeliest, _TOGETHER
        if best is not None and not best.scans.together and "global" not in astuple(best.scans):
            own = Scanning(scan=best.scans.left, right_scan=best.scans.right)  # pyrefly: ignore[bad-argument-type]
            scannings = (*_TOGETHER, own)
    found = ratio_of_sequence(windows, rig, scannings, seed, focal_sigma, times, centre_sigma)
    if found is None:
        return capture
    candidate = Candidate(
        scans=scans_of(rig.shutter_of(found.scanning, 1.0)),
        probability=found.probability,
        ratio=found.ratio,
        sigma=found.sigma,
        delay=found.scanning.right_delay,
        delay_sigma=0.0,
        calibration=_focal_errors(1.0 - float(np.exp(-found.log_focal))),
        calibration_sigma=_focal_errors(found.log_focal_sigma * float(np.exp(-found.log_focal))),
    )
    # With nearly no readout, the scan does not matter.
    near = nearly_global(replace(capture, candidates=(replace(candidate, probability=1.0),)))
    candidate, doubt = candidate if near is None else near[0], ""
    if candidate.probability < CERTAIN or candidate.sigma > MAX_SIGMA:
        text = f"{candidate.ratio:.2f} +- {candidate.sigma:.2f}"
        doubt = f"{len(windows) + 1} successive frames do not determine the readout ratio: {text}"
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


def _focal_errors(share: float) -> tuple[float, ...]:
    """The calibration errors of focal lengths that are too short by this share."""
    return (*NO_ERRORS[:FOCAL], share, *NO_ERRORS[FOCAL + 1 :])


def shutter_of_sequence(windows: Sequence[Correspondences], rig: StereoRig, seed: int = 0) -> RollingShutter:
    """Estimate the shutter of cameras that read alike from the first ``LONGEST`` windows, under any motion.

    Raises:
        NoMotionError: the matches do not determine it.
    """
    return shutter_found(capture_of_sequence(_without_estimate(windows), windows[:LONGEST], rig, None, seed), rig)


def capture_of_video(
    windows: Sequence[FloatArray],
    camera: PinholeCamera,
    scan: Scan | None,
    seed: int = 0,
    focal_sigma: float = 0.0,
    times: FloatArray | None = None,
    centre_sigma: float = 0.0,
) -> Capture | None:
    """The shutter of one camera from a trajectory through successive frames; None if none explains the matches.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, of the frames 0 and 1, 1 and 2, ...; with outliers.
        scan: see ``known_alone``.
        focal_sigma, times, centre_sigma: see ``ratio_of_sequence``. The focal length is returned as a calibration
            error.
    """
    matches, scan = [Correspondences(left=each) for each in windows], scan or "top"
    scannings = Scanning(scan=scan), Scanning(scan=OPPOSITE[scan])
    rig = StereoRig.of_one(camera)
    found = capture_of_sequence(
        _without_estimate(matches), matches, rig, scannings, seed, focal_sigma, times, centre_sigma
    )
    return found if found.candidates else None


def _without_estimate(windows: Sequence[Correspondences]) -> Capture:
    """The capture before anything is estimated."""
    pairs = [each.left if len(each.left) else each.tracks[:, [0, 1, 4, 5]] for each in windows]
    every = np.concatenate([*pairs, np.zeros((0, 4))])
    moved = float(np.median(np.linalg.norm(every[:, 2:] - every[:, :2], axis=1))) if len(every) else 0.0
    return Capture(reason="too few matches agree with any motion", matches=0, moved_px=moved)


@dataclass(frozen=True, kw_only=True, eq=False)
class SequenceRatio:
    """A readout ratio estimated from successive frames."""

    scanning: Scanning
    """The scanning with the largest evidence."""
    probability: float
    """Posterior probability of the scanning, with equal prior probabilities."""
    ratio: float
    sigma: float
    noise_px: float
    used: int
    """Number of matches in inlier tracks."""
    total: int
    """Number of matches."""
    log_focal: float = 0.0
    """Logarithm of the focal length divided by the rig's."""
    log_focal_sigma: float = 0.0
    """Standard deviation of ``log_focal``; 0: the focal length is given."""


def ratio_of_sequence(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    scannings: Sequence[Scanning],
    seed: int = 0,
    focal_sigma: float = 0.0,
    times: FloatArray | None = None,
    centre_sigma: float = 0.0,
) -> SequenceRatio | None:
    """Estimate the ratio and choose among the scannings; None if no trajectory explains the tracks.

    Args:
        windows: matches, with outliers, of the frames 0 and 1, 1 and 2, ...
        seed: seed of the search for motions of single windows.
        focal_sigma: prior standard deviation of the logarithm of the focal length about the rig's; 0: it is given,
            as it must be for a camera with a lens.
        times: (n + 1,) times of the frames' first lines, frame periods; None: one period apart.
        centre_sigma: prior standard deviation of the principal point about the rig's, image widths, each axis; 0:
            it is given.
    """
    alone = is_of_one_camera(windows)
    if sum(len(each.left if alone else each.tracks) for each in windows) < _FEWEST * len(windows):
        return None
    fewer = thinned_chains if alone else thinned
    few, found = fewer(windows, _SOME), dict[int, list[_Found]]()
    # Far from the truth the evidence has several maxima, so start at several places.
    away = (-_COARSE_FOCAL, _COARSE_FOCAL) if focal_sigma else (0.0,)
    starts = [_Place(_FIRST), *(_Place(ratio, by) for ratio in _OTHERS if alone for by in away)]
    for number, scanning in enumerate(scannings):
        profile = _Profile(few, rig, scanning, times, focal_sigma, centre_sigma)
        spline = profile.first_spline(seed)
        started = _likeliest(partial(profile.started, curve=spline), starts, _ROUGH)
        rough = _likeliest(profile.rough, started, _REFINED)
        if alone:
            straight = _likeliest(profile.started_straight, straight_curves(spline, 0.0), 1)
            rough += _likeliest(profile.rough, straight, 1)
        refined = _likeliest(profile.refined_with_noise, rough, len(rough))
        refined += _likeliest(profile.refined_without_dashboard, refined[:1] if alone else [], 1)
        if refined:
            found[number] = sorted(refined, key=lambda each: -each.evidence)
    if not found:
        return None
    best = max(found, key=lambda each: found[each][0].evidence)
    first, rivals = found[best][0], found[best]  # local optima, which may be nearly as likely
    try:
        profile = _Profile(fewer(windows, _TRACKS), rig, scannings[best], times, focal_sigma, centre_sigma)
        profile = profile.with_noise_of(first)
        likeliest = profile.refined_again(first)
        top, covariance = profile.most_evident(likeliest)
        dispersion = profile.dispersion(top, covariance)
    except NotDefiniteError:
        return None
    odds = sum(np.exp((each[0].evidence - first.evidence) / dispersion) for each in found.values())
    places = np.array([each.place[:2] for each in rivals])
    likely = tempered([np.exp(each.evidence - first.evidence) for each in rivals], dispersion)
    covariance = dispersion * covariance + spread_about(places[0], likely, places)
    # Where the approximation of the evidence holds, it is largest near the likeliest fit.
    both = np.array([top.place[:2], likeliest.place[:2]])
    covariance += spread_about(both[0], np.array([0.5, 0.5]), both)
    estimate = profile.result(top, covariance, 1.0 / float(odds))
    # Refuse fits to two or three wrong matches, and fits to all of them with an error scale too large for noise.
    right = estimate.used >= _LEAST_SHARE * estimate.total and estimate.noise_px <= MOST_NOISE_PX
    return estimate if right else None


class _Place(NamedTuple):
    """Values of the unknowns that all observations share."""

    ratio: float
    log_focal: float = 0.0
    """See ``SequenceRatio``."""
    x: float = 0.0
    """Principal point relative to the rig's, image widths."""
    y: float = 0.0

    def inside(self, reach: FloatArray) -> _Place:
        """The nearest place whose ratio is at least ``reach[0]`` from its limits."""
        return self._replace(ratio=float(np.clip(self.ratio, _LEAST + reach[0], 1.0 - reach[0])))

    def moved(self, step: FloatArray) -> _Place:
        """The place after a step of its first unknowns, within the limits."""
        whole = np.zeros(len(self))
        whole[: len(step)] = step
        return _Place(*np.clip(np.add(self, whole), -_LIMITS, _LIMITS).tolist()).inside(np.zeros(1))


class _Found(NamedTuple):
    """A fit at a place, with the logarithm of its evidence."""

    evidence: float
    place: _Place
    fit: Fit


def _likeliest(step: Callable[[_Start], _Found], starts: Iterable[_Start], count: int) -> list[_Found]:
    """The results of a step of the search with the largest evidence, at most ``count``."""

    def found(start: _Start) -> list[_Found]:
        with suppress(NotDefiniteError):
            return [step(start)]
        return []

    every = itertools.chain.from_iterable(_in_threads(found, starts))
    return sorted(every, key=lambda each: -each.evidence)[:count]


def _in_threads(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """The results of ``work``, in order, which all cores compute: most of it is compiled code."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(work, items))


class _Point(NamedTuple):
    """A spline and a place, with the normal equations there."""

    curve: Curve
    place: _Place
    equations: Equations


@dataclass(frozen=True, eq=False)
class _Joint:
    """The cost of a spline and of some unknowns of a place, in the form that ``descend`` takes.

    The error distribution and the prior are fixed. The spline depends strongly on ratio and focal length, and
    steps of these alone would creep along narrow curved valleys.
    """

    profile: _Profile
    found: Fit
    """Only its error distribution, prior and inliers are used."""
    free: Sequence[int]
    """Indices of the unknowns of the place that are estimated."""

    def at(self, curve: Curve, place: _Place) -> _Point:
        """The point with equations that include the prior of the place."""
        tracks, known, free = self.profile.tracks(place, True), self.found, np.array(self.free, dtype=np.int64)
        found = normal_equations(curve, tracks, known.tails, known.prior, known.trust)
        precisions, units, border = self.profile.precisions, self.profile.units, found.border
        assert border is not None
        corner = border.corner * np.outer(units, units) + np.diag(precisions)
        slope = border.slope * units + precisions * place
        border = Border((border.mixed * units)[:, free], corner[np.ix_(free, free)], slope[free])
        cost = found.cost + 0.5 * float(precisions @ np.square(place))
        return _Point(curve, place, found._replace(cost=cost, border=border if len(free) else None))

    def stepped(self, here: _Point, damping: float) -> _Point | None:
        equations, border = here.equations, here.equations.border
        damped = anchored(equations, here.curve, self.profile.tracks(here.place), 1.0).copy()
        damped[:, 0] += damping * equations.band[:, 0]
        step = np.zeros(len(here.place))
        try:
            lower = band_factor(damped)
            if border is None:
                follow = -band_solve(lower, equations.gradient)
            else:
                larger = border.corner + np.diag(damping * np.diagonal(border.corner))
                follow, own = bordered_step(lower, equations.gradient, border._replace(corner=larger))
                step[list(self.free)] = own
        except NotDefiniteError:
            return None
        shorter = float(np.min(np.minimum(1.0, _LARGEST / np.maximum(np.abs(step), 1e-9))))
        curve = from_pose_at(moved(here.curve, shorter * follow), 0.0)
        there = self.at(curve, here.place.moved(shorter * step))
        return there if there.equations.cost <= equations.cost else None

    def settled(self, before: _Point, after: _Point) -> bool:
        return before.equations.cost - after.equations.cost < _FLAT_COST


class _Profile:
    """The evidence as a function of ratio and focal length, for some tracks."""

    def __init__(
        self,
        windows: Sequence[Correspondences],
        rig: StereoRig,
        scanning: Scanning,
        times: FloatArray | None,
        focal_sigma: float,
        centre_sigma: float,
    ) -> None:
        self._windows, self._rig, self._scanning = windows, rig, scanning
        sigmas, width = (0.0, focal_sigma, centre_sigma, centre_sigma), float(rig.camera.width)
        self.precisions = np.array([each**-2 if each else 0.0 for each in sigmas])
        self.units = np.array([1.0, 1.0, width, width])
        self.axes = 2 if focal_sigma else 1
        self._marginal = (2, 3) if centre_sigma else ()
        self._free = (*range(self.axes), *self._marginal)
        self._linked = [np.ones(len(each.left)) for each in windows] if is_of_one_camera(windows) else None
        # Errors of dense flow are correlated, those of features are not.
        flow = self._linked is not None
        self._share, self._extra, self._shared = (_SHARE, _EXTRA_VARIANCE, _SHARED) if flow else (1.0, 1.0, 0.0)
        self._times = np.arange(len(windows) + 1.0) if times is None else times
        # Times are linear in the ratio, so that two ratios give the tracks of all.
        self._packed = [
            pack_windows(windows, rig, self._shutter(ratio), self._linked, share=self._share, times=self._times)
            for ratio in (0.0, 1.0)
        ]
        later = self._packed[1].ends[:, [2, 7, 8]] - self._packed[0].ends[:, [2, 7, 8]]
        self._packed[0] = replace(self._packed[0], by_ratio=later)
        self._noise = np.ones(len(self._packed[0]))

    def with_noise(self, noise: FloatArray) -> _Profile:
        """The evidence with this relative noise (n,) of each track in addition."""
        out = copy.copy(self)
        out._packed, out._noise = [each.with_noise(noise) for each in self._packed], self._noise * noise
        return out

    def with_noise_of(self, found: _Found) -> _Profile:
        """The evidence with the noise of each part of the image under a fit, which may be to other tracks."""
        tracks = self.tracks(found.place)
        return self.with_noise(noise_by_tile(tracks, squared_errors(found.fit.curve, tracks)))

    def _shutter(self, ratio: float) -> RollingShutter:
        return self._rig.shutter_of(self._scanning, ratio)

    def tracks(self, place: _Place, shared: bool = False) -> TimedTracks:
        """The tracks as read and seen at this place; ``shared``: with what equations of the place need."""
        still, full = self._packed
        ends, longer = still.ends + place.ratio * (full.ends - still.ends), np.exp(place.log_focal)
        ends[:, :2] = (ends[:, :2] - self.units[2:] * [place.x, place.y] / still.focal) / longer
        return replace(still, ends=ends, focal=still.focal * longer, by_ratio=still.by_ratio if shared else None)

    def first_spline(self, seed: int) -> Curve:
        """The spline through the motions of single windows at ``_FIRST`` and the given focal length."""
        first = _Place(_FIRST)
        motions = window_motions(self._windows, self._rig, self._shutter(first.ratio), seed, self._times)
        # All ratios have the same knots, so that control poses without tracks add the same to each evidence.
        span = span_of(float(self._times[-1]), self._shutter(1.0))
        return first_curve(motions, self.tracks(first), span, _KNOTS, self._times)

    def started_straight(self, curve: Curve) -> _Found:
        """The fit of a nearly uniform translation, from a spline, at ``_FIRST``.

        Where a third of the image moves with the camera, or its lens is long, translations across the optical axis
        explain in part what rotations do, and motions of single windows change between both.
        """
        place, prior = _Place(_FIRST), TrajectoryOptions().prior._replace(position=_STRAIGHT)
        tracks = self.tracks(place)
        return self._found(place, fit(curve, tracks, prior, False, _WIDE, np.ones(len(tracks))))

    def started(self, start: _Place, curve: Curve) -> _Found:
        """The fit at a place under a wide error distribution, from the spline for the given focal length.

        Raises:
            NotDefiniteError: there is no fit; ``rough`` and ``refined`` raise it too.
        """
        tracks, prior = self.tracks(start), TrajectoryOptions().prior
        curve = _with_smaller_rotations(curve, float(np.exp(start.log_focal)))
        return self._found(start, fit(curve, tracks, prior, True, _WIDE, np.ones(len(tracks))))

    def _found(self, place: _Place, found: Fit) -> _Found:
        """The fit with its evidence, in which the principal point is marginalised."""
        here = _Joint(self, found, self._marginal).at(found.curve, place)
        found = replace(found, equations=here.equations)
        return _Found(log_evidence(found, _PRECISION), place, found)

    def rough(self, start: _Found) -> _Found:
        """Fit spline and place together under the same wide error distribution."""
        return self._found(*self._fitted(start.place, start.fit, self._free, fixed=True))

    def refined(self, start: _Found) -> _Found:
        """Fit spline and place under the error distribution of the tracks; the evidence is normalised."""
        place, found = start.place, start.fit
        for _ in range(_ROUNDS):
            last_place, (place, found) = place, self._fitted(place, found, self._free, fixed=False)
            # The knots stay fine, since coarse ones would enforce a smoothness that the prior must decide on.
            kind = choose(found, self.tracks(place), ())
            near = np.all(np.abs(np.subtract(place, last_place)[:2]) < _NEAR_PLACE)
            done, found = kind is found, kind
            if done or near:
                break
        out = self._found(place, found)
        return out._replace(evidence=self._normalised(out))

    def _fitted(self, place: _Place, found: Fit, free: Sequence[int], fixed: bool) -> tuple[_Place, Fit]:
        """Fit spline, ``free`` unknowns, variances of the prior and, unless ``fixed``, the error distribution."""
        for _ in range(_FIXED_ROUNDS if fixed else _FREE_ROUNDS):
            problem = _Joint(self, found, free)
            here = descend(problem, problem.at(found.curve, place), _STEPS_A_ROUND, DAMPING)
            last, old, trust = variances(found.prior, None), found.tails, found.trust
            moved_by, tracks = np.abs(np.subtract(here.place, place))[:2], self.tracks(here.place)
            place, tails = here.place, old
            lower = band_factor(anchored(here.equations, here.curve, tracks, ANCHORED))
            used, determined, prior, _ = estimate_variances(here.equations, lower, found.prior, None)
            if not fixed:
                tails, trust = observed(here.equations.squares, tracks.freedom, old, used)
            found = Fit(curve=here.curve, tails=tails, prior=prior, trust=trust, equations=here.equations)
            change = np.abs(np.log(variances(prior, None) / last))
            settling = (change > _FLAT_VARIANCE) & (change * determined > _FLAT_EVIDENCE)
            still = abs(np.log(tails.scale / old.scale)) < _FLAT_VARIANCE and np.all(
                moved_by < (_ROUGHLY if fixed else 1.0) * _FLAT_PLACE
            )
            if still and not np.any(settling):
                break
        return place, replace(found, equations=_Joint(self, found, ()).at(found.curve, place).equations)

    def refined_again(self, start: _Found) -> _Found:
        """``refined`` from a fit to other tracks, or under another noise."""
        trust = right_tracks(start.fit, self.tracks(start.place))
        return self.refined(start._replace(fit=replace(start.fit, trust=trust)))

    def refined_with_noise(self, start: _Found) -> _Found:
        """``refined`` with the noise that each part of the image has at the start."""
        return self.with_noise_of(start).refined_again(start)

    def refined_without_dashboard(self, start: _Found) -> _Found:
        """``refined_with_noise`` after a fit in which the lower third of the image has little weight.

        A dashboard or a handlebar there moves with the camera. A fit to it and to the scene is a local optimum.
        """
        tracks = self.tracks(start.place)
        y = tracks.ends[tracks.starts[:-1], 1]
        little = self.with_noise(np.where(y > np.quantile(y, 2.0 / 3.0), _LITTLE_WEIGHT, 1.0))
        return self.refined_with_noise(little.refined_again(start))

    def _normalised(self, found: _Found) -> float:
        """Logarithm of evidence that can be compared with that under other error distributions of these tracks."""
        tails, freedom = found.fit.tails, self.tracks(found.place).freedom
        each = scipy.special.gammaln(0.5 * (tails.nu + freedom)) - scipy.special.gammaln(0.5 * tails.nu)
        each -= 0.5 * freedom * np.log(np.pi * tails.nu * (self._noise * tails.scale) ** 2)
        wrong = -freedom * np.log(MOST_NOISE_PX)  # outliers have a uniform distribution in all fits
        return found.evidence + self._share * float(np.sum(np.where(found.fit.trust > 0.0, each, wrong)))

    def beside(self, found: _Found, follows: FloatArray, step: FloatArray) -> _Found:
        """The fit at a place near that of another one, with the same prior and error distribution.

        Args:
            follows: derivative (6 controls, axes) of the spline by the place, negated; the fit starts along it.
            step: (2,) from the other place.
        """
        (_, place, other), near = found, found.place.moved(step)
        taken = np.subtract(near, place)[: self.axes]
        follow, own = np.split(-follows @ taken, [-len(self._marginal) or len(follows)])
        place = near.moved(np.concatenate([np.zeros(2), own]))
        problem = _Joint(self, other, self._marginal)
        here = descend(problem, problem.at(moved(other.curve, follow), place), _STEPS_BESIDE, DAMPING)
        return self._found(here.place, replace(other, curve=here.curve))

    def follows(self, found: _Found) -> FloatArray:
        """Minus the derivative (6 controls + m, axes) of spline and principal point by ratio and focal length."""
        (_, place, other), tracks, axes = found, self.tracks(found.place), self.axes
        here = _Joint(self, other, self._free).at(other.curve, place).equations
        lower, border = band_factor(anchored(here, other.curve, tracks, ANCHORED)), here.border
        assert border is not None
        follows = band_solve(lower, border.mixed)
        left = border.corner - border.mixed.T @ follows
        own = np.asarray(np.linalg.solve(left[axes:, axes:], left[axes:, :axes]), dtype=np.float64)
        return np.concatenate([follows[:, :axes] - follows[:, axes:] @ own, own])

    def most_evident(self, start: _Found) -> tuple[_Found, FloatArray]:
        """The fit of largest evidence and the covariance (2, 2) of its place, by Newton's method on differences.

        The fit of largest probability ignores how the volume of possible splines changes with the place. The
        second row and column are 0 if the focal length is given.
        """
        best, axes, reach = start, self.axes, _REACH[1].copy()
        out = np.zeros((2, 2))
        for _ in range(_STEPS):
            best = best._replace(place=best.place.inside(reach))
            follows, steps = self.follows(best), np.diag(reach)
            near = [np.zeros(2), *steps[:axes], *-steps[:axes], *([steps[0] + steps[1]] if axes > 1 else [])]
            places = _in_threads(partial(self.beside, best, follows), near)
            here, *others = (each.evidence for each in places)
            ahead, behind = np.array(others[:axes]), np.array(others[axes : 2 * axes])
            H = np.diag(2.0 * here - ahead - behind)
            if axes > 1:
                H[0, 1] = H[1, 0] = ahead[0] + ahead[1] - here - others[-1]
            values, vectors = np.linalg.eigh(H / np.outer(reach[:axes], reach[:axes]))
            inverse = (vectors / np.maximum(np.abs(values), 1.0)) @ vectors.T
            out[:axes, :axes] = inverse
            step = inverse @ ((ahead - behind) / (2.0 * reach[:axes]))
            step *= np.min(np.minimum(1.0, _LARGEST_STEP[:axes] / np.maximum(np.abs(step), 1e-9)))
            there = self.beside(best, follows, step)
            if there.evidence >= here:
                best = self._found(*self._fitted(there.place, there.fit, self._marginal, fixed=True))
            sigma = np.sqrt(np.diagonal(out))
            reach = np.clip(np.where(sigma > 0.0, sigma, reach), *_REACH)
            if np.all(np.abs(step) <= 0.3 * sigma[:axes]):
                break
        return best, out

    def dispersion(self, found: _Found, covariance: FloatArray) -> float:
        """Factor on the covariance (2, 2) of a place for correlated errors of tracks in one part of the image."""
        tracks, follows, fitted = self.tracks(found.place), self.follows(found), found.fit
        inverse = covariance[: self.axes, : self.axes]
        scores = np.zeros((len(tracks), self.axes))
        factor = 0.5 * self._share * fitted.trust * (fitted.tails.nu + tracks.freedom)
        for axis, step in enumerate(np.diag(np.sqrt(np.diagonal(inverse)))):
            ends = [self.beside(found, follows, sign * step) for sign in (-1.0, 1.0)]
            spread = fitted.tails.nu * fitted.tails.scale**2
            costs = [factor * np.log1p(each.fit.equations.squares / spread) for each in ends]
            scores[:, axis] = (costs[1] - costs[0]) / (ends[1].place[axis] - ends[0].place[axis])
        groups = tiles(tracks.ends[tracks.starts[:-1], :2])
        shared = shared_error_factor(scores @ inverse, groups, inverse, self.axes)
        return self._extra * shared * variance_factor(len(np.unique(groups)) - 1.0, self.axes)

    def result(self, found: _Found, covariance: FloatArray, probability: float) -> SequenceRatio:
        """The result for a place with its covariance (2, 2); the ratio is limited to at most 1."""
        place, tracks, trust = found.place, self.tracks(found.place), found.fit.trust
        ratio, deviation = _truncated(place.ratio, float(np.hypot(np.sqrt(covariance[0, 0]), self._shared)))
        # Number of windows that each track extends over.
        spans = np.maximum(np.round(np.diff(tracks.starts) / (1 if self._linked else 2)) - 1.0, 1.0)
        return SequenceRatio(
            scanning=self._scanning,
            probability=probability,
            ratio=ratio,
            sigma=deviation,
            noise_px=noise_px(found.fit.tails),
            used=int(np.sum(spans[trust > 0.0])),
            total=int(np.sum(spans)),
            log_focal=place.log_focal,
            log_focal_sigma=float(np.sqrt(covariance[1, 1])),
        )


def _truncated(ratio: float, sigma: float) -> tuple[float, float]:
    """Mean and standard deviation of a normal distribution truncated to possible ratios."""
    fine = np.linspace(_LEAST, 1.0, 981)
    density = np.exp(-0.5 * ((fine - ratio) / max(sigma, 1e-3)) ** 2)
    mean = float(density @ fine / np.sum(density))
    return mean, float(np.sqrt(density @ (fine - mean) ** 2 / np.sum(density)))


def _with_smaller_rotations(curve: Curve, factor: float) -> Curve:
    """The spline with rotations divided by a factor, which compensates a focal length longer by this factor."""
    if factor == 1.0:
        return curve
    return make_curve(curve.first, curve.interval, so3.exp(so3.log(curve.R) / factor), curve.p)
