"""Stated deviations, against closed forms and against simulated truth."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from rsbench.core import uncertainty as u


def test_the_larger_covariance_is_the_larger_one_along_common_axes() -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    first, second = turn * [4.0, 1.0, 9.0] @ turn.T, turn * [1.0, 2.0, 9.0] @ turn.T
    np.testing.assert_allclose(u.larger(first, second), turn * [4.0, 2.0, 9.0] @ turn.T, atol=1e-12)
    np.testing.assert_allclose(u.larger(np.zeros((3, 3)), second), second, atol=1e-12)


def test_equal_measurements_count_as_many_and_one_that_dominates_as_one() -> None:
    assert u.effective_count(np.full(40, 6.0 / 40)) == pytest.approx(40.0)
    assert u.effective_count(np.array([1.0, 1e-9])) == pytest.approx(1.0)
    assert u.effective_count(np.zeros(0)) == 0.0


def test_the_ellipsoid_of_a_sampled_covariance_covers_as_hotelling_has_it() -> None:
    """Independent truth: 20,000 means and covariances of 20 normal samples."""
    rng, n, p = np.random.default_rng(1), 20, 3
    draws = rng.normal(size=(20_000, n, p))
    mean = draws.mean(axis=1)
    centred = draws - mean[:, None]
    C = np.swapaxes(centred, 1, 2) @ centred / (n - 1) / n
    squares = np.einsum("ni,nij,nj->n", mean, np.linalg.inv(C), mean)
    factor = u.small_sample_factor(n - 1, p)
    assert np.mean(squares <= factor * scipy.stats.chi2.ppf(0.95, p)) == pytest.approx(0.95, abs=0.005)
    assert u.small_sample_factor(1e7, p) == pytest.approx(1.0, abs=1e-5)
    assert u.variance_factor(1e7, p) == pytest.approx(1.0, abs=1e-5)


def test_errors_that_neighbours_share_are_seen_and_independent_ones_are_not() -> None:
    """A mean of values that have, by tile, a common error of a third of their deviation: variance 1 + 20 / 9."""
    factors = []
    for common in (0.0, 1.0 / 3.0):
        found = []
        for seed in range(200):
            rng = np.random.default_rng(seed)
            places = rng.uniform(size=(240, 2))
            groups = u.tiles(places)
            values = rng.normal(size=240) + common * rng.normal(size=12)[groups]
            shares = (values - values.mean())[:, None] / 240
            found.append(float(u.clustered(shares, groups)[0, 0] / (shares.T @ shares)[0, 0]))
        factors.append(np.mean(found))
    assert factors[0] == pytest.approx(1.0, abs=0.1)  # 200 variances of 11 degrees of freedom: +-0.03
    assert factors[1] == pytest.approx((1.0 + 20.0 / 9.0) / (1.0 + 1.0 / 9.0), rel=0.1)


def test_a_regression_is_covered_with_unequal_noise_and_few_measurements() -> None:
    """Forty measurements of three parameters, noise that grows with the place: White's holds 87 %."""
    held = {"stated": 0, "plain": 0}
    for seed in range(600):
        rng = np.random.default_rng(seed)
        places = rng.uniform(-1.0, 1.0, (40, 2))
        X = np.column_stack([np.ones(40), places])
        e = rng.normal(size=40) * (0.3 + places[:, 0] ** 2)
        inverse = np.asarray(np.linalg.inv(X.T @ X), dtype=np.float64)
        error, left = inverse @ X.T @ e, e - X @ inverse @ X.T @ e
        h = np.einsum("ni,ij,nj->n", X, inverse, X)
        stated = u.stated_covariance(
            X * left[:, None], inverse, float(left @ left) / 37.0 * inverse, h, places, 3
        ).covariance
        for name, C in (("stated", stated), ("plain", inverse @ (X * left[:, None] ** 2).T @ X @ inverse)):
            held[name] += bool(error @ np.linalg.solve(C, error) <= scipy.stats.chi2.ppf(0.95, 3))
    assert 0.93 < held["stated"] / 600 < 0.985 and held["plain"] / 600 < 0.9


def test_the_ellipsoid_of_few_measurements_of_equal_noise_is_not_too_large_either() -> None:
    """Forty-two measurements of six parameters: one-sided corrections alone make axes of 1.3 deviations."""
    nees, old = list[float](), list[float]()
    for seed in range(1000):
        rng = np.random.default_rng([1, seed])
        places, noise = rng.uniform(-1.0, 1.0, (42, 2)), rng.normal(size=42)
        X = np.column_stack([np.ones(42), places, places**2, places[:, 0] * places[:, 1]])
        inverse = np.asarray(np.linalg.inv(X.T @ X), dtype=np.float64)
        error = inverse @ X.T @ noise
        left = noise - X @ error
        h = np.einsum("ni,ij,nj->n", X, inverse, X)
        information = float(left @ left) / 36.0 * inverse
        stated = u.stated_covariance(X * left[:, None], inverse, information, h, places, 6).covariance
        nees.append(float(error @ np.linalg.solve(stated, error)))
        shares = X * (left / (1.0 - h))[:, None] @ inverse
        sampled = u.larger(shares.T @ shares, information) * u.small_sample_factor(u.effective_count(h), 6)
        old.append(float(error @ np.linalg.solve(sampled, error)))
    size, before = (float(np.sqrt(scipy.stats.chi2.ppf(0.5, 6) / np.median(each))) for each in (nees, old))
    assert 0.95 < size < 1.2 < 1.3 < before
    assert 0.93 < np.mean(np.array(nees) <= scipy.stats.chi2.ppf(0.95, 6)) < 0.98


def test_what_is_shrunk_is_nearer_to_the_truth() -> None:
    """Mean squared distance of covariances from 20 samples: equal axes, and one of nine times the variance."""
    for variances, most in ((np.ones(5), 0.3), (np.array([9.0, 1.0, 1.0, 1.0, 1.0]), 1.0)):
        away = np.zeros(2)
        for seed in range(300):
            draws = np.random.default_rng([2, seed]).normal(size=(20, 5)) * np.sqrt(variances / 20)
            C, left = u.shrunk(draws, np.diag([2.0] * 5))
            assert 0.0 <= left <= 1.0
            away += [np.sum((each - np.diag(variances)) ** 2) for each in (draws.T @ draws, C)]
        assert away[1] < most * away[0]


def test_common_shifts_of_tiles_are_covered_where_plain_deviations_are_a_third() -> None:
    """A mean of 1200 places whose tiles are shifted: the shift of a tile does not average out within it."""
    rng, n = np.random.default_rng(0), 1200
    places = rng.uniform(size=(n, 2))
    groups, X = u.tiles(places), np.column_stack([np.ones(n), places])
    inverse = np.asarray(np.linalg.inv(X.T @ X), dtype=np.float64)
    added = u.common_shifts(X[None] @ inverse, groups, sigma_px=0.1)
    errors = []
    for _ in range(4000):
        e = 0.1 * rng.normal(size=n) + u.SHIFT_PX * rng.normal(size=12)[groups]
        errors.append(inverse @ X.T @ e)
    expected = 0.01 * inverse + added
    np.testing.assert_allclose(np.cov(np.transpose(errors)), expected, atol=0.06 * np.max(expected))
    assert np.all(u.common_shifts(X[None] @ inverse, groups, sigma_px=1e-3) < 1e-2 * np.abs(added) + 1e-12)


def test_shifts_widen_by_their_mean_share_of_the_other_variance() -> None:
    shifted = np.diag([1.0, 3e-6])
    stated = u.Stated(np.diag([2.0, 2e-6]) + shifted, shifted=shifted)
    assert stated.by_shifts == pytest.approx(1.0 + (0.5 + 1.5) / 2.0)
    assert u.Stated(np.eye(2)).by_shifts == 1.0
