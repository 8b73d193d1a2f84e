"""Correct any number of frames of one camera in order, each with the frame before or after it.

The neighbour nearer to the target's time is used, as the camera's speed changes; the other one fills areas that
neither frame shows. A frame after a cut is corrected with the next one.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.motion_models import InertialMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.imu import GyroMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.pipeline.camera_capture import TOO_FEW
from rsbench.pipeline.footage import check_alike
from rsbench.pipeline.frame_depth import CorrectionOptions, inpainted
from rsbench.pipeline.mono_correction import (
    CUT,
    PIXELS,
    STILL,
    FoundOwnMotion,
    MonoFusionCorrector,
    SeenPair,
    Turned,
    find_steady_motion,
    group_of,
    motion_of_pair,
    refusal,
    shared_trajectory,
    trajectory_matches,
    turned,
    with_best_motion,
    with_selected_model,
)
from rsbench.pipeline.mono_gyro import NOT_COVERED, around, rotation_alone, with_gyro
from rsbench.pipeline.sequence_capture import CorrectedMoment
from rsbench.vision.corrector import load_corrector
from rsbench.vision.images import ahead, grey_u8, map_ahead
from rsbench.vision.mono_fusion import Beyond, Flows, MonoFusion, MonoFusionOptions, find_flows

_AT_ONCE = 2
"""Number of pairs that are processed in parallel; parts of a pair's work use two cores by themselves."""
_PIXELS_AHEAD, _PAIRS_AHEAD = 3_000_000, (2, 10)
"""Pixels, and number of pairs, that wait to be drawn while the next trajectory is fitted, which takes as long for
small frames as for large ones."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pair:
    """Two successive frames, ready to be corrected."""

    fusion: MonoFusion | None
    found: FoundOwnMotion | None
    reason: str
    """Why they cannot be corrected; empty if they can."""


class _Seen(NamedTuple):
    """Two successive frames as read, with their flow and, with a gyroscope, their motion."""

    number: int
    """Number of the first frame."""
    images: tuple[NDArray[Any], NDArray[Any]]
    flows: Flows
    found: FoundOwnMotion | None
    reason: str
    """Why they cannot be corrected; empty if they can."""
    matches: FloatArray
    """(n, 4), see ``trajectory_matches``; (0, 4) with a gyroscope or a reason."""
    period: float
    """Time between the frames, frame periods."""


def options_of_camera(inpaint: bool | None, seed: int, target_row: float, fill: bool = True) -> CorrectionOptions:
    """Options for the correction of one camera's frames; options for components of a rig have no effect on it.

    With ``fill``, other frames fill holes.
    """
    corrector = MonoFusionCorrector(fusion=MonoFusionOptions(inpaint=False, fill=fill), seed=seed)
    entry = replace(load_corrector("mono-fusion"), component=corrector)
    return CorrectionOptions(corrector=entry, target_row=target_row, seed=seed, inpaint=bool(inpaint))


def correct_frames(
    frames: Iterable[NDArray[Any]],
    camera: PinholeCamera,
    shutter: RollingShutter,
    options: CorrectionOptions | None = None,
    done: int = 0,
    gyro: FloatArray | None = None,
    starts: FloatArray | None = None,
) -> Iterator[CorrectedMoment]:
    """Correct each frame (H, W[, 3]), uint8 or uint16, of one camera to the time of its target row, in order.

    Memory does not grow with the number of frames, as only a few pairs are kept.

    Args:
        frames: frames in order; they are iterated once.
        camera, shutter: camera and shutter of the frames.
        options: options from ``options_of_camera``; None: the target is the middle row.
        done: number of first frames that are left out.
        gyro: (n, 4) tau, w of a gyroscope, as in ``Correspondences``: tau 0 is the first row of the first frame.
        starts: (n,) increasing times of the frames' first rows, frame periods; 0, 1, 2, ... if absent. The readout
            is a smaller share of a longer interval, and a trajectory uses only intervals of about 1.

    Raises:
        RsbenchError: there are fewer than two frames, frames of two sizes, or only two frames, which cannot be
            corrected. Among more frames, such a pair gives a result with a reason.
    """
    options = options or options_of_camera(None, 0, (camera.height - 1) / 2)
    turn = turned(camera, shutter)
    pending: CorrectedMoment | None = None
    each: _Frame | None = None
    every = _with_neighbours(_pairs(frames, turn, options, done, gyro, starts))
    for each, moment in map_ahead(lambda one: (one, _corrected(one, turn, options)), every, 1, 1):
        if each.number < done:
            continue
        if each.number == 1 and each.after is None and each.before and not each.before.fusion:
            raise RsbenchError(f"frames: {each.before.reason}")
        if pending is not None:
            yield pending
        pending = moment
        if each.number > 0:  # the first frame waits until it is known whether a third one follows
            yield pending
            pending = None
    if each is None:
        raise RsbenchError(TOO_FEW)


class _Frame(NamedTuple):
    """A frame and the pairs that contain it; None where there is none, or it is done."""

    number: int
    image: NDArray[Any]
    previous: NDArray[Any] | None
    before: _Pair | None
    """The pair of the previous frame and this one."""
    after: _Pair | None
    """The pair of this frame and the next one."""


def _with_neighbours(
    pairs: Iterator[tuple[int, NDArray[Any], NDArray[Any], _Pair | None]],
) -> Iterator[_Frame]:
    """The frames of ``_pairs``, each with the pairs that contain it."""
    previous: NDArray[Any] | None = None
    before: _Pair | None = None
    last: tuple[int, NDArray[Any]] | None = None
    for number, first, second, after in pairs:
        yield _Frame(number - 1, first, previous, before, after)
        previous, before, last = first, after, (number, second)
    if last is not None:
        yield _Frame(*last, previous, before, None)


def _pairs(
    frames: Iterable[NDArray[Any]],
    turn: Turned,
    options: CorrectionOptions,
    done: int,
    gyro: FloatArray | None,
    starts: FloatArray | None,
) -> Iterator[tuple[int, NDArray[Any], NDArray[Any], _Pair | None]]:
    """For each pair in order: number of the second frame, both frames, and the pair; None: it is done."""
    first = max(done - 1, 0)
    begin = group_of(first)[0] if gyro is None else first
    turned_gyro, waiting = None if gyro is None else turn.gyro(gyro), deque[_Seen]()

    def look(at: tuple[int, tuple[NDArray[Any], NDArray[Any]]]) -> _Seen:
        return _analyse(*at, turn, options, turned_gyro, *_span(at[0], starts))

    def kept(seen: Iterable[_Seen]) -> Iterator[SeenPair]:
        for each in seen:
            waiting.append(each)
            yield SeenPair(matches=each.matches, period=each.period)

    def ready(at: tuple[_Seen, Motion | None]) -> tuple[_Seen, _Pair | None]:
        seen, path = at
        return seen, None if seen.number < first else _ready(seen, path, turn, options)

    def in_order(paths: Iterator[Motion | None]) -> Iterator[tuple[_Seen, Motion | None]]:
        for path in paths:
            while waiting[0].number < first:
                yield waiting.popleft(), None
            yield waiting.popleft(), path
        while waiting:
            yield waiting.popleft(), None

    pairs = enumerate(itertools.pairwise(frames))
    for number, (before, image) in itertools.islice(pairs, begin):
        yield number + 1, before, image, None
    seen = kept(map_ahead(look, pairs, _AT_ONCE, _AT_ONCE))
    rig = StereoRig.of_one(turn.camera)
    paths = (None for _ in seen) if gyro is not None else shared_trajectory(seen, rig, turn.shutter, begin, first)
    most = int(np.clip(_PIXELS_AHEAD // (turn.camera.width * turn.camera.height), *_PAIRS_AHEAD))
    for each, pair in map_ahead(ready, ahead(in_order(paths), most), _AT_ONCE, _AT_ONCE):
        yield each.number + 1, *each.images, pair


def _span(number: int, starts: FloatArray | None) -> tuple[float, float]:
    """Start and length of a pair, frame periods."""
    if starts is None or number + 1 >= len(starts):
        return float(number), 1.0
    return float(starts[number]), float(starts[number + 1] - starts[number])


def _analyse(
    number: int,
    images: tuple[NDArray[Any], NDArray[Any]],
    turn: Turned,
    options: CorrectionOptions,
    gyro: FloatArray | None,
    start: float,
    period: float,
) -> _Seen:
    """Flow of a pair and, with a gyroscope, its motion; ``gyro``: (n, 4) of the sequence in axes of ``turn``."""
    turn, nothing = turn.paced(period), np.zeros((0, 4))
    check_alike({f"frame {number + place}": image for place, image in enumerate(images)})
    given = [turn.image(image) for image in images]
    flows = find_flows(given)
    reason = refusal(given, flows)
    if gyro is None:
        matches = nothing if reason else trajectory_matches(flows, options.seed, PIXELS)
        return _Seen(number, images, flows, None, reason, matches, period)
    samples = around(gyro, start, start + period * (1.0 + turn.shutter.readout_ratio))
    found, reason = _motion_by_gyro(samples, reason, flows, turn, options, start, period)
    return _Seen(number, images, flows, found, reason, nothing, period)


def _motion_by_gyro(
    samples: FloatArray | None,
    reason: str,
    flows: Flows,
    turn: Turned,
    options: CorrectionOptions,
    start: float,
    period: float,
) -> tuple[FoundOwnMotion | None, str]:
    """The motion over two frames with a gyroscope, or the reason why there is none.

    Args:
        samples: (n, 4) tau, w around the pair; None: they do not cover it, and flow alone gives the motion.
        reason: why flow alone gives no motion; empty if it does.
        start, period: first time and length of the pair, frame periods.
    """
    rig, shutter = StereoRig.of_one(turn.camera), turn.shutter
    local = None if samples is None else (samples - [start, 0.0, 0.0, 0.0]) * [1.0 / period, *3 * [period]]
    if reason:
        if local is None or reason in (STILL, CUT):
            return None, reason
        return rotation_alone(rig, shutter, "left", local), ""
    search = options.robust, options.seed
    found = find_steady_motion(flows, rig, shutter, "left", *search)
    if local is None:
        return replace(found, unused=NOT_COVERED), ""
    return with_gyro(with_selected_model(found, flows, *search), flows, local, *search), ""


def _ready(seen: _Seen, path: Motion | None, turn: Turned, options: CorrectionOptions) -> _Pair:
    """Prepare the fusion of a pair with its final motion; ``path``: see ``motion_of_pair``."""
    if seen.reason:
        return _Pair(fusion=None, found=None, reason=seen.reason)
    turn, search = turn.paced(seen.period), (options.robust, options.seed)
    images, found = [turn.image(image) for image in seen.images], seen.found
    if found is None:
        rig = StereoRig.of_one(turn.camera)
        found = motion_of_pair(path, seen.matches, seen.flows, rig, turn.shutter, *search)
    elif isinstance(found.own.motion, InertialMotion):  # the motion is not from a gyroscope
        found = with_best_motion(found, seen.flows, *search)
    corrector = options.corrector.component
    assert isinstance(corrector, MonoFusionCorrector)
    return _Pair(fusion=MonoFusion(images, found.own, seen.flows, corrector.fusion), found=found, reason="")


def _corrected(each: _Frame, turn: Turned, options: CorrectionOptions) -> CorrectedMoment:
    """Correct a frame with one neighbour and fill it from the other; or return why not."""
    line = turn.line(options.target_row)
    sources = [(each.before, 1), (each.after, 0)]
    good = [
        (pair.fusion, place, pair.found) for pair, place in sources if pair is not None and pair.fusion is not None
    ]
    good.sort(key=lambda source: _readouts_away(*source[:2], line))
    why = "" if each.before is None else each.before.reason
    moment = CorrectedMoment(number=each.number, images={"left": each.image}, frames={}, found=None, reason=why)
    # A still camera needs no correction; an identical frame, however, replaces one that was not recorded.
    stays = why == STILL and each.previous is not None and not np.array_equal(each.previous, each.image)
    if stays or not good:
        return replace(moment, reason=why or (each.after.reason if each.after else ""))
    fusion, place, found = good[0]
    target = _target(fusion, place, line)
    places = fusion.places(place, target)
    # A gyroscope measures shakes between frames, which the parabolas of ``expected_errors`` do not follow.
    if fusion.own.shutter.readout_ratio > 0.0 and not isinstance(fusion.own.motion, GyroMotion):
        errors = expected_errors(turn.image(each.image), places, [pair[:2] for pair in good], line)
        if errors[0] > _LARGEST_RATIO[len(good)] * errors[1]:
            return replace(moment, reason=UNTRUSTED)
    beyond = Beyond(*good[1][:2], _target(*good[1][:2], line)) if len(good) > 1 else None
    fused = inpainted(turn.back(fusion.corrected(place, target, beyond, places)), options)
    return replace(moment, frames={"left": fused}, found=turn.found(found))


def _readouts_away(fusion: MonoFusion, place: int, line: float) -> float:
    """Time from a line of frame ``place`` of a pair to the middle line of the other frame, in readouts."""
    shutter = fusion.own.shutter
    later = (line - (shutter.height - 1) / 2) / shutter.height
    period = 1.0 / shutter.readout_ratio if shutter.readout_ratio > 0.0 else np.inf
    return period + (later if place else -later)


# Test whether a corrected frame is nearer to the truth than the frame as read.


_LARGEST_RATIO = {2: 1.3, 1: 2.0}
"""Largest expected mean square error of a corrected frame divided by that of the frame as read, by the number of
neighbours: with one neighbour, the path is less accurate when the speed changes. A video that shakes within each
frame has up to 1.2 and 1.7 although its corrected frames have a third of the error."""
_CONSISTENT_PX, _CLIPPED_PX, _SMOOTHED_PX = 0.5, 4.0, 1.5
"""Largest forward-backward error of usable flow; displacement beyond which errors do not grow, since the pixel
shows something else; blur of the image by whose gradients displacements become grey levels; all in px."""
_SOME = np.s_[::2, ::2]
"""The pixels whose errors are averaged."""
UNTRUSTED = "its correction is not expected to be better than the frame as read, which is kept"


def expected_errors(
    image: NDArray[Any], drawn: FloatArray, seen: Sequence[tuple[MonoFusion, int]], line: float
) -> tuple[float, float]:
    """Expected mean square errors, grey levels, of a corrected frame and of the frame as read, from optical flow.

    The reference for each pixel is its path in the image at the target's time: a parabola through its positions in
    the frame and in both neighbours, or a line if there is one neighbour. The path does not depend on depth, focal
    length, motion model or trajectory, whose errors affect the correction, but on the same readout ratio.

    Args:
        image: the frame (H, W[, C]), with rows read from the top.
        drawn: (H, W, 2 or 3) position of each of its pixels in the corrected frame, px.
        seen: the pairs that contain the frame, and its index in each; the readout ratio must be above 0.
        line: the line at whose time the target is.
    """
    lines, flows = len(image), seen[0][0].flows
    height, width = flows.shape
    grey = cv2.resize(grey_u8(image), (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = cv2.GaussianBlur(grey, (0, 0), _SMOOTHED_PX)
    slopes = [cv2.Sobel(grey, cv2.CV_32F, dx, 1 - dx, scale=0.125)[_SOME] for dx in (1, 0)]
    columns, rows = (
        ((np.arange(n) + 0.5) * s).astype(np.intp)[_SOME[0]]
        for n, s in zip((width, height), flows.scale, strict=True)
    )
    away = (drawn[np.ix_(rows, columns)][..., :2] - np.stack(np.meshgrid(columns, rows), axis=-1)) / flows.scale
    later, good = ((line - rows) / lines)[:, None], np.ones(slopes[0].shape, dtype=np.bool_)
    ends = list[tuple[Any, Any]]()
    for fusion, place in seen:  # times in readouts, which pairs of different lengths share
        flow = fusion.flows.flow[place][_SOME]
        ends.append(((1.0 - 2.0 * place) / fusion.own.shutter.readout_ratio + flow[..., 1] / height, flow))
        good &= fusion.flows.returns[place][_SOME] < _CONSISTENT_PX
    (a, to_first), (b, to_last) = ends[0], ends[-1]
    if len(ends) == 1:
        moved = (later / a)[..., None] * to_first
    else:
        moved = (later * (later - b) / (a * (a - b)))[..., None] * to_first
        moved = moved + (later * (later - a) / (b * (b - a)))[..., None] * to_last
    errors = []
    for off in (away - moved, moved):
        length = np.linalg.norm(off, axis=-1)
        levels = slopes[0] * off[..., 0] + slopes[1] * off[..., 1]
        levels *= np.minimum(1.0, _CLIPPED_PX / np.maximum(length, 1e-6))
        errors.append(float(np.mean(levels[good] ** 2)) if np.any(good) else 0.0)
    return errors[0], errors[1]


def _target(fusion: MonoFusion, place: int, line: float) -> float:
    """The time of a line of frame ``place`` of a pair, in the pair's periods."""
    return float(fusion.own.shutter.time_after(line, place, "left"))
