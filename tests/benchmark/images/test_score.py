"""Scores of predictions of known quality: the truth scores the best of everything, a failure the worst."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.images.predict import VIEWS
from rsbench.benchmark.images.score import score_correction, score_depth, score_poses
from rsbench.dataset.files import MATCH_SETS, save_arrays
from rsbench.dataset.sequence import Sequence, read_dataset


@pytest.fixture(scope="module")
def sequence(smoke_dataset: Path) -> Sequence:
    return read_dataset(smoke_dataset)[0]


def answer_of(sequence: Sequence, **changes: Any) -> dict[str, Any]:
    answer = {
        "solver": "gs-8pt",
        "success": True,
        "reason": "",
        "w": sequence.motion.w.tolist(),
        "d": sequence.motion.d.tolist(),
        "metric": True,
        "motion_model": sequence.motion.name,
        "reference_point": "body",
        "shutter": "rolling",
        "uses": ["left"],
        "inliers": {"left": 10},
        "matches": dict.fromkeys(MATCH_SETS, 10),
        "iterations": 1,
        "seconds": 0.1,
    }
    return answer | changes


def write_prediction(folder: Path, sequence: Sequence, answer: dict[str, Any]) -> Path:
    (folder / "motion").mkdir()
    (folder / "motion" / "gs-8pt.json").write_text(json.dumps(answer))
    disparities = {}
    for side, frame in VIEWS:
        disparity = sequence.rig.disparity(sequence.depth("rs", side, frame))
        disparities[f"{side}_{frame}"] = disparity.astype(np.float32)
    save_arrays(folder / "disparity.npz", disparities)
    return folder


def test_truth_scores_the_best_of_everything(sequence: Sequence, tmp_path: Path) -> None:
    folder = write_prediction(tmp_path, sequence, answer_of(sequence))
    (pose,) = score_poses(sequence, folder)
    assert max(pose["e_R_deg"], pose["e_T_deg"], pose["e_s"]) < 1e-12
    for depth in score_depth(sequence, folder):
        # float32 holds a disparity to 6e-8 relative.
        if depth["pixels"] != "occluded" or np.isfinite(depth["rmse_m"]):
            assert depth["rmse_m"] < 1e-5
            assert depth["coverage"] == 1.0
            assert depth["over_2m"] == depth["bad_1px"] == 0.0
    rows = score_correction(sequence, folder, "gs-8pt")
    psnr = {(row["side"], row["frame"], row["depth"], row["motion"]): row["psnr_common"] for row in rows}
    for side, frame in VIEWS:
        best = psnr[side, frame, "true", "true"]
        # The same map but for float32 rounding of depth, which moves no pixel by 1e-3 px.
        assert psnr[side, frame, "SGM", "estimated"] == pytest.approx(best, abs=0.05)


def test_failure_scores_the_worst_and_is_told_apart(sequence: Sequence, tmp_path: Path) -> None:
    failed = answer_of(sequence, success=False, w=None, d=None, reason="no consensus")
    folder = write_prediction(tmp_path, sequence, failed)
    (pose,) = score_poses(sequence, folder)
    assert (pose["e_R_deg"], pose["e_T_deg"], pose["e_s"]) == (180.0, 180.0, np.inf)
    assert not pose["success"]
    rows = score_correction(sequence, folder, "gs-8pt")
    estimated = [row for row in rows if row["motion"] == "estimated"]
    assert len(estimated) == 8
    assert all(not row["success"] and np.isnan(row["psnr"]) and row["coverage"] == 0.0 for row in estimated)
    assert all(row["success"] for row in rows if row["motion"] == "true")
