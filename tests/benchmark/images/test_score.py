"""Scores of predictions of known quality: the truth scores the best of everything, a failure the worst."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.images.plan import EvaluationOptions, Places, Plan, Recipe, make_plan
from rsbench.benchmark.images.predict import Bench
from rsbench.benchmark.images.score import Row, Scorer
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.storage.files import MATCH_SETS, save_arrays


@pytest.fixture(scope="module")
def plan(castle: Sequence) -> Plan:
    return make_plan(EvaluationOptions(solvers=("gs-8pt",)), [castle])


def store_truth(places: Places, plan: Plan, **changes: Any) -> None:
    """The truth as the prediction of rs-stereo-refined and of sgm; ``changes`` of the motion's record."""
    motion = places.sequence.motion
    record: dict[str, Any] = {
        "solver": plan.chain.solver.name,
        "entry": plan.chain.solver.name,
        "seed": 0,
        "success": True,
        "reason": "",
        "w": motion.w.tolist(),
        "d": motion.d.tolist(),
        "metric": True,
        "key": plan.chain.solver.key,
        "motion_model": motion.name,
        "motion_parameters": {},
        "reference_point": "body",
        "shutter": "rolling",
        "uses": ["left"],
        "inliers": {"left": 9},
        "matches": dict.fromkeys(MATCH_SETS, 10),
        "iterations": 1,
    }
    artefact = places.motion(plan.chain.solver)
    artefact.start()
    artefact.finish(record | changes)
    disparities = {}
    for side, frame in VIEWS:
        disparity = places.sequence.rig.disparity(places.sequence.depth("rs", side, frame))
        disparities[f"{side}_{frame}"] = disparity.astype(np.float32)
    artefact = places.depth(plan.chain.matcher)
    artefact.start()
    save_arrays(artefact.file(".npz"), disparities)
    artefact.finish({"matcher": "sgm", "entry": "sgm", "timed": False, "success": True, "reason": ""})


def scored(castle: Sequence, plan: Plan, folder: Path, **changes: Any) -> dict[str, list[Row]]:
    with SolverRunner() as runner:
        bench = Bench(castle, folder, plan, runner)
        store_truth(bench.places, plan, **changes)
        for recipe in Recipe(chain=plan.chain).variants():
            bench._correct(recipe)
    scorer = Scorer(Places(castle, folder, plan.chain), plan)
    scorer.score()
    assert scorer.stale == []
    return scorer.rows


def test_truth_scores_the_best_of_everything(castle: Sequence, plan: Plan, tmp_path: Path) -> None:
    rows = scored(castle, plan, tmp_path)
    (pose,) = rows["pose"]
    assert max(pose["e_R_deg"], pose["e_T_deg"], pose["e_s"]) < 1e-12
    assert (pose["inliers"], pose["data_model"], pose["assumed_model"]) == (9, "linear", "linear")
    for depth in rows["depth"]:
        # float32 holds a disparity to 6e-8 relative.
        if depth["pixels"] != "occluded" or np.isfinite(depth["rmse_m"]):
            assert depth["rmse_m"] < 1e-5
            assert depth["coverage"] == 1.0
            assert depth["over_2m"] == depth["bad_1px"] == 0.0
    psnr = {
        (row["side"], row["frame"], row["solver"], row["matcher"]): row["psnr"]
        for row in rows["correction"]
        if row["pixels"] == "visible"
    }
    assert len(psnr) == 4 * 5
    for side, frame in VIEWS:
        best = psnr[side, frame, "true", "true"]
        # The same map but for float32 rounding of depth, which moves no pixel by 1e-3 px, and for the sky, which
        # the oracle knows and the chain has to find.
        assert psnr[side, frame, "rs-stereo-refined", "sgm"] == pytest.approx(best, abs=0.5)
        assert best > psnr[side, frame, "none", "none"] + 6.0
    assert rows["failures"] == []


def test_failure_scores_the_worst_and_is_told_apart(castle: Sequence, plan: Plan, tmp_path: Path) -> None:
    rows = scored(castle, plan, tmp_path, success=False, w=None, d=None, reason="no consensus")
    (pose,) = rows["pose"]
    assert (pose["e_R_deg"], pose["e_T_deg"], pose["e_s"]) == (180.0, 180.0, np.inf)
    assert not pose["success"]
    estimated = [row for row in rows["correction"] if row["solver"] == "rs-stereo-refined"]
    assert len(estimated) == 2 * 4 * 2  # two depths, four views, two sets of pixels
    for row in estimated:
        assert (row["success"], row["coverage"], row["psnr"], row["ssim"]) == (False, 0.0, 0.0, -1.0)
    assert all(row["success"] for row in rows["correction"] if row["solver"] == "true")
    reasons = {(row["kind"], row["name"]): row["reason"] for row in rows["failures"]}
    assert reasons["solver", "rs-stereo-refined"] == "no consensus"
    assert "no consensus" in reasons["correction", "fusion+rs-stereo-refined+sgm"]
