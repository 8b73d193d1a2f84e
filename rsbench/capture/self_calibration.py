"""The focal length of a rig or of one camera, and k1 of a rig, from matches while the camera turns.

Cards of real rigs are a little wrong. A wrong focal length or lens bends what a rotation does to the image, so
matches of a rig that turns show it, beside motion and shutter; matches of a rig that moves straight on do not.

Pairs of frames of one camera are less certain than the noise of their matches says: a hand shakes between two
frames, and motion that no model describes is taken for a focal length. Only the scatter from pair to pair shows by
how much, so this scatter, with a prior on it, counts as an error of each pair.
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
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions

_TELLING = 0.5
"""Largest standard deviation of a determined value over the prior's."""
_LEAST_TURN = np.deg2rad(0.25)
"""Per frame period: where a rig turns less, the focal length follows errors of the calibration more than the
motion, and is not estimated. A straight drive (KITTI) gave one 6 % too long, at a stated standard deviation of 2
%."""
_FEWEST_TURNS = 3
"""Windows of a rig whose rows show that its calibration errs: only their scatter shows how much of that error the
focal length takes up (KITTI: single windows are off by up to eleven standard deviations)."""
_LEFT_OVER = 0.03
"""Relative error of a focal length where the calibration errs by more than its terms describe: a KITTI excerpt
that turns gave 4 % too little, at a standard deviation of 1 % by the scatter of its windows."""
_TOGETHER = np.array([2e-4, 2e-4])
"""Relative error of a focal length, and error of k1, by errors that matches of pictures share: without it the
deviations of 21 pairs of traced frames were too small by a half (``benchmarks/wrong_cards.py``)."""
_MOST_ROUNDS, _SETTLED = 4, 0.1
"""Behind a lens the error is linear only nearby: estimated again until it moves by this share of its deviation."""
_TERMS = [FOCAL, RADIAL]


@dataclass(frozen=True, kw_only=True)
class FoundCamera:
    """A rig as its card has it, except for what was estimated of its cameras."""

    rig: StereoRig
    sigma: CardSigma
    """Of estimated values; the card's for others."""
    determined: tuple[bool, bool]
    """Whether the focal length and k1 were estimated; where not, the rig has the card's."""
    k1_later: bool = False
    """Whether rows show that the calibration errs: k1 is then estimated with its other errors, and is no lens
    here."""

    def words(self, given: StereoRig, sigma: CardSigma) -> str:
        """Such as "focal length 545.9 +- 0.4 px (card: 520.0 +- 20.0)"."""
        parts, later = list[str](), "is found with the errors of the calibration that rows show"
        undetermined = "as the card has it: the matches cannot tell; turn the rig, or give more frames"
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
    """Focal length and k1 of a rig from the matches of one or more pairs of times, with all else that is unknown.

    Where rows show that the calibration errs, k1 is one of these errors and stays the card's here.

    Args:
        sigma: of the card; values with 0 are not estimated.
        given: as ``known_of`` takes it; with a readout ratio alone, rows are read from the top.

    Raises:
        RsbenchError: a deviation of k1 for a lens that has none.
    """
    given, lens = given or KnownInputs(), rig.camera.lens
    if sigma.k1 and lens is not None and lens.model == "double-sphere":
        raise RsbenchError(f"k1_sigma = {sigma.k1}: a double-sphere lens has no k1; leave it out")
    if given.readout_ratio is not None and given.scanning is None:
        given = replace(given, scanning=Scanning())
    known = known_of(windows[0], rig, given)
    later = sigma.k1 > 0.0 and known.calibration_sigma[OFFSET] > 0.0
    found, determined, last = rig, np.zeros(2, dtype=np.bool_), np.zeros(2)
    for _ in range(_MOST_ROUNDS):
        prior, sigmas = np.array([sigma.focal / found.camera.fx, sigma.k1]), np.array(known.calibration_sigma)
        sigmas[_TERMS] = np.where(prior > 0.0, prior, sigmas[_TERMS])
        expecting = replace(known, calibration_sigma=tuple(sigmas.tolist()))
        errors = _errors_of(windows, found, expecting, robust, seed)
        mended = None if errors is None else _mended(found, np.where(errors.determined, errors.values, 0.0))
        lost = errors is None or not np.any(errors.determined) or np.any(determined & ~errors.determined)
        if errors is None or mended is None or lost:
            return FoundCamera(rig=rig, sigma=sigma, determined=(False, False), k1_later=later)
        found, determined, last = mended, errors.determined, errors.sigma * (mended.camera.fx, 1.0)
        known = replace(known, scans=errors.scans)
        if found.camera.lens is None or np.all(np.abs(errors.values) < _SETTLED * errors.sigma):
            break
    focal, k1 = np.where(determined, last, (sigma.focal, sigma.k1)).tolist()
    both = (bool(determined[0]), bool(determined[1]))
    return FoundCamera(rig=found, sigma=CardSigma(focal=focal, k1=k1), determined=both, k1_later=later)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Errors:
    """Relative error by which a focal length is too short, and error by which k1 is too small, (2,) each."""

    values: FloatArray
    sigma: FloatArray
    determined: BoolArray
    scans: tuple[Scans, ...]
    """Under which, beyond doubt."""


def _errors_of(
    windows: Sequence[Correspondences], rig: StereoRig, known: Known, robust: RobustOptions | None, seed: int
) -> _Errors | None:
    """From the windows in which the rig turns; None where they show nothing."""
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
    errs = known.calibration_sigma[OFFSET] > 0.0 and best.scans.together  # rows of other scans differ anyway
    if errs and len(turning) < _FEWEST_TURNS:
        return None
    prior, left_over = np.array(known.calibration_sigma)[_TERMS], np.array([_LEFT_OVER if errs else 0.0, 0.0])
    sigma = np.hypot(np.hypot(np.array(best.calibration_sigma)[_TERMS], _TOGETHER), left_over)
    determined = (prior > 0.0) & (sigma <= _TELLING * prior) & [True, not errs]
    values = np.array(best.calibration)[_TERMS]
    return _Errors(values=values, sigma=sigma, determined=determined, scans=(best.scans,))


def _mended(rig: StereoRig, errors: FloatArray) -> StereoRig | None:
    """A rig without errors (2,) of its focal length and k1; None where its lens would fold within the image."""
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
    """Angle, rad, per frame period, under the best fit; 0 where there is none."""
    if window.evidence is None:
        return 0.0
    best = max(window.evidence.peaks.values(), key=lambda peak: peak.value)
    return float(np.linalg.norm(best.fit.theta[:3]))


# One camera

PRIOR = 0.35
"""Standard deviation of the logarithm of a focal length over the width of the image, about 0: lenses from a half
to two widths, of 90 to 28 degrees, are within two of them."""
_MATCHES, _SAMPLES = 400, 100
"""Of a pair, and of samples of them: neighbours in dense flow have common errors."""
_MODELS = ("inertial", "accelerated")
_NEARBY, _PAIR_ROUNDS = 0.3, 4
"""Relative error of a focal length that is found at once; beyond it, the search starts again from there."""
_LEAST_PAIR_TURN, _LEAST_PAIR_MOVED = np.deg2rad(1.0), 0.01
"""Per frame period, and the widths by which that moves the image: a smaller turn shows the errors of the flow more
than the focal length, and a focal length that is far too short makes turns look large."""
_EXPECTED, _EXPECTED_WEIGHT = 0.25, 4.0
"""Scatter of the logarithm from pair to pair, before any is seen, and the number of pairs that this counts for."""
_SHARED = 0.05
"""Error that the pairs of a video have in common."""
_SHARED_BY_TRACKS = 0.02
"""Error that the frames of a video have in common where one trajectory explains them."""
_LEAST_TURNING = 0.5
"""Share of the pairs: where few seem to turn, they do so by their errors."""
_BROKEN, _LEAST_GOOD = 3.0, 0.75
"""Prior deviations beyond which a pair shows only its shake, and the share of pairs that must be within."""
_TELLING_PAIRS = 0.65
"""Largest standard deviation of a determined value over the prior's."""


class PairFocal(NamedTuple):
    """The focal length from one pair of frames."""

    log: float
    """Logarithm of the focal length over the width of the image."""
    sigma: float
    """From the noise of the matches alone."""
    turn: float
    """Radians per frame period."""

    @property
    def turns(self) -> bool:
        """Whether the camera turned enough to show it."""
        return self.turn >= _LEAST_PAIR_TURN and self.turn * np.exp(self.log) >= _LEAST_PAIR_MOVED


@dataclass(frozen=True, kw_only=True)
class FoundFocal:
    """Focal length of a camera, px."""

    focal: float
    """The most probable one; where the pairs do not determine it, the width of the image."""
    sigma: float
    determined: bool
    pairs: int
    """That it is estimated from."""


def focal_of_pair(
    matches: FloatArray, size: tuple[int, int], shutter: RollingShutter, options: RobustOptions, seed: int = 0
) -> PairFocal | None:
    """From matches (n, 4) x0, y0, x1, y1, px, in random order; None where no motion explains them.

    Args:
        size: width and height, px.
        shutter: of the camera.
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
    """The focal length found with the ratio, of images of this width; None: it is not determined."""
    best = capture.likeliest
    error, sigma = (0.0, 0.0) if best is None else (best.calibration[FOCAL], best.calibration_sigma[FOCAL])
    log_sigma = float(np.hypot(sigma / (1.0 - error), _SHARED_BY_TRACKS))
    if not sigma or log_sigma > _TELLING_PAIRS * PRIOR:
        return None
    focal = width / (1.0 - error)
    return FoundFocal(focal=focal, sigma=focal * log_sigma, determined=True, pairs=capture.windows)


def conclude_focal(pairs: Sequence[PairFocal | None], width: int) -> FoundFocal:
    """From all pairs of a video of this width together."""
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
    if sigma > _TELLING_PAIRS * PRIOR:
        return undetermined
    focal = width * float(np.exp(mean * sigma**2 / variance))
    return FoundFocal(focal=focal, sigma=sigma * focal, determined=True, pairs=len(good))
