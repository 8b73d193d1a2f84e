"""Depth against closed forms and against ray-triangle intersection in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsbench.core.camera import PinholeCamera
from rsbench.renderers.backend import start_backend
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render, render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Scene, SceneMesh

FloatArray = NDArray[np.float64]
CAMERA = PinholeCamera(width=61, height=44, fx=50.0, fy=53.0, cx=28.3, cy=22.9)
LIGHT = Light(sun_direction=(0.0, -1.0, 0.0), up=(0.0, -1.0, 0.0))
QUICK = RendererOptions(samples=1)
# Rays and vertices are rounded to float32 (2**-24 each) and about ten operations follow: a few ulp.
FLOAT32 = 16 * 2.0**-24


def scene_of(*meshes: SceneMesh) -> MitsubaScene:
    return MitsubaScene(Scene(name="test", meshes=meshes, light=LIGHT))


def rays(camera: PinholeCamera, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """World origins (H, 3) and directions (H, W, 3) with camera z = 1; R (H, 3, 3), t (H, 3)."""
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    d = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    return -np.einsum("hji,hj->hi", R, t), np.einsum("hji,hwj->hwi", R, d)


def plane_depth(camera: PinholeCamera, R: FloatArray, t: FloatArray, n: FloatArray, c: float) -> FloatArray:
    """z of the plane n.X = c in each row's camera, 0 behind it or above its horizon."""
    origin, direction = rays(camera, R, t)
    with np.errstate(divide="ignore"):
        z = (c - origin @ n)[:, None] / (direction @ n)
    return np.where(z > 0, z, 0.0)


def test_global_shutter_depth_of_a_plane(quad: Any) -> None:
    # A wall turned about both axes, so z is not constant and a distance along the ray would differ.
    n = Rotation.from_euler("xyz", (20, -35, 10), degrees=True).apply([0.0, 0.0, -1.0])
    e1 = np.cross(n, [0.0, 1.0, 0.0])
    e1 /= np.linalg.norm(e1)
    e2, centre = np.cross(n, e1), np.array([0.3, -0.2, 7.0])
    wall = quad([centre + 40 * (a * e1 + b * e2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    R, t = Rotation.from_rotvec([0.05, -0.1, 0.2]).as_matrix(), np.array([0.1, -0.3, 0.4])
    depth = render_global(scene_of(wall), CAMERA, R, t, QUICK).depth
    assert depth.dtype == np.float32
    truth = plane_depth(CAMERA, np.tile(R, (44, 1, 1)), np.tile(t, (44, 1)), n, float(n @ centre))
    np.testing.assert_allclose(depth, truth, rtol=FLOAT32)


def test_rolling_shutter_depth_of_a_plane_follows_every_row(quad: Any, row_poses: Any) -> None:
    ground = quad([[-900, 1.6, 900], [900, 1.6, 900], [900, 1.6, -900], [-900, 1.6, -900]])
    R, t = row_poses(44, w=(0.1, 0.3, -0.4), d=(0.5, 0.2, -0.9), start=(0.2, 0.1, 0.3), ratio=1.0)
    depth = render(scene_of(ground), CAMERA, LinePoses(R, t), QUICK).depth
    truth = plane_depth(CAMERA, R, t, np.array([0.0, 1.0, 0.0]), 1.6)
    near = (truth > 0) & (truth < 100)  # beyond, the plane is seen at a grazing angle and then ends
    assert near.mean() > 0.3 and (truth == 0).mean() > 0.2
    _, direction = rays(CAMERA, R, t)
    # n.d is a difference of terms of size |d|, so its rounding grows as 1 / |n.d|;
    # that of a GPU with the triangle too.
    size = 1800.0 / 16 if start_backend().variant == "cuda_ad_rgb" else 0.0
    grazing = np.linalg.norm(direction, axis=-1) / np.abs(direction[..., 1])
    assert (np.abs(depth - truth) / np.where(near, truth, 1))[near].max() < 0.05
    assert (np.abs(depth - truth)[near] <= (FLOAT32 * (truth + size) * grazing)[near]).all()
    np.testing.assert_array_equal(depth[truth == 0], 0.0)
    # The test can tell rows apart: the pose of a neighbouring row is far outside the tolerance.
    wrong = plane_depth(CAMERA, np.roll(R, 1, 0), np.roll(t, 1, 0), np.array([0.0, 1.0, 0.0]), 1.6)
    assert (np.abs(wrong - truth)[near] > (10 * FLOAT32 * truth * grazing)[near]).mean() > 0.9


def test_depth_of_a_fine_ball_is_that_of_the_sphere(solid: Any) -> None:
    ball, centre = trimesh.creation.icosphere(5), np.array([0.2, -0.1, 5.0])
    depth = render_global(scene_of(solid("ball", ball, centre)), CAMERA, np.eye(3), np.zeros(3), QUICK).depth
    _, d = rays(CAMERA, np.eye(3)[None].repeat(44, 0), np.zeros((44, 3)))
    dd, dc = np.einsum("hwi,hwi->hw", d, d), d @ centre
    discriminant = dc**2 - dd * (centre @ centre - 1.0)
    hit = discriminant > 0.1 * dd  # away from the rim
    truth = (dc - np.sqrt(np.where(hit, discriminant, 0))) / dd
    # An equilateral triangle of side e lies at most e^2/6 below the unit sphere (half its circumradius squared);
    # off the rim a ray meets the sphere at a cosine above 0.3.
    edge = float(ball.edges_unique_length.max())
    error = depth[hit] - truth[hit]
    assert error.max() < edge**2 / 6 / 0.3 and error.min() > -FLOAT32 * 5
    assert (depth[discriminant < 0] == 0).all()


@pytest.mark.parametrize("tiny", [-2e-19, -0.0, 1e-19, -1e-17])
def test_a_ray_that_runs_along_an_axis_but_for_rounding_harms_no_neighbour(tiny: float, solid: Any) -> None:
    """Embree's packets lose what hits rays beside one whose direction has a component between -1e-18 and 0."""
    camera = PinholeCamera.centred(61, 45, 50.0)
    wall = trimesh.creation.box((80.0, 80.0, 2.0)).subdivide().subdivide()
    mesh = solid("wall", wall, (0.0, 0.0, 6.0))
    R = np.eye(3)
    R[2, :2] = tiny
    frame = render_global(scene_of(mesh), camera, R, np.array([0.2, 0.3, -0.4]), QUICK)
    np.testing.assert_allclose(frame.depth, 4.6, rtol=FLOAT32)


def test_a_surface_may_be_arbitrarily_near(quad: Any) -> None:
    wall = quad([[-1, -1, 0.001], [1, -1, 0.001], [1, 1, 0.001], [-1, 1, 0.001]])
    depth = render_global(scene_of(wall), CAMERA, np.eye(3), np.zeros(3), QUICK).depth
    np.testing.assert_allclose(depth, 0.001, rtol=FLOAT32)


def test_depth_does_not_depend_on_the_card(town: Scene, row_poses: Any) -> None:
    R, t = row_poses(44, w=(0.1, 0.0, 0.1))
    scene = MitsubaScene(town)
    cards = (QUICK, RendererOptions(samples=9), RendererOptions(samples=1, integrator="path"))
    frames = [render(scene, CAMERA, LinePoses(R, t), card) for card in cards]
    np.testing.assert_array_equal(frames[0].depth, frames[1].depth)
    np.testing.assert_array_equal(frames[0].depth, frames[2].depth)


@pytest.mark.parametrize(("x", "y"), [(5, 40), (52, 3), (30, 20)])
def test_depth_lifts_a_pixel_back_onto_a_known_point(quad: Any, x: int, y: int) -> None:
    # A small target placed where the camera's own formula puts pixel (x, y); its neighbours miss it.
    z = 6.0
    X = np.array([(x - CAMERA.cx) / CAMERA.fx * z, (y - CAMERA.cy) / CAMERA.fy * z, z])
    r = 0.4 * z / CAMERA.fx
    target = quad(X + r * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]))
    depth = render_global(scene_of(target), CAMERA, np.eye(3), np.zeros(3), QUICK).depth
    assert np.argwhere(depth > 0).tolist() == [[y, x]]
    np.testing.assert_allclose(depth[y, x], z, rtol=FLOAT32)
