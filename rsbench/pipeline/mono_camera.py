"""The estimate of what the card of a camera whose frames are corrected alone does not give."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.capture.calibration import RefusedFramesError
from rsbench.capture.hypotheses import scans_of
from rsbench.capture.self_calibration import (
    CENTRE_SIGMA,
    PRIOR,
    FoundFocal,
    PairFocal,
    conclude_focal,
    focal_of_capture,
    focal_of_pair,
)
from rsbench.capture.sequence_shutter import LONGEST, capture_of_video
from rsbench.capture.shutter_decision import (
    LEAST_BACKWARDS,
    NoMotionError,
    conclude_alone,
    examine_alone,
    fits_backwards,
    known_alone,
    runs_backwards,
    shutter_alone,
)
from rsbench.capture.two_frame_estimate import Capture, Window
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.shutter import RollingShutter, Scan, Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import OneCameraCard, check_alike
from rsbench.pipeline.mono_correction import STILL, flow_matches, refusal, trajectory_matches
from rsbench.solvers.engine.robust_motion import RobustOptions
from rsbench.vision.mono_fusion import find_flows

# The shutter of a video, from its camera's card or estimated from its frames.


WINDOWS = 8
"""Most pairs of frames from which the shutter is estimated; they are evenly spaced in the video."""
IN_ORDER = 5
"""Frames with a given shutter are in reverse order if this many first pairs all fit better in that order. A single
pair may do so by a tremble of the hand: 14 of 50 pairs of ten rendered sequences did, four of these sequences
chosen because one pair did."""
_FEWEST_PAIRS, _MOST_EXAMINED = 6, 60
"""Fewest successive pairs that determine a trajectory; number of pairs that are examined for them."""
TOO_FEW = "frames: fewer than two; the motion of one camera needs at least two"
BACKWARDS = (
    "time runs backwards in them: they are in the reverse order, or lines are read from the side opposite to the "
    "given one (`scan` in the camera's card)"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundShutter:
    """The shutter of a camera, and the estimate that it comes from."""

    shutter: RollingShutter
    capture: Capture | None
    """None if the card gives the shutter."""
    focal: FoundFocal | None = None
    """The focal length, if it was estimated with the shutter."""

    @property
    def scan(self) -> Scan:
        """The side at which the readout begins."""
        return self.shutter.scan_of("left")


def find_shutter(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    options: RobustOptions,
    seed: int = 0,
    advance: Callable[[str], None] = lambda word: None,
    starts: FloatArray | None = None,
) -> FoundShutter:
    """The shutter of a camera, from its card or its frames (H, W[, 3]); refuses frames in reverse order.

    Args:
        frames: frames in order; they are iterated once.
        count: approximate number of the frames; 0: unknown.
        card: given values.
        options, seed: settings of the search for a motion.
        advance: called after each pair that is examined.
        starts: (n,) times of the frames' first rows, frame periods; None: one period apart.

    Raises:
        NoMotionError: the frames do not determine the shutter.
        RefusedFramesError: the frames are in reverse order.
        RsbenchError: there are fewer than two frames, or frames of two sizes.
    """
    if card.readout_ratio is None:
        return _estimate_shutter(frames, count, card, options, seed, advance, starts)
    scan, ratio = card.scan or "top", card.readout_ratio
    found, shutter = list[FloatArray](), None
    for matches, _, camera in matched_pairs(frames, card, 1, IN_ORDER if ratio >= LEAST_BACKWARDS else 0, seed):
        shutter = shutter or Scanning(scan=scan).shutter_of(camera.width, camera.height, ratio)
        if matches is None:
            continue
        advance("order of the frames")
        if not fits_backwards(matches, camera, shutter, options, seed):
            return FoundShutter(shutter=shutter, capture=None)
        found.append(matches)
    assert shutter is not None
    if found:
        windows = [examine_alone(matches, camera, known_alone(scan), options, seed) for matches in found]
        _refuse_backwards(conclude_alone(windows), shutter)
    return FoundShutter(shutter=shutter, capture=None)


def _refuse_backwards(capture: Capture, shutter: RollingShutter) -> None:
    if runs_backwards(capture, scans_of(replace(shutter, readout_ratio=1.0))):
        raise RefusedFramesError(BACKWARDS)


def _estimate_shutter(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    options: RobustOptions,
    seed: int,
    advance: Callable[[str], None],
    starts: FloatArray | None,
) -> FoundShutter:
    """Estimate the shutter from a trajectory through successive pairs, or else from single pairs."""
    first, run, camera = _successive_matches(frames, card, seed, advance)
    focal_sigma, on_trajectory = PRIOR if card.focal_unknown else 0.0, None
    centre_sigma = CENTRE_SIGMA if card.camera is None else 0.0
    if len(run) >= _FEWEST_PAIRS:
        times = None if starts is None else starts[first : first + len(run) + 1] - starts[first]
        on_trajectory = capture_of_video(run, camera, card.scan, seed, focal_sigma, times, centre_sigma)
    if on_trajectory is not None:
        focal = focal_of_capture(on_trajectory, camera.width) if card.focal_unknown else None
        return replace(_conclude(on_trajectory, camera, card), focal=focal)
    known, windows, camera, why = known_alone(card.scan, focal_sigma), list[Window](), None, ""
    for matches, reason, camera in matched_pairs(frames, card, max((count - 1) // WINDOWS, 1), WINDOWS, seed):
        why = why or reason
        if matches is not None:
            windows.append(examine_alone(matches, camera, known, options, seed))
            advance(f"pair {len(windows)}")
    assert camera is not None
    if not windows and why == STILL:
        raise NoMotionError(why)
    if not windows:
        raise NoMotionError(f"cannot tell the readout ratio: {why}. Give readout_ratio in the camera's card")
    return _conclude(conclude_alone(windows), camera, card)


def _conclude(capture: Capture, camera: PinholeCamera, card: OneCameraCard) -> FoundShutter:
    if card.scan is not None:
        _refuse_backwards(capture, Scanning(scan=card.scan).shutter_of(camera.width, camera.height, 1.0))
    return FoundShutter(shutter=shutter_alone(capture, camera), capture=capture)


def _successive_matches(
    frames: Iterable[NDArray[Any]], card: OneCameraCard, seed: int, advance: Callable[[str], None]
) -> tuple[int, list[FloatArray], PinholeCamera]:
    """Number of the first frame and ``trajectory_matches`` of the first usable successive pairs, and the camera.

    At most ``LONGEST`` pairs are used.

    Raises RsbenchError as ``matched_pairs`` does.
    """
    run, first, camera = list[FloatArray](), 0, None
    for number, (before, image) in enumerate(itertools.pairwise(frames), start=1):
        check_alike({f"frame {number - 1}": before, f"frame {number}": image})
        camera = card.camera_of(image.shape[1], image.shape[0])
        flows = find_flows([before, image])
        if not refusal([before, image], flows):
            run.append(trajectory_matches(flows, seed))
            advance(f"pair {number}")
        elif len(run) >= _FEWEST_PAIRS:
            break
        else:
            run.clear()
            first = number
        if len(run) == LONGEST or number >= _MOST_EXAMINED:
            break
    if camera is None:
        raise RsbenchError(TOO_FEW)
    return first, run, camera


def matched_pairs(
    frames: Iterable[NDArray[Any]], card: OneCameraCard, every: int, most: int, seed: int
) -> Iterator[tuple[FloatArray | None, str, PinholeCamera]]:
    """For every ``every``-th pair: its matches or the reason why it has none, and the camera.

    It stops after ``most`` pairs with matches. Raises RsbenchError for fewer than two frames or unequal frames.
    """
    number, found = 0, 0
    for number, (before, image) in enumerate(itertools.pairwise(frames), start=1):
        check_alike({f"frame {number - 1}": before, f"frame {number}": image})
        camera = card.camera_of(image.shape[1], image.shape[0])
        if (number - 1) % every == 0 and found < most:
            flows = find_flows([before, image])
            reason = refusal([before, image], flows)
            found += not reason
            yield None if reason else flow_matches(flows, np.random.default_rng(seed)), reason, camera
        elif number == 1:
            yield None, "", camera
        if found >= most:
            return
    if number == 0:
        raise RsbenchError(TOO_FEW)


# The camera of a video: from its card, with a focal length estimated from its frames, or with the default.


PAIRS = 5
"""Most pairs of frames from which the focal length is estimated; they are evenly spaced in the video."""


def find_camera_alone(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int = 0,
    advance: Callable[[str], None] = lambda word: None,
    found: FoundFocal | None = None,
) -> tuple[PinholeCamera, FoundFocal | None]:
    """The camera, and the estimate of its focal length from the frames; None if the card gives it.

    Args:
        frames, count, card, options, seed, advance: see ``find_shutter``.
        shutter: shutter of the camera.
        found: the focal length if it was estimated with the shutter.

    Raises:
        RsbenchError: there are fewer than two frames, or frames of two sizes.
    """
    camera, pairs = None, list[PairFocal | None]()
    wanted = PAIRS if card.focal_unknown and found is None else 0
    for matches, _, camera in matched_pairs(frames, card, max((count - 1) // PAIRS, 1), wanted, seed):
        if matches is not None:
            pairs.append(focal_of_pair(matches, (camera.width, camera.height), shutter, options, seed))
            advance(f"pair {len(pairs)}")
    assert camera is not None
    if not card.focal_unknown:
        return camera, None
    found = found or conclude_focal(pairs, camera.width)
    return PinholeCamera.centred(camera.width, camera.height, found.focal), found
