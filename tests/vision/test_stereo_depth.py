"""Disparity, its refinement, the sky, and cameras that read their lines at different times."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from analytic_dataset import plane_colours, plane_depth
from numpy.typing import NDArray

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import row_poses
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scanning
from rsbench.vision.stereo_depth import (
    SgmOptions,
    depth_metrics,
    disparity_range,
    fill_holes,
    moving_disparities,
    refine_disparity,
    seen_by_other,
    sky_mask,
    stereo_disparities,
    stereo_disparity,
)
from rsbench.vision.stereo_matcher import load_matcher

Build = Callable[..., Any]
Pair = tuple[np.ndarray, np.ndarray]
RIG = StereoRig(camera=PinholeCamera.centred(200, 160, 260.0), baseline=0.4)


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    """A slanted wall and a ball, rolling shutter, strong motion: the rows still match."""
    Plane, Sphere = shapes
    return world((Plane((0.3, 0.3, 1), 7), Sphere((0.1, 0.1, 4), 0.6)), size=(240, 320), focal=400, shortest=0.12)


@pytest.fixture(scope="module")
def pair(scene: Any, u8: Build) -> Pair:
    return u8(scene.rolling("left", 1)[0]), u8(scene.rolling("right", 1)[0])


def _flat(disparity: np.ndarray) -> np.ndarray:
    d = disparity.astype(np.float32)
    kernel = np.ones((11, 11), dtype=np.uint8)
    return cv2.dilate(d, kernel) - cv2.erode(d, kernel) < 3.0


def _bias(error: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Median error by eighths of the fraction of the true disparity: pixel locking shows as a wave."""
    fraction = truth - np.floor(truth)
    return np.array([np.median(error[(fraction >= a) & (fraction < a + 0.125)]) for a in np.arange(0, 1, 0.125)])


@pytest.mark.parametrize("side", ["left", "right"])
def test_disparity_is_true_to_hundredths_of_a_pixel(scene: Any, pair: Pair, side: Any) -> None:
    truth = scene.rig.disparity(scene.rolling(side, 1)[1])
    raw = stereo_disparity(*pair, scene.rig, side, SgmOptions(refine_iterations=0))
    fine = stereo_disparity(*pair, scene.rig, side)
    assert fine.dtype == np.float32 and fine.shape == truth.shape
    np.testing.assert_array_equal(np.isfinite(raw), np.isfinite(fine))
    good = np.isfinite(fine) & _flat(truth)
    # Seen by both cameras: the rest of the image must be matched.
    columns = np.arange(320) - truth if side == "left" else np.arange(320) + truth
    both = (columns >= 0) & (columns <= 319) & _flat(truth)
    assert np.mean(np.isfinite(fine)[both]) > 0.97
    error = (fine - truth)[good]
    assert np.median(np.abs(error)) < 0.03
    assert np.mean(np.abs(error) > 0.5) < 0.01
    # The matcher's own interpolation is off by more than 0.1 px at some fractions, the refined one nowhere.
    assert np.abs(_bias((raw - truth)[good], truth[good])).max() > 0.1
    assert np.abs(_bias(error, truth[good])).max() < 0.015


def test_both_sides_are_the_two_single_sides(scene: Any, pair: Pair) -> None:
    left, right = stereo_disparities(*pair, scene.rig)
    np.testing.assert_array_equal(left, stereo_disparity(*pair, scene.rig, "left"))
    np.testing.assert_array_equal(right, stereo_disparity(*pair, scene.rig, "right"))


def test_a_band_that_the_other_camera_misses_is_unknown(scene: Any, pair: Pair) -> None:
    """The left band of the left image and the right band of the right one stay unknown, and nothing else."""
    left, right = stereo_disparities(*pair, scene.rig)
    true_left = scene.rig.disparity(scene.rolling("left", 1)[1])
    true_right = scene.rig.disparity(scene.rolling("right", 1)[1])
    columns = np.arange(320)
    assert np.mean(np.isfinite(left)[columns - true_left < -2]) < 0.02
    assert np.mean(np.isfinite(right)[columns + true_right > 321]) < 0.02
    # OpenCV alone would leave out as many columns as there are disparities.
    assert np.mean(np.isfinite(left)[(columns - true_left > 2) & (columns < 60)]) > 0.9


def test_a_square_before_a_wall_hides_the_band_that_geometry_says() -> None:
    """Disparity 30 before 10: the left camera sees 20 columns left of the square that the right one does not."""
    square = {"left": slice(100, 150), "right": slice(70, 120)}
    depth = {}
    for side, columns in square.items():
        disparity = np.full((40, 200), 10.0)
        disparity[10:30, columns] = 30.0
        depth[side] = RIG.depth(disparity)
    depth["left"][0], depth["right"][0] = np.nan, np.nan  # sky
    hidden = {"left": (slice(80, 100), slice(0, 10)), "right": (slice(120, 140), slice(190, 200))}
    sides: tuple[Side, Side] = ("left", "right")
    for side, other in (sides, sides[::-1]):
        expected = np.ones((40, 200), dtype=np.bool_)
        band, outside = hidden[side]
        expected[10:30, band], expected[:, outside], expected[0] = False, False, False
        np.testing.assert_array_equal(seen_by_other(depth[side], depth[other], RIG, side), expected)


@pytest.mark.parametrize("mode", ["sgbm", "hh", "3way", "hh4"])
def test_every_mode_matches(scene: Any, pair: Pair, mode: Any) -> None:
    truth = scene.rolling("left", 1)[1]
    found = stereo_disparity(*pair, scene.rig, options=SgmOptions(mode=mode, num_disparities=64))
    scores = depth_metrics(scene.rig.depth(found), truth, scene.rig)
    assert scores["coverage"] > 0.75 and scores["bad_1px"] < 0.03 and scores["median_m"] < 0.02


def test_range_from_depth_number_and_images(scene: Any, pair: Pair) -> None:
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in pair)

    def count(**options: Any) -> int:
        return disparity_range(left, right, scene.rig, SgmOptions(**options))

    assert count(nearest_depth=3.0) == 64  # 400 px * 0.4 m / 3 m = 53.3 px
    assert count(num_disparities=70) == 80
    assert count(nearest_depth=0.01) == 320  # never more than the image is wide
    largest = float(np.max(scene.rig.disparity(scene.rolling("left", 1)[1])))
    assert largest <= count() <= 2 * largest + 32


@pytest.mark.parametrize("value", [0, 128, 255])
def test_no_texture_is_no_depth(value: int) -> None:
    flat = np.full((160, 200, 3), value, dtype=np.uint8)
    for disparity in stereo_disparities(flat, flat, RIG):
        assert np.all(np.isnan(disparity))
    assert depth_metrics(RIG.depth(disparity), np.ones((160, 200)), RIG)["coverage"] == 0.0


def test_refinement_finds_a_constant_shift() -> None:
    """A pattern moved by a known fraction, started 0.4 px away on either side; NaN stays."""
    y, x = np.mgrid[:60, :90].astype(np.float64)

    def pattern(at: np.ndarray) -> np.ndarray:
        wave = 40 * np.sin(at / 2.1 + y / 5) + 30 * np.sin(at / 3.7 - y / 3) + 20 * np.sin(at / 6.1 + 1)
        return np.rint(128 + wave).astype(np.uint8)

    shift = 7.37
    left, right = pattern(x), pattern(x + shift)
    for start in (shift - 0.4, shift + 0.4):
        initial = np.full((60, 90), start, dtype=np.float32)
        initial[20:22, 30:40] = np.nan
        refined = refine_disparity(left, right, initial, iterations=3)
        np.testing.assert_array_equal(np.isnan(refined), np.isnan(initial))
        inner = refined[:, 16:-6]
        # Rounding to 8 bits and the cubic's own error; worst where the phases leave a window little slope.
        assert np.nanmedian(np.abs(inner - shift)) < 0.015
        assert np.nanmax(np.abs(inner - shift)) < 0.06
    np.testing.assert_array_equal(refine_disparity(left, right, initial, iterations=0), initial)


@pytest.mark.parametrize("eighths", [2, 6])
def test_refinement_of_aliased_images_does_not_depend_on_the_fraction(eighths: int) -> None:
    """Pixels are means of areas of a texture that is finer than they are, as in cameras without a low-pass filter.

    At shifts of 2 and 6 eighths of a pixel, Keys' kernel errs by 0.046 px in the mean, the spline by 0.012 px.
    """
    rng = np.random.default_rng(eighths)
    texture = cv2.GaussianBlur(rng.standard_normal((1600, 2480)).astype(np.float32), (0, 0), 5.0)
    levels = 128.0 + 50.0 / float(np.std(texture)) * texture

    def pixels(first: int) -> np.ndarray:
        means = levels[:, first : first + 2400].reshape(200, 8, 300, 8).mean(axis=(1, 3))
        return np.clip(np.rint(means), 0, 255).astype(np.uint8)

    truth = 5.0 + eighths / 8.0
    initial = np.full((200, 300), 5.5, dtype=np.float32)
    refined = refine_disparity(pixels(0), pixels(40 + eighths), initial)[:, 16:-6]
    assert abs(float(np.mean(refined)) - truth) < 0.015


def test_holes_are_filled_from_behind() -> None:
    nan = np.nan
    rows = np.array(
        [[nan, 4, nan, nan, 2, nan], [nan] * 6, [1, 2, 3, 4, 5, 6], [nan, nan, nan, 7, nan, 9]], dtype=np.float32
    )
    expected = [[4, 4, 2, 2, 2, 2], [nan] * 6, [1, 2, 3, 4, 5, 6], [7, 7, 7, 7, 7, 9]]
    np.testing.assert_array_equal(fill_holes(rows), expected)


def test_metrics_of_known_errors() -> None:
    """Ten surface pixels at 10 m (10.4 px), one of each fault, and three of sky; depth by hand."""
    truth = np.full((1, 13), 10.0)
    truth[0, 10:] = 0.0, np.inf, 0.0  # sky either way
    estimate = truth.copy()
    estimate[0, 12] = 5.0
    estimate[0, :6] = np.nan, 0.0, 13.0, 10.5, 7.0, np.inf
    scores = depth_metrics(estimate, truth, RIG)
    assert scores["coverage"] == pytest.approx(0.7)
    assert scores["median_m"] == 0.0
    assert scores["rmse_m"] == pytest.approx(math.sqrt((9 + 0.25 + 9) / 7))
    assert scores["over_2m"] == pytest.approx(2 / 7)
    # 104 / 13 = 8 px is 2.4 px off, 104 / 10.5 0.5 px, 104 / 7 4.5 px.
    assert scores["bad_1px"] == pytest.approx(2 / 7)
    assert scores["bad_2px"] == pytest.approx(2 / 7)
    assert scores["bad_3px"] == pytest.approx(1 / 7)
    assert scores["on_sky"] == pytest.approx(1 / 3)
    # The sky is no part of what can be seen by both cameras.
    part = depth_metrics(estimate, truth, RIG, np.isfinite(truth) & (truth > 0.0))
    assert part == scores


def test_metrics_without_pixels() -> None:
    for truth in (np.zeros((2, 2)), np.ones((2, 2))):
        scores = depth_metrics(np.full((2, 2), np.nan), truth, RIG)
        assert scores["coverage"] == 0.0
        assert scores["on_sky"] == 0.0 if truth[0, 0] == 0.0 else math.isnan(scores["on_sky"])
        errors = {name: value for name, value in scores.items() if name not in ("coverage", "on_sky")}
        assert all(math.isnan(value) for value in errors.values())
    with pytest.raises(ValueError, match="shape of truth"):
        depth_metrics(np.ones((2, 2)), np.ones((2, 3)), RIG)


def test_bad_input() -> None:
    good = np.zeros((160, 200), dtype=np.uint8)
    for left, right in ((good[:-1], good), (good, good[:, :-1]), (good.astype(np.float32), good)):
        with pytest.raises(ValueError, match="must"):
            stereo_disparity(left, right, RIG)
    wrong: list[dict[str, Any]] = [
        {"mode": "fast"},
        {"block_size": 4},
        {"num_disparities": 0},
        {"nearest_depth": -1.0},
        {"p1": 40},
        {"refine_iterations": -1},
        {"least_disparity": 0.0},
    ]
    for options in wrong:
        with pytest.raises(ValueError, match="must"):
            SgmOptions(**options)


def _frame(sky_colour: tuple[int, int, int] = (190, 205, 230)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture with a smooth upper third, its disparity as a matcher finds it, and the true sky."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 160, (90, 120, 3)).astype(np.uint8)
    sky = np.zeros((90, 120), dtype=bool)
    sky[:30] = True
    sky[20:30, 50:60] = False  # a chimney
    gradient = np.linspace(0, 6, 90)[:, None, None]
    smooth = np.clip(np.array(sky_colour) + gradient, 0, 255).astype(np.uint8)
    image[sky] = np.broadcast_to(smooth, image.shape)[sky]
    disparity = np.full((90, 120), 20.0, dtype=np.float32)
    disparity[60:] = 60.0  # the ground in front
    disparity[:5] = np.nan
    return image, disparity, sky


def test_a_smooth_bright_far_area_at_the_top_is_sky() -> None:
    image, disparity, sky = _frame()
    found = sky_mask(image, disparity)
    # The rim of one pixel may go either way.
    assert np.mean(found[sky]) > 0.97 and np.mean(found[~sky]) < 0.01


@pytest.mark.parametrize("kind", ["grey", "16 bit"])
def test_grey_and_deep_images(kind: str) -> None:
    image, disparity, sky = _frame()
    changed = image.mean(axis=-1).astype(np.uint8) if kind == "grey" else image.astype(np.uint16) * 257
    found = sky_mask(changed, disparity)
    assert np.mean(found[sky]) > 0.9 and np.mean(found[~sky]) < 0.02


def test_what_is_near_red_dark_below_or_without_disparity_is_no_sky() -> None:
    image, disparity, _ = _frame()
    near = np.where(np.arange(90)[:, None] < 45, np.float32(80.0), disparity)  # nearer than the ground
    seen = [(_frame(colour)[0], disparity) for colour in ((230, 190, 180), (20, 22, 30))]
    for each in (
        *seen,
        (image, near),
        (image[::-1].copy(), disparity[::-1].copy()),
        (image, np.full_like(disparity, np.nan)),
    ):
        assert not np.any(sky_mask(*each))


CAMERA = PinholeCamera.centred(160, 120, 140.0)
MOTION = LinearMotion([0.06, -0.03, 0.05], [0.15, 0.12, 0.1])
BARREL = Lens(model="brown-conrady", k1=-0.1)


def seen(rig: StereoRig, shutter: RollingShutter, side: Side) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image and depth of frame 0."""
    poses = row_poses(rig, shutter, MOTION, side, 0)
    if shutter.axis(side) == 1:
        depth = plane_depth(rig.camera, poses)
        return plane_colours(rig.camera, poses, depth), depth
    # Columns are the rows of a camera whose axes x and y are exchanged; the lens is alike in all directions.
    camera = replace(rig.camera, width=120, height=160, cx=rig.camera.cy, cy=rig.camera.cx)
    turned = Pose(poses.R[:, [1, 0, 2]], poses.t[:, [1, 0, 2]])
    depth = plane_depth(camera, turned)
    return np.swapaxes(plane_colours(camera, turned, depth), 0, 1).copy(), depth.T.copy()


@pytest.mark.parametrize(
    ("lens", "scanning"),
    [(None, {"right_delay": 0.3}), (None, {"scan": "top", "right_scan": "bottom"}), (BARREL, {"scan": "left"})],
    ids=["late", "opposite", "columns through a lens"],
)
def test_depth_is_that_of_the_planes(lens: Lens | None, scanning: dict[str, Any]) -> None:
    rig = StereoRig(camera=replace(CAMERA, lens=lens), baseline=0.4)
    shutter = Scanning(**scanning).shutter_of(160, 120, 0.9)
    images, truth = dict[Side, NDArray[np.uint8]](), dict[Side, NDArray[np.float32]]()
    for side in SIDES:
        images[side], truth[side] = seen(rig, shutter, side)
    found = moving_disparities(load_matcher("sgm"), images, rig, shutter, MOTION, 0)
    for side, disparity in zip(SIDES, found, strict=True):
        known, right = np.isfinite(disparity), rig.disparity(truth[side])
        off = np.abs(disparity - right)
        # Waves of 12 px are matched to some hundredths of a pixel; the corner of both planes is where it errs.
        assert np.mean(known) > 0.6
        assert np.median(off[known]) < 0.1 and np.mean(off[known] > 1.0) < 0.05
    still = stereo_disparities(images["left"], images["right"], rig.ideal)[0]
    wrong = ~(np.abs(still - rig.disparity(truth["left"])) <= 1.0)
    assert np.mean(wrong) > 2 * np.mean(~(np.abs(found[0] - rig.disparity(truth["left"])) <= 1.0))


def test_depth_of_a_vertical_rig_is_that_of_the_planes() -> None:
    """Columns of a level rig are rows of one that is turned by 90 degrees, and its pixels those turned."""
    level = StereoRig(camera=CAMERA, baseline=0.4)
    turned = PinholeCamera.centred(120, 160, 140.0)
    rig = StereoRig.of_cameras(turned, turned, np.eye(3), [0.0, -0.4, 0.0])
    columns, rows = Scanning(scan="left").shutter_of(160, 120, 0.9), Scanning().shutter_of(120, 160, 0.9)
    images, truth = dict[Side, NDArray[np.uint8]](), dict[Side, NDArray[np.float32]]()
    for side in SIDES:
        image, truth[side] = seen(level, columns, side)
        images[side] = np.ascontiguousarray(np.rot90(image, -1))
    found = moving_disparities(load_matcher("sgm"), images, rig, rows, MOTION, 0)
    for side, disparity in zip(SIDES, found, strict=True):
        off = np.abs(np.rot90(disparity) - level.disparity(truth[side]))
        known = np.isfinite(off)
        assert np.mean(known) > 0.6
        assert np.median(off[known]) < 0.1 and np.mean(off[known] > 1.0) < 0.05
