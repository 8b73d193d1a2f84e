"""Depth of the baselines, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.projection import back_project, row_poses, rs_project_near
from rsbench.core.rig import StereoRig
from rsbench.vision.baselines import dense_flow, flow_depth, plane_depth

Build = Callable[..., Any]


@settings(deadline=None, max_examples=10)
@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.5, 20.0), st.integers(0, 100))
def test_the_plane_is_found_among_other_surfaces(a: float, b: float, z: float, seed: int) -> None:
    """A fifth of the pixels lies on something else: absolute differences leave the plane where it is."""
    y, x = np.mgrid[:48, :64] / 48.0
    true = z / (1.0 + a * x + b * y)
    rng = np.random.default_rng(seed)
    seen = np.where(rng.random(true.shape) < 0.2, 0.3 * true, true)
    seen[rng.random(true.shape) < 0.1] = 0.0
    found = plane_depth(seen)
    # Float32, and weights that stop at a thousandth of the median inverse depth.
    np.testing.assert_allclose(found, true, rtol=3e-3)


def test_a_plane_of_nothing_is_at_infinity() -> None:
    assert np.all(np.isinf(plane_depth(np.zeros((6, 8)))))


def test_a_plane_seen_edge_on_ends_at_infinity() -> None:
    y = np.linspace(-1.0, 1.0, 40)[:, None]
    depth = np.where(y > 0.1, 1.0 / np.maximum(y, 0.1), np.inf) * np.ones((1, 30))
    assert np.all(plane_depth(np.where(np.isfinite(depth), depth, 0.0))[:15] > 100.0)


def test_depth_from_exact_flow_is_the_true_depth(world: Build, shapes: Any) -> None:
    """Flow from the row equation of every pixel's point; what is left is the rounding of the target row."""
    scene = world((shapes[0]((0.1, 0.2, 1.0), 5.0),), d=(0.3, -0.1, 0.05))
    _, depth = scene.rolling("left", 0)
    camera, geometry = scene.rig.camera, (scene.rig, scene.shutter, scene.motion)
    grid = camera.pixel_grid()
    points = back_project(*geometry, "left", 0, grid, depth)
    seen = rs_project_near(*geometry, "left", 1, points, grid[..., 1])
    inside = np.isfinite(seen.depth)
    flow = np.where(inside[..., None], seen.pixels - grid, 0.0).astype(np.float32)
    here, there = (row_poses(*geometry, "left", k) for k in (0, 1))
    found = flow_depth(flow, camera, here, there)
    middle = np.zeros_like(inside)
    middle[10:-10, 10:-10] = True
    error = np.abs(found / depth - 1.0)[inside & middle]
    # Half a row of the motion is 1 / 320 of a readout; the flow is some 15 px long.
    assert np.quantile(error, 0.99) < 0.02


def test_depth_has_the_unit_of_the_translation(world: Build, shapes: Any) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    camera = scene.rig.camera
    flow = np.zeros((camera.height, camera.width, 2), dtype=np.float32)
    flow[..., 0] = camera.fx * 0.3 / 5.0
    for unit in (1.0, 10.0):
        rig = StereoRig(camera=camera, baseline=scene.rig.baseline * unit)
        motion = type(scene.motion)(scene.motion.w, scene.motion.d * unit)
        here, there = (row_poses(rig, scene.shutter, motion, "left", k) for k in (0, 1))
        found = flow_depth(flow, camera, here, there)
        np.testing.assert_allclose(np.median(found), 5.0 * unit, rtol=1e-5)


def test_no_motion_in_the_picture_is_infinitely_far(world: Build, shapes: Any) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    camera = scene.rig.camera
    here, there = (row_poses(scene.rig, scene.shutter, scene.motion, "left", k) for k in (0, 1))
    still = flow_depth(np.zeros((camera.height, camera.width, 2), dtype=np.float32), camera, here, there)
    assert np.all(np.isinf(still))


def test_dense_flow_follows_a_shift() -> None:
    rng = np.random.default_rng(0)
    from cv2 import GaussianBlur

    image = GaussianBlur(rng.integers(0, 255, (120, 160)).astype(np.float32), (0, 0), 2.0)
    image = (255 * (image - image.min()) / np.ptp(image)).astype(np.uint8)
    flow = dense_flow(image, np.roll(image, (2, 3), axis=(0, 1)))
    np.testing.assert_allclose(np.median(flow[20:-20, 20:-20], axis=(0, 1)), [3.0, 2.0], atol=0.1)
