"""Self-calibration: the focal length of a rig or of one camera, and k1 of a rig, from matches during a rotation.

Calibrations of real rigs are slightly wrong. A wrong focal length or lens distorts the image motion that a
rotation causes, so it can be estimated with motion and shutter while the rig rotates, not while it translates.

For one camera, the focal length of a pair of frames is less certain than the noise of its matches suggests: a
hand-held camera shakes between two frames, and motion that no model describes changes the estimated focal length.
The error of each pair therefore includes the scatter between pairs, which has a prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rsbench.capture.calibration import FOCAL, NO_ERRORS, OFFSET, RADIAL, CardSigma
from rsbench.capture.hypotheses import Known, KnownInputs, Scans, scans_of
from rsbench.capture.shutter_decision import as_global, examine_alone, known_of
from rsbench.capture.two_frame_estimate import CERTAIN, Capture, Window, conclude, examine
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import BoolArray, Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions

_DETERMINED_SHARE = 0.5
"""A value is determined if its standard deviation is at most this share of the prior's."""
_LEAST_TURN = np.deg2rad(0.25)
"""Least rotation per frame period for an estimate: below it, calibration errors affect the focal length more than
the motion does. A straight drive (KITTI) gave one 6 % too long, at a stated standard deviation of 2 %."""
_FEWEST_TURNS = 3
"""Fewest rotating windows of a rig whose rows show calibration errors: only the scatter of the windows shows how
these affect the focal length (KITTI: single windows are off by up to eleven standard deviations)."""
_EXTRA_SIGMA = 0.03
"""Relative error of a focal length due to calibration errors that ``TERMS`` do not describe: a rotating KITTI
excerpt gave 4 % too little, at a standard deviation of 1 % by the scatter of its windows."""
_COMMON_SIGMA = np.array([2e-4, 2e-4])
"""Relative error of a focal length, and error of k1, due to correlated errors of image matches: without it the
deviations of 21 pairs of traced frames were too small by a half (``benchmarks/wrong_cards.py``)."""
_MOST_ROUNDS, _CONVERGED = 4, 0.1
"""With a lens, errors are only locally linear; they are estimated again until below this share of sigma."""
_TERMS = [FOCAL, RADIAL]


@dataclass(frozen=True, kw_only=True)
class FoundCamera:
    """A rig with the values of its card, except for those that were estimated."""

    rig: StereoRig
    sigma: CardSigma
    """Standard deviations of the estimated values; the card's for others."""
    determined: tuple[bool, bool]
    """Whether the focal length and k1 were estimated; otherwise the rig has the card's."""
    k1_later: bool = False
    """Whether rows show calibration errors: k1 is then estimated with these, and the rig's lens stays as given."""

    def words(self, given: StereoRig, sigma: CardSigma) -> str:
        """A report such as "focal length 545.9 +- 0.4 px (card: 520.0 +- 20.0)"."""
        parts, later = list[str](), "is estimated with the calibration errors that the rows show"
        undetermined = "as on the card: the matches do not determine it; rotate the rig, or give more frames"
        if sigma.focal:
            card = f"(card: {given.camera.fx:.1f} +- {sigma.focal:.1f})"
            found = f"{self.rig.camera.fx:.1f} +- {self.sigma.focal:.1f} px"
            parts.append(f"focal length {found if self.determined[0] else undetermined} {card}")
        if sigma.k1:
            card = f"(card: {_k1(given):.3f} +- {sigma.k1:.3f})"
            found = f"{_k1(self.rig):.4f} +- {self.sigma.k1:.4f}"
            otherwise = later if self.k1_later else undetermined
            parts.append(f"k1 {found if self.determined[1] else otherwise} {card}")
        return "; ".join(parts)


def find_camera(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    sigma: CardSigma,
    given: KnownInputs | None = None,
    robust: RobustOptions | None = None,
    seed: int = 0,
) -> FoundCamera:
    """Estimate the focal length and k1 of a rig from one or more windows, together with all other unknowns.

    If rows show calibration errors, k1 is estimated with these later, and keeps the card's value here.

    Args:
        windows: matches of two frame times each.
        sigma: standard deviations of the card's values; values with 0 are not estimated.
        given: as for ``known_of``.

    Raises:
        RsbenchError: ``sigma.k1`` is given for a lens model without k1.
    """
    given, lens = given or KnownInputs(), rig.camera.lens
    if sigma.k1 and lens is not None and lens.model == "double-sphere":
        raise RsbenchError(f"k1_sigma = {sigma.k1}: a double-sphere lens has no k1; leave it out")
    known = known_of(windows[0], rig, given)
    later = sigma.k1 > 0.0 and known.calibration_sigma[OFFSET] > 0.0
    found, determined, last = rig, np.zeros(2, dtype=np.bool_), np.zeros(2)
    for _ in range(_MOST_ROUNDS):
        prior, sigmas = np.array([sigma.focal / found.camera.fx, sigma.k1]), np.array(known.calibration_sigma)
        sigmas[_TERMS] = np.where(prior > 0.0, prior, sigmas[_TERMS])
        expecting = replace(known, calibration_sigma=tuple(sigmas.tolist()))
        errors = _errors_of(windows, found, expecting, robust, seed)
        better = None if errors is None else _corrected(found, np.where(errors.determined, errors.values, 0.0))
        lost = errors is None or not np.any(errors.determined) or np.any(determined & ~errors.determined)
        if errors is None or better is None or lost:
            return FoundCamera(rig=rig, sigma=sigma, determined=(False, False), k1_later=later)
        found, determined, last = better, errors.determined, errors.sigma * (better.camera.fx, 1.0)
        known = replace(known, scans=errors.scans)
        if found.camera.lens is None or np.all(np.abs(errors.values) < _CONVERGED * errors.sigma):
            break
    focal, k1 = np.where(determined, last, (sigma.focal, sigma.k1)).tolist()
    both = (bool(determined[0]), bool(determined[1]))
    return FoundCamera(rig=found, sigma=CardSigma(focal=focal, k1=k1), determined=both, k1_later=later)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Errors:
    """(2,) relative error by which the focal length is too short, and error by which k1 is too small."""

    values: FloatArray
    sigma: FloatArray
    determined: BoolArray
    scans: tuple[Scans, ...]
    """The scans under which these errors were estimated, which are certain."""


def _errors_of(
    windows: Sequence[Correspondences], rig: StereoRig, known: Known, robust: RobustOptions | None, seed: int
) -> _Errors | None:
    """Estimate the errors from the windows in which the rig rotates; None if these do not suffice."""
    examined = [(each, examine(each, rig, known, robust, seed)) for each in windows]
    turning = [(each, window) for each, window in examined if _turn(window) >= _LEAST_TURN]
    if not turning:
        return None
    capture = conclude([window for _, window in turning])
    if known.ratio is None:
        capture = as_global(capture, [each for each, _ in turning], rig, known)
    best = capture.likeliest
    if best is None or best.probability < CERTAIN:
        return None
    wrong_rows = known.calibration_sigma[OFFSET] > 0.0 and best.scans.together  # else rows differ by the scans
    if wrong_rows and len(turning) < _FEWEST_TURNS:
        return None
    prior, extra = np.array(known.calibration_sigma)[_TERMS], np.array([_EXTRA_SIGMA if wrong_rows else 0.0, 0.0])
    sigma = np.hypot(np.hypot(np.array(best.calibration_sigma)[_TERMS], _COMMON_SIGMA), extra)
    determined = (prior > 0.0) & (sigma <= _DETERMINED_SHARE * prior) & [True, not wrong_rows]
    values = np.array(best.calibration)[_TERMS]
    return _Errors(values=values, sigma=sigma, determined=determined, scans=(best.scans,))


def _corrected(rig: StereoRig, errors: FloatArray) -> StereoRig | None:
    """The rig corrected for errors (2,) of focal length and k1; None if its lens would fold within the image."""
    focal, k1 = map(float, errors)
    camera, lens = rig.camera, rig.camera.lens or Lens(model="brown-conrady")
    lens = replace(lens, k1=lens.k1 + k1) if k1 else camera.lens
    try:
        camera = replace(camera, fx=camera.fx / (1.0 - focal), fy=camera.fy / (1.0 - focal), lens=lens)
    except ValueError:
        return None
    return replace(rig, camera=camera)


def _k1(rig: StereoRig) -> float:
    return 0.0 if rig.camera.lens is None else rig.camera.lens.k1


def _turn(window: Window) -> float:
    """Rotation of the best fit, rad per frame period; 0 if there is no fit."""
    if window.evidence is None:
        return 0.0
    best = max(window.evidence.peaks.values(), key=lambda peak: peak.value)
    return float(np.linalg.norm(best.fit.theta[:3]))


# One camera

PRIOR = 0.35
"""Prior standard deviation of log(focal length / image width) about 0: two of them cover lenses from half a width
to two widths, 90 to 28 degrees."""
CENTRE_SIGMA = 0.01
"""Prior standard deviation of the principal point of an unknown camera about the image centre, image widths."""
_MATCHES, _SAMPLES = 400, 100
"""Number of matches of a pair that are used, as neighbours in dense flow are correlated; RANSAC iterations."""
_MODELS = ("inertial", "accelerated")
_NEARBY, _PAIR_ROUNDS = 0.3, 4
"""Relative error of a focal length up to which one fit suffices; otherwise the search restarts from its result."""
_LEAST_PAIR_TURN, _LEAST_PAIR_MOVED = np.deg2rad(1.0), 0.01
"""Least rotation of a pair, rad per frame period, and least image shift by it, in widths: errors of the flow
affect smaller rotations more, and a focal length that is far too short makes the rotation look large."""
_EXPECTED, _EXPECTED_WEIGHT = 0.25, 4.0
"""Prior of the scatter of the logarithm between pairs, and the number of pairs that this prior is worth."""
_SHARED = 0.05
"""Relative error that all pairs of a video have in common."""
_SHARED_BY_TRACKS = 0.02
"""The same if one trajectory explains all frames of the video."""
_LEAST_TURNING = 0.5
"""Least share of rotating pairs: if only a few appear to rotate, this is due to their errors."""
_BROKEN, _LEAST_GOOD = 3.0, 0.75
"""Prior deviations beyond which a pair is an outlier because of shake, and the least share of inliers."""
_DETERMINED_SHARE_PAIRS = 0.65
"""A focal length is determined if the standard deviation of its logarithm is at most this share of the prior's."""


class PairFocal(NamedTuple):
    """The focal length from one pair of frames."""

    log: float
    """Logarithm of focal length divided by image width."""
    sigma: float
    """Standard deviation of ``log`` due to the noise of the matches alone."""
    turn: float
    """Rotation, radians per frame period."""

    @property
    def turns(self) -> bool:
        """Whether the camera rotated enough to determine the focal length."""
        return self.turn >= _LEAST_PAIR_TURN and self.turn * np.exp(self.log) >= _LEAST_PAIR_MOVED


@dataclass(frozen=True, kw_only=True)
class FoundFocal:
    """Focal length of a camera, px."""

    focal: float
    """The most probable focal length; the image width if the pairs do not determine it."""
    sigma: float
    determined: bool
    pairs: int
    """Number of pairs that were used."""


def focal_of_pair(
    matches: FloatArray, size: tuple[int, int], shutter: RollingShutter, options: RobustOptions, seed: int = 0
) -> PairFocal | None:
    """The focal length from matches (n, 4) x0, y0, x1, y1, px, in random order; None if no motion explains them.

    Args:
        size: width and height of the image, px.
        shutter: shutter of the camera.
    """
    width, height = size
    quick = replace(options, max_iterations=min(options.max_iterations, _SAMPLES))
    expected = np.array(NO_ERRORS)
    expected[FOCAL] = PRIOR
    known = Known(
        ratio=shutter.readout_ratio,
        scans=(scans_of(shutter),),
        delay=0.0,
        calibration_sigma=tuple(expected.tolist()),
        models=_MODELS,
    )
    focal, found = float(width), None
    for _ in range(_PAIR_ROUNDS):
        camera = PinholeCamera.centred(width, height, focal)
        capture = conclude([examine_alone(matches[:_MATCHES], camera, known, quick, seed)])
        best = capture.likeliest
        if best is None:
            return None
        error, focal = best.calibration[FOCAL], focal / (1.0 - best.calibration[FOCAL])
        turn = float(np.linalg.norm(capture.peaks[capture.motion_model].fit.theta[:3]))
        found = PairFocal(float(np.log(focal / width)), best.calibration_sigma[FOCAL] / (1.0 - error), turn)
        if abs(error) < _NEARBY or abs(found.log) > _BROKEN * PRIOR:
            break
    return found


def focal_of_capture(capture: Capture, width: int) -> FoundFocal | None:
    """The focal length, px, estimated with the readout ratio, for an image width; None: undetermined."""
    best = capture.likeliest
    error, sigma = (0.0, 0.0) if best is None else (best.calibration[FOCAL], best.calibration_sigma[FOCAL])
    log_sigma = float(np.hypot(sigma / (1.0 - error), _SHARED_BY_TRACKS))
    if not sigma or log_sigma > _DETERMINED_SHARE_PAIRS * PRIOR:
        return None
    focal = width / (1.0 - error)
    return FoundFocal(focal=focal, sigma=focal * log_sigma, determined=True, pairs=capture.windows)


def conclude_focal(pairs: Sequence[PairFocal | None], width: int) -> FoundFocal:
    """Combine the pairs of a video of this image width to one focal length."""
    solved = [each for each in pairs if each is not None]
    turning = [each for each in solved if each.turns]
    good = [each for each in turning if abs(each.log) <= _BROKEN * PRIOR]
    undetermined = FoundFocal(focal=float(width), sigma=PRIOR * width, determined=False, pairs=len(good))
    if not good or len(good) < _LEAST_GOOD * len(turning) or len(turning) < _LEAST_TURNING * len(solved):
        return undetermined
    logs, own = np.array([each.log for each in good]), np.array([each.sigma for each in good])
    scatter = _EXPECTED
    for _ in range(10):
        weights = 1.0 / (scatter**2 + own**2)
        mean = float(weights @ logs / np.sum(weights))
        squares = _EXPECTED_WEIGHT * _EXPECTED**2 + float(np.sum((logs - mean) ** 2))
        scatter = float(np.sqrt(squares / (_EXPECTED_WEIGHT + len(good) - 1)))
    variance = 1.0 / float(np.sum(weights)) + _SHARED**2
    sigma = (1.0 / variance + 1.0 / PRIOR**2) ** -0.5
    if sigma > _DETERMINED_SHARE_PAIRS * PRIOR:
        return undetermined
    focal = width * float(np.exp(mean * sigma**2 / variance))
    return FoundFocal(focal=focal, sigma=sigma * focal, determined=True, pairs=len(good))
