"""Scores and statistics of stored trials, on constructed answers and known distributions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.simulated.sweep_card import Cell, Setting
from rsbench.benchmark.simulated.sweep_summary import (
    bootstrap_interval,
    over_bound,
    score_trials,
    statistics,
    summary_row,
)

N = 40
SETTING = Setting(
    width=900,
    height=900,
    focal=810.0,
    baseline=0.6,
    readout_ratio=0.8,
    points=30,
    depth=(2.0, 10.0),
    rotation_deg=2.0,
    translation=0.3,
    noise_px=0.1,
)
CELL = Cell(index=0, variant="all", value=1.0, setting=SETTING)
LIMIT = {"rotation": np.full(N, 1e-3), "direction": np.full(N, 1e-2), "scale": np.full(N, 0.1)}


def arrays(**changes: Any) -> dict[str, Any]:
    """Trials with a perfect answer of one solver."""
    rng = np.random.default_rng(0)
    w, d = 0.03 * rng.standard_normal((N, 3)), 0.3 * rng.standard_normal((N, 3))
    flags = {name: np.ones((N, 1), dtype=np.bool_) for name in ("success", "metric", "direction_known")}
    return {"w": w, "d": d, "w_est": w[:, None].copy(), "d_est": d[:, None].copy(), **flags} | changes


def test_a_perfect_answer_scores_zero() -> None:
    scores = score_trials(arrays(), 0, "body", CELL)
    for values in scores.values():
        np.testing.assert_allclose(values, 0.0, atol=1e-12)


def test_failures_score_the_worst_value_and_are_counted() -> None:
    content = arrays()
    content["success"][:5] = False
    content["w_est"][:5], content["d_est"][:5] = np.nan, np.nan
    scores = score_trials(content, 0, "body", CELL)
    assert np.all(scores["e_R_deg"][:5] == 180.0) and np.all(scores["e_T_deg"][:5] == 180.0)
    assert np.all(np.isinf(scores["e_s"][:5]))
    row = summary_row(scores, content["success"][:, 0], LIMIT, 0)
    assert row["failures"] == 5 and row["success_share"] == 35 / 40
    # They stay in the mean and the 90th percentile of 40 trials.
    assert row["e_R_mean"] == pytest.approx(180.0 * 5 / 40) and row["e_R_p90"] == 180.0
    assert row["e_R_median"] < 1e-9


def test_a_solver_of_the_left_camera_is_scored_against_its_translation() -> None:
    content = arrays()
    rig = SETTING.rig()
    from rsbench.core.motion import LinearMotion

    for k in range(N):
        motion = LinearMotion(content["w"][k], content["d"][k])
        start, end = (rig.cam_from_world(motion, tau, "left") for tau in (0.0, 1.0))
        content["d_est"][k, 0] = 7.0 * (end.t - end.R @ start.R.T @ start.t)
    content["metric"][:] = False
    scores = score_trials(content, 0, "left", CELL)
    np.testing.assert_allclose(scores["e_T_deg"], 0.0, atol=1e-9)
    assert np.all(np.isnan(scores["e_s"]))
    assert score_trials(content, 0, "body", CELL)["e_T_deg"].min() > 0.01


def test_the_sign_of_the_translation_counts() -> None:
    content = arrays()
    content["d_est"] *= -1.0
    np.testing.assert_allclose(score_trials(content, 0, "body", CELL)["e_T_deg"], 180.0)


def test_errors_that_do_not_exist_are_marked() -> None:
    content = arrays(d=np.zeros((N, 3)))
    limit = LIMIT | {"direction": np.full(N, np.inf), "scale": np.full(N, np.inf)}
    row = summary_row(score_trials(content, 0, "body", CELL), content["success"][:, 0], limit, 0)
    assert row["unobservable"] == "direction and scale"
    assert row["e_T_median"] is None and row["e_T_over_bound"] is None and row["e_s_median"] is None
    # A trial then counts as solved by its rotation.
    assert row["success_share"] == 1.0 and row["e_R_median"] < 1e-9


def test_unobservable_scale_hides_scale_alone() -> None:
    content = arrays()
    limit = LIMIT | {"scale": np.full(N, 0.7)}
    row = summary_row(score_trials(content, 0, "body", CELL), content["success"][:, 0], limit, 0)
    assert row["unobservable"] == "scale" and row["e_s_median"] is None and row["e_T_median"] < 1e-9


def test_quotient_of_errors_at_the_bound_is_one() -> None:
    rng = np.random.default_rng(1)
    sigmas = rng.uniform(0.5, 2.0, 4000)
    # The norm of three normal errors whose squares add up to sigma^2 in the mean.
    errors = np.linalg.norm(rng.standard_normal((4000, 3)), axis=1) * sigmas / np.sqrt(3)
    found = over_bound(errors, sigmas, 0)
    assert found["over_bound"] == pytest.approx(1.0, abs=0.03)  # three standard deviations of such a mean
    low, high = found["over_bound_low"], found["over_bound_high"]
    assert low is not None and high is not None and 0.95 < low < 1.0 < high < 1.05
    assert over_bound(errors, np.zeros(4000), 0)["over_bound"] is None
    assert over_bound(errors[:0], sigmas[:0], 0)["over_bound"] is None


def test_bootstrap_intervals_cover_the_truth() -> None:
    rng = np.random.default_rng(5)
    experiments, n = 300, 80
    hits = {"mean": 0, "median": 0}
    for _ in range(experiments):
        found = statistics(rng.exponential(1.0, n), 0)
        for name, truth in (("mean", 1.0), ("median", np.log(2.0))):
            low, high = found[f"{name}_low"], found[f"{name}_high"]
            assert low is not None and high is not None
            hits[name] += low <= truth <= high
    # 95 % within four standard deviations (0.0126) of 300 experiments, less what n = 80 costs such an interval.
    assert 0.88 < hits["mean"] / experiments < 0.99
    assert 0.88 < hits["median"] / experiments < 0.99


def test_bootstrap_of_a_mean_agrees_with_the_normal_interval() -> None:
    values = np.random.default_rng(2).standard_normal(400)
    low, high = bootstrap_interval(values, lambda v: np.mean(v, axis=-1), seed=0)
    half = 1.96 * np.std(values) / np.sqrt(400)
    # 1000 resamples know the ends of the interval to about 5 % of its half width.
    np.testing.assert_allclose([low, high], [np.mean(values) - half, np.mean(values) + half], atol=0.2 * half)
    assert (low, high) == bootstrap_interval(values, lambda v: np.mean(v, axis=-1), seed=0)
