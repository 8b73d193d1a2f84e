"""A sliding window of two frames over a sequence: every frame is corrected with the motion to the next one."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.errors import RsbenchError
from rsbench.pipeline.chain import (
    CorrectionOptions,
    FramePair,
    NoMotionError,
    complete_depth,
    correct_frames,
    frame_pair,
    match_frames,
    motion_of,
    solve_frames,
)
from rsbench.pipeline.footage import FrameSource, check_alike
from rsbench.pipeline.readout import ReadoutEstimate, estimate_readout_ratio
from rsbench.pipeline.robust_motion import RobustEstimate
from rsbench.vision.fusion import Fused

_READOUT_WINDOWS = 5
"""Windows from which an unknown readout ratio is estimated."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Window:
    """What was found for two consecutive frames; ``robust`` is None and ``reason`` says why when no motion was."""

    pairs: tuple[FramePair, FramePair]
    robust: RobustEstimate | None
    reason: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedMoment:
    """Both images of one time of a sequence."""

    number: int
    images: dict[Side, NDArray[Any]]
    """As they were read."""
    frames: dict[Side, Fused]
    """Corrected; empty when no motion was found."""
    robust: RobustEstimate | None
    reason: str


def estimate_sequence_readout(
    left: FrameSource, right: FrameSource, rig: StereoRig, options: CorrectionOptions
) -> ReadoutEstimate:
    """Readout ratio of a sequence: the weighted mean of its first windows.

    Raises:
        RsbenchError: as ``rsbench.pipeline.chain.match_frames``.
        NoMotionError: no window determines it.
    """
    estimates = []
    for first, second in itertools.islice(itertools.pairwise(_both(left, right)), _READOUT_WINDOWS):
        images = {(side, frame): pair[side] for frame, pair in enumerate((first, second)) for side in SIDES}
        matches = match_frames(images, options)
        estimate = estimate_readout_ratio(matches, rig, options.solver, options.robust, options.seed)
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
        yield _moment(number, window, last, rig, shutter, options)
        last = window
    if last is not None:
        yield _moment(number + 1, None, last, rig, shutter, options)


def _windows(
    left: FrameSource, right: FrameSource, rig: StereoRig, readout_ratio: float, options: CorrectionOptions
) -> Iterator[Window]:
    pairs = (frame_pair(images["left"], images["right"], rig, options) for images in _both(left, right))
    for first, second in itertools.pairwise(pairs):
        robust, reason = None, ""
        images = {(side, frame): pair.images[side] for frame, pair in enumerate((first, second)) for side in SIDES}
        try:
            robust, _, _ = solve_frames(match_frames(images, options), rig, readout_ratio, options)
        except NoMotionError as error:
            reason = str(error)
        yield Window(pairs=(first, second), robust=robust, reason=reason)


def _moment(
    number: int,
    window: Window | None,
    last: Window | None,
    rig: StereoRig,
    shutter: RollingShutter,
    options: CorrectionOptions,
) -> CorrectedMoment:
    """The first frame of ``window``, or the second of ``last`` when only that knows a motion."""
    use, frame = (window, 0) if window is not None and window.robust is not None else (last, 1)
    pair = window.pairs[0] if window is not None else last.pairs[1]  # type: ignore[union-attr]
    if use is None or use.robust is None:
        reason = window.reason if window is not None else (last.reason if last is not None else "")
        return CorrectedMoment(number=number, images=pair.images, frames={}, robust=None, reason=reason)
    motion: Motion = motion_of(use.robust, options)
    views = tuple((side, frame) for side in SIDES)
    pairs = complete_depth(use.pairs, rig, shutter, motion) if options.depth_from_motion else use.pairs
    fused = correct_frames(pairs, rig, shutter, motion, options, views)
    frames = {side: fused[side, frame] for side in SIDES}
    return CorrectedMoment(number=number, images=pair.images, frames=frames, robust=use.robust, reason="")


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
