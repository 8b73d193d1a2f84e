"""Dense tracks against closed-form worlds: exact rolling-shutter images, of a rectified pair and of any rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.correspondences import Correspondences, lens_covariance, without_lens
from rsbench.core.projection import back_project, rs_project
from rsbench.core.rig import VIEWS, StereoRig, View
from rsbench.core.shutter import Scanning
from rsbench.pipeline.frame_capture import find_matches_of_rig
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.vision.dense_matcher import (
    DenseMatcher,
    DenseOptions,
    dense_tracks,
    start_of_flow,
    stereo_by_flow,
)
from rsbench.vision.feature_matcher import find_correspondences, load_features

Build = Callable[..., Any]
Images = dict[View, np.ndarray]


@pytest.fixture(scope="module")
def images(scene: Any, u8: Build) -> Images:
    return {view: u8(scene.rolling(*view)[0]) for view in VIEWS}


def _errors(scene: Any, tracks: np.ndarray) -> np.ndarray:
    """Distances (n, 3), px, of the later ends from where ``rs_project`` puts the exact point of the first one."""
    rig, shutter, motion = scene.rig, scene.shutter, scene.motion
    tau = shutter.pixel_time(tracks[:, :2], 0, "left")
    pose = rig.cam_from_world(motion, tau, "left")
    rays = np.einsum("nji,nj->ni", pose.R, rig.sensor("left").unproject(tracks[:, :2]))
    centre = -np.einsum("nji,nj->ni", pose.R, pose.t)
    depth = np.min([each.distance(centre, rays) for each in scene.surfaces], axis=0)
    points = back_project(rig, shutter, motion, "left", 0, tracks[:, :2], depth)
    ends: dict[View, np.ndarray] = {
        ("right", 0): tracks[:, 2:4],
        ("left", 1): tracks[:, 4:6],
        ("right", 1): tracks[:, 6:8],
    }
    found = [
        np.linalg.norm(rs_project(rig, shutter, motion, side, frame, points).pixels - end, axis=1)
        for (side, frame), end in ends.items()
    ]
    return np.stack(found, axis=1)


def test_tracks_follow_the_true_flow(scene: Any, images: Images) -> None:
    """Patches aligned to some hundredths of a pixel; those at the sphere's rim hold two surfaces."""
    found = find_correspondences(load_features("dense"), images)
    error = _errors(scene, found.tracks)
    assert len(found.tracks) > 300 and found.covariance.shape == (len(found.tracks), 3)
    assert np.median(error) < 0.03
    assert np.mean(~(error < 0.5)) < 0.03


def test_predicted_deviations_order_the_errors(scene: Any, images: Images) -> None:
    """With noise: the half of smaller predicted variance errs less, and the scale is right within 3 times."""
    rng = np.random.default_rng(3)
    noisy = {
        view: np.clip(np.rint(image + rng.normal(0.0, 6.0, image.shape)), 0, 255).astype(np.uint8)
        for view, image in images.items()
    }
    found = dense_tracks(noisy, DenseOptions(levels=1, most_deviation=1.0))
    error = np.sqrt(np.mean(_errors(scene, found.tracks) ** 2, axis=1))
    predicted = np.sqrt(found.covariance[:, 0] + found.covariance[:, 2])
    order = np.argsort(predicted)
    small, large = (np.median(error[half]) for half in np.array_split(order, 2))
    assert len(error) > 100 and small < 0.85 * large
    assert 1 / 3 < np.median(error) / np.median(predicted) < 3.0


def test_large_motion_starts_from_an_affine_map(images: Images) -> None:
    """Closed form: an image turned by 8 deg and moved by a fifth of its width."""
    size = 320, 240
    A = np.add(cv2.getRotationMatrix2D((160.0, 120.0), 8.0, 1.0), [[0.0, 0.0, 64.0], [0.0, 0.0, -20.0]])
    first = cv2.cvtColor(images["left", 0], cv2.COLOR_RGB2GRAY)
    found = start_of_flow(first, cv2.warpAffine(first, A, size, borderMode=cv2.BORDER_REFLECT_101))
    assert found is not None
    middle = np.array([150.0, 110.0, 1.0])
    np.testing.assert_allclose(found @ middle, A @ middle, atol=4.0)  # a pixel of a quarter's size
    np.testing.assert_allclose(found[:, :2], A[:, :2], atol=0.06)
    assert start_of_flow(first, first) is None


def test_blurred_frames_are_matched_on_a_coarser_level(scene: Any, images: Images) -> None:
    """A blur of 17 px along x leaves few patches at full size."""
    kernel = np.full((1, 17), 1.0 / 17.0)
    rng = np.random.default_rng(4)
    seen = {
        (side, frame): np.clip(
            np.rint(cv2.filter2D(image, cv2.CV_64F, kernel) + rng.normal(0.0, 8.0, image.shape)), 0, 255
        ).astype(np.uint8)
        for (side, frame), image in images.items()
    }
    one, three = (dense_tracks(seen, DenseOptions(levels=levels)) for levels in (1, 3))
    assert len(three.tracks) > 1.3 * len(one.tracks)
    assert np.median(_errors(scene, three.tracks)) < 0.3


def test_half_the_size_finds_the_same(scene: Any, images: Images) -> None:
    found = dense_tracks(images, DenseOptions(half=True))
    assert len(found.tracks) > 100 and np.median(_errors(scene, found.tracks)) < 0.08


def test_frames_that_show_nothing_have_no_tracks() -> None:
    flat = {view: np.full((120, 160), 90, dtype=np.uint8) for view in VIEWS}
    assert len(DenseMatcher().match(flat).tracks) == 0
    small = {view: np.full((20, 30), 90, dtype=np.uint8) for view in VIEWS}
    assert len(DenseMatcher().match(small).tracks) == 0


def test_images_of_other_sizes_are_refused(images: Images) -> None:
    with pytest.raises(ValueError, match=r"right_1 must have the size of left_0"):
        dense_tracks({**images, ("right", 1): images["right", 1][:-1]})
    with pytest.raises(ValueError, match="levels"):
        DenseOptions(levels=0)


# Any rig


def _rig() -> StereoRig:
    """Two cameras of different size, focal length and lens, turned by degrees."""
    left = PinholeCamera(
        width=320,
        height=240,
        fx=300.0,
        fy=302.0,
        cx=161.0,
        cy=118.0,
        lens=Lens(model="brown-conrady", k1=-0.12, k2=0.02, p1=0.001),
    )
    right = PinholeCamera(
        width=352, height=264, fx=330.0, fy=329.0, cx=174.0, cy=133.0, lens=Lens(model="brown-conrady", k1=-0.08)
    )
    turn = so3.exp(np.array([0.02, -0.03, 0.05]))
    return StereoRig.of_cameras(left, right, turn, turn @ [-0.4, 0.01, 0.005])


def _seen(scene: Any, view: View) -> np.ndarray:
    """The image of a camera as it is: every pixel by the ray of its own line."""
    side, frame = view
    grid = scene.rig.sensor(side).pixel_grid()
    pose = scene.rig.cam_from_world(scene.motion, scene.shutter.pixel_time(grid, frame, side), side)
    R = np.swapaxes(pose.R, -1, -2)
    rays = (R @ scene.rig.sensor(side).unproject(grid)[..., None])[..., 0]
    centre = -(R @ pose.t[..., None])[..., 0]
    depth = np.min([each.distance(centre, rays) for each in scene.surfaces], axis=0)
    return np.asarray(scene.texture(centre + depth[..., None] * rays))


@pytest.mark.parametrize("scan", ["top", "left"])
def test_any_rig(world: Build, shapes: Any, u8: Build, scan: Any) -> None:
    """Of cameras that read columns a left-right match is of two times: its ends lie on no common row."""
    Plane, Sphere = shapes
    scene = world((Plane((0.2, 0.3, 1), 8), Sphere((0.2, 0.1, 4), 0.6)), size=(240, 320), focal=300, shortest=0.2)
    rig, scanning = _rig(), Scanning(scan=scan)
    scene = replace(scene, rig=rig, shutter=rig.shutter_of(scanning, 0.8))
    images = {view: u8(_seen(scene, view)) for view in VIEWS}
    options = CorrectionOptions(features=load_features("dense"))
    found = find_matches_of_rig(images, rig, scanning, options)
    error = _errors(scene, found.tracks)
    assert len(found.tracks) > 200 and len(found.covariance) == len(found.tracks)
    assert np.median(error) < 0.05
    assert np.mean(~(error < 0.5)) < 0.03


@settings(max_examples=20)
@given(
    st.floats(0.01, 1.0),
    st.floats(0.01, 1.0),
    st.floats(-0.9, 0.9),
    st.floats(20.0, 300.0),
    st.floats(20.0, 220.0),
)
def test_covariances_follow_the_lens(a: float, b: float, c: float, x: float, y: float) -> None:
    """By finite differences of the lens; and back."""
    eye, tracks = _rig().eye("left"), np.tile([x, y], (1, 4))
    given = np.array([[a * a, c * a * b, b * b]])
    found = lens_covariance(given, tracks, eye)
    ideal, h = eye.ideal_pixels(tracks[:, :2])[0], 1e-3
    J = np.stack(
        [(eye.lens_pixels(ideal + s) - eye.lens_pixels(ideal - s)) / (2 * h) for s in h * np.eye(2)], axis=1
    )
    full = J @ given[0, [0, 1, 1, 2]].reshape(2, 2) @ J.T
    np.testing.assert_allclose(found[0], full.ravel()[[0, 1, 3]], rtol=1e-5, atol=1e-9)
    back = without_lens(Correspondences(tracks=tracks, covariance=found), _rig())
    np.testing.assert_allclose(back.covariance, given, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("shift", [(-9.0, 0.0), (-6.0, 4.0), (7.0, 0.0)])
def test_stereo_matches_by_flow_lie_on_any_row(shift: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (260, 360)).astype(np.float32), (0, 0), 2.0)
    image = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    across, down = (int(each) for each in shift)
    found = stereo_by_flow(image[10:250, 10:350], image[10 - down : 250 - down, 10 - across : 350 - across])
    assert len(found) > 500
    off = np.linalg.norm(found[:, 2:] - found[:, :2] - shift, axis=1)
    assert np.quantile(off, 0.95) < 0.3  # DIS without refinement


def test_images_that_show_nothing_have_no_stereo_matches_by_flow() -> None:
    for shape in ((20, 30), (100, 120)):
        assert stereo_by_flow(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)).shape == (0, 4)


def test_enough_tracks_are_looked_for_at_fewer_places() -> None:
    fewer = DenseMatcher().with_enough(400)
    assert (fewer.points, fewer.fewest) == (1000, 200)
    assert DenseMatcher(points=300, fewest=0).with_enough(400) == DenseMatcher(points=300, fewest=0)
