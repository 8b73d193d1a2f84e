"""Estimate the capture of a sequence, of a rig or of one camera, from some of its frames.

``know_capture`` returns a ``KnownCapture``; with it, a correction needs nothing but the frames and options.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from numpy.typing import NDArray

from rsbench.capture.calibration import NO_ERRORS, RefusedFramesError, check_rig
from rsbench.capture.hypotheses import GLOBAL, Known, KnownInputs
from rsbench.capture.model_choice import compared_models
from rsbench.capture.rig_calibration import FoundRig
from rsbench.capture.sequence_shutter import LONGEST, SUCCESSIVE, capture_of_sequence, shakes
from rsbench.capture.shutter_decision import NoMotionError, as_global, known_of, shutter_found
from rsbench.capture.trajectory_tracks import ENOUGH
from rsbench.capture.two_frame_estimate import CERTAIN, Capture, conclude, examine
from rsbench.capture.two_frame_estimate import Window as Examined
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.camera_capture import IN_ORDER, PAIRS, find_focal, find_shutter
from rsbench.pipeline.footage import FrameSource, OneCameraCard, Progress, RigCard, check_alike, no_progress
from rsbench.pipeline.frame_capture import (
    CAMERA_WINDOWS,
    KnownCapture,
    find_rig,
    match_given,
    match_windows,
    refuse_backwards,
    rig_of_matches,
    with_enough,
    with_found_camera,
)
from rsbench.pipeline.frame_depth import CorrectionOptions, Images
from rsbench.pipeline.frame_motion import FoundMotion
from rsbench.pipeline.mono_correction import FoundOwnMotion
from rsbench.pipeline.mono_gyro import PAIRS as CLOCK_PAIRS
from rsbench.pipeline.mono_gyro import pair_rates, with_clock_corrected
from rsbench.vision.fusion import Fused


@dataclass(frozen=True, kw_only=True, eq=False)
class Gyroscope:
    """A gyroscope's log for a sequence."""

    samples: FloatArray
    """(n, 4) tau, w, as in ``Correspondences.gyro``; tau 0 is the first row of the first frame."""
    clock_error: float = 0.0
    """Largest error of its clock, frame periods; 0: the times are exact."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedMoment:
    """The corrected images of one frame time of a sequence."""

    number: int
    images: dict[Side, NDArray[Any]]
    """The images as read."""
    frames: dict[Side, Fused]
    """The corrected images; empty if a motion is needed and not found, or the corrector failed."""
    found: FoundMotion | FoundOwnMotion | None
    """The motion that was used for the correction."""
    reason: str
    """With ``frames``, why the motion of other times than usual was used; without, why there are none. Empty for
    the last time of a rig, which always uses the motion from the previous time."""
    pose: Pose | None = None
    """body_from_world at the start of the frame, if there is a trajectory; the world is the first body."""
    line_poses: Pose | None = None
    """(lines, 3, 3), (lines, 3) body_from_world at the time of each line of the left camera, sorted by time."""

    @property
    def shown(self) -> dict[Side, Fused]:
        """The corrected frames; if there are none, the images as read, with the reason."""
        images = {side: image.copy() for side, image in self.images.items()}
        return self.frames or {
            side: replace(Fused.failed(image, self.reason), image=image) for side, image in images.items()
        }


def know_capture(
    sources: Sequence[FrameSource],
    card: RigCard | OneCameraCard,
    options: CorrectionOptions,
    gyro: Gyroscope | None = None,
    progress: Progress = no_progress,
) -> KnownCapture:
    """Estimate from the frames of a rig or of one camera the values that their card does not give.

    Args:
        sources: frames of the left and the right camera, or of one camera; they are read once per estimate.

    Raises:
        NoMotionError: the frames do not determine the shutter.
        RefusedFramesError: the frames contradict the card.
        RsbenchError: there are too few frames, frames of two sizes, or the card contradicts their size.
    """
    if isinstance(card, OneCameraCard):
        return _know_camera(sources[0], card, options, gyro, progress)
    left, right = sources
    rig, inputs, shown = card.rig_of(next(iter(left)), next(iter(right))), card.inputs, spread_windows(left, right)
    rig, note = with_found_camera(rig, shown, options, inputs, progress)
    with (no_progress if rig.aligned else progress)("checking the calibration", 1) as advance:
        turned = with_found_rig(rig, left, right, options, inputs)
        advance("")
    rig = rig if turned is None else turned.rig
    if not rig.aligned:  # its calibration errors are estimated by ``refine_rig``
        inputs = replace(inputs, calibration=inputs.calibration or NO_ERRORS)
    capture, shutter, errors = None, None, inputs.calibration
    if inputs.readout_ratio is None or errors is None:
        with progress("estimating the shutter", min(max(left.count - 1, 1), WINDOWS)) as advance:
            capture, shutter = estimate_sequence_capture(left, right, rig, options, inputs, advance)
        nothing = capture is None or not rig.rows_together(shutter.scanning)
        errors = NO_ERRORS if nothing else capture.calibration
    return KnownCapture(
        rig=rig,
        shutter=shutter or inputs.shutter_of(rig),
        capture=capture,
        calibration=errors,
        rig_found=turned,
        camera_note=note,
        gyro=None if gyro is None else gyro.samples,
    )


def frames_with_times(source: FrameSource) -> tuple[FrameSource, FloatArray | None]:
    """The frames of one camera without copies, and times (n,) of their first rows, periods; None: even."""
    timeline = source.timeline
    frames = source if len(timeline.starts) == len(timeline.twins) else source.only(timeline.originals)
    return frames, None if timeline.even else timeline.starts


def _know_camera(
    source: FrameSource,
    card: OneCameraCard,
    options: CorrectionOptions,
    gyro: Gyroscope | None,
    progress: Progress,
) -> KnownCapture:
    frames, starts = frames_with_times(source)
    if starts is not None:  # use the longest run of intervals of about one period, as most estimates assume these
        run = source.timeline.even_run()
        frames, starts = source.only(source.timeline.originals[run]), starts[run]
    robust, seed, pairs = options.robust, options.seed, max(frames.count - 1, 1)
    unknown = card.readout_ratio is None
    with progress("estimating the shutter", min(pairs, LONGEST if unknown else IN_ORDER) + unknown) as advance:
        known = find_shutter(frames, frames.count, card, robust, seed, advance, starts)
        if unknown:
            advance("all pairs together")
    if card.focal_unknown and known.focal is None:
        with progress("estimating the focal length", min(pairs, PAIRS)) as advance:
            known = find_focal(frames, frames.count, card, known, robust, seed, advance)
    camera, shutter = known.rig.camera, known.shutter
    samples, clock = None if gyro is None else gyro.samples, None
    if gyro is not None and gyro.clock_error > 0.0:
        with progress("estimating the gyroscope's clock", min(pairs, CLOCK_PAIRS)) as advance:
            rates = pair_rates(frames, frames.count, camera, shutter, robust, seed, advance, starts)
        samples, clock = with_clock_corrected(rates, gyro.samples, camera, shutter, gyro.clock_error)
    return replace(known, gyro=samples, clock=clock)


# Windows of a sequence of a rig, and refusals of windows.


JUDGED = 3
"""Number of first windows that are checked against the rig; if all of them are refused, so is the sequence."""


class Refusals:
    """Counts refused windows; refuses the sequence if the first ``JUDGED`` or all windows are refused."""

    def __init__(self, source: FrameSource) -> None:
        self._source, self._count = source, 0
        self._last: RefusedFramesError | None = None

    def add(self, number: int, error: RefusedFramesError) -> None:
        """Record that window ``number`` was refused."""
        self._count, self._last = self._count + 1, error
        if number + 1 == JUDGED:
            self.end(JUDGED)

    def end(self, windows: int) -> None:
        """Raise RefusedFramesError if all of the first ``windows`` windows were refused."""
        if self._last is not None and self._count == windows:
            raise RefusedFramesError(self._last.reason, f"{self._source.path}, frames 0 to {windows}")


def window_images(left: FrameSource, right: FrameSource) -> Iterator[Images]:
    """The images of each window, i.e. of two successive frame times."""
    for pair in itertools.pairwise(_both(left, right)):
        yield {(side, frame): both[side] for frame, both in enumerate(pair) for side in SIDES}


def _both(left: FrameSource, right: FrameSource) -> Iterator[dict[Side, NDArray[Any]]]:
    """Left and right image of every frame time, all of one type, those of a camera of one size."""
    first: tuple[NDArray[Any], NDArray[Any]] | None = None
    number = -1
    for number, (a, b) in enumerate(itertools.zip_longest(left, right)):
        if a is None or b is None:
            shorter, longer = (left, right) if a is None else (right, left)
            raise RsbenchError(f"{shorter.path}: has {number} frames, fewer than {longer.path}")
        first = first or (a, b)
        for source, begin, image in zip((left, right), first, (a, b), strict=True):
            check_alike({f"{source.path}, frame 0": begin, f"{source.path}, frame {number}": image})
        check_alike({f"{left.path}, frame {number}": a, f"{right.path}, frame {number}": b}, sizes=False)
        yield {"left": a, "right": b}
    if number < 1:
        raise RsbenchError(f"{left.path}: has {number + 1} frames; at least 2 are needed")


# The shutter of a sequence, from some of its windows.


WINDOWS = 8
"""Most windows from which the shutter is estimated under motion models."""
FEWEST_FRAMES = 4
"""Fewest frames for a trajectory: fewer do not reveal a shake that is the same in both frames of a window."""


def estimate_sequence_capture(
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    options: CorrectionOptions,
    inputs: KnownInputs | None = None,
    advance: Callable[[str], None] = lambda word: None,
) -> tuple[Capture | None, RollingShutter]:
    """Estimate the shutter of a sequence, which is constant, from windows that are evenly spaced in it.

    With a given ratio, only the calibration errors are estimated; the capture is None if the first window shows
    none. If the shutter proves to be global, the rest is estimated as for a given global shutter.

    Args:
        inputs: given values, see ``know_matches``.
        advance: called after each window.

    Raises:
        RefusedFramesError: the first windows contradict the given rig, or the frames are in reverse order.
        NoMotionError: the windows do not determine the shutter.
    """
    inputs = inputs or KnownInputs()

    def under_global() -> Capture | None:
        still = replace(inputs, readout_ratio=0.0, scanning=Scanning())
        return estimate_sequence_capture(left, right, rig, options, still, advance)[0]

    estimate, refusals = _ShutterEstimate(rig, options, inputs, under_global), Refusals(left)
    doubts = list[RefusedFramesError | None]()
    every, number = max((left.count - 1) // WINDOWS, 1), -1
    for number, images in enumerate(window_images(left, right)):
        estimate.check_shake(number)
        chosen = not estimate.shaken and number % every == 0 and len(estimate.used) < WINDOWS
        if not (chosen or number < estimate.successive):
            continue
        matching = with_enough(options, ENOUGH) if estimate.shaken else options
        try:
            matches, doubt = match_given(images, rig, matching, inputs, judge_rig=number < JUDGED)
            doubts.append(doubt)
        except RefusedFramesError as error:
            refusals.add(number, error)
            matches, chosen = Correspondences(), False
        estimate.add(number, matches, chosen)
        if estimate.nothing_unknown:
            break
        if chosen:
            advance(f"window {number}")
    refusals.end(number + 1)
    capture = None if estimate.nothing_unknown else estimate.concluded()
    if capture is None or inputs.readout_ratio is not None:
        return capture, inputs.shutter_of(rig)
    refuse_backwards(capture, rig, inputs.scanning)
    shutter, doubt = shutter_found(capture, rig), next(filter(None, doubts), None)
    if doubt is not None and rig.rows_together(shutter.scanning):
        raise doubt
    return capture, shutter


class _ShutterEstimate:
    """The estimate of a shutter from the windows so far."""

    def __init__(
        self,
        rig: StereoRig,
        options: CorrectionOptions,
        inputs: KnownInputs,
        under_global: Callable[[], Capture | None],
    ) -> None:
        self._rig, self._options, self._under_global = rig, options, under_global
        self._inputs = replace(inputs, models=compared_models(options.motion_model))
        self._examined, self.used, self._first = list[Examined](), list[Correspondences](), list[Correspondences]()
        self._known: Known | None = None
        self._waiting = list[Correspondences]()
        self.shaken = False

    @property
    def successive(self) -> int:
        """Number of first windows that are always matched, for a trajectory through them."""
        return LONGEST if self.shaken else SUCCESSIVE

    @property
    def nothing_unknown(self) -> bool:
        """Whether there is nothing to estimate: the ratio is given and the calibration shows no errors."""
        return (
            self._inputs.readout_ratio is not None
            and self._known is not None
            and not any(self._known.calibration_sigma)
        )

    def check_shake(self, number: int) -> None:
        """Decide whether the rig shakes, once there are enough windows: motion models are then not used."""
        if number + 1 == FEWEST_FRAMES and self._examined and self._inputs.readout_ratio is None:
            self.shaken = shakes(conclude(self._examined), self._first, self._rig, self._options.seed)
            if not self.shaken:
                self._examine_waiting()

    def add(self, number: int, matches: Correspondences, chosen: bool) -> None:
        """Add a window; if ``chosen``, motion models are fitted to it."""
        if number < self.successive:
            self._first.append(matches)
        if not chosen:
            return
        self._waiting.append(matches)
        if not self._examined or number + 1 >= FEWEST_FRAMES:  # others wait for ``check_shake``: fits are slow
            self._examine_waiting()

    def _examine_waiting(self) -> None:
        options = self._options
        for matches in self._waiting:
            known = self._known = self._known or known_of(matches, self._rig, self._inputs)
            if self.nothing_unknown:
                return
            self._examined.append(examine(matches, self._rig, known, options.robust, options.seed))
            self.used.append(matches)
            self._known = _narrowed(known, conclude(self._examined))
        self._waiting.clear()

    def concluded(self) -> Capture:
        """The estimate from all windows: by motion models, or by one trajectory if the rig shakes."""
        if not self.shaken:
            self._examine_waiting()
        if self._known is None:
            raise NoMotionError("no window of the sequence has matches: put readout_ratio into the rig's card")
        capture = conclude(self._examined)
        if self._inputs.readout_ratio is None:
            capture = as_global(capture, self.used, self._rig, self._known, self._under_global)
        if self._inputs.readout_ratio is not None or len(self._first) + 1 < FEWEST_FRAMES:
            return capture
        if self.shaken or shakes(capture, self._first, self._rig, self._options.seed):
            given = None if self._inputs.scanning is None else (self._inputs.scanning,)
            return capture_of_sequence(capture, self._first, self._rig, given, self._options.seed)
        return capture


def _narrowed(known: Known, capture: Capture) -> Known:
    """The known values without scans that the windows so far exclude."""
    if not capture.candidates or capture.candidates[0].probability < CERTAIN:
        return known
    left = {candidate.scans for candidate in capture.candidates} | {GLOBAL}
    return replace(known, scans=tuple(each for each in known.scans if each in left))


# Estimates of a rig's calibration from some frames of a sequence.


def spread_windows(left: FrameSource, right: FrameSource) -> Iterable[Images]:
    """Evenly spaced windows of a sequence."""
    every = max((left.count - 1) // CAMERA_WINDOWS, 1)
    return islice(window_images(left, right), every // 2, None, every)


RIG_WINDOWS, RIG_FRAMES = 5, 60
"""Most windows for the errors of a rig's calibration, and the first frames among which they are evenly spaced."""


def with_found_rig(
    rig: StereoRig, left: FrameSource, right: FrameSource, options: CorrectionOptions, inputs: KnownInputs
) -> FoundRig | None:
    """Correct the rig's calibration by some of the first frames; None if these agree with it or are inconclusive.

    One window is not enough: an object that moves in most of it changes the convergence of the cameras, by which
    all depths and speeds are too small or too large.
    """
    together = rig.rows_together(inputs.reading, inputs.readout_ratio)
    if rig.aligned and not together:
        return None
    every = max((min(left.count, RIG_FRAMES) - 1) // RIG_WINDOWS, 1)
    windows = islice(window_images(left, right), 0, every * RIG_WINDOWS, every)
    first, inputs = next(windows), replace(inputs, calibration=None)
    try:
        if rig.aligned:
            check_rig(first["left", 0], first["right", 0], rig)
            return None
        matches = match_windows(itertools.chain([first], windows), rig, inputs, options)
        return rig_of_matches(matches, rig, inputs, options)
    except RefusedFramesError as refusal:
        with suppress(RefusedFramesError, NoMotionError):  # the correction reports refused windows
            shown = itertools.chain([first], windows)
            return find_rig(shown, rig, inputs, options, refusal)[0] if together else None
        return None
