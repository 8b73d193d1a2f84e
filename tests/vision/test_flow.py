"""Dense flow and the depth that it means, against the row equation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cv2 import GaussianBlur

from rsbench.core.projection import back_project, rs_project_near
from rsbench.vision.flow import dense_flow, flow_depth

Build = Callable[..., Any]


@pytest.mark.parametrize("frame", [0, 1])
@pytest.mark.parametrize("side", ["left", "right"])
def test_exact_flow_gives_the_exact_depth(world: Build, shapes: Any, side: Any, frame: int) -> None:
    """The flow of every pixel's point by the row equation; every row of either frame has its own pose."""
    scene = world((shapes[0]((0.1, 0.2, 1.0), 5.0),), d=(0.3, -0.1, 0.05))
    _, depth = scene.rolling(side, frame)
    geometry = scene.rig, scene.shutter, scene.motion
    grid = scene.rig.camera.pixel_grid()
    points = back_project(*geometry, side, frame, grid, depth)
    seen = rs_project_near(*geometry, side, 1 - frame, points, grid[..., 1])
    inside = np.isfinite(seen.depth)
    found, error = flow_depth(grid[inside], (seen.pixels - grid)[inside], *geometry, side, frame)
    # rs_project_near stops at 1e-9 px; the parallax is some 15 px. The depth map itself is float32.
    np.testing.assert_allclose(found, depth[inside], rtol=1e-5)
    assert np.max(error) < 1e-4


def test_flow_that_the_motion_forbids_has_its_error(world: Build, shapes: Any) -> None:
    """Sideways motion moves pixels along the rows: 3 px across them are an error; the wrong way is infinite."""
    scene = world((shapes[0]((0.0, 0.0, 1.0), 5.0),), w_deg=(0.0, 0.0, 0.0), d=(0.3, 0.0, 0.0))
    geometry = scene.rig, scene.shutter, scene.motion
    pixels = np.array([[40.0, 30.0], [40.0, 30.0], [40.0, 30.0]])
    depth, error = flow_depth(pixels, np.array([[8.0, 0.0], [8.0, 3.0], [-2.0, 0.0]]), *geometry, "left", 0)
    assert np.isfinite(depth[0]) and error[0] < 1e-9
    assert 2.5 < error[1] < 3.5  # the rows are also read at other times
    assert np.isinf(depth[2]) and error[2] == pytest.approx(2.0)


def test_dense_flow_follows_a_shift() -> None:
    rng = np.random.default_rng(0)
    image = GaussianBlur(rng.integers(0, 255, (120, 160)).astype(np.float32), (0, 0), 2.0)
    image = (255 * (image - image.min()) / np.ptp(image)).astype(np.uint8)
    flow = dense_flow(image, np.roll(image, (2, 3), axis=(0, 1)))
    np.testing.assert_allclose(np.median(flow[20:-20, 20:-20], axis=(0, 1)), [3.0, 2.0], atol=0.1)
