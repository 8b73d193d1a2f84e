"""Scores of depth maps and corrected frames, one row for each problem: formulas of docs/reference/protocols.md.

The formulas themselves are those of ``rsbench.vision``. What is unknown in a depth map is wrong there, and what a
method did not draw is black: nobody gains by leaving out what is difficult.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.leaderboard.picture_parts import (
    Parts,
    SquareErrors,
    depth_parts,
    frame_parts,
    shares,
)
from rsbench.benchmark.leaderboard.true_pictures import TruePictures
from rsbench.core.rig import StereoRig
from rsbench.vision.flow import dense_flow
from rsbench.vision.published_quality import flip, ssim_deepunroll, ssim_uniform
from rsbench.vision.quality import Picture, psnr_within, ssim_within
from rsbench.vision.stereo_depth import depth_metrics

Numbers = dict[str, float]
Frame = tuple[NDArray[np.uint8], NDArray[np.bool_]]
"""An image (H, W, 3) and where something was drawn (H, W)."""
_LIMITS_PX = (1, 2, 3)
_WORST_PART: Numbers = {
    **{f"bad_{n}": 1.0 for n in _LIMITS_PX},
    "coverage": 0.0,
    "abs_rel": math.inf,
    "rmse_m": math.inf,
}
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


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueDepth:
    """What depth maps of a problem are compared with."""

    rig: StereoRig
    depth: NDArray[np.float32]
    """(H, W) m, 0 where there is no surface."""
    seen: NDArray[np.bool_]
    """(H, W) by both cameras."""
    parts: Parts
    """Of the surface."""

    @classmethod
    def of(cls, pictures: TruePictures) -> TrueDepth:
        """Read it."""
        depth, rig = pictures.depth(), pictures.sequence.rig
        parts = depth_parts(pictures.rolling(), depth > 0.0)
        return cls(rig=rig, depth=depth, seen=pictures.seen_by_both(depth), parts=parts)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueFrame:
    """What a corrected frame is compared with."""

    name: str
    """Of the row: ``first`` or ``middle``."""
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
            parts = frame_parts(image, common, each.row)
            name = each.stem.rpartition("_")[2]
            found.append(cls(name=name, picture=Picture(image), common=common, parts=parts))
        return found


def depth_scores(true: TrueDepth, depth: NDArray[np.float32] | None) -> Numbers:
    """Of a depth map (H, W), m, 0 unknown; None: a failure."""
    truth, rig, seen = true.depth, true.rig, true.seen
    found = part_scores(depth, truth, rig, np.ones_like(seen))
    for name, part in (("visible", seen), ("occluded", ~seen)):
        scores = part_scores(depth, truth, rig, part)
        found |= {f"{key}_{name}": scores[key] for key in ("bad_1", "abs_rel", "rmse_m")}
    wrong = np.ones_like(seen) if depth is None else _wrong(depth, truth, rig)
    found |= shares(true.parts, wrong)
    sky = truth == 0.0
    invented = 1.0 if depth is None else float(np.mean(depth[sky] > 0.0)) if np.any(sky) else 0.0
    return {**found, "on_sky": invented}


def _wrong(depth: NDArray[np.float32], truth: NDArray[np.float32], rig: StereoRig) -> NDArray[np.bool_]:
    """(H, W) where the disparity is off by more than 1 px, or not known; of a surface."""
    found, true = (rig.disparity(np.where(each > 0.0, each, 1.0).astype(np.float64)) for each in (depth, truth))
    return (depth <= 0.0) | (np.abs(found - true) > 1.0)


def part_scores(
    depth: NDArray[np.float32] | None, truth: NDArray[np.float32], rig: StereoRig, part: NDArray[np.bool_]
) -> Numbers:
    """Of some pixels. Where none of them shows a surface nothing is wrong; errors in metres do not exist."""
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


def frame_scores(truths: Sequence[TrueFrame], frames: Sequence[Frame] | None) -> Numbers:
    """Of corrected frames, one for each that is asked; None: a failure. Means over these, of dB too."""
    scores, squares = list[Numbers](), SquareErrors()
    for number, true in enumerate(truths):
        squares.add(None if frames is None else frames[number][0], true.picture.image, true.parts)
        scores.append(_WORST_FRAME if frames is None else _frame(*frames[number], true))
    found = {key: float(np.mean([each[key] for each in scores])) for key in _WORST_FRAME}
    by_row = {f"psnr_{name}": math.nan for name in ("first", "middle")}
    by_row |= {f"psnr_{true.name}": each["psnr"] for true, each in zip(truths, scores, strict=True)}
    return {**found, **by_row, **squares.scores(), "error": 1.0 - found["ssim"]}


def _frame(image: NDArray[np.uint8], drawn: NDArray[np.bool_], true: TrueFrame) -> Numbers:
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
    return {**found, **_flips(image, truth.image, masks)}


def _flips(image: NDArray[np.uint8], truth: NDArray[np.uint8], masks: dict[str, Any]) -> Numbers:
    """NaN where the package that computes it has no wheel."""
    errors, names = flip(image, truth), ("flip_common", "flip_covered", "flip_all")
    if errors is None:
        return dict.fromkeys(names, math.nan)
    return {
        name: float(np.mean(errors[mask])) if np.any(mask) else 1.0
        for name, mask in zip(names, masks.values(), strict=True)
    }
