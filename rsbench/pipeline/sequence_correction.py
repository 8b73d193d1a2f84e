"""A sliding window of two frames over a sequence: every frame is corrected with the motion to the next one."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.calibration_errors import NO_ERRORS, OFFSET
from rsbench.capture.estimate import CERTAIN, Capture, conclude, examine
from rsbench.capture.estimate import Window as Examined
from rsbench.capture.hypotheses import Known
from rsbench.capture.rectification import RefusedFramesError
from rsbench.capture.scans import GLOBAL
from rsbench.capture.settle import AUTO, NoMotionError, as_global, known_of, shutter_found
from rsbench.capture.trajectory_check import SUCCESSIVE, shakes
from rsbench.capture.trajectory_shutter import LONGEST, capture_of_sequence
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
from rsbench.vision.frame_threads import ahead, map_ahead
from rsbench.vision.fusion import Fused
from rsbench.vision.stereo_matcher import needs_motion

WINDOWS = 8
"""At most, of those by which the shutter is found."""
_FEWEST_FRAMES = 4
"""Of a sequence through which a trajectory is fitted: fewer do not show what two frames shake alike."""
_AHEAD = 4
"""Windows that are matched, and frames that are corrected, ahead: as many as leave a trajectory together."""
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
    line_poses: Pose | None = None
    """(lines, 3, 3), (lines, 3) likewise, at the time of each line of the left camera, in order of time."""


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
    scanning = scanning if readout_ratio is None else scanning or Scanning()
    look, refusals = _Look(rig, options, readout_ratio, scanning, calibration), _Refusals(left)
    doubts = list[RefusedFramesError | None]()
    every, number = max((left.count - 1) // WINDOWS, 1), -1
    for number, images in enumerate(_window_images(left, right)):
        look.judge(number)
        chosen = not look.shaken and number % every == 0 and len(look.used) < WINDOWS
        if not (chosen or number < look.successive):
            continue
        try:
            if scanning is None:
                matches, doubt = match_unknown(images, rig, options, judge_rig=number < _JUDGED)
                doubts.append(doubt)
            else:
                matches = match_frames(images, rig, options, scanning, judge_rig=number < _JUDGED)
        except RefusedFramesError as error:
            refusals.add(number, error)
            matches, chosen = Correspondences(), False
        look.add(number, matches, chosen)
        if look.is_right:
            break
        if chosen:
            advance(f"window {number}")
    refusals.end(number + 1)
    if readout_ratio is not None:
        shutter = (scanning or Scanning()).shutter_of(rig.camera.width, rig.camera.height, readout_ratio)
        return (None if look.is_right else look.concluded()), shutter
    capture = look.concluded()
    shutter, doubt = shutter_found(capture, rig), next(filter(None, doubts), None)
    if doubt is not None and shutter.rows_together:
        raise doubt
    return capture, shutter


class _Look:
    """What windows so far say of a shutter."""

    def __init__(
        self,
        rig: StereoRig,
        options: CorrectionOptions,
        readout_ratio: float | None,
        scanning: Scanning | None,
        calibration: tuple[float, ...] | None,
    ) -> None:
        self._rig, self._options, self._ratio = rig, options, readout_ratio
        self._scanning, self._calibration = scanning, calibration
        self._examined, self.used, self._first = list[Examined](), list[Correspondences](), list[Correspondences]()
        self._known: Known | None = None
        self._waiting = list[Correspondences]()
        self.shaken = False

    @property
    def successive(self) -> int:
        """How many of the first windows are looked at, whichever others are."""
        return LONGEST if self.shaken else SUCCESSIVE

    @property
    def is_right(self) -> bool:
        """Whether there is nothing to look for: the ratio is known, and the calibration shows no errors."""
        return self._ratio is not None and self._known is not None and not any(self._known.calibration_sigma)

    def judge(self, number: int) -> None:
        """Whether the rig shakes, once there are enough windows before ``number``: no motion model helps then."""
        if number + 1 == _FEWEST_FRAMES and self._examined and self._ratio is None:
            self.shaken = shakes(conclude(self._examined), self._first, self._rig, self._options.seed)
            if not self.shaken:
                self._examine_waiting()

    def add(self, number: int, matches: Correspondences, chosen: bool) -> None:
        """A window; ``chosen``: to be judged under the motion models."""
        if number < self.successive:
            self._first.append(matches)
        if not chosen:
            return
        self._waiting.append(matches)
        if not self._examined or number + 1 >= _FEWEST_FRAMES:  # those between wait for ``judge``: they take long
            self._examine_waiting()

    def _examine_waiting(self) -> None:
        options, models = self._options, models_asked(self._options.motion_model)
        for matches in self._waiting:
            asked = (self._ratio, self._scanning, self._calibration)
            known = self._known = self._known or known_of(matches, self._rig, *asked, models)
            if self.is_right:
                return
            self._examined.append(examine(matches, self._rig, known, options.robust, options.seed))
            self.used.append(matches)
            self._known = _narrowed(known, conclude(self._examined))
        self._waiting.clear()

    def concluded(self) -> Capture:
        """What all say: under the motion models, or, of a rig that shakes, along one trajectory."""
        if not self.shaken:
            self._examine_waiting()
        if self._known is None:
            raise NoMotionError("no window of the sequence can be judged: put readout_ratio into the rig's card")
        capture = conclude(self._examined)
        if self._ratio is None:
            capture = as_global(capture, self.used, self._rig, self._known)
        if self._ratio is not None or len(self._first) + 1 < _FEWEST_FRAMES:
            return capture
        if self.shaken or shakes(capture, self._first, self._rig, self._options.seed):
            return capture_of_sequence(capture, self._first, self._rig, self._scanning, self._options.seed)
        return capture


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
    along = _has_trajectory(left, shutter, options)
    windows = ahead(_windows(left, right, rig, shutter, options, calibration, not along), _AHEAD)
    if along:
        windows = on_one_trajectory(windows, rig, shutter, options, calibration)
    places = _places(_with_depth(windows, rig, shutter, options, calibration[OFFSET]))
    # Nothing is known of whether another package's may run twice at a time.
    threads = 2 if options.corrector.built_in and options.matcher.built_in else 1
    yield from map_ahead(lambda each: _moment(*each, rig, shutter, options), places, _AHEAD, threads)


def _places(windows: Iterable[Window]) -> Iterator[tuple[int, int, list[Window]]]:
    """Number of each frame, its number in the first of the windows that show it, and these."""
    last, number = None, 0
    for number, window in enumerate(windows):
        yield number, 0, [window] if last is None else [window, last]
        last = window
    if last is not None:
        yield number + 1, 1, [last]


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
    with_motion: bool,
) -> Iterator[Window]:
    """The windows of a sequence, each for itself; ``with_motion``: with a motion where the corrector needs one."""
    needs, refusals = options.corrector.component.spec.needs, _Refusals(left)
    number = -1
    for number, images in enumerate(_window_images(left, right)):
        found, reason, matches = None, "", None
        if needs & {"motion", "matches"}:
            try:
                judged, scanning = number < _JUDGED, shutter.scanning
                matches = match_frames(images, rig, options, scanning, judge_rig=judged)
                if "motion" in needs and with_motion:
                    ratio = shutter.readout_ratio
                    found = solve_frames(matches, rig, ratio, options, calibration, scanning, in_order=True).found
            except NoMotionError as error:
                reason = str(error)
            except RefusedFramesError as error:
                refusals.add(number, error)
                reason = error.reason
        yield Window(images=images, pairs=None, found=found, reason=reason, matches=matches)
    refusals.end(number + 1)


def _with_depth(
    windows: Iterable[Window], rig: StereoRig, shutter: RollingShutter, options: CorrectionOptions, offset: float
) -> Iterator[Window]:
    """The windows with depth from the other camera, that of each frame found once."""
    apart = not shutter.rows_together or needs_motion(options.matcher)
    if apart or "depth" not in options.corrector.component.spec.needs:
        yield from windows
        return
    second = None
    for window in windows:
        images = window.images
        first = second or frame_pair(images["left", 0], images["right", 0], rig, options, offset)
        second = frame_pair(images["left", 1], images["right", 1], rig, options, offset)
        yield replace(window, pairs=(first, second))


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
        line_poses=_line_poses(here, frame, shutter),
    )


def _pose_at(window: Window, frame: int) -> Pose | None:
    """Of the body at the start of a frame of a window."""
    if window.pose is None or window.found is None or frame == 0:
        return window.pose
    return compose(window.found.motion.body_from_world(float(frame)), window.pose)


def _line_poses(window: Window, frame: int, shutter: RollingShutter) -> Pose | None:
    """Of the body at the times of the left camera's lines, in order of time."""
    if window.pose is None or window.found is None:
        return None
    return compose(window.found.motion.body_from_world(np.sort(shutter.line_times(frame, "left"))), window.pose)


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
