"""The track that asks for corrected frames: formulas of docs/reference/protocols.md, those of ``rsbench.vision``.

What a method did not draw is black: nobody gains by leaving out what is difficult. Entries that the board makes
itself close narrow holes, as the command does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.leaderboard.picture_track import CardChain, Making, PictureTrack
from rsbench.benchmark.leaderboard.pictures import (
    FOLDER,
    PARTINGS,
    VIEW,
    Asked,
    Parts,
    SquareErrors,
    TruePictures,
    frame_png,
    parts_within,
    read_answer_frame,
    texture,
)
from rsbench.benchmark.leaderboard.pictures import columns as parting_columns
from rsbench.benchmark.leaderboard.splits import GYRO, bare_problems, with_gyro
from rsbench.benchmark.leaderboard.track import FAILED, ORACLE, SECONDS, Numbers, Score, Split, Submission, Truth
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, VIEWS, View
from rsbench.dataset.imu import MEASURED
from rsbench.dataset.layout import exposed_file, picture_file
from rsbench.dataset.sequence import Sequence as Rendered
from rsbench.dataset.sequence import read_pairs
from rsbench.pipeline.chain import CorrectedFrames, Given, correct_four, correct_known_rows
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_matches import find_matches_of_rig
from rsbench.pipeline.mono_correction import find_own_motion, flow_matches, refusal
from rsbench.pipeline.problem import Problem
from rsbench.storage.files import write_bytes
from rsbench.vision.closing import finished
from rsbench.vision.corrector import CorrectorSpec, demand_corrected, load_corrector
from rsbench.vision.flow import dense_flow
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.mono_fusion import find_flows
from rsbench.vision.published_quality import flip, ssim_deepunroll, ssim_uniform
from rsbench.vision.quality import GAUSSIAN, Picture, psnr_within, ssim_map, ssim_within, to_unit, window_mask

Frame = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""An image (H, W, 3) and where something was drawn (H, W)."""
_PIXELS = ("", "_covered", "_all")
"""Ends of columns: of the common pixels, of what was drawn, of all."""
_WORST_FRAME: Numbers = {
    **{f"{name}{end}": 0.0 for name in ("ssim", "psnr") for end in _PIXELS},
    **{f"flip_{part}": 1.0 for part in ("common", "covered", "all")},
    "coverage": 0.0,
    "epe_px": math.inf,
    "ssim_deepunroll": 0.0,
    "ssim_uniform": 0.0,
}
_SMALLER = 0.25
"""The squared error of another reading must be below this part of that of what stands there."""
_FRAMES = (
    Score(key="ssim", title="SSIM", hint="of the common pixels, at least 0", kind="share", better="higher"),
    Score(key="ssim_covered", title="SSIM covered", hint="of what it drew itself", kind="share", better="higher"),
    Score(key="ssim_all", title="SSIM all", hint="of the whole image", kind="share", better="higher"),
    Score(key="coverage", title="drawn", hint="share of the common pixels drawn", kind="share", better="higher"),
    FAILED,
    Score(key="psnr", title="PSNR (dB)", hint="median, of the common pixels", kind="median", better="higher"),
    *(
        Score(key=f"psnr_{part}", title=f"PSNR {part}", hint=words, kind="median", better="higher")
        for part, words in (
            ("covered", "of what it drew itself"),
            ("all", "of the whole image"),
            ("first", "of the first row's time, common pixels"),
            ("middle", "of the middle row's time, common pixels"),
        )
    ),
    *(
        Score(key=f"flip_{part}", title=f"FLIP {part}", hint=f"median, of {words}", kind="median")
        for part, words in (("common", "the common pixels"), ("covered", "what it drew"), ("all", "all pixels"))
    ),
    Score(key="epe_px", title="EPE (px)", hint="median flow to the truth, common and drawn pixels", kind="median"),
    Score(
        key="ssim_deepunroll",
        title="SSIM DeepUnrollNet",
        hint="of the whole image as DeepUnrollNet, RSSR, CVR and QRSC compute it",
        kind="median",
        better="higher",
    ),
    Score(
        key="ssim_uniform",
        title="SSIM uniform",
        hint="of the whole image with scikit-image's default window",
        kind="median",
        better="higher",
    ),
    SECONDS,
)


def _uncorrected(pictures: TruePictures, place: Path) -> None:
    image = pictures.rolling()
    for each in pictures.asked:
        write_bytes(place / f"{each.stem}.png", frame_png(image, np.ones(image.shape[:2], dtype=np.bool_)))


def _best(pictures: TruePictures, place: Path) -> None:
    """Our default corrector with the true motion and depth."""
    sequence = pictures.sequence
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    given = Given(motion=sequence.motion, pairs=true_pairs(sequence, images))
    for each in pictures.asked:
        options = CorrectionOptions(target_row=each.row)
        ratio = sequence.shutter.readout_ratio
        fused = correct_four(images, sequence.rig, ratio, options, given=given, views=(VIEW,)).frames[VIEW]
        write_bytes(place / f"{each.stem}.png", frame_png(fused.image, fused.origin != 0))


class CorrectionTrack(PictureTrack):
    """Rolling-shutter frames as a global shutter would have taken them."""

    name, id = "correction", "correction-1"
    title = "Corrected frames"
    asks_rows = True
    rows: ClassVar[tuple[str, ...]] = ("first", "middle")
    """At whose times frames are asked, where the dataset has the truth."""
    flips: ClassVar[bool] = True
    """Whether FLIP is among the scores."""
    scores = _FRAMES
    error, error_title = "error", "1 - SSIM"
    exact = MappingProxyType({"error": 1e-6, **dict.fromkeys(parting_columns("rms", PARTINGS[0]), 0.05)})
    part_score, part_title = "rms", "RMS error of the common pixels, of 255"
    others = (
        ("uncorrected", "images", "The rolling-shutter frame as it is", _uncorrected),
        ("fusion-true", ORACLE, "The corrector fusion with the true motion and depth", _best),
    )
    smoke = ("fusion", "zhuang", "uncorrected", "fusion-true", ORACLE)
    # Without FLIP, whose package has no wheel for some systems.
    smoke_metrics = (
        *(f"ssim{part}" for part in ("", "_covered", "_all", "_deepunroll", "_uniform")),
        *(f"psnr{part}" for part in ("", "_covered", "_all", "_first", "_middle")),
        "coverage",
        "epe_px",
    )

    def asked(self, sequence: Rendered) -> tuple[Asked, ...]:
        """At the first row, and at others where the dataset has that truth."""
        side, frame = VIEW
        lines = sequence.shutter.lines(side)
        numbers = {"first": 0, "middle": lines // 2, "last": lines - 1}
        rows = {name: numbers[name] for name in self.rows if numbers[name] in (0, *sequence.twins)}
        return tuple(
            Asked(f"{side}_{frame}_{name}", row, picture_file("gs", side, frame + sequence.first, row))
            for name, row in rows.items()
        )

    def hints(
        self, folder: Path, truth: Truth, png_unit_m: float | None, split: Split, wanted: bool
    ) -> Iterable[str]:
        assert truth.pictures is not None
        found: set[str] = set()
        for each in truth.pictures.asked:
            image, _ = read_answer_frame(folder, truth.pictures, each)
            if wanted and split.public:
                others = {k.stem: truth.pictures.frame(k.row) for k in truth.pictures.asked if k != each}
                found |= set(_readings(image, truth.pictures.frame(each.row), others))
        return found

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], Numbers]:
        true = TrueFrame.all_of(pictures)

        def scores_of(submission: Submission, success: bool) -> Numbers:
            folder = submission.folder / FOLDER
            drawn = [read_answer_frame(folder, pictures, each) for each in pictures.asked] if success else None
            return frame_scores(true, drawn, self.rows, flips=self.flips)

        return scores_of

    def draw_example(self, pictures: TruePictures, place: Path) -> None:
        _uncorrected(pictures, place)

    def chain(self, card: str) -> CardChain:
        corrector = load_corrector(card)
        chain, spec = CorrectionOptions(corrector=corrector), corrector.component.spec
        return CardChain(chain, corrector, chain.key, ("readout", "images", *sorted(spec.sees)), spec.reference)

    def make(self, making: Making, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        drawn: dict[str, bytes] = {}
        try:
            frames, seconds = self.corrected(making, chain)
            for each, found in zip(making.asked, frames, strict=True):
                demand_corrected(found, chain.corrector.name)
                fused = finished(found[VIEW])
                drawn[each.stem] = frame_png(fused.image, fused.origin != Origin.NOBODY)
        except RsbenchError as error:
            return {"success": False, "reason": str(error)[:300]}
        place.mkdir(parents=True)
        for stem, data in drawn.items():
            write_bytes(place / f"{stem}.png", data)
        return {"seconds": round(seconds, 4)}

    def corrected(self, making: Making, chain: CorrectionOptions) -> tuple[list[dict[View, Fused]], float]:
        """The frame at the time of each row that is asked, and the seconds that this takes alone.

        Raises:
            RsbenchError: it cannot be corrected.
        """
        needs = chain.corrector.component.spec.needs
        rig, shutter = making.problem.rig, making.problem.shutter
        if needs & {"motion", "matches"} and making.given.matches is None:
            start = time.perf_counter()
            matches = find_matches_of_rig(making.images, rig, shutter.scanning, chain)
            making.given = replace(making.given, matches=matches)
            making.spent["matching"] = time.perf_counter() - start
        first, *others = (float(each.row) for each in making.asked)
        found = correct_four(
            making.images,
            rig,
            shutter.readout_ratio,
            replace(chain, target_row=first),
            given=making.given,
            views=(VIEW,),
            scanning=shutter.scanning,
            rows=others,
        )
        _share(making, found)
        steps = {"matching": {"motion", "matches"}, "motion": {"motion"}, "depth": {"depth"}}
        spent = sum(making.spent.get(step, 0.0) for step, of in steps.items() if needs & of)
        return [found.frames, *found.at_rows], found.seconds["correction"] + spent


def _share(making: Making, found: CorrectedFrames) -> None:
    """What need not be found again, and how long it took."""
    if making.given.motion is None and found.motion is not None:
        making.spent["motion"] = found.seconds["motion"]
    if making.given.pairs is None and found.pairs is not None:
        making.spent["depth"] = found.seconds["depth"]
    motion, pairs = found.motion or making.given.motion, found.pairs or making.given.pairs
    making.given = replace(making.given, motion=motion, pairs=pairs)


# Marking


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueFrame:
    """What a corrected frame is compared with."""

    name: str
    """Of the row: ``first``, ``middle`` or ``last``."""
    picture: Picture
    """(H, W, 3) of a global shutter."""
    common: NDArray[np.bool_]
    """(H, W) see ``TruePictures.common``."""
    parts: Parts
    """Of the common pixels."""

    @classmethod
    def all_of(cls, pictures: TruePictures) -> list[TrueFrame]:
        """Read those that are asked of a problem."""
        found, commons = list[TrueFrame](), pictures.commons()
        for each, common in zip(pictures.asked, commons, strict=True):
            image = pictures.frame(each.row)
            parts = parts_within(CorrectionTrack.part_score, image, each.row, common)
            name = each.stem.rpartition("_")[2]
            found.append(cls(name=name, picture=Picture(image), common=common, parts=parts))
        return found


def frame_scores(
    truths: Sequence[TrueFrame],
    frames: Sequence[Frame] | None,
    rows: Sequence[str] = CorrectionTrack.rows,
    *,
    flips: bool = True,
) -> Numbers:
    """Of corrected frames, one for each that is asked; None: a failure. Means over these, of dB too.

    ``rows`` are those at whose times they may be asked; ``flips``: FLIP too, which takes most of the time.
    """
    scores, squares = list[Numbers](), SquareErrors(CorrectionTrack.part_score)
    for number, true in enumerate(truths):
        squares.add(None if frames is None else frames[number][0], true.picture.image, true.parts)
        scores.append(_WORST_FRAME if frames is None else _frame(*frames[number], true, flips))
    keys = [key for key in _WORST_FRAME if flips or not key.startswith("flip_")]
    found = {key: float(np.mean([each[key] for each in scores])) for key in keys}
    by_row = {f"psnr_{name}": math.nan for name in rows}
    by_row |= {f"psnr_{true.name}": each["psnr"] for true, each in zip(truths, scores, strict=True)}
    return {**found, **by_row, **squares.scores(), "error": 1.0 - found["ssim"]}


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
    # Where no pixel counts there is no value; where SSIM is below 0, nothing of the picture is left.
    found = {key: _WORST_FRAME[key] if math.isnan(value) else value for key, value in found.items()}
    found |= {key: max(value, 0.0) for key, value in found.items() if key.startswith("ssim")}
    return {**found, **(_flips(image, truth.image, masks) if flips else {})}


def _flips(image: NDArray[np.uint8], truth: NDArray[np.uint8], masks: dict[str, Any]) -> Numbers:
    """NaN where the package that computes it has no wheel."""
    errors, names = flip(image, truth), ("flip_common", "flip_covered", "flip_all")
    if errors is None:
        return dict.fromkeys(names, math.nan)
    return {
        name: float(np.mean(errors[mask])) if np.any(mask) else 1.0
        for name, mask in zip(names, masks.values(), strict=True)
    }


# What may be meant


def _readings(
    image: NDArray[np.uint8], truth: NDArray[np.uint8], others: dict[str, NDArray[np.uint8]]
) -> Iterator[str]:
    limit = _SMALLER * _squared(image, truth)
    readings: dict[str, NDArray[Any]] = {
        "red and blue are swapped; PNG files hold RGB": image[..., ::-1],
        "it is upside down": image[::-1],
        "it is mirrored": image[:, ::-1],
        "it stands a row too low": np.roll(image, -1, axis=0),
        "it stands a row too high": np.roll(image, 1, axis=0),
        "it stands a column too far right": np.roll(image, -1, axis=1),
        "it stands a column too far left": np.roll(image, 1, axis=1),
    }
    for words, reading in readings.items():
        if _squared(reading, truth) < limit:
            yield words
            return
    for stem, other in others.items():
        if _squared(image, other) < limit:
            yield f"it is nearer to the truth of {stem}: the rows are exchanged"


def _squared(image: NDArray[Any], truth: NDArray[np.uint8]) -> float:
    """Mean squared difference of the pixels that are not black, but for the rim, which a shift brings in."""
    counted = np.any(image > 0, axis=-1)
    counted[[0, -1]] = counted[:, [0, -1]] = False
    difference = image[counted].astype(np.float32) - truth[counted]
    return float(np.mean(difference * difference)) if difference.size else np.inf


# Corrected frames by where things stand in them: what filters can do to a picture moves nothing.
#
# A frame's noise, blur and vignetting are no matter of the shutter, yet they are most of what SSIM counts on a
# real sensor. So windows of the frame and of the truth, blurred alike, are laid over each other where they
# correlate most, and what counts is by how far they stand off. Dense flow would not do: on a noisy frame it errs
# by as much as a corrected frame is off; nor phase correlation, which undoes the blur.

LIMIT_PX = 2.0
"""A window that stands farther off has no part in the score."""
WINDOW_PX, _STEP_PX, _REACH_PX = 64, 32, 4
"""Side of a window, from one to the next, and how far it is looked for."""
_BLUR_PX = 3.0
"""Standard deviation of the blur of both pictures."""
_LOOK_PX = 2.0
"""Standard deviation of the blur under which pictures are compared: white noise is left with a seventh."""
_LOOK_CONSTANTS = 0.1
"""Factor of SSIM's constants: the blur takes contrast away, and beside the whole ones a tenth of it would do."""
_TEXTURE = 5.0
"""Grey levels by which the truth must deviate around a pixel that counts: elsewhere nothing tells where it is."""
_LEAST = 0.25
"""Share of a window's pixels that must count."""


class PlacedCorrection(CorrectionTrack):
    """Rolling-shutter frames as a global shutter would have taken them, ranked by geometry."""

    name, id = "correction-2", "correction-2"
    title = "Corrected frames, by where things stand"
    scores = (
        Score(
            key="placed",
            title="placed",
            hint="1 where textured common pixels stand right, 0 from 2 px on and where they are not drawn",
            kind="share",
            better="higher",
        ),
        *(score for score in CorrectionTrack.scores if not score.key.startswith("flip_")),
    )
    flips = False
    error, error_title = "misplaced", "1 - placed"
    smoke: ClassVar[tuple[str, ...]] = ()

    def chain(self, card: str) -> CardChain:
        return super().chain(card).choosing()

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], Numbers]:
        others, true = super().scorer(truth, pictures), TrueFrame.all_of(pictures)

        def scores_of(submission: Submission, success: bool) -> Numbers:
            folder = submission.folder / FOLDER
            drawn = [read_answer_frame(folder, pictures, each) for each in pictures.asked] if success else None
            share = 0.0 if drawn is None else placed(true, drawn)
            return {**others(submission, success), "placed": share, "misplaced": 1.0 - share}

        return scores_of


class SeenCorrection(PlacedCorrection):
    """Rolling-shutter frames as a global shutter of the same sensor would have taken them."""

    name, id = "correction-3", "correction-3"
    title = "Corrected frames, by where things stand and how they look"
    scores = (
        Score(
            key="corrected",
            title="placed x picture",
            hint="the product of the two: what stands in its place and looks like the scene there",
            kind="share",
            better="higher",
        ),
        *(score for score in PlacedCorrection.scores if score.key == "placed"),
        Score(
            key="picture",
            title="picture",
            hint="SSIM of blurred images to what a global shutter of the same sensor shows, 0 where not drawn",
            kind="share",
            better="higher",
        ),
        *(score for score in PlacedCorrection.scores if score.key != "placed"),
    )
    error, error_title = "uncorrected", "1 - placed x picture"
    beside = ("placed", "picture", "failure")

    def asked(self, sequence: Rendered) -> tuple[Asked, ...]:
        """The truth is what the same sensor expects under a global shutter, without noise.

        Raises:
            RsbenchError: the dataset has a sensor and no such images.
        """
        asked = super().asked(sequence)
        if sequence.sensor is None:
            return asked
        if not sequence.exposed_twins:
            raise RsbenchError(
                f"{sequence.folder}: has no global-shutter images of its sensor, which {self.id} compares with; "
                "render the dataset again with exposed_twins = true in its card"
            )
        side, frame = VIEW
        return tuple(each._replace(file=exposed_file(side, frame + sequence.first, each.row)) for each in asked)

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], Numbers]:
        others, true = super().scorer(truth, pictures), TrueFrame.all_of(pictures)

        def scores_of(submission: Submission, success: bool) -> Numbers:
            folder, found = submission.folder / FOLDER, others(submission, success)
            drawn = [read_answer_frame(folder, pictures, each) for each in pictures.asked] if success else None
            looks = 0.0 if drawn is None else seen_alike(true, drawn)
            both = found["placed"] * looks
            return {**found, "picture": looks, "corrected": both, "uncorrected": 1.0 - both}

        return scores_of


def seen_alike(truths: Sequence[TrueFrame], frames: Sequence[Frame]) -> float:
    """The mean over frames of the SSIM to their truth, both blurred, over their common pixels; at least 0.

    What is not drawn counts 0. The blur leaves a sensor's noise without weight, so that a filter gains nothing;
    contrast, colour, strong noise and holes that were filled with anything keep theirs.
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
    """The mean over frames of the share of their textured common pixels that are drawn, each by its window's
    distance from its place: 1 at 0, 0 from ``LIMIT_PX`` on; 1 where no window has enough texture."""
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
    """Of the place where a window is found from the middle of what is around it, px; infinite at the rim."""
    found = cv2.matchTemplate(around, window, cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(np.argmax(found)), found.shape)
    if not (0 < y < 2 * _REACH_PX and 0 < x < 2 * _REACH_PX):
        return math.inf
    down = _top(found[y - 1 : y + 2, x])
    across = _top(found[y, x - 1 : x + 2])
    return math.hypot(float(y) + down - _REACH_PX, float(x) + across - _REACH_PX)


def _top(three: NDArray[np.float32]) -> float:
    """Where the parabola through three neighbours is largest, from the middle one."""
    before, middle, after = map(float, three)
    bend = before - 2.0 * middle + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


def _blurred(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), dtype=np.float32)


# The track of corrected frames for methods that see one camera, beside those of a rig on the same frames.
#
# What a corrector needs is found from the two frames of that camera alone, by dense flow: matches, and a motion
# whose translation has no length. Correctors that need the depth of a rig run in the chain of ``correction``, and
# their entries say that they use the other camera: what it is worth.

_SIDE = VIEW[0]
_LAST = {"key": "psnr_last", "title": "PSNR last", "hint": "of the last row's time, common pixels"}


class MonoCorrectionTrack(CorrectionTrack):
    """Rolling-shutter frames of one camera as a global shutter would have taken them."""

    name, id = "correction-mono", "correction-mono-1"
    title = "Corrected frames of one camera"
    allowed = (*CorrectionTrack.allowed, "gyro")
    given = "the four rolling-shutter frames; samples of a gyroscope where the dataset has the channel imu"
    rows = ("first", "middle", "last")
    scores = tuple(
        each
        for score in CorrectionTrack.scores
        for each in ((score, replace(score, **_LAST)) if score.key == "psnr_middle" else (score,))
    )
    smoke = ("mono-fusion", "flow-scaled", "zhuang", "fusion", "uncorrected", "fusion-true", ORACLE)

    def problems(self, data: Path | None, seed_file: Path | None, count: int) -> Iterator[Problem]:
        assert data is not None
        sequences = zip(bare_problems(data), read_pairs(data), strict=True)
        return islice((with_gyro(problem, sequence) for problem, sequence in sequences), count)

    def shown(self, sequence: Rendered) -> tuple[str, ...]:
        return (MEASURED,) if GYRO in sequence.channels else ()

    def chain(self, card: str) -> CardChain:
        made = super().chain(card)
        spec = made.options.corrector.component.spec
        if _of_a_rig(spec):
            return made.choosing()
        others = [name for name, there in (("time", "time" in spec.sees), ("gyro", "gyro" in spec.needs)) if there]
        return made._replace(uses=("readout", "images", *others))

    def corrected(self, making: Making, chain: CorrectionOptions) -> tuple[list[dict[View, Fused]], float]:
        spec = chain.corrector.component.spec
        if _of_a_rig(spec):
            return super().corrected(making, chain)
        problem, known = making.problem, Given()
        images = {view: image for view, image in making.images.items() if view[0] == _SIDE}
        if spec.needs & {"motion", "matches"}:
            making.alone = making.alone or _alone(making, chain)
            known = making.alone
        gyro = problem.correspondences.gyro
        known = replace(known, gyro=gyro if len(gyro) > 0 else None)
        rig, rows, start = (
            problem.rig.about(_SIDE),
            [float(each.row) for each in making.asked],
            time.perf_counter(),
        )
        frames = correct_known_rows(images, known, rig, problem.shutter, chain, (VIEW,), 0.0, rows)
        spent = making.spent.get("alone", 0.0) if spec.needs & {"motion", "matches"} else 0.0
        return frames, time.perf_counter() - start + spent


def _of_a_rig(spec: CorrectorSpec) -> bool:
    """Whether a corrector asks for more than one camera: for depth, or by itself for frames of the other one."""
    return "depth" in spec.needs or ("stereo" in spec.sees and not spec.needs & {"motion", "matches"})


def _alone(making: Making, chain: CorrectionOptions) -> Given:
    """Matches of the asked camera over time, and its motion, whose translation has length 1.

    Raises:
        RsbenchError: its frames show none.
    """
    start = time.perf_counter()
    frames = [making.images[_SIDE, frame] for frame in FRAMES]
    flows = find_flows(frames)
    if reason := refusal(frames, flows):
        raise RsbenchError(reason)
    matches = flow_matches(flows, np.random.default_rng(chain.seed))
    rig, shutter = making.problem.rig, making.problem.shutter
    found = find_own_motion(flows, rig, shutter, _SIDE, chain.robust, chain.seed)
    if found.own.motion is None:
        raise RsbenchError(found.reason)
    making.spent["alone"] = time.perf_counter() - start
    return Given(matches=Correspondences(left=matches), motion=found.own.motion)
