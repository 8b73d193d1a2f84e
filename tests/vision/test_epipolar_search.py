"""Search along epipolar curves, and the reprojection that it uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import back_project, row_poses, rs_project_near
from rsbench.core.rig import SIDES, StereoRig, View
from rsbench.core.shutter import Scanning
from rsbench.vision.epipolar_search import census as census_of
from rsbench.vision.epipolar_search import depth_from_motion, ones, stereo_contradicts
from rsbench.vision.reprojection import reproject_pixels, reprojection_of

Build = Callable[..., Any]


def _post(X: np.ndarray) -> np.ndarray:
    return np.abs(X[..., 0] - 0.1) < 0.06


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_thin_post_before_a_wall_gets_its_depth(world: Build, shapes: Any, u8: Any, side: Any) -> None:
    """Ten pixels wide, none of it known to stereo; the wall behind it is known."""
    plane = shapes[0]
    scene = world((plane((0.05, 0.1, 1.0), 7.0), plane((0.0, 0.0, 1.0), 3.0, _post)), d=(0.25, -0.1, 0.1))
    seen = [scene.rolling(side, frame) for frame in (0, 1)]
    images, truth = [u8(image) for image, _ in seen], [depth for _, depth in seen]
    posts = [depth < 4.0 for depth in truth]
    known = [np.where(post, 0.0, depth).astype(np.float32) for post, depth in zip(posts, truth, strict=True)]
    asked: Any = tuple(images), tuple(known), scene.rig, scene.shutter, scene.motion, side
    both = depth_from_motion(*asked)
    for frame in (0, 1):  # as where both are asked for: the other one is searched where it must agree
        alone = depth_from_motion(*asked, wanted=(frame,))
        np.testing.assert_array_equal(alone[frame], both[frame])
        assert not np.any(alone[1 - frame])
    for frame, found in enumerate(both):
        assert not np.any(found[~posts[frame]])
        got = found[posts[frame]]
        assert np.mean(got > 0.0) > 0.7
        # Half a pixel of some 20 px of parallax is 2.5 %; a match lies within that and its neighbours' votes.
        assert np.mean(np.abs(got[got > 0.0] / truth[frame][posts[frame]][got > 0.0] - 1.0) < 0.05) > 0.95


def test_a_depth_that_the_other_frame_contradicts_is_replaced(world: Build, shapes: Any, u8: Any) -> None:
    """Stereo saw the wall in place of a post before it, as it does where texture runs along the baseline."""
    plane = shapes[0]
    scene = world((plane((0.05, 0.1, 1.0), 7.0), plane((0.0, 0.0, 1.0), 3.0, _post)), d=(0.25, -0.1, 0.1))
    seen = [scene.rolling("left", frame) for frame in (0, 1)]
    images, truth = [u8(image) for image, _ in seen], [depth for _, depth in seen]
    posts = [depth < 4.0 for depth in truth]
    known = [np.where(post, 7.0, depth).astype(np.float32) for post, depth in zip(posts, truth, strict=True)]
    given: Any = tuple(images), tuple(known), scene.rig, scene.shutter, scene.motion, "left"
    assert not any(np.any(depth) for depth in depth_from_motion(*given))
    for frame, found in enumerate(depth_from_motion(*given, replace_unlike=True)):
        post, wall = found[posts[frame]], found[~posts[frame]]
        assert np.mean(post > 0.0) > 0.6
        assert np.mean(np.abs(post[post > 0.0] / truth[frame][posts[frame]][post > 0.0] - 1.0) < 0.05) > 0.9
        # Only what the post hides of the wall in the other frame is searched; hardly any is found nearer.
        assert np.mean((wall > 0.0) & (wall < 6.0)) < 0.01


def test_what_the_other_frame_does_not_confirm_has_no_depth(world: Build, shapes: Any) -> None:
    """Noise in the second frame: nothing there looks like the first."""
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), d=(0.3, 0.0, 0.0))
    images = tuple(np.random.default_rng(k).integers(0, 255, (160, 200), dtype=np.uint8) for k in (0, 1))
    nothing = (np.zeros((160, 200), np.float32),) * 2
    found = depth_from_motion(images, nothing, scene.rig, scene.shutter, scene.motion, "left")  # pyrefly: ignore[bad-argument-type]
    assert all(np.mean(depth > 0.0) < 0.02 for depth in found)


def test_a_camera_of_fewer_lines_contradicts_wrong_depth_in_all_lines(world: Build, shapes: Any, u8: Any) -> None:
    """The other camera has half the lines: those of the first one are not numbers of its lines."""
    scene = world((shapes[0]((0.0, 0.1, 1.0), 5.0),))
    camera = scene.rig.camera
    small = camera.resized(camera.width // 2, camera.height // 2)
    rig = StereoRig.of_cameras(camera, small, np.eye(3), (-scene.rig.baseline, 0.0, 0.0))
    shutter = rig.shutter_of(Scanning(), 0.8)
    seen = [
        replace(scene, rig=replace(scene.rig, camera=each)).see(row_poses(rig, shutter, scene.motion, side, 0))
        for side, each in zip(SIDES, (camera, small), strict=True)
    ]
    images, right = (u8(seen[0][0]), u8(seen[1][0])), seen[0][1].astype(np.float32)
    given: Any = rig, shutter, scene.motion, "left", 0
    wrong = np.asarray(1.4 * right, dtype=np.float32)
    found = stereo_contradicts(images, right, wrong, *given)
    # The first columns are beyond the other image; elsewhere repetitions of the texture hide a few.
    assert np.all(np.mean(found[:, 40:], axis=1) > 0.8)
    assert np.mean(stereo_contradicts(images, wrong, right, *given)) < 0.02


def test_without_a_translation_there_is_no_depth(world: Build, shapes: Any, u8: Any) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),))
    still = LinearMotion(np.zeros(3), np.zeros(3))
    image, unknown = u8(scene.rolling("left", 0)[0]), np.zeros((160, 200), np.float32)
    found = depth_from_motion((image, image), (unknown, unknown), scene.rig, scene.shutter, still, "left")
    assert not np.any(found[0]) and not np.any(found[1])


def test_a_census_counts_the_darker_neighbours() -> None:
    grey = np.random.default_rng(0).integers(0, 255, (12, 14), dtype=np.uint8)
    census = census_of(grey)
    for y, x in ((2, 2), (5, 7), (9, 11)):
        darker = np.count_nonzero(grey[y - 2 : y + 3, x - 2 : x + 3] < grey[y, x])
        assert ones(census[y, x]) == bin(int(census[y, x])).count("1") == darker


MOTION = LinearMotion([0.06, -0.03, 0.05], [0.15, 0.12, 0.1])


@pytest.mark.parametrize(
    ("lens", "scanning"),
    [(None, {}), (Lens(model="brown-conrady", k1=-0.1), {"scan": "left", "right_scan": "bottom"})],
    ids=["rows", "columns to rows through a lens"],
)
@pytest.mark.parametrize("there", [("left", 1), ("right", 0), ("right", 1)])
def test_places_are_those_of_the_projection(lens: Lens | None, scanning: dict[str, Any], there: View) -> None:
    camera = PinholeCamera(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5, lens=lens)
    rig, here = StereoRig(camera=camera, baseline=0.4), ("left", 0)
    shutter = Scanning(**scanning).shutter_of(160, 120, 0.9)
    poses = [row_poses(rig, shutter, MOTION, *view) for view in (here, there)]
    maps = reprojection_of(camera, *poses, axes=(shutter.axis(here[0]), shutter.axis(there[0])))
    depth = np.random.default_rng(0).uniform(2.0, 9.0, (120, 160)).astype(np.float32)
    own_line = np.indices((120, 160), dtype=np.int32)[0 if shutter.axis(there[0]) == 1 else 1]
    places, factors = reproject_pixels(maps, (1 / depth).astype(np.float32), own_line)

    points = back_project(rig, shutter, MOTION, "left", 0, camera.pixel_grid(), depth)
    exact = rs_project_near(rig, shutter, MOTION, *there, points, own_line)
    both = np.isfinite(places[..., 0]) & np.isfinite(exact.depth)
    assert np.mean(both) > 0.4
    # They differ in who is inside by the pixel's half at the border alone.
    assert np.mean(np.isfinite(places[..., 0]) != np.isfinite(exact.depth)) < 0.02
    # Between two lines the place is taken as straight; positions are float32.
    np.testing.assert_allclose(places[both], exact.pixels[both], atol=2e-4)
    np.testing.assert_allclose(depth[both] / factors[both], exact.depth[both], rtol=1e-4)
