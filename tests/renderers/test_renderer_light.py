"""Colours, shadows, orientation and the pixel convention against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.renderers.image import to_srgb8
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.pixel_samples import subpixel_grid
from rsbench.renderers.render import LinePoses, render, render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

CAMERA = PinholeCamera.centred(32, 24, 20.0)
UP = (0.0, -1.0, 0.0)
BLACK = (0.0, 0.0, 0.0)
WHITE_SKY = Light(sun_direction=UP, sun_irradiance=BLACK, sky_zenith=(1, 1, 1), sky_horizon=(1, 1, 1), up=UP)


def picture(light: Light, *meshes: SceneMesh, camera: PinholeCamera = CAMERA, **options: Any) -> Any:
    scene = MitsubaScene(Scene(name="test", meshes=meshes, light=light))
    return render_global(scene, camera, np.eye(3), np.zeros(3), RendererOptions(**options)).image


def wall(quad: Any, z: float = 5.0, size: float = 20.0, **extra: Any) -> SceneMesh:
    """Faces the camera; its first corner is the top left one."""
    mesh: SceneMesh = quad([[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]], **extra)
    return mesh


def linear(srgb: float) -> float:
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4


@pytest.mark.parametrize("samples", [1, 4, 16, 25])
def test_subpixel_grid_is_stratified_with_distinct_coordinates(samples: int) -> None:
    grid = subpixel_grid(samples)
    k = round(samples**0.5)
    cells = np.floor((grid + 0.5) * k).astype(int)
    assert len({tuple(cell) for cell in cells.tolist()}) == samples
    centred = (np.arange(samples) + 0.5) / samples - 0.5
    for axis in (0, 1):
        np.testing.assert_allclose(np.sort(grid[:, axis]), centred, atol=1e-7)


def test_an_edge_lies_at_its_sub_pixel_place(quad: Any) -> None:
    """Pixel x covers [x - 0.5, x + 0.5]: a black half plane from x = 10.3125 covers 3/16 of pixel 10."""
    black, z, edge_x, edge_y = Material(name="black", colour=BLACK), 4.0, 10.3125, 7.4375
    left = (edge_x - CAMERA.cx) / CAMERA.fx * z
    top = (edge_y - CAMERA.cy) / CAMERA.fy * z
    upright = quad([[left, -50, z], [50, -50, z], [50, 50, z], [left, 50, z]], black)
    image = picture(WHITE_SKY, upright)[..., 0]
    expected = np.where(np.arange(32) < 10, 1.0, 0.0)
    expected[10] = 13 / 16
    np.testing.assert_allclose(image, np.tile(expected, (24, 1)), atol=1e-6)
    level = quad([[-50, top, z], [50, top, z], [50, 50, z], [-50, 50, z]], black)
    image = picture(WHITE_SKY, level)[..., 0]
    expected = np.where(np.arange(24) < 7, 1.0, 0.0)
    expected[7] = 15 / 16
    np.testing.assert_allclose(image, np.tile(expected[:, None], (1, 32)), atol=1e-6)


def test_right_is_right_and_down_is_down(quad: Any) -> None:
    patch = quad([[1, 1, 4], [2, 1, 4], [2, 2, 4], [1, 2, 4]], Material(name="red", colour=(1, 0, 0)))
    image = picture(WHITE_SKY, patch)
    rows, columns = np.nonzero(image[..., 1] < 0.5)
    assert rows.min() > 12 and columns.min() > 16


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_texture_stands_upright_repeats_and_is_srgb(quad: Any, integrator: Integrator) -> None:
    """Row 0 of a texture is its top, v points up, and one unit of uv is one repeat."""
    texels = np.array([[[200, 20, 20], [20, 200, 20]], [[20, 20, 200], [128, 128, 128]]], dtype=np.uint8)
    texture = texels.repeat(8, axis=0).repeat(8, axis=1)
    uv = np.array([[0.0, 1.0], [2.0, 1.0], [2.0, -1.0], [0.0, -1.0]])
    mesh = wall(quad, z=2.0, size=1.0, material=Material(name="t", texture=texture), uv=uv)
    sun = Light(sun_direction=(0, 0, -1), sun_irradiance=(np.pi,) * 3, sky_zenith=BLACK, sky_horizon=BLACK, up=UP)
    camera = PinholeCamera.centred(32, 32, 32.0)  # the wall fills it: 16 pixels a repeat, one texel each
    image = picture(sun, mesh, camera=camera, integrator=integrator, samples=1)
    decoded = np.vectorize(linear)(texture / 255.0)
    np.testing.assert_allclose(image, np.tile(decoded, (2, 2, 1)), rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_lambertian_wall_has_the_closed_form_radiance(quad: Any, integrator: Integrator) -> None:
    """L = albedo E cos / pi, from either side of the surface."""
    direction = np.array([0.6, 0.0, -0.8])
    irradiance = (3.0, 2.0, 1.0)
    sun = Light(
        sun_direction=tuple(direction), sun_irradiance=irradiance, sky_zenith=BLACK, sky_horizon=BLACK, up=UP
    )
    mesh = wall(quad, material=Material(name="m", colour=(0.5, 0.7, 1.0)))
    flipped = quad(mesh.vertices[::-1], mesh.material)
    albedo = np.array([linear(0.5), linear(0.7), 1.0])
    expected = albedo * irradiance * 0.8 / np.pi
    for side in (mesh, flipped):
        image = picture(sun, side, integrator=integrator, samples=4)
        np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=1e-5)


def test_sky_term_of_sunsky(quad: Any) -> None:
    """A wall gets 0.6 of the sky's mean radiance, level ground all of it; the path tracer agrees on the ground."""
    sky = Light(
        sun_direction=UP, sun_irradiance=BLACK, sky_zenith=(0.2, 0.4, 0.9), sky_horizon=(0.8, 0.8, 0.9), up=UP
    )
    mean = np.array([0.8, 0.8, 0.9]) / 3 + 2 * np.array([0.2, 0.4, 0.9]) / 3
    grey = Material(name="grey", colour=(0.5, 0.5, 0.5))
    image = picture(sky, wall(quad, material=grey))
    np.testing.assert_allclose(image, np.broadcast_to(0.6 * linear(0.5) * mean, image.shape), rtol=1e-5)
    ground = quad([[-500, 1, 500], [500, 1, 500], [500, 1, -500], [-500, 1, -500]], grey)
    image = picture(sky, ground)[20:]
    np.testing.assert_allclose(image, np.broadcast_to(linear(0.5) * mean, image.shape), rtol=1e-5)
    traced = picture(sky, ground, integrator="path", samples=256)[20:]
    # Monte Carlo: 128 pixels of 256 samples, relative deviation of one sample below 1: 1 / 181; five of them.
    np.testing.assert_allclose(traced.mean(axis=(0, 1)), linear(0.5) * mean, rtol=0.03)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_empty_pixels_show_the_sky(integrator: Integrator) -> None:
    light = Light(sun_direction=UP, sky_zenith=(0.1, 0.2, 0.9), sky_horizon=(0.8, 0.7, 0.6), up=UP)
    image = picture(light, integrator=integrator, samples=1)
    y, x = np.mgrid[:24, :32]
    d = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], axis=-1)
    sine = np.maximum(-d[..., 1] / np.linalg.norm(d, axis=-1), 0.0)[..., None]
    expected = np.array(light.sky_horizon) + (np.array(light.sky_zenith) - light.sky_horizon) * sine
    # `path` reads the sky from a map of 64 rows, interpolated: half a row's slope at the horizon's kink.
    np.testing.assert_allclose(image, expected, atol=1e-5 if integrator == "sunsky" else 0.7 * np.pi / 64 / 2)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_a_shadow_falls_where_the_sun_is_hidden(quad: Any, integrator: Integrator) -> None:
    """Sun from straight above; a roof over x > 0 shades that half of the ground, and the sky is black."""
    sun = Light(sun_direction=UP, sky_zenith=BLACK, sky_horizon=BLACK, up=UP)
    ground = quad([[-50, 1, 50], [50, 1, 50], [50, 1, -50], [-50, 1, -50]])
    roof = quad([[0, -30, 50], [50, -30, 50], [50, -30, -50], [0, -30, -50]], Material(name="b", colour=BLACK))
    image = picture(sun, ground, roof, integrator=integrator)[16:]
    expected = linear(0.8) * np.array(sun.sun_irradiance) / np.pi
    np.testing.assert_allclose(image[:, :16], np.broadcast_to(expected, (8, 16, 3)), rtol=1e-5)
    np.testing.assert_array_equal(image[:, 16:], 0.0)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_shading_normals_are_used_as_given(quad: Any, integrator: Integrator) -> None:
    normal = np.array([0.6, 0.0, -0.8])
    sun = Light(
        sun_direction=tuple(normal), sun_irradiance=(np.pi,) * 3, sky_zenith=BLACK, sky_horizon=BLACK, up=UP
    )
    mesh = wall(quad, material=Material(name="w", colour=(1, 1, 1)), normals=np.tile(normal, (4, 1)))
    np.testing.assert_allclose(picture(sun, mesh, integrator=integrator, samples=1), 1.0, rtol=1e-5)


def test_materials_stay_with_their_meshes_in_any_number(quad: Any) -> None:
    """Twenty stripes of twenty materials, of which neighbours are equal in value but not in name."""
    stripes = []
    for i in range(20):
        left, right = ((edge - CAMERA.cx) / CAMERA.fx * 4 for edge in (i + 5.5, i + 6.5))
        colour = (0.05 * (i // 2), 0.5, 1 - 0.05 * (i // 2))
        corners = [[left, -9, 4], [right, -9, 4], [right, 9, 4], [left, 9, 4]]
        stripes.append(quad(corners, Material(name=f"m{i}", colour=colour)))
    image = picture(WHITE_SKY, *stripes)[12, 6:26]
    expected = [[0.6 * linear(c) for c in stripe.material.colour] for stripe in stripes]
    np.testing.assert_allclose(image, expected, atol=1e-5)


def test_srgb_encoding() -> None:
    codes = np.arange(256, dtype=np.uint8)
    light = np.vectorize(linear)(codes / 255.0)
    np.testing.assert_array_equal(to_srgb8(light, 1.0), codes)
    np.testing.assert_array_equal(to_srgb8(light / 4, 4.0), codes)
    np.testing.assert_array_equal(to_srgb8([-1.0, 0.0, 7.0], 1.0), [0, 0, 255])


def test_a_mesh_without_faces_is_nothing(quad: Any) -> None:
    empty = replace(wall(quad), faces=np.zeros((0, 3), dtype=np.int32))
    np.testing.assert_array_equal(picture(WHITE_SKY, empty), 1.0)


def test_bad_scenes_are_refused_in_one_line(quad: Any) -> None:
    texture = np.zeros((4, 4, 3), dtype=np.uint8)
    with pytest.raises(RsbenchError, match=r"'quad'.*no uv"):
        picture(WHITE_SKY, wall(quad, material=Material(name="t", texture=texture), uv=None))
    with pytest.raises(RsbenchError, match=r"texture of shape \(4, 4\), uint8"):
        picture(WHITE_SKY, wall(quad, material=Material(name="t", texture=texture[..., 0])))
    good = wall(quad)
    bad: tuple[tuple[str, Any], ...] = (
        ("vertices", np.where(good.vertices > 5, np.nan, good.vertices)),
        ("uv", np.zeros((3, 2))),
        ("normals", np.zeros((4, 2))),
        ("faces", good.faces + 1),
        ("faces", good.faces - 1),
        ("faces", good.faces.ravel()),
    )
    for field, value in bad:
        with pytest.raises(RsbenchError, match=f"mesh 'quad': {field} of shape"):
            picture(WHITE_SKY, replace(good, **{field: value}))
    with pytest.raises(RsbenchError, match="sun_direction"):
        picture(Light(sun_direction=(0.0, 0.0, 0.0)))
    with pytest.raises(RsbenchError, match="up"):
        picture(Light(sun_direction=(0.0, 0.0, 1.0), up=(0.0, float("nan"), 0.0)))


SKY = Light(sun_direction=UP, sun_irradiance=BLACK, sky_zenith=(0.2, 0.4, 0.9), sky_horizon=(0.8, 0.8, 0.7), up=UP)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.0, -0.6, -0.8), (0.0, 0.28, -0.96)])
def test_an_open_surface_has_all_light_of_the_sky(quad: Any, normal: tuple[float, float, float]) -> None:
    """Against a sum over directions; with few of its own the ratio of the renderer is exact all the same."""
    z = 1.0 - (2.0 * np.arange(40_000) + 1.0) / 40_000
    turn, level = np.arange(40_000) * 2.399963, np.sqrt(1 - z**2)
    ways = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=-1)
    height = np.maximum(-ways[:, 1:2], 0.0)
    radiance = np.array(SKY.sky_horizon) + (np.array(SKY.sky_zenith) - SKY.sky_horizon) * height
    expected = 4 * np.mean(radiance * np.maximum(ways @ normal, 0.0)[:, None], axis=0)
    white = Material(name="w", colour=(1, 1, 1))
    image = picture(SKY, wall(quad, material=white, normals=np.tile(normal, (4, 1))), sky_rays=1, samples=1)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=2e-3)


def test_a_wall_hides_its_part_of_the_sky(quad: Any) -> None:
    """Of a white sky, level ground at x from a wall of height h and no end has (1 + cos(atan(h / x))) / 2."""
    white = Material(name="w", colour=(1, 1, 1))
    ground = quad([[-1e3, 1, 1e3], [1e3, 1, 1e3], [1e3, 1, -1e3], [-1e3, 1, -1e3]], white)
    dark = Material(name="b", colour=BLACK)
    edge = quad([[1.5, -1, 1e3], [1.5, -1, -1e3], [1.5, 1, -1e3], [1.5, 1, 1e3]], dark)
    image = picture(WHITE_SKY, ground, edge, sky_rays=32)[20, 2:20:3, 0]
    at = (np.arange(2, 20, 3) - CAMERA.cx) / (20 - CAMERA.cy)
    # 512 directions; a row of a lattice more or less on each side of the edge: 2 / sqrt(512) at most.
    expected = 0.5 * (1 + np.cos(np.arctan(2.0 / (1.5 - at))))
    np.testing.assert_allclose(image, expected, atol=0.03)


def test_a_hidden_sky_is_that_of_the_path_tracer(town: Scene) -> None:
    """With direct light only; 4 % is the deviation of a pixel of 64 samples, of which there are hundreds."""
    scene, camera = MitsubaScene(town), PinholeCamera.centred(40, 30, 30.0)
    options = RendererOptions(sky_rays=4)
    seen = render_global(scene, camera, np.eye(3), np.zeros(3), options)
    traced = render_global(
        scene, camera, np.eye(3), np.zeros(3), replace(options, integrator="path", samples=64, max_depth=2)
    )
    on = seen.depth > 0
    assert np.mean(seen.image[on]) == pytest.approx(np.mean(traced.image[on]), rel=0.01)
    rough = np.median(np.abs(seen.image[on] / traced.image[on] - 1))
    assert rough < 0.08
    poses = np.broadcast_to(np.eye(3), (30, 3, 3)), np.zeros((30, 3))
    rows = render(scene, camera, LinePoses(*poses), options, rows=[3, 17]).image
    np.testing.assert_array_equal(rows, seen.image[[3, 17]])
