"""The shutter that a correction uses: from the matches of a rig or of one camera, or an error that says why not.

``known_of`` collects what is given; it is not estimated. An estimate is used where it is certain, or where its
error does not matter. Otherwise the message names what the matches leave undetermined, what that trades against,
and the remedy. One camera that turns or passes things shows its readout by how far lines that are read later have
moved; a motion along its lines shows nothing. Lengths are in any unit there: the estimate does not depend on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rsbench.capture.calibration import FOCAL, NO_ERRORS, OFFSET, row_pattern, term_sizes
from rsbench.capture.hypotheses import ALL_SCANS, CALIBRATION, GLOBAL, MODELS, Known, Scans, scans_of
from rsbench.capture.hypothesis_ranking import COARSE, Peak
from rsbench.capture.trajectory_tracks import thinned
from rsbench.capture.two_frame_estimate import (
    CERTAIN,
    Candidate,
    Capture,
    Window,
    conclude,
    examine,
    nearly_global,
)
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

OPPOSITE: dict[Scan, Scan] = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}
_MAX_SIGMA, _HARMLESS_PX = 0.1, 1.0
"""Standard deviation of a ratio that frames are corrected with, at most; more where it moves no pixel by this."""
_PRIOR_FACTOR, _LEAST_PRIOR_PX, _MOST_PRIOR_PX, _FEWEST = 2.0, 0.1, 2.0, 200
"""Standard deviation of each error of a calibration over the size of the row differences, px: rows show some,
and the others come from the same calibration. From 0.1 px on there are any to find, of as many left-right matches:
rendered pairs show 0.02 px at most, two excerpts of KITTI odometry 1.1 px."""
_LEAST_SIZE = 1e-3
"""px that 1 of a term moves a pixel by, at least: of an image of a narrow field there is little of the others."""
_FROM_GLOBAL = 3.0
"""Deviations from 0 of a ratio, at least, of lines that are said to be read one after the other: a pair of KITTI,
whose calibration errs, gave 0.25 +- 0.09 from the left, at a probability of 0.98."""
_CLEARLY, LEAST_BACKWARDS, _NEAR = 0.999, 0.25, 0.2
"""Probability of the opposite scan at which frames are refused, and the ratio from which their order shows."""
_FEW = 600
"""Tracks, or matches of one camera, that tell of most frames that time runs forward."""
_AXES = ("tilt", "pan", "roll", "sideways motion", "vertical motion", "forward motion")


class NoMotionError(RsbenchError):
    """The frames are in order, but no motion explains their matches; the message says why."""


def known_of(
    matches: Correspondences,
    rig: StereoRig,
    readout_ratio: float | None,
    scanning: Scanning | None,
    calibration: tuple[float, ...] | None = None,
    models: tuple[str, ...] = MODELS,
) -> Known:
    """What is known before the matches are asked; None of it is looked for.

    Errors of the calibration are looked for where the row differences of the left-right matches show some, and are
    expected to be as large as these: they come from the same calibration.
    """
    scans = ALL_SCANS
    if scanning is not None:
        width, height = rig.camera.width, rig.camera.height
        rolling = scans_of(scanning.shutter_of(width, height, 1.0))
        scans = (
            (GLOBAL, rolling, reversed_scans(rolling))
            if readout_ratio is None
            else (rolling if readout_ratio > 0.0 else GLOBAL,)
        )
    return Known(
        ratio=readout_ratio,
        scans=scans,
        delay=None if scanning is None else scanning.right_delay,
        calibration=calibration or NO_ERRORS,
        calibration_sigma=_errors_expected(matches, rig) if calibration is None else NO_ERRORS,
        models=models,
    )


def _errors_expected(matches: Correspondences, rig: StereoRig) -> tuple[float, ...]:
    """Standard deviation of each error of a calibration: the row differences show how large they are."""
    stereo = _stereo(matches)
    pattern = row_pattern(stereo, rig) if rig.camera.lens is None and len(stereo) >= _FEWEST else None
    sigma = 0.0 if pattern is None else min(_PRIOR_FACTOR * pattern.systematic_px, _MOST_PRIOR_PX)
    if pattern is None or sigma <= _LEAST_PRIOR_PX:
        return NO_ERRORS
    camera = rig.camera
    rays = (0.5 * (stereo[:, :2] + stereo[:, 2:]) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    out = sigma / np.maximum(term_sizes(rays, camera.fx), _LEAST_SIZE)
    out[FOCAL] = 0.0  # what the rows show says nothing of it
    return tuple(out.tolist())


def _stereo(matches: Correspondences) -> FloatArray:
    """The left-right matches (n, 4) of both times; those of the tracks where there are no others."""
    pairs = np.concatenate([matches.stereo_0, matches.stereo_1])
    tracks = matches.tracks
    return pairs if len(pairs) else np.concatenate([tracks[:, :4], tracks[:, 4:]])


def as_global(
    capture: Capture,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    known: Known,
    under_global: Callable[[], Capture | None] = lambda: None,
) -> Capture:
    """A global shutter, where the matches allow nothing but one or nearly one (``nearly_global``).

    What is unknown beside is found again under a global shutter.

    Args:
        windows: the matches from which, of cameras of which ``known`` is known.
        under_global: what others say, if anything; asked where the shutter is global.
    """
    candidates = nearly_global(capture)
    if candidates is None:
        return capture
    again = under_global()
    if again is None:
        alone = replace(known, scans=(GLOBAL,), ratio=0.0, delay=0.0)
        again = conclude([examine(each, rig, alone) for each in windows])
    if again.likeliest is None:
        return capture
    still = replace(again.likeliest, probability=candidates[0].probability, sigma=candidates[0].sigma)
    found = (still, *candidates[1:])
    return replace(capture, candidates=found, models=again.models, peaks=again.peaks, named=True)


def shutter_found(capture: Capture, rig: StereoRig) -> RollingShutter:
    """The shutter of the most probable candidate.

    Raises:
        NoMotionError: there is none, or the matches leave open what would matter; in words.
    """
    best = capture.likeliest
    if best is None:
        raise NoMotionError(f"cannot tell how the cameras read: {capture.reason}")
    harmless = best.sigma * capture.moved_px <= _HARMLESS_PX or best.scans == GLOBAL
    named = best.probability >= CERTAIN or capture.moved_px <= _HARMLESS_PX
    rolls = not best.scans.rolls or best.ratio >= _FROM_GLOBAL * best.sigma or harmless
    if not named or not rolls or not (best.sigma <= _MAX_SIGMA or harmless):
        raise NoMotionError(cannot_tell(capture))
    return shutter_of(best, rig)


def shutter_of(candidate: Candidate, rig: StereoRig) -> RollingShutter:
    """The shutter of a candidate; a camera with a global shutter beside one that rolls has none here.

    Raises:
        NoMotionError: one camera alone rolls.
    """
    camera, scans = rig.camera, candidate.scans
    ratio = candidate.ratio if scans.rolls else 0.0
    if scans.rolls and "global" in (scans.left, scans.right):
        raise NoMotionError(f"{scans}: a rig of which one camera alone rolls cannot be corrected")
    delay = candidate.delay if abs(candidate.delay) > 2.0 * candidate.delay_sigma else 0.0
    if not scans.rolls:
        return RollingShutter(height=camera.height, readout_ratio=0.0, right_delay=delay)
    scanning = Scanning(scan=scans.left, right_scan=scans.right, right_delay=delay)  # pyrefly: ignore[bad-argument-type]
    return scanning.shutter_of(camera.width, camera.height, ratio)


def cannot_tell(capture: Capture) -> str:
    """Which unknowns the matches leave open, what the ratio trades against, and what would settle it."""
    text = f"cannot tell the readout ratio: {capture.reason}"
    peak = capture.peaks.get(capture.motion_model)
    best = capture.likeliest
    if best is not None and peak is not None and best.sigma > _MAX_SIGMA:
        text += f"; a larger ratio goes with {trade(peak)}"
    return f"{text}. Give readout_ratio in the rig's card, or frames in which the rig turns, or more frames"


def trade(peak: Peak) -> str:
    """The parameter of the motion, or the offset, that takes up most of a change of the ratio, with its amount."""
    w, d, offset = peak.trade[:3], peak.trade[3:6], float(peak.trade[6 + CALIBRATION.start + OFFSET])
    depth = 10.0 * max(float(np.linalg.norm(peak.fit.theta[3:])), 1e-6)
    share = np.abs(np.concatenate([w, d / depth]))
    k = int(np.argmax(share))
    more = "more" if peak.trade[k] * peak.fit.theta[k] >= 0.0 else "less"
    amount = 0.1 * abs(float(peak.trade[k]))
    unit = f"{np.rad2deg(amount):.2g} deg" if k < 3 else f"{amount:.2g} m"
    text = f"{more} {_AXES[k]} ({unit} for 0.1)"
    return text if abs(offset) < 0.1 else f"{text} and a disparity offset ({0.1 * offset:+.2g} px for 0.1)"


def reversed_scans(scans: Scans) -> Scans:
    """Lines read from the opposite side: what frames in the wrong order look like."""
    opposite = {"top": "bottom", "bottom": "top", "left": "right", "right": "left", "global": "global"}
    return Scans(opposite[scans.left], opposite[scans.right])  # pyrefly: ignore[bad-argument-type]


def runs_backwards(capture: Capture, scans: Scans) -> bool:
    """Whether lines are read from the side opposite to what is said, or the frames are in the wrong order."""
    best = capture.likeliest
    if best is None or best.scans != reversed_scans(scans) or best.scans == scans:
        return False
    return best.probability > _CLEARLY and best.ratio >= LEAST_BACKWARDS


def scans_by_laws(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    models: tuple[str, ...],
    options: RobustOptions,
    seed: int,
    start: Motion | None = None,
) -> Scans | None:
    """How lines are read, as is said or from the opposite side, by laws of motion, beyond doubt; None: unknown.

    Near the ratio that is said: where none of them holds, laws find any. Of most frames a part of the matches
    tells that they are as is said; all are asked where it does not. ``start`` is as in ``examine``.
    """
    few, found = thinned([matches], _FEW)[0], None
    for part in (matches,) if few is matches else (few, matches):
        known = replace(known_of(part, rig, None, shutter.scanning, None, models), delay=shutter.right_delay)
        best = conclude([examine(part, rig, known, options, seed, start)]).likeliest
        certain = best is not None and best.probability > _CLEARLY and best.sigma <= _NEAR
        found = best.scans if best and certain and abs(best.ratio - shutter.readout_ratio) <= _NEAR else None
        if found == scans_of(shutter):
            break
    return found


def record_of(capture: Capture) -> dict[str, Any]:
    """What was found of the shutter and how sure it is, as JSON holds it."""
    best = capture.likeliest
    return {
        "told": capture.told,
        "reason": capture.reason,
        "left": None if best is None else best.scans.left,
        "right": None if best is None else best.scans.right,
        "probability": None if best is None else best.probability,
        "readout_ratio": None if best is None else best.ratio,
        "readout_ratio_sigma": None if best is None else best.sigma,
        "right_delay": None if best is None else best.delay,
        "right_delay_sigma": None if best is None else best.delay_sigma,
        "disparity_offset": capture.offset,
        "disparity_offset_sigma": capture.offset_sigma,
        "candidates": candidates_of(capture),
        "motion_models": dict(capture.models),
        "windows": capture.windows,
        "matches": capture.matches,
        "used": capture.used,
        "noise_px": capture.noise_px if capture.used else None,
        "moved_px": capture.moved_px,
    }


def candidates_of(capture: Capture) -> list[dict[str, Any]]:
    """Every way of reading that is not out of the question, the most probable first."""
    return [
        {
            "left": each.scans.left,
            "right": each.scans.right,
            "probability": each.probability,
            "readout_ratio": each.ratio,
            "readout_ratio_sigma": each.sigma,
        }
        for each in capture.candidates
    ]


_LOOK, _CLEARLY_LESS = 500, 0.97
"""Matches of a quick look at the order of frames, and the share of the noise that is less than by chance."""


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
    for scan in (shutter.scan_of("left"), OPPOSITE[shutter.scan_of("left")]):
        seen = replace(shutter, scan=scan)
        solver, rng = RefinedSolver(motion_model="inertial", one_camera=True), np.random.default_rng(seed)
        given = Correspondences(left=matches[:: max(len(matches) // _LOOK, 1)])
        found = estimate_motion(given, rig_of(camera), seen, solver, options, rng)
        noise.append(found.estimate.noise_px or np.inf if found.estimate.success else np.inf)
    return noise[1] < _CLEARLY_LESS * noise[0]


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
