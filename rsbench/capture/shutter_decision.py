"""Decide on the shutter that a correction uses, from the matches of a rig or of one camera.

``known_of`` collects the given values, which are not estimated. An estimated shutter is used if it is certain or
if its error does not matter. Otherwise the error message names what the matches leave undetermined, which
parameter compensates for it, and the remedy. The readout of one camera can be estimated while it rotates or passes
objects, since later lines have moved further; a motion along its lines shows nothing. Its lengths have any unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rsbench.capture.calibration import FOCAL, NO_ERRORS, OFFSET, row_pattern, term_sizes
from rsbench.capture.hypotheses import (
    ALL_SCANS,
    CALIBRATION,
    GLOBAL,
    Known,
    KnownInputs,
    Scans,
    scans_of,
    shutter_under,
)
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
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver

OPPOSITE: dict[Scan, Scan] = {"top": "bottom", "bottom": "top", "left": "right", "right": "left"}
_MAX_SIGMA, _HARMLESS_PX = 0.1, 1.0
"""Largest standard deviation of a ratio that is used, unless it moves pixels by no more than ``_HARMLESS_PX``."""
_MAX_SHARE = 0.25
"""The same relative to one camera's ratio: a correction by twice the true ratio is no better than none."""
_PRIOR_FACTOR, _LEAST_PRIOR_PX, _MOST_PRIOR_PX, _FEWEST = 2.0, 0.1, 2.0, 200
"""Prior standard deviation of the calibration errors divided by the size of the row differences, which have the
same cause; its limits, px; fewest left-right matches for it. Below 0.1 px no errors are estimated: rendered pairs
show at most 0.02 px, two excerpts of KITTI odometry 1.1 px."""
_LEAST_SIZE = 1e-3
"""Lower limit of the shift by 1 of a term, px: in a narrow field of view some terms have little effect."""
_ROLLING_SIGMAS = 3.0
"""Least ratio of a rolling shutter, in standard deviations: a pair of KITTI, whose calibration is wrong, gave
0.25 +- 0.09 from the left, at a probability of 0.98."""
_CLEARLY, LEAST_BACKWARDS, _NEAR = 0.999, 0.25, 0.2
"""Probability of the opposite scan above which frames are refused; least ratio for that; tolerance of a ratio."""
_FEW = 600
"""Tracks, or matches of one camera, that suffice for most frames to show that they are in temporal order."""
_QUICK_TEST, _CLEARLY_LESS = 500, 0.97
"""Number of matches of a quick test of the order of frames; quotient of noise below which one order is better."""
_AXES = ("tilt", "pan", "roll", "sideways motion", "vertical motion", "forward motion")


class NoMotionError(RsbenchError):
    """Raised if the frames are in order but no motion explains their matches; the message says why."""


def known_of(matches: Correspondences, rig: StereoRig, given: KnownInputs) -> Known:
    """Convert given values to what is known about a capture before its matches are fitted.

    With a readout ratio and no scanning, rows are read from the top. If no calibration errors are given, they are
    estimated where the row differences of left-right matches show some; the size of these differences sets their
    prior.

    Raises:
        RsbenchError: a readout ratio of the right camera is given, but none of the left one.
    """
    ratio, scans = given.readout_ratio, ALL_SCANS
    scanning = given.scanning if ratio is None else given.reading
    if scanning is not None:
        if ratio is None and scanning.right_readout_ratio is not None:
            raise RsbenchError(
                f"right_readout_ratio = {scanning.right_readout_ratio}: give readout_ratio too; a ratio is only "
                "estimated if both cameras have the same"
            )
        rolling = scans_of(rig.shutter_of(scanning, 1.0))
        scans = (GLOBAL, rolling, reversed_scans(rolling))
    known = Known(
        ratio=ratio,
        scans=scans,
        delay=None if scanning is None else scanning.right_delay,
        calibration=given.calibration or NO_ERRORS,
        calibration_sigma=_calibration_prior(matches, rig) if given.calibration is None else NO_ERRORS,
        models=given.models,
    )
    return known if ratio is None or scanning is None else known.with_shutter(rig.shutter_of(scanning, ratio))


def _calibration_prior(matches: Correspondences, rig: StereoRig) -> tuple[float, ...]:
    """(14,) prior standard deviation of each calibration error, from the left-right matches of both times.

    If there are no such matches, those of the tracks are used.
    """
    tracks, stereo = matches.tracks, np.concatenate([matches.stereo_0, matches.stereo_1])
    stereo = stereo if len(stereo) else np.concatenate([tracks[:, :4], tracks[:, 4:]])
    if not rig.aligned:
        ends = [rig.eye(side).ideal_pixels(stereo[:, k : k + 2]) for k, side in zip((0, 2), SIDES, strict=True)]
        stereo = np.concatenate(ends, axis=1)
    pattern = row_pattern(stereo, rig) if rig.camera.lens is None and len(stereo) >= _FEWEST else None
    sigma = 0.0 if pattern is None else min(_PRIOR_FACTOR * pattern.systematic_px, _MOST_PRIOR_PX)
    if sigma <= _LEAST_PRIOR_PX:
        return NO_ERRORS
    camera = rig.camera
    rays = (0.5 * (stereo[:, :2] + stereo[:, 2:]) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    out = sigma / np.maximum(term_sizes(rays, camera.fx), _LEAST_SIZE)
    out[FOCAL] = 0.0  # the rows do not depend on it
    return tuple(out.tolist())


def as_global(
    capture: Capture,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    known: Known,
    under_global: Callable[[], Capture | None] = lambda: None,
) -> Capture:
    """Replace a capture whose shutter is global or nearly so (``nearly_global``) by one with a global shutter.

    All other unknowns are estimated again under a global shutter. Other captures are returned unchanged.

    Args:
        windows: the matches of the capture.
        under_global: returns the capture under a global shutter if the caller has it, else None.
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
        NoMotionError: there is none, or it is too uncertain and its error would matter.
    """
    best = capture.likeliest
    if best is None:
        raise NoMotionError(_cannot_tell(capture, rig))
    still = capture.moved_px <= _HARMLESS_PX and rig.metric
    harmless = best.sigma * capture.moved_px <= _HARMLESS_PX or best.scans == GLOBAL
    rolls = not best.scans.rolls or best.ratio >= _ROLLING_SIGMAS * best.sigma
    largest = _MAX_SIGMA if rig.metric else min(_MAX_SIGMA, _MAX_SHARE * best.ratio)
    if (best.probability >= CERTAIN or still) and (harmless or (rolls and best.sigma <= largest)):
        return shutter_of(best, rig)
    raise NoMotionError(_cannot_tell(capture, rig))


def shutter_of(candidate: Candidate, rig: StereoRig) -> RollingShutter:
    """The shutter of a candidate.

    Raises:
        NoMotionError: only one camera has a rolling shutter; two cameras with different ratios may look like that.
    """
    if candidate.scans.rolls and "global" in (candidate.scans.left, candidate.scans.right):
        raise NoMotionError(
            f"{candidate.scans}, or both rolling with different ratios: give readout_ratio and right_readout_ratio"
        )
    delay = candidate.delay if abs(candidate.delay) > 2.0 * candidate.delay_sigma else 0.0
    return shutter_under(candidate.scans, candidate.ratio, rig, delay)


def _cannot_tell(capture: Capture, rig: StereoRig) -> str:
    """Message on what the matches leave undetermined, what compensates for the ratio, and the remedy."""
    who, best = "rig" if rig.metric else "camera", capture.likeliest
    if best is None:
        text = f"how the {'cameras read' if rig.metric else 'camera reads'}: {capture.reason}"
    else:
        text = f"the readout ratio: {capture.reason if rig.metric else f'the frames show {_readings(capture)}'}"
        if rig.metric and best.sigma > _MAX_SIGMA and (peak := capture.peaks.get(capture.motion_model)):
            text += f"; a larger ratio goes with {_trade(peak)}"
    remedy = f"Give readout_ratio in the {who}'s card, or frames in which the {who} turns, or more frames"
    return f"cannot tell {text}. {remedy}"


def _readings(capture: Capture) -> str:
    """How one camera may read, as text."""

    def reading_of(candidate: Candidate) -> str:
        start = candidate.scans.left
        return "all lines read at once" if start == "global" else f"lines read from the {start}"

    best = capture.candidates[0]
    if best.probability >= CERTAIN:
        return f"{reading_of(best)}, but not how fast: {best.ratio:.2f} +- {best.sigma:.2f}"
    likely = [each for each in capture.candidates if each.probability > 0.1]
    return ", or ".join(f"{reading_of(each)} ({each.probability:.0%})" for each in likely) or "any shutter"


def _trade(peak: Peak) -> str:
    """Text on the motion parameter, and the disparity offset, that compensate most of a change of the ratio."""
    w, d, offset = peak.trade[:3], peak.trade[3:6], float(peak.trade[6 + CALIBRATION.start + OFFSET])
    depth = 10.0 * max(float(np.linalg.norm(peak.fit.theta[3:])), 1e-6)
    k = int(np.argmax(np.abs(np.concatenate([w, d / depth]))))
    more = "more" if peak.trade[k] * peak.fit.theta[k] >= 0.0 else "less"
    amount = 0.1 * abs(float(peak.trade[k]))
    unit = f"{np.rad2deg(amount):.2g} deg" if k < 3 else f"{amount:.2g} m"
    text = f"{more} {_AXES[k]} ({unit} for 0.1)"
    return text if abs(offset) < 0.1 else f"{text} and a disparity offset ({0.1 * offset:+.2g} px for 0.1)"


def reversed_scans(scans: Scans) -> Scans:
    """The scans with lines read from the opposite side, which frames in the wrong order appear to have."""
    opposite = {**OPPOSITE, "global": "global"}
    return Scans(opposite[scans.left], opposite[scans.right])  # pyrefly: ignore[bad-argument-type]


def runs_backwards(capture: Capture, scans: Scans) -> bool:
    """Whether lines are clearly read from the side opposite to ``scans``, as of frames in the wrong order."""
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
    only_opposite: bool = False,
) -> Scans | None:
    """The scans of a given shutter or the opposite ones, whichever are certain by motion models; None: neither is.

    The estimated ratio must be near the given one: if no model holds, it may be arbitrary. For most frames some of
    the matches suffice to confirm the given scans under the model of ``start``; otherwise all models and then all
    matches are used. ``start`` is as in ``examine``.

    With ``only_opposite``, the search ends as soon as the opposite scans are not the likeliest.
    """
    few, found = thinned([matches], _FEW)[0], None
    alone = (start.name,) if start is not None and start.name in models else models
    tries = [(few, laws) for laws in dict.fromkeys((alone, models))]
    for part, laws in tries if few is matches else [*tries, (matches, models)]:
        given = known_of(part, rig, KnownInputs(models=laws)).with_shutter(shutter)
        known = replace(given, ratio=None, scans=(GLOBAL, *given.scans, reversed_scans(given.scans[0])))
        window = examine(part, rig, known, options, seed, start)
        best = conclude([window], under_laws=True).likeliest
        certain = best is not None and best.probability > _CLEARLY and best.sigma <= _NEAR
        found = best.scans if best and certain and abs(best.ratio - (given.ratio or 0.0)) <= _NEAR else None
        if found == scans_of(shutter) or (only_opposite and best and best.scans != reversed_scans(given.scans[0])):
            break
    return found


def record_of(capture: Capture) -> dict[str, Any]:
    """The estimated shutter and its uncertainty, as written to JSON."""
    best = candidates_of(capture)[0] if capture.candidates else dict.fromkeys(_OF_A_CANDIDATE)
    likeliest = capture.likeliest
    return {
        "told": capture.determined,
        "reason": capture.reason,
        **best,
        "right_delay": None if likeliest is None else likeliest.delay,
        "right_delay_sigma": None if likeliest is None else likeliest.delay_sigma,
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


_OF_A_CANDIDATE = ("left", "right", "probability", "readout_ratio", "readout_ratio_sigma")


def candidates_of(capture: Capture) -> list[dict[str, Any]]:
    """Records of all scans that are not excluded, in descending probability."""
    values = ((c.scans.left, c.scans.right, c.probability, c.ratio, c.sigma) for c in capture.candidates)
    return [dict(zip(_OF_A_CANDIDATE, each, strict=True)) for each in values]


# One camera


def known_alone(scan: Scan | None = None, focal_sigma: float = 0.0) -> Known:
    """What is known about one camera without a given readout ratio.

    The opposite scan stays possible, because it reveals frames in the wrong order. Scans by columns are possible
    only if ``scan`` is one of them: errors of one camera's optical flow resemble them. ``focal_sigma`` is the
    relative prior standard deviation of the focal length; 0: the focal length is given.
    """
    given, sigma = Scans(scan or "top", scan or "top"), np.array(NO_ERRORS)
    sigma[FOCAL] = focal_sigma
    scans = (GLOBAL, given, reversed_scans(given))
    return Known(scans=scans, delay=0.0, calibration_sigma=tuple(sigma.tolist()))


def examine_alone(
    matches: FloatArray, camera: PinholeCamera, known: Known, options: RobustOptions, seed: int = 0
) -> Window:
    """Fit each hypothesis to matches (n, 4) x0, y0, x1, y1, px, with outliers, of two frames of one camera."""
    given, rig = Correspondences(left=matches), StereoRig.of_one(camera)
    # The search starts from the motion under a shutter between those that are possible.
    starts = {scans.left for scans in known.scans}
    scan, ratio = next(each for each in COARSE if ("global" if each[1] == 0.0 else each[0]) in starts)
    shutter = RollingShutter(height=camera.height, width=camera.width, readout_ratio=ratio, scan=scan)
    rng = np.random.default_rng(seed)
    found = estimate_motion(given, rig, shutter, RefinedSolver(one_camera=True), options, rng).estimate
    start = LinearMotion(w=found.w, d=found.d) if found.success else None
    return examine(given, rig, known, options, seed, start)


def fits_backwards(
    matches: FloatArray, camera: PinholeCamera, shutter: RollingShutter, options: RobustOptions, seed: int = 0
) -> bool:
    """Quick test whether matches (n, 4) fit better if lines are read from the opposite side."""
    noise, given = list[float](), Correspondences(left=matches[:: max(len(matches) // _QUICK_TEST, 1)])
    for scan in (shutter.scan_of("left"), OPPOSITE[shutter.scan_of("left")]):
        solver, rng = RefinedSolver(motion_model="inertial", one_camera=True), np.random.default_rng(seed)
        found = estimate_motion(
            given, StereoRig.of_one(camera), replace(shutter, scan=scan), solver, options, rng
        ).estimate
        noise.append(found.noise_px or np.inf if found.success else np.inf)
    return noise[1] < _CLEARLY_LESS * noise[0]


def conclude_alone(windows: Sequence[Window]) -> Capture:
    """Combine all windows of one camera; the result is a global shutter if the shutter is global or nearly so."""
    capture = conclude(windows)
    candidates = nearly_global(capture)
    return capture if candidates is None else replace(capture, candidates=candidates, named=True)
