"""Half the size and back: places of points and borders of depth are the image's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import FRAMES, SIDES
from rsbench.pipeline.correction_options import CorrectionOptions
from rsbench.vision.feature_matcher import load_features
from rsbench.vision.features import MatchOptions, SiftMatcher, detect
from rsbench.vision.half_size import at_full_size, guided_upsample, halved
from rsbench.vision.patch_alignment import refine_matches
from rsbench.vision.stereo_depth import SgmOptions, depth_metrics, stereo_disparity

Build = Callable[..., Any]


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    Plane, Sphere = shapes
    return world((Plane((0.2, 0.3, 1), 8), Sphere((0.2, 0.1, 4), 0.6)), size=(240, 320), focal=400, shortest=0.12)


@pytest.mark.parametrize("shape", [(300, 300), (299, 301), (1, 2)])
def test_a_halved_ramp_has_the_values_of_the_places_that_it_stands_for(shape: tuple[int, int]) -> None:
    y, x = np.indices(shape, dtype=np.float64)
    small = [halved((each * 0.5).astype(np.uint8)) for each in (x, y)]
    h, w = small[0].shape
    places = at_full_size(np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2), shape)
    for each, place in zip(small, places.T, strict=True):
        np.testing.assert_allclose(2.0 * each.reshape(-1), place, atol=1.6)  # whole grey levels of half a pixel


def test_features_lie_where_the_blobs_are() -> None:
    """Of an image of odd size, whose halves are a little more than two pixels wide."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:401, :399]
    centres = np.stack(np.meshgrid(np.arange(6), np.arange(6)), -1).reshape(-1, 2) * 60.0 + 45
    centres += rng.uniform(-0.5, 0.5, centres.shape)
    image = np.full(x.shape, 60.0)
    for (cx, cy), sigma in zip(centres, rng.uniform(4, 8, len(centres)), strict=True):
        image += 120 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    points = detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), MatchOptions(half=True)).points
    distance = np.linalg.norm(points[:, None] - centres, axis=-1)
    found = distance.min(axis=1) < 2
    assert np.unique(distance[found].argmin(axis=1)).size > 30
    offset = points[found] - centres[distance[found].argmin(axis=1)]
    assert np.all(np.abs(offset.mean(axis=0)) < 0.03)  # the pixel of half the size is twice as large


def test_matches_that_are_aligned_are_as_good_as_those_of_the_full_size(scene: Any, u8: Build) -> None:
    """Left-right matches against the true disparity of their rows."""
    images = {(side, k): u8(scene.rolling(side, k)[0]) for k in FRAMES for side in SIDES}
    truth = scene.rig.disparity(scene.rolling("left", 0)[1])
    off = {}
    for half in (False, True):
        matches = refine_matches(images, SiftMatcher(half=half).match(images))
        x, y, other, _ = matches.stereo_0.T
        places = np.rint(np.stack([y, x])).astype(int)
        off[half] = float(np.median(np.abs(x - other - truth[tuple(places)])))
        assert len(matches.stereo_0) > 30
    assert off[True] < 1.5 * off[False] + 0.02


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
