"""Panels of the paper's Figure 4 for one sequence: six images for the left camera's frame 0, and numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.predict import true_pairs
from rsbench.benchmark.images.score import visible_pixels
from rsbench.benchmark.scoring import motion_errors
from rsbench.benchmark.studies.correction_bench import Bench
from rsbench.benchmark.studies.correction_study import WORST
from rsbench.capture.shutter_decision import NoMotionError
from rsbench.core.geometry import FixedGeometry
from rsbench.core.motion import Motion
from rsbench.core.rig import VIEWS, View
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import correct_frames, uncorrected
from rsbench.pipeline.frame_capture import find_matches
from rsbench.pipeline.frame_depth import CorrectionOptions, Pairs, frame_pairs
from rsbench.pipeline.frame_motion import find_motion
from rsbench.solvers.engine.base import load_solver_entry
from rsbench.storage.files import load_arrays, read_json, save_arrays, write_json
from rsbench.vision.correction import correct_frame
from rsbench.vision.corrector import load_corrector
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.fusion import Fused, Origin
from rsbench.vision.quality import Picture, psnr, psnr_within
from rsbench.vision.stereo_depth import depth_metrics
from rsbench.vision.stereo_matcher import load_matcher

VIEW: View = ("left", 0)
LITERAL = {
    "solver": "rs-stereo-linear",
    "features": "sift",
    "matcher": "sgm",
    "corrector": "single-view",
}
"""Components described in the paper, by the name of their option."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Panels:
    """Arrays of the six panels; depth in metres, NaN where there is none."""

    rolling: NDArray[np.uint8]
    corrected: NDArray[np.uint8]
    known: NDArray[np.bool_]
    """(H, W) mask of the pixels of ``corrected`` that are visible in at least one frame."""
    truth: NDArray[np.uint8]
    """The global-shutter image at row 0's pose."""
    true_depth: NDArray[np.float32]
    depth_error: NDArray[np.float32]
    """Absolute error of SGM's depth; infinite where SGM has a depth but there is no surface."""
    numbers: dict[str, Any]


def make_panels(sequence: Sequence) -> Panels:
    """Match, solve, estimate depth, correct the frame, and compare it with the ground truth.

    If no motion is found, the uncorrected frame is shown, with the worst scores for the correction.
    """
    bench = Bench(sequence, seed=0)
    frames = uncorrected(bench.images, (VIEW,))
    if bench.motion is not None:
        frames, _ = bench.corrected(bench.sgm, bench.motion, views=(VIEW,))
    return _compare(sequence, 0, bench.motion, frames[VIEW], bench.sgm)


def literal_options(seed: int) -> CorrectionOptions:
    """Return options with the components of ``LITERAL`` and without steps that the paper does not describe."""
    return CorrectionOptions(
        solver=load_solver_entry(LITERAL["solver"]),
        features=load_features(LITERAL["features"]),
        matcher=load_matcher(LITERAL["matcher"]),
        corrector=load_corrector(LITERAL["corrector"]),
        depth_from_motion=False,
        find_sky=False,
        seed=seed,
    )


def correct_literally(sequence: Sequence, seeds: Iterable[int]) -> Iterator[tuple[list[dict[str, Any]], Panels]]:
    """Correct the four views with ``literal_options``; yield the scores and the panels for each RANSAC seed.

    A score is the PSNR, dB, over three sets of pixels: ``drawn`` from the frame at an estimated depth, ``visible``
    in the rolling-shutter frame according to the true depth and motion, and ``all``; pixels that are not drawn are
    black. The PSNR of the uncorrected frame over the same pixels is also given. If no motion is found, the scores
    are the worst ones.
    """
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    rolling = {view: Picture(image) for view, image in images.items()}
    truths = {view: Picture(sequence.image("gs", *view)) for view in VIEWS}
    visible = visible_pixels(sequence, true_pairs(sequence, images), VIEWS)
    rig, shutter = sequence.rig, sequence.shutter
    matches = find_matches(images, literal_options(0))
    pairs = frame_pairs(images, rig, literal_options(0))
    for seed in seeds:
        options = literal_options(seed)
        try:
            motion = find_motion(matches, rig, shutter, options).motion
            frames = correct_frames(images, pairs, rig, shutter, motion, options)
        except NoMotionError:
            motion, frames = None, uncorrected(images)
        errors, rows = motion_errors(motion, sequence.motion, rig), list[dict[str, Any]]()
        for view, fused in frames.items():
            drawn = fused.origin == Origin.HERE
            row = {"sequence": sequence.name, "ransac_seed": seed, **LITERAL, **errors}
            row |= {
                "side": view[0],
                "frame": view[1],
                "success": motion is not None,
                "share_drawn": float(drawn.mean()),
            }
            parts = {"drawn": drawn, "visible": visible[view], "all": np.ones_like(drawn)}
            shown = (rolling[view], fused.image)
            before, after = (psnr_within(image, truths[view], [*parts.values()]) for image in shown)
            for name, *values in zip(parts, before, after, strict=True):
                row[f"psnr_rolling_{name}"] = values[0]
                row[f"psnr_{name}"] = WORST["psnr"] if motion is None else values[1]
            rows.append(row)
        panels = _compare(sequence, seed, motion, frames[VIEW], pairs)
        yield rows, replace(panels, numbers={**panels.numbers, **LITERAL})


def _compare(sequence: Sequence, seed: int, motion: Motion | None, fused: Fused, pairs: Pairs) -> Panels:
    """Return the panels of a frame that was corrected with ``motion`` and the depth of ``pairs``."""
    side, frame = VIEW
    rolling, truth = sequence.image("rs", *VIEW), sequence.image("gs", *VIEW)
    true_depth, found, success = sequence.depth("rs", *VIEW), pairs[frame].depth[side], motion is not None
    depth = np.where(np.isfinite(found), found, np.float32(0.0))
    surface = true_depth > 0
    error = np.where(surface, np.abs(depth - true_depth), np.float32(np.inf))
    error = np.where(depth > 0, error, np.float32(np.nan))
    here = fused.origin == Origin.HERE
    true = sequence.motion
    truth_given = FixedGeometry(sequence.rig, sequence.shutter, true)
    oracle = correct_frame(rolling, np.where(surface, true_depth, np.float32(np.inf)), truth_given, VIEW)
    numbers = {
        "seed": sequence.manifest["seed"],
        "ransac_seed": seed,
        "rotation_deg": float(np.rad2deg(np.linalg.norm(true.w))),
        "translation": float(np.linalg.norm(true.d)),
        "readout_ratio": sequence.shutter.readout_ratio,
        **motion_errors(motion, true, sequence.rig),
        "psnr_rolling": psnr(rolling, truth, here),
        "psnr_corrected": psnr(fused.image, truth, here) if success else WORST["psnr"],
        "psnr_oracle": psnr(oracle.image, truth, here & oracle.mask),
        "psnr_corrected_all": psnr(fused.image, truth) if success else WORST["psnr"],
        "psnr_rolling_all": psnr(rolling, truth),
        **{f"share_{name}": share for name, share in fused.shares().items()},
        **{
            f"depth_{name}": None if math.isnan(value) else value  # no sky, or no estimated depth
            for name, value in depth_metrics(depth, true_depth, sequence.rig).items()
        },
    }
    return Panels(
        rolling=rolling,
        corrected=fused.image,
        known=fused.origin != Origin.NOBODY,
        truth=truth,
        true_depth=np.where(surface, true_depth, np.float32(np.nan)),
        depth_error=error.astype(np.float32),
        numbers=numbers,
    )


def save_panels(folder: Path, panels: Panels) -> None:
    """Write panels.npz and numbers.json into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {name: value for name, value in vars(panels).items() if name != "numbers"}
    save_arrays(folder / "panels.npz", arrays)
    write_json(folder / "numbers.json", panels.numbers)


def load_panels(folder: Path) -> Panels:
    """Read the files of ``save_panels``.

    Raises:
        RsbenchError: numbers.json is missing or damaged.
    """
    numbers = read_json(folder / "numbers.json")
    return Panels(**load_arrays(folder / "panels.npz"), numbers=numbers)
