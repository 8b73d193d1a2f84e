"""A sliding window of two frames over a sequence: every frame is corrected with the motion to the next one."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from rsbench.capture.calibration_errors import NO_ERRORS, OFFSET
from rsbench.capture.estimate import CERTAIN, Capture, conclude, examine
from rsbench.capture.estimate import Window as Examined
from rsbench.capture.hypotheses import Known
from rsbench.capture.rectification import RefusedFramesError
from rsbench.capture.scans import GLOBAL
from rsbench.capture.settle import AUTO, NoMotionError, as_global, known_of, shutter_found
from rsbench.capture.trajectory_check import SUCCESSIVE, shakes
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose, compose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.pipeline.chain import Given, check_cameras, correct_known, find_depth
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.footage import FrameSource, check_alike
from rsbench.pipeline.frame_depth import Images, frame_pair
from rsbench.pipeline.frame_matches import match_frames, match_unknown
from rsbench.pipeline.frame_motion import FoundMotion, models_asked, solve_frames
from rsbench.pipeline.sequence_trajectory import Window, on_one_trajectory
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import needs_motion

WINDOWS = 8
"""At most, of those by which the shutter is found."""
SHAKEN = (
    "cannot tell the readout ratio: the rig shakes, and its frames follow none of the motion models under which "
    "it shows. Give readout_ratio in the rig's card, or find it in frames in which the rig turns evenly"
)
_FEWEST_FRAMES = 4
"""Of a sequence through which a trajectory is fitted: fewer do not show what two frames shake alike."""
_JUDGED = 3
"""First windows whose rig is looked at; when all of them are refused, so is the sequence."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedMoment:
    """Both images of one time of a sequence."""

    number: int
    images: dict[Side, NDArray[Any]]
    """As they were read."""
    frames: dict[Side, Fused]
    """Corrected; empty when a motion was needed and not found, or the corrector found no correction."""
    found: FoundMotion | None
    reason: str
    """Why no motion leads from here to the next frame, or why there is no correction; empty when neither is so, or
    when this is the last frame."""
    pose: Pose | None = None
    """Body from world at the start of the frame, where a trajectory was found; the world is the first body."""


def estimate_sequence_capture(
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    options: CorrectionOptions,
    readout_ratio: float | None = None,
    scanning: Scanning | None = None,
    calibration: tuple[float, ...] | None = None,
    advance: Callable[[str], None] = lambda word: None,
) -> tuple[Capture | None, RollingShutter]:
    """How the cameras of a sequence read, from windows that lie evenly over it: their shutter does not change.

    With a known ratio the calibration alone is looked for; no capture where the first window shows no errors.

    Args:
        readout_ratio, scanning, calibration: see ``solve_frames``.
        advance: called for each window.

    Raises:
        RefusedFramesError: the first windows cannot be what they are said to be.
        NoMotionError: the windows do not determine the shutter.
    """
    models = models_asked(options.motion_model)
    scanning = scanning if readout_ratio is None else scanning or Scanning()
    examined, used, known, first = list[Examined](), list[Correspondences](), None, list[Correspondences]()
    speaks_against = list[RefusedFramesError]()
    for number, matches, doubt in _some_matches(left, right, rig, options, scanning):
        if number < SUCCESSIVE:
            first.append(matches)
        if doubt is not None:
            speaks_against.append(doubt)
        if number % _every(left) or len(examined) == WINDOWS:
            continue
        known = known or known_of(matches, rig, readout_ratio, scanning, calibration, models)
        if readout_ratio is not None and not any(known.calibration_sigma):
            break
        examined.append(examine(matches, rig, known, options.robust, options.seed))
        used.append(matches)
        advance(f"window {number}")
        known = _narrowed(known, conclude(examined))
    if readout_ratio is not None:
        shutter = (scanning or Scanning()).shutter_of(rig.camera.width, rig.camera.height, readout_ratio)
        return (conclude(examined) if examined else None), shutter
    if known is None:
        raise NoMotionError("no window of the sequence can be judged: put readout_ratio into the rig's card")
    capture = as_global(conclude(examined), used, rig, known)
    shutter = shutter_found(capture, rig)
    if len(first) + 1 >= _FEWEST_FRAMES and shakes(capture, first, rig, options.seed):
        raise NoMotionError(SHAKEN)
    if speaks_against and shutter.rows_together:
        raise speaks_against[-1]
    return capture, shutter


def _every(left: FrameSource) -> int:
    """Windows from one that is looked at to the next."""
    return max((left.count - 1) // WINDOWS, 1)


def _some_matches(
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    options: CorrectionOptions,
    scanning: Scanning | None,
) -> Iterator[tuple[int, Correspondences, RefusedFramesError | None]]:
    """Number and matches of the first windows and of some over the whole, and what speaks against a pair.

    Raises:
        RefusedFramesError: the first windows, or all, are refused.
    """
    refusals, number = _Refusals(left), -1
    for number, images in enumerate(_window_images(left, right)):
        if number % _every(left) and number >= SUCCESSIVE:
            continue
        try:
            doubt = None
            if scanning is None:
                matches, doubt = match_unknown(images, rig, options, judge_rig=number < _JUDGED)
            else:
                matches = match_frames(images, rig, options, scanning, judge_rig=number < _JUDGED)
        except RefusedFramesError as error:
            refusals.add(number, error)
            continue
        yield number, matches, doubt
    refusals.end(number + 1)


def _narrowed(known: Known, capture: Capture) -> Known:
    """Without scans that the windows so far exclude."""
    if not capture.candidates or capture.candidates[0].probability < CERTAIN:
        return known
    left = {candidate.scans for candidate in capture.candidates} | {GLOBAL}
    return replace(known, scans=tuple(each for each in known.scans if each in left))


def correct_sequence(
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    readout_ratio: float,
    options: CorrectionOptions,
    calibration: tuple[float, ...] = NO_ERRORS,
    scanning: Scanning | None = None,
) -> Iterator[CorrectedMoment]:
    """Every frame of a sequence corrected, in order; the last one with the motion from the one before.

    A frame from which no motion leads to the next uses the motion that led to it; without either it is given
    back uncorrected. Both say why.

    Args:
        calibration: what the calibration is wrong by, see ``calibration_errors.TERMS``.
        scanning: how the cameras read their lines; None: rows from the top, both at once.

    Raises:
        RefusedFramesError: the first three windows, or all, cannot be what they are said to be.
        RsbenchError: frames that differ in size, or cannot be read; cameras that the options do not take.
    """
    scanning = scanning or Scanning()
    check_cameras(rig, scanning, options, calibration[OFFSET])
    shutter = scanning.shutter_of(rig.camera.width, rig.camera.height, readout_ratio)
    last: Window | None = None
    number = -1
    windows = _windows(left, right, rig, shutter, options, calibration)
    if _has_trajectory(left, shutter, options):
        alone = _windows(left, right, rig, shutter, replace(options, motion_model=None), calibration)
        windows = on_one_trajectory(alone, rig, shutter, options, calibration)
    for number, window in enumerate(windows):
        yield _moment(number, 0, [window] if last is None else [window, last], rig, shutter, options)
        last = window
    if last is not None:
        yield _moment(number + 1, 1, [last], rig, shutter, options)


def _has_trajectory(left: FrameSource, shutter: RollingShutter, options: CorrectionOptions) -> bool:
    """Whether one trajectory is fitted to all windows: of four frames and more whose motion model is open."""
    asked = options.motion_model == AUTO and "motion" in options.corrector.component.spec.needs
    return asked and shutter.readout_ratio > 0.0 and not 0 < left.count < _FEWEST_FRAMES


class _Refusals:
    """Windows that were refused; when these are all that were seen first, or all, so is the sequence."""

    def __init__(self, source: FrameSource) -> None:
        self._source, self._count = source, 0
        self._last: RefusedFramesError | None = None

    def add(self, number: int, error: RefusedFramesError) -> None:
        """Window ``number`` was refused."""
        self._count, self._last = self._count + 1, error
        if number + 1 == _JUDGED:
            self.end(_JUDGED)

    def end(self, windows: int) -> None:
        """There are no more than ``windows``."""
        if self._last is not None and self._count == windows:
            raise RefusedFramesError(self._last.reason, f"{self._source.path}, frames 0 to {windows}")


def _window_images(left: FrameSource, right: FrameSource) -> Iterator[Images]:
    for pair in itertools.pairwise(_both(left, right)):
        yield {(side, frame): both[side] for frame, both in enumerate(pair) for side in SIDES}


def _windows(
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
    calibration: tuple[float, ...],
) -> Iterator[Window]:
    needs, refusals, second = options.corrector.component.spec.needs, _Refusals(left), None
    offset = calibration[OFFSET]
    number = -1
    for number, images in enumerate(_window_images(left, right)):
        pairs = None
        if "depth" in needs and shutter.rows_together and not needs_motion(options.matcher):
            first = second or frame_pair(images["left", 0], images["right", 0], rig, options, offset)
            second = frame_pair(images["left", 1], images["right", 1], rig, options, offset)
            pairs = first, second
        found, reason, matches = None, "", None
        if needs & {"motion", "matches"}:
            try:
                judged, scanning = number < _JUDGED, shutter.scanning
                matches = match_frames(images, rig, options, scanning, judge_rig=judged)
                if "motion" in needs:
                    ratio = shutter.readout_ratio
                    found = solve_frames(matches, rig, ratio, options, calibration, scanning, in_order=True).found
            except NoMotionError as error:
                reason = str(error)
            except RefusedFramesError as error:
                refusals.add(number, error)
                reason = error.reason
        yield Window(images=images, pairs=pairs, found=found, reason=reason, matches=matches)
    refusals.end(number + 1)


def _moment(
    number: int,
    frame: int,
    windows: list[Window],
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> CorrectedMoment:
    """Frame 0 or 1 of the first window; as frame 1 of the second one when only that knows a motion."""
    here, needs = windows[0], options.corrector.component.spec.needs
    images = {side: here.images[side, frame] for side in SIDES}
    places = list(zip(windows, (frame, 1), strict=False))
    if "motion" in needs:
        places = [(window, place) for window, place in places if window.found is not None]
    elif "matches" in needs:
        places = [(window, place) for window, place in places if window.matches is not None]
    if not places:
        return CorrectedMoment(number=number, images=images, frames={}, found=None, reason=here.reason)
    window, place = places[0]
    motion = None if window.found is None else window.found.motion
    pairs = window.pairs
    if "depth" in needs:
        pairs = find_depth(window.images, rig, shutter, motion, options, pairs)
    views = tuple((side, place) for side in SIDES)
    offset = 0.0 if window.found is None else window.found.disparity_offset
    known = Given(matches=window.matches, motion=motion, pairs=pairs)
    fused = correct_known(window.images, known, rig, shutter, options, views, offset)
    for (side, _), each in fused.items():
        if not each.success:
            why = f"{side}: {each.reason}"
            return CorrectedMoment(number=number, images=images, frames={}, found=window.found, reason=why)
    frames = {side: fused[side, place] for side in SIDES}
    return CorrectedMoment(
        number=number,
        images=images,
        frames=frames,
        found=window.found,
        reason=here.reason if frame == 0 else "",
        pose=_pose_at(here, frame),
    )


def _pose_at(window: Window, frame: int) -> Pose | None:
    """Of the body at the start of a frame of a window."""
    if window.pose is None or window.found is None or frame == 0:
        return window.pose
    return compose(window.found.motion.body_from_world(float(frame)), window.pose)


def _both(left: FrameSource, right: FrameSource) -> Iterator[dict[Side, NDArray[Any]]]:
    """Left and right image of every time, all alike."""
    first: NDArray[Any] | None = None
    number = -1
    for number, (a, b) in enumerate(itertools.zip_longest(left, right)):
        if a is None or b is None:
            shorter, longer = (left, right) if a is None else (right, left)
            raise RsbenchError(f"{shorter.path}: has {number} frames, fewer than {longer.path}")
        first = a if first is None else first
        check_alike({f"{left.path}, frame 0": first, f"{left.path}, frame {number}": a})
        check_alike({f"{left.path}, frame {number}": a, f"{right.path}, frame {number}": b})
        yield {"left": a, "right": b}
    if number < 1:
        raise RsbenchError(f"{left.path}: has {number + 1} frames; at least 2 are needed")
