"""The track that asks for corrected frames: formulas of docs/reference/protocols.md, those of ``rsbench.vision``.

What a method did not draw is black: nobody gains by leaving out what is difficult. Entries that the board makes
itself close narrow holes, as the command does.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.leaderboard.marking import Numbers
from rsbench.benchmark.leaderboard.picture_files import FOLDER, frame_png, read_answer_frame
from rsbench.benchmark.leaderboard.picture_parts import PARTINGS, Parts, SquareErrors, parts_within
from rsbench.benchmark.leaderboard.picture_parts import columns as parting_columns
from rsbench.benchmark.leaderboard.picture_running import CardChain, Making
from rsbench.benchmark.leaderboard.picture_track import PictureTrack
from rsbench.benchmark.leaderboard.splits import Split, Truth
from rsbench.benchmark.leaderboard.submissions import Submission
from rsbench.benchmark.leaderboard.track import FAILED, ORACLE, SECONDS, Score
from rsbench.benchmark.leaderboard.true_pictures import VIEW, Asked, TruePictures
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.dataset import sequence as sequences
from rsbench.dataset.layout import picture_file
from rsbench.pipeline.chain import CorrectedFrames, Given, correct_four
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.pipeline.frame_matches import find_matches_of_rig
from rsbench.storage.files import write_bytes
from rsbench.vision.closing import finished
from rsbench.vision.corrector import demand_corrected, load_corrector
from rsbench.vision.flow import dense_flow
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.published_quality import flip, ssim_deepunroll, ssim_uniform
from rsbench.vision.quality import Picture, psnr_within, ssim_within

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

    def asked(self, sequence: sequences.Sequence) -> tuple[Asked, ...]:
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
            image, _ = read_answer_frame(folder, truth, each)
            if wanted and split.public:
                others = {k.stem: truth.pictures.frame(k.row) for k in truth.pictures.asked if k != each}
                found |= set(_readings(image, truth.pictures.frame(each.row), others))
        return found

    def scorer(self, truth: Truth, pictures: TruePictures) -> Callable[[Submission, bool], Numbers]:
        true = TrueFrame.all_of(pictures)

        def scores_of(submission: Submission, success: bool) -> Numbers:
            folder = submission.folder / FOLDER
            drawn = [read_answer_frame(folder, truth, each) for each in pictures.asked] if success else None
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
