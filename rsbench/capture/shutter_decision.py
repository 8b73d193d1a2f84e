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
"""Largest standard deviation of a ratio that is used; a larger one is used where it moves no pixel by this."""
_MAX_SHARE = 0.25
"""The same as a share of one camera's ratio: a correction by twice the true ratio is no better than none."""
_PRIOR_FACTOR, _LEAST_PRIOR_PX, _MOST_PRIOR_PX, _FEWEST = 2.0, 0.1, 2.0, 200
"""Prior standard deviation of each error of a calibration over the size of the row differences, its limits, px,
and the left-right matches that it needs: the other errors come from the same calibration as these differences.
Below 0.1 px there are none to find: rendered pairs show at most 0.02 px, two excerpts of KITTI odometry 1.1 px."""
_LEAST_SIZE = 1e-3
"""px by which 1 of a term moves a pixel, at least: an image of a narrow field shows little of some terms."""
_FROM_GLOBAL = 3.0
"""Standard deviations from 0 that a ratio of rolling lines needs: a pair of KITTI, whose calibration errs, gave
0.25 +- 0.09 from the left, at a probability of 0.98."""
_CLEARLY, LEAST_BACKWARDS, _NEAR = 0.999, 0.25, 0.2
"""Probability of the opposite scan at which frames are refused, and the ratio from which their order shows."""
_FEW = 600
"""Tracks, or matches of one camera, that show for most frames that time runs forward."""
_LOOK, _CLEARLY_LESS = 500, 0.97
"""Matches of a quick look at the order of frames, and the share of the noise that is less than by chance."""
_AXES = ("tilt", "pan", "roll", "sideways motion", "vertical motion", "forward motion")


class NoMotionError(RsbenchError):
    """The frames are in order, but no motion explains their matches; the message says why."""


def known_of(matches: Correspondences, rig: StereoRig, given: KnownInputs) -> Known:
    """What is known of a capture before its matches are fitted: the one step from given values.

    Errors of the calibration that are not given are estimated where the row differences of the left-right matches
    show some; these set their prior, because they come from the same calibration.

    Raises:
        RsbenchError: a readout ratio of the right camera, but none of the left one.
    """
    ratio, scanning, scans = given.readout_ratio, given.scanning, ALL_SCANS
    if scanning is not None:
        if ratio is None and scanning.right_readout_ratio is not None:
            raise RsbenchError(
                f"right_readout_ratio = {scanning.right_readout_ratio}: give readout_ratio too; it is estimated "
                "for cameras alone that share one"
            )
        rolling = scans_of(rig.shutter_of(scanning, 1.0))
        scans = (GLOBAL, rolling, reversed_scans(rolling))
    known = Known(
        ratio=ratio,
        scans=scans,
        delay=None if scanning is None else scanning.right_delay,
        calibration=given.calibration or NO_ERRORS,
        calibration_sigma=_errors_expected(matches, rig) if given.calibration is None else NO_ERRORS,
        models=given.models,
    )
    return known if ratio is None or scanning is None else known.with_shutter(rig.shutter_of(scanning, ratio))


def _errors_expected(matches: Correspondences, rig: StereoRig) -> tuple[float, ...]:
    """Prior standard deviation of each error of a calibration, from the left-right matches of both times.

    Those of the tracks where there are no others.
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
    out[FOCAL] = 0.0  # which the rows do not show
    return tuple(out.tolist())


def as_global(
    capture: Capture,
    windows: Sequence[Correspondences],
    rig: StereoRig,
    known: Known,
    under_global: Callable[[], Capture | None] = lambda: None,
) -> Capture:
    """A global shutter, where the matches allow nothing but one or nearly one (``nearly_global``).

    All other unknowns are estimated again under a global shutter.

    Args:
        windows: the matches of the capture.
        under_global: a capture under a global shutter, or None; called where the shutter is global.
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
        NoMotionError: there is none, or what the matches leave undetermined would matter.
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
    """The shutter of a candidate.

    Raises:
        NoMotionError: one camera alone rolls: so it seems of two with ratios of their own, too.
    """
    if candidate.scans.rolls and "global" in (candidate.scans.left, candidate.scans.right):
        raise NoMotionError(
            f"{candidate.scans}, or with another ratio: give readout_ratio and right_readout_ratio"
        )
    delay = candidate.delay if abs(candidate.delay) > 2.0 * candidate.delay_sigma else 0.0
    return shutter_under(candidate.scans, candidate.ratio, rig, delay)


def cannot_tell(capture: Capture) -> str:
    """Which unknowns the matches leave undetermined, what the ratio trades against, and the remedy."""
    text = f"cannot tell the readout ratio: {capture.reason}"
    peak = capture.peaks.get(capture.motion_model)
    best = capture.likeliest
    if best is not None and peak is not None and best.sigma > _MAX_SIGMA:
        text += f"; a larger ratio goes with {_trade(peak)}"
    return f"{text}. Give readout_ratio in the rig's card, or frames in which the rig turns, or more frames"


def _trade(peak: Peak) -> str:
    """The parameter of the motion, or the offset, that compensates most of a change of the ratio, and by how
    much."""
    w, d, offset = peak.trade[:3], peak.trade[3:6], float(peak.trade[6 + CALIBRATION.start + OFFSET])
    depth = 10.0 * max(float(np.linalg.norm(peak.fit.theta[3:])), 1e-6)
    k = int(np.argmax(np.abs(np.concatenate([w, d / depth]))))
    more = "more" if peak.trade[k] * peak.fit.theta[k] >= 0.0 else "less"
    amount = 0.1 * abs(float(peak.trade[k]))
    unit = f"{np.rad2deg(amount):.2g} deg" if k < 3 else f"{amount:.2g} m"
    text = f"{more} {_AXES[k]} ({unit} for 0.1)"
    return text if abs(offset) < 0.1 else f"{text} and a disparity offset ({0.1 * offset:+.2g} px for 0.1)"


def reversed_scans(scans: Scans) -> Scans:
    """Lines read from the opposite side: what frames in the wrong order look like."""
    opposite = {**OPPOSITE, "global": "global"}
    return Scans(opposite[scans.left], opposite[scans.right])  # pyrefly: ignore[bad-argument-type]


def runs_backwards(capture: Capture, scans: Scans) -> bool:
    """Whether lines are read from the side opposite to given scans, or the frames are in the wrong order."""
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
    """The scans of a given shutter, or the opposite ones, whichever motion models show beyond doubt; None:
    neither.

    Only near the given ratio: where no model holds, any ratio may come out. For most frames a part of the matches
    shows the given scans under the model of ``start``; otherwise all models and then all matches are used.
    ``start`` is as in ``examine``.
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
        if found == scans_of(shutter):
            break
    return found


def record_of(capture: Capture) -> dict[str, Any]:
    """What was estimated of the shutter and how certain it is, as JSON holds it."""
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
    """All scans that are not excluded, the most probable first."""
    values = ((c.scans.left, c.scans.right, c.probability, c.ratio, c.sigma) for c in capture.candidates)
    return [dict(zip(_OF_A_CANDIDATE, each, strict=True)) for each in values]


# One camera


def known_alone(scan: Scan | None = None, focal_sigma: float = 0.0) -> Known:
    """What is known of a camera whose readout ratio is not given, with its ``scan`` if that is.

    The opposite scan stays possible, because frames in the wrong order show it. Columns are possible only where
    ``scan`` gives them: errors of the flow of one camera resemble them. ``focal_sigma`` is the relative prior
    standard deviation of the focal length; 0: it is given.
    """
    given, sigma = Scans(scan or "top", scan or "top"), np.array(NO_ERRORS)
    sigma[FOCAL] = focal_sigma
    scans = (GLOBAL, given, reversed_scans(given))
    return Known(scans=scans, delay=0.0, calibration_sigma=tuple(sigma.tolist()))


def examine_alone(
    matches: FloatArray, camera: PinholeCamera, known: Known, options: RobustOptions, seed: int = 0
) -> Window:
    """Matches (n, 4) x0, y0, x1, y1, px, of two frames of a camera under each hypothesis; with outliers."""
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
    """Whether matches (n, 4) fit better where lines are read from the other side: a quick look, no decision."""
    noise, given = list[float](), Correspondences(left=matches[:: max(len(matches) // _LOOK, 1)])
    for scan in (shutter.scan_of("left"), OPPOSITE[shutter.scan_of("left")]):
        solver, rng = RefinedSolver(motion_model="inertial", one_camera=True), np.random.default_rng(seed)
        found = estimate_motion(
            given, StereoRig.of_one(camera), replace(shutter, scan=scan), solver, options, rng
        ).estimate
        noise.append(found.noise_px or np.inf if found.success else np.inf)
    return noise[1] < _CLEARLY_LESS * noise[0]


def conclude_alone(windows: Sequence[Window]) -> Capture:
    """What all windows of a camera show together; a global shutter where they allow only one or nearly one."""
    capture = conclude(windows)
    candidates = nearly_global(capture)
    return capture if candidates is None else replace(capture, candidates=candidates, named=True)


def shutter_alone(capture: Capture, camera: PinholeCamera) -> RollingShutter:
    """The shutter of the most probable candidate.

    Raises:
        NoMotionError: there is none, or what the frames leave undetermined would matter.
    """

    def words(candidate: Candidate) -> str:
        start = candidate.scans.left
        return "all lines read at once" if start == "global" else f"lines read from the {start}"

    remedy = "Give readout_ratio in the camera's card, or frames in which the camera turns, or more frames"
    best = capture.likeliest
    if best is None:
        raise NoMotionError(f"cannot tell how the camera reads: {capture.reason}. {remedy}")
    certain = best.probability >= CERTAIN
    harmless = best.sigma * capture.moved_px <= _HARMLESS_PX or best.scans == GLOBAL
    if certain and (best.sigma <= min(_MAX_SIGMA, _MAX_SHARE * best.ratio) or harmless):
        return shutter_of(best, StereoRig.of_one(camera))
    if certain:
        how = f"{words(best)}, but not how fast: {best.ratio:.2f} +- {best.sigma:.2f}"
    else:
        likely = [each for each in capture.candidates if each.probability > 0.1]
        how = ", or ".join(f"{words(each)} ({each.probability:.0%})" for each in likely) or "any shutter"
    raise NoMotionError(f"cannot tell the readout ratio: the frames show {how}. {remedy}")
