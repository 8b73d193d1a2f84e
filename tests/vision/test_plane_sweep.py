"""The plane sweep and semi-global aggregation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, View
from rsbench.vision.plane_sweep import SweepMatcher, aggregated, sweep_depths, winners
from rsbench.vision.stereo_matcher import load_matcher

Build = Callable[..., Any]


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    """A slanted wall at 5 to 9 m with a board 3 m away before it; it moves by some 20 px between the frames."""
    plane = shapes[0]

    def board(X: np.ndarray) -> np.ndarray:
        return (np.abs(X[..., 0] + 0.2) < 0.3) & (np.abs(X[..., 1]) < 0.3)

    surfaces = (plane((0.2, 0.3, 1.0), 7.0), plane((0.0, 0.0, 1.0), 3.0, board))
    return world(surfaces, size=(100, 128), focal=160.0, d=(0.35, -0.1, 0.1), w_deg=(4.0, 1.0, -2.0))


@pytest.fixture(scope="module")
def frames(scene: Any, u8: Any) -> dict[str, Any]:
    seen = {view: scene.rolling(*view) for view in VIEWS}
    return {
        "images": {view: u8(image) for view, (image, _) in seen.items()},
        "truth": {view: depth for view, (_, depth) in seen.items()},
    }


def found(scene: Any, frames: Any, **options: Any) -> dict[Any, np.ndarray]:
    return sweep_depths(frames["images"], scene.rig, scene.shutter, scene.motion, SweepMatcher(**options))


def off_px(scene: Any, depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors as parallax over a frame period, px."""
    known = np.isfinite(depth)
    step = scene.rig.camera.fx * np.linalg.norm(scene.motion.d)
    return step * np.abs(1.0 / depth[known] - 1.0 / truth[known])


@pytest.mark.parametrize("sources", ["time", "stereo", "all"])
def test_depth_is_within_a_plane_of_the_truth(scene: Any, frames: Any, sources: str) -> None:
    depths = found(scene, frames, sources=sources)
    for view in VIEWS:
        off = off_px(scene, depths[view], frames["truth"][view])
        # A fifth of the image leaves the other frame, or is hidden there.
        assert off.size > (0.85 if sources == "all" else 0.7) * depths[view].size
        # Planes lie half a pixel of parallax apart. Beside the board's edges windows see both surfaces.
        assert np.median(off) < 0.15
        assert np.mean(off < 0.5) > 0.85


@pytest.mark.parametrize("sources", ["time", "stereo", "all"])
def test_the_depth_of_some_views_is_that_of_all(scene: Any, frames: Any, sources: Any) -> None:
    """What is not asked is found no more only where nothing that is asked depends on it."""
    known = scene.rig, scene.shutter, scene.motion
    matcher = SweepMatcher(sources=sources)
    whole = matcher.depths(frames["images"], *known)
    chosen: tuple[list[View], ...] = ([("left", 1)], [("right", 0), ("left", 1)])
    for views in chosen:
        some = matcher.depths_of(frames["images"], *known, views)
        assert list(some) == views
        for view in views:
            np.testing.assert_array_equal(some[view], whole[view])


def test_who_ignores_the_shutter_is_biased(scene: Any, frames: Any) -> None:
    """Turning by 4 deg about x moves the image by 11 of 100 rows: times between rows are 9 % from a period."""
    exact, wrong = (
        np.median(off_px(scene, depths["left", 0], frames["truth"]["left", 0]))
        for depths in (found(scene, frames, sources="time", rolling=rolling) for rolling in (True, False))
    )
    assert wrong > 5.0 * exact and wrong > 0.5
    # The other camera of a moment reads its rows at the same times: without time nothing is wrong.
    one, other = (found(scene, frames, sources="stereo", rolling=rolling)["left", 0] for rolling in (True, False))
    # Rounding of the poses alone tells them apart; at edges it may tip a choice.
    assert np.mean(np.isfinite(one) != np.isfinite(other)) < 0.01
    assert np.nanquantile(np.abs(one / other - 1.0), 0.95) < 1e-3


def test_a_range_that_is_given_is_kept(scene: Any, frames: Any) -> None:
    depth = found(scene, frames, nearest_depth=4.0)["left", 0]
    assert np.nanmin(depth) > 3.9
    near = frames["truth"]["left", 0] < 3.5
    assert np.mean(np.isfinite(depth[near])) < 0.3  # the board lies nearer than what is searched


def test_nothing_alike_and_no_parallax_have_no_depth(scene: Any, frames: Any) -> None:
    rng = np.random.default_rng(1)
    noise = {view: rng.integers(0, 255, (100, 128), dtype=np.uint8) for view in VIEWS}
    depths = sweep_depths(noise, scene.rig, scene.shutter, scene.motion, SweepMatcher(sources="time"))
    assert all(np.mean(np.isfinite(depth)) < 0.2 for depth in depths.values())
    still = LinearMotion(scene.motion.w, np.zeros(3))
    about_left = scene.rig.about("left")
    depth = sweep_depths(
        frames["images"], about_left, scene.shutter.at_once(), still, SweepMatcher(sources="time")
    )["left", 0]
    assert not np.any(np.isfinite(depth))  # a turn about the left camera shows it no depth


def test_the_cards_are_what_they_say(tmp_path: Path) -> None:
    assert load_matcher("sweep").component == SweepMatcher()
    assert load_matcher("sweep-time").component == SweepMatcher(sources="time")
    assert load_matcher("sweep-time-gs").component == SweepMatcher(sources="time", rolling=False)
    card = tmp_path / "wrong.toml"
    for line, words in (
        ("planes = 2", "planes = 2: must lie in"),
        ("window = 4", "window = 4: must be odd"),
        ("p1 = 300", "p1 = 300: must not exceed p2, 200"),
        ('sources = "both"', "sources"),
    ):
        card.write_text(f'class = "rsbench.vision.plane_sweep:SweepMatcher"\n[parameters]\n{line}\n', "utf-8")
        with pytest.raises(RsbenchError, match=words):
            load_matcher(card)


def _by_definition(costs: np.ndarray, p1: float, p2: float) -> np.ndarray:
    height, width, _ = costs.shape
    total = np.zeros(costs.shape)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        path = np.zeros(costs.shape)
        for y in range(height)[:: 1 if dy >= 0 else -1]:
            for x in range(width)[:: 1 if dx >= 0 else -1]:
                path[y, x] = costs[y, x]
                if 0 <= y - dy < height and 0 <= x - dx < width:
                    before = path[y - dy, x - dx]
                    beside = np.pad(before, 1, constant_values=np.inf)
                    steps = np.minimum(beside[:-2], beside[2:]) + p1
                    path[y, x] += np.minimum(np.minimum(before, before.min() + p2), steps) - before.min()
        total += path
    return total


def test_sums_are_those_of_the_definition() -> None:
    costs = np.random.default_rng(0).integers(0, 255, (7, 9, 6), dtype=np.uint8)
    np.testing.assert_array_equal(aggregated(costs, 10, 60), _by_definition(costs, 10, 60))
    # The largest sums that the penalties allow still fit.
    np.testing.assert_array_equal(aggregated(costs, 4000, 4000), _by_definition(costs, 4000, 4000))


def test_the_winner_is_the_minimum_of_a_parabola() -> None:
    at = np.array([[2.25, 3.5, 0.0, 6.0]])
    total = np.round(1000.0 + 100.0 * (np.arange(7) - at[..., None]) ** 2).astype(np.uint16)
    np.testing.assert_allclose(winners(total), at, atol=1e-6)
