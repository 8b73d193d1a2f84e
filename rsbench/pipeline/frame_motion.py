"""Matches, motion and shutter of four frames: found, or refused with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.model_choice import ModelChoice, settle_model
from rsbench.capture.readout import LEAST_BACKWARDS, ReadoutEstimate, estimate_readout_ratio, runs_backwards
from rsbench.capture.rectification import RefusedFramesError, check_rig, without_offset
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.pipeline.body_motion import body_motion
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_depth import Images
from rsbench.pipeline.isolated_solver import SolverRunner
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.registry import SolverEntry
from rsbench.solvers.engine.robust_motion import RobustEstimate, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.feature_matcher import find_correspondences
from rsbench.vision.features import SiftMatcher
from rsbench.vision.images import eight_bit
from rsbench.vision.undistortion import undistorted, with_lens

_FEWEST_MATCHES = 12
_MAX_READOUT_SIGMA = 0.25
BACKWARDS = (
    "time runs backwards in them: the two times are exchanged, or rows are read from the bottom up (turn the "
    "images by 180 degrees then, and exchange left and right)"
)
_REFEREE = "rs-stereo-refined"
"""Name of the card with the default parameters of ``RefinedSolver``."""


class NoMotionError(RsbenchError):
    """The frames are in order, but no motion explains their matches; the message says why."""


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
    disparity_offset: float = 0.0
    """What was taken from the disparities before, px."""
    choice: ModelChoice | None = None
    """How the motion model was chosen; None when it is the solver's."""


def find_matches(images: Images, options: CorrectionOptions, sides: tuple[Side, Side] = SIDES) -> Correspondences:
    """Correspondences of the four frames, whatever they are; ``sides`` says which images are taken for the left's.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    order = [(side, frame) for frame in (0, 1) for side in sides]
    levels = eight_bit([images[view] for view in order])
    names = [(side, frame) for frame in (0, 1) for side in SIDES]
    return find_correspondences(options.features, dict(zip(names, levels, strict=True)))


def find_matches_of_rig(
    images: Images, rig: StereoRig, scanning: Scanning, options: CorrectionOptions
) -> Correspondences:
    """``find_matches`` of cameras as they are, in pixels of their images.

    Matchers see images without distortion. Where the cameras do not read rows together, a left-right match is of
    two times, and its ends of two rows: rsbench's own matcher looks for it anywhere, and of others, which may look
    along the row, only matches over time are kept.

    Raises:
        RsbenchError: another package's feature matcher failed, see ``find_correspondences``.
    """
    camera = rig.camera
    images = {view: undistorted(image, camera) for view, image in images.items()}
    component = options.features.component
    if not scanning.rows_together and isinstance(component, SiftMatcher):
        apart = replace(options.features, component=replace(component, row_tolerance=None))
        options = replace(options, features=apart)
    matches = with_lens(find_matches(images, options), camera)
    if scanning.rows_together or isinstance(component, SiftMatcher):
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
        judge_rig: whether to look if frame 0 is a rectified pair in the right order.

    Raises:
        RefusedFramesError: no texture, sides exchanged, not rectified, or not of one time.
    """
    scanning = scanning or Scanning()
    if judge_rig and scanning.rows_together:
        check_rig(images["left", 0], images["right", 0], rig)
    matches = find_matches_of_rig(images, rig, scanning, options)
    temporal = max(len(matches.left) + len(matches.right), 2 * len(matches.tracks))
    if temporal < _FEWEST_MATCHES:
        raise RefusedFramesError(
            f"only {temporal} matches between the two times; {_FEWEST_MATCHES} are needed: the frames show no "
            "texture, or not the same scene"
        )
    return matches


def find_motion(
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    rng: np.random.Generator | None = None,
) -> FoundMotion:
    """The body's motion by the solver of the options; ``rng`` draws RANSAC's samples, by default from the seed.

    Another package's solver answers from a process of its own, within the time limit of its card.

    Raises:
        RsbenchError: the solver cannot take the motion model of the options.
        NoMotionError: the solver found none, failed, or found only the direction of the translation.
    """
    entry = options.solver
    rng = np.random.default_rng(options.seed) if rng is None else rng
    if entry.built_in:
        robust = estimate_motion(matches, rig, shutter, entry.solver, options.robust, rng, entry.options.robust)
    else:
        with SolverRunner() as runner:
            robust = runner.robust(entry, matches, rig, shutter, options.robust, rng)
    motion, choice = motion_of(robust.estimate, entry, rig), None
    if options.motion_model is not None:
        robust, choice = settle_model(
            options.motion_model, robust, entry, matches, rig, shutter, options.robust, rng
        )
        motion = motion if choice is None else choice.motion
    point = entry.solver.spec.reference_point
    return FoundMotion(motion=motion, robust=robust, solver=entry.name, reference_point=point, choice=choice)


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


def find_readout(
    matches: Correspondences, rig: StereoRig, options: CorrectionOptions, disparity_offset: float | None = None
) -> ReadoutEstimate | None:
    """The readout ratio that explains the matches best, by ``referee``; None when no motion does at any."""
    _, judge = referee(options.solver)
    return estimate_readout_ratio(matches, rig, judge, options.robust, options.seed, disparity_offset)


def referee(entry: SolverEntry) -> tuple[str, RefinedSolver]:
    """The solver that finds an unknown readout ratio and the direction of time, with its name.

    The chosen one when it is a refined one of both cameras, else rs-stereo-refined. Both need residuals that hold
    for any readout ratio, and a fit as good as the matches allow: a solver that is off by pixels would blame the
    shutter.
    """
    solver = entry.solver
    if isinstance(solver, RefinedSolver) and not solver.one_camera:
        return entry.name, solver
    return _REFEREE, RefinedSolver()


def solve_frames(
    matches: Correspondences,
    rig: StereoRig,
    readout_ratio: float | None,
    options: CorrectionOptions,
    disparity_offset: float | None = None,
    scanning: Scanning | None = None,
) -> tuple[FoundMotion, RollingShutter, ReadoutEstimate | None]:
    """Motion and shutter from matches; the readout ratio is estimated when it is None.

    Args:
        disparity_offset: what a disparity is too large by, px; None has it estimated with the readout ratio,
            and is 0 where that is known.
        scanning: how the cameras read; must be plain where the readout ratio is estimated.

    Raises:
        RefusedFramesError: time runs backwards in the frames.
        NoMotionError: no motion explains the matches, or they do not determine the readout ratio.
    """
    shutter, readout = solve_shutter(matches, rig, readout_ratio, options, disparity_offset)
    shutter = (scanning or Scanning()).shutter_of(rig.camera.width, rig.camera.height, shutter.readout_ratio)
    offset = (disparity_offset or 0.0) if readout is None else readout.disparity_offset
    matches = without_offset(matches, offset)
    found = replace(find_motion(matches, rig, shutter, options), disparity_offset=offset)
    if readout is None and _runs_backwards(matches, rig, found.robust, shutter, options):
        raise RefusedFramesError(BACKWARDS)
    return found, shutter, readout


def solve_shutter(
    matches: Correspondences,
    rig: StereoRig,
    readout_ratio: float | None,
    options: CorrectionOptions,
    disparity_offset: float | None = None,
) -> tuple[RollingShutter, ReadoutEstimate | None]:
    """The shutter, from its readout ratio or, when that is None, from the matches.

    Raises:
        RefusedFramesError: time runs backwards in the frames.
        NoMotionError: no motion explains the matches, or they do not determine the readout ratio.
    """
    readout = None
    if readout_ratio is None:
        readout = find_readout(matches, rig, options, disparity_offset)
        if readout is None:
            raise NoMotionError("no motion explains the matches at any readout ratio")
        check_readout(readout)
        readout_ratio = readout.readout_ratio
    return RollingShutter(height=rig.camera.height, readout_ratio=readout_ratio), readout


def check_readout(readout: ReadoutEstimate) -> None:
    """Whether frames can be corrected with this estimate.

    Raises:
        RefusedFramesError: time runs backwards in the frames.
        NoMotionError: the matches do not determine the readout ratio.
    """
    if readout.backwards:
        raise RefusedFramesError(BACKWARDS)
    if not readout.sigma <= _MAX_READOUT_SIGMA:
        raise NoMotionError(
            f"the matches do not determine the readout ratio ({readout}): the motion is too small; put "
            "readout_ratio into the rig's card"
        )


def _runs_backwards(
    matches: Correspondences,
    rig: StereoRig,
    robust: RobustEstimate,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> bool:
    """Whether time runs backwards in the frames: they then fit a negative readout ratio.

    At a ratio near 0 there is no order to see, and a wrong ratio or focal length is no wrong order: what counts is
    the ratio that fits best. It is not looked for with a lens or another scan: those are of calibrated cameras.
    """
    _, judge = referee(options.solver)
    if shutter.readout_ratio < LEAST_BACKWARDS or rig.camera.lens is not None or not shutter.plain:
        return False
    if judge is not options.solver.solver:
        rng = np.random.default_rng(options.seed)
        robust = estimate_motion(matches, rig, shutter, judge, options.robust, rng)
        if not robust.estimate.success:
            return False
    if not runs_backwards(matches, rig, shutter.readout_ratio, judge, options.robust, robust, options.seed):
        return False
    best = find_readout(matches, rig, options)
    return best is not None and best.backwards
