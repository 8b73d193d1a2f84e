"""Glossy surfaces against closed forms: Fresnel, Trowbridge and Reitz, and where a mirror shows what."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.renderers.options import Integrator, RendererOptions
from rsbench.renderers.pixel_samples import facet_points
from rsbench.renderers.render import Frame, LinePoses, render, render_global
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

FloatArray = NDArray[np.float64]
CAMERA = PinholeCamera.centred(32, 24, 20.0)
UP, BLACK = (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)
WHITE = Light(sun_direction=UP, sun_irradiance=BLACK, sky_zenith=(1, 1, 1), sky_horizon=(1, 1, 1), up=UP)
TOWARDS_SUN = np.array([0.48, -0.36, -0.8])
SUN = Light(
    sun_direction=(0.48, -0.36, -0.8), sun_irradiance=(3.0, 2.0, 1.0), sky_zenith=BLACK, sky_horizon=BLACK, up=UP
)
INDEX = 1.5


def coat(roughness: float, colour: tuple[float, float, float] = BLACK) -> Material:
    return Material(name="coat", colour=colour, roughness=roughness)


def wall(quad: Any, material: Material, z: float = 5.0) -> SceneMesh:
    mesh: SceneMesh = quad([[-40, -40, z], [40, -40, z], [40, 40, z], [-40, 40, z]], material)
    return mesh


def frame(light: Light, *meshes: SceneMesh, **options: Any) -> Frame:
    named = [replace(mesh, name=f"m{number}") for number, mesh in enumerate(meshes)]
    scene = MitsubaScene(Scene(name="test", meshes=tuple(named), light=light))
    return render_global(scene, CAMERA, np.eye(3), np.zeros(3), RendererOptions(**options))


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


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5])
def test_the_sun_glints_as_facets_say(quad: Any, integrator: Integrator, roughness: float) -> None:
    """One sample a pixel, at its centre, and no light but the sun's."""
    image = frame(SUN, wall(quad, coat(roughness)), integrator=integrator, samples=1, max_depth=2).image
    normal = np.array([0.0, 0.0, -1.0])
    expected = facets(towards_eye(), TOWARDS_SUN, normal, roughness)
    # float32, of which the narrowest glint makes the most: its exponent is 1 / alpha^2 = 2000 times the rounding.
    np.testing.assert_allclose(image, expected[..., None] * SUN.sun_irradiance, rtol=1e-3, atol=1e-7)
    # The brightest pixel shows the sun's mirror image; a wide glint leans to where Fresnel's share grows.
    y, x = np.unravel_index(np.argmax(image[..., 0]), image.shape[:2])
    place = CAMERA.project(TOWARDS_SUN * (1, 1, -1))
    assert roughness > 0.2 or np.max(np.abs(place - (x, y))) <= 1.0


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_a_smooth_coat_mirrors_what_fresnel_says(quad: Any, integrator: Integrator) -> None:
    """Of a white sky all around; the surface below is black."""
    samples = 16 if integrator == "sunsky" else 256
    image = frame(WHITE, wall(quad, coat(0.05)), integrator=integrator, samples=samples, max_depth=2).image[..., 1]
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
    mesh = wall(quad, coat(roughness, (0.7, 0.5, 0.2)))
    seen = frame(WHITE, mesh, samples=64, sky_rays=1).image
    traced = frame(WHITE, mesh, samples=1024, integrator="path", max_depth=2).image
    np.testing.assert_allclose(np.mean(seen, axis=(0, 1)), np.mean(traced, axis=(0, 1)), rtol=5e-3, atol=2e-3)


@pytest.mark.parametrize("integrator", ["sunsky", "path"])
def test_a_mirror_image_stands_where_geometry_says(quad: Any, integrator: Integrator) -> None:
    """A white patch beside the camera, mirrored in a black wall at z = 5, is seen as far behind it."""
    corners = [[3.0, -0.5, 1.0], [4.0, -0.5, 1.0], [4.0, 0.5, 1.0], [3.0, 0.5, 1.0]]
    patch = quad(corners, Material(name="p", colour=(1, 1, 1)))
    # From above and from behind the wall, past its upper edge: upon the side of the patch that it mirrors.
    light = replace(SUN, sun_direction=(0.0, -0.998, 0.06), sun_irradiance=(300.0, 300.0, 300.0))
    samples = 16 if integrator == "sunsky" else 256
    options: dict[str, Any] = {"integrator": integrator, "samples": samples, "max_depth": 3}
    image = frame(light, wall(quad, coat(0.05)), patch, **options).image[..., 0]
    expected = CAMERA.project(np.array([3.5, 0.0, 9.0]))
    x, y = (np.sum(axis * image) / np.sum(image) for axis in np.moveaxis(CAMERA.pixel_grid(), -1, 0))
    assert np.max(image) > 0.01
    np.testing.assert_allclose([x, y], expected, atol=0.1)


def test_facets_are_spread_evenly_and_one_is_the_middle() -> None:
    np.testing.assert_array_equal(facet_points(1), [[0.5, 0.5]])
    points = facet_points(16)
    assert points.min() > 0 and points.max() < 1
    assert len({tuple(cell) for cell in np.floor(4 * points).astype(int).tolist()}) == 16


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
