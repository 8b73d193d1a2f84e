"""Depth of the baselines, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rsbench.core.rig import StereoRig
from rsbench.vision.baseline_depths import monocular_depth, plane_depth

Build = Callable[..., Any]


@settings(max_examples=10)
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


def test_one_camera_measures_a_plane_in_the_unit_of_its_translation(world: Build, shapes: Any) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    camera = scene.rig.camera
    flow = np.zeros((camera.height, camera.width, 2), dtype=np.float32)
    flow[..., 0] = camera.fx * 0.3 / 5.0
    for unit in (1.0, 10.0):
        rig = StereoRig(camera=camera, baseline=scene.rig.baseline * unit)
        motion = type(scene.motion)(scene.motion.w, scene.motion.d * unit)
        found = monocular_depth(flow, rig, scene.shutter, motion, "left", 0)
        np.testing.assert_allclose(found, 5.0 * unit, rtol=1e-5)


def test_no_motion_in_the_picture_is_infinitely_far(world: Build, shapes: Any) -> None:
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    flow = np.zeros((scene.rig.camera.height, scene.rig.camera.width, 2), dtype=np.float32)
    assert np.all(np.isinf(monocular_depth(flow, scene.rig, scene.shutter, scene.motion, "left", 0)))
