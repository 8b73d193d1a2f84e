"""The robust loop on lines: no geometry of cameras anywhere."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.ransac import (
    BoolArray,
    IntArray,
    RansacOptions,
    all_inlier_probability,
    log10_false_alarms,
    msac_score,
    ransac,
    required_iterations,
)

Line = tuple[float, float]


@dataclass
class LineEstimator:
    """y = a x + b through points, in groups that are sampled separately."""

    points: FloatArray
    num_data: tuple[int, ...]
    sample_size: tuple[int, ...]
    refines: int = 0
    generates: int = 0

    def generate(self, samples: IntArray) -> Iterator[list[Line]]:
        for sample in samples:
            self.generates += 1
            (x0, y0), (x1, y1) = self.points[sample]
            a = (y1 - y0) / (x1 - x0) if x0 != x1 else 0.0
            yield [(a, y0 - a * x0)] if x0 != x1 else []

    def residuals(self, model: Line) -> FloatArray:
        return self.points[:, 1] - model[0] * self.points[:, 0] - model[1]

    def refine(self, model: Line, inliers: BoolArray) -> Line | None:
        self.refines += 1
        a, b = np.polyfit(self.points[inliers, 0], self.points[inliers, 1], 1)
        return float(a), float(b)


def line_problem(outlier_ratio: float, seed: int = 0, n: int = 100) -> tuple[LineEstimator, BoolArray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 10, n)
    y = 2.0 * x - 1.0 + rng.normal(0, 0.01, n)
    bad = np.arange(n) < round(outlier_ratio * n)
    y[bad] = rng.uniform(-20, 20, np.count_nonzero(bad))
    return LineEstimator(np.column_stack([x, y]), (n,), (2,)), ~bad


@pytest.mark.parametrize("outlier_ratio", [0.0, 0.3, 0.6])
def test_finds_the_line(outlier_ratio: float) -> None:
    estimator, good = line_problem(outlier_ratio)
    report = ransac(estimator, RansacOptions(threshold=0.03), np.random.default_rng(1))
    assert report.success and report.model is not None
    # A hundred points of noise 0.01 over a range of 10 fix the slope to 0.001.
    assert report.model == pytest.approx((2.0, -1.0), abs=0.02)
    assert np.count_nonzero(report.inliers & good) >= 0.98 * np.count_nonzero(good)
    assert np.count_nonzero(report.inliers & ~good) <= 2


def test_report_speaks_about_its_own_model() -> None:
    estimator, _ = line_problem(0.4)
    options = RansacOptions(threshold=0.03)
    report = ransac(estimator, options, np.random.default_rng(1))
    assert report.model is not None
    residuals = np.abs(estimator.residuals(report.model))
    np.testing.assert_array_equal(report.inliers, residuals <= 0.03)
    assert report.score == msac_score(residuals, 0.03)


def test_local_optimisation_lowers_the_cost() -> None:
    estimator, _ = line_problem(0.4)
    scores = {
        steps: ransac(
            estimator, RansacOptions(threshold=0.03, lo_steps=steps, final_steps=0), np.random.default_rng(1)
        ).score
        for steps in (0, 4)
    }
    assert scores[4] < scores[0]


def test_groups_are_sampled_separately() -> None:
    estimator, _ = line_problem(0.0, n=50)
    seen: list[IntArray] = []
    original = estimator.generate

    def generate(samples: IntArray) -> Iterator[list[Line]]:
        seen.extend(samples)
        return original(samples)

    estimator.generate = generate  # pyrefly: ignore[method-assign]
    estimator.num_data, estimator.sample_size = (20, 20, 10), (1, 1, 0)
    ransac(estimator, RansacOptions(threshold=0.03, min_iterations=30), np.random.default_rng(0))
    samples = np.array(seen)
    assert len(samples) >= 30
    assert np.all(samples[:, 0] < 20) and np.all((samples[:, 1] >= 20) & (samples[:, 1] < 40))


def test_no_model_is_a_failure_with_a_reason() -> None:
    estimator = LineEstimator(np.ones((10, 2)), (10,), (2,))
    report = ransac(estimator, RansacOptions(threshold=1.0, max_iterations=20), np.random.default_rng(0))
    assert not report.success and report.reason == "no sample gave a model" and report.iterations == 20


def test_nan_residuals_count_as_outliers() -> None:
    estimator, _ = line_problem(0.0)
    estimator.points[3, 1] = np.nan
    report = ransac(estimator, RansacOptions(threshold=0.05, lo_steps=0, final_steps=0), np.random.default_rng(0))
    assert report.success and not report.inliers[3]


def test_all_inlier_probability_by_hand() -> None:
    # 3 of 5 good, samples of 2: 3/5 * 2/4.
    assert all_inlier_probability((3,), (5,), (2,)) == pytest.approx(0.3)
    # A second group, 2 of 4 good, samples of 1.
    assert all_inlier_probability((3, 2), (5, 4), (2, 1)) == pytest.approx(0.15)
    assert all_inlier_probability((1,), (5,), (2,)) == 0.0
    assert all_inlier_probability((0, 5), (7, 5), (0, 3)) == 1.0


def test_required_iterations_by_hand() -> None:
    # 1 - (1 - 1/4)^k >= 0.99  ->  k >= ln 0.01 / ln 0.75 = 16.008
    assert required_iterations(0.25, 0.99) == pytest.approx(16.008, abs=1e-3)
    assert required_iterations(1.0, 0.99) == 1.0
    assert required_iterations(0.0, 0.99) == math.inf
    # (1 - p) rounds to 1: the logarithm must not.
    assert required_iterations(1e-18, 0.5) == pytest.approx(math.log(2) * 1e18)


def test_stops_after_the_required_iterations() -> None:
    """Exactly half of 40 points are good: p = C(20, 2) / C(40, 2) = 0.2436, so 24.7 samples for 99.9 %."""
    estimator, _ = line_problem(0.5, n=40)
    report = ransac(
        estimator, RansacOptions(threshold=0.05, confidence=0.999, min_iterations=1), np.random.default_rng(0)
    )
    good = np.count_nonzero(report.inliers)
    expected = required_iterations(all_inlier_probability((int(good),), (40,), (2,)), 0.999)
    assert 20 <= good <= 21
    assert report.iterations == math.ceil(expected) == estimator.generates


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=20), st.floats(0.1, 3))
@settings(max_examples=30)
def test_msac_score_is_bounded_by_the_number_of_data(residuals: list[float], threshold: float) -> None:
    score = msac_score(np.array(residuals), threshold)
    assert 0.0 <= score <= len(residuals)
    assert msac_score(np.array([*residuals, np.inf]), threshold) == pytest.approx(score + 1.0)


@pytest.mark.parametrize(
    "bad",
    [
        {"threshold": 0.0},
        {"threshold": math.nan},
        {"confidence": 1.0},
        {"min_iterations": 0},
        {"min_iterations": 20, "max_iterations": 10},
        {"lo_steps": -1},
    ],
)
def test_options_refuse_nonsense(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad)).split("_")[0]):
        RansacOptions(**{"threshold": 1.0, **bad})  # pyrefly: ignore[bad-argument-type]


def test_false_alarms_by_hand() -> None:
    # C(10, 4) = 210 choices, two inliers beyond a sample of 2 at 1 in 100 each, 50 samples: 210 * 50 * 1e-4.
    assert log10_false_alarms(4, 10, 2, 50, 0.01) == pytest.approx(math.log10(210 * 50 * 1e-4), abs=1e-12)


def test_consensus_of_pure_noise_is_no_consensus() -> None:
    points = np.random.default_rng(5).uniform(0.0, 1.0, (100, 2))
    # A line band of +-0.01 in the unit square holds about 2 % of uniform points.
    report = ransac(
        LineEstimator(points, (100,), (2,)),
        RansacOptions(threshold=0.01, max_iterations=500),
        np.random.default_rng(0),
    )
    assert not report.success
    assert "chance" in report.reason
