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
"""Per frame period: where a rig turns less, errors of the calibration say more of a focal length than the motion
does, and it is not asked. From a straight drive (KITTI) it came out 6 % too long, at a stated deviation of 2 %."""
_FEWEST_TURNS = 3
"""Windows of a rig whose rows show that its calibration errs: by their scatter alone is it known how much of that
they take for a focal length (KITTI: single windows are off by up to eleven deviations)."""
_LEFT_OVER = 0.03
"""Share of a focal length by which it is off, about, where the calibration errs in more than its terms hold: found
4 % too short from a KITTI excerpt that turns, at a deviation of 1 % by the scatter of its windows."""
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
        open_ = "the matches cannot tell, so the card's is used"
        return f"focal length: {open_} ({card}); turn the rig, or give more frames"


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
    scanning = scanning if readout_ratio is None else scanning or Scanning()
    known = known_of(windows[0], rig, readout_ratio, scanning)
    sigmas, rows_differ = list(known.calibration_sigma), any(known.calibration_sigma)
    sigmas[FOCAL] = prior
    known = replace(known, calibration_sigma=tuple(sigmas))
    examined = [(each, examine(each, rig, known, robust, seed)) for each in windows]
    turning = [(each, window) for each, window in examined if _turn(window) >= _LEAST_TURN]
    if not turning:
        return None
    capture = conclude([window for _, window in turning])
    if readout_ratio is None:
        capture = as_global(capture, [each for each, _ in turning], rig, known)
    best = capture.likeliest
    if best is None or best.probability < CERTAIN:
        return None
    errs = rows_differ and best.scans.together  # of cameras that read apart the rows differ anyway
    if errs and len(turning) < _FEWEST_TURNS:
        return None
    left_over = _LEFT_OVER if errs else 0.0
    return best.calibration[FOCAL], float(np.hypot(best.calibration_sigma[FOCAL], left_over))


def _turn(window: Window) -> float:
    """Angle, rad, per frame period, under what fits best; 0 where nothing does."""
    if window.evidence is None:
        return 0.0
    best = max(window.evidence.peaks.values(), key=lambda peak: peak.value)
    return float(np.linalg.norm(best.fit.theta[:3]))
