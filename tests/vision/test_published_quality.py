"""Scores of other protocols, against windows taken one by one, and FLIP's fixed points."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from rsbench.vision.published_quality import flip, ssim_deepunroll, ssim_uniform
from rsbench.vision.quality import ssim

RNG = np.random.default_rng(4)
TRUTH = RNG.integers(0, 256, (24, 30, 3), dtype=np.uint8)
ESTIMATE = np.clip(TRUTH + RNG.normal(0, 20, TRUTH.shape), 0, 255).astype(np.uint8)


def local_ssim(a: np.ndarray, b: np.ndarray, weights: np.ndarray, factor: float = 1.0) -> float:
    """SSIM of one window, written out."""
    ma, mb = np.sum(weights * a), np.sum(weights * b)
    va, vb = factor * np.sum(weights * (a - ma) ** 2), factor * np.sum(weights * (b - mb) ** 2)
    cov = factor * np.sum(weights * (a - ma) * (b - mb))
    return float(((2 * ma * mb + 1e-4) * (2 * cov + 9e-4)) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))


def test_uniform_windows_with_the_sample_covariance() -> None:
    a, b = ESTIMATE / 255.0, TRUTH / 255.0
    weights = np.full((7, 7), 1 / 49)
    values = [
        local_ssim(a[y : y + 7, x : x + 7, c], b[y : y + 7, x : x + 7, c], weights, 49 / 48)
        for y in range(18)
        for x in range(24)
        for c in range(3)
    ]
    assert ssim_uniform(ESTIMATE, TRUTH) == pytest.approx(np.mean(values), abs=1e-12)
    theirs = structural_similarity(ESTIMATE, TRUTH, channel_axis=-1, data_range=255)
    assert ssim_uniform(ESTIMATE, TRUTH) == pytest.approx(theirs, abs=1e-12)


def test_the_half_pixel_window_on_zero_padding() -> None:
    a, b = (np.pad(image / 255.0, ((5, 5), (5, 5), (0, 0))) for image in (ESTIMATE, TRUTH))
    line = np.exp(-((np.arange(11) - 5.5) ** 2) / 4.5)
    weights = np.outer(line, line) / line.sum() ** 2
    values = [
        local_ssim(a[y : y + 11, x : x + 11, c], b[y : y + 11, x : x + 11, c], weights)
        for y in range(24)
        for x in range(30)
        for c in range(3)
    ]
    assert ssim_deepunroll(ESTIMATE, TRUTH) == pytest.approx(np.mean(values), abs=1e-12)


def test_equal_images_are_perfect_and_grey_ones_are_accepted() -> None:
    grey = TRUTH[..., 0]
    assert ssim_deepunroll(grey, grey) == ssim_uniform(grey, grey) == pytest.approx(1.0)
    errors = flip(TRUTH, TRUTH)
    assert errors is not None and not np.any(errors)


def test_protocols_differ_by_more_than_methods_often_do() -> None:
    values = [score(ESTIMATE, TRUTH) for score in (ssim, ssim_deepunroll, ssim_uniform)]
    assert np.ptp(values) > 1e-3


def _lab(rgb: tuple[float, float, float]) -> np.ndarray:
    """CIE L*a*b* (D65) of linear RGB, a* and b* times L* / 100 (Hunt's adjustment of the FLIP paper)."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    t = (xyz @ rgb) / xyz.sum(axis=1)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t * (29 / 6) ** 2 / 3 + 4 / 29)
    lightness = 116 * f[1] - 16
    return np.array([lightness, 5 * (f[0] - f[1]) * lightness, 2 * (f[1] - f[2]) * lightness])


def _hyab(a: np.ndarray, b: np.ndarray) -> float:
    return float(abs(a[0] - b[0]) + np.hypot(*(a - b)[1:]))


def test_flip_of_black_and_white_is_near_one() -> None:
    """By hand, for images without edges: Andersson et al., FLIP, 2020, with q_c = 0.7, p_c = 0.4, p_t = 0.95."""
    largest = _hyab(_lab((0, 1, 0)), _lab((0, 0, 1))) ** 0.7
    error = _hyab(_lab((0, 0, 0)), _lab((1, 1, 1))) ** 0.7
    assert error > 0.4 * largest
    expected = 0.95 + (error - 0.4 * largest) / (largest - 0.4 * largest) * 0.05
    black, white = np.zeros((64, 64, 3), np.uint8), np.full((64, 64, 3), 255, np.uint8)
    errors = flip(black, white)
    assert errors is not None and errors.shape == (64, 64)
    # Float32, and matrices of the standard to four digits.
    np.testing.assert_allclose(errors, expected, atol=1e-4)
