"""The correction of four frames of a rolling-shutter rig: matching, motion, depth, corrected frames.

The functions take images and return arrays, without files. Values that the caller knows are passed as ``Given``
and not estimated, so that users, tables and studies with true values share this code.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, OFFSET
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.rig_calibration import FoundRig
from rsbench.capture.two_frame_estimate import Capture
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, VIEWS, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_capture import KnownCapture, know_four, with_found_camera
from rsbench.pipeline.frame_depth import (
    CorrectionOptions,
    Images,
    Pairs,
    complete_depth,
    frame_pairs,
    inpainted,
    moving_pairs,
    timed_pairs,
)
from rsbench.pipeline.frame_motion import FoundMotion, solve_frames
from rsbench.pipeline.mono_sequence import correct_frames as correct_own_frames
from rsbench.pipeline.mono_sequence import options_of_camera
from rsbench.vision.corrector import CorrectionProblem, find_corrected_rows
from rsbench.vision.correctors import FusionCorrector
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import needs_motion, refuse_motion

Step = Callable[[str], None]
STEPS = ("matching", "motion", "depth", "correction")


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """Values that are given; None is estimated if the corrector needs it."""

    matches: Correspondences | None = None
    """Matches, which are used without a check that the frames fit the rig."""
    motion: Motion | None = None
    """Motion of the body, metres, of any model; the readout ratio must then be given too."""
    pairs: Pairs | None = None
    """Frames with their depth; with ``depth_from_motion``, unknown depth is still estimated."""
    gyro: FloatArray | None = None
    """(n, 4) samples of a gyroscope, as in ``Correspondences``; they cannot be estimated from frames."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedFrames:
    """The result for four frames; None: the value was neither given nor needed."""

    motion: Motion | None
    """Motion of the body that was used for the correction."""
    found: FoundMotion | None
    """The estimate of the motion; None if it was given."""
    known: KnownCapture
    """Rig, shutter and calibration errors, given or estimated, and the estimates."""
    matches: Correspondences | None
    pairs: Pairs | None
    """The frames with the depth that was used for the correction."""
    frames: dict[View, Fused]
    """Corrected frames; each has a field that says whether its correction succeeded."""
    at_rows: list[dict[View, Fused]]
    """The frames corrected to each of the further target rows."""
    seconds: dict[str, float]
    """Duration of each of ``STEPS``; matching includes the estimate of the capture, and stereo matching runs
    beside the motion."""

    @property
    def rig(self) -> StereoRig:
        """The cameras, including values that were estimated."""
        return self.known.rig

    @property
    def shutter(self) -> RollingShutter:
        """The shutter, given or estimated."""
        return self.known.shutter

    @property
    def capture(self) -> Capture | None:
        """The estimate of the shutter; None if it was given."""
        return self.known.capture

    @property
    def rig_found(self) -> FoundRig | None:
        """The estimated errors of the rig's calibration; None if the rows of the frames agree with it."""
        return self.known.rig_found


def correct_four(
    images: Images,
    rig: StereoRig,
    inputs: KnownInputs,
    options: CorrectionOptions,
    step: Step = lambda word: None,
    given: Given | None = None,
    views: tuple[View, ...] = VIEWS,
    rows: Sequence[float] = (),
) -> CorrectedFrames:
    """Correct four frames (H, W[, 3]), uint8 or uint16, of a rig over one frame period.

    Args:
        images: images by side and frame.
        rig: the rig, whose cameras have the images' size.
        inputs: given values. A scanning that is not given is estimated with the readout ratio; if that is given,
            both cameras read rows from the top at the same time. Calibration errors that are not given are
            estimated if the row differences of the matches show some.
        options: the components, and options of the steps between them.
        step: called with the name of each of the 4 steps when it is done.
        given: further given values.
        views: the frames to correct.
        rows: further target rows, to whose times the frames are corrected too.

    Raises:
        RsbenchError: the frames contradict the arguments, the options do not support the cameras (see
            ``check_cameras``), or a component of another package failed.
        NoMotionError: the matches do not determine a motion or readout ratio.
        ValueError: a motion is given without a readout ratio.
    """
    given, errors = given or Given(), inputs.calibration or NO_ERRORS
    check_cameras(rig, inputs.reading, options, errors[OFFSET], given.pairs is not None)
    if given.motion is not None and inputs.readout_ratio is None:
        raise ValueError("readout_ratio must be given with the motion: one estimated from matches may not fit it")
    clock, needs = _Clock(step), options.corrector.component.spec.needs
    wanted = given.motion is None and "motion" in needs
    rig, note = with_found_camera(rig, [images], options, inputs)
    if inputs.readout_ratio is not None and not wanted and (given.matches or "matches" not in needs):
        shutter = inputs.shutter_of(rig)
        known = KnownCapture(rig=rig, shutter=shutter, matches=given.matches, calibration=errors)
    else:
        known = know_four(images, rig, inputs, options, given.matches)
    known = replace(known, camera_note=note)
    clock("matching")
    rig, shutter, offset = known.rig, known.shutter, known.calibration[OFFSET]
    if known.capture is not None:
        check_cameras(rig, shutter.scanning, options, errors[OFFSET], given.pairs is not None)
    pairs, stereo = given.pairs, None
    with ThreadPoolExecutor(1) as beside:
        if "depth" in needs and pairs is None and options.matcher.built_in and not _waits(rig, shutter, options):
            stereo = beside.submit(frame_pairs, images, rig, options, offset)
        found = solve_frames(known, options) if wanted else None
        clock("motion")
        pairs = pairs if stereo is None else stereo.result()
    motion = given.motion if found is None else found.motion
    if "depth" in needs:
        pairs = find_depth(images, rig, shutter, motion, options, pairs, offset)
    clock("depth")
    given = replace(given, matches=known.matches, motion=motion, pairs=pairs)
    frames, *at_rows = correct_known_rows(
        images, given, rig, shutter, options, views, offset, (options.target_row, *rows), check=found is not None
    )
    clock("correction")
    return CorrectedFrames(
        motion=motion,
        found=found,
        known=known,
        matches=known.matches,
        pairs=pairs,
        frames=frames,
        at_rows=at_rows,
        seconds=clock.seconds,
    )


def check_cameras(
    rig: StereoRig,
    scanning: Scanning,
    options: CorrectionOptions,
    disparity_offset: float,
    depth_is_known: bool = False,
) -> None:
    """Check that the options support the cameras.

    Raises:
        RsbenchError: depth is needed without motion although the two images of a pair have different times; or an
            offset is given for cameras with a lens or another scan, or for a matcher that needs the motion.
    """
    needs = options.corrector.component.spec.needs
    if not depth_is_known and "depth" in needs:
        _check_matcher(options, disparity_offset)
    if not (depth_is_known or rig.rows_together(scanning)) and "depth" in needs and "motion" not in needs:
        raise RsbenchError(
            f"scan = {scanning.scan!r}, right_scan = {scanning.right_scan!r}, "
            f"right_delay = {scanning.right_delay}: depth needs the motion between the times of both cameras, "
            f"which corrector {options.corrector.name!r} does not use"
        )
    lens = rig.camera.lens
    what = f"camera.lens = {lens.model!r}" if lens is not None else f"scan = {scanning.scan!r}"
    what = what if rig.aligned else "cameras that differ or look in different directions"
    if disparity_offset and not (rig.rectified and scanning.plain):
        raise RsbenchError(
            f"disparity_offset = {disparity_offset}: must be 0 with {what}; calibrate the rig again"
        )


def _check_matcher(options: CorrectionOptions, disparity_offset: float) -> None:
    """Raise RsbenchError if the matcher needs a motion and there is none, or a disparity offset is given too."""
    if not needs_motion(options.matcher):
        return
    if "motion" not in options.corrector.component.spec.needs:
        refuse_motion(options.matcher, f"corrector {options.corrector.name!r} does not use one")
    if disparity_offset:
        raise RsbenchError(
            f"disparity_offset = {disparity_offset}: must be 0 with matcher {options.matcher.name!r}; "
            "calibrate the rig again"
        )


def find_depth(
    images: Images,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion | None,
    options: CorrectionOptions,
    pairs: Pairs | None = None,
    disparity_offset: float = 0.0,
    frames: tuple[int, ...] = FRAMES,
) -> Pairs:
    """The frames with depth by the matcher unless ``pairs`` has it, completed from the motion in ``frames``."""
    if pairs is None and _waits(rig, shutter, options):
        if motion is None:
            by_motion = needs_motion(options.matcher)
            needer = f"matcher {options.matcher.name!r}" if by_motion else "a pair of images with two times"
            raise ValueError(f"the motion must be given: {needer} needs it")
        pairs = moving_pairs(images, rig, shutter, motion, options)
    elif pairs is None:
        pairs = frame_pairs(images, rig, options, disparity_offset)
    if not all(pair.timed for pair in pairs):
        if motion is None:
            raise ValueError("the motion must be given for depth from cameras with a lens")
        pairs = timed_pairs(pairs, rig, shutter, motion)
    if options.depth_from_motion and motion is not None and not all(pair.with_motion for pair in pairs):
        pairs = complete_depth(pairs, rig, shutter, motion, frames)
    return pairs


def _waits(rig: StereoRig, shutter: RollingShutter, options: CorrectionOptions) -> bool:
    """Whether stereo depth needs the motion."""
    return needs_motion(options.matcher) or not rig.rows_together(shutter.scanning, shutter.readout_ratio)


def correct_frames(
    images: Images,
    pairs: Pairs | None,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion | None,
    options: CorrectionOptions,
    views: tuple[View, ...] = VIEWS,
    disparity_offset: float = 0.0,
) -> dict[View, Fused]:
    """``correct_known_rows`` for one row and for correctors that need nothing but a motion and depth."""
    given = Given(motion=motion, pairs=pairs)
    return correct_known_rows(images, given, rig, shutter, options, views, disparity_offset, check=False)[0]


def correct_known_rows(
    images: Images,
    known: Given,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    views: tuple[View, ...],
    disparity_offset: float,
    rows: Sequence[float] | None = None,
    check: bool = True,
) -> list[dict[View, Fused]]:
    """Correct the given views to the times of target rows, as images of the same cameras and lenses.

    At a readout ratio of 0 (global shutter) the frames are returned unchanged.

    Args:
        rows: target rows; by default the one in the options.
        check: whether frames that an estimated motion does not explain are corrected by each camera alone. A given
            motion is used as it is: a comparison of motions must not mend the worst of them.

    Raises:
        RsbenchError: the corrector needs a gyroscope's samples and there are none, or the corrector of another
            package failed, see ``find_corrected_rows``.
    """
    rows = (options.target_row,) if rows is None else rows
    pairs, needs = known.pairs, options.corrector.component.spec.needs
    if shutter.still and not (options.one_time and shutter.right_delay and known.motion is not None):
        return [uncorrected(images, views, pairs) for _ in rows]
    if "gyro" in needs and known.gyro is None:
        raise RsbenchError(
            f"corrector {options.corrector.name!r}: needs the samples of a gyroscope: give them as gyro in "
            "Python, or evaluate a dataset that has the channel imu"
        )
    problem = CorrectionProblem(
        images=images,
        rig=rig,
        shutter=shutter,
        target_row=options.target_row,
        motion=known.motion,
        depth=None if pairs is None else {(s, f): pairs[f].depth[s] for s in SIDES for f in FRAMES},
        guess=None if pairs is None else {(s, f): pairs[f].guess[s] for s in SIDES for f in FRAMES},
        disparity_offset=disparity_offset,
        matches=known.matches if "matches" in needs else None,
        gyro=known.gyro if "gyro" in needs else None,
        one_time=options.one_time,
    )
    found = find_corrected_rows(options.corrector, problem, views, rows)
    if check:
        found = [
            _credible(each, replace(problem, target_row=row), options)
            for each, row in zip(found, rows, strict=True)
        ]
    return [{view: inpainted(fused, options) for view, fused in corrected.items()} for corrected in found]


_CREDIBLE = 0.93
"""Least share of the flow beside moving objects that the motion of a rig must explain. It is at least 0.96 on
rendered frames, also of posts and trees where flow errs, and 0.98 on real frames whose calibration is right; 0.76
to 0.93 on others, of which motion or convergence are wrong; below 0.3 if a motion is clearly wrong."""


def _credible(
    frames: dict[View, Fused], problem: CorrectionProblem, options: CorrectionOptions
) -> dict[View, Fused]:
    """Return the frames; if the motion does not explain the images, correct them by each camera alone instead."""
    return {
        view: _by_one_camera(problem, view, fused.explained, options) if fused.explained < _CREDIBLE else fused
        for view, fused in frames.items()
    }


def _by_one_camera(problem: CorrectionProblem, view: View, explained: float, options: CorrectionOptions) -> Fused:
    """Correct a frame by the frames of its own camera, without depth; if that fails, return it uncorrected."""
    (side, frame), shutter, camera = view, problem.shutter, problem.rig.sensor(view[0])
    ratio, lines = shutter.ratio_of(side), shutter.lines(side)
    row = float(problem.target_time(view) - shutter.start(frame, side)) * lines / ratio if ratio else 0.0
    own = RollingShutter(height=camera.height, width=camera.width, readout_ratio=ratio, scan=shutter.scan_of(side))
    images, fill = [problem.images[side, each] for each in FRAMES], True
    if isinstance(options.corrector.component, FusionCorrector):
        fill = options.corrector.component.use_other_views
    by_own = options_of_camera(False, options.seed, row, fill)
    try:
        moment = list(correct_own_frames(images, camera, own, by_own))[frame]
        found, reason = moment.frames.get("left"), moment.reason
    except RsbenchError as error:
        found, reason = None, str(error)
    as_read = Fused.seen(images[frame].copy(), np.ones(images[frame].shape[:2], dtype=np.bool_))
    fused = found or as_read
    note = "corrected by its own camera" if found else f"as read: {reason}"
    return replace(fused, depth=np.full_like(fused.depth, np.nan), explained=explained, note=note)


def uncorrected(images: Images, views: tuple[View, ...] = VIEWS, pairs: Pairs | None = None) -> dict[View, Fused]:
    """The uncorrected frames with their depth if it is known, the result for a global shutter."""
    frames = {view: Fused.seen(images[view], np.ones(images[view].shape[:2], dtype=np.bool_)) for view in views}
    if pairs is None:
        return frames
    depths = {(side, frame): pairs[frame].depth[side] for side, frame in views}
    return {
        view: replace(fused, depth=np.where(depths[view] > 0.0, depths[view], np.float32(np.nan)))
        for view, fused in frames.items()
    }


class _Clock:
    """Measures the seconds of each step."""

    def __init__(self, step: Step) -> None:
        self.seconds: dict[str, float] = {}
        self._step, self._last = step, time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now
        self._step(name)
