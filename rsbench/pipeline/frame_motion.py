"""Matches of four frames of a rig: found, or refused with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, OFFSET, RefusedFramesError, check_rig, recalibrated
from rsbench.capture.hypotheses import MODELS, KnownInputs, scans_of
from rsbench.capture.model_choice import AUTO, ModelChoice, choose_model, spline_choice, spread_by_unknowns
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
from rsbench.capture.shutter_decision import (
    LEAST_BACKWARDS,
    NoMotionError,
    as_global,
    known_of,
    reversed_scans,
    runs_backwards,
    scans_by_laws,
    shutter_found,
)
from rsbench.capture.trajectory_gyro import GyroFound
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.two_frame_estimate import CERTAIN, Capture, conclude, examine
from rsbench.capture.two_frame_spline import dispersion_of_rows, log_odds_of_opposite, two_frame_spline
from rsbench.components.motion_models import load_kernel, make_motion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences, without_lens
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_depth import CorrectionOptions, Images
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import MotionEstimate, SolverEntry, SolverSpec
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.feature_matcher import find_correspondences
from rsbench.vision.features import ROW_TOLERANCE_PX
from rsbench.vision.images import eight_bit

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

    Other matchers see images without distortion. Where the cameras do not read rows together, a left-right match
    is of two times, and its ends of two rows: rsbench's own looks for it anywhere, and of others, which may look
    along the row, only matches over time are kept.

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
    turned, inputs = with_errors(rig, start), replace(inputs, calibration=NO_ERRORS)
    if inputs.readout_ratio is not None:
        shutter = inputs.shutter_of(turned)
    else:
        shutter = solve_frames(matches, turned, inputs, options, with_motion=False).shutter
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


# From a solver's answer to the motion of the rig's body, which corrections and tables work with.


def body_motion(estimate: MotionEstimate, spec: SolverSpec, rig: StereoRig) -> Motion | str:
    """The body's motion in metres that an estimate stands for, or the reason why it stands for none.

    A left camera's translation t becomes the body's: d = t - o + R o, with o the left camera's offset. The pose
    after one period is then exact. Between the rows a constant twist of the camera is one of the body too; a
    camera that moves linearly has a body that does so up to |w|^2 |o| / 8.

    Args:
        estimate: a solver's answer.
        spec: what that solver declares: the point whose translation d is, and the motion model.
        rig: where the left camera is.
    """
    if not estimate.success:
        return estimate.reason
    if not estimate.metric:
        whose = "the left camera's " if spec.reference_point == "left" else ""
        return f"the length of d is not known in metres, only {whose}direction of translation"
    d = estimate.d
    if spec.reference_point == "left":
        offset = rig.offset("left")
        d = d - offset + so3.exp(estimate.w) @ offset
    return make_motion(spec.motion_model, estimate.w, d, spec.motion_parameters)


# Motion and shutter of four frames, from their matches: found, or refused with the reason.


BACKWARDS = (
    "time runs backwards in them: the two times are exchanged, or lines are read from the side opposite to what "
    "is given (`scan` in the rig's card)"
)

SHAKES = (
    "cannot tell the readout ratio: the rig shakes as no motion model does, which two frames do not tell from a "
    "readout. Give readout_ratio in the rig's card, or four frames and more"
)
_BEYOND_DOUBT = 23.0
"""Logarithm of odds between splines: 7, as of a probability of 0.999, did tracks count 0.15 and not a half."""
_MOMENTS = 33
"""Of a frame period, at which poses are compared."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundMotion:
    """The motion of the rig's body, and the solver's answer that it comes from."""

    motion: Motion
    """Of the model that the solver assumes, or that the matches prefer to it; metres."""
    robust: RobustEstimate
    """As the solver gave it: about its own reference point."""
    solver: str
    """Name of the solver's entry."""
    reference_point: str
    """The point whose translation ``robust.estimate.d`` is."""
    calibration: tuple[float, ...] = NO_ERRORS
    """What was taken from the matches before, see ``calibration.TERMS``."""
    choice: ModelChoice | None = None
    """How the motion model was chosen; None when it is the solver's."""
    gyro: GyroFound | None = None
    """What was found of a gyroscope; None: there is none."""

    @property
    def unevenness(self) -> tuple[float, float]:
        """How far the body is off an even motion through its poses at 0 and 1: root mean square over them.

        Radians, and metres of the middle of the rig: none of a rig that coasts, much of one that shakes.
        """
        tau = np.linspace(0.0, 1.0, _MOMENTS)
        (R, t), w = self.motion.body_from_world(tau), self.motion.w
        places = -(np.swapaxes(R, 1, 2) @ t[..., None])[..., 0]
        turns = so3.log(R @ np.swapaxes(so3.exp(tau[:, None] * w), 1, 2))
        shifts = places - tau[:, None] * places[-1]
        turned, shifted = (float(np.sqrt(np.mean(np.sum(each**2, axis=1)))) for each in (turns, shifts))
        return turned, shifted

    @property
    def disparity_offset(self) -> float:
        """px that were taken from the disparities."""
        return self.calibration[OFFSET]


def find_motion(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    rng: np.random.Generator | None = None,
    capture: Capture | None = None,
    splines: bool = True,
) -> FoundMotion:
    """The body's motion by the solver of the options; ``rng`` draws RANSAC's samples, by default from the seed.

    With a motion model in the options the matches decide which is used: by ``capture``, where the shutter was
    found too, or by a look at the models alone. With ``auto`` they may ask for a spline, if ``splines`` may be.

    Another package's solver answers from a process of its own, within the time limit of its card.

    Raises:
        RsbenchError: the solver cannot take the motion model of the options.
        NoMotionError: the solver found none, failed, or found only the direction of the translation.
    """
    entry = options.solver
    rng = np.random.default_rng(options.seed) if rng is None else rng
    choice = None if capture is None or options.motion_model is None else choose_model(capture)
    robust = _solved(entry if choice is None else entry_of(entry, choice), matches, rig, shutter, options, rng)
    if capture is None and options.motion_model is not None and robust.estimate.success:
        start = motion_of(robust.estimate, entry, rig)
        requested, seed = options.motion_model, options.seed
        choice = chosen_model(requested, start, matches, rig, shutter, options.robust, seed)
        if choice is not None and choice.used != entry.solver.spec.motion_model:
            robust = _solved(entry_of(entry, choice), matches, rig, shutter, options, rng)
    if choice is not None:
        robust = widened(robust, choice.spread)
    elif capture is not None and capture.motion_model in capture.peaks:
        robust = widened(robust, spread_by_unknowns(capture.peaks[capture.motion_model]))
    entry = entry if choice is None else entry_of(entry, choice)
    motion, point = motion_of(robust.estimate, entry, rig), entry.solver.spec.reference_point
    if splines and options.motion_model == AUTO:
        robust, choice, motion = or_spline(robust, choice, motion, matches, rig, shutter, options.seed)
    return FoundMotion(motion=motion, robust=robust, solver=entry.name, reference_point=point, choice=choice)


def or_spline(
    robust: RobustEstimate,
    choice: ModelChoice | None,
    law: Motion,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    seed: int,
) -> tuple[RobustEstimate, ModelChoice | None, Motion]:
    """An answer of a solver that ``takes_models``, or in its place a spline, where the matches ask for it."""
    found = two_frame_spline(matches, rig, shutter, law, seed)
    if found is None or found.probability < CERTAIN:
        return scaled(robust, dispersion_of_rows(matches, rig, shutter, law)), choice, law
    motion = found.motion
    estimate = replace(
        robust.estimate, w=motion.w, d=motion.d, noise_px=found.noise_px, covariance=found.covariance
    )
    count = MatchCount(inliers=int(np.count_nonzero(found.inliers)), matches=len(found.inliers))
    robust = replace(
        robust,
        estimate=estimate,
        inliers={**robust.inliers, "tracks": found.inliers},
        counts={**robust.counts, "tracks": count},
    )
    return robust, spline_choice(choice, motion, law, found.probability, found.unique), motion


def widened(robust: RobustEstimate, spread: FloatArray) -> RobustEstimate:
    """With what unknowns add to the covariance."""
    known = robust.estimate.covariance
    return (
        robust if known is None else replace(robust, estimate=replace(robust.estimate, covariance=known + spread))
    )


def scaled(robust: RobustEstimate, factor: float) -> RobustEstimate:
    """With a covariance of so many times the variance."""
    known = robust.estimate.covariance
    return robust if known is None else widened(robust, (factor - 1.0) * known)


def _solved(
    entry: SolverEntry,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    rng: np.random.Generator,
) -> RobustEstimate:
    if entry.built_in:
        return estimate_motion(matches, rig, shutter, entry.solver, options.robust, rng, entry.options.robust)
    with SolverRunner() as runner:
        return runner.robust(entry, matches, rig, shutter, options.robust, rng)


def chosen_model(
    requested: str,
    start: Motion,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    robust: RobustOptions,
    seed: int,
) -> ModelChoice | None:
    """The motion model that matches prefer, of a shutter that is known; None where nothing can be concluded.

    Args:
        requested: ``auto`` or a name.
        start: a motion near theirs, of any model.
    """
    given = KnownInputs(readout_ratio=shutter.readout_ratio, scanning=shutter.scanning, calibration=NO_ERRORS)
    known = known_of(matches, rig, given)
    capture = conclude([examine(matches, rig, known, robust, seed, start)])
    if requested not in (AUTO, *capture.peaks):  # one that the matches exclude, or another package's
        alone = conclude([examine(matches, rig, replace(known, models=(requested,)), robust, seed, start)])
        models, peaks = {**capture.models, requested: 0.0}, {**capture.peaks, **alone.peaks}
        capture = replace(capture, models=models, peaks=peaks)
    return choose_model(capture, requested)


def models_asked(motion_model: str | None) -> tuple[str, ...]:
    """Those that ``auto`` chooses from, or the one that is requested."""
    return MODELS if motion_model in (None, AUTO) else (str(motion_model),)


def takes_models(entry: SolverEntry) -> bool:
    """Whether a solver can assume any motion model."""
    solver = entry.solver
    return isinstance(solver, RefinedSolver) and solver.shutter == "rolling" and not solver.one_camera


def check_model(requested: str, entry: SolverEntry) -> None:
    """Raises RsbenchError when there is no such model to ask for, or the solver cannot take another one."""
    if requested != AUTO:
        load_kernel(requested)
    if not takes_models(entry):
        spec = entry.solver.spec
        known_to = f"solver {entry.name!r} knows only {spec.motion_model} motion and a {spec.shutter} shutter"
        known_to += "" if spec.metric else ", without a length"
        raise RsbenchError(f"--motion-model {requested}: {known_to}; take rs-stereo-refined")


def model_to_use(requested: str | None, entry: SolverEntry) -> str | None:
    """The one that is requested; else ``auto`` where the solver takes it. RsbenchError as of ``check_model``."""
    if requested is None:
        return AUTO if takes_models(entry) else None
    check_model(requested, entry)
    return requested


def entry_of(entry: SolverEntry, choice: ModelChoice) -> SolverEntry:
    """A refined solver with another motion model."""
    solver = entry.solver
    assert isinstance(solver, RefinedSolver)
    if choice.used == solver.motion_model and not choice.parameters:
        return entry
    return replace(
        entry, component=replace(solver, motion_model=choice.used, motion_parameters=dict(choice.parameters))
    )


def motion_of(estimate: MotionEstimate, entry: SolverEntry, rig: StereoRig) -> Motion:
    """The body's motion, metres, that a solver's answer means, in the model that the solver assumes.

    Raises:
        NoMotionError: the answer is a failure, or has no length.
    """
    motion = body_motion(estimate, entry.solver.spec, rig)
    if isinstance(motion, Motion):
        return motion
    if not estimate.success:
        raise NoMotionError(f"solver {entry.name!r} found no motion: {motion}")
    if entry.solver.spec.metric:
        raise NoMotionError(f"solver {entry.name!r}: {motion}: more matches must be seen by both cameras")
    raise NoMotionError(f"solver {entry.name!r}: {motion}; a correction needs metres, as rs-stereo-refined finds")


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedFrames:
    """Motion and shutter of four frames."""

    found: FoundMotion | None
    """None if none was requested."""
    shutter: RollingShutter
    matches: Correspondences
    """Those that it rests on; disparities as matched."""
    capture: Capture | None
    """How the shutter was found; None where it was given."""


def solve_frames(
    matches: Correspondences,
    rig: StereoRig,
    given: KnownInputs,
    options: CorrectionOptions,
    *,
    doubt: RefusedFramesError | None = None,
    in_order: bool = False,
    with_motion: bool = True,
) -> SolvedFrames:
    """Motion and shutter from matches; what ``given`` lacks of the shutter is estimated with the motion.

    Args:
        given: without a calibration its errors are estimated if the row differences of the matches show some;
            without a scanning it is estimated with the readout ratio, or is rows from the top where that is given.
        doubt: raised where the cameras read rows together, see ``match_unknown``.
        in_order: whether the frames are known to be in the order of time.
        with_motion: whether a motion is requested beside the shutter.

    Raises:
        RefusedFramesError: time runs backwards in the frames.
        NoMotionError: no motion explains the matches, or they do not determine the shutter.
    """
    scanning = given.scanning
    if given.readout_ratio is None:
        capture = find_capture(matches, rig, given, options)
        if scanning is not None and runs_backwards(capture, scans_of(rig.shutter_of(scanning, 1.0))):
            raise RefusedFramesError(BACKWARDS)
        shutter = shutter_found(capture, rig)
        together = rig.rows_together(shutter.scanning)
        used, errors = capture, capture.calibration if together else NO_ERRORS
        if together:
            if doubt is not None:
                raise doubt
            matches = on_their_rows(matches, rig)
    else:
        given, capture = replace(given, scanning=scanning or Scanning()), None
        shutter = given.shutter_of(rig)
        used, errors = _calibrated(matches, rig, given, options)
    if not with_motion:
        return SolvedFrames(found=None, shutter=shutter, matches=matches, capture=capture)
    at_rest = recalibrated(matches, rig, errors)
    found = replace(find_motion(at_rest, rig, shutter, options, capture=used), calibration=errors)
    if capture is None and not in_order and _runs_backwards(at_rest, rig, found, shutter, options):
        raise RefusedFramesError(BACKWARDS)
    if capture is not None and isinstance(found.motion, ContinuousMotion):
        raise NoMotionError(SHAKES)
    return SolvedFrames(found=found, shutter=shutter, matches=matches, capture=capture)


def _calibrated(
    matches: Correspondences,
    rig: StereoRig,
    given: KnownInputs,
    options: CorrectionOptions,
) -> tuple[Capture | None, tuple[float, ...]]:
    """What the matches say of a calibration that may be wrong, with a known shutter; None where it is right."""
    if given.calibration is not None or not rig.rows_together(given.scanning or Scanning()):
        return None, given.calibration or NO_ERRORS
    if not any(known_of(matches, rig, given).calibration_sigma):
        return None, NO_ERRORS
    capture = find_capture(matches, rig, given, options)
    return (capture, capture.calibration) if capture.peaks else (None, NO_ERRORS)


def find_capture(
    matches: Correspondences,
    rig: StereoRig,
    given: KnownInputs,
    options: CorrectionOptions,
) -> Capture:
    """Motion of two times, and what ``given`` lacks of shutter and calibration, from matches."""
    entry, models = options.solver, models_asked(options.motion_model)
    if options.motion_model is None and isinstance(entry.solver, RefinedSolver):
        models = (entry.solver.motion_model,)
    known = known_of(matches, rig, replace(given, models=models))
    capture = conclude([examine(matches, rig, known, options.robust, options.seed)])
    return as_global(capture, [matches], rig, known) if given.readout_ratio is None else capture


def _runs_backwards(
    matches: Correspondences,
    rig: StereoRig,
    found: FoundMotion,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> bool:
    """Whether time runs backwards in the frames: their lines then seem to be read from the opposite side.

    The laws must find the opposite scan beyond doubt, and near the given ratio: where no law fits they find any
    ratio. For a shaken rig splines under both scans decide, unless the laws find the given shutter.
    """
    if shutter.readout_ratio < LEAST_BACKWARDS or not shutter.plain:
        return False
    shakes, opposite = isinstance(found.motion, ContinuousMotion), reversed_scans(scans_of(shutter))
    if shakes:
        other = replace(shutter, scan=opposite.left, right_scan=opposite.right)  # pyrefly: ignore
        if log_odds_of_opposite(matches, rig, shutter, other, found.motion, options.seed) <= _BEYOND_DOUBT:
            return False
    models, start = models_asked(options.motion_model), None if shakes else found.motion
    scans = scans_by_laws(matches, rig, shutter, models, options.robust, options.seed, start)
    return scans != scans_of(shutter) if shakes else scans == opposite
