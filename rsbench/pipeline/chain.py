"""The whole chain on four frames of a rolling-shutter rig: match, motion, depth, corrected frames.

Images in, arrays out; files are the business of others. What a caller knows already is given (``Given``) and not
looked for: one chain serves users, tables, and studies with their oracles.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration import NO_ERRORS, OFFSET, of_offset
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.rig_calibration import FoundRig
from rsbench.capture.two_frame_estimate import Capture
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import FRAMES, SIDES, VIEWS, StereoRig, View
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.frame_capture import KnownCapture, know_four
from rsbench.pipeline.frame_depth import (
    CorrectionOptions,
    Images,
    Pairs,
    complete_depth,
    frame_pairs,
    moving_pairs,
    timed_pairs,
)
from rsbench.pipeline.frame_motion import FoundMotion, solve_frames
from rsbench.vision.corrector import CorrectionProblem, find_corrected_rows
from rsbench.vision.fusion import Fused, Origin, inpaint
from rsbench.vision.stereo_matcher import needs_motion, refuse_motion

Step = Callable[[str], None]
STEPS = ("matching", "motion", "depth", "correction")


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What need not be found; None is found when the corrector needs it."""

    matches: Correspondences | None = None
    """Taken as they are, without a look at whether the frames are in order."""
    motion: Motion | None = None
    """Of the body, metres, of any model; the readout ratio must be known then."""
    pairs: Pairs | None = None
    """Frames with their depth; ``depth_from_motion`` still fills what is unknown in it."""
    gyro: FloatArray | None = None
    """(n, 4) samples of a gyroscope, as in ``Correspondences``: the one thing that frames do not show."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedFrames:
    """The result for four frames; None is what neither was given nor needed. A frame may have failed by value."""

    motion: Motion | None
    """Of the body, with which the frames were corrected."""
    found: FoundMotion | None
    """Where it comes from; None when it was given."""
    shutter: RollingShutter
    capture: Capture | None
    """How the shutter was found; None when it was given."""
    matches: Correspondences | None
    pairs: Pairs | None
    """The frames with the depth that they were corrected with."""
    rig: StereoRig
    """The cameras, with estimated values where ``rsbench.correct`` estimated some."""
    rig_found: FoundRig | None
    """What the frames showed of the rig's calibration; None where their rows agree with it."""
    frames: dict[View, Fused]
    at_rows: list[dict[View, Fused]]
    """At each of the further requested rows."""
    seconds: dict[str, float]
    """Of each of ``STEPS``."""


def correct_four(
    images: Images,
    rig: StereoRig,
    readout_ratio: float | None,
    options: CorrectionOptions,
    step: Step = lambda word: None,
    given: Given | None = None,
    views: tuple[View, ...] = VIEWS,
    disparity_offset: float | None = None,
    scanning: Scanning | None = None,
    rows: Sequence[float] = (),
) -> CorrectedFrames:
    """Correct four frames (H, W[, 3]), uint8 or uint16, of a rig over one frame period.

    Args:
        images: by side and frame.
        rig: its cameras have the images' size.
        readout_ratio: None has it found from the matches.
        options: components and what happens between them.
        step: called with the name of each of the 4 steps done.
        given: what is known already.
        views: the frames that are wanted.
        disparity_offset: px by which disparities are too large, of a calibration that is right otherwise; None has
            its errors found where the row differences of the matches show some.
        scanning: how the cameras read their lines; None: found with the readout ratio, or where that is given,
            rows from the top, both at once.
        rows: further target rows, at whose times the frames are wanted too.

    Raises:
        RsbenchError: frames that cannot be what the arguments state, cameras that the options do not take (see
            ``check_cameras``), or a component of another package failed.
        NoMotionError: the matches determine no motion or readout ratio.
        ValueError: a motion is given and no readout ratio.
    """
    given = given or Given()
    check_cameras(rig, scanning or Scanning(), options, disparity_offset, given.pairs is not None)
    if given.motion is not None and readout_ratio is None:
        raise ValueError("readout_ratio must be known where the motion is given: the matches would give another")
    clock, needs = _Clock(step), options.corrector.component.spec.needs
    calibration = None if disparity_offset is None else of_offset(disparity_offset)
    inputs = KnownInputs(readout_ratio=readout_ratio, scanning=scanning, calibration=calibration)
    wanted, matches = given.motion is None and "motion" in needs, given.matches
    if readout_ratio is not None and not wanted and (matches is not None or "matches" not in needs):
        known = KnownCapture(rig=rig, shutter=inputs.shutter_of(rig), calibration=calibration or NO_ERRORS)
        clock("matching")
    else:
        matches, known = know_four(images, rig, inputs, options, matches, clock)
    found = solve_frames(matches, known, options) if wanted and matches is not None else None
    clock("motion")
    rig, shutter, offset = known.rig, known.shutter, known.calibration[OFFSET]
    if known.capture is not None:
        check_cameras(rig, shutter.scanning, options, disparity_offset, given.pairs is not None)
    motion = given.motion if found is None else found.motion
    pairs = (
        find_depth(images, rig, shutter, motion, options, given.pairs, offset) if "depth" in needs else given.pairs
    )
    clock("depth")
    given = replace(given, matches=matches, motion=motion, pairs=pairs)
    frames, *at_rows = correct_known_rows(
        images, given, rig, shutter, options, views, offset, (options.target_row, *rows)
    )
    clock("correction")
    return CorrectedFrames(
        motion=motion,
        found=found,
        shutter=shutter,
        capture=known.capture,
        matches=matches,
        pairs=pairs,
        rig=rig,
        rig_found=known.rig_found,
        frames=frames,
        at_rows=at_rows,
        seconds=clock.seconds,
    )


def check_cameras(
    rig: StereoRig,
    scanning: Scanning,
    options: CorrectionOptions,
    disparity_offset: float | None,
    depth_is_known: bool = False,
) -> None:
    """Whether these cameras can be corrected with these options.

    Raises:
        RsbenchError: depth is requested without motion where the two images of a pair have different times; or an
            offset is given for cameras with a lens or another scan, or for a matcher that needs the motion.
    """
    needs = options.corrector.component.spec.needs
    if not depth_is_known and "depth" in needs:
        _check_matcher(options, disparity_offset)
    if not (depth_is_known or rig.rows_together(scanning)) and "depth" in needs and "motion" not in needs:
        raise RsbenchError(
            f"scan = {scanning.scan!r}, right_scan = {scanning.right_scan!r}, "
            f"right_delay = {scanning.right_delay}: depth is found with the motion between the times of both "
            f"cameras, for which corrector {options.corrector.name!r} does not ask"
        )
    lens = rig.camera.lens
    what = f"camera.lens = {lens.model!r}" if lens is not None else f"scan = {scanning.scan!r}"
    what = what if rig.aligned else "cameras that differ or look in different directions"
    if disparity_offset and not (rig.rectified and scanning.plain):
        raise RsbenchError(
            f"disparity_offset = {disparity_offset}: must be 0 with {what}; calibrate the rig again"
        )


def _check_matcher(options: CorrectionOptions, disparity_offset: float | None) -> None:
    """Raises RsbenchError where the matcher needs a motion and there is none, or only one of a doubtful rig."""
    if not needs_motion(options.matcher):
        return
    if "motion" not in options.corrector.component.spec.needs:
        refuse_motion(options.matcher, f"corrector {options.corrector.name!r} does not ask for one")
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
    """The frames with their depth: by the matcher unless ``pairs`` has it, then from the motion, of ``frames``."""
    asks = needs_motion(options.matcher)
    if pairs is None and (asks or not rig.rows_together(shutter.scanning, shutter.readout_ratio)):
        if motion is None:
            where = f"matcher {options.matcher.name!r} finds depth" if asks else "cameras read rows apart"
            raise ValueError(f"the motion must be known where {where}")
        pairs = moving_pairs(images, rig, shutter, motion, options)
    elif pairs is None:
        pairs = frame_pairs(images, rig, options, disparity_offset)
    if not all(pair.timed for pair in pairs):
        if motion is None:
            raise ValueError("the motion must be known where depth is found through a lens")
        pairs = timed_pairs(pairs, rig, shutter, motion)
    if options.depth_from_motion and motion is not None and not all(pair.with_motion for pair in pairs):
        pairs = complete_depth(pairs, rig, shutter, motion, frames)
    return pairs


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
    """``correct_known_rows`` of one row and of correctors that need no more than a motion and a depth."""
    given = Given(motion=motion, pairs=pairs)
    return correct_known_rows(images, given, rig, shutter, options, views, disparity_offset)[0]


def correct_known_rows(
    images: Images,
    known: Given,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    views: tuple[View, ...],
    disparity_offset: float,
    rows: Sequence[float] | None = None,
) -> list[dict[View, Fused]]:
    """Corrected frames of the requested views at the times of target rows, through the same lens.

    A global shutter leaves nothing to correct: at a readout ratio of 0 the frames come back as they are.

    Args:
        rows: by default that of the options.

    Raises:
        RsbenchError: the corrector needs a gyroscope's samples and there are none, or another package's corrector
            failed, see ``find_corrected``.
    """
    rows = (options.target_row,) if rows is None else rows
    pairs, needs = known.pairs, options.corrector.component.spec.needs
    if shutter.still and not (options.one_time and shutter.right_delay and known.motion is not None):
        return [uncorrected(images, views, pairs) for _ in rows]
    if "gyro" in needs and known.gyro is None:
        raise RsbenchError(
            f"corrector {options.corrector.name!r}: needs the samples of a gyroscope, which frames do not show: "
            "give them as gyro in Python, or evaluate a dataset that has the channel imu"
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
    return [
        {view: inpainted(fused, options) for view, fused in corrected.items()}
        for corrected in find_corrected_rows(options.corrector, problem, views, rows)
    ]


def inpainted(fused: Fused, options: CorrectionOptions) -> Fused:
    """A frame without holes, if the options ask for that."""
    if not (options.inpaint and fused.success):
        return fused
    return replace(fused, image=inpaint(fused.image, fused.origin == Origin.NOBODY))


def uncorrected(images: Images, views: tuple[View, ...] = VIEWS, pairs: Pairs | None = None) -> dict[View, Fused]:
    """The frames as they are, with the depth that is known of them: what a user has after a failure."""
    frames = {view: Fused.seen(images[view], np.ones(images[view].shape[:2], dtype=np.bool_)) for view in views}
    if pairs is None:
        return frames
    depths = {(side, frame): pairs[frame].depth[side] for side, frame in views}
    return {
        view: replace(fused, depth=np.where(depths[view] > 0.0, depths[view], np.float32(np.nan)))
        for view, fused in frames.items()
    }


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
