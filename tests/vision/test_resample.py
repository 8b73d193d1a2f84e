from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from rsbench.vision.resample import resample


def _positions(rng: np.random.Generator, n: int, low: float, high: float) -> np.ndarray:
    return rng.uniform(low, high, (n, n, 2)).astype(np.float32)


def test_cubic_reproduces_parabolas() -> None:
    """Keys' kernel is exact to second order: the values of any quadratic come back, here to float32."""
    y, x = np.mgrid[:20, :24].astype(np.float64)

    def value(px: np.ndarray, py: np.ndarray) -> np.ndarray:
        return 0.3 + 0.02 * px - 0.01 * py + 0.001 * px**2 - 0.002 * px * py + 0.0015 * py**2

    at = _positions(np.random.default_rng(0), 30, 2.0, 16.0)
    got = resample(value(x, y).astype(np.float32), at)
    np.testing.assert_allclose(got, value(at[..., 0].astype(float), at[..., 1].astype(float)), atol=3e-7)


@pytest.mark.parametrize("channels", [0, 1, 3, 4])
def test_cubic_is_separable_keys_convolution(channels: int) -> None:
    """Against the kernel's definition, summed over the whole image, for every number of channels."""
    rng = np.random.default_rng(channels)
    shape = (12, 14, channels) if channels else (12, 14)
    image = rng.random(shape).astype(np.float32)
    at = _positions(rng, 6, 2.0, 9.0)

    def kernel(s: np.ndarray) -> np.ndarray:
        s = np.abs(s)
        near, far = 1.5 * s**3 - 2.5 * s**2 + 1.0, -0.5 * s**3 + 2.5 * s**2 - 4.0 * s + 2.0
        return np.where(s <= 1, near, np.where(s < 2, far, 0.0))

    wx, wy = kernel(at[..., 0, None] - np.arange(14)), kernel(at[..., 1, None] - np.arange(12))
    expected = np.einsum("abx,aby,yx...->ab...", wx, wy, image.astype(float))
    np.testing.assert_allclose(resample(image, at), expected, atol=1e-6)


def test_linear_agrees_with_scipy() -> None:
    rng = np.random.default_rng(1)
    image = rng.random((12, 14)).astype(np.float32)
    at = _positions(rng, 6, 1.0, 10.0)
    expected = map_coordinates(image.astype(float), [at[..., 1], at[..., 0]], order=1)
    np.testing.assert_allclose(resample(image, at, "linear"), expected, atol=1e-6)


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_pixel_centres_return_the_pixels(interpolation: str, dtype: type) -> None:
    """At whole positions, border included, the kernels are 1 on the pixel and 0 elsewhere; NaN gives 0."""
    image: np.ndarray = (np.random.default_rng(2).random((7, 9, 3)) * (1 if dtype is np.float32 else 255)).astype(
        dtype
    )
    at = np.stack(np.meshgrid(np.arange(9), np.arange(7)), axis=-1).astype(np.float32)
    at[3, 4] = np.nan
    expected = image.copy()
    expected[3, 4] = 0
    got = resample(image, at, interpolation)  # pyrefly: ignore[bad-argument-type]
    assert got.dtype == image.dtype
    np.testing.assert_array_equal(got, expected)


def test_overshoot_of_integers_is_clipped() -> None:
    image = np.zeros((8, 8), dtype=np.uint8)
    image[:, 4:] = 255
    at = np.full((1, 2, 2), 4.0, dtype=np.float32)
    at[0, :, 0] = 2.5, 4.5  # beside the edge, where the cubic under- and overshoots by 1/16
    np.testing.assert_array_equal(resample(image, at), [[0, 255]])


def test_positions_beyond_the_border_repeat_it() -> None:
    image = np.random.default_rng(3).random((6, 6)).astype(np.float32)
    at = np.array([[[-30.0, 2.0], [2.0, 400.0]]], dtype=np.float32)
    np.testing.assert_allclose(resample(image, at), [[image[2, 0], image[5, 2]]], rtol=1e-6)


@pytest.mark.parametrize("interpolation", ["cubic", "linear"])
@pytest.mark.parametrize("share", [0.0, 0.002, 0.1, 0.24])
@pytest.mark.parametrize("channels", [0, 3])
def test_few_positions_among_many_are_sampled_alike(interpolation: str, share: float, channels: int) -> None:
    """Those that are wanted have the values of a request for all of them; the others are 0."""
    rng = np.random.default_rng(3)
    image = rng.integers(0, 255, (40, 50, channels) if channels else (40, 50), dtype=np.uint8)
    at = _positions(rng, 60, -2.0, 48.0)
    wanted = rng.random((60, 60)) < share
    few = np.where(wanted[..., None], at, np.float32(np.nan))
    whole, got = (resample(image, each, interpolation) for each in (at, few))  # pyrefly: ignore[bad-argument-type]
    # Vector instructions may round a sum otherwise than what is left at the end of a row does.
    assert np.max(np.abs(got[wanted].astype(int) - whole[wanted]), initial=0) <= 1
    assert not np.any(got[~wanted])
