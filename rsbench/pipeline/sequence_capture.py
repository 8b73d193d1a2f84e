"""How the frames of a sequence were taken, by a rig or by one camera: given, or estimated from some of them.

``know_capture`` ends in one ``KnownCapture``; with that, a correction needs nothing but the frames and options.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from numpy.typing import NDArray

from rsbench.capture.calibration import NO_ERRORS, CardSigma, RefusedFramesError, check_rig
from rsbench.capture.hypotheses import GLOBAL, Known, KnownInputs
from rsbench.capture.rig_calibration import FoundRig
from rsbench.capture.self_calibration import FoundCamera, find_camera
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
from rsbench.pipeline.footage import FrameSource, Progress, RigCard, check_alike, no_progress
from rsbench.pipeline.frame_capture import (
    KnownCapture,
    find_rig,
    match_frames,
    match_given,
    models_asked,
    rig_of_matches,
    with_enough,
)
from rsbench.pipeline.frame_depth import CorrectionOptions, Images
from rsbench.pipeline.frame_motion import FoundMotion
from rsbench.pipeline.mono_camera import IN_ORDER, PAIRS, OneCameraCard, find_camera_alone, find_shutter
from rsbench.pipeline.mono_correction import FoundOwnMotion
from rsbench.pipeline.mono_gyro import PAIRS as CLOCK_PAIRS
from rsbench.pipeline.mono_gyro import in_time, pair_rates
from rsbench.vision.fusion import Fused


@dataclass(frozen=True, kw_only=True, eq=False)
class Gyroscope:
    """A gyroscope's log beside frames."""

    samples: FloatArray
    """(n, 4) tau, w, as of ``Correspondences.gyro``; tau 0 is the first row of the first frame."""
    clock_error: float = 0.0
    """Frame periods by which its clock may be off; 0: the times are exact."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedMoment:
    """The images of one time of a sequence."""

    number: int
    images: dict[Side, NDArray[Any]]
    """As they were read."""
    frames: dict[Side, Fused]
    """Corrected; empty when a motion was needed and not found, or the corrector found no correction."""
    found: FoundMotion | FoundOwnMotion | None
    """The motion that they were corrected with."""
    reason: str
    """With frames, why they were corrected with the motion between two other times than usual; without, why there
    are none. Empty for the last time of a rig, whose motion comes from the one before."""
    pose: Pose | None = None
    """Body from world at the start of the frame, where a trajectory was found; the world is the first body."""
    line_poses: Pose | None = None
    """(lines, 3, 3), (lines, 3) likewise, at the time of each line of the left camera, in order of time."""

    @property
    def shown(self) -> dict[Side, Fused]:
        """The corrected frames; without them the images as they were read, with the reason."""
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
    """Estimates from the frames of a rig or of one camera what their card leaves open.

    Args:
        sources: frames of the left and the right camera, or of one; read once for each quantity that is estimated.

    Raises:
        NoMotionError: the frames do not show how their lines are read.
        RefusedFramesError: the frames contradict the card.
        RsbenchError: too few frames, frames of two sizes, or cameras that cannot be of such images.
    """
    if isinstance(card, OneCameraCard):
        return _know_camera(sources[0], card, options, gyro, progress)
    left, right = sources
    rig, inputs, shown = card.rig_of(next(iter(left)), next(iter(right))), card.inputs, spread_windows(left, right)
    rig, note = with_found_camera(rig, card.sigma, shown, options, inputs, progress)
    turned = with_found_rig(rig, left, right, options, inputs)
    rig = rig if turned is None else turned.rig
    if not rig.aligned:  # found as errors of the rig
        inputs = replace(inputs, calibration=inputs.calibration or NO_ERRORS)
    capture, shutter, errors = None, None, inputs.calibration
    if inputs.readout_ratio is None or errors is None:
        with progress("looking at the shutter", min(max(left.count - 1, 1), WINDOWS)) as advance:
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
    """The frames of one camera without copies, and the times of their first rows, frame periods; None: even."""
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
    if starts is not None:  # the longest run of even intervals, which most of this assumes
        run = source.timeline.even_run()
        frames, starts = source.only(source.timeline.originals[run]), starts[run]
    robust, seed, pairs = options.robust, options.seed, max(frames.count - 1, 1)
    unknown = card.readout_ratio is None
    with progress("looking at the shutter", min(pairs, LONGEST if unknown else IN_ORDER) + unknown) as advance:
        found = find_shutter(frames, frames.count, card, robust, seed, advance)
        if unknown:
            advance("all pairs together")
    shutter = found.shutter
    wanted, words = card.focal_unknown and found.focal is None, "looking at the focal length"
    with progress(words, min(pairs, PAIRS)) if wanted else no_progress("", 0) as advance:
        camera, focal = find_camera_alone(frames, frames.count, card, shutter, robust, seed, advance, found.focal)
    samples, clock = None if gyro is None else gyro.samples, None
    if gyro is not None and gyro.clock_error > 0.0:
        with progress("looking at the gyroscope's clock", min(pairs, CLOCK_PAIRS)) as advance:
            rates = pair_rates(frames, frames.count, camera, shutter, robust, seed, advance, starts)
        samples, clock = in_time(rates, gyro.samples, camera, shutter, gyro.clock_error)
    return KnownCapture(
        rig=StereoRig.of_one(camera),
        shutter=shutter,
        capture=found.capture,
        focal=focal,
        gyro=samples,
        clock=clock,
    )


# Windows of a sequence of a rig, and what is refused of them.


JUDGED = 3
"""First windows whose rig is looked at; when all of them are refused, so is the sequence."""


class Refusals:
    """Windows that were refused; when these are all that were seen first, or all, so is the sequence."""

    def __init__(self, source: FrameSource) -> None:
        self._source, self._count = source, 0
        self._last: RefusedFramesError | None = None

    def add(self, number: int, error: RefusedFramesError) -> None:
        """Window ``number`` was refused."""
        self._count, self._last = self._count + 1, error
        if number + 1 == JUDGED:
            self.end(JUDGED)

    def end(self, windows: int) -> None:
        """There are no more than ``windows``."""
        if self._last is not None and self._count == windows:
            raise RefusedFramesError(self._last.reason, f"{self._source.path}, frames 0 to {windows}")


def window_images(left: FrameSource, right: FrameSource) -> Iterator[Images]:
    for pair in itertools.pairwise(_both(left, right)):
        yield {(side, frame): both[side] for frame, both in enumerate(pair) for side in SIDES}


def _both(left: FrameSource, right: FrameSource) -> Iterator[dict[Side, NDArray[Any]]]:
    """Left and right image of every time, all of one kind, those of a camera of one size."""
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


# How the cameras of a sequence read, from some of its windows.


WINDOWS = 8
"""At most, of those by which the shutter is found."""
FEWEST_FRAMES = 4
"""Of a sequence through which a trajectory is fitted: fewer do not show what two frames shake alike."""


def estimate_sequence_capture(
    left: FrameSource,
    right: FrameSource,
    rig: StereoRig,
    options: CorrectionOptions,
    inputs: KnownInputs | None = None,
    advance: Callable[[str], None] = lambda word: None,
) -> tuple[Capture | None, RollingShutter]:
    """How the cameras of a sequence read, from windows that lie evenly over it: their shutter does not change.

    With a known ratio the calibration alone is looked for; no capture where the first window shows no errors. Of a
    shutter that is found to be global it is found as if that had been known.

    Args:
        inputs: what is given, see ``know_matches``.
        advance: called for each window.

    Raises:
        RefusedFramesError: the first windows contradict the given rig.
        NoMotionError: the windows do not determine the shutter.
    """
    inputs = inputs or KnownInputs()
    if inputs.readout_ratio is not None:
        inputs = replace(inputs, scanning=inputs.reading)

    def under_global() -> Capture | None:
        still = replace(inputs, readout_ratio=0.0, scanning=Scanning())
        return estimate_sequence_capture(left, right, rig, options, still, advance)[0]

    look, refusals = _Look(rig, options, inputs, under_global), Refusals(left)
    doubts = list[RefusedFramesError | None]()
    every, number = max((left.count - 1) // WINDOWS, 1), -1
    for number, images in enumerate(window_images(left, right)):
        look.judge(number)
        chosen = not look.shaken and number % every == 0 and len(look.used) < WINDOWS
        if not (chosen or number < look.successive):
            continue
        matching = with_enough(options, ENOUGH) if look.shaken else options
        try:
            matches, doubt = match_given(images, rig, matching, inputs, judge_rig=number < JUDGED)
            doubts.append(doubt)
        except RefusedFramesError as error:
            refusals.add(number, error)
            matches, chosen = Correspondences(), False
        look.add(number, matches, chosen)
        if look.is_right:
            break
        if chosen:
            advance(f"window {number}")
    refusals.end(number + 1)
    capture = None if look.is_right else look.concluded()
    if capture is None or inputs.readout_ratio is not None:
        return capture, inputs.shutter_of(rig)
    shutter, doubt = shutter_found(capture, rig), next(filter(None, doubts), None)
    if doubt is not None and rig.rows_together(shutter.scanning):
        raise doubt
    return capture, shutter


class _Look:
    """What windows so far show of a shutter."""

    def __init__(
        self,
        rig: StereoRig,
        options: CorrectionOptions,
        inputs: KnownInputs,
        under_global: Callable[[], Capture | None],
    ) -> None:
        self._rig, self._options, self._under_global = rig, options, under_global
        self._inputs = replace(inputs, models=models_asked(options.motion_model))
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
        return (
            self._inputs.readout_ratio is not None
            and self._known is not None
            and not any(self._known.calibration_sigma)
        )

    def judge(self, number: int) -> None:
        """Whether the rig shakes, once there are enough windows before ``number``: no motion model helps then."""
        if number + 1 == FEWEST_FRAMES and self._examined and self._inputs.readout_ratio is None:
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
        if not self._examined or number + 1 >= FEWEST_FRAMES:  # those between wait for ``judge``: they take long
            self._examine_waiting()

    def _examine_waiting(self) -> None:
        options = self._options
        for matches in self._waiting:
            known = self._known = self._known or known_of(matches, self._rig, self._inputs)
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
        if self._inputs.readout_ratio is None:
            capture = as_global(capture, self.used, self._rig, self._known, self._under_global)
        if self._inputs.readout_ratio is not None or len(self._first) + 1 < FEWEST_FRAMES:
            return capture
        if self.shaken or shakes(capture, self._first, self._rig, self._options.seed):
            given = None if self._inputs.scanning is None else (self._inputs.scanning,)
            return capture_of_sequence(capture, self._first, self._rig, given, self._options.seed)
        return capture


def _narrowed(known: Known, capture: Capture) -> Known:
    """Without scans that the windows so far exclude."""
    if not capture.candidates or capture.candidates[0].probability < CERTAIN:
        return known
    left = {candidate.scans for candidate in capture.candidates} | {GLOBAL}
    return replace(known, scans=tuple(each for each in known.scans if each in left))


# The focal length and k1 of a rig whose card says how sure it is of them, from some of its frames.


_WINDOWS = 8
"""At most, of a sequence."""


def spread_windows(left: FrameSource, right: FrameSource) -> Iterable[Images]:
    """Some windows of a sequence, evenly spread."""
    every = max((left.count - 1) // _WINDOWS, 1)
    return islice(window_images(left, right), every // 2, None, every)


def camera_of_frames(
    windows: Iterable[Images], rig: StereoRig, sigma: CardSigma, options: CorrectionOptions, inputs: KnownInputs
) -> FoundCamera:
    """``find_camera`` from the matches of a few windows; those without matches say nothing."""
    matches = list[Correspondences]()
    for images in islice(windows, _WINDOWS):
        with suppress(RefusedFramesError):  # the correction says so of each
            matches.append(match_given(images, rig, options, inputs, judge_rig=False)[0])
    if not matches:
        return FoundCamera(rig=rig, sigma=sigma, determined=(False, False))
    shutter = KnownInputs(readout_ratio=inputs.readout_ratio, scanning=inputs.scanning)
    return find_camera(matches, rig, sigma, shutter, options.robust, options.seed)


def with_found_camera(
    rig: StereoRig,
    sigma: CardSigma,
    windows: Iterable[Images],
    options: CorrectionOptions,
    inputs: KnownInputs,
    progress: Progress = no_progress,
) -> tuple[StereoRig, str]:
    """The rig with the focal length and k1 that are estimated where ``sigma`` is not 0, and words on both."""
    if not sigma:
        return rig, ""
    with progress("looking at the calibration", 1) as advance:
        found = camera_of_frames(windows, rig, sigma, options, inputs)
        advance("")
    return found.rig, found.words(rig, sigma)


def with_found_rig(
    rig: StereoRig, left: FrameSource, right: FrameSource, options: CorrectionOptions, inputs: KnownInputs
) -> FoundRig | None:
    """The rig as the first frames show it; None where their rows agree with its calibration, or do not tell."""
    images = next(iter(window_images(left, right)), None)
    if images is None or not rig.rows_together(inputs.reading, inputs.readout_ratio):
        return None
    inputs = replace(inputs, calibration=None)
    try:
        if rig.aligned:
            check_rig(images["left", 0], images["right", 0], rig)
            return None
        return rig_of_matches(match_frames(images, rig, options, inputs.scanning), rig, inputs, options)
    except RefusedFramesError as refusal:
        try:
            return find_rig(images, rig, inputs, options, refusal)[0]
        except (RefusedFramesError, NoMotionError):
            return None  # the correction says so of each window
