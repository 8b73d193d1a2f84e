"""Rays through lenses against the host's undistortion, and lenses and scans in both methods of rendering."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import row_poses as line_poses
from rsbench.core.rig import StereoRig
from rsbench.core.se3 import Pose
from rsbench.core.shutter import RollingShutter, Scan
from rsbench.renderers.backend import start_backend
from rsbench.renderers.exposure import instant_times
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import make_sensor
from rsbench.scenes.model import Scene

BARREL = Lens(model="brown-conrady", k1=-0.28, k2=0.07, p1=0.002, p2=-0.001, k3=0.004)
FISHEYE = Lens(model="kannala-brandt", k1=-0.04, k2=0.012, k3=-0.003, k4=0.0005)
CAMERA = PinholeCamera.centred(30, 24, 20.0)


@pytest.mark.parametrize("shrunk", [1, 16])
@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_rays_at_every_sample_are_the_host_s(lens: Lens, shrunk: int) -> None:
    """In a small camera a sample is far from its pixel's centre: many steps are needed."""
    start_backend()
    import drjit as dr
    import mitsuba as mi

    width, height, cx, cy = 640 // shrunk, 480 // shrunk, 322.0 / shrunk, 236.5 / shrunk
    camera = PinholeCamera(width=width, height=height, fx=400 / shrunk, fy=405 / shrunk, cx=cx, cy=cy, lens=lens)
    still = np.broadcast_to(np.eye(3), (height, 3, 3)), np.zeros((height, 3))
    sensor = make_sensor(camera, *still)
    rng = np.random.default_rng(0)
    low, high = np.array([-0.49, -0.49]), np.array([width - 0.51, height - 0.51])
    corners = np.array([low, high, [low[0], high[1]], [high[0], low[1]], [cx, cy]])
    pixels = np.concatenate([corners, rng.uniform(low, high, size=(300, 2))])
    pixels = pixels.astype(np.float32)
    if dr.is_jit_v(mi.Float):
        x, y = mi.Float(pixels[:, 0].copy()), mi.Float(pixels[:, 1].copy())
        rays = sensor.lens
        found = np.stack([np.array(each) for each in rays.coordinates(x, y, rays.pixel(x, y, True))], axis=-1)
    else:
        found = np.array([list(sensor.row_ray(x, y, 0)[1])[:2] for x, y in pixels.tolist()])
    expected = camera.unproject(pixels.astype(np.float64))[:, :2]
    # What is rounded to single precision is the answer alone: half a unit in the last place. Before that a ray is
    # within 1e-8 px of its sample; 4 times that where the lens squeezes the image.
    np.testing.assert_allclose(found, expected, rtol=6e-8, atol=4e-8 / camera.fx)


@pytest.mark.parametrize("exposed", [False, True])
@pytest.mark.parametrize("scan", ["top", "bottom", "left", "right"])
def test_single_pass_is_stitched_with_a_lens_and_every_scan(town: Any, scan: Scan, exposed: bool) -> None:
    start_backend()
    scene = MitsubaScene(town)
    camera = replace(CAMERA, lens=BARREL if scan in ("top", "left") else FISHEYE)
    rig = StereoRig(camera=camera, baseline=0.2)
    shutter = RollingShutter(height=24, width=30, readout_ratio=0.8, scan=scan)
    motion = LinearMotion((-0.1, 0.2, 0.1), (-0.4, 0.1, 0.3))
    poses, columns = line_poses(rig, shutter, motion, "left", 0), shutter.axis("left") == 0
    options, rows = RendererOptions(samples=4, seed=7), [0, 1, 11, 23]
    instants = instant_times(shutter.line_times(0, "left"), 0.2, 64)
    blur = LinePoses(*rig.cam_from_world(motion, instants, "left")) if exposed else None
    one = render(scene, camera, LinePoses(*poses, columns=columns), options, exposed=blur)
    other = replace(options, method="stitched")
    stitched = render(scene, camera, LinePoses(*poses, columns=columns), other, exposed=blur, rows=rows)
    np.testing.assert_array_equal(one.image[rows], stitched.image)
    np.testing.assert_array_equal(one.depth[rows], stitched.depth)
    # The scan is seen at all: its first line is the global shutter's at that time, the last one is not.
    first = shutter.first_line("left")
    still = Pose(*(np.broadcast_to(part[first], part.shape) for part in poses))
    gs = render(scene, camera, LinePoses(*still, columns=columns), options)
    lines = one.depth.T if columns else one.depth
    gs_lines = gs.depth.T if columns else gs.depth
    np.testing.assert_array_equal(lines[first], gs_lines[first])
    assert np.mean(one.depth != gs.depth) > 0.3


def test_depth_is_that_of_the_ray_through_the_lens(quad: Any, town: Any) -> None:
    start_backend()
    # A wall at z = 3 + 0.5 x: along a ray (u, v, 1) it is met at z = 3 / (1 - 0.5 u).
    wall = quad([[-60, -60, -27], [60, -60, 33], [60, 60, 33], [-60, 60, -27]])
    camera = replace(CAMERA, lens=BARREL)
    poses = np.broadcast_to(np.eye(3), (24, 3, 3)), np.zeros((24, 3))
    depth = render(
        MitsubaScene(Scene(name="wall", meshes=(wall,), light=town.light)), camera, LinePoses(*poses)
    ).depth
    u = camera.unproject(camera.pixel_grid())[..., 0]
    np.testing.assert_allclose(depth, 3.0 / (1.0 - 0.5 * u), rtol=2e-6)  # single precision
