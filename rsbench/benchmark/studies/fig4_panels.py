"""What the paper's Figure 4 shows of one sequence: six pictures of the left camera's frame 0, and numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.studies.correction_bench import Bench
from rsbench.benchmark.studies.correction_study import WORST
from rsbench.core.geometry import GivenGeometry
from rsbench.core.rig import Side
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import uncorrected
from rsbench.storage.files import load_arrays, read_json, save_arrays, write_json
from rsbench.vision.correction import correct_frame
from rsbench.vision.fusion import Origin
from rsbench.vision.quality import psnr
from rsbench.vision.stereo_depth import depth_metrics

SIDE: Side = "left"
FRAME = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class Panels:
    """Arrays of the six panels; depth in metres, NaN where there is none."""

    rolling: NDArray[np.uint8]
    corrected: NDArray[np.uint8]
    known: NDArray[np.bool_]
    """(H, W) pixels of ``corrected`` that some frame saw."""
    truth: NDArray[np.uint8]
    """The global-shutter image at row 0's pose."""
    true_depth: NDArray[np.float32]
    depth_error: NDArray[np.float32]
    """Absolute, of SGM against ``true_depth``; infinite where there is no surface, but a depth all the same."""
    numbers: dict[str, Any]


def make_panels(sequence: Sequence, seed: int = 0) -> Panels:
    """Match, solve, find depth and correct with the estimates; compare with the truth.

    Where no motion is found, the frame is shown as it was, and the numbers of the correction are the worst.
    """
    bench = Bench(sequence, seed)
    view = SIDE, FRAME
    frames = uncorrected(bench.images, (view,))
    if bench.motion is not None:
        frames, _ = bench.corrected(bench.sgm, bench.motion, views=(view,))
    fused, success = frames[view], bench.motion is not None
    rolling, truth = bench.images[view], sequence.image("gs", *view)
    true_depth = sequence.depth("rs", *view)
    depth = np.where(np.isfinite(bench.sgm[FRAME].depth[SIDE]), bench.sgm[FRAME].depth[SIDE], np.float32(0.0))
    surface = true_depth > 0
    error = np.where(surface, np.abs(depth - true_depth), np.float32(np.inf))
    error = np.where(depth > 0, error, np.float32(np.nan))
    here = fused.origin == Origin.HERE
    truth_given = GivenGeometry(bench.rig, bench.shutter, sequence.motion)
    oracle = correct_frame(rolling, bench.true[FRAME].depth[SIDE], truth_given, view)
    true, errors = sequence.motion, bench.motion_errors()
    numbers = {
        "seed": sequence.manifest["seed"],
        "ransac_seed": seed,
        "rotation_deg": float(np.rad2deg(np.linalg.norm(true.w))),
        "translation": float(np.linalg.norm(true.d)),
        "readout_ratio": sequence.shutter.readout_ratio,
        **{name: errors[f"{name}_ours"] for name in ("e_R_deg", "e_T_deg")},
        "psnr_rolling": psnr(rolling, truth, here),
        "psnr_corrected": psnr(fused.image, truth, here) if success else WORST["psnr"],
        "psnr_oracle": psnr(oracle.image, truth, here & oracle.mask),
        "psnr_corrected_all": psnr(fused.image, truth) if success else WORST["psnr"],
        "psnr_rolling_all": psnr(rolling, truth),
        **{f"share_{name}": share for name, share in fused.shares().items()},
        **{
            f"depth_{name}": None if math.isnan(value) else value  # without sky, or without any depth
            for name, value in depth_metrics(depth, true_depth, bench.rig).items()
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


_ARRAYS = ("rolling", "corrected", "known", "truth", "true_depth", "depth_error")


def save_panels(folder: Path, panels: Panels) -> None:
    """panels.npz and numbers.json in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    save_arrays(folder / "panels.npz", {name: getattr(panels, name) for name in _ARRAYS})
    write_json(folder / "numbers.json", panels.numbers)


def load_panels(folder: Path) -> Panels:
    """What ``save_panels`` wrote.

    Raises:
        RsbenchError: numbers.json is missing or damaged.
    """
    numbers = read_json(folder / "numbers.json")
    return Panels(**load_arrays(folder / "panels.npz"), numbers=numbers)
