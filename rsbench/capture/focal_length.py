"""The focal length of both cameras from the matches of a moving rig.

Cards of real rigs are a little wrong. A wrong focal length bends what a rotation does to the image, so matches of
a rig that turns show it, beside motion and shutter; of one that drives straight on they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration_errors import FOCAL
from rsbench.capture.estimate import CERTAIN, Window, conclude, examine
from rsbench.capture.settle import as_global, known_of
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning
from rsbench.solvers.engine.robust_motion import RobustOptions

_TELLING = 0.5
"""Standard deviation over the prior's, at most, of what is told."""
_LEAST_TURN = np.deg2rad(0.25)
"""Per frame period: of rigs that turn less, errors of the calibration say more of a focal length than the motion
does. Of a straight drive (KITTI) it came out 6 % too long, at a stated deviation of 2 %."""
_MOST_ROUNDS, _SETTLED = 4, 0.1
"""Behind a lens the error is linear only nearby: again from what was found, until it moves by few deviations."""


@dataclass(frozen=True, kw_only=True)
class FoundFocal:
    """A rig as its card has it, but for what the matches say of its focal length."""

    rig: StereoRig
    sigma: float
    """px, of fx; the card's where the matches do not tell."""
    told: bool
    """Where not, the rig is the card's."""

    def words(self, given: StereoRig, sigma: float) -> str:
        """Such as "focal length 545.9 +- 0.4 px (card: 520.0 +- 20.0)"."""
        card = f"card: {given.camera.fx:.1f} +- {sigma:.1f}"
        if self.told:
            return f"focal length {self.rig.camera.fx:.1f} +- {self.sigma:.1f} px ({card})"
        return f"focal length: the matches cannot tell, so the card's is used ({card}); turn the rig"


def find_focal(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    sigma: float,
    readout_ratio: float | None = None,
    scanning: Scanning | None = None,
    robust: RobustOptions | None = None,
    seed: int = 0,
) -> FoundFocal:
    """The focal length of a rig from the matches of one or more pairs of times; all else is found beside.

    Args:
        sigma: standard deviation of the card's fx, px; fy goes with it.
        readout_ratio, scanning: as ``settle.known_of`` takes them.
    """
    found = rig
    for _ in range(_MOST_ROUNDS):
        error = _error_of(windows, found, sigma / rig.camera.fx, readout_ratio, scanning, robust, seed)
        if error is None or error[1] * found.camera.fx > _TELLING * sigma:
            return FoundFocal(rig=rig, sigma=sigma, told=False)
        e, deviation = error
        camera = found.camera
        found = replace(found, camera=replace(camera, fx=camera.fx / (1.0 - e), fy=camera.fy / (1.0 - e)))
        if rig.camera.lens is None or abs(e) < _SETTLED * deviation:
            break
    return FoundFocal(rig=found, sigma=deviation * found.camera.fx, told=True)


def _error_of(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    prior: float,
    readout_ratio: float | None,
    scanning: Scanning | None,
    robust: RobustOptions | None,
    seed: int,
) -> tuple[float, float] | None:
    """The share by which the focal length is too short, and its deviation; None where the windows do not tell."""
    known = known_of(windows[0], rig, readout_ratio, scanning)
    sigmas = list(known.calibration_sigma)
    sigmas[FOCAL] = prior
    known = replace(known, calibration_sigma=tuple(sigmas))
    examined = [examine(each, rig, known, robust, seed) for each in windows]
    if not _turns(examined):
        return None
    capture = conclude(examined)
    if readout_ratio is None:
        capture = as_global(capture, windows, rig, known)
    best = capture.likeliest
    if best is None or best.probability < CERTAIN:
        return None
    return best.calibration[FOCAL], best.calibration_sigma[FOCAL]


def _turns(examined: Sequence[Window]) -> bool:
    """Whether the rig turns in half of the windows, under what fits each best."""
    peaks = [max(each.evidence.peaks.values(), key=lambda p: p.value) for each in examined if each.evidence]
    return bool(peaks) and float(np.median([np.linalg.norm(peak.fit.theta[:3]) for peak in peaks])) >= _LEAST_TURN
