"""Estimate the capture of four frames of a rig: find or refuse matches, then estimate what is not given.

``know_four`` and ``know_matches`` return a ``KnownCapture`` (rig, shutter, calibration errors, matches). Motion,
depth and corrected frames are then functions of frames, this object and options.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, RefusedFramesError, check_rig
from rsbench.capture.hypotheses import MODELS, KnownInputs, scans_of
from rsbench.capture.model_choice import compared_models
from rsbench.capture.rig_calibration import (
    ERRORS,
    FoundRig,
    agrees,
    parallax_contradicts,
    prior_of,
    refine_rig,
    rotation_of_rows,
    rows_moved,
    with_errors,
)
from rsbench.capture.self_calibration import FoundCamera, FoundFocal, find_camera
from rsbench.capture.shutter_decision import as_global, known_of, runs_backwards, shutter_found
from rsbench.capture.two_frame_estimate import Capture, conclude, examine
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import Progress, no_progress
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import RefinedSolver

if TYPE_CHECKING:  # what works on images is loaded where images are given, and not for matches alone
    from rsbench.pipeline.frame_depth import CorrectionOptions, Images
    from rsbench.pipeline.mono_gyro import Clock

BACKWARDS = (
    "time runs backwards in them: they are in the reverse order, or lines are read from the side opposite to the "
    "given one (`scan` in the card)"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownCapture:
    """Rig, shutter and calibration errors of frames, given or estimated, and the estimates that they come from."""

    rig: StereoRig
    """The cameras; for one camera ``StereoRig.of_one``."""
    shutter: RollingShutter
    matches: Correspondences | None = None
    """The matches of two frame times that are valid for the shutter; None for a sequence."""
    capture: Capture | None = None
    """The estimate of the shutter; None if it is given."""
    calibration: tuple[float, ...] = NO_ERRORS
    """Calibration errors, see ``calibration.TERMS``."""
    models: Capture | None = None
    """The comparison of motion models, if shutter or calibration errors were estimated from these two times."""
    rig_found: FoundRig | None = None
    """The estimate of rotation, focal lengths and delay of the right camera; None if they are as given."""
    focal: FoundFocal | None = None
    """The estimate of one camera's focal length; None if it is given."""
    camera_note: str = ""
    """Report on the estimate of a rig's focal length and k1."""
    gyro: FloatArray | None = None
    """(n, 4) samples of a gyroscope at the times of the frames; None: there is none."""
    clock: Clock | None = None
    """Error of the gyroscope's clock; None if its times are exact."""


def know_four(
    images: Images,
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    matches: Correspondences | None = None,
) -> KnownCapture:
    """Match four frames and estimate their capture, for ``solve_frames``.

    Args:
        inputs: given values; calibration errors of a rig that is not aligned are estimated by ``refine_rig``.
        matches: given matches, which are used unchanged; None: the frames are matched.

    Raises:
        RefusedFramesError, NoMotionError: see ``match_frames`` and ``know_matches``.
    """

    def known(
        matches: Correspondences, found: FoundRig | None, doubt: RefusedFramesError | None = None
    ) -> KnownCapture:
        right = rig if found is None else found.rig
        given = inputs if right.aligned else replace(inputs, calibration=inputs.calibration or NO_ERRORS)
        return replace(know_matches(matches, right, given, options, doubt), rig_found=found)

    from rsbench.vision.dense_matcher import forget_matches

    forget_matches()
    check, found, doubt = matches is None, None, None
    try:
        if matches is None:
            matches, doubt = match_given(images, rig, options, inputs)
        if check and doubt is None and not rig.aligned and inputs.calibration is None:
            found = rig_of_matches([matches], rig, inputs, options)
        return known(matches, found, doubt)
    except RefusedFramesError as refusal:
        if refusal.stereo is None or not check or not rig.rows_together(inputs.reading, inputs.readout_ratio):
            raise
        found, (matches,) = find_rig([images], rig, inputs, options, refusal)
    return known(matches, found)


def know_matches(
    matches: Correspondences,
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    doubt: RefusedFramesError | None = None,
) -> KnownCapture:
    """Estimate the capture from matches.

    Args:
        inputs: calibration errors that are not given are estimated if row differences of the matches show some; a
            scanning that is not given is estimated with the readout ratio, or rows from the top.
        doubt: error that is raised if both cameras read rows at the same time, see ``match_given``.

    Raises:
        RefusedFramesError: the frames are in reverse order.
        NoMotionError: the matches do not determine the shutter.
    """
    if inputs.readout_ratio is not None:
        models, errors = _calibrated(matches, rig, inputs, options)
        shutter = inputs.shutter_of(rig)
        return KnownCapture(rig=rig, shutter=shutter, matches=matches, calibration=errors, models=models)
    capture = find_capture(matches, rig, inputs, options)
    refuse_backwards(capture, rig, inputs.scanning)
    shutter, errors = shutter_found(capture, rig), NO_ERRORS
    if rig.rows_together(shutter.scanning):
        if doubt is not None:
            raise doubt
        matches, errors = on_their_rows(matches, rig), capture.calibration
    return KnownCapture(
        rig=rig, shutter=shutter, matches=matches, capture=capture, calibration=errors, models=capture
    )


def refuse_backwards(capture: Capture, rig: StereoRig, scanning: Scanning | None) -> None:
    """Raise RefusedFramesError if lines are clearly read from the side opposite to a given scanning."""
    if scanning is not None and runs_backwards(capture, scans_of(rig.shutter_of(scanning, 1.0))):
        raise RefusedFramesError(BACKWARDS)


def _calibrated(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> tuple[Capture | None, tuple[float, ...]]:
    """Estimate calibration errors with a known shutter, if the matches show some; None: no estimate was made."""
    if inputs.calibration is not None or not rig.rows_together(inputs.reading):
        return None, inputs.calibration or NO_ERRORS
    if not any(known_of(matches, rig, inputs).calibration_sigma):
        return None, NO_ERRORS
    capture = find_capture(matches, rig, inputs, options)
    return (capture, capture.calibration) if capture.peaks else (None, NO_ERRORS)


def find_capture(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> Capture:
    """Estimate from matches the motion between two times and the values of the capture that ``inputs`` lacks."""
    solver, models = options.solver.solver, compared_models(options.motion_model)
    if options.motion_model is None and isinstance(solver, RefinedSolver):
        models = (solver.motion_model,)
    return capture_of(matches, rig, replace(inputs, models=models), options.robust, options.seed)


def capture_of(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, robust: RobustOptions, seed: int
) -> Capture:
    """``find_capture`` for the motion models in ``inputs``; a nearly global shutter is made global."""
    known = known_of(matches, rig, inputs)
    capture = conclude([examine(matches, rig, known, robust, seed)])
    return as_global(capture, [matches], rig, known) if inputs.readout_ratio is None else capture


# Matches of the frames of a rig, and the correction of its calibration by them.


_FEWEST_MATCHES = 12


def find_matches(
    images: Images,
    options: CorrectionOptions,
    rig: StereoRig | None = None,
) -> Correspondences:
    """Correspondences of the four frames; with a ``rig``, they are in the pixels of its cameras.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    from rsbench.vision.feature_matcher import find_correspondences
    from rsbench.vision.images import eight_bit

    names = [(side, frame) for frame in (0, 1) for side in SIDES]
    levels = eight_bit([images[name] for name in names])
    return find_correspondences(options.features, dict(zip(names, levels, strict=True)), rig)


def find_matches_of_rig(
    images: Images, rig: StereoRig, scanning: Scanning, options: CorrectionOptions
) -> Correspondences:
    """``find_matches`` for the cameras of a rig, in pixels of their images.

    Matchers of other packages get undistorted images. If the cameras do not read rows at the same time, the points
    of a left-right match have different times and lie on different rows. rsbench's matchers then search the whole
    image; matchers of other packages may search the row only, so their left-right matches are not used.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    together, apart = rig.rows_together(scanning), options.features.component.apart()
    if not together and apart is not None:
        options = replace(options, features=replace(options.features, component=apart))
    matches = find_matches(images, options, rig=rig)
    if together or apart is not None:
        return matches
    return Correspondences(left=matches.left, right=matches.right)


def match_frames(
    images: Images,
    rig: StereoRig,
    options: CorrectionOptions,
    scanning: Scanning | None = None,
    *,
    judge_rig: bool = True,
) -> Correspondences:
    """``find_matches_of_rig`` for a user's frames, after a check that they fit the rig.

    Args:
        scanning: scan of the cameras; None: both read rows from the top at the same time.
        judge_rig: whether to check that frame 0 is a rectified pair in the right order.

    Raises:
        RefusedFramesError: no texture, sides exchanged, not rectified, or left and right of different times.
    """
    scanning = scanning or Scanning()
    if judge_rig and rig.rows_together(scanning):
        check_rig(images["left", 0], images["right", 0], rig)
    return _check_enough(find_matches_of_rig(images, rig, scanning, options))


def with_enough(options: CorrectionOptions, tracks: int) -> CorrectionOptions:
    """The same options, with a feature matcher that may return only tracks if there are at least ``tracks``."""
    component = options.features.component.with_enough(tracks)
    return replace(options, features=replace(options.features, component=component))


def find_rig(
    windows: Iterable[Images],
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    refusal: RefusedFramesError,
) -> tuple[FoundRig, list[Correspondences]]:
    """Correct the calibration of a rig that the rows of its frames contradict, and match the frames with it.

    Args:
        windows: pairs of frame times; the first one is that which was refused.
        inputs: given values, with or without a readout ratio.
        refusal: the error with which the frames were refused for ``rig``.

    Raises:
        RefusedFramesError: ``refusal``, if no rotation of the right camera puts the matches on the epipolar lines.
        NoMotionError: the frames do not determine a motion or readout ratio.
    """
    rows = None if refusal.stereo is None else rotation_of_rows(refusal.stereo, rig, options.seed)
    if rows is None:
        raise refusal
    turned = with_errors(rig, rows[0])
    try:
        matches = match_windows(windows, turned, inputs, options)
    except RefusedFramesError:
        raise refusal from None
    found = _refined_rig(matches, rig, rows[0], inputs, options)
    if found is None:
        raise refusal
    return found, matches


def match_windows(
    windows: Iterable[Images], rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> list[Correspondences]:
    """Matches of pairs of frame times by ``match_frames``, without later windows that are refused.

    Raises:
        RefusedFramesError: the first window is refused.
    """
    matches = list[Correspondences]()
    for number, images in enumerate(windows):
        try:
            matches.append(match_frames(images, rig, options, inputs.scanning, judge_rig=number == 0))
        except RefusedFramesError:
            if not matches:
                raise
    return matches


_WIDE = 4.0
"""Factor of the threshold for outliers while the calibration may be off by a few pixels."""
_LIKELY_ROWS_PX = 0.3
"""Largest row difference, px, for which the given calibration is tested before an estimation."""


def rig_of_matches(
    windows: Sequence[Correspondences], rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> FoundRig | None:
    """Correct a rig by matches along its epipolar lines; None if they agree with its calibration.

    If rows or parallax over time contradict the calibration, one window is tested by ``agrees`` before errors are
    estimated; the errors of several windows are always estimated, and are used if they are significant.

    If both cameras read the ends of a match at different times, rows differ by the motion too. Errors are then
    estimated from the tracks alone, if the readout ratio is given.

    Raises:
        NoMotionError: the matches do not determine a readout ratio.
    """
    if not rig.rows_together(inputs.reading, inputs.readout_ratio):
        unknown = inputs.readout_ratio is None or _as_calibrated(windows, rig, inputs, options)
        found = None if unknown else _rig_of_tracks(windows, rig, inputs, options)
    else:
        rows_agree = not any(known_of(windows[0], rig, inputs).calibration_sigma)
        if rows_agree and not _converges_otherwise(windows, rig, inputs, options):
            return None
        ideal = [without_lens(each, rig) for each in windows]
        ends = np.concatenate([part for each in ideal for part in (each.stereo_0, each.stereo_1)])
        rows = rotation_of_rows(ends, rig, options.seed)
        if rows is None or (
            rows_moved(rows[0], rig) < _LIKELY_ROWS_PX and _as_calibrated(windows, rig, inputs, options)
        ):
            return None
        found = _refined_rig(windows, rig, rows[0], inputs, options)
    return found if found is not None and found.significant else None


def _rig_of_tracks(
    windows: Sequence[Correspondences], rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> FoundRig | None:
    """``refine_rig`` without a start from rows: with a wide threshold for outliers, then with the usual one."""
    shutter, prior, found = inputs.shutter_of(rig), prior_of(np.zeros(len(ERRORS))), None
    wide = replace(options.robust, threshold_px=_WIDE * options.robust.threshold_px)
    for robust in (wide, options.robust):
        start = np.zeros(len(ERRORS)) if found is None else found.errors
        found = refine_rig(windows, rig, shutter, start, prior, robust, options.seed, _model_name(options))
        if found is None:
            return None
    return found


def _as_calibrated(
    windows: Sequence[Correspondences], rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> bool:
    """Whether the matches of a window agree with the calibration, see ``agrees``; False if the readout ratio is
    unknown or there are several windows."""
    if inputs.readout_ratio is None or len(windows) > 1:
        return False
    prior, model = prior_of(np.zeros(len(ERRORS))), _model_name(options)
    return agrees(windows, rig, inputs.shutter_of(rig), prior, options.robust, options.seed, model)


def _converges_otherwise(
    windows: Sequence[Correspondences], rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> bool:
    """``parallax_contradicts``; False if the readout ratio is unknown."""
    if inputs.readout_ratio is None:
        return False
    prior, model = prior_of(np.zeros(len(ERRORS))), _model_name(options)
    known = rig, inputs.shutter_of(rig), prior, options.robust, options.seed, model
    return parallax_contradicts(windows, *known)


def _model_name(options: CorrectionOptions) -> str:
    return options.motion_model if options.motion_model in MODELS else "linear"


def _refined_rig(
    windows: Sequence[Correspondences],
    rig: StereoRig,
    start: FloatArray,
    inputs: KnownInputs,
    options: CorrectionOptions,
) -> FoundRig | None:
    """``refine_rig`` with the given shutter, or the one that the first window shows for the errors ``start``."""
    inputs = replace(inputs, calibration=NO_ERRORS)
    shutter = know_matches(windows[0], with_errors(rig, start), inputs, options).shutter
    prior = prior_of(start)
    return refine_rig(windows, rig, shutter, start, prior, options.robust, options.seed, _model_name(options))


def match_given(
    images: Images, rig: StereoRig, options: CorrectionOptions, inputs: KnownInputs, *, judge_rig: bool = True
) -> tuple[Correspondences, RefusedFramesError | None]:
    """``match_frames``; for an unknown scan also the error to raise if both cameras read rows at the same time."""
    if inputs.readout_ratio is not None or inputs.scanning is not None:
        return match_frames(images, rig, options, inputs.scanning, judge_rig=judge_rig), None
    doubt = None
    try:
        if judge_rig:
            check_rig(images["left", 0], images["right", 0], rig)
    except RefusedFramesError as error:
        doubt = error
    scanning = Scanning() if options.features.component.apart() is None else Scanning(scan="left")
    return _check_enough(find_matches_of_rig(images, rig, scanning, options)), doubt


def on_their_rows(matches: Correspondences, rig: StereoRig) -> Correspondences:
    """The matches without tracks whose left and right points are on different rows."""
    from rsbench.vision.features import ROW_TOLERANCE_PX

    tracks = without_lens(Correspondences(tracks=matches.tracks), rig).tracks
    off = np.maximum(np.abs(tracks[:, 1] - tracks[:, 3]), np.abs(tracks[:, 5] - tracks[:, 7]))
    near = off <= ROW_TOLERANCE_PX
    return replace(
        matches, tracks=matches.tracks[near], covariance=matches.covariance[near[: len(matches.covariance)]]
    )


def _check_enough(matches: Correspondences) -> Correspondences:
    temporal = max(len(matches.left) + len(matches.right), 2 * len(matches.tracks))
    if temporal < _FEWEST_MATCHES:
        raise RefusedFramesError(
            f"only {temporal} matches between the two times; {_FEWEST_MATCHES} are needed: the frames show no "
            "texture, or not the same scene"
        )
    return matches


# The focal length and k1 of a rig whose card gives their standard deviations, from some of its frames.


CAMERA_WINDOWS = 8
"""Most windows, i.e. two successive frame times, for the focal length and k1."""


def camera_of_frames(
    windows: Iterable[Images], rig: StereoRig, options: CorrectionOptions, inputs: KnownInputs
) -> FoundCamera:
    """``find_camera`` from the matches of a few windows; windows without matches are skipped."""
    matches = list[Correspondences]()
    for images in islice(windows, CAMERA_WINDOWS):
        with suppress(RefusedFramesError):  # the correction reports refused windows
            matches.append(match_given(images, rig, options, inputs, judge_rig=False)[0])
    if not matches:
        return FoundCamera(rig=rig, sigma=inputs.sigma, determined=(False, False))
    shutter = KnownInputs(readout_ratio=inputs.readout_ratio, scanning=inputs.scanning)
    return find_camera(matches, rig, inputs.sigma, shutter, options.robust, options.seed)


def with_found_camera(
    rig: StereoRig,
    windows: Iterable[Images],
    options: CorrectionOptions,
    inputs: KnownInputs,
    progress: Progress = no_progress,
) -> tuple[StereoRig, str]:
    """The rig with focal length and k1 estimated if ``inputs.sigma`` is not 0, and a report on both."""
    if not inputs.sigma:
        return rig, ""
    with progress("estimating the calibration", 1) as advance:
        found = camera_of_frames(windows, rig, options, inputs)
        advance("")
    return found.rig, found.words(rig, inputs.sigma)
