"""Tracks of corrected frames; docs/reference/protocols.md has the formulas, which ``rsbench.vision`` implements.

Pixels that a method did not draw are black, so that leaving out difficult pixels does not raise a score. In
rsbench's own entries narrow holes are closed, as by ``rsbench correct``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.leaderboard.picture_track import CardChain, PictureTrack, SharedWork, drawn_oracle
from rsbench.benchmark.leaderboard.pictures import (
    PARTINGS,
    PICTURES,
    VIEW,
    Parts,
    RequestedPicture,
    TruePictures,
    frame_png,
    parts_within,
    read_answer_frame,
    rms_by_part,
    texture,
)
from rsbench.benchmark.leaderboard.pictures import columns as parting_columns
from rsbench.benchmark.leaderboard.splits import Frames
from rsbench.benchmark.leaderboard.track import FAILED, ORACLE, SECONDS, Numbers, Score, Submission, Track
from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, VIEWS, View
from rsbench.dataset.layout import exposed_file, picture_file
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.pipeline.chain import CorrectedFrames, Given, correct_four, correct_known_rows
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.mono_correction import find_own_motion, flow_matches, refusal
from rsbench.storage.files import write_bytes
from rsbench.vision.corrector import CorrectorSpec, demand_corrected, load_corrector
from rsbench.vision.flow import dense_flow
from rsbench.vision.fusion import Fused, Origin, finished
from rsbench.vision.mono_fusion import find_flows
from rsbench.vision.quality import (
    GAUSSIAN,
    Picture,
    flip,
    psnr_within,
    ssim_deepunroll,
    ssim_map,
    ssim_uniform,
    ssim_within,
    to_unit,
    window_mask,
)

Frame = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""An image (H, W, 3) and the mask (H, W) of pixels that the method drew."""
_PIXELS = ("", "_covered", "_all")
"""Suffixes of the columns of scores over common pixels, drawn pixels, and all pixels."""
_WORST_FRAME: Numbers = {
    **{f"{name}{end}": 0.0 for name in ("ssim", "psnr") for end in _PIXELS},
    **{f"flip_{part}": 1.0 for part in ("common", "covered", "all")},
    "coverage": 0.0,
    "epe_px": math.inf,
    "ssim_deepunroll": 0.0,
    "ssim_uniform": 0.0,
}
_SMALLER = 0.25
"""A likely mistake is reported if undoing it reduces the squared error to less than this share."""
_FRAMES = (
    Score("ssim", "SSIM", "of the common pixels, at least 0", "share", "higher"),
    Score("ssim_covered", "SSIM covered", "of what it drew itself", "share", "higher"),
    Score("ssim_all", "SSIM all", "of the whole image", "share", "higher"),
    Score("coverage", "drawn", "share of the common pixels drawn", "share", "higher"),
    FAILED,
    Score("psnr", "PSNR (dB)", "median, of the common pixels", "median", "higher"),
    *(
        Score(f"psnr_{part}", f"PSNR {part}", words, "median", "higher")
        for part, words in (
            ("covered", "of what it drew itself"),
            ("all", "of the whole image"),
            ("first", "of the first row's time, common pixels"),
            ("middle", "of the middle row's time, common pixels"),
        )
    ),
    *(
        Score(f"flip_{part}", f"FLIP {part}", f"median, of {words}", "median")
        for part, words in (("common", "the common pixels"), ("covered", "what it drew"), ("all", "all pixels"))
    ),
    Score("epe_px", "EPE (px)", "median flow to the truth, common and drawn pixels", "median"),
    Score(
        "ssim_deepunroll",
        "SSIM DeepUnrollNet",
        "of the whole image as DeepUnrollNet, RSSR, CVR and QRSC compute it",
        "median",
        "higher",
    ),
    Score(
        "ssim_uniform", "SSIM uniform", "of the whole image with scikit-image's default window", "median", "higher"
    ),
    SECONDS,
)


def _uncorrected(pictures: TruePictures, place: Path) -> None:
    image = pictures.rolling()
    for each in pictures.requested:
        write_bytes(place / f"{each.stem}.png", frame_png(image, np.ones(image.shape[:2], dtype=np.bool_)))


def _best(pictures: TruePictures, place: Path) -> None:
    """Write the frames of the default corrector with the true motion and depth."""
    sequence = pictures.sequence
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    given = Given(motion=sequence.motion, pairs=true_pairs(sequence, images))
    for each in pictures.requested:
        options = CorrectionOptions(target_row=each.row)
        inputs = KnownInputs.of(sequence.shutter)
        fused = correct_four(images, sequence.rig, inputs, options, given=given, views=(VIEW,)).frames[VIEW]
        write_bytes(place / f"{each.stem}.png", frame_png(fused.image, fused.origin != Origin.NOBODY))


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectionTrack(PictureTrack):
    """A track of frames corrected from a rolling to a global shutter."""

    rows: tuple[str, ...] = ("first", "middle")
    """Rows to whose times frames must be corrected, if the dataset has the truth for them."""
    flips: bool = True
    """Whether FLIP is among the scores."""
    at_rows = True
    part_score, part_title = "rms", "RMS error of the common pixels, of 255"

    def requested(self, sequence: Rendered) -> tuple[RequestedPicture, ...]:
        """Return the pictures for the first row, and for the other rows for which the dataset has the truth."""
        side, frame = VIEW
        lines = sequence.shutter.lines(side)
        numbers = {"first": 0, "middle": lines // 2, "last": lines - 1}
        rows = {name: numbers[name] for name in self.rows if numbers[name] in (0, *sequence.twins)}
        return tuple(
            RequestedPicture(f"{side}_{frame}_{name}", row, picture_file("gs", side, frame + sequence.first, row))
            for name, row in rows.items()
        )

    def read(self, submission: Submission, pictures: TruePictures) -> list[Frame]:
        return [read_answer_frame(submission.folder / PICTURES, pictures, each) for each in pictures.requested]

    def hints(self, drawn: Sequence[Frame], pictures: TruePictures, public: bool) -> Iterable[str]:
        if not public:
            return ()
        truths, found = {each.stem: pictures.frame(each.row) for each in pictures.requested}, set[str]()
        for (stem, truth), (image, _) in zip(truths.items(), drawn, strict=True):
            others = {name: other for name, other in truths.items() if name != stem}
            found |= set(_mistakes(image, truth, others))
        return found

    def truth_of(self, pictures: TruePictures) -> list[TrueFrame]:
        found, commons = list[TrueFrame](), pictures.commons()
        for each, common in zip(pictures.requested, commons, strict=True):
            image, name = pictures.frame(each.row), each.stem.rpartition("_")[2]
            parts = parts_within(self.part_score, image, each.row, common)
            found.append(TrueFrame(name=name, picture=Picture(image), common=common, parts=parts))
        return found

    def scores_of(self, true: Sequence[TrueFrame], drawn: Sequence[Frame] | None) -> Numbers:
        """Return means over the requested frames, for PSNR those of the values in dB."""
        frames = list(zip(true, [None] * len(true) if drawn is None else drawn, strict=True))
        scores = [_WORST_FRAME if frame is None else _frame(*frame, one, self.flips) for one, frame in frames]
        keys = [key for key in _WORST_FRAME if self.flips or not key.startswith("flip_")]
        found = {key: float(np.mean([each[key] for each in scores])) for key in keys}
        by_row = {f"psnr_{name}": math.nan for name in self.rows}
        by_row |= {f"psnr_{one.name}": each["psnr"] for one, each in zip(true, scores, strict=True)}
        parted = ((None if frame is None else frame[0], one.picture.image, one.parts) for one, frame in frames)
        squares = rms_by_part(self.part_score, parted)
        return {**found, **by_row, **squares, "error": 1.0 - found["ssim"]}

    def draw(self, pictures: TruePictures, place: Path) -> None:
        _uncorrected(pictures, place)

    def chain(self, card: str) -> CardChain:
        corrector = load_corrector(card)
        chain, spec = CorrectionOptions(corrector=corrector), corrector.component.spec
        return CardChain(chain, corrector, chain.key, ("readout", "images", *sorted(spec.sees)), spec.reference)

    def make(self, work: SharedWork, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        drawn: dict[str, bytes] = {}
        try:
            frames, seconds = self.corrected(work, chain)
            for each, found in zip(work.requested, frames, strict=True):
                demand_corrected(found, chain.corrector.name)
                fused = finished(found[VIEW])
                drawn[each.stem] = frame_png(fused.image, fused.origin != Origin.NOBODY)
        except RsbenchError as error:
            return {"success": False, "reason": str(error)[:300]}
        place.mkdir(parents=True)
        for stem, data in drawn.items():
            write_bytes(place / f"{stem}.png", data)
        return {"seconds": round(seconds, 4)}

    def corrected(self, work: SharedWork, chain: CorrectionOptions) -> tuple[list[dict[View, Fused]], float]:
        """Correct the frame to the time of each requested row; also return the run time of this entry alone, s.

        Raises:
            RsbenchError: the frame cannot be corrected.
        """
        needs = chain.corrector.component.spec.needs
        rig, shutter = work.problem.rig, work.problem.shutter
        if needs & {"motion", "matches"} and work.known.matches is None:
            start = time.perf_counter()
            matches = find_matches_of_rig(work.images, rig, shutter.scanning, chain)
            work.known = replace(work.known, matches=matches)
            work.spent["matching"] = time.perf_counter() - start
        first, *others = (float(each.row) for each in work.requested)
        found = correct_four(
            work.images,
            rig,
            KnownInputs.of(shutter),
            replace(chain, target_row=first),
            given=work.known,
            views=(VIEW,),
            rows=others,
        )
        _share(work, found)
        steps = {"matching": {"motion", "matches"}, "motion": {"motion"}, "depth": {"depth"}}
        spent = sum(work.spent.get(step, 0.0) for step, users in steps.items() if needs & users)
        return [found.frames, *found.at_rows], found.seconds["correction"] + spent


def _share(work: SharedWork, found: CorrectedFrames) -> None:
    """Store intermediate results and their run time for the other entries of the job."""
    if work.known.motion is None and found.motion is not None:
        work.spent["motion"] = found.seconds["motion"]
    if work.known.pairs is None and found.pairs is not None:
        work.spent["depth"] = found.seconds["depth"]
    motion, pairs = found.motion or work.known.motion, found.pairs or work.known.pairs
    work.known = replace(work.known, motion=motion, pairs=pairs)


# Marking


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueFrame:
    """Ground truth of a corrected frame."""

    name: str
    """Name of the row: ``first``, ``middle`` or ``last``."""
    picture: Picture
    """(H, W, 3) image of a global shutter."""
    common: NDArray[np.bool_]
    """Mask (H, W) of common pixels, see ``TruePictures.commons``."""
    parts: Parts
    """Named parts of the common pixels."""


def _frame(image: NDArray[np.uint8], drawn: NDArray[np.bool_], true: TrueFrame, flips: bool) -> Numbers:
    common, truth, drawing = true.common, true.picture, Picture(image)
    masks = dict(zip(_PIXELS, (common, drawn, np.ones_like(common)), strict=True))
    both, values = common & drawn, list(masks.values())
    found = dict(zip((f"ssim{end}" for end in _PIXELS), ssim_within(drawing, truth, values), strict=True))
    found |= dict(zip((f"psnr{end}" for end in _PIXELS), psnr_within(drawing, truth, values), strict=True))
    found["coverage"] = np.count_nonzero(both) / max(int(np.count_nonzero(common)), 1)
    off = np.linalg.norm(dense_flow(image, truth.image)[both].astype(np.float64), axis=-1)
    found["epe_px"] = float(np.mean(off)) if off.size else math.inf
    found["ssim_deepunroll"] = ssim_deepunroll(drawing, truth)
    found["ssim_uniform"] = ssim_uniform(drawing, truth)
    # A mask without pixels gives NaN, which becomes the worst value; a negative SSIM counts as 0.
    found = {key: _WORST_FRAME[key] if math.isnan(value) else value for key, value in found.items()}
    found |= {key: max(value, 0.0) for key, value in found.items() if key.startswith("ssim")}
    return {**found, **(_flips(image, truth.image, masks) if flips else {})}


def _flips(image: NDArray[np.uint8], truth: NDArray[np.uint8], masks: dict[str, Any]) -> Numbers:
    """Return the mean FLIP error per mask; NaN if the package flip-evaluator is not installed."""
    errors, names = flip(image, truth), ("flip_common", "flip_covered", "flip_all")
    if errors is None:
        return dict.fromkeys(names, math.nan)
    return {
        name: float(np.mean(errors[mask])) if np.any(mask) else 1.0
        for name, mask in zip(names, masks.values(), strict=True)
    }


# Likely mistakes


def _mistakes(
    image: NDArray[np.uint8], truth: NDArray[np.uint8], others: dict[str, NDArray[np.uint8]]
) -> Iterator[str]:
    limit = _SMALLER * _squared(image, truth)
    readings: dict[str, NDArray[Any]] = {
        "red and blue are swapped; PNG files hold RGB": image[..., ::-1],
        "it is upside down": image[::-1],
        "it is mirrored": image[:, ::-1],
        "it is a row too low": np.roll(image, -1, axis=0),
        "it is a row too high": np.roll(image, 1, axis=0),
        "it is a column too far right": np.roll(image, -1, axis=1),
        "it is a column too far left": np.roll(image, 1, axis=1),
    }
    for words, reading in readings.items():
        if _squared(reading, truth) < limit:
            yield words
            return
    for stem, other in others.items():
        if _squared(image, other) < limit:
            yield f"it is nearer to the truth of {stem}: the rows are exchanged"


def _squared(image: NDArray[Any], truth: NDArray[np.uint8]) -> float:
    """Return the mean squared difference of the pixels that are not black, without the border, because shifted
    images wrap around."""
    counted = np.any(image > 0, axis=-1)
    counted[[0, -1]] = counted[:, [0, -1]] = False
    difference = image[counted].astype(np.float32) - truth[counted]
    return float(np.mean(difference * difference)) if difference.size else np.inf


# Scores by the position of the content in corrected frames
#
# Noise, blur and vignetting do not depend on the shutter, but determine most of the SSIM of a real sensor.
# Therefore windows of the blurred truth are found in the blurred frame by template matching, and the length of
# their displacement is scored. Dense flow is not accurate enough: on noisy frames its errors are as large as those
# of a corrected frame. Phase correlation would undo the blur.

LIMIT_PX = 2.0
"""Displacement at which, and above which, the score of a window is 0."""
WINDOW_PX, _STEP_PX, _REACH_PX = 64, 32, 4
"""Side of a window, distance between windows, and radius of the search, px."""
_BLUR_PX = 3.0
"""Standard deviation of the blur of both pictures."""
_LOOK_PX = 2.0
"""Standard deviation of the blur before pictures are compared; it reduces white noise to a seventh."""
_LOOK_CONSTANTS = 0.1
"""Factor of the constants of SSIM, because the blur reduces the contrast."""
_TEXTURE = 5.0
"""Smallest local standard deviation of the true image, grey levels, at pixels that count."""
_LEAST = 0.25
"""Smallest share of counted pixels in a window."""


class PlacedTrack(CorrectionTrack):
    """A track of corrected frames, ranked by the position of their content."""

    def chain(self, card: str) -> CardChain:
        return super().chain(card).choosing()

    def scores_of(self, true: Sequence[TrueFrame], drawn: Sequence[Frame] | None) -> Numbers:
        share = 0.0 if drawn is None else placed(true, drawn)
        return {**super().scores_of(true, drawn), "placed": share, "misplaced": 1.0 - share}


class SensorTrack(PlacedTrack):
    """A track of corrected frames whose truth is the image of the same sensor with a global shutter."""

    def requested(self, sequence: Rendered) -> tuple[RequestedPicture, ...]:
        """Return the pictures, whose truth is the noise-free image of the same sensor with a global shutter.

        Raises:
            RsbenchError: the dataset has a sensor, but no such images.
        """
        requested = super().requested(sequence)
        if sequence.sensor is None:
            return requested
        if not sequence.exposed_twins:
            raise RsbenchError(
                f"{sequence.folder}: has no global-shutter images of its sensor, which {self.id} compares with; "
                "render the dataset again with exposed_twins = true in its card"
            )
        side, frame = VIEW
        return tuple(
            each._replace(file=exposed_file(side, frame + sequence.first, each.row)) for each in requested
        )

    def scores_of(self, true: Sequence[TrueFrame], drawn: Sequence[Frame] | None) -> Numbers:
        found = super().scores_of(true, drawn)
        looks = 0.0 if drawn is None else seen_alike(true, drawn)
        both = found["placed"] * looks
        return {**found, "picture": looks, "corrected": both, "shortfall": 1.0 - both}


def seen_alike(truths: Sequence[TrueFrame], frames: Sequence[Frame]) -> float:
    """Return the mean over frames of the SSIM of blurred images over the common pixels; at least 0. Pixels that
    are not drawn count as 0.

    The blur removes most of the sensor's noise, so that smoothing does not raise the score; contrast, colour,
    strong noise and filled holes still affect it.
    """
    return float(np.mean([_alike(*frame, true) for true, frame in zip(truths, frames, strict=True)]))


def _alike(image: NDArray[np.uint8], drawn: NDArray[np.bool_], true: TrueFrame) -> float:
    seen, wanted = (
        Picture(cv2.GaussianBlur(to_unit(each), (0, 0), _LOOK_PX)) for each in (image, true.picture.image)
    )
    windows = window_mask(drawn.shape, true.common)
    if not np.any(windows):
        return 1.0
    scores = np.mean(ssim_map(seen, wanted, GAUSSIAN, _LOOK_CONSTANTS), axis=-1)
    return max(0.0, float(np.mean(np.where(drawn, scores, 0.0)[windows])))


def placed(truths: Sequence[TrueFrame], frames: Sequence[Frame]) -> float:
    """Return the mean over frames of the share of textured common pixels that are drawn, weighted by the
    displacement of their window: 1 at 0 px, 0 from ``LIMIT_PX`` on. It is 1 if no window has enough texture."""
    return float(np.mean([_placed(*frame, true) for true, frame in zip(truths, frames, strict=True)]))


def _placed(image: NDArray[np.uint8], drawn: NDArray[np.bool_], true: TrueFrame) -> float:
    truth = true.picture.image
    counted = true.common & (texture(truth) >= _TEXTURE)
    seen, wanted = (_blurred(each) for each in (image, truth))
    side = min(WINDOW_PX, *(size - 2 * _REACH_PX for size in counted.shape))
    score, total = 0.0, 0
    for y, x in product(*(range(_REACH_PX, size - side - _REACH_PX + 1, _STEP_PX) for size in counted.shape)):
        window = np.s_[y : y + side, x : x + side]
        count = int(np.count_nonzero(counted[window]))
        if count < _LEAST * side * side:
            continue
        around = seen[y - _REACH_PX : y + side + _REACH_PX, x - _REACH_PX : x + side + _REACH_PX]
        there = np.count_nonzero(counted[window] & drawn[window])
        score += there * max(0.0, 1.0 - _distance(around, wanted[window]) / LIMIT_PX)
        total += count
    return score / total if total else 1.0


def _distance(around: NDArray[np.float32], window: NDArray[np.float32]) -> float:
    """Return the displacement, px, of the best match of a window in its search region; infinite at the border."""
    found = cv2.matchTemplate(around, window, cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(np.argmax(found)), found.shape)
    if not (0 < y < 2 * _REACH_PX and 0 < x < 2 * _REACH_PX):
        return math.inf
    down = _top(found[y - 1 : y + 2, x])
    across = _top(found[y, x - 1 : x + 2])
    return math.hypot(float(y) + down - _REACH_PX, float(x) + across - _REACH_PX)


def _top(three: NDArray[np.float32]) -> float:
    """Return the maximum position, relative to the middle, of the parabola through three neighbouring values."""
    before, middle, after = map(float, three)
    bend = before - 2.0 * middle + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


def _blurred(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), dtype=np.float32)


# Tracks of one camera
#
# The inputs of a corrector, matches and a motion without the scale of its translation, are estimated by dense flow
# from the two frames of this camera. Correctors that need the depth of a rig run as on the track ``correction``;
# their entries state that they use the other camera, and show its benefit.

_SIDE = VIEW[0]
_LAST = {"key": "psnr_last", "title": "PSNR last", "hint": "of the last row's time, common pixels"}


class OneCameraTrack(CorrectionTrack):
    """A track of corrected frames of one camera."""

    def chain(self, card: str) -> CardChain:
        made = super().chain(card)
        spec = made.options.corrector.component.spec
        if _needs_rig(spec):
            return made.choosing()
        others = [name for name, there in (("time", "time" in spec.sees), ("gyro", "gyro" in spec.needs)) if there]
        return made._replace(uses=("readout", "images", *others))

    def corrected(self, work: SharedWork, chain: CorrectionOptions) -> tuple[list[dict[View, Fused]], float]:
        spec = chain.corrector.component.spec
        if _needs_rig(spec):
            return super().corrected(work, chain)
        problem, known = work.problem, Given()
        images = {view: image for view, image in work.images.items() if view[0] == _SIDE}
        if spec.needs & {"motion", "matches"}:
            work.left = work.left or _from_left(work, chain)
            known = work.left
        gyro = problem.correspondences.gyro
        known = replace(known, gyro=gyro if len(gyro) > 0 else None)
        rig, rows = problem.rig.about(_SIDE), [float(each.row) for each in work.requested]
        start = time.perf_counter()
        frames = correct_known_rows(images, known, rig, problem.shutter, chain, (VIEW,), 0.0, rows)
        spent = work.spent.get("left", 0.0) if spec.needs & {"motion", "matches"} else 0.0
        return frames, time.perf_counter() - start + spent


def _needs_rig(spec: CorrectorSpec) -> bool:
    """Whether a corrector needs both cameras, for depth or for frames of the other camera."""
    return "depth" in spec.needs or ("stereo" in spec.sees and not spec.needs & {"motion", "matches"})


def _from_left(work: SharedWork, chain: CorrectionOptions) -> Given:
    """Estimate matches of the left camera over time and its motion, whose translation has length 1.

    Raises:
        RsbenchError: the frames do not determine a motion.
    """
    start = time.perf_counter()
    frames = [work.images[_SIDE, frame] for frame in FRAMES]
    flows = find_flows(frames)
    if reason := refusal(frames, flows):
        raise RsbenchError(reason)
    matches = flow_matches(flows, np.random.default_rng(chain.seed))
    rig, shutter = work.problem.rig, work.problem.shutter
    found = find_own_motion(flows, rig, shutter, _SIDE, chain.robust, chain.seed)
    if found.own.motion is None:
        raise RsbenchError(found.reason)
    work.spent["left"] = time.perf_counter() - start
    return Given(matches=Correspondences(left=matches), motion=found.own.motion)


_RIG: dict[str, Any] = {
    "allowed": ("readout", "images", "stereo", "time"),
    "given": "the four rolling-shutter frames",
    "inputs": Frames(),
    "exact": {"error": 1e-6, **dict.fromkeys(parting_columns("rms", PARTINGS[0]), 0.05)},
    "oracles": (
        drawn_oracle("uncorrected", "images", "The rolling-shutter frame as it is", _uncorrected),
        drawn_oracle("fusion-true", ORACLE, "The corrector fusion with the true motion and depth", _best),
    ),
    # Without FLIP, whose package has no wheel for some systems.
    "smoke_metrics": (
        *(f"ssim{part}" for part in ("", "_covered", "_all", "_deepunroll", "_uniform")),
        *(f"psnr{part}" for part in ("", "_covered", "_all", "_first", "_middle")),
        *("coverage", "epe_px"),
    ),
}
_ONE_CAMERA: dict[str, Any] = _RIG | {
    "allowed": (*_RIG["allowed"], "gyro"),
    "given": "the four rolling-shutter frames; samples of a gyroscope where the dataset has the channel imu",
}
_SSIM: dict[str, Any] = {"error": "error", "error_title": "1 - SSIM"}
_PLACED = Score(
    "placed",
    "placed",
    "1 where textured common pixels stand right, 0 from 2 px on and where they are not drawn",
    "share",
    "higher",
)
_WITHOUT_FLIP = tuple(score for score in _FRAMES if not score.key.startswith("flip_"))
OF_SENSORS: dict[str, Any] = _RIG | {
    "scores": (
        Score(
            "corrected",
            "placed x picture",
            "the product of the two: what stands in its place and looks like the scene there",
            "share",
            "higher",
        ),
        _PLACED,
        Score(
            "picture",
            "picture",
            "SSIM of blurred images to what a global shutter of the same sensor shows, 0 where not drawn",
            "share",
            "higher",
        ),
        *_WITHOUT_FLIP,
    ),
    "flips": False,
    "error": "shortfall",
    "error_title": "1 - placed x picture",
    "beside": ("placed", "picture", "failure"),
}
"""Fields of a ``SensorTrack``."""
TRACKS: tuple[Track, ...] = (
    SensorTrack(
        **OF_SENSORS,
        name="correction-3",
        id="correction-3",
        title="Corrected frames, by where things stand and how they look",
    ),
    PlacedTrack(
        **_RIG,
        name="correction-2",
        id="correction-2",
        title="Corrected frames, by where things stand",
        scores=(_PLACED, *_WITHOUT_FLIP),
        flips=False,
        error="misplaced",
        error_title="1 - placed",
    ),
    CorrectionTrack(
        **_RIG | _SSIM,
        name="correction",
        id="correction-1",
        title="Corrected frames",
        scores=_FRAMES,
        smoke=("fusion", "zhuang", "uncorrected", "fusion-true", ORACLE),
    ),
    OneCameraTrack(
        **_ONE_CAMERA | _SSIM,
        name="correction-mono",
        id="correction-mono-1",
        title="Corrected frames of one camera",
        rows=("first", "middle", "last"),
        scores=tuple(
            each
            for score in _FRAMES
            for each in ((score, replace(score, **_LAST)) if score.key == "psnr_middle" else (score,))
        ),
        smoke=("mono-fusion", "flow-scaled", "zhuang", "fusion", "uncorrected", "fusion-true", ORACLE),
    ),
)
