"""How one camera reads its lines, from matches between its frames: the estimator of a rig that has one camera.

A camera that turns or goes past things shows it by how far lines that are read later have moved; what lies along
its lines shows nothing, and then the words say so. Lengths are in any unit: the estimate does not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rsbench.capture.estimate import CERTAIN, Candidate, Capture, Window, conclude, examine, nearly_global
from rsbench.capture.hypotheses import Known
from rsbench.capture.scans import GLOBAL, Scans
from rsbench.capture.settle import NoMotionError, reversed_scans, shutter_of
from rsbench.capture.start import COARSE
from rsbench.capture.trajectory_shutter import capture_of_sequence, nothing_of
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import LinearMotion, Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

_MAX_SIGMA, _HARMLESS_PX = 0.1, 1.0
"""As for a rig: standard deviation of a ratio that frames are corrected with, and px that do not matter."""
_LOOK, _CLEARLY_LESS = 500, 0.97
"""Matches of a quick look at the order of frames, and the share of the noise that is less than by chance."""
_OPPOSITE: dict[Scan, Scan] = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}


def rig_of(camera: PinholeCamera) -> StereoRig:
    """A rig whose body is where this camera is, the left one; there are no matches of the right one."""
    return StereoRig(camera=camera, baseline=1.0).about("left")


def known_alone(scan: Scan | None = None) -> Known:
    """What is known of a camera whose readout ratio is not: that there is one, and perhaps its ``scan``.

    The opposite scan stays possible: it is what frames in the wrong order show. Columns are for who says so: what
    one camera's flow errs by may look like them.
    """
    said = Scans(scan or "top", scan or "top")
    return Known(scans=(GLOBAL, said, reversed_scans(said)), delay=0.0)


def examine_alone(
    matches: FloatArray, camera: PinholeCamera, known: Known, options: RobustOptions, seed: int = 0
) -> Window:
    """Matches (n, 4) x0, y0, x1, y1, px, of two frames of a camera under each hypothesis; with outliers."""
    given = Correspondences(left=matches)
    return examine(given, rig_of(camera), known, options, seed, _start(given, camera, known, options, seed))


def _start(
    matches: Correspondences, camera: PinholeCamera, known: Known, options: RobustOptions, seed: int
) -> Motion | None:
    """The motion under a shutter between those that are possible; None when there is none."""
    starts = {scans.left for scans in known.scans}
    scan, ratio = next(each for each in COARSE if ("global" if each[1] == 0.0 else each[0]) in starts)
    shutter = RollingShutter(height=camera.height, width=camera.width, readout_ratio=ratio, scan=scan)
    rng = np.random.default_rng(seed)
    found = estimate_motion(matches, rig_of(camera), shutter, RefinedSolver(one_camera=True), options, rng)
    return LinearMotion(w=found.estimate.w, d=found.estimate.d) if found.estimate.success else None


def fits_backwards(
    matches: FloatArray, camera: PinholeCamera, shutter: RollingShutter, options: RobustOptions, seed: int = 0
) -> bool:
    """Whether matches (n, 4) fit better where lines are read from the other side: a quick look, no judgement."""
    noise = list[float]()
    for scan in (shutter.scan_of("left"), _OPPOSITE[shutter.scan_of("left")]):
        seen = replace(shutter, scan=scan)
        solver, rng = RefinedSolver(motion_model="inertial", one_camera=True), np.random.default_rng(seed)
        given = Correspondences(left=matches[:: max(len(matches) // _LOOK, 1)])
        found = estimate_motion(given, rig_of(camera), seen, solver, options, rng)
        noise.append(found.estimate.noise_px or np.inf if found.estimate.success else np.inf)
    return noise[1] < _CLEARLY_LESS * noise[0]


def capture_along(
    windows: Sequence[FloatArray], camera: PinholeCamera, scan: Scan | None, seed: int = 0
) -> Capture | None:
    """What successive frames say along one way, however they shake; None where no way explains the matches.

    Args:
        windows: matches (n, 4) x0, y0, x1, y1, px, of the frames 0 and 1, 1 and 2, ...; with outliers.
        scan: as of ``known_alone``.
    """
    given, said = [Correspondences(left=each) for each in windows], scan or "top"
    scannings = Scanning(scan=said), Scanning(scan=_OPPOSITE[said])
    found = capture_of_sequence(nothing_of(given), given, rig_of(camera), scannings, seed)
    return found if found.candidates else None


def conclude_alone(windows: Sequence[Window]) -> Capture:
    """What all windows of a camera say together; a global shutter where all that they allow is one or nearly."""
    capture = conclude(windows)
    candidates = nearly_global(capture)
    return capture if candidates is None else replace(capture, candidates=candidates, named=True)


def shutter_alone(capture: Capture, camera: PinholeCamera) -> RollingShutter:
    """The shutter of the most probable candidate.

    Raises:
        NoMotionError: there is none, or the frames leave open what would matter; in words.
    """
    best = capture.likeliest
    if best is None:
        raise NoMotionError(f"cannot tell how the camera reads: {capture.reason}. {_GIVE}")
    certain = best.probability >= CERTAIN
    harmless = best.sigma * capture.moved_px <= _HARMLESS_PX or best.scans == GLOBAL
    if certain and (best.sigma <= _MAX_SIGMA or harmless):
        return shutter_of(best, rig_of(camera))
    if certain:
        how = f"{_words(best)}, but not how fast: {best.ratio:.2f} +- {best.sigma:.2f}"
    else:
        likely = [each for each in capture.candidates if each.probability > 0.1]
        how = ", or ".join(f"{_words(each)} ({each.probability:.0%})" for each in likely) or "any shutter"
    raise NoMotionError(f"cannot tell the readout ratio: the frames show {how}. {_GIVE}")


_GIVE = "Give readout_ratio in the camera's card, or frames in which the camera turns, or more frames"


def _words(candidate: Candidate) -> str:
    start = candidate.scans.left
    return "all lines read at once" if start == "global" else f"lines read from the {start}"
