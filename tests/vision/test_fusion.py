"""Filling disocclusions, against the closed-form world of conftest; narrow holes and seams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rsbench.core.camera import PinholeCamera
from rsbench.core.projection import row_poses
from rsbench.core.se3 import Pose
from rsbench.vision.correction import warp
from rsbench.vision.fusion import Fused, Origin, SourceView, finished, fuse, inpaint
from rsbench.vision.quality import psnr

Build = Callable[..., Any]


def _card(centre_x: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda X: (np.abs(X[..., 0] - centre_x) < 0.5) & (np.abs(X[..., 1]) < 0.6)


@pytest.fixture(scope="module")
def scene(world: Build, shapes: Any) -> Any:
    """A leaning wall behind a card; the motion to the right opens a strip of wall beside the card."""
    plane = shapes[0]
    surfaces = (plane((0.05, 0.1, 1.0), 7.0), plane((0.0, 0.0, 1.0), 3.0, _card(0.0)))
    return world(surfaces, d=(0.25, -0.1, 0.1), baseline=0.4)


def _view(scene: Any, side: Any, frame: int, origin: Origin) -> SourceView:
    image, depth = scene.rolling(side, frame)
    poses = row_poses(scene.rig, scene.shutter, scene.motion, side, frame)
    return SourceView(image=image.astype(np.float32), depth=depth.astype(np.float32), poses=poses, origin=origin)


def _fuse(scene: Any, *views: SourceView, tau: float = 0.0) -> Any:
    target = scene.rig.cam_from_world(scene.motion, tau, "left")
    return fuse(views, scene.rig.camera, target)


def _all_views(scene: Any) -> list[SourceView]:
    return [
        _view(scene, "left", 0, Origin.HERE),
        _view(scene, "right", 0, Origin.OTHER_CAMERA),
        _view(scene, "left", 1, Origin.OTHER_FRAME),
        _view(scene, "right", 1, Origin.OTHER_FRAME),
    ]


def test_what_the_frame_saw_stays_as_it_is(scene: Any) -> None:
    views = _all_views(scene)
    alone, fused = _fuse(scene, views[0]), _fuse(scene, *views)
    here = alone.origin == Origin.HERE
    np.testing.assert_array_equal(here, fused.origin == Origin.HERE)
    np.testing.assert_array_equal(alone.image[here], fused.image[here])
    target = scene.rig.cam_from_world(scene.motion, 0.0, "left")
    np.testing.assert_array_equal(here, warp(views[0], scene.rig.camera, target).mask)


def test_holes_show_what_the_other_frames_saw(scene: Any, truth: Build) -> None:
    """Every pixel of a hole that another frame saw, by the closed form, is filled with the true surface."""
    fused = _fuse(scene, *_all_views(scene))
    expected = truth(scene, "left", 0, 0.0)
    elsewhere = np.zeros(expected.visible.shape, dtype=bool)
    for side, frame in (("right", 0), ("left", 1), ("right", 1)):
        elsewhere |= truth(scene, side, frame, 0.0, target="left").visible
    hole = ~expected.visible & elsewhere
    assert hole.sum() > 200
    # A pixel at the very rim of a surface may go to either side of it.
    assert np.mean(fused.origin[hole] != Origin.NOBODY) > 0.97
    filled = np.isin(fused.origin, [Origin.OTHER_CAMERA, Origin.OTHER_FRAME]) & hole
    wrong = np.abs(fused.depth[filled] - expected.depth[filled]) > 0.01 * expected.depth[filled]
    assert np.mean(wrong) < 0.02
    # Resampling a texture of waves of ten pixels and more costs less than an rms of 0.018.
    assert psnr(fused.image, expected.image.astype(np.float32), filled) > 35.0


def test_nearer_surfaces_hide_farther_ones_among_the_fillers(scene: Any) -> None:
    """Two fillers that contradict each other: the nearer one is what the target sees, in whatever order."""
    camera = scene.rig.camera
    first = _view(scene, "left", 0, Origin.HERE)
    grey = np.full_like(first.image, 0.5)  # all images look alike, so that none contradicts another
    empty = SourceView(image=grey, depth=np.zeros_like(first.depth), poses=first.poses, origin=Origin.HERE)
    near, far = (
        SourceView(
            image=np.full_like(first.image, value),
            depth=np.full_like(first.depth, depth),
            poses=first.poses,
            origin=origin,
        )
        for value, depth, origin in ((0.48, 3.0, Origin.OTHER_CAMERA), (0.53, 9.0, Origin.OTHER_FRAME))
    )
    middle = (slice(40, camera.height - 40), slice(40, camera.width - 40))
    for order in ((near, far), (far, near)):
        fused = _fuse(scene, empty, *order)
        assert np.all(fused.origin[middle] == Origin.OTHER_CAMERA)
        np.testing.assert_allclose(fused.image[middle], 0.48, atol=1e-6)


def test_tears_in_one_surface_are_closed_and_views_past_an_edge_stay_open(scene: Any, truth: Build) -> None:
    """One pixel in twenty has twice its depth, lands behind its neighbours and leaves a hole in the surface."""
    left, expected = _view(scene, "left", 0, Origin.HERE), truth(scene, "left", 0, 0.0)
    off = np.random.default_rng(0).random(left.depth.shape) < 0.05
    seen = replace(left, depth=np.where(off, 2.0 * left.depth, left.depth))
    nothing = replace(left, depth=np.zeros_like(left.depth), origin=Origin.GUESSED)
    alone, closed = _fuse(scene, seen), _fuse(scene, seen, nothing)
    torn = (alone.origin == Origin.NOBODY) & expected.visible
    assert torn.sum() > 200
    assert np.mean(closed.origin[torn] == Origin.GUESSED) > 0.9  # the others lie between the card and the wall
    shut = torn & (closed.origin == Origin.GUESSED)
    # The depth of the farther side, within the 3 % by which the sides of one surface may differ.
    np.testing.assert_allclose(closed.depth[shut], expected.depth[shut], rtol=0.03)
    assert psnr(closed.image, expected.image.astype(np.float32), shut) > 30.0
    unseen = (alone.origin == Origin.NOBODY) & ~expected.visible
    assert unseen.sum() > 200 and np.mean(closed.origin[unseen] == Origin.NOBODY) > 0.9


@pytest.mark.parametrize("half_width", [0.03, 0.25])
def test_what_one_frame_alone_sees_is_not_replaced_by_what_lies_behind(
    world: Build, shapes: Any, half_width: float
) -> None:
    """A post of unknown depth that stands before the left camera's wall; the right camera sees wall everywhere.

    Where the left frame shows the post, no other frame's wall may stand; the post's pixels are guessed at most.
    """
    plane = shapes[0]
    wall = plane((0.05, 0.1, 1.0), 7.0)
    scene = world((wall,), d=(0.25, -0.1, 0.1), baseline=0.4)
    left, *others = _all_views(scene)
    at = np.abs(np.arange(scene.rig.camera.width) - 90.0) < 100.0 * half_width
    post = np.broadcast_to(at, left.depth.shape)
    image = np.where(post[..., None], np.float32(1.0), left.image * np.float32(0.5))
    seen = replace(left, image=image, depth=np.where(post, np.float32(0.0), left.depth))
    darker = [replace(view, image=view.image * np.float32(0.5)) for view in others]
    guess = replace(seen, depth=np.where(post, left.depth, np.float32(0.0)), origin=Origin.GUESSED)
    fused = _fuse(scene, seen, *darker, guess)
    where = warp(replace(left, image=post.astype(np.float32)), scene.rig.camera, _target(scene))
    inside = where.mask & (where.image > 0.999)
    assert np.count_nonzero(inside) > 500
    assert np.all(fused.origin[inside] == Origin.GUESSED) and np.all(fused.image[inside] > 0.9)
    # Where not even a guess is left, the wall is better than nothing, and marked as the others'.
    assert np.all(_fuse(scene, seen, *darker).origin[inside] >= Origin.OTHER_CAMERA)
    # What the frame does not contradict is still filled: the wall outside its picture.
    assert np.count_nonzero((fused.origin == Origin.OTHER_CAMERA) | (fused.origin == Origin.OTHER_FRAME)) > 50


def _target(scene: Any) -> Any:
    return scene.rig.cam_from_world(scene.motion, 0.0, "left")


@pytest.mark.parametrize("axis", [0, 1])
def test_a_point_half_a_pixel_past_the_last_centre_is_the_frame_s_own(axis: int) -> None:
    """19.4999999999 is inside a frame of 20 pixels, and 19.5 in float32, which rounds to 20."""
    camera = PinholeCamera.centred(20, 20, 10.0)
    here, target = Pose(R=np.tile(np.eye(3), (20, 1, 1)), t=np.zeros((20, 3))), Pose(R=np.eye(3), t=np.zeros(3))
    here.t[:, axis] = (0.5 - 1e-10) / 10.0
    grey = np.full((20, 20), 100.0, dtype=np.float32)
    blank = SourceView(image=grey, depth=np.zeros_like(grey), poses=here, origin=Origin.HERE)
    there = Pose(R=here.R, t=np.zeros((20, 3)))
    other = SourceView(image=grey, depth=np.ones_like(grey), poses=there, origin=Origin.OTHER_CAMERA)
    assert np.all(fuse([blank, other], camera, target).origin == Origin.OTHER_CAMERA)


def test_guesses_come_last_and_nothing_is_kept_unmarked(scene: Any) -> None:
    first = _view(scene, "left", 0, Origin.HERE)
    half = first.depth.copy()
    half[:, :60] = 0.0
    seen = SourceView(image=first.image, depth=half, poses=first.poses, origin=Origin.HERE)
    guess = SourceView(image=first.image, depth=np.full_like(half, 3.0), poses=first.poses, origin=Origin.GUESSED)
    other = _view(scene, "right", 0, Origin.OTHER_CAMERA)
    fused = _fuse(scene, seen, guess, other)
    with_other, alone = fused.origin == Origin.OTHER_CAMERA, _fuse(scene, seen, other).origin
    # Guesses come after what another camera saw, but before what the frame contradicts.
    assert np.all(alone[with_other] == Origin.OTHER_CAMERA) and np.any(with_other)
    assert np.all(fused.origin[(alone == Origin.OTHER_CAMERA) & ~with_other] == Origin.GUESSED)
    assert np.any(fused.origin == Origin.GUESSED)
    nobody = fused.origin == Origin.NOBODY
    np.testing.assert_array_equal(fused.image[nobody], 0.0)
    assert np.all(np.isnan(fused.depth[nobody])) and not np.any(np.isnan(fused.depth[~nobody]))
    assert sum(fused.shares().values()) == pytest.approx(1.0)


def test_infinite_depth_moves_by_rotation_alone_and_hides_nothing(world: Build, shapes: Any, truth: Build) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 3.0, _card(0.0)),), sky=True, d=(0.25, -0.1, 0.1))
    fused = _fuse(scene, *_all_views(scene))
    expected = truth(scene, "left", 0, 0.0)
    sky = np.isinf(expected.depth)
    known = fused.origin != Origin.NOBODY
    assert np.mean(np.isinf(fused.depth[sky & known])) > 0.99
    assert np.mean(np.isfinite(fused.depth[~sky & known])) > 0.99


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_inpainting_touches_the_missing_pixels_only(kind: Any, channels: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(100, 200, (40, 50, *channels)).astype(kind)
    missing = np.zeros((40, 50), dtype=bool)
    missing[10:14, 20:25] = True
    hurt = np.where(missing[(...,) + (None,) * len(channels)], 0, image).astype(kind)
    filled = inpaint(hurt, missing)
    assert filled.dtype == kind and filled.shape == image.shape
    np.testing.assert_array_equal(filled[~missing], image[~missing])
    # Invented from its surroundings: within their range.
    assert filled[missing].min() >= 90 and filled[missing].max() <= 210


def _frame(holes: np.ndarray, channels: tuple[int, ...] = (3,)) -> tuple[Fused, np.ndarray]:
    """A frame with these holes, and what it would show without them."""
    height, width = holes.shape
    ramp = np.broadcast_to(np.linspace(60, 180, width), (height, width))
    image = np.ascontiguousarray(
        np.broadcast_to(ramp.reshape(height, width, *(1 for _ in channels)), (height, width, *channels))
    )
    true = np.rint(image).astype(np.uint8)
    return Fused.seen(
        np.where(holes.reshape(height, width, *(1 for _ in channels)), 0, true).astype(np.uint8), ~holes
    ), true


@pytest.mark.parametrize("channels", [(), (3,)])
def test_specks_and_slits_are_closed_and_marked_and_regions_stay(channels: tuple[int, ...]) -> None:
    holes = np.zeros((200, 300), dtype=np.bool_)
    holes[20:22, 40:260] = holes[100, 100] = holes[150:200, 296:] = holes[:, 0] = True
    region = np.zeros_like(holes)
    region[60:140, 150:230] = True
    fused, true = _frame(holes | region, channels)
    closed = finished(fused)
    assert set(np.unique(closed.origin[holes])) == {Origin.INVENTED}
    # A step of the ramp is half a grey level, and a hole is five wide at most.
    assert np.abs(closed.image[holes].astype(int) - true[holes]).max() <= 6
    # A disc rounds the corners of a region off.
    inner = closed.origin[62:138, 152:228]
    assert np.all(inner == Origin.NOBODY) and not np.any(closed.image[62:138, 152:228])
    seen = ~(holes | region)
    np.testing.assert_array_equal(closed.image[seen], fused.image[seen])
    np.testing.assert_array_equal(closed.origin[seen], fused.origin[seen])


def test_a_failure_and_a_whole_frame_are_left_alone() -> None:
    holes = np.zeros((50, 60), dtype=np.bool_)
    whole, _ = _frame(holes)
    assert finished(whole) is whole
    failed = replace(_frame(~holes)[0], reason="nothing is known")
    assert finished(failed) is failed


def _slanted(near: Origin, far: Origin, behind: float) -> tuple[Fused, np.ndarray]:
    """A near thing at 2 m before something, cut along pixels by a slanted line; and what a pixel's area shows."""
    size, fine = 60, 16
    x = (np.arange(size * fine) + 0.5) / fine
    area = (x[None, :] < 20.3 + 0.37 * x[:, None]).reshape(size, fine, size, fine).mean(axis=(1, 3))
    cut = area > 0.5
    image = np.where(cut, 200, 80).astype(np.uint8)
    origin = np.where(cut, np.uint8(near), np.uint8(far))
    depth = np.where(cut, 2.0, behind).astype(np.float32)
    return Fused(image=image, origin=origin, depth=depth), 80.0 + 120.0 * area


@pytest.mark.parametrize("behind", [3.0, np.inf, np.nan])
def test_a_seam_before_something_farther_is_a_line_and_not_a_staircase(behind: float) -> None:
    fused, true = _slanted(Origin.HERE, Origin.OTHER_FRAME, behind)
    even = finished(fused)
    off = [
        np.sqrt(np.mean((image - true) ** 2)) for image in (fused.image.astype(float), even.image.astype(float))
    ]
    assert off[1] < 0.75 * off[0]
    changed = even.image != fused.image
    assert (
        np.array_equal(even.origin, fused.origin) and changed.any(axis=1).all() and changed.sum(axis=1).max() <= 4
    )


@pytest.mark.parametrize(
    ("near", "far", "behind"),
    [
        (Origin.HERE, Origin.HERE, 3.0),  # the frame's own edge, as its optics made it
        (Origin.HERE, Origin.OTHER_FRAME, 2.05),  # one surface
    ],
)
def test_edges_that_are_no_seams_of_depth_stay(near: Origin, far: Origin, behind: float) -> None:
    fused, _ = _slanted(near, far, behind)
    assert finished(fused) is fused


def test_black_does_not_run_into_the_picture() -> None:
    even = finished(_slanted(Origin.HERE, Origin.NOBODY, np.nan)[0])
    black = cv2.dilate((even.origin == Origin.NOBODY).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert np.all(even.image[black & (even.origin == Origin.HERE)] == 200)
