"""Light: sun and sky, environment maps, gloss and textures, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest
from commands import refused
from numpy.typing import NDArray
from small_scenes import write_box_scene

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.dataset.manifest import scene_hash, scene_key
from rsbench.renderers.backend import start_backend
from rsbench.renderers.image import to_srgb8
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.render import Frame, LinePoses, render, render_global
from rsbench.renderers.scene import MitsubaScene, _loaded
from rsbench.scenes.load import irradiance_map, lit_by, load_scene, read_environment
from rsbench.scenes.model import Light, Material, Scene, SceneMesh, Viewpoint

CAMERA = PinholeCamera.centred(32, 24, 20.0)
UP = (0.0, -1.0, 0.0)
BLACK = (0.0, 0.0, 0.0)
WHITE_SKY = Light(sun_direction=UP, sun_irradiance=BLACK, sky_zenith=(1, 1, 1), sky_horizon=(1, 1, 1), up=UP)
SKY = replace(WHITE_SKY, sky_zenith=(0.2, 0.4, 0.9), sky_horizon=(0.8, 0.8, 0.7))
INTEGRATORS = pytest.mark.parametrize("integrator", ["sunsky", "path"])


def sun_alone(direction: Any, irradiance: tuple[float, float, float] = (np.pi,) * 3) -> Light:
    return Light(
        sun_direction=tuple(direction), sun_irradiance=irradiance, sky_zenith=BLACK, sky_horizon=BLACK, up=UP
    )


def white(**more: Any) -> Material:
    return Material(name="w", colour=(1, 1, 1), **more)


def frame(
    light: Light, *meshes: SceneMesh, camera: PinholeCamera = CAMERA, view: Viewpoint | None = None, **options: Any
) -> Frame:
    """Of a camera at the origin of the world, or at a viewpoint of the scene."""
    named = tuple(replace(mesh, name=f"{mesh.name}{k}" if k else mesh.name) for k, mesh in enumerate(meshes))
    scene = Scene(name="test", meshes=named, light=light)
    seen = MitsubaScene(scene if view is None else scene.seen_from(view))
    return render_global(seen, camera, np.eye(3), np.zeros(3), RendererOptions(**options))


def picture(light: Light, *meshes: SceneMesh, **more: Any) -> Any:
    return frame(light, *meshes, **more).image


def wall(quad: Any, z: float = 5.0, size: float = 20.0, **extra: Any) -> SceneMesh:
    """Faces the camera; its first corner is the top left one."""
    mesh: SceneMesh = quad([[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]], **extra)
    return mesh


def linear(srgb: float) -> float:
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4


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


@INTEGRATORS
def test_texture_stands_upright_repeats_and_is_srgb(quad: Any, integrator: Integrator) -> None:
    """Row 0 of a texture is its top, v points up, and one unit of uv is one repeat."""
    texels = np.array([[[200, 20, 20], [20, 200, 20]], [[20, 20, 200], [128, 128, 128]]], dtype=np.uint8)
    texture = texels.repeat(8, axis=0).repeat(8, axis=1)
    uv = np.array([[0.0, 1.0], [2.0, 1.0], [2.0, -1.0], [0.0, -1.0]])
    mesh = wall(quad, z=2.0, size=1.0, material=Material(name="t", texture=texture), uv=uv)
    camera = PinholeCamera.centred(32, 32, 32.0)  # the wall fills it: 16 pixels a repeat, one texel each
    image = picture(sun_alone((0, 0, -1)), mesh, camera=camera, integrator=integrator, samples=1)
    decoded = np.vectorize(linear)(texture / 255.0)
    np.testing.assert_allclose(image, np.tile(decoded, (2, 2, 1)), rtol=2e-5, atol=2e-5)


@INTEGRATORS
def test_lambertian_wall_has_the_closed_form_radiance(quad: Any, integrator: Integrator) -> None:
    """L = albedo E cos / pi, from either side of the surface."""
    direction = np.array([0.6, 0.0, -0.8])
    irradiance = (3.0, 2.0, 1.0)
    mesh = wall(quad, material=Material(name="m", colour=(0.5, 0.7, 1.0)))
    flipped = quad(mesh.vertices[::-1], mesh.material)
    albedo = np.array([linear(0.5), linear(0.7), 1.0])
    expected = albedo * irradiance * 0.8 / np.pi
    for side in (mesh, flipped):
        image = picture(sun_alone(direction, irradiance), side, integrator=integrator, samples=4)
        np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=1e-5)


def test_sky_term_of_sunsky(quad: Any) -> None:
    """A wall gets 0.6 of the sky's mean radiance, level ground all of it; the path tracer agrees on the ground."""
    mean = np.array([0.8, 0.8, 0.7]) / 3 + 2 * np.array([0.2, 0.4, 0.9]) / 3
    grey = Material(name="grey", colour=(0.5, 0.5, 0.5))
    image = picture(SKY, wall(quad, material=grey))
    np.testing.assert_allclose(image, np.broadcast_to(0.6 * linear(0.5) * mean, image.shape), rtol=1e-5)
    ground = quad([[-500, 1, 500], [500, 1, 500], [500, 1, -500], [-500, 1, -500]], grey)
    image = picture(SKY, ground)[20:]
    np.testing.assert_allclose(image, np.broadcast_to(linear(0.5) * mean, image.shape), rtol=1e-5)
    traced = picture(SKY, ground, integrator="path", samples=256)[20:]
    # Monte Carlo: 128 pixels of 256 samples, relative deviation of one sample below 1: 1 / 181; five of them.
    np.testing.assert_allclose(traced.mean(axis=(0, 1)), linear(0.5) * mean, rtol=0.03)


@INTEGRATORS
def test_empty_pixels_show_the_sky(integrator: Integrator) -> None:
    light = Light(sun_direction=UP, sky_zenith=(0.1, 0.2, 0.9), sky_horizon=(0.8, 0.7, 0.6), up=UP)
    image = picture(light, integrator=integrator, samples=1)
    y, x = np.mgrid[:24, :32]
    d = np.stack([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, np.ones_like(x)], axis=-1)
    sine = np.maximum(-d[..., 1] / np.linalg.norm(d, axis=-1), 0.0)[..., None]
    expected = np.array(light.sky_horizon) + (np.array(light.sky_zenith) - light.sky_horizon) * sine
    # `path` reads the sky from a map of 64 rows, interpolated: half a row's slope at the horizon's kink.
    np.testing.assert_allclose(image, expected, atol=1e-5 if integrator == "sunsky" else 0.7 * np.pi / 64 / 2)


@INTEGRATORS
def test_a_shadow_falls_where_the_sun_is_hidden(quad: Any, integrator: Integrator) -> None:
    """Sun from straight above; a roof over x > 0 shades that half of the ground, and the sky is black."""
    sun = sun_alone(UP, (2.6, 2.4, 2.1))
    ground = quad([[-50, 1, 50], [50, 1, 50], [50, 1, -50], [-50, 1, -50]])
    roof = quad([[0, -30, 50], [50, -30, 50], [50, -30, -50], [0, -30, -50]], Material(name="b", colour=BLACK))
    image = picture(sun, ground, roof, integrator=integrator)[16:]
    expected = linear(0.8) * np.array(sun.sun_irradiance) / np.pi
    np.testing.assert_allclose(image[:, :16], np.broadcast_to(expected, (8, 16, 3)), rtol=1e-5)
    np.testing.assert_array_equal(image[:, 16:], 0.0)


@INTEGRATORS
def test_shading_normals_are_used_as_given(quad: Any, integrator: Integrator) -> None:
    normal = np.array([0.6, 0.0, -0.8])
    mesh = wall(quad, material=white(), normals=np.tile(normal, (4, 1)))
    image = picture(sun_alone(normal), mesh, integrator=integrator, samples=1)
    np.testing.assert_allclose(image, 1.0, rtol=1e-5)


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
    good, texture = wall(quad), np.zeros((4, 4, 3), dtype=np.uint8)
    bad: tuple[tuple[str, Any, str], ...] = (
        ("material", white(texture=texture[..., 0]), "texture of shape (4, 4), uint8"),
        ("vertices", np.where(good.vertices > 5, np.nan, good.vertices), "mesh 'quad': vertices of shape"),
        ("uv", np.zeros((3, 2)), "mesh 'quad': uv of shape"),
        ("normals", np.zeros((4, 2)), "mesh 'quad': normals of shape"),
        ("faces", good.faces + 1, "mesh 'quad': faces of shape"),
        ("faces", good.faces - 1, "mesh 'quad': faces of shape"),
        ("faces", good.faces.ravel(), "mesh 'quad': faces of shape"),
    )
    for field, value, words in bad:
        with refused(words):
            picture(WHITE_SKY, replace(good, **{field: value}))
    with refused("'quad'", "no uv"):
        picture(WHITE_SKY, wall(quad, material=white(texture=texture), uv=None))
    with refused("sun_direction"):
        picture(Light(sun_direction=(0.0, 0.0, 0.0)))
    with refused("up"):
        picture(Light(sun_direction=(0.0, 0.0, 1.0), up=(0.0, float("nan"), 0.0)))


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.0, -0.6, -0.8), (0.0, 0.28, -0.96)])
def test_an_open_surface_has_all_light_of_the_sky(quad: Any, normal: tuple[float, float, float]) -> None:
    """Against a sum over directions; with few of its own the ratio of the renderer is exact all the same."""
    z = 1.0 - (2.0 * np.arange(40_000) + 1.0) / 40_000
    turn, level = np.arange(40_000) * 2.399963, np.sqrt(1 - z**2)
    ways = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=-1)
    height = np.maximum(-ways[:, 1:2], 0.0)
    radiance = np.array(SKY.sky_horizon) + (np.array(SKY.sky_zenith) - SKY.sky_horizon) * height
    expected = 4 * np.mean(radiance * np.maximum(ways @ normal, 0.0)[:, None], axis=0)
    mesh = wall(quad, material=white(), normals=np.tile(normal, (4, 1)))
    image = picture(SKY, mesh, sky_rays=1, samples=1)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), rtol=2e-3)


def test_a_wall_hides_its_part_of_the_sky(quad: Any) -> None:
    """Of a white sky, level ground at x from a wall of height h and no end has (1 + cos(atan(h / x))) / 2."""
    ground = quad([[-1e3, 1, 1e3], [1e3, 1, 1e3], [1e3, 1, -1e3], [-1e3, 1, -1e3]], white())
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
    direct = replace(options, integrator="path", samples=64, max_depth=2)
    traced = render_global(scene, camera, np.eye(3), np.zeros(3), direct)
    on = seen.depth > 0
    assert np.mean(seen.image[on]) == pytest.approx(np.mean(traced.image[on]), rel=0.01)
    rough = np.median(np.abs(seen.image[on] / traced.image[on] - 1))
    assert rough < 0.08
    poses = np.broadcast_to(np.eye(3), (30, 3, 3)), np.zeros((30, 3))
    rows = render(scene, camera, LinePoses(*poses), options, rows=[3, 17]).image
    np.testing.assert_array_equal(rows, seen.image[[3, 17]])


CARD = Light(sun_direction=(0.0, 0.6, 0.8), sun_irradiance=(2.0, 2.0, 2.0), sky_zenith=(0.4,) * 3)
AHEAD = Viewpoint(eye=(0.0, 0.0, 1.0), target=(0.0, 1.0, 1.0))


def _sky(height: int = 32) -> NDArray[np.float32]:
    """Another colour in each direction, brighter above; nothing is black."""
    y, x = np.mgrid[:height, : 2 * height]
    turn = np.pi * (x + 0.5) / height
    wave = [1.2 + np.cos(turn - 2.1 * k) * np.sin(np.pi * (y + 0.5) / height) for k in range(3)]
    return (np.stack(wave, axis=-1) * (1.5 - y / height)[..., None]).astype(np.float32)


def _save(path: Path, radiance: NDArray[np.float32]) -> Path:
    if path.suffix == ".hdr":
        assert cv2.imwrite(str(path), np.ascontiguousarray(radiance[..., ::-1]))
        return path
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {name: radiance[..., k].copy() for k, name in enumerate("RGB")}) as file:
        file.write(str(path))
    return path


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_both_formats_are_read(tmp_path: Path, suffix: str) -> None:
    radiance = _sky()
    read = read_environment(_save(tmp_path / f"sky{suffix}", radiance))
    # RGBE has eight bits for the brightest of three values.
    np.testing.assert_allclose(read, radiance, atol=0.0 if suffix == ".exr" else radiance.max() / 128)


def test_the_middle_of_the_map_lies_ahead_and_its_right_side_at_the_right() -> None:
    radiance = np.full((32, 64, 3), 0.1, np.float32)
    radiance[:, 32:40, 0] = 2.0  # red: from ahead to an eighth of the way round, to the right
    radiance[:14, :, 1] = 1.0  # green above
    for turn, red in ((0.0, slice(18, 32)), (90.0, slice(0, 0))):
        for integrator in ("sunsky", "path"):
            image = picture(lit_by(CARD, radiance, turn), view=AHEAD, integrator=integrator, samples=4)
            is_red, is_green = (image[..., k] > 3 * image[..., 2] for k in (0, 1))
            assert np.all(is_red[20, red]) and not np.any(is_red[20, : red.start - 4])
            assert np.all(is_green[0]) and not np.any(is_green[23])


def test_a_map_is_as_bright_as_the_light_of_the_card_and_its_sun_is_a_sun() -> None:
    """Level ground gets sun times sine plus sky; so much sun as a disc of so much light has."""
    radiance = np.full((64, 128, 3), 0.5, np.float32)
    row, column = 20, 80
    radiance[row, column] = 40_000.0
    light = lit_by(CARD, 7.0 * radiance, 0.0)
    down, around = np.pi * (row + 0.5) / 64, np.pi * ((column + 0.5) / 64 - 1)
    way = np.array([np.sin(down) * np.sin(around), np.sin(down) * np.cos(around), np.cos(down)])
    np.testing.assert_allclose(light.sun_direction, way, atol=1e-6)
    assert light.environment is not None
    solid = (np.cos(np.pi * row / 64) - np.cos(np.pi * (row + 1) / 64)) * np.pi / 64
    sky = float(light.environment.radiance[-1, 0, 0])
    assert np.ptp(light.environment.radiance) < 1e-6, "the sun is not in the map any more"
    assert light.sun_irradiance[0] / sky == pytest.approx((40_000.0 - 0.5) * solid / 0.5, rel=1e-6)
    horizon = 0.2126 * 0.75 + 0.7152 * 0.85 + 0.0722 * 0.95
    wanted = 2.0 * 0.8 + np.pi * (horizon + 2 * 0.4) / 3
    # The sum over 64 rows errs by about (pi / 64)^2 / 24.
    assert light.sun_irradiance[0] * way[2] + np.pi * sky == pytest.approx(wanted, rel=1e-4)
    assert lit_by(CARD, _sky(), 0.0).sun_irradiance == (0.0, 0.0, 0.0), "a map without a sun has none"


def test_open_surfaces_have_the_sum_of_all_light(quad: Any) -> None:
    light = lit_by(CARD, _sky(), 30.0)
    wall = quad([[-20, 5, 21], [20, 5, 21], [20, 5, -19], [-20, 5, -19]], white())
    seen, near = (picture(light, wall, view=AHEAD, samples=1, sky_rays=rays)[12, 16] for rays in (0, 2))
    traced = picture(light, wall, view=AHEAD, integrator="path", samples=256, max_depth=2).mean(axis=(0, 1))
    # 768 pixels of 256 samples that differ by less than themselves: 0.2 %; the map of open surfaces has 32 rows.
    np.testing.assert_allclose(seen, traced, rtol=0.01)
    np.testing.assert_allclose(near, traced, rtol=0.01)
    even = irradiance_map(np.ones((33, 64, 3), np.float32))
    np.testing.assert_allclose(even, 1.0, rtol=2e-3)


def test_a_card_names_its_map_and_the_hash_knows_it(tmp_path: Path) -> None:
    card = write_box_scene(tmp_path, "box")
    plain = load_scene(card)
    card.write_text(card.read_text() + '[light]\nenvironment = "sky.exr"\nenvironment_turn_deg = 45.0\n')
    with pytest.raises(RsbenchError, match=r"sky.exr: cannot be read"):
        load_scene(card)
    hashes = {scene_hash(plain)}
    for factor in (np.float32(1), np.linspace(1, 2, 64, dtype=np.float32)[:, None]):
        _save(tmp_path / "sky.exr", _sky() * factor)
        hashes.add(scene_hash(load_scene(card)))
    assert len(hashes) == 3 and scene_key(str(card)) is None


def test_what_is_no_map_is_refused_by_its_header(tmp_path: Path) -> None:
    huge = tmp_path / "huge.hdr"
    huge.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 50000 +X 100000\n")
    wide = _save(tmp_path / "wide.exr", np.ones((8, 15, 3), np.float32))
    dark = _save(tmp_path / "dark.exr", np.zeros((8, 16, 3), np.float32))
    bent = _save(tmp_path / "bent.exr", np.full((8, 16, 3), np.nan, np.float32))
    cut = tmp_path / "cut.exr"
    cut.write_bytes(_save(tmp_path / "whole.exr", _sky()).read_bytes()[:400])
    short = tmp_path / "short.hdr"
    short.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 64 +X 128\n")
    (tmp_path / "sky.png").write_bytes(b"x")
    for path, words in (
        (huge, "RSBENCH_LIMITS"),
        (wide, "15 x 8: a lat-long map is twice as wide as high"),
        (dark, "no light at all"),
        (bent, "not finite"),
        (cut, "damaged"),
        (short, "damaged"),
        (tmp_path / "sky.png", "must end in .hdr or .exr"),
    ):
        with refused(words, path.name):
            read_environment(path)


FloatArray = NDArray[np.float64]
TOWARDS_SUN = np.array([0.48, -0.36, -0.8])
SUN = sun_alone(TOWARDS_SUN, (3.0, 2.0, 1.0))
INDEX = 1.5


def coat(roughness: float, colour: tuple[float, float, float] = BLACK) -> Material:
    return Material(name="coat", colour=colour, roughness=roughness)


def coated(quad: Any, material: Material) -> SceneMesh:
    return wall(quad, size=40.0, material=material)


def towards_eye() -> FloatArray:
    """(24, 32, 3) unit vectors from the surfaces of pixel centres."""
    rays = CAMERA.unproject(CAMERA.pixel_grid())
    return np.asarray(-rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def fresnel(cosine: FloatArray) -> FloatArray:
    """Share of unpolarised light that a dielectric mirrors."""
    inner = np.sqrt(1 - (1 - cosine**2) / INDEX**2)
    across = (cosine - INDEX * inner) / (cosine + INDEX * inner)
    along = (INDEX * cosine - inner) / (INDEX * cosine + inner)
    return np.asarray(0.5 * (across**2 + along**2))


def facets(wi: FloatArray, wo: FloatArray, normal: FloatArray, roughness: float) -> FloatArray:
    """Cook and Torrance 1982 with the facets of Walter et al. 2007 (GGX): f times the cosine of ``wo``."""
    alpha2 = roughness**4
    half = wi + wo
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    c = half @ normal
    spread = alpha2 / (np.pi * (c * c * (alpha2 - 1) + 1) ** 2)
    shadow = np.ones(c.shape)
    for way in (wi, wo):
        cosine = np.broadcast_to(way, wi.shape) @ normal
        shadow = shadow * 2 / (1 + np.sqrt(1 + alpha2 * (1 / cosine**2 - 1)))
    return np.asarray(spread * shadow * fresnel(np.sum(wi * half, axis=-1)) / (4 * (wi @ normal)))


@INTEGRATORS
@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5])
def test_the_sun_glints_as_facets_say(quad: Any, integrator: Integrator, roughness: float) -> None:
    """One sample a pixel, at its centre, and no light but the sun's."""
    image = picture(SUN, coated(quad, coat(roughness)), integrator=integrator, samples=1, max_depth=2)
    normal = np.array([0.0, 0.0, -1.0])
    expected = facets(towards_eye(), TOWARDS_SUN, normal, roughness)
    # float32, of which the narrowest glint makes the most: its exponent is 1 / alpha^2 = 2000 times the rounding.
    np.testing.assert_allclose(image, expected[..., None] * SUN.sun_irradiance, rtol=1e-3, atol=1e-7)
    # The brightest pixel shows the sun's mirror image; a wide glint leans to where Fresnel's share grows.
    y, x = np.unravel_index(np.argmax(image[..., 0]), image.shape[:2])
    place = CAMERA.project(TOWARDS_SUN * (1, 1, -1))
    assert roughness > 0.2 or np.max(np.abs(place - (x, y))) <= 1.0


@INTEGRATORS
def test_a_smooth_coat_mirrors_what_fresnel_says(quad: Any, integrator: Integrator) -> None:
    """Of a white sky all around; the surface below is black."""
    samples = 16 if integrator == "sunsky" else 256
    options: dict[str, Any] = {"integrator": integrator, "samples": samples, "max_depth": 2}
    image = picture(WHITE_SKY, coated(quad, coat(0.05)), **options)[..., 1]
    expected = fresnel(towards_eye()[..., 2] * -1)
    # What facets of alpha = 0.0025 lose and blur is below a part in a thousand; the path tracer draws coat or not
    # at even odds, so that 256 samples err by 1 / 16 or less, and its mean over 768 pixels by 0.3 %.
    if integrator == "sunsky":
        np.testing.assert_allclose(image, expected, rtol=2e-3)
    assert np.mean(image) == pytest.approx(np.mean(expected), rel=2e-3 if integrator == "sunsky" else 0.01)


@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.5])
def test_below_a_coat_lies_what_path_sees_there(quad: Any, roughness: float) -> None:
    """Both parts of a white sky's light. The path tracer's mean errs by 0.2 %, sunsky's constant by 0.5 %, and its
    64 facets, the same in all pixels, by 0.2 % of the sky where the coat is rough."""
    mesh = coated(quad, coat(roughness, (0.7, 0.5, 0.2)))
    seen = picture(WHITE_SKY, mesh, samples=64, sky_rays=1)
    traced = picture(WHITE_SKY, mesh, samples=1024, integrator="path", max_depth=2)
    np.testing.assert_allclose(np.mean(seen, axis=(0, 1)), np.mean(traced, axis=(0, 1)), rtol=5e-3, atol=2e-3)


@INTEGRATORS
def test_a_mirror_image_stands_where_geometry_says(quad: Any, integrator: Integrator) -> None:
    """A white patch beside the camera, mirrored in a black wall at z = 5, is seen as far behind it."""
    corners = [[3.0, -0.5, 1.0], [4.0, -0.5, 1.0], [4.0, 0.5, 1.0], [3.0, 0.5, 1.0]]
    patch = quad(corners, white())
    # From above and from behind the wall, past its upper edge: upon the side of the patch that it mirrors.
    light = replace(SUN, sun_direction=(0.0, -0.998, 0.06), sun_irradiance=(300.0, 300.0, 300.0))
    samples = 16 if integrator == "sunsky" else 256
    options: dict[str, Any] = {"integrator": integrator, "samples": samples, "max_depth": 3}
    image = picture(light, coated(quad, coat(0.05)), patch, **options)[..., 0]
    expected = CAMERA.project(np.array([3.5, 0.0, 9.0]))
    x, y = (np.sum(axis * image) / np.sum(image) for axis in np.moveaxis(CAMERA.pixel_grid(), -1, 0))
    assert np.max(image) > 0.01
    np.testing.assert_allclose([x, y], expected, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"sky_rays": 2}, {"integrator": "path"}], ids=str)
def test_single_pass_is_stitched_with_gloss(town: Scene, row_poses: Any, options: dict[str, Any]) -> None:
    """Bit for bit, image, depth and mask; and the mask is that of the instances."""
    shiny = {"ground": 0.3, "box1": 0.05, "sphere": 0.5}
    meshes = tuple(
        replace(mesh, material=replace(mesh.material, roughness=shiny.get(mesh.material.name)))
        for mesh in town.meshes
    )
    scene = MitsubaScene(replace(town, meshes=meshes))
    camera = PinholeCamera.centred(30, 24, 26.0)
    R, t = row_poses(24, w=(-0.1, 0.2, 0.1), d=(-0.4, 0.1, 0.3))
    chosen = RendererOptions(samples=4, seed=7, **options)
    one = render(scene, camera, LinePoses(R, t), chosen)
    whole = render(scene, camera, LinePoses(R, t), replace(chosen, method="stitched", full_frames=True))
    rows = render(scene, camera, LinePoses(R, t), replace(chosen, method="stitched"), rows=[3, 17])
    dull = render(MitsubaScene(town), camera, LinePoses(R, t), chosen)
    for name in ("image", "depth", "gloss"):
        np.testing.assert_array_equal(getattr(one, name), getattr(whole, name))
        np.testing.assert_array_equal(getattr(rows, name), getattr(one, name)[[3, 17]])
    np.testing.assert_array_equal(one.depth, dull.depth)
    assert not np.any(dull.gloss) and 0.2 < np.mean(one.gloss) < 0.9


def test_roughness_has_a_range() -> None:
    for value in (0.0, 0.04, 0.51, float("nan")):
        with pytest.raises(RsbenchError, match=r"'coat': roughness = .*0.05 to 0.5"):
            coat(value)


SIZES = ((1, 1), (1, 7), (2, 2), (3, 640), (256, 256), (513, 31))


@pytest.fixture(scope="module")
def materials() -> list[Material]:
    rng = np.random.default_rng(0)
    textures = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in SIZES]
    colour = Material(name="plain", colour=(0.2, 0.04, 1.0))
    return [colour, *(Material(name=f"texture {k}", texture=each) for k, each in enumerate(textures))]


@pytest.fixture(scope="module")
def scene(materials: list[Material], quad: Any) -> MitsubaScene:
    if start_backend().variant == "scalar_rgb":
        pytest.skip("asks Mitsuba's textures themselves")
    corners = [[-1, -1, 4], [1, -1, 4], [1, 1, 4], [-1, 1, 4]]
    meshes = tuple(quad(corners, each, name=each.name) for each in materials)
    return MitsubaScene(Scene(name="quads", meshes=meshes, light=Light(sun_direction=(0, -1, -1), up=UP)))


def shape_of(scene: MitsubaScene, number: int) -> Any:
    """Mitsuba's shape of a mesh."""
    return next(shape for shape in scene.scene.shapes() if shape.id() == f"mesh{number:05d}")


def hits(scene: MitsubaScene, number: int, reach: float, size: tuple[int, int]) -> Any:
    """Anywhere within ``reach`` of the texture of a mesh, at the middles of texels, and at their borders."""
    import drjit as dr
    import mitsuba as mi

    anywhere = np.random.default_rng(1).uniform(-reach, reach, (2, 10_000))
    halves = 2 * np.array(size[::-1])[:, None]
    uv = np.concatenate([anywhere, np.round(anywhere * halves) / halves], axis=1).astype(np.float32)
    found = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    found.uv, found.shape = mi.Point2f(*map(mi.Float, uv)), mi.ShapePtr(shape_of(scene, number))
    return found


@pytest.mark.parametrize("reach", [1.0, 40.0, 3000.0, 3e5])
def test_reflectances_have_the_bits_of_mitsubas(
    scene: MitsubaScene, materials: list[Material], reach: float
) -> None:
    for number, (material, size) in enumerate(zip(materials, ((1, 1), *SIZES), strict=True)):
        hit = hits(scene, number, reach, size)
        ours = np.array(scene.reflectance(hit, True))
        theirs = np.array(_loaded(material).eval_diffuse_reflectance(hit))
        np.testing.assert_array_equal(ours, np.broadcast_to(theirs, ours.shape))
        assert material.texture is None or size == (1, 1) or np.ptp(ours) > 0.5


def test_coordinates_beyond_all_measure_end_within_the_texture(scene: MitsubaScene) -> None:
    for number in range(1, 1 + len(SIZES)):
        for reach in (1e8, 1e20):
            found = np.array(scene.reflectance(hits(scene, number, reach, (1, 1)), True))
            assert np.all((found >= 0.0) & (found <= 1.0))
