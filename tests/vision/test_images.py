"""Grey values, half sizes, values between pixels, and several frames at once."""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.images import (
    ahead,
    at_full_size,
    guided_upsample,
    halved,
    map_ahead,
    map_frames,
    resample,
    resample_at,
    single_opencv,
)
from rsbench.vision.stereo_depth import SgmOptions, depth_metrics, stereo_disparity

Build = Callable[..., Any]


@pytest.mark.parametrize("shape", [(300, 300), (299, 301), (1, 2)])
def test_a_halved_ramp_has_the_values_of_the_places_that_it_stands_for(shape: tuple[int, int]) -> None:
    y, x = np.indices(shape, dtype=np.float64)
    small = [halved((each * 0.5).astype(np.uint8)) for each in (x, y)]
    h, w = small[0].shape
    places = at_full_size(np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2), shape)
    for each, place in zip(small, places.T, strict=True):
        np.testing.assert_allclose(2.0 * each.reshape(-1), place, atol=1.6)  # whole grey levels of half a pixel


def test_borders_lie_where_the_image_has_them() -> None:
    """A dark square before a bright wall, its left border inside a pixel of half the size."""
    grey = np.full((60, 80), 200, np.uint8)
    grey[20:41, 31:60] = 40
    small = halved(grey)
    values = np.where(small < 120, 30.0, 10.0).astype(np.float32)
    found = guided_upsample(values, small, grey)
    np.testing.assert_array_equal(found, np.where(grey < 120, 30.0, 10.0))
    values[:4] = np.nan
    assert np.all(np.isnan(guided_upsample(values, small, grey)[:7])) and np.all(np.isfinite(found[9:]))


@pytest.mark.parametrize("crop", [0, 1])
def test_disparity_at_half_the_size(scene: Any, u8: Build, crop: int) -> None:
    """Within two hundredths of a pixel of the full one in the median, on even and on odd sizes."""
    left, right = (u8(scene.rolling(side, 1)[0])[crop:, crop:] for side in SIDES)
    truth = scene.rolling("left", 1)[1][crop:, crop:]
    size = {"width": left.shape[1], "height": left.shape[0]}
    rig = replace(scene.rig, camera=replace(scene.rig.camera, **size))
    full, half = (stereo_disparity(left, right, rig, options=SgmOptions(half=each)) for each in (False, True))
    scores = [depth_metrics(rig.depth(each), truth, rig) for each in (full, half)]
    assert scores[1]["coverage"] > scores[0]["coverage"] - 0.05
    assert scores[1]["bad_1px"] < scores[0]["bad_1px"] + 0.02
    disparity = rig.disparity(truth)
    errors = [np.nanmedian(np.abs(each - disparity)) for each in (full, half)]
    assert errors[1] < errors[0] + 0.02


def test_the_faster_chain_is_ours_alone() -> None:
    options = CorrectionOptions()
    fast = options.faster()
    assert fast.key != options.key and not fast.depth_from_motion
    assert all(getattr(each.component, "half", False) for each in (fast.features, fast.matcher))
    with pytest.raises(RsbenchError, match="--fast: features 'sift-lines'"):
        replace(options, features=load_features("sift-lines")).faster()


def _positions(rng: np.random.Generator, n: int, low: float, high: float) -> np.ndarray:
    return rng.uniform(low, high, (n, n, 2)).astype(np.float32)


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


def test_no_points_have_no_values() -> None:
    image = np.zeros((4, 5, 3), np.uint8)
    assert resample_at(image, np.zeros((0, 2), np.float32)).shape == (0, 3)
    assert resample_at(image[..., 0], np.zeros((0, 2), np.float32), "linear").dtype == np.uint8


def test_opencv_has_its_threads_back_after_a_fault() -> None:
    before = cv2.getNumThreads()
    with pytest.raises(ZeroDivisionError), single_opencv():
        assert cv2.getNumThreads() == 1
        raise ZeroDivisionError
    assert cv2.getNumThreads() == before


@pytest.mark.parametrize(("pixels", "at_once"), [(10_000, 4), (2_000_000, 2), (50_000_000, 1)])
def test_no_more_than_the_memory_is_for(pixels: int, at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """200 B of each pixel: 1 GB holds two frames of 2 Mpx; one is always worked on."""
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    lock, now, most = threading.Lock(), 0, 0

    def work(item: int) -> int:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.02)
        with lock:
            now -= 1
        return 2 * item

    assert map_frames(work, range(8), pixels, 200.0) == [0, 2, 4, 6, 8, 10, 12, 14]
    assert most <= at_once
    assert most == at_once or at_once > 1


def test_what_is_made_ahead_comes_in_order_and_a_fault_in_its_place() -> None:
    def numbers() -> Iterator[int]:
        yield from range(5)
        raise ValueError("no more")

    found, made = list[int](), ahead(numbers(), 3)
    with pytest.raises(ValueError, match="no more"):
        found.extend(made)
    assert found == [0, 1, 2, 3, 4]


def test_work_ahead_comes_in_order_and_a_fault_in_its_place() -> None:
    def slow_first(n: int) -> int:
        time.sleep(0.05 * (n == 0))
        return n

    assert list(map_ahead(slow_first, range(6), 2, 2)) == list(range(6))
    with pytest.raises(ZeroDivisionError):
        list(map_ahead(lambda n: 1 // (n - 3), range(6), 2, 2))


def test_who_stops_asking_waits_for_no_more_than_what_runs() -> None:
    made = list[int]()

    def number(n: int) -> int:
        made.append(n)
        time.sleep(0.02)
        return n

    with contextlib.closing(map_ahead(number, itertools.count(), 4, 1)) as asked:
        assert next(asked) == 0
    assert len(made) <= 6
