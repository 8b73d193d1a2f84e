"""The whole chain on four frames of a rolling-shutter rig: match, motion, depth, corrected frames.

Images in, arrays out; files are the business of others.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import MOTION_MODELS, Motion
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter
from rsbench.errors import RsbenchError
from rsbench.pipeline.footage import FRAMES, VIEWS, View
from rsbench.pipeline.readout import ReadoutEstimate, estimate_readout_ratio, reversed_in_time, runs_backwards
from rsbench.pipeline.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.correction import WarpOptions
from rsbench.vision.features import MatchOptions, match_stereo_frames
from rsbench.vision.flow import depth_from_motion
from rsbench.vision.fusion import Fused, Origin, SourceView, fuse, inpaint
from rsbench.vision.sky import sky_mask
from rsbench.vision.stereo_depth import SgmOptions, fill_holes, stereo_disparities

Images = Mapping[View, NDArray[Any]]
Step = Callable[[str], None]
_FEW_STEREO = 0.1
"""Left-right matches per temporal match below which the images may be swapped or not rectified."""
_FEWEST_MATCHES = 12
_MAX_READOUT_SIGMA = 0.25
_BRIGHT = 99.9
"""Percentile of a 16-bit image that becomes white for matching."""


@dataclass(frozen=True, kw_only=True)
class CorrectionOptions:
    """What decides the result, apart from the frames and the rig."""

    target_row: float = 0.0
    """The time of this row of the frame is the time of its corrected image."""
    use_other_views: bool = True
    """Fill what the frame did not see from the other three."""
    depth_from_motion: bool = True
    """Where the other camera gives no depth, take it from the flow to the other frame and the motion."""
    guess_depth: bool = True
    """Where no depth was found, take that of the farther neighbour in the row."""
    find_sky: bool = True
    inpaint: bool = False
    """Invent what nobody saw; it stays marked."""
    seed: int = 0
    solver: RefinedSolver = field(default_factory=RefinedSolver)
    matching: MatchOptions = field(default_factory=MatchOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    sgm: SgmOptions = field(default_factory=SgmOptions)
    warp: WarpOptions = field(default_factory=WarpOptions)


@dataclass(frozen=True, kw_only=True, eq=False)
class FramePair:
    """One time of the rig: both images with their depth."""

    images: dict[Side, NDArray[Any]]
    depth: dict[Side, NDArray[np.float32]]
    """(H, W) metres in each row's own camera; inf in the sky and at no disparity, 0 unknown."""
    guess: dict[Side, NDArray[np.float32]]
    """(H, W) the same where ``depth`` is unknown, from the neighbours; 0 elsewhere."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedFrames:
    """The result for four frames."""

    motion: Motion
    robust: RobustEstimate
    shutter: RollingShutter
    readout: ReadoutEstimate | None
    """How the readout ratio was estimated; None when it was given."""
    matches: Correspondences
    frames: dict[View, Fused]
    seconds: dict[str, float]


class NoMotionError(Exception):
    """The frames are in order, but no motion explains their matches; the message says why."""


def frame_pair(left: NDArray[Any], right: NDArray[Any], rig: StereoRig, options: CorrectionOptions) -> FramePair:
    """Depth of both images (H, W[, 3]), uint8 or uint16, of one time."""
    images = dict(zip(SIDES, (left, right), strict=True))
    levels = dict(zip(SIDES, eight_bit([left, right]), strict=True))
    both = stereo_disparities(levels["left"], levels["right"], rig, options.sgm)
    disparities = dict(zip(SIDES, both, strict=True))
    depth, guess = {}, {}
    for side in SIDES:
        sky = sky_mask(levels[side], disparities[side]) if options.find_sky else np.zeros(left.shape[:2], np.bool_)
        disparity = np.where(sky, np.float32(0.0), disparities[side])
        depth[side] = _depth(disparity, rig)
        filled = fill_holes(disparity)
        guess[side] = np.where(np.isnan(disparity), _depth(filled, rig), np.float32(0.0))
    return FramePair(images=images, depth=depth, guess=guess)


def frame_pairs(images: Images, rig: StereoRig, options: CorrectionOptions) -> tuple[FramePair, FramePair]:
    """``frame_pair`` of frame 0 and of frame 1, side by side: the matcher itself keeps one core busy."""
    with ThreadPoolExecutor(len(FRAMES)) as pool:
        first, second = pool.map(
            lambda frame: frame_pair(images["left", frame], images["right", frame], rig, options), FRAMES
        )
    return first, second


def complete_depth(
    pairs: tuple[FramePair, FramePair], rig: StereoRig, shutter: RollingShutter, motion: Motion
) -> tuple[FramePair, FramePair]:
    """The same frames with depth from the motion where the other camera gave none."""

    def side_depths(side: Side) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        first, second = eight_bit([pair.images[side] for pair in pairs])
        unknown = pairs[0].depth[side] == 0.0, pairs[1].depth[side] == 0.0
        return depth_from_motion((first, second), unknown, rig, shutter, motion, side)

    with ThreadPoolExecutor(len(SIDES)) as pool:
        found = dict(zip(SIDES, pool.map(side_depths, SIDES), strict=True))
    first, second = (_completed(pair, {side: found[side][k] for side in SIDES}) for k, pair in enumerate(pairs))
    return first, second


def _completed(pair: FramePair, found: dict[Side, NDArray[np.float32]]) -> FramePair:
    depth = {side: np.where(found[side] > 0.0, found[side], pair.depth[side]) for side in SIDES}
    guess = {side: np.where(found[side] > 0.0, np.float32(0.0), pair.guess[side]) for side in SIDES}
    return FramePair(images=pair.images, depth=depth, guess=guess)


def _depth(disparity: NDArray[np.float32], rig: StereoRig) -> NDArray[np.float32]:
    """Metres (H, W): inf where there is no disparity, 0 where it is unknown."""
    depth = np.where(np.isnan(disparity), 0.0, rig.depth(disparity))
    return np.nan_to_num(depth, nan=np.inf, posinf=np.inf).astype(np.float32)


def match_frames(images: Images, options: CorrectionOptions) -> Correspondences:
    """Correspondences of the four frames.

    Raises:
        RsbenchError: no texture, sides exchanged, or not rectified.
    """
    matches = _matches(images, SIDES, options)
    temporal = len(matches.left) + len(matches.right)
    if temporal < _FEWEST_MATCHES:
        raise RsbenchError(
            f"frames: only {temporal} matches between frame 0 and frame 1; {_FEWEST_MATCHES} are needed: the "
            "frames show no texture, or not the same scene"
        )
    stereo = min(len(matches.stereo_0), len(matches.stereo_1))
    if stereo < _FEW_STEREO * temporal / 2:
        swapped = _matches(images, (SIDES[1], SIDES[0]), options)
        if min(len(swapped.stereo_0), len(swapped.stereo_1)) > 3 * stereo:
            raise RsbenchError("frames: the left and the right images are exchanged; give the left ones first")
        raise RsbenchError(
            f"frames: only {stereo} of about {temporal // 2} features are found on the same row of the left and "
            "the right image; the frames must be rectified and in the order LEFT_0 RIGHT_0 LEFT_1 RIGHT_1"
        )
    return matches


def _matches(images: Images, sides: tuple[Side, Side], options: CorrectionOptions) -> Correspondences:
    left_0, right_0, left_1, right_1 = eight_bit([images[side, frame] for frame in (0, 1) for side in sides])
    return match_stereo_frames(left_0, right_0, left_1, right_1, options.matching)


def eight_bit(images: list[NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Images for matching; 16-bit ones are brought to 8 bits by one factor, for they may use few of their bits."""
    if images[0].dtype == np.uint8:
        return images
    top = max(float(np.percentile(image, _BRIGHT)) for image in images)
    scale = np.float32(255.0 / max(top, 1.0))
    return [np.clip(image * scale + np.float32(0.5), 0.0, 255.0).astype(np.uint8) for image in images]


def solve_frames(
    matches: Correspondences, rig: StereoRig, readout_ratio: float | None, options: CorrectionOptions
) -> tuple[RobustEstimate, RollingShutter, ReadoutEstimate | None]:
    """Motion and shutter from matches; the readout ratio is estimated when it is None.

    Raises:
        RsbenchError: the frames fit better in the opposite order.
        NoMotionError: no motion explains the matches, or they do not determine the readout ratio.
    """
    readout = None
    if readout_ratio is None:
        readout = estimate_readout_ratio(matches, rig, options.solver, options.robust, options.seed)
        if readout is None:
            raise NoMotionError("no motion explains the matches at any readout ratio")
        if not readout.sigma <= _MAX_READOUT_SIGMA:
            raise NoMotionError(
                f"the matches do not determine the readout ratio ({readout}): the motion is too small; put "
                "readout_ratio into the rig's card"
            )
        readout_ratio = readout.readout_ratio
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=readout_ratio)
    rng = np.random.default_rng(options.seed)
    robust = estimate_motion(matches, rig, shutter, options.solver, options.robust, rng)
    if not robust.estimate.success:
        raise NoMotionError(f"no motion found: {robust.estimate.reason}")
    if _runs_backwards(matches, rig, robust, shutter, readout, options):
        raise RsbenchError(
            "frames: time runs backwards in them: frame 0 and frame 1 are exchanged, or rows are read from the "
            "bottom up (turn the images by 180 degrees then, and exchange left and right)"
        )
    return robust, shutter, readout


def _runs_backwards(
    matches: Correspondences,
    rig: StereoRig,
    robust: RobustEstimate,
    shutter: RollingShutter,
    readout: ReadoutEstimate | None,
    options: CorrectionOptions,
) -> bool:
    """Whether time runs backwards in the frames: they then fit a negative readout ratio."""
    ratio = backward_ratio = shutter.readout_ratio
    if readout is not None:
        if ratio > 3.0 * readout.sigma:
            return False
        # Backwards, the best ratio is negative, so the search ended near 0.
        solver, turned = options.solver, reversed_in_time(matches)
        backward = estimate_readout_ratio(turned, rig, solver, options.robust, options.seed)
        if backward is None:
            return False
        backward_ratio = backward.readout_ratio
    return runs_backwards(
        matches, rig, ratio, backward_ratio, options.solver, options.robust, robust, options.seed
    )


def correct_frames(
    pairs: tuple[FramePair, FramePair],
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    options: CorrectionOptions,
    views: tuple[View, ...] = VIEWS,
) -> dict[View, Fused]:
    """Corrected frames of the views asked for, at the time of ``options.target_row`` of each."""
    poses = {view: row_poses(rig, shutter, motion, *view) for view in VIEWS}

    def corrected(view: View) -> Fused:
        side, frame = view
        target = rig.cam_from_world(motion, shutter.row_time(options.target_row, frame), side)
        fused = fuse(_sources(pairs, view, poses, options), rig.camera, target, options.warp)
        return _finish(fused, options)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(views, pool.map(corrected, views), strict=True))


def _sources(
    pairs: tuple[FramePair, FramePair], view: View, poses: Mapping[View, Pose], options: CorrectionOptions
) -> list[SourceView]:
    """The images that a corrected view is made of, in the order in which they are trusted."""
    side, frame = view
    other: Side = "right" if side == "left" else "left"
    here, then = pairs[frame], pairs[1 - frame]
    sources = [_view(here, side, poses[side, frame], Origin.HERE)]
    if options.use_other_views:
        sources += [
            _view(here, other, poses[other, frame], Origin.OTHER_CAMERA),
            _view(then, side, poses[side, 1 - frame], Origin.OTHER_FRAME),
            _view(then, other, poses[other, 1 - frame], Origin.OTHER_FRAME),
        ]
    if options.guess_depth:
        sources.append(_view(here, side, poses[side, frame], Origin.GUESSED))
    return sources


def _view(pair: FramePair, side: Side, poses: Pose, origin: Origin) -> SourceView:
    depth = pair.guess if origin is Origin.GUESSED else pair.depth
    return SourceView(image=pair.images[side], depth=depth[side], poses=poses, origin=origin)


def _finish(fused: Fused, options: CorrectionOptions) -> Fused:
    if not options.inpaint:
        return fused
    image = inpaint(fused.image, fused.origin == Origin.NOBODY)
    return Fused(image=image, origin=fused.origin, depth=fused.depth, corrected=fused.corrected)


def motion_of(robust: RobustEstimate, options: CorrectionOptions) -> Motion:
    """The estimate as a motion of the model that the solver assumes."""
    return MOTION_MODELS[options.solver.motion_model](robust.estimate.w, robust.estimate.d)


def correct_four(
    images: Images,
    rig: StereoRig,
    readout_ratio: float | None,
    options: CorrectionOptions,
    step: Step = lambda word: None,
) -> CorrectedFrames:
    """Correct the four frames (H, W[, 3]), uint8 or uint16, of a rig over one frame period.

    ``readout_ratio`` None has it estimated. ``step`` is called with the name of each of the 4 steps done.

    Raises:
        RsbenchError: frames that cannot be what they are said to be.
        NoMotionError: the matches determine no motion or readout ratio.
    """
    clock = _Clock(step)
    matches = match_frames(images, options)
    clock("matching")
    robust, shutter, readout = solve_frames(matches, rig, readout_ratio, options)
    clock("motion")
    motion = motion_of(robust, options)
    pairs = frame_pairs(images, rig, options)
    if options.depth_from_motion:
        pairs = complete_depth(pairs, rig, shutter, motion)
    clock("depth")
    frames = correct_frames(pairs, rig, shutter, motion, options)
    clock("correction")
    return CorrectedFrames(
        motion=motion,
        robust=robust,
        shutter=shutter,
        readout=readout,
        matches=matches,
        frames=frames,
        seconds=clock.seconds,
    )


class _Clock:
    """Seconds of each step."""

    def __init__(self, step: Step) -> None:
        self.seconds: dict[str, float] = {}
        self._step, self._last = step, time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now
        self._step(name)
