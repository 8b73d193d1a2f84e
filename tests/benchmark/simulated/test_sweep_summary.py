"""Scores and statistics of stored trials, on constructed answers and known distributions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.simulated.run_sweep import (
    at_bound,
    over_bound,
    score_trials,
    summary_row,
)
from rsbench.benchmark.simulated.sweep_card import Cell, load_sweep
from rsbench.core.pose_errors import translation_of_offset

N = 40
SETTING = load_sweep("noise").setting
CELL = Cell(index=0, variant="all", value=1.0, setting=SETTING)
LIMIT = {"rotation": np.full((N, 3), 5e-4), "direction": np.full((N, 2), 5e-3), "scale": np.full(N, 0.1)}


def arrays(**changes: Any) -> dict[str, Any]:
    """Trials with a perfect answer of one solver."""
    rng = np.random.default_rng(0)
    w, d = 0.03 * rng.standard_normal((N, 3)), 0.3 * rng.standard_normal((N, 3))
    flags = {name: np.ones((N, 1), dtype=np.bool_) for name in ("success", "metric", "direction_known")}
    return {"w": w, "d": d, "w_est": w[:, None].copy(), "d_est": d[:, None].copy(), **flags} | changes


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
    own = translation_of_offset(content["w"], content["d"], SETTING.rig().offset("left"))
    content["d_est"][:, 0] = 7.0 * own
    content["metric"][:] = False
    scores = score_trials(content, 0, "left", CELL)
    np.testing.assert_allclose(scores["e_T_deg"], 0.0, atol=1e-9)
    assert np.all(np.isnan(scores["e_s"]))
    assert score_trials(content, 0, "body", CELL)["e_T_deg"].min() > 0.01


def test_errors_that_do_not_exist_are_marked() -> None:
    content = arrays(d=np.zeros((N, 3)))
    limit = LIMIT | {"direction": np.full((N, 2), np.inf), "scale": np.full(N, np.inf)}
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


@pytest.mark.slow
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


def test_errors_at_the_bound_against_known_distributions() -> None:
    """Two equal axes: a Rayleigh distribution; one axis alone: a half-normal one; three equal axes: Maxwell's."""
    n = 300
    for axes, median, mean in (
        ([2.0, 2.0], 2.0 * np.sqrt(2.0 * np.log(2.0)), 2.0 * np.sqrt(np.pi / 2.0)),
        ([1.0, 0.0], 0.674490, np.sqrt(2.0 / np.pi)),
        ([1.0, 1.0, 1.0], 1.538172, 2.0 * np.sqrt(2.0 / np.pi)),
    ):
        found = at_bound(np.tile(axes, (n, 1)), 0)
        # 30 000 draws know the mean of such a distribution to 0.4 %, its median to 0.7 %; three of those.
        assert found["bound_mean"] == pytest.approx(mean, rel=0.015)
        assert found["bound_median"] == pytest.approx(median, rel=0.02)
