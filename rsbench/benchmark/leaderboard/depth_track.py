"""The track of depth maps; docs/reference/protocols.md has the formulas, which ``rsbench.vision`` implements.

Unknown depth counts as wrong, so that leaving out difficult pixels does not raise a score.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.picture_track import CardChain, PictureTrack, SharedWork, drawn_oracle
from rsbench.benchmark.leaderboard.pictures import (
    FARTHEST,
    PICTURES,
    VIEW,
    Parts,
    RequestedPicture,
    TruePictures,
    parts_within,
    read_answer_depth,
    shares,
)
from rsbench.benchmark.leaderboard.splits import Frames
from rsbench.benchmark.leaderboard.track import FAILED, ORACLE, SECONDS, Numbers, Score, Submission, Track
from rsbench.capture.hypotheses import KnownInputs
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.so3 import FloatArray
from rsbench.dataset.layout import picture_file
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import Given
from rsbench.pipeline.frame_capture import know_matches, match_frames
from rsbench.pipeline.frame_depth import CorrectionOptions, metres, motion_disparities
from rsbench.pipeline.frame_motion import solve_frames
from rsbench.storage.files import write_depth
from rsbench.vision.stereo_depth import depth_metrics
from rsbench.vision.stereo_matcher import load_matcher, needs_motion, sensor_disparities

_LIMITS_PX = (1, 2, 3)
_WORST_PART: Numbers = {
    **{f"bad_{n}": 1.0 for n in _LIMITS_PX},
    "coverage": 0.0,
    "abs_rel": math.inf,
    "rmse_m": math.inf,
}
_NEAR = 0.1
"""Largest median relative error with which a depth map, after undoing a mistake, agrees with the truth."""
_RIGHT = 0.01
"""Median relative error below which no likely mistake is reported."""
_SMALLER = 0.25
"""A likely mistake is reported if undoing it reduces the error below this share."""
_FAR_M = 300.0
"""A larger median depth is probably not in metres."""
_DEPTH = (
    Score("bad_1", "bad@1", "share of surface wrong by over 1 px of disparity or unknown", "share"),
    *(Score(f"bad_{limit}", f"bad@{limit}", f"the same beyond {limit} px", "share") for limit in (2, 3)),
    Score("bad_1_visible", "bad@1 visible", "bad@1 of what the right camera sees", "share"),
    Score("bad_1_occluded", "bad@1 occluded", "bad@1 of what it does not see", "share"),
    Score("coverage", "known", "share of surface with a depth", "share", "higher"),
    Score("on_sky", "on sky", "share of pixels without a surface that have a depth", "share"),
    FAILED,
    Score("abs_rel", "AbsRel", "median of the mean relative error, where known", "median"),
    Score("rmse_m", "RMSE (m)", "median of the root mean squared error, where known", "median"),
    *(
        Score(f"{key}_{part}", f"{title} {part}", f"{title} of the {part} part", "median")
        for part in ("visible", "occluded")
        for key, title in (("abs_rel", "AbsRel"), ("rmse_m", "RMSE"))
    ),
    SECONDS,
)


def _constant(pictures: TruePictures, place: Path) -> None:
    depth = pictures.depth()
    surface = depth[depth > 0.0]
    _flat(pictures, place, float(np.median(surface)) if surface.size else 0.0)


def _flat(pictures: TruePictures, place: Path, depth_m: float) -> None:
    (each,) = pictures.requested
    write_depth(place / f"{each.stem}.exr", np.full(pictures.size[::-1], depth_m, dtype=np.float32))


class DepthTrack(PictureTrack):
    """A track of depth maps of rolling-shutter frames."""

    part_score, part_title = "bad_1", "bad@1"

    def requested(self, sequence: Sequence) -> tuple[RequestedPicture, ...]:
        file = picture_file("rs", VIEW[0], VIEW[1] + sequence.first, depth=True)
        return (RequestedPicture(f"{VIEW[0]}_{VIEW[1]}", 0, file, (".exr", ".png")),)

    def read(self, submission: Submission, pictures: TruePictures) -> NDArray[np.float32]:
        return read_answer_depth(submission.folder / PICTURES, pictures, submission.header.png_unit_m)

    def hints(self, drawn: NDArray[np.float32], pictures: TruePictures, public: bool) -> Iterable[str]:
        if public:
            return _mistakes(drawn, pictures)
        far = np.any(drawn > 0.0) and np.median(drawn[drawn > 0.0]) > _FAR_M
        return (f"half of it is above {_FAR_M:g} m; depth is in metres, not millimetres",) if far else ()

    def truth_of(self, pictures: TruePictures) -> TrueDepth:
        depth, rig = pictures.depth(), pictures.sequence.rig
        parts = parts_within(self.part_score, pictures.rolling(), 0, depth > 0.0)
        return TrueDepth(rig=rig, depth=depth, seen=pictures.seen_by_both(depth), parts=parts)

    def scores_of(self, true: TrueDepth, drawn: NDArray[np.float32] | None) -> Numbers:
        truth, rig, seen = true.depth, true.rig, true.seen
        found = part_scores(drawn, truth, rig, np.ones_like(seen))
        for name, part in (("visible", seen), ("occluded", ~seen)):
            scores = part_scores(drawn, truth, rig, part)
            found |= {f"{key}_{name}": scores[key] for key in ("bad_1", "abs_rel", "rmse_m")}
        wrong = np.ones_like(seen) if drawn is None else _wrong(drawn, truth, rig)
        found |= shares(true.parts, wrong)
        sky = truth == 0.0
        invented = 1.0 if drawn is None else float(np.mean(drawn[sky] > 0.0)) if np.any(sky) else 0.0
        return {**found, "on_sky": invented}

    def draw(self, pictures: TruePictures, place: Path) -> None:
        _flat(pictures, place, 10.0)

    def chain(self, card: str) -> CardChain:
        matcher = load_matcher(card)
        uses = self.allowed if needs_motion(matcher) else ("images", "stereo")
        return CardChain(CorrectionOptions(matcher=matcher), matcher, matcher.key, uses)

    def make(self, work: SharedWork, chain: CorrectionOptions, place: Path) -> dict[str, Any]:
        rig, (side, frame) = work.problem.rig, VIEW
        shared = 0.0
        try:
            if needs_motion(chain.matcher):
                motion = _motion(work, chain)
                shared, start = sum(work.spent.values()), time.perf_counter()
                found = motion_disparities(chain.matcher, work.images, rig, work.problem.shutter, motion, (VIEW,))
                depth = metres(found[VIEW], rig, VIEW[0])
            else:
                start = time.perf_counter()
                pair = [work.images[each, frame] for each in SIDES]
                disparity = sensor_disparities(chain.matcher, pair[0], pair[1], rig)[SIDES.index(side)]
                depth = np.nan_to_num(rig.depth(disparity), nan=0.0)
        except RsbenchError as error:
            return {"success": False, "reason": str(error)[:300]}
        seconds = shared + time.perf_counter() - start
        place.mkdir(parents=True)
        (each,) = work.requested
        write_depth(place / f"{each.stem}.exr", np.where(depth > FARTHEST, 0.0, depth).astype(np.float32))
        return {"seconds": round(seconds, 4)}


def _motion(work: SharedWork, chain: CorrectionOptions) -> Motion:
    """Estimate the motion with the default solver; it is the same for all matchers, and computed once.

    Raises:
        RsbenchError: see ``match_frames``, ``know_matches`` and ``solve_frames``.
    """
    rig, shutter, start = work.problem.rig, work.problem.shutter, time.perf_counter()
    if work.known.motion is None:
        matches = match_frames(work.images, rig, chain, shutter.scanning)
        matched = time.perf_counter()
        found = solve_frames(know_matches(matches, rig, KnownInputs.of(shutter), chain), chain)
        work.known = Given(motion=found.motion)
        work.spent = {"matching": matched - start, "motion": time.perf_counter() - matched}
    assert work.known.motion is not None
    return work.known.motion


# Marking


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueDepth:
    """Ground truth of the depth maps of a problem."""

    rig: StereoRig
    depth: NDArray[np.float32]
    """(H, W) m, 0 where there is no surface."""
    seen: NDArray[np.bool_]
    """(H, W) pixels whose scene point both cameras see."""
    parts: Parts
    """Parts of the surface."""


def _wrong(depth: NDArray[np.float32], truth: NDArray[np.float32], rig: StereoRig) -> NDArray[np.bool_]:
    """Return the mask (H, W) of pixels with unknown disparity, or wrong by over 1 px; valid only on surfaces."""
    found, true = (rig.disparity(np.where(each > 0.0, each, 1.0).astype(np.float64)) for each in (depth, truth))
    return (depth <= 0.0) | (np.abs(found - true) > 1.0)


def part_scores(
    depth: NDArray[np.float32] | None, truth: NDArray[np.float32], rig: StereoRig, part: NDArray[np.bool_]
) -> Numbers:
    """Return the scores of the pixels in ``part``; if none has a surface, shares are perfect and errors NaN."""
    if depth is None:
        return _WORST_PART
    surface = part & (truth > 0.0)
    if not np.any(surface):
        return {key: 0.0 if key.startswith("bad") else math.nan for key in _WORST_PART} | {"coverage": 1.0}
    scores = depth_metrics(depth, truth, rig, part)
    known = surface & (depth > 0.0)
    if not np.any(known):
        return _WORST_PART
    error = np.abs(depth[known].astype(np.float64) - truth[known]) / truth[known]
    return {
        **{f"bad_{n}": 1.0 - scores["coverage"] * (1.0 - scores[f"bad_{n}px"]) for n in _LIMITS_PX},
        "coverage": scores["coverage"],
        "abs_rel": float(np.mean(error)),
        "rmse_m": scores["rmse_m"],
    }


# Likely mistakes


def _mistakes(depth: NDArray[np.float32], pictures: TruePictures) -> Iterator[str]:
    sequence = pictures.sequence
    rig, true = sequence.rig, pictures.depth()
    product = rig.camera.fx * rig.baseline
    along = np.linalg.norm(rig.camera.unproject(rig.camera.pixel_grid()), axis=-1)
    both = (depth > 0.0) & (true > 0.0)
    if not np.any(both):
        return
    submitted, z = (each[both].astype(np.float64) for each in (depth, true))
    error = _error(submitted, z)
    if error < _RIGHT:
        return
    readings: dict[str, Callable[[], FloatArray]] = {
        "it is in millimetres; depth is in metres": lambda: submitted / 1000.0,
        "it is in centimetres; depth is in metres": lambda: submitted / 100.0,
        "it is disparity in px; depth is fx * baseline / disparity": lambda: product / submitted,
        "it is inverse depth, 1 / m, not depth": lambda: 1.0 / submitted,
        "it is the distance along the ray; depth is z of the camera": lambda: submitted / along[both],
    }
    for words, reading in readings.items():
        if _error(reading(), z) < min(_NEAR, _SMALLER * error):
            yield words
            return
    before = sequence.depth("rs", "left", 0)
    there = (depth > 0.0) & (before > 0.0)
    if _error(depth[there].astype(np.float64), before[there].astype(np.float64)) < _SMALLER * error:
        yield "it is that of frame 0, not of frame 1"
    elif _error(submitted * np.median(z / submitted), z) < min(_NEAR, _SMALLER * error):
        yield "it is right up to a factor; depth is in metres"


def _error(depth: FloatArray, truth: FloatArray) -> float:
    """Return the median relative error of depth."""
    return float(np.median(np.abs(depth - truth) / truth)) if truth.size else np.inf


TRACKS: tuple[Track, ...] = (
    DepthTrack(
        name="depth",
        id="depth-1",
        title="Depth of rolling-shutter frames",
        allowed=("readout", "images", "stereo", "time"),
        given="the four rolling-shutter frames",
        inputs=Frames(),
        scores=_DEPTH,
        error="bad_1",
        error_title="bad@1",
        exact=dict.fromkeys(("abs_rel", "abs_rel_visible", "abs_rel_occluded"), 1e-6),
        oracles=(
            drawn_oracle("constant", ORACLE, "The median true depth of each sequence, everywhere", _constant),
        ),
        smoke=("sgm", "sweep", "sgm-plain", "constant", ORACLE),
        smoke_metrics=(
            *(f"bad_{part}" for part in ("1", "2", "3", "1_visible", "1_occluded")),
            *("coverage", "on_sky", "abs_rel", "rmse_m"),
        ),
    ),
)
