"""Features and their matches, against closed-form worlds; alignment of patches, on images given by a formula."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rsbench.core.correspondences import Correspondences, unlinked_pairs
from rsbench.core.projection import back_project, rs_project
from rsbench.core.rig import SIDES, View
from rsbench.vision.feature_matcher import find_correspondences, load_features
from rsbench.vision.features import (
    MatchOptions,
    SiftMatcher,
    align,
    best_two,
    close_loops,
    detect,
    forget_features,
    match_stereo_frames,
    refine_matches,
    smoothed,
)

Build = Callable[..., Any]
Four = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def images(scene: Any, u8: Build) -> Four:
    left_0, right_0, left_1, right_1 = (scene.rolling(side, k)[0] for k in (0, 1) for side in ("left", "right"))
    return u8(left_0), u8(right_0), u8(left_1), u8(right_1)


@pytest.mark.parametrize(("half", "size", "atol"), [(False, (300, 300), 0.01), (True, (401, 399), 0.03)])
def test_blob_centres_have_no_offset(half: bool, size: tuple[int, int], atol: float) -> None:
    """Gaussian blobs at known sub-pixel places: OpenCV's default would be 0.25 px off in x and in y.

    At half the size a pixel is twice as large, and a little more where the size is odd.
    """
    rng, spacing = np.random.default_rng(0), 60.0 if half else 44.0
    y, x = np.mgrid[: size[0], : size[1]]
    centres = np.stack(np.meshgrid(np.arange(6), np.arange(6)), -1).reshape(-1, 2) * spacing + (45 if half else 40)
    centres += rng.uniform(-0.5, 0.5, centres.shape)
    image = np.full(size, 60.0)
    for (cx, cy), sigma in zip(centres, rng.uniform(*((4, 8) if half else (2, 5)), len(centres)), strict=True):
        image += 120 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    points = detect(np.clip(np.rint(image), 0, 255).astype(np.uint8), MatchOptions(half=half)).points
    distance = np.linalg.norm(points[:, None] - centres, axis=-1)
    found = distance.min(axis=1) < 1 + half
    assert np.unique(distance[found].argmin(axis=1)).size > 30
    offset = points[found] - centres[distance[found].argmin(axis=1)]
    assert np.all(np.abs(offset.mean(axis=0)) < atol)
    assert half or np.all(np.abs(offset) < 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_best_two_is_exhaustive_search(seed: int) -> None:
    """Against all distances in float64, masked by the window."""
    rng = np.random.default_rng(seed)
    sets = []
    for n in (300, 700):  # more than one chunk
        points = rng.uniform(0, 50, (n, 2))
        sets.append((points[np.argsort(points[:, 1])], rng.integers(0, 256, (n, 128)).astype(np.float32)))
    (pa, da), (pb, db) = sets
    best, nearest, second, back = best_two(pa, da, pb, db, (-20.0, 5.0), (-8.0, 9.0))
    gap = pb - pa[:, None]
    allowed = (gap[..., 0] >= -20) & (gap[..., 0] <= 5) & (gap[..., 1] >= -8) & (gap[..., 1] <= 9)
    distance = ((da[:, None].astype(float) - db) ** 2).sum(-1)
    distance[~allowed] = np.inf
    ordered = np.sort(distance, axis=1)
    np.testing.assert_array_equal(nearest, ordered[:, 0])
    np.testing.assert_array_equal(second, ordered[:, 1])
    some = np.isfinite(ordered[:, 0])
    np.testing.assert_array_equal(best[some], distance[some].argmin(axis=1))
    assert np.all(best[~some] == -1)
    np.testing.assert_array_equal(back, np.where(allowed.any(axis=0), distance.argmin(axis=0), -1))


def _flow_error(scene: Any, matches: np.ndarray, source: tuple[Any, int], target: tuple[Any, int]) -> np.ndarray:
    """Distance, px, from the matched point to where ``rs_project`` puts the exact point of the surface."""
    rig, shutter, motion = scene.rig, scene.shutter, scene.motion
    pose = rig.cam_from_world(motion, shutter.row_time(matches[:, 1], source[1]), source[0])
    depth, _, _ = scene.depth_along(pose, matches[:, :2])
    points = back_project(rig, shutter, motion, *source, matches[:, :2], depth)
    return np.linalg.norm(rs_project(rig, shutter, motion, *target, points).pixels - matches[:, 2:], axis=1)


def test_matches_follow_the_true_flow(scene: Any, images: Four) -> None:
    found = match_stereo_frames(*images)
    pairs = {
        "left": (("left", 0), ("left", 1)),
        "right": (("right", 0), ("right", 1)),
        "stereo_0": (("left", 0), ("right", 0)),
        "stereo_1": (("left", 1), ("right", 1)),
    }
    for name, (source, target) in pairs.items():
        matches = getattr(found, name)
        assert len(matches) > 100
        error = _flow_error(scene, matches, source, target)
        assert np.nanmedian(error) < 0.15
        assert np.mean(~(error < 2.0)) < 0.05
    for name in ("stereo_0", "stereo_1"):
        matches = getattr(found, name)
        assert np.all(matches[:, 0] > matches[:, 2])
        assert np.all(np.abs(matches[:, 1] - matches[:, 3]) <= 1.5)


def test_where_tracks_are_enough_there_are_no_pairs(images: Four) -> None:
    views: tuple[View, ...] = (("left", 0), ("right", 0), ("left", 1), ("right", 1))
    seen = dict(zip(views, images, strict=True))
    everything = SiftMatcher(refine=True).match(seen)
    count = len(everything.tracks)
    alone = SiftMatcher(refine=True, enough_tracks=count).match(seen)
    np.testing.assert_array_equal(alone.tracks, everything.tracks)
    assert not any(len(each) for each in (alone.left, alone.right, alone.stereo_0, alone.stereo_1))
    assert len(SiftMatcher(refine=True, enough_tracks=count + 1).match(seen).left) == len(everything.left)


def test_loops_close_or_open_or_contradict() -> None:
    left = np.array([[0, 10], [1, 11], [2, 12], [3, 13]])
    right = np.array([[20, 30], [21, 31], [22, 32]])
    stereo_0 = np.array([[0, 20], [1, 21], [2, 22]])
    stereo_1 = np.array([[10, 30], [11, 32], [13, 31]])
    np.testing.assert_array_equal(close_loops(left, right, stereo_0, stereo_1), [[0, 20, 10, 30]])
    none = np.zeros((0, 2), dtype=np.int64)
    for sets in ((none, right, stereo_0, stereo_1), (left, none, stereo_0, stereo_1), (left, right, none, none)):
        assert close_loops(*sets).shape == (0, 4)


def test_search_radius_bounds_temporal_matches(images: Four) -> None:
    """Points move by 11 to 20 px and have disparities of 17 to 46 px: the bounds keep some and cut some off."""
    found = match_stereo_frames(*images, MatchOptions(search_radius=14.0, max_disparity=20.0))
    free = match_stereo_frames(*images)

    def shifts(matches: np.ndarray) -> np.ndarray:
        return np.abs(matches[:, 2:] - matches[:, :2])

    for name in ("left", "right"):
        bounded, unbounded = shifts(getattr(found, name)), shifts(getattr(free, name))
        assert len(bounded) > 100
        assert bounded.max() <= 14.0 < unbounded.max()
    bounded, unbounded = shifts(found.stereo_0)[:, 0], shifts(free.stereo_0)[:, 0]
    assert len(bounded) > 100
    assert bounded.max() <= 20.0 < unbounded.max()


@pytest.mark.parametrize("value", [0, 128, 255])
def test_no_texture_is_no_match(value: int) -> None:
    flat = np.full((60, 80, 3), value, dtype=np.uint8)
    found = match_stereo_frames(flat, flat, flat, flat)
    for name in ("left", "right", "stereo_0", "stereo_1", "tracks"):
        assert len(getattr(found, name)) == 0


def test_one_blank_image_leaves_the_other_sets(images: Four) -> None:
    found = match_stereo_frames(images[0], images[1], images[2], np.zeros_like(images[3]))
    assert len(found.left) > 100 and len(found.stereo_0) > 100
    assert len(found.right) == len(found.stereo_1) == len(found.tracks) == 0


@pytest.mark.parametrize("shape", [(60, 80, 2), (60,), (0, 80), (60, 80, 3, 1)])
def test_bad_shapes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="image must have shape"):
        detect(np.zeros(shape, dtype=np.uint8))


def test_bad_types_sizes_and_options(images: Four) -> None:
    with pytest.raises(ValueError, match="uint8 or uint16"):
        detect(images[0].astype(np.float32))
    with pytest.raises(ValueError, match="right_1 must have the size"):
        match_stereo_frames(images[0], images[1], images[2], images[3][:-1])
    wrong: list[dict[str, Any]] = [
        {"ratio": 0.0},
        {"max_features": -1},
        {"search_radius": 0.0},
        {"row_tolerance": -1.0},
    ]
    for options in wrong:
        with pytest.raises(ValueError, match="must"):
            MatchOptions(**options)


def test_frames_of_keypoints_are_the_similarity_between_the_images() -> None:
    """A picture turned by 20 degrees, 1.2 times as large; bins of SIFT are 10 degrees and a third of an octave."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (400, 400)).astype(np.float32), (0, 0), 3.0)
    picture = np.clip(128 + 8.0 * (picture - picture.mean()), 0, 255).astype(np.uint8)
    turn = 1.2 * np.array([[np.cos(0.35), -np.sin(0.35)], [np.sin(0.35), np.cos(0.35)]])
    shift = np.array([200.0, 200.0]) - turn @ [200.0, 200.0]
    turned = cv2.warpAffine(picture, np.column_stack([turn, shift]), (400, 400), flags=cv2.INTER_CUBIC)
    images: dict[View, NDArray[np.uint8]] = {
        ("left", 0): picture,
        ("right", 0): picture,
        ("left", 1): turned,
        ("right", 1): turned,
    }
    found = find_correspondences(load_features("sift-affine"), images)
    right = np.linalg.norm(found.left[:, :2] @ turn.T + shift - found.left[:, 2:], axis=1) < 1.0
    assert np.sum(right) > 100
    np.testing.assert_allclose(np.median(found.affine[right], axis=0), turn.ravel(), atol=0.02)
    assert np.median(np.abs(found.affine[right] - turn.ravel())) < 0.1
    assert len(find_correspondences(load_features("sift"), images).affine) == 0


_SIZE = 96
_WAVES = np.random.default_rng(5).uniform(-0.55, 0.55, (24, 2))
"""Angular frequencies, per px: waves of 11 px and more, which the smoothing leaves."""
_PHASES = np.random.default_rng(6).uniform(0.0, 2.0 * np.pi, 24)
_PLACES = np.stack(np.meshgrid(np.arange(20.3, 76.0, 9.0), np.arange(20.7, 76.0, 9.0)), axis=-1).reshape(-1, 2)


def _levels(places: np.ndarray) -> np.ndarray:
    """Grey levels (...), 20 to 235, at places (..., 2)."""
    return 127.5 + 8.0 * np.sum(np.cos(places @ _WAVES.T + _PHASES), axis=-1)


def _image(A: np.ndarray, t: np.ndarray, gain: float = 1.0, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """The scene as a camera sees it in which the point p of the scene lies at A p + t."""
    grid = np.stack(np.meshgrid(np.arange(_SIZE), np.arange(_SIZE)), axis=-1).astype(np.float64)
    levels = gain * (_levels((grid - t) @ np.linalg.inv(A).T) - 127.5) + 127.5
    levels += noise * np.random.default_rng(seed).standard_normal(levels.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


@settings(max_examples=12)
@given(
    shear=st.lists(st.floats(-0.08, 0.08), min_size=4, max_size=4),
    shift=st.lists(st.floats(-0.45, 0.45), min_size=2, max_size=2),
    gain=st.floats(0.8, 1.0),
)
def test_patches_follow_affine_maps(shear: list[float], shift: list[float], gain: float) -> None:
    """The smoothing does not shear with the map and the cubic kernel is not exact: up to 0.05 px, in the median a
    tenth of it. Rounding to whole levels, 0.29 levels of gradients of some 10 a pixel, leaves as much in weak
    patches."""
    A = np.eye(2) + np.reshape(shear, (2, 2))
    t = np.array(shift) + 48.0 - A @ [48.0, 48.0]
    truth = _PLACES @ A.T + t
    rough = np.rint(truth * 2.0) / 2.0
    found, done, _ = align(smoothed(_image(np.eye(2), np.zeros(2))), smoothed(_image(A, t, gain)), _PLACES, rough)
    assert np.mean(done) > 0.9
    assert np.median(np.abs(found - truth)[done]) < 0.015
    assert np.max(np.abs(found - truth)[done]) < 0.12


@pytest.mark.parametrize("eighths", [2, 6])
def test_fractions_of_a_pixel_do_not_pull(eighths: int) -> None:
    """Pixels are means of areas of a texture that is finer than they are, as in cameras without a low-pass filter.

    With Keys' kernel, shifts of 2 and 6 eighths of a pixel are 0.02 px too large and too small in the mean, whose
    deviation is 0.0001 px; with the spline 0.003 px.
    """
    rng, size = np.random.default_rng(eighths), 8 * (400 + 1)
    texture = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), 5.0)
    levels = 128.0 + 50.0 / float(np.std(texture)) * texture
    a, b = (
        smoothed(np.clip(np.rint(_pixels(levels[:, first:])), 0, 255).astype(np.uint8))
        for first in (8, 8 - eighths)
    )
    places = np.stack(np.meshgrid(np.arange(20.0, 381.0, 15.0), np.arange(20.0, 381.0, 15.0)), axis=-1).reshape(
        -1, 2
    )
    found, done, _ = align(a, b, places, places)
    assert np.all(done)
    assert abs(np.mean(found[:, 0] - places[:, 0]) - eighths / 8.0) < 0.005


def _pixels(texture: np.ndarray) -> np.ndarray:
    """Means (400, 400) over squares of 8 x 8."""
    return texture[:3200, :3200].reshape(400, 8, 400, 8).mean(axis=(1, 3))


def test_noise_decides_how_well() -> None:
    """At 1.5 levels of noise in each image, least squares leave 1.5 sqrt(2) over the root of the summed squares of
    the gradients, of which the smoothing and the weights keep a half: some 0.02 px here."""
    shift = np.array([0.3, -0.2])
    a, b = (smoothed(_image(np.eye(2), t, noise=1.5, seed=n)) for n, t in enumerate((np.zeros(2), shift)))
    found, done, _ = align(a, b, _PLACES, _PLACES)
    dx, dy = (_levels(_PLACES + step) - _levels(_PLACES - step) for step in ([0.5, 0.0], [0.0, 0.5]))
    bound = 1.5 * np.sqrt(2.0) / np.sqrt(0.5 * 100.0 * np.mean(np.concatenate([dx, dy]) ** 2))
    assert np.all(done)
    assert 0.5 * bound < np.sqrt(np.mean((found - _PLACES - shift) ** 2)) < 2.0 * bound


@pytest.mark.parametrize("levels", [128.0, None])
def test_what_cannot_be_aligned_stays(levels: float | None) -> None:
    """No texture, another scene, and a patch beyond the border."""
    a = smoothed(_image(np.eye(2), np.zeros(2)))
    other = np.random.default_rng(1).integers(0, 255, (_SIZE, _SIZE)).astype(np.uint8)
    b = smoothed(other if levels is None else np.full((_SIZE, _SIZE), levels, dtype=np.uint8))
    places = np.array([[48.0, 48.0], [3.0, 48.0], [48.0, 94.0]])
    found, done, _ = align(a, b, places, places)
    assert not np.any(done)
    np.testing.assert_array_equal(found, places)


@pytest.mark.slow
def test_a_track_stays_one_in_all_sets() -> None:
    images: dict[View, NDArray[np.uint8]] = {
        (side, frame): _image(np.eye(2), np.array([-1.5 * (side == "right") + 0.7 * frame, 0.4 * frame]))
        for side in SIDES
        for frame in (0, 1)
    }
    place = np.array([[40.2, 44.9], [55.1, 51.3], [61.0, 30.5]])
    ends = [np.add(place, (-1.5 * right + 0.7 * frame, 0.4 * frame)) for frame in (0, 1) for right in (0, 1)]
    tracks = np.concatenate([ends[0], *(np.add(end, 0.2) for end in ends[1:])], axis=1)
    matches = Correspondences(
        left=tracks[:, [0, 1, 4, 5]],
        right=tracks[:, [2, 3, 6, 7]],
        stereo_0=tracks[:2, :4],
        stereo_1=tracks[:, 4:],
        tracks=tracks[:2],
    )
    found = refine_matches(images, matches)
    np.testing.assert_allclose(found.tracks, np.concatenate(ends, axis=1)[:2], atol=0.02)
    assert [len(found.left), len(found.right), len(found.stereo_0), len(found.stereo_1)] == [3, 3, 2, 3]
    assert np.count_nonzero(unlinked_pairs(found, "left")) == np.count_nonzero(unlinked_pairs(found, "right")) == 1


def test_features_are_those_of_the_image_and_the_options_that_are_asked_for() -> None:
    rng = np.random.default_rng(0)
    image = np.asarray(255 * rng.random((60, 80)), dtype=np.uint8)
    found = detect(image)
    assert detect(image.copy()) is found
    forget_features()
    assert detect(image) is not found
    few = detect(image, MatchOptions(max_features=5))
    assert len(few.points) < len(detect(image).points)
    image[:] = 0
    assert len(detect(image).points) == 0
