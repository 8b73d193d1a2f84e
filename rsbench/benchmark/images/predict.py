"""Predictions on image sequences: matches, motions, disparity and corrected frames, stored before any scoring.

Nothing here reads the truth of a sequence: only its rolling-shutter images, its rig and its shutter.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsbench import __version__
from rsbench.benchmark.seeds import generator
from rsbench.core.correspondences import Correspondences
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.dataset.files import MATCH_SETS, read_json, save_arrays, save_matches, sha256, write_json, write_png
from rsbench.dataset.sequence import FRAMES, Sequence
from rsbench.motions import make_motion
from rsbench.pipeline.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.engine.registry import load_solver_entry
from rsbench.vision.correction import correct_frame
from rsbench.vision.features import MatchOptions, match_stereo_frames
from rsbench.vision.stereo_depth import SgmMatcher
from rsbench.vision.stereo_matcher import StereoMatcher

Step = Callable[[str], None]
VIEWS: tuple[tuple[Side, int], ...] = tuple(product(SIDES, FRAMES))


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Everything that decides a prediction, apart from the dataset."""

    solvers: tuple[str, ...]
    """Names or paths of solver cards."""
    correction_solver: str = "rs-stereo-refined"
    """Solver whose motion the correction uses; one of ``solvers``."""
    seed: int = 0
    matching: MatchOptions = field(default_factory=MatchOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    sgm: StereoMatcher = field(default_factory=SgmMatcher)

    def steps(self) -> int:
        """Progress steps of one sequence: matching, solvers, and depth and correction of each view."""
        return 1 + len(self.solvers) + len(VIEWS)


def predict_sequence(sequence: Sequence, options: EvaluationOptions, folder: Path, step: Step) -> None:
    """Write all predictions of a sequence into ``folder``; kept when they were made from the same input before."""
    identity = _identity(sequence, options)
    marker = folder / "prediction.json"
    if marker.is_file() and read_json(marker).get("identity") == identity:
        for _ in range(options.steps()):
            step(sequence.name)
        return
    if folder.exists():
        shutil.rmtree(folder)
    (folder / "motion").mkdir(parents=True)
    (folder / "corrected").mkdir()
    images = {view: sequence.image("rs", *view) for view in VIEWS}
    started = time.perf_counter()
    matches = match_stereo_frames(
        images["left", 0], images["right", 0], images["left", 1], images["right", 1], options.matching
    )
    matching_s = time.perf_counter() - started
    save_matches(folder / "matches.npz", matches)
    step(sequence.name)
    for name in options.solvers:
        _predict_motion(sequence, matches, name, options, folder)
        step(sequence.name)
    motion = read_motion(folder, options.correction_solver)
    disparities = {}
    depth_s = 0.0
    for frame in FRAMES:
        started = time.perf_counter()
        both = options.sgm.disparities(images["left", frame], images["right", frame], sequence.rig)
        depth_s += time.perf_counter() - started
        for side, disparity in zip(SIDES, both, strict=True):
            disparities[f"{side}_{frame}"] = disparity
            if motion is not None:
                _correct(sequence, images[side, frame], disparity, motion, side, frame, folder)
            step(sequence.name)
    save_arrays(folder / "disparity.npz", disparities)
    write_json(marker, {"identity": identity, "matching_s": matching_s, "depth_s": depth_s})


def _predict_motion(
    sequence: Sequence, matches: Correspondences, name: str, options: EvaluationOptions, folder: Path
) -> None:
    entry = load_solver_entry(name)
    solver, spec = entry.solver, entry.solver.spec
    rng = generator(options.seed, "images", sequence.name, entry.name, 0)
    robust = estimate_motion(matches, sequence.rig, sequence.shutter, solver, options.robust, rng)
    estimate = robust.estimate
    answer = {
        "solver": entry.name,
        "success": estimate.success,
        "reason": estimate.reason,
        "w": estimate.w.tolist() if estimate.success else None,
        "d": estimate.d.tolist() if estimate.success else None,
        "metric": estimate.metric,
        "motion_model": spec.motion_model,
        **({"motion_parameters": dict(spec.motion_parameters)} if spec.motion_parameters else {}),
        "reference_point": spec.reference_point,
        "shutter": spec.shutter,
        "uses": sorted(spec.needs | {name for name, size in solver.sample_sizes(matches).items() if size}),
        "inliers": {key: int(np.count_nonzero(mask)) for key, mask in robust.inliers.items()},
        "matches": {key: len(getattr(matches, key)) for key in MATCH_SETS},
        "iterations": robust.iterations,
        "seconds": robust.seconds,
    }
    write_json(folder / "motion" / f"{entry.name}.json", answer)
    save_arrays(
        folder / "motion" / f"{entry.name}-inliers.npz", {str(key): mask for key, mask in robust.inliers.items()}
    )


def _correct(
    sequence: Sequence,
    image: NDArray[np.uint8],
    disparity: NDArray[np.float32],
    motion: Motion,
    side: Side,
    frame: int,
    folder: Path,
) -> None:
    depth = depth_of(disparity, sequence.rig)
    corrected = correct_frame(image, depth, sequence.rig, sequence.shutter, motion, side, frame)
    write_png(folder / "corrected" / f"{side}_{frame}.png", corrected.image)
    write_png(folder / "corrected" / f"{side}_{frame}_mask.png", np.where(corrected.mask, 255, 0).astype(np.uint8))


def depth_of(disparity: NDArray[np.float32], rig: StereoRig) -> NDArray[np.float32]:
    """Depth (H, W), metres, 0 where the disparity is not known: the depth convention of the dataset."""
    return np.nan_to_num(rig.depth(disparity), nan=0.0).astype(np.float32)


def read_motion(folder: Path, solver: str) -> Motion | None:
    """Motion that a solver predicted, or None when it found none."""
    answer = read_json(folder / "motion" / f"{load_solver_entry(solver).name}.json")
    if not answer["success"]:
        return None
    return make_motion(answer["motion_model"], answer["w"], answer["d"], answer.get("motion_parameters"))


def _identity(sequence: Sequence, options: EvaluationOptions) -> str:
    """Hash of what decides the predictions: the sequence's bytes, the options, the cards and the version."""
    solvers = [load_solver_entry(name).key for name in options.solvers]
    parts = [
        sha256(sequence.folder / "sequence.json"),
        json.dumps(asdict(options), default=str),
        *solvers,
        __version__,
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
