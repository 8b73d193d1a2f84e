"""Stereo and feature matchers by card, and what they may answer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commands import refused
from general_rigs import RIGS

from rsbench.components.cards import list_cards
from rsbench.components.motion_models import LinearMotion
from rsbench.components.plugins import Entry, RunOptions
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES, VIEWS, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.vision.feature_matcher import FeatureMatcher, find_correspondences, load_features
from rsbench.vision.features import MatchOptions, SiftMatcher
from rsbench.vision.plane_sweep import SweepMatcher
from rsbench.vision.stereo_depth import SgmMatcher, SgmOptions
from rsbench.vision.stereo_matcher import (
    MotionMatcher,
    StereoMatcher,
    find_depths,
    find_disparities,
    load_matcher,
    widened,
)

RIG = StereoRig(camera=PinholeCamera.centred(40, 30, 50.0), baseline=0.2)
SHUTTER, MOTION = RollingShutter(height=30, readout_ratio=0.5), LinearMotion(np.zeros(3), np.ones(3))
IMAGES = {view: np.zeros((30, 40), np.uint8) for view in VIEWS}


@pytest.mark.parametrize("name", list_cards("matchers"))
def test_matcher_cards_load(name: str) -> None:
    entry = load_matcher(name)
    assert isinstance(entry.component, (SgmMatcher, SweepMatcher)) and entry.description


@pytest.mark.parametrize("name", list_cards("features"))
def test_feature_cards_load(name: str) -> None:
    assert load_features(name).description


def test_the_default_cards_state_the_defaults() -> None:
    sgm, sift = load_matcher("sgm").component, load_features("sift").component
    assert sgm == SgmMatcher() and sift == SiftMatcher()
    # What the functions take for themselves is what the cards say.
    assert vars(sgm) == vars(SgmOptions()) and vars(sift) == vars(MatchOptions())


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("block_size = 4", "block_size = 4: must be odd"),
        ("block_size = 1001", "block_size = 1001: must lie in"),
        ("num_disparities = 10000000000", "num_disparities = 10000000000: must lie in"),
        ("p1 = 100", "p1 = 100: must not exceed p2, 32"),
        ("consistency_px = nan", "must be finite"),
        ("blok_size = 3", "unknown key"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, line: str, message: str) -> None:
    card = tmp_path / "wrong.toml"
    card.write_text(f'class = "rsbench.vision.stereo_depth:SgmMatcher"\n[parameters]\n{line}\n', "utf-8")
    with refused(match=message):
        load_matcher(card)


@pytest.mark.parametrize(
    "line", ["max_features = 1000000000", "contrast_threshold = -1.0", "edge_threshold = 0.0"]
)
def test_features_without_end_are_refused(tmp_path: Path, line: str) -> None:
    card = tmp_path / "wrong.toml"
    card.write_text(f'class = "rsbench.vision.features:SiftMatcher"\n[parameters]\n{line}\n', "utf-8")
    with pytest.raises(RsbenchError, match=f"{line}: must lie in"):
        load_features(card)


@pytest.mark.parametrize("line", ["time_limit_s = 0.0", "time_limit = 3.0"])
def test_wrong_options_of_a_card_are_named(tmp_path: Path, line: str) -> None:
    card = tmp_path / "wrong.toml"
    card.write_text(f'class = "rsbench.vision.stereo_depth:SgmMatcher"\n{line}\n', "utf-8")
    with pytest.raises(RsbenchError, match="time_limit"):
        load_matcher(card)


# What other packages' components may answer. This module is not rsbench's, so they count as such.


def answered(self: Any, *known: Any) -> Any:
    if isinstance(self.answer, Exception):
        raise self.answer
    return self.answer


@dataclass(frozen=True)
class Says(StereoMatcher):
    answer: Any
    disparities = answered  # pyrefly: ignore[bad-override]


@dataclass(frozen=True)
class SaysDepth(MotionMatcher):
    answer: Any
    depths = answered  # pyrefly: ignore[bad-override]


@dataclass(frozen=True)
class Finds(FeatureMatcher):
    answer: Any
    match = answered  # pyrefly: ignore[bad-override]


def entry_of(component: Any) -> Entry[Any, RunOptions]:
    return Entry(name="mine", path=None, description="", component=component, options=RunOptions(), key="k")


def flat(value: float, dtype: Any = np.float64, shape: tuple[int, int] = (30, 40)) -> np.ndarray:
    return np.full(shape, value, dtype)


def test_good_disparities_pass_as_float32() -> None:
    left, right = flat(3.0), flat(float("nan"), np.float32)
    both = find_disparities(entry_of(Says((left, right))), IMAGES["left", 0], IMAGES["right", 0], RIG)
    assert [disparity.dtype for disparity in both] == [np.float32, np.float32]
    np.testing.assert_array_equal(both, (left, right))


def test_a_matcher_that_needs_a_motion_is_refused_where_there_is_none() -> None:
    with pytest.raises(RsbenchError, match=r"^matcher 'mine': needs the rig's motion, and .*such as sgm$"):
        find_disparities(entry_of(SaysDepth({})), IMAGES["left", 0], IMAGES["right", 0], RIG)


def test_good_depths_pass_as_float32() -> None:
    answer = dict.fromkeys(VIEWS, flat(3.0)) | {("left", 1): flat(float("nan")), ("right", 1): flat(float("inf"))}
    depths = find_depths(entry_of(SaysDepth(answer)), IMAGES, RIG, SHUTTER, MOTION)
    assert {depth.dtype for depth in depths.values()} == {np.dtype(np.float32)}
    np.testing.assert_array_equal(list(depths.values()), list(answer.values()))


def test_cameras_that_a_matcher_does_not_take_are_refused() -> None:
    late = RollingShutter(height=30, readout_ratio=0.5, right_delay=0.1)
    with pytest.raises(RsbenchError, match=r"right_delay = 0\.1: matcher 'mine' takes rows"):
        find_depths(entry_of(SaysDepth({})), IMAGES, RIG, late, MOTION)


def disparities_of(answer: Any) -> Any:
    return find_disparities(entry_of(Says(answer)), IMAGES["left", 0], IMAGES["right", 0], RIG)


def depths_of(answer: Any) -> Any:
    return find_depths(entry_of(SaysDepth(answer)), IMAGES, RIG, SHUTTER, MOTION)


def matches_of(answer: Any) -> Any:
    return find_correspondences(entry_of(Finds(answer)), IMAGES)


@pytest.mark.parametrize(
    ("found", "answer", "words"),
    [
        (disparities_of, flat(1.0), ("two arrays",)),
        (disparities_of, (flat(1.0), flat(1.0, shape=(40, 30))), ("right disparity", "(30, 40)", "(40, 30)")),
        (disparities_of, (flat(1, np.int64), flat(1.0)), ("left disparity", "int64")),
        (disparities_of, (flat(1.0), [1.0]), ("right disparity", "list")),
        (disparities_of, (flat(-2.0), flat(1.0)), ("left disparity", "-2.0", "x_left - x_right")),
        (disparities_of, (flat(1.0), flat(float("inf"))), ("right disparity", "inf")),
        (disparities_of, KeyError("weights"), ("failed: KeyError", "weights")),
        (depths_of, [flat(1.0)], ("depth of each image",)),
        (depths_of, {("left", 0): flat(1.0)}, ("depth of each image", "right")),
        (depths_of, dict.fromkeys(VIEWS, flat(0.0)), ("above 0 or NaN", "0.0")),
        (depths_of, dict.fromkeys(VIEWS, flat(1.0, shape=(40, 30))), ("(30, 40)", "(40, 30)")),
        (depths_of, dict.fromkeys(VIEWS, flat(1, np.int64)), ("int64",)),
        (matches_of, None, ("feature", "Correspondences", "NoneType")),
        (matches_of, Correspondences(left=np.full((3, 4), 900.0)), ("left", "outside", "40 x 30")),
        (matches_of, Correspondences(tracks=np.full((1, 8), -5.0)), ("tracks", "outside")),
        (matches_of, ValueError("no descriptors"), ("failed: ValueError: no descriptors",)),
    ],
)
def test_wrong_answers_are_refused_in_one_line(found: Any, answer: Any, words: tuple[str, ...]) -> None:
    with refused("matcher 'mine'", *words):
        found(answer)


def test_sub_pixel_positions_at_the_border_pass() -> None:
    corner = Correspondences(left=np.array([[-0.4, -0.4, 39.4, 29.4]]))
    assert find_correspondences(entry_of(Finds(corner)), IMAGES) is corner


@pytest.mark.parametrize("name", RIGS)
def test_level_images_hold_what_both_cameras_show(name: str) -> None:
    rig, rng = RIGS[name], np.random.default_rng(3)
    level, ends = widened(rig), rig.camera.ideal
    # Points all around, up to a disparity of a quarter of the image's width; within twice the size, the limit.
    pixels = rng.uniform(-0.49, 1.49, (20_000, 2)) * (ends.width, ends.height)
    disparity = rng.uniform(0.0, 0.25 * ends.width, (len(pixels), 1))
    pixels[:, 0] = np.maximum(pixels[:, 0], disparity[:, 0] - 0.49 * ends.width)
    other = pixels - disparity * [1.0, 0.0]
    rays = [ends.unproject(each) for each in (pixels, other)]
    shown = [rig.eye(side).contains(rig.eye(side).project(each)) for side, each in zip(SIDES, rays, strict=True)]
    assert 100 < np.count_nonzero(shown[0] & shown[1]) < 0.6 * len(pixels)
    for each in rays:
        assert np.all(level.contains(level.project(each[shown[0] & shown[1]])))


def test_black_borders_do_not_widen_the_search() -> None:
    """Both images show noise at a disparity of 8 px within a band; beyond it the right one is black."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (240, 420)).astype(np.float32), None, 2.0)
    wall = np.clip((wall - 127.5) * 4.0 + 127.5, 0.0, 255.0).astype(np.uint8)
    left, right, seen = wall[:, :400], wall[:, 8:408].copy(), np.ones((240, 400), np.bool_)
    seen[:, 200:] = False
    right[~seen] = 0
    rig = StereoRig(camera=PinholeCamera.centred(400, 240, 300.0), baseline=0.2)
    limited = SgmMatcher().limited(left, right, rig, [np.ones_like(seen), seen])
    assert isinstance(limited, SgmMatcher)
    # The search at a quarter of the size finds 2 px or so, to which a tenth and a pixel are added.
    assert limited.num_disparities is not None and 8 <= limited.num_disparities <= 16
    assert SgmMatcher(num_disparities=40).limited(left, right, rig, [seen, seen]).num_disparities == 40
