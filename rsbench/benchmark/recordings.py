"""Scores on recordings in the layouts of other projects, as far as these contain ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import SIDES, Side, StereoRig, View
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.pipeline.footage import check_alike, read_frame
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.corrector import CorrectionProblem, CorrectorEntry, find_corrected_rows
from rsbench.vision.features import Gate, detect, match
from rsbench.vision.fusion import Fused
from rsbench.vision.images import eight_bit
from rsbench.vision.quality import Picture, psnr_deepunroll, ssim, ssim_deepunroll
from rsbench.vision.stereo_depth import depth_metrics
from rsbench.vision.stereo_matcher import MatcherEntry, find_disparities


def depth_scores(recordings: Sequence[Recording], matcher: MatcherEntry) -> pd.DataFrame:
    """Score depth on each image pair with true disparities of the left image; columns as in scores/depth.csv."""
    rows: list[dict[str, Any]] = []
    for recording in recordings:
        for (side, frame), read in recording.disparities.items():
            apart, pair = recording.right_from_left, [(each, frame) for each in ("left", "right")]
            if side != "left" or apart is None or not all(view in recording.images for view in pair):
                continue
            left, right = (recording.cameras[each] for each in ("left", "right"))
            rig = StereoRig(camera=left, baseline=float(-apart.t[0]))
            images = eight_bit([read_frame(recording.images[view]) for view in pair])  # pyrefly: ignore
            found, _ = find_disparities(matcher, images[0], images[1], rig)
            # ``StereoRig.depth`` assumes equal principal points, so their difference is added.
            estimate = np.nan_to_num(rig.depth(found.astype(np.float64) + (right.cx - left.cx)))
            truth = np.nan_to_num(rig.depth(read()))
            metrics = depth_metrics(estimate, truth, rig)
            rows.append({"recording": recording.name, "frame": frame, "matcher": matcher.name, **metrics})
    return pd.DataFrame(rows)


def pose_scores(recordings: Sequence[Recording], seed: int) -> pd.DataFrame:
    """Score the motion between successive frames: one row for each camera with known shutter and poses, solved by
    rs-mono-refined, and one row for both cameras of a rig, solved by rs-stereo-refined."""
    rows: list[dict[str, Any]] = []
    for recording in recordings:
        rows += _rig_rows(recording, seed)
        for side in recording.poses:
            frames = sorted(frame for each, frame in recording.images if each == side)
            if side not in recording.shutters:
                continue
            for first, second in pairwise(frames):
                truth = _relative(recording, side, first, second)
                if truth is not None:
                    score = _pose_score(recording, side, first, second, truth, seed)
                    rows.append({"recording": recording.name, "camera": side, "frame": first, **score})
    return pd.DataFrame(rows)


def _rig_rows(recording: Recording, seed: int) -> Iterator[dict[str, Any]]:
    rig, shutter = recording.rig, recording.shutter
    if rig is None or shutter is None or "left" not in recording.poses:
        return
    frames = [frame for frame in range(recording.frames) if {(s, frame) for s in SIDES} <= recording.images.keys()]
    cam_from_body = Pose(rig.own("left").R, rig.own("left").R @ rig.offset("left"))
    options = CorrectionOptions(seed=seed)
    for first, second in pairwise(frames):
        truth = _relative(recording, "left", first, second)
        if truth is None:
            continue
        moved = compose(compose(inverse(cam_from_body), Pose(so3.exp(truth[0]), truth[1])), cam_from_body)
        paths = {(side, k): recording.images[side, first + k] for side in SIDES for k in (0, 1)}
        images = dict(zip(paths, eight_bit([read_frame(path) for path in paths.values()]), strict=True))
        matches = find_matches_of_rig(images, rig, shutter.scanning, options)
        solver = options.solver.solver
        found = estimate_motion(matches, rig, shutter, solver, options.robust, np.random.default_rng(seed))
        score = _motion_score(found, so3.log(moved.R), moved.t, matches)
        length = np.linalg.norm(found.estimate.d) / np.linalg.norm(moved.t) if found.estimate.success else np.nan
        scale = {"e_s": float(np.abs(np.log(length)))}
        yield {"recording": recording.name, "camera": "both", "frame": first, **score, **scale}


def _relative(recording: Recording, side: Side, first: int, second: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the true rotation vector and translation between the first rows of two frames; None if unknown."""
    poses = recording.poses[side](np.array([first, second], dtype=np.float64))
    one, two = (Pose(poses.R[k], poses.t[k]) for k in (0, 1))
    moved = compose(two, inverse(one))
    if second != first + 1 or not np.all(np.isfinite(moved.R)):
        return None
    return so3.log(moved.R), moved.t


def _pose_score(
    recording: Recording, side: Side, first: int, second: int, truth: tuple[FloatArray, FloatArray], seed: int
) -> dict[str, Any]:
    camera = recording.cameras[side]
    a, b = (detect(image) for image in eight_bit([read_frame(recording.images[side, k]) for k in (first, second)]))
    reach = float(max(camera.width, camera.height))
    pairs = match(a, b, Gate(dx=(-reach, reach), dy=(-reach, reach)))
    matches = Correspondences(left=np.concatenate([a.points[pairs[:, 0]], b.points[pairs[:, 1]]], axis=1))
    rig = StereoRig(camera=camera, baseline=1.0)  # the baseline is not used
    solver = RefinedSolver(one_camera=True)
    shutter, rng = recording.shutters[side], np.random.default_rng(seed)
    found = estimate_motion(matches, rig, shutter, solver, RobustOptions(), rng)
    return _motion_score(found, *truth, matches)


def _motion_score(found: RobustEstimate, w: FloatArray, d: FloatArray, matches: Correspondences) -> dict[str, Any]:
    """Return the errors of an estimated motion; a failed estimate gets 180 degrees."""
    count = sum(len(getattr(matches, name)) for name in ("left", "right", "stereo_0", "stereo_1"))
    if not found.estimate.success:
        return {"e_R_deg": 180.0, "e_T_deg": 180.0, "inliers": 0, "matches": count}
    return {
        "e_R_deg": float(np.rad2deg(rotation_error(found.estimate.w, w))),
        "e_T_deg": float(np.rad2deg(translation_error(found.estimate.d, d))),
        "inliers": found.inlier_count,
        "matches": count,
    }


BASELINE = "uncorrected"
_VIEW: View = ("left", 1)
Image = NDArray[Any]


class Pair(NamedTuple):
    """A frame with ground truth, and the frame before it."""

    recording: Recording
    side: Side
    before: int
    frame: int

    @property
    def rows(self) -> list[int]:
        """Rows at whose times the true global-shutter image of the frame is available."""
        return sorted(
            row for side, frame, row in self.recording.truths if (side, frame) == (self.side, self.frame)
        )


def pairs_with_truth(recordings: Sequence[Recording]) -> list[Pair]:
    """Return the pairs of all cameras with a known shutter, in the order of recordings, cameras and frames."""
    found = list[Pair]()
    for recording in recordings:
        for side in recording.shutters:
            frames = sorted(frame for each, frame in recording.images if each == side)
            pairs = [Pair(recording, side, *two) for two in pairwise(frames) if two[1] == two[0] + 1]
            found += [pair for pair in pairs if pair.rows]
    return found


def check_sees_one_camera(entry: CorrectorEntry) -> None:
    """Raise RsbenchError if a corrector needs more than the frames of one camera."""
    spec = entry.component.spec
    needs = [*sorted(spec.needs), *(["the other camera"] if "stereo" in spec.sees else [])]
    if needs:
        raise RsbenchError(
            f"--corrector {entry.name}: needs {', '.join(needs)}; frames of one camera take mono-fusion, "
            "flow-scaled or another that sees the images of one camera alone"
        )


def correction_scores(
    pairs: Sequence[Pair], correctors: Sequence[CorrectorEntry], step: Callable[[str], object] = str
) -> pd.DataFrame:
    """Score each corrector on each pair and target row; if a correction fails, the uncorrected frame is scored.

    Raises:
        RsbenchError: an image cannot be read, or differs in size or type from the others of its pair.
    """
    rows: list[dict[str, Any]] = []
    for pair in pairs:
        rows += _scores(pair, correctors)
        step(f"{pair.recording.name} {pair.frame}")
    return pd.DataFrame(rows)


def _scores(pair: Pair, correctors: Sequence[CorrectorEntry]) -> Iterator[dict[str, Any]]:
    recording, side, rows = pair.recording, pair.side, pair.rows
    paths = [recording.images[side, pair.before], recording.images[side, pair.frame]]
    paths += [recording.truths[side, pair.frame, row] for row in rows]
    frames = {str(path): read_frame(path) for path in paths}
    check_alike(frames)
    before, image, *truths = eight_bit(list(frames.values()))
    weights = _weights(recording.masks.get((side, pair.frame)), image.shape[:2])
    problem = CorrectionProblem(
        images={("left", 0): before, _VIEW: image},
        rig=StereoRig(camera=recording.cameras[side], baseline=1.0),  # the baseline is not used
        shutter=recording.shutters[side],
        target_row=float(rows[0]),
        motion=None,
        depth=None,
        guess=None,
    )
    untouched = Fused.seen(image, np.ones(image.shape[:2], dtype=np.bool_))
    made = {BASELINE: [untouched for _ in rows]}
    for entry in correctors:
        answers = find_corrected_rows(entry, problem, [_VIEW], [float(row) for row in rows])
        made[entry.name] = [answer[_VIEW] for answer in answers]
    where = {"recording": recording.name, "camera": side, "frame": pair.frame}
    for k, (row, true) in enumerate(zip(rows, map(Picture, truths), strict=True)):
        for method, found in made.items():
            fused = found[k]
            scores = _compared(fused.image if fused.success else image, true, weights)
            yield {
                **where,
                "row": row,
                "method": method,
                "success": fused.success,
                **scores,
                "reason": fused.reason,
            }


def _compared(image: Image, true: Picture, weights: Image | None) -> dict[str, float]:
    made = Picture(image)
    return {
        "psnr": psnr_deepunroll(made, true),
        "ssim": ssim(made, true),
        "psnr_mask": float("nan") if weights is None else psnr_deepunroll(made, true, weights),
        "ssim_deepunroll": ssim_deepunroll(made, true),
    }


def _weights(path: Path | None, shape: tuple[int, ...]) -> Image | None:
    """Return the weights (H, W) from a mask file, or None without one; RsbenchError if its size differs."""
    if path is None:
        return None
    mask = read_frame(path)
    if mask.shape[:2] != shape:
        raise RsbenchError(
            f"{path}: is {mask.shape[1]} x {mask.shape[0]} pixels, its frame {shape[1]} x {shape[0]}"
        )
    return (mask if mask.ndim == 2 else mask[..., 0]).astype(np.float64)
