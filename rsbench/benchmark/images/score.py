"""Scores of stored predictions against the truth; no solver runs here."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import VIEWS, depth_of, read_motion
from rsbench.benchmark.scoring import pose_errors
from rsbench.core.motion import Motion
from rsbench.core.rig import Side
from rsbench.dataset.files import load_arrays, read_json
from rsbench.dataset.sequence import Sequence
from rsbench.vision.correction import Corrected, correct_frame
from rsbench.vision.quality import psnr, ssim
from rsbench.vision.stereo_depth import depth_metrics, seen_by_other

Row = dict[str, Any]


def score_poses(sequence: Sequence, folder: Path) -> list[Row]:
    """One row per solver: e_R, e_T (degrees), e_s; a failure scores the worst value of each."""
    rows = []
    for path in sorted((folder / "motion").glob("*.json")):
        answer = read_json(path)
        rows.append(
            {
                "sequence": sequence.name,
                "solver": answer["solver"],
                "shutter": answer["shutter"],
                "uses": "+".join(answer["uses"]),
                "success": answer["success"],
                **_pose_errors(sequence, answer),
                "inliers": sum(answer["inliers"].values()),
                "iterations": answer["iterations"],
                "seconds": answer["seconds"],
                "reason": answer["reason"],
            }
        )
    return rows


def _pose_errors(sequence: Sequence, answer: Row) -> dict[str, float]:
    nothing = [np.nan] * 3
    errors = pose_errors(
        answer["w"] or nothing, answer["d"] or nothing, true_w=sequence.motion.w, true_d=sequence.motion.d,
        rig=sequence.rig, success=answer["success"], metric=answer["metric"],
        reference_point=answer["reference_point"],
    )  # fmt: skip
    return {name: float(value) for name, value in errors.items()}


def score_depth(sequence: Sequence, folder: Path) -> list[Row]:
    """Rows per view: SGM depth against the truth, in the row's own camera.

    Over all surface pixels, those that the other camera sees, and those that it does not.
    """
    disparities = load_arrays(folder / "disparity.npz")
    rows = []
    for side, frame in VIEWS:
        truth = sequence.depth("rs", side, frame)
        estimate = depth_of(disparities[f"{side}_{frame}"], sequence.rig)
        other: Side = "right" if side == "left" else "left"
        seen = seen_by_other(truth, sequence.depth("rs", other, frame), sequence.rig, side)
        for name, part in (("all", None), ("visible", seen), ("occluded", ~seen)):
            scores = depth_metrics(estimate, truth, sequence.rig, part)
            rows.append({"sequence": sequence.name, "side": side, "frame": frame, "pixels": name, **scores})
    return rows


def score_correction(sequence: Sequence, folder: Path, solver: str) -> list[Row]:
    """Rows per view and method: the estimate, the oracles that replace depth or motion by the truth, and nothing.

    Every method is scored on the pixels that it covers, beside the uncorrected frame on the same pixels, and on
    the pixels that all methods cover.
    """
    disparities = load_arrays(folder / "disparity.npz")
    motions = {"estimated": read_motion(folder, solver), "true": sequence.motion}
    rows = []
    for side, frame in VIEWS:
        image, truth = sequence.image("rs", side, frame), sequence.image("gs", side, frame)
        true_depth = sequence.depth("rs", side, frame)
        depths = {"SGM": depth_of(disparities[f"{side}_{frame}"], sequence.rig), "true": true_depth}
        corrected = {
            (depth, motion): _correct(
                sequence, image, depths[depth], motions[motion], side, frame, depth == "true"
            )
            for depth, motion in product(depths, motions)
        }
        common = np.logical_and.reduce([result.mask for result in corrected.values() if result is not None])
        for (depth, motion), result in corrected.items():
            row = {"sequence": sequence.name, "side": side, "frame": frame, "depth": depth, "motion": motion}
            rows.append(row | _image_scores(result, image, truth, common))
    return rows


def _correct(
    sequence: Sequence,
    image: NDArray[np.uint8],
    depth: NDArray[np.float32],
    motion: Motion | None,
    side: Side,
    frame: int,
    knows_sky: bool,
) -> Corrected | None:
    if motion is None:
        return None
    sky = depth == 0 if knows_sky else None
    return correct_frame(image, depth, sequence.rig, sequence.shutter, motion, side, frame, sky_mask=sky)


def _image_scores(
    result: Corrected | None, image: NDArray[np.uint8], truth: NDArray[np.uint8], common: NDArray[np.bool_]
) -> Row:
    if result is None:
        names = ("psnr", "ssim", "psnr_uncorrected", "ssim_uncorrected", "psnr_common", "psnr_uncorrected_common")
        return {"success": False, "coverage": 0.0, **dict.fromkeys(names, float("nan"))}
    return {
        "success": True,
        "coverage": float(np.mean(result.mask)),
        "psnr": psnr(result.image, truth, result.mask),
        "ssim": ssim(result.image, truth, result.mask),
        "psnr_uncorrected": psnr(image, truth, result.mask),
        "ssim_uncorrected": ssim(image, truth, result.mask),
        "psnr_common": psnr(result.image, truth, common),
        "psnr_uncorrected_common": psnr(image, truth, common),
    }
