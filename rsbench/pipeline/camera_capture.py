"""Estimate the capture of one camera's frames: shutter and focal length, if its card does not give them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    shutter_found,
)
from rsbench.capture.two_frame_estimate import Capture, Window
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.footage import OneCameraCard, check_alike
from rsbench.pipeline.frame_capture import KnownCapture, refuse_backwards
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


def find_shutter(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    options: RobustOptions,
    seed: int = 0,
    advance: Callable[[str], None] = lambda word: None,
    starts: FloatArray | None = None,
) -> KnownCapture:
    """A camera and its shutter, from its card or its frames (H, W[, 3]); refuses frames in reverse order.

    An unknown focal length is estimated too if one trajectory explains the frames; else see ``find_focal``.

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
    scanning, ratio = Scanning(scan=card.scan or "top"), card.readout_ratio
    found, known = list[FloatArray](), None
    for matches, _, camera in matched_pairs(frames, card, 1, IN_ORDER if ratio >= LEAST_BACKWARDS else 0, seed):
        rig = StereoRig.of_one(camera)
        known = KnownCapture(rig=rig, shutter=rig.shutter_of(scanning, ratio))
        if matches is None:
            continue
        advance("order of the frames")
        if not fits_backwards(matches, camera, known.shutter, options, seed):
            return known
        found.append(matches)
    assert known is not None
    if found:
        windows = [examine_alone(matches, camera, known_alone(scanning.scan), options, seed) for matches in found]
        refuse_backwards(conclude_alone(windows), known.rig, scanning)
    return known


def _estimate_shutter(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    options: RobustOptions,
    seed: int,
    advance: Callable[[str], None],
    starts: FloatArray | None,
) -> KnownCapture:
    """Estimate the shutter from a trajectory through successive pairs, or else from single pairs."""
    first, run, camera = _successive_matches(frames, card, seed, advance)
    focal_sigma, on_trajectory = PRIOR if card.focal_unknown else 0.0, None
    centre_sigma = CENTRE_SIGMA if card.camera is None else 0.0
    if len(run) >= _FEWEST_PAIRS:
        times = None if starts is None else starts[first : first + len(run) + 1] - starts[first]
        on_trajectory = capture_of_video(run, camera, card.scan, seed, focal_sigma, times, centre_sigma)
    if on_trajectory is not None:
        focal = focal_of_capture(on_trajectory, camera.width) if card.focal_unknown else None
        known = _concluded(on_trajectory, camera, card)
        return known if focal is None else _with_focal(known, focal)
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
    return _concluded(conclude_alone(windows), camera, card)


def _concluded(capture: Capture, camera: PinholeCamera, card: OneCameraCard) -> KnownCapture:
    rig = StereoRig.of_one(camera)
    refuse_backwards(capture, rig, None if card.scan is None else Scanning(scan=card.scan))
    return KnownCapture(rig=rig, shutter=shutter_found(capture, rig), capture=capture)


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


# The focal length of a video, if its camera's card does not give it.


PAIRS = 5
"""Most pairs of frames from which the focal length is estimated; they are evenly spaced in the video."""


def find_focal(
    frames: Iterable[NDArray[Any]],
    count: int,
    card: OneCameraCard,
    known: KnownCapture,
    options: RobustOptions,
    seed: int = 0,
    advance: Callable[[str], None] = lambda word: None,
) -> KnownCapture:
    """Estimate the focal length from the frames with a known shutter; the width is used if they do not show it.

    Args:
        known: result of ``find_shutter``; all others: see there.
    """
    pairs, camera, every = list[PairFocal | None](), known.rig.camera, max((count - 1) // PAIRS, 1)
    for matches, *_ in matched_pairs(frames, card, every, PAIRS, seed):
        if matches is not None:
            pairs.append(focal_of_pair(matches, (camera.width, camera.height), known.shutter, options, seed))
            advance(f"pair {len(pairs)}")
    return _with_focal(known, conclude_focal(pairs, camera.width))


def _with_focal(known: KnownCapture, focal: FoundFocal) -> KnownCapture:
    camera = PinholeCamera.centred(known.rig.camera.width, known.rig.camera.height, focal.focal)
    return replace(known, rig=StereoRig.of_one(camera), focal=focal)
