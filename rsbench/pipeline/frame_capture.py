"""How the frames of two times of a rig were taken: matches found or refused, then all of it that is not given.

``know_four`` and ``know_matches`` end in one ``KnownCapture``; with that, motion, depth and corrected frames are
functions of frames, matches and options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, RefusedFramesError, check_rig
from rsbench.capture.hypotheses import MODELS, KnownInputs, scans_of
from rsbench.capture.model_choice import AUTO
from rsbench.capture.rig_calibration import (
    ERRORS,
    FoundRig,
    agrees,
    prior_of,
    refine_rig,
    rotation_of_rows,
    rows_moved,
    with_errors,
)
from rsbench.capture.self_calibration import FoundFocal
from rsbench.capture.shutter_decision import as_global, known_of, runs_backwards, shutter_found
from rsbench.capture.two_frame_estimate import Capture, conclude, examine
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_depth import CorrectionOptions, Images
from rsbench.pipeline.mono_gyro import Clock
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.dense_matcher import forget_matches
from rsbench.vision.feature_matcher import find_correspondences
from rsbench.vision.features import ROW_TOLERANCE_PX
from rsbench.vision.images import eight_bit

BACKWARDS = (
    "time runs backwards in them: the two times are exchanged, or lines are read from the side opposite to what "
    "is given (`scan` in the rig's card)"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownCapture:
    """How frames were taken, given or estimated, and where each estimate comes from."""

    rig: StereoRig
    """The cameras; of one camera ``StereoRig.of_one``."""
    shutter: RollingShutter
    capture: Capture | None = None
    """How the shutter was estimated; None where it is given."""
    calibration: tuple[float, ...] = NO_ERRORS
    """Errors of the calibration, see ``calibration.TERMS``."""
    models: Capture | None = None
    """Motion models compared on the matches of the two times from which any of this was estimated; None: none."""
    rig_found: FoundRig | None = None
    """How rotation, focal lengths and delay of the right camera were estimated; None where they are as given."""
    focal: FoundFocal | None = None
    """How one camera's focal length was estimated; None where it is given."""
    camera_note: str = ""
    """What was estimated of a rig's focal length and k1."""
    gyro: FloatArray | None = None
    """(n, 4) samples of a gyroscope at the times of the frames; None without one."""
    clock: Clock | None = None
    """Error of the gyroscope's clock; None where its times are exact."""


def know_four(
    images: Images,
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    matches: Correspondences | None = None,
    step: Callable[[str], None] = lambda word: None,
) -> tuple[Correspondences, KnownCapture]:
    """The matches of four frames, as ``solve_frames`` takes them, and how the frames were taken.

    Args:
        inputs: what is given; the errors of a rig that is not ideal are estimated as errors of the rig.
        matches: given ones are taken as they are.
        step: called with ``matching`` when there are matches.

    Raises:
        RefusedFramesError, NoMotionError: see ``match_frames`` and ``know_matches``.
    """

    def known(
        matches: Correspondences, found: FoundRig | None, doubt: RefusedFramesError | None = None
    ) -> tuple[Correspondences, KnownCapture]:
        right = rig if found is None else found.rig
        given = inputs if right.aligned else replace(inputs, calibration=inputs.calibration or NO_ERRORS)
        matches, capture = know_matches(matches, right, given, options, doubt)
        return matches, replace(capture, rig_found=found)

    forget_matches()
    own, found, doubt = matches is None and rig.rows_together(inputs.reading, inputs.readout_ratio), None, None
    try:
        if matches is None:
            matches, doubt = match_given(images, rig, options, inputs)
        step("matching")
        if own and doubt is None and not rig.aligned and inputs.calibration is None:
            found = rig_of_matches(matches, rig, inputs, options)
        return known(matches, found, doubt)
    except RefusedFramesError as refusal:
        if refusal.stereo is None or not own:
            raise
        found, matches = find_rig(images, rig, inputs, options, refusal)
    return known(matches, found)


def know_matches(
    matches: Correspondences,
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    doubt: RefusedFramesError | None = None,
) -> tuple[Correspondences, KnownCapture]:
    """How the frames of matches were taken, and the matches that are right for that.

    Args:
        inputs: without a calibration its errors are estimated if the row differences of the matches show some;
            without a scanning it is estimated with the readout ratio, or is rows from the top where that is given.
        doubt: raised where the cameras read rows together, see ``match_unknown``.

    Raises:
        RefusedFramesError: time runs backwards in the frames.
        NoMotionError: the matches do not determine the shutter.
    """
    if inputs.readout_ratio is not None:
        models, errors = _calibrated(matches, rig, inputs, options)
        return matches, KnownCapture(rig=rig, shutter=inputs.shutter_of(rig), calibration=errors, models=models)
    capture = find_capture(matches, rig, inputs, options)
    if inputs.scanning is not None and runs_backwards(capture, scans_of(rig.shutter_of(inputs.scanning, 1.0))):
        raise RefusedFramesError(BACKWARDS)
    shutter, errors = shutter_found(capture, rig), NO_ERRORS
    if rig.rows_together(shutter.scanning):
        if doubt is not None:
            raise doubt
        matches, errors = on_their_rows(matches, rig), capture.calibration
    return matches, KnownCapture(rig=rig, shutter=shutter, capture=capture, calibration=errors, models=capture)


def _calibrated(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> tuple[Capture | None, tuple[float, ...]]:
    """What the matches say of a calibration that may be wrong, with a known shutter; None where it is right."""
    if inputs.calibration is not None or not rig.rows_together(inputs.reading):
        return None, inputs.calibration or NO_ERRORS
    inputs = replace(inputs, scanning=inputs.reading)
    if not any(known_of(matches, rig, inputs).calibration_sigma):
        return None, NO_ERRORS
    capture = find_capture(matches, rig, inputs, options)
    return (capture, capture.calibration) if capture.peaks else (None, NO_ERRORS)


def find_capture(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> Capture:
    """Motion of two times, and what ``inputs`` lacks of shutter and calibration, from matches."""
    solver, models = options.solver.solver, models_asked(options.motion_model)
    if options.motion_model is None and isinstance(solver, RefinedSolver):
        models = (solver.motion_model,)
    return capture_of(matches, rig, replace(inputs, models=models), options.robust, options.seed)


def capture_of(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, robust: RobustOptions, seed: int
) -> Capture:
    """``find_capture`` under the motion models of ``inputs``; a nearly global shutter is a global one."""
    known = known_of(matches, rig, inputs)
    capture = conclude([examine(matches, rig, known, robust, seed)])
    return as_global(capture, [matches], rig, known) if inputs.readout_ratio is None else capture


def models_asked(motion_model: str | None) -> tuple[str, ...]:
    """Those that ``auto`` chooses from, or the one that is requested."""
    return MODELS if motion_model in (None, AUTO) else (str(motion_model),)


# Matches of the frames of a rig, and its calibration as they show it.


_FEWEST_MATCHES = 12


def find_matches(
    images: Images,
    options: CorrectionOptions,
    sides: tuple[Side, Side] = SIDES,
    rig: StereoRig | None = None,
) -> Correspondences:
    """Correspondences of the four frames, whatever they are; ``sides`` says which images are taken for the left's.

    Those of frames that the cameras of ``rig`` took are in their pixels.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    levels = eight_bit([images[side, frame] for frame in (0, 1) for side in sides])
    names = [(side, frame) for frame in (0, 1) for side in SIDES]
    return find_correspondences(options.features, dict(zip(names, levels, strict=True)), rig)


def find_matches_of_rig(
    images: Images, rig: StereoRig, scanning: Scanning, options: CorrectionOptions
) -> Correspondences:
    """``find_matches`` of cameras as they are, in pixels of their images.

    Other matchers get images without distortion. Where the cameras do not read rows together, the two ends of a
    left-right match have two times and lie on two rows: rsbench's matchers search the whole image for it, and
    those of other packages, which may search the row alone, give only their matches over time.

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
    """``find_matches_of_rig`` of frames that a user says to be those of a rig.

    Args:
        scanning: how the cameras read; None: rows from the top, both at once.
        judge_rig: whether to look if frame 0 is a rectified pair in the right order.

    Raises:
        RefusedFramesError: no texture, sides exchanged, not rectified, or not of one time.
    """
    scanning = scanning or Scanning()
    if judge_rig and rig.rows_together(scanning):
        check_rig(images["left", 0], images["right", 0], rig)
    return _enough(find_matches_of_rig(images, rig, scanning, options))


def with_enough(options: CorrectionOptions, tracks: int) -> CorrectionOptions:
    """The same options, whose feature matcher may give tracks alone where there are as many as that."""
    component = options.features.component.with_enough(tracks)
    return replace(options, features=replace(options.features, component=component))


def find_rig(
    images: Images, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions, refusal: RefusedFramesError
) -> tuple[FoundRig, Correspondences]:
    """The rig as its frames show it, where their rows contradict its calibration, and the matches under it.

    Args:
        inputs: with or without a readout ratio.
        refusal: why the frames are refused under ``rig``.

    Raises:
        RefusedFramesError: the same, where no rotation of the right camera puts the matches on the epipolar lines.
        NoMotionError: the frames determine no motion or readout ratio.
    """
    rows = None if refusal.stereo is None else rotation_of_rows(refusal.stereo, rig, options.seed)
    if rows is None:
        raise refusal
    turned = with_errors(rig, rows[0])
    try:
        matches = match_frames(images, turned, options, inputs.scanning)
    except RefusedFramesError:
        raise refusal from None
    found = _refined(matches, rig, rows[0], inputs, options)
    if found is None:
        raise refusal
    return found, matches


_CLEAR = 3.0
"""Deviations beyond which an error of a calibration is one: to estimate none costs accuracy of the motion."""
_LIKELY_ROWS_PX = 0.3
"""Rows' error, px, up to which a calibration is first tried as it is."""


def rig_of_matches(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> FoundRig | None:
    """The rig as matches along its epipolar lines show it; None where they agree with its calibration.

    Raises:
        NoMotionError: the matches determine no readout ratio.
    """
    if not any(known_of(matches, rig, inputs).calibration_sigma):
        return None
    ideal = without_lens(matches, rig)
    rows = rotation_of_rows(np.concatenate([ideal.stereo_0, ideal.stereo_1]), rig, options.seed)
    if rows is None or (
        rows_moved(rows[0], rig) < _LIKELY_ROWS_PX and _as_calibrated(matches, rig, inputs, options)
    ):
        return None
    found = _refined(matches, rig, rows[0], inputs, options)
    # Rows differ by the motion too, where both cameras read a point at two times: that is no error.
    agrees = found is None or bool(np.all(np.abs(found.errors) <= _CLEAR * found.sigma))
    return None if agrees else found


def _as_calibrated(
    matches: Correspondences, rig: StereoRig, inputs: KnownInputs, options: CorrectionOptions
) -> bool:
    """Whether the matches agree with the calibration; False where the ratio is unknown, or that is not clear."""
    if inputs.readout_ratio is None:
        return False
    prior, model = prior_of(np.zeros(len(ERRORS))), _law(options)
    return agrees([matches], rig, inputs.shutter_of(rig), prior, _CLEAR, options.robust, options.seed, model)


def _law(options: CorrectionOptions) -> str:
    return options.motion_model if options.motion_model in MODELS else "linear"


def _refined(
    matches: Correspondences, rig: StereoRig, start: FloatArray, inputs: KnownInputs, options: CorrectionOptions
) -> FoundRig | None:
    """``refine_rig`` under the shutter that is given, or that the matches show near the right rig."""
    inputs = replace(inputs, calibration=NO_ERRORS)
    shutter = know_matches(matches, with_errors(rig, start), inputs, options)[1].shutter
    prior = prior_of(start)
    return refine_rig([matches], rig, shutter, start, prior, options.robust, options.seed, _law(options))


def match_unknown(
    images: Images, rig: StereoRig, options: CorrectionOptions, *, judge_rig: bool = True
) -> tuple[Correspondences, RefusedFramesError | None]:
    """``match_frames`` for cameras of any scan, and the evidence against a pair that reads rows at one time.

    Raises:
        RefusedFramesError: no texture.
    """
    doubt = None
    try:
        if judge_rig:
            check_rig(images["left", 0], images["right", 0], rig)
    except RefusedFramesError as error:
        doubt = error
    scanning = Scanning() if options.features.component.apart() is None else Scanning(scan="left")
    return _enough(find_matches_of_rig(images, rig, scanning, options)), doubt


def match_given(
    images: Images, rig: StereoRig, options: CorrectionOptions, inputs: KnownInputs, *, judge_rig: bool = True
) -> tuple[Correspondences, RefusedFramesError | None]:
    """``match_frames`` where readout ratio or scanning are given, else ``match_unknown``; their errors."""
    if inputs.readout_ratio is None and inputs.scanning is None:
        return match_unknown(images, rig, options, judge_rig=judge_rig)
    return match_frames(images, rig, options, inputs.scanning, judge_rig=judge_rig), None


def on_their_rows(matches: Correspondences, rig: StereoRig) -> Correspondences:
    """Without tracks whose left-right ends are not on one row, of cameras that read rows together."""
    tracks = without_lens(Correspondences(tracks=matches.tracks), rig).tracks
    off = np.maximum(np.abs(tracks[:, 1] - tracks[:, 3]), np.abs(tracks[:, 5] - tracks[:, 7]))
    near = off <= ROW_TOLERANCE_PX
    return replace(
        matches, tracks=matches.tracks[near], covariance=matches.covariance[near[: len(matches.covariance)]]
    )


def _enough(matches: Correspondences) -> Correspondences:
    temporal = max(len(matches.left) + len(matches.right), 2 * len(matches.tracks))
    if temporal < _FEWEST_MATCHES:
        raise RefusedFramesError(
            f"only {temporal} matches between the two times; {_FEWEST_MATCHES} are needed: the frames show no "
            "texture, or not the same scene"
        )
    return matches
