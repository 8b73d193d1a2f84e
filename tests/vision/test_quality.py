"""Image quality in our protocol and in published ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rsbench.vision.quality import LastSsim, flip, psnr, ssim, ssim_deepunroll, ssim_uniform, window_mask


def _pair(shape: tuple[int, ...], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(0.0, 0.05, shape), axis=1)
    truth = (truth - truth.min()) / np.ptp(truth)
    return np.clip(truth + rng.normal(0.0, 0.05, shape), 0.0, 1.0), truth


@pytest.mark.parametrize("shape", [(40, 50), (40, 50, 3)])
def test_against_scikit_image(shape: tuple[int, ...]) -> None:
    estimate, truth = _pair(shape)
    expected = structural_similarity(
        truth,
        estimate,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2 if len(shape) == 3 else None,
    )
    assert ssim(estimate, truth) == pytest.approx(expected, abs=1e-12)
    assert psnr(estimate, truth) == pytest.approx(
        peak_signal_noise_ratio(truth, estimate, data_range=1.0), abs=1e-9
    )


def test_types_share_one_scale() -> None:
    """8-bit, 16-bit and floating-point copies of the same picture score the same."""
    a, b = ((image * 255).astype(np.uint8) for image in _pair((30, 30, 3)))
    wide = [image.astype(np.uint16) * 257 for image in (a, b)]
    unit = [image / 255.0 for image in (a, b)]
    for first, second in (wide, unit):
        assert psnr(first, second) == pytest.approx(psnr(a, b), abs=1e-9)
        assert ssim(first, second) == pytest.approx(ssim(a, b), abs=1e-9)


def test_one_pair_in_several_masks_scores_as_each_alone() -> None:
    """To the last bit, whatever pair was scored before."""
    last, rng = LastSsim(), np.random.default_rng(3)
    (first, truth), (second, other) = _pair((40, 50, 3)), _pair((40, 50, 3), 1)
    for estimate, against in ((first, truth), (second, truth), (second, other), (first, truth)):
        for mask in (np.ones((40, 50), np.bool_), rng.random((40, 50)) > 0.001, np.zeros((40, 50), np.bool_)):
            np.testing.assert_array_equal(last.within(estimate, against, mask), ssim(estimate, against, mask))


def test_what_the_mask_hides_never_counts() -> None:
    """Whatever stands in uncovered pixels, PSNR and SSIM stay the same, to the last bit."""
    estimate, truth = _pair((60, 60))
    mask = np.ones((60, 60), dtype=bool)
    mask[20:24, 30:50] = False
    spoilt = np.where(mask, estimate, np.random.default_rng(1).random(truth.shape))
    assert psnr(spoilt, truth, mask) == psnr(estimate, truth, mask)
    assert ssim(spoilt, truth, mask) == ssim(estimate, truth, mask)
    assert psnr(spoilt, truth) < psnr(estimate, truth)


def test_masked_ssim_is_the_mean_of_the_covered_windows() -> None:
    """A mask that covers the left part scores as the left part alone."""
    estimate, truth = _pair((40, 60))
    mask = np.zeros((40, 60), dtype=bool)
    mask[:, :35] = True
    assert ssim(estimate, truth, mask) == pytest.approx(ssim(estimate[:, :35], truth[:, :35]), abs=1e-12)
    assert np.count_nonzero(window_mask((40, 60), mask)) == 30 * 25


def test_nothing_covered_is_not_a_number() -> None:
    estimate, truth = _pair((30, 30))
    mask = np.zeros((30, 30), dtype=bool)
    assert math.isnan(psnr(estimate, truth, mask))
    assert math.isnan(ssim(estimate, truth, mask))
    mask[:10, :10] = True  # covered, but smaller than a window
    assert math.isfinite(psnr(estimate, truth, mask))
    assert math.isnan(ssim(estimate, truth, mask))
    assert math.isnan(ssim(estimate[:8, :8], truth[:8, :8]))


@pytest.mark.parametrize(
    ("estimate", "truth", "mask"),
    [
        (np.zeros((4, 4)), np.zeros((4, 5)), None),
        (np.zeros(4), np.zeros(4), None),
        (np.zeros((4, 4), dtype=np.int32), np.zeros((4, 4), dtype=np.int32), None),
        (np.zeros((4, 4)), np.zeros((4, 4)), np.ones((4, 5), dtype=bool)),
        (np.zeros((4, 4)), np.zeros((4, 4)), np.ones((4, 4))),
    ],
)
def test_bad_input(estimate: Any, truth: Any, mask: Any) -> None:
    for measure in (psnr, ssim):
        with pytest.raises(ValueError, match="must"):
            measure(estimate, truth, mask)


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
