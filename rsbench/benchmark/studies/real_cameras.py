"""Comparison of the default pipeline on frames of a realistic camera and of an ideal camera.

Both cameras have the same motion in the same scenes. The realistic one has lens distortion, a finite exposure time
and photon noise. Motion is solved with several RANSAC seeds. For each seed, the largest error is computed in units
of its stated standard deviation; frames are corrected with the seeds for which it is the median and the maximum.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.benchmark.images.store import keep
from rsbench.benchmark.images.store import kept as kept_rows
from rsbench.benchmark.scoring import motion_errors
from rsbench.benchmark.studies.correction_bench import Row, rows_identity
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.components.seeds import generator
from rsbench.core.errors import RsbenchError
from rsbench.core.motion import Motion
from rsbench.core.rig import VIEWS, View
from rsbench.core.so3 import FloatArray
from rsbench.dataset.card import CameraCard, DatasetCard
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.chain import correct_frames, find_depth
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions, Pairs, frame_pairs
from rsbench.pipeline.frame_motion import FoundMotion, find_motion
from rsbench.vision.fusion import Origin
from rsbench.vision.quality import psnr

FEWEST_SEEDS = 10
BEYOND = 4.0
"""Number of stated standard deviations above which an error contradicts the stated covariance."""
_CORRECTED: tuple[View, ...] = (("left", 0), ("left", 1))
_LOST = {"psnr": 0.0, "psnr_clean": 0.0, "coverage": 0.0}


def ideal_card(card: DatasetCard) -> DatasetCard:
    """Return the card with an ideal camera, without lens and sensor; RsbenchError if the card has its own rig."""
    return replace(card, name=f"{card.name}-ideal", sensor=None, camera=replace(_camera(card), lens=None))


def sized(card: DatasetCard, width: int) -> DatasetCard:
    """Return the card with images of another width and the same field of view.

    Raises:
        RsbenchError: the width is too small to find matches, or the card has its own rig.
    """
    camera = _camera(card)
    scale = width / camera.width
    if width < 64:
        raise RsbenchError(f"--width {width}: must be at least 64 px")
    height = max(round(camera.height * scale), 1)
    return replace(card, camera=replace(camera, width=width, height=height, focal=camera.focal * scale))


def _camera(card: DatasetCard) -> CameraCard:
    if card.camera is None:
        raise RsbenchError(
            f"dataset {card.name}: has a rig; this study takes two equal cameras, the table 'camera'"
        )
    return card.camera


def study(
    datasets: Mapping[str, Path], seeds: int, step: Callable[[str], None], kept: Path
) -> tuple[list[Row], list[Row]]:
    """Evaluate all sequences of each camera's dataset; return a row per seed and a row per corrected view.

    Finished sequences are stored in the folder ``kept``, so that an interrupted run can be resumed.

    Raises:
        RsbenchError: a dataset cannot be read.
    """
    motions: list[Row] = []
    views: list[Row] = []
    for camera, folder in datasets.items():
        for sequence in read_dataset(folder):
            scene, stratum, _ = sequence.name.rsplit("-", 2)
            key = {"camera": camera, "scene": scene, "stratum": stratum, "sequence": sequence.name}
            file = kept / camera / f"{sequence.name}.json"
            identity = rows_identity(folder, sequence.name, seed=seeds, solver=CorrectionOptions().solver.name)
            if (found := kept_rows(file, identity)) is None:
                found = study_sequence(sequence, seeds)
                keep(file, identity, found)
            motions += [key | row for row in found[0]]
            views += [key | row for row in found[1]]
            step(f"{camera} {sequence.name}")
    return motions, views


def study_sequence(sequence: Sequence, seeds: int) -> tuple[list[Row], list[Row]]:
    """Return the motion errors for every seed, and the scores of the corrected views."""
    options, rig, shutter = CorrectionOptions(), sequence.rig, sequence.shutter
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    matches = find_matches_of_rig(images, rig, shutter.scanning, options)
    found: list[FoundMotion | None] = []
    for seed in range(seeds):
        rng = generator(options.seed, "real", sequence.name, seed)
        try:
            found.append(find_motion(matches, rig, shutter, options, rng))
        except NoMotionError:
            found.append(None)
    rows = [{"seed": seed, **_errors(sequence, one)} for seed, one in enumerate(found)]
    order = np.argsort([row["sigmas"] for row in rows], kind="stable")
    pairs = frame_pairs(images, rig, options)
    views = [row | {"seed": "none"} for row in _uncorrected(sequence)]
    for name, seed in (("median", order[len(order) // 2]), ("worst", order[-1])):
        one = found[seed]
        scores = _corrected(sequence, images, pairs, None if one is None else one.motion, options)
        views += [row | {"seed": name} for row in scores]
    return rows, views


def _errors(sequence: Sequence, found: FoundMotion | None) -> Row:
    if found is None:
        errors = motion_errors(None, sequence.motion, sequence.rig)
        return {"success": False, **errors, "sigmas": math.nan, "inliers": 0}
    motion, truth, covariance = found.motion, sequence.motion, found.robust.estimate.covariance
    off = np.concatenate([motion.w - truth.w, motion.d - truth.d])
    return {
        "success": True,
        **motion_errors(motion, truth, sequence.rig),
        "sigmas": math.nan if covariance is None else largest_in_sigmas(off, covariance),
        "inliers": found.robust.inlier_count,
    }


def largest_in_sigmas(off: FloatArray, covariance: FloatArray) -> float:
    """Return the largest error of (n,) in units of its standard deviation, from a covariance (n, n)."""
    return float(np.max(np.abs(off) / np.sqrt(np.diag(covariance))))


def _uncorrected(sequence: Sequence) -> list[Row]:
    rows = []
    for side, frame in _CORRECTED:
        twin = sequence.image("gs", side, frame)
        score = psnr(sequence.image("rs", side, frame), twin), psnr(sequence.clean_image(side, frame), twin)
        rows.append({"side": side, "frame": frame, "psnr": score[0], "psnr_clean": score[1], "coverage": 1.0})
    return rows


def _corrected(
    sequence: Sequence,
    images: Mapping[View, NDArray[np.uint8]],
    pairs: Pairs,
    motion: Motion | None,
    options: CorrectionOptions,
) -> list[Row]:
    """Return the PSNR, over the drawn pixels, of the corrected frames and of noise-free frames corrected alike."""
    keys = [{"side": side, "frame": frame} for side, frame in _CORRECTED]
    if motion is None:
        return [key | _LOST for key in keys]
    rig, shutter = sequence.rig, sequence.shutter
    pairs = find_depth(images, rig, shutter, motion, options, pairs)
    found = correct_frames(images, pairs, rig, shutter, motion, options, _CORRECTED)
    clean = found
    if sequence.sensor is not None:
        sharp = {view: sequence.clean_image(*view) for view in VIEWS}
        clean = correct_frames(sharp, pairs, rig, shutter, motion, options, _CORRECTED)
    rows = []
    for key, view in zip(keys, _CORRECTED, strict=True):
        twin, drawn = sequence.image("gs", *view), found[view].origin != Origin.NOBODY
        both = drawn & (clean[view].origin != Origin.NOBODY)
        scores = {
            "psnr": psnr(found[view].image, twin, drawn),
            "psnr_clean": psnr(clean[view].image, twin, both),
            "coverage": float(np.mean(drawn)),
        }
        rows.append(key | scores)
    return rows


def within_stated(motions: pd.DataFrame, camera: str) -> tuple[int, int]:
    """Count the sequences of a camera in which no seed fails or has an error above ``BEYOND`` stated standard
    deviations; return this count and the number of sequences."""
    own = motions[motions["camera"] == camera]
    worst = own["sigmas"].fillna(math.inf).groupby(own["sequence"]).max()
    return int(np.count_nonzero(worst <= BEYOND)), len(worst)


def summarise(motions: pd.DataFrame, views: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scene, stratum and camera: median and worst errors over seeds, mean PSNR over views."""
    keys = ["scene", "stratum", "camera"]
    rows = []
    for values, group in motions.groupby(keys, sort=False):
        seen = views
        for key, value in zip(keys, values, strict=True):
            seen = seen[seen[key] == value]
        row = dict(zip(keys, values, strict=True)) | {"sequences": group["sequence"].nunique()}
        row |= {"seeds": group["seed"].nunique(), "failures": int(np.count_nonzero(~group["success"]))}
        row |= {name: float(group[name].median()) for name in ("e_R_deg", "e_T_deg")}
        row["e_R_worst_deg"], row["e_T_worst_deg"] = float(group["e_R_deg"].max()), float(group["e_T_deg"].max())
        row["sigmas"] = float(group["sigmas"].max())
        for name in ("none", "median", "worst"):
            own = seen[seen["seed"] == name]
            row[f"psnr_{name}"] = float(own["psnr"].mean())
            row[f"psnr_clean_{name}"] = float(own["psnr_clean"].mean())
        rows.append(row | {"coverage": float(seen[seen["seed"] == "median"]["coverage"].mean())})
    return pd.DataFrame(rows)
