"""Correct a sequence: the motion of each window (two successive frames) comes from one trajectory through all.

Two frames cannot reveal a shake that is the same in both; a sequence can, because its windows overlap. A window is
finished when some later ones have been matched, so memory does not grow with the length of the footage.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsbench.capture.calibration import OFFSET, RefusedFramesError, recalibrated
from rsbench.capture.model_choice import AUTO
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.capture.trajectory_estimate import StreamedWindow, stream_trajectory
from rsbench.capture.trajectory_spline import ContinuousMotion
from rsbench.capture.trajectory_tracks import ENOUGH
from rsbench.core.correspondences import Correspondences
from rsbench.core.rig import FRAMES, SIDES
from rsbench.core.se3 import Pose, compose
from rsbench.core.shutter import RollingShutter
from rsbench.pipeline.chain import Given, check_cameras, correct_known_rows, find_depth
from rsbench.pipeline.footage import FrameSource
from rsbench.pipeline.frame_capture import KnownCapture, match_frames, with_enough
from rsbench.pipeline.frame_depth import CorrectionOptions, Images, Pairs, frame_pair
from rsbench.pipeline.frame_motion import FoundMotion, solve_frames
from rsbench.pipeline.mono_sequence import correct_frames
from rsbench.pipeline.sequence_capture import (
    FEWEST_FRAMES,
    JUDGED,
    CorrectedMoment,
    Refusals,
    frames_with_times,
    window_images,
)
from rsbench.solvers.engine.base import MotionEstimate
from rsbench.solvers.engine.robust_motion import MatchCount, RobustEstimate
from rsbench.solvers.refined import NO_DEPTHS
from rsbench.vision.images import ahead, map_ahead
from rsbench.vision.stereo_matcher import needs_motion

BRIDGED = "few of the matches agree with the motion"
TURNED = "; their rotation is that of the gyroscope, without a translation"
_LONGEST_BRIDGE = 2
"""Largest distance, in windows, to one with matches at which the spline is used: if eight windows have none and a
hand rotates by 1.5 deg per frame, the middle one is wrong by 1 deg; for four windows it is 0.16 deg."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """Two successive frames of a rig, with what was estimated from them."""

    images: Images
    pairs: Pairs | None
    """Stereo depth; None if the corrector needs none, or if depth is estimated after the motion."""
    found: FoundMotion | None
    """None: there is no motion, and ``reason`` says why."""
    reason: str = ""
    matches: Correspondences | None = None
    """None if the corrector needs none, or the frames were refused."""
    pose: Pose | None = None
    """body_from_world at the start of the first frame, from the trajectory; the world is the first body."""


def on_one_trajectory(windows: Iterable[Window], known: KnownCapture, seed: int, solver: str) -> Iterator[Window]:
    """Replace the motion of each window by that of one trajectory; windows without matches are interpolated.

    Args:
        windows: the windows in order.
        known: rig, shutter and gyroscope. With a gyroscope any number of windows is bridged: far from windows with
            matches it gives the rotation alone, and the translation is unknown.
        seed: seed of the search for motions of single windows.
        solver: name that is recorded for the motions.
    """
    waiting, rig = deque[Window](), known.rig

    def matches() -> Iterator[Correspondences]:
        for window in windows:
            waiting.append(window)
            yield recalibrated(window.matches or Correspondences(), rig, known.calibration)

    for streamed in stream_trajectory(matches(), rig, known.shutter, seed, gyro=known.gyro):
        window = waiting.popleft()
        found = _found(streamed, solver)
        reason = "" if streamed.supported else window.reason or BRIDGED
        pose = streamed.body_from_world
        if streamed.apart > _LONGEST_BRIDGE:
            by_gyro = streamed.gyro is not None and streamed.gyro.used
            found, pose = _rotation_only(found) if by_gyro else None, None
            reason += TURNED if by_gyro else ""
        yield replace(window, found=found, reason=reason, pose=pose)


def _found(streamed: StreamedWindow, solver: str) -> FoundMotion:
    """The motion of a window of the trajectory in the form that a solver's answer has."""
    motion, right = streamed.motion, int(np.count_nonzero(streamed.inliers))
    estimate = MotionEstimate(
        w=motion.w,
        d=motion.d,
        success=True,
        reason=BRIDGED if not streamed.supported else "" if streamed.depths else NO_DEPTHS,
        metric=True,
        noise_px=streamed.noise_px,
        covariance=streamed.covariance,
    )
    robust = RobustEstimate(
        estimate=estimate,
        inliers={"tracks": streamed.inliers},
        counts={"tracks": MatchCount(inliers=right, matches=len(streamed.inliers))},
        iterations=0,
        seconds=0.0,
        threshold_px=0.0,
    )
    return FoundMotion(
        motion=motion,
        robust=robust,
        solver=solver,
        reference_point="body",
        gyro=streamed.gyro,
    )


def _rotation_only(found: FoundMotion) -> FoundMotion:
    """The same motion with its rotation alone."""
    assert isinstance(found.motion, ContinuousMotion)
    curve = found.motion.curve
    motion = ContinuousMotion.of(curve._replace(p=np.zeros_like(curve.p)))
    estimate = replace(found.robust.estimate, d=motion.d, covariance=None)
    return replace(found, motion=motion, robust=replace(found.robust, estimate=estimate))


# A sliding window of two frames over a sequence: every frame is corrected with the motion to the next one.


_AHEAD = 4
"""Number of windows that are matched, and of frames that are corrected, in advance."""
_DEPTHS_AHEAD = 2
"""Number of windows that get a motion and stereo depth in advance."""


def correct_sequence(
    sources: Sequence[FrameSource], known: KnownCapture, options: CorrectionOptions, first: int = 0
) -> Iterator[CorrectedMoment]:
    """Correct the frames of a sequence of a rig or of one camera, in order.

    A rig's frames are corrected with the motion to the next frame time, the last ones, and those without such a
    motion, with the motion from the previous time. For one camera see ``correct_frames``; copies are left out.

    Args:
        sources: frames of the left and the right camera, or of one camera.
        known: rig, shutter and, for a sequence with ``takes_gyro``, a gyroscope.
        first: number of the first frame that is returned.

    Raises:
        RefusedFramesError: the first three windows, or all, contradict the given rig.
        RsbenchError: frames differ in size or cannot be read, or the options do not support the cameras.
    """
    rig, shutter = known.rig, known.shutter
    if not rig.metric:
        frames, starts = frames_with_times(sources[0])
        numbers = sources[0].timeline.originals
        done = int(np.count_nonzero(numbers < first))
        for moment in correct_frames(frames, rig.camera, shutter, options, done, known.gyro, starts):
            yield replace(moment, number=int(numbers[moment.number]))
        return
    left, right = sources
    check_cameras(rig, shutter.scanning, options, known.calibration[OFFSET])
    on_trajectory = takes_gyro(left, options) and not shutter.still
    windows = ahead(_windows(left, right, known, options, not on_trajectory), _AHEAD)
    if on_trajectory:
        windows = on_one_trajectory(windows, known, options.seed, options.solver.name)
    deep = ahead(_with_depth(windows, known, options, first), _DEPTHS_AHEAD)
    places = (each for each in _frames_of(deep) if each[0] >= first)
    # A component of another package may not be thread-safe.
    threads = 2 if options.corrector.built_in and options.matcher.built_in else 1
    yield from map_ahead(lambda each: _corrected_moment(*each, known, options), places, _AHEAD, threads)


def _frames_of(windows: Iterable[Window]) -> Iterator[tuple[int, int, list[Window]]]:
    """For each frame its number, its index 0 or 1 in the first of its windows, and the windows that contain it."""
    last, number = None, 0
    for number, window in enumerate(windows):
        yield number, 0, [window] if last is None else [window, last]
        last = window
    if last is not None:
        yield number + 1, 1, [last]


def takes_gyro(left: FrameSource, options: CorrectionOptions) -> bool:
    """Whether a rolling-shutter sequence gets a trajectory: it has four frames and no fixed motion model."""
    chosen = options.motion_model == AUTO and "motion" in options.corrector.component.spec.needs
    return chosen and not 0 < left.count < FEWEST_FRAMES


def _windows(
    left: FrameSource, right: FrameSource, known: KnownCapture, options: CorrectionOptions, with_motion: bool
) -> Iterator[Window]:
    """The windows of a sequence, matched and, with ``with_motion``, solved independently of each other."""
    needs, refusals = options.corrector.component.spec.needs, Refusals(left)
    matching = options if with_motion or "matches" in needs else with_enough(options, ENOUGH)
    number = -1
    for number, images in enumerate(window_images(left, right)):
        found, reason, matches = None, "", None
        if needs & {"motion", "matches"}:
            try:
                judged = number < JUDGED
                matches = match_frames(images, known.rig, matching, known.shutter.scanning, judge_rig=judged)
                if "motion" in needs and with_motion:
                    found = solve_frames(replace(known, matches=matches), options, in_order=True)
            except NoMotionError as error:
                reason = str(error)
            except RefusedFramesError as error:
                refusals.add(number, error)
                reason = error.reason
        yield Window(images=images, pairs=None, found=found, reason=reason, matches=matches)
    refusals.end(number + 1)


def _with_depth(
    windows: Iterator[Window], known: KnownCapture, options: CorrectionOptions, first: int
) -> Iterator[Window]:
    """The windows with stereo depth, which is computed once for each frame from ``first`` on."""
    rig, shutter, offset = known.rig, known.shutter, known.calibration[OFFSET]
    apart = not rig.rows_together(shutter.scanning, shutter.readout_ratio) or needs_motion(options.matcher)
    if apart or "depth" not in options.corrector.component.spec.needs:
        yield from windows
        return
    later = None
    yield from itertools.islice(windows, max(first - 1, 0))
    for window in windows:
        images = window.images
        earlier = later or frame_pair(images["left", 0], images["right", 0], rig, options, offset)
        later = frame_pair(images["left", 1], images["right", 1], rig, options, offset)
        yield replace(window, pairs=(earlier, later))


def _corrected_moment(
    number: int, frame: int, windows: list[Window], known: KnownCapture, options: CorrectionOptions
) -> CorrectedMoment:
    """Correct frame 0 or 1 of the first window, or, if only the second window has a motion, its frame 1."""
    here, needs, rig, shutter = windows[0], options.corrector.component.spec.needs, known.rig, known.shutter
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
        # With a trajectory, depth of the corrected frame suffices: that of the other frame has little effect.
        frames = FRAMES if window.pose is None else (place,)
        pairs = find_depth(window.images, rig, shutter, motion, options, pairs, frames=frames)
    views = tuple((side, place) for side in SIDES)
    given = Given(matches=window.matches, motion=motion, pairs=pairs)
    (fused,) = correct_known_rows(window.images, given, rig, shutter, options, views, known.calibration[OFFSET])
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
    """body_from_world at the start of a frame of a window; None without a trajectory."""
    if window.pose is None or window.found is None or frame == 0:
        return window.pose
    return compose(window.found.motion.body_from_world(float(frame)), window.pose)


def _line_poses(window: Window, frame: int, shutter: RollingShutter) -> Pose | None:
    """body_from_world at the times of the left camera's lines, sorted by time; None without a trajectory."""
    if window.pose is None or window.found is None:
        return None
    return compose(window.found.motion.body_from_world(np.sort(shutter.line_times(frame, "left"))), window.pose)
