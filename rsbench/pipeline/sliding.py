"""A sliding window of two frames over a sequence: every frame is corrected with the motion to the next one."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.errors import RsbenchError
from rsbench.pipeline.chain import correct_frames, find_depth
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.footage import FrameSource, check_alike
from rsbench.pipeline.frame_depth import Images, Pairs, frame_pair
from rsbench.pipeline.frame_motion import FoundMotion, NoMotionError, find_readout, match_frames, solve_frames
from rsbench.pipeline.readout import ReadoutEstimate
from rsbench.vision.fusion import Fused

_READOUT_WINDOWS = 5
"""Windows from which an unknown readout ratio is estimated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """What was found for two consecutive frames; ``found`` is None and ``reason`` says why when no motion was."""

    images: Images
    pairs: Pairs | None
    """With depth from the other camera; None when the corrector needs none."""
    found: FoundMotion | None
    reason: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedMoment:
    """Both images of one time of a sequence."""

    number: int
    images: dict[Side, NDArray[Any]]
    """As they were read."""
    frames: dict[Side, Fused]
    """Corrected; empty when a motion was needed and not found."""
    found: FoundMotion | None
    reason: str


def estimate_sequence_readout(
    left: FrameSource, right: FrameSource, rig: StereoRig, options: CorrectionOptions
) -> ReadoutEstimate:
    """Readout ratio of a sequence: the weighted mean of its first windows.

    Raises:
        RsbenchError: as ``rsbench.pipeline.frame_motion.match_frames``.
        NoMotionError: no window determines it.
    """
    estimates = []
    for first, second in itertools.islice(itertools.pairwise(_both(left, right)), _READOUT_WINDOWS):
        images = {(side, frame): pair[side] for frame, pair in enumerate((first, second)) for side in SIDES}
        matches = match_frames(images, options)
        estimate = find_readout(matches, rig, options)
        if estimate is not None and np.isfinite(estimate.sigma):
            estimates.append(estimate)
    if not estimates:
        raise NoMotionError("no window of the sequence determines the readout ratio")
    weights = np.array([1.0 / max(estimate.sigma, 1e-6) ** 2 for estimate in estimates])
    ratios = np.array([estimate.readout_ratio for estimate in estimates])
    return ReadoutEstimate(
        readout_ratio=float(np.sum(weights * ratios) / np.sum(weights)),
        sigma=float(np.sum(weights) ** -0.5),
        matches=sum(estimate.matches for estimate in estimates),
    )


def correct_sequence(
    left: FrameSource, right: FrameSource, rig: StereoRig, readout_ratio: float, options: CorrectionOptions
) -> Iterator[CorrectedMoment]:
    """Every frame of a sequence corrected, in order; the last one with the motion from the one before.

    A frame from which no motion leads to the next uses the motion that led to it; without either it is given
    back uncorrected.

    Raises:
        RsbenchError: frames that differ in size, cannot be read, or run backwards in time.
    """
    shutter = RollingShutter(height=rig.camera.height, readout_ratio=readout_ratio)
    last: Window | None = None
    number = -1
    for number, window in enumerate(_windows(left, right, rig, readout_ratio, options)):
        yield _moment(number, 0, [window] if last is None else [window, last], rig, shutter, options)
        last = window
    if last is not None:
        yield _moment(number + 1, 1, [last], rig, shutter, options)


def _windows(
    left: FrameSource, right: FrameSource, rig: StereoRig, readout_ratio: float, options: CorrectionOptions
) -> Iterator[Window]:
    needs = options.corrector.component.spec.needs
    times = (
        (images, frame_pair(images["left"], images["right"], rig, options) if "depth" in needs else None)
        for images in _both(left, right)
    )
    for (first, pair_0), (second, pair_1) in itertools.pairwise(times):
        images = {(side, frame): both[side] for frame, both in enumerate((first, second)) for side in SIDES}
        pairs = (pair_0, pair_1) if pair_0 is not None and pair_1 is not None else None
        found, reason = None, ""
        if "motion" in needs:
            try:
                found, _, _ = solve_frames(match_frames(images, options), rig, readout_ratio, options)
            except NoMotionError as error:
                reason = str(error)
        yield Window(images=images, pairs=pairs, found=found, reason=reason)


def _moment(
    number: int,
    frame: int,
    windows: list[Window],
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> CorrectedMoment:
    """Frame 0 or 1 of the first window; as frame 1 of the second one when only that knows a motion."""
    here = windows[0]
    images = {side: here.images[side, frame] for side in SIDES}
    places = list(zip(windows, (frame, 1), strict=False))
    if "motion" in options.corrector.component.spec.needs:
        places = [(window, place) for window, place in places if window.found is not None]
    if not places:
        return CorrectedMoment(number=number, images=images, frames={}, found=None, reason=here.reason)
    window, place = places[0]
    motion = None if window.found is None else window.found.motion
    pairs = window.pairs
    if pairs is not None:
        pairs = find_depth(window.images, rig, shutter, motion, options, pairs)
    views = tuple((side, place) for side in SIDES)
    fused = correct_frames(window.images, pairs, rig, shutter, motion, options, views)
    frames = {side: fused[side, place] for side in SIDES}
    return CorrectedMoment(number=number, images=images, frames=frames, found=window.found, reason="")


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
