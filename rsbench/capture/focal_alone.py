"""The focal length of one camera from matches between its frames, where these turn.

A rotation bends the image by what the focal length is, so each pair of frames that turns shows it, beside its
motion. How well is not what the noise of its matches says: between two frames a hand shakes, and what no motion
model holds is taken for a focal length. Only how pairs scatter shows by how much, so their scatter counts for each
of them, with what is expected of it before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rsbench.capture.calibration_errors import FOCAL, NO_ERRORS
from rsbench.capture.camera_alone import examine_alone
from rsbench.capture.estimate import conclude
from rsbench.capture.hypotheses import Known
from rsbench.capture.scans import scans_of
from rsbench.core.camera import PinholeCamera
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions

PRIOR = 0.35
"""Standard deviation of the logarithm of a focal length over the width of the image, about 0: lenses from a half
to two widths, of 90 to 28 degrees, are within two of them."""
_MATCHES, _SAMPLES = 400, 100
"""Of a pair, and of samples of them: neighbours in dense flow err alike."""
_MODELS = ("inertial", "accelerated")
_NEARBY, _ROUNDS = 0.3, 4
"""Share of a focal length that is found at once; one that is off by more is looked for again from there."""
_LEAST_TURN, _LEAST_MOVED = np.deg2rad(1.0), 0.01
"""Per frame period, and the widths by which that moves the image: what turns less shows more of the errors of the
flow than of a focal length, and a focal length that is far too short makes turns look large."""
_EXPECTED, _EXPECTED_WEIGHT = 0.25, 4.0
"""Scatter of the logarithm from pair to pair, before any is seen, and the number of pairs that this counts for."""
_SHARED = 0.05
"""By which the pairs of a video err alike."""
_LEAST_TURNING = 0.5
"""Share of the pairs: where few seem to turn, they seem so by what they err."""
_BROKEN, _LEAST_GOOD = 3.0, 0.75
"""Prior deviations beyond which a pair shows its shaking alone, and the share that must not be so."""
_TELLING = 0.65
"""Standard deviation over the prior's, at most, of what is told."""


class PairFocal(NamedTuple):
    """What one pair of frames says."""

    log: float
    """Logarithm of the focal length over the width of the image."""
    sigma: float
    """By the noise of the matches alone."""
    turn: float
    """Radians per frame period."""

    @property
    def turns(self) -> bool:
        """Whether the camera turned enough to show it."""
        return self.turn >= _LEAST_TURN and self.turn * np.exp(self.log) >= _LEAST_MOVED


@dataclass(frozen=True, kw_only=True)
class FoundFocal:
    """Focal length of a camera, px."""

    focal: float
    """The most probable one; where the pairs do not tell it, the width of the image."""
    sigma: float
    told: bool
    pairs: int
    """That it rests on."""


def focal_of_pair(
    matches: FloatArray, size: tuple[int, int], shutter: RollingShutter, options: RobustOptions, seed: int = 0
) -> PairFocal | None:
    """What matches (n, 4) x0, y0, x1, y1, px, in random order, say; None where no motion explains them.

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
    for _ in range(_ROUNDS):
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


def conclude_focal(pairs: Sequence[PairFocal | None], width: int) -> FoundFocal:
    """What all pairs of a video of this width say together."""
    solved = [each for each in pairs if each is not None]
    turning = [each for each in solved if each.turns]
    good = [each for each in turning if abs(each.log) <= _BROKEN * PRIOR]
    untold = FoundFocal(focal=float(width), sigma=PRIOR * width, told=False, pairs=len(good))
    if not good or len(good) < _LEAST_GOOD * len(turning) or len(turning) < _LEAST_TURNING * len(solved):
        return untold
    logs, own = np.array([each.log for each in good]), np.array([each.sigma for each in good])
    scatter = _EXPECTED
    for _ in range(10):
        weights = 1.0 / (scatter**2 + own**2)
        mean = float(weights @ logs / np.sum(weights))
        squares = _EXPECTED_WEIGHT * _EXPECTED**2 + float(np.sum((logs - mean) ** 2))
        scatter = float(np.sqrt(squares / (_EXPECTED_WEIGHT + len(good) - 1)))
    variance = 1.0 / float(np.sum(weights)) + _SHARED**2
    sigma = (1.0 / variance + 1.0 / PRIOR**2) ** -0.5
    if sigma > _TELLING * PRIOR:
        return untold
    focal = width * float(np.exp(mean * sigma**2 / variance))
    return FoundFocal(focal=focal, sigma=sigma * focal, told=True, pairs=len(good))
