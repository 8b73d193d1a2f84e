"""Textures as bytes: the bits that Mitsuba's own bilinear, repeated textures have."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rsbench.renderers.backend import start_backend
from rsbench.renderers.scene import MitsubaScene, _loaded
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

SIZES = ((1, 1), (1, 7), (2, 2), (3, 640), (256, 256), (513, 31))


@pytest.fixture(scope="module")
def materials() -> list[Material]:
    rng = np.random.default_rng(0)
    textures = [rng.integers(0, 256, (*size, 3), dtype=np.uint8) for size in SIZES]
    colour = Material(name="plain", colour=(0.2, 0.04, 1.0))
    return [colour, *(Material(name=f"texture {k}", texture=each) for k, each in enumerate(textures))]


@pytest.fixture(scope="module")
def scene(materials: list[Material]) -> MitsubaScene:
    if start_backend().variant == "scalar_rgb":
        pytest.skip("asks Mitsuba's textures themselves")
    corners = np.array([[-1, -1, 4], [1, -1, 4], [1, 1, 4], [-1, 1, 4]], dtype=float)
    meshes = tuple(
        SceneMesh(
            name=each.name,
            vertices=corners,
            faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
            material=each,
            uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=float),
        )
        for each in materials
    )
    light = Light(sun_direction=(0, -1, -1), up=(0, -1, 0))
    return MitsubaScene(Scene(name="quads", meshes=meshes, light=light))


def hits(shape: Any, reach: float, size: tuple[int, int]) -> Any:
    """Anywhere within ``reach`` of the texture, at the middles of texels, and at their borders."""
    import drjit as dr
    import mitsuba as mi

    anywhere = np.random.default_rng(1).uniform(-reach, reach, (2, 10_000))
    halves = 2 * np.array(size[::-1])[:, None]
    uv = np.concatenate([anywhere, np.round(anywhere * halves) / halves], axis=1).astype(np.float32)
    found = dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    found.uv, found.shape = mi.Point2f(*map(mi.Float, uv)), mi.ShapePtr(shape)
    return found


@pytest.mark.parametrize("reach", [1.0, 40.0, 3000.0, 3e5])
def test_reflectances_have_the_bits_of_mitsubas(
    scene: MitsubaScene, materials: list[Material], reach: float
) -> None:
    shapes = {shape.id(): shape for shape in scene.scene.shapes()}
    for number, (material, size) in enumerate(zip(materials, ((1, 1), *SIZES), strict=True)):
        hit = hits(shapes[f"mesh{number:05d}"], reach, size)
        ours = np.array(scene.reflectance(hit, True))
        theirs = np.array(_loaded(material).eval_diffuse_reflectance(hit))
        np.testing.assert_array_equal(ours, np.broadcast_to(theirs, ours.shape))
        assert material.texture is None or size == (1, 1) or np.ptp(ours) > 0.5


def test_textures_come_back_from_their_bytes(scene: MitsubaScene, materials: list[Material]) -> None:
    shapes = {shape.id(): shape for shape in scene.scene.shapes()}
    assert scene._reflectances is not None
    for number, material in enumerate(materials):
        texture = scene._reflectances.texture(shapes[f"mesh{number:05d}"])
        if material.texture is None:
            assert texture is None
        else:
            np.testing.assert_array_equal(texture, material.texture)


def test_coordinates_beyond_all_measure_end_within_the_texture(scene: MitsubaScene) -> None:
    shapes = {shape.id(): shape for shape in scene.scene.shapes()}
    for number in range(1, 1 + len(SIZES)):
        for reach in (1e8, 1e20):
            found = np.array(scene.reflectance(hits(shapes[f"mesh{number:05d}"], reach, (1, 1)), True))
            assert np.all((found >= 0.0) & (found <= 1.0))
