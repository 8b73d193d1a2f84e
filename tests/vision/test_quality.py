from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rsbench.vision.quality import LastSsim, psnr, ssim, window_mask


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


def test_identical_images() -> None:
    _, truth = _pair((30, 30))
    assert psnr(truth, truth) == math.inf
    assert ssim(truth, truth) == pytest.approx(1.0, abs=1e-12)


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
