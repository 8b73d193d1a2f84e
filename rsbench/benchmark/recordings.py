"""Scores on recordings in layouts of others, as far as they have a truth: disparities, or poses of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import Side, StereoRig
from rsbench.core.se3 import Pose, compose, inverse
from rsbench.core.so3 import FloatArray
from rsbench.dataset.recording import Recording
from rsbench.pipeline.footage import read_frame
from rsbench.solvers.engine.robust_motion import RobustOptions, estimate_motion
from rsbench.solvers.refined import RefinedSolver
from rsbench.vision.features import Gate, detect, match
from rsbench.vision.images import eight_bit
from rsbench.vision.stereo_depth import depth_metrics
from rsbench.vision.stereo_matcher import MatcherEntry, find_disparities


def depth_scores(recordings: Sequence[Recording], matcher: MatcherEntry) -> pd.DataFrame:
    """A row for each pair of images with disparities of the left one, as in scores/depth.csv."""
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
            # A pixel's disparity lacks what the principal points differ by.
            estimate = np.nan_to_num(rig.depth(found.astype(np.float64) + (right.cx - left.cx)))
            truth = np.nan_to_num(rig.depth(read()))
            metrics = depth_metrics(estimate, truth, rig)
            rows.append({"recording": recording.name, "frame": frame, "matcher": matcher.name, **metrics})
    return pd.DataFrame(rows)


def pose_scores(recordings: Sequence[Recording], seed: int) -> pd.DataFrame:
    """A row for every two successive frames of a camera whose shutter and poses are known, by rs-mono-refined."""
    rows: list[dict[str, Any]] = []
    for recording in recordings:
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


def _relative(recording: Recording, side: Side, first: int, second: int) -> tuple[FloatArray, FloatArray] | None:
    """Rotation vector and translation from the first frame to the second, of their first rows; None: not known."""
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
    rig = StereoRig(camera=camera, baseline=1.0)  # a length that a solver of one camera does not ask for
    solver = RefinedSolver(one_camera=True)
    shutter, rng = recording.shutters[side], np.random.default_rng(seed)
    found = estimate_motion(matches, rig, shutter, solver, RobustOptions(), rng)
    w, d = truth
    if not found.estimate.success:
        return {"e_R_deg": 180.0, "e_T_deg": 180.0, "inliers": 0, "matches": len(pairs)}
    return {
        "e_R_deg": float(np.rad2deg(rotation_error(found.estimate.w, w))),
        "e_T_deg": float(np.rad2deg(translation_error(found.estimate.d, d))),
        "inliers": found.inlier_count,
        "matches": len(pairs),
    }
