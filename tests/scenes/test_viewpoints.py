"""Viewpoints and light: frames, horizon, centring, against vector algebra written here."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rsbench.core.errors import RsbenchError
from rsbench.scenes.load import LightCard
from rsbench.scenes.model import Light, Material, Scene, SceneMesh, Viewpoint

coordinate = st.floats(-50, 50, allow_nan=False)
point = st.tuples(coordinate, coordinate, coordinate)


@given(point, point)
@settings(max_examples=80)
def test_the_view_is_centred_level_and_right_handed(
    eye: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    sight = np.subtract(target, eye)
    assume(np.hypot(sight[0], sight[1]) > 1e-3)
    rotation, translation = Viewpoint(eye=eye, target=target).world_from_scene()
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert rotation @ eye + translation == pytest.approx(np.zeros(3), abs=1e-10)
    assert rotation @ target + translation == pytest.approx([0, 0, np.linalg.norm(sight)], abs=1e-9)
    up = rotation @ (0, 0, 1)
    assert up[0] == pytest.approx(0, abs=1e-12) and up[1] < 0  # the image's y points down


def test_a_known_view() -> None:
    rotation, _ = Viewpoint(eye=(1, -2, 3), target=(1, 5, 3)).world_from_scene()
    assert rotation == pytest.approx(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]))


@pytest.mark.parametrize("target", [(0.0, 0.0, 5.0), (0.0, 0.0, -5.0), (0.0, 0.0, 0.0)])
def test_vertical_views_are_refused(target: tuple[float, float, float]) -> None:
    with pytest.raises(RsbenchError, match="vertical"):
        Viewpoint(eye=(0.0, 0.0, 0.0), target=target).world_from_scene()


def test_seen_from_moves_everything_rigidly() -> None:
    vertices = np.array([[1.0, 2, 3], [4, 5, 6], [-1, 0, 2]])
    normals = np.array([[0.0, 0, 1], [1, 0, 0], [0, 0.6, 0.8]])
    mesh = SceneMesh(
        name="m",
        vertices=vertices,
        faces=np.array([[0, 1, 2]], np.int32),
        material=Material(name="a"),
        normals=normals,
    )
    light = Light(sun_direction=(0.6, 0.0, 0.8))
    scene = Scene(name="s", meshes=(mesh,), light=light, viewpoints={})
    seen = scene.seen_from(Viewpoint(eye=(3, 3, 3), target=(0, 7, 1)))
    moved = seen.meshes[0]
    for a in range(3):
        for b in range(3):
            before = np.linalg.norm(vertices[a] - vertices[b])
            assert np.linalg.norm(moved.vertices[a] - moved.vertices[b]) == pytest.approx(before)
    assert moved.normals is not None
    sun, up = np.asarray(seen.light.sun_direction), np.asarray(seen.light.up)
    assert moved.normals @ sun == pytest.approx(normals @ (0.6, 0.0, 0.8))
    assert sun @ up == pytest.approx(0.8)
    assert np.linalg.norm(moved.vertices, axis=1) == pytest.approx(np.linalg.norm(vertices - 3, axis=1))


def test_the_sun_stands_where_the_card_says() -> None:
    light = LightCard(sun_azimuth_deg=90.0, sun_elevation_deg=30.0).light()
    assert light.sun_direction == pytest.approx((0.0, 0.75**0.5, 0.5))
    light = LightCard(sun_azimuth_deg=180.0, sun_elevation_deg=60.0).light()
    assert light.sun_direction == pytest.approx((-0.5, 0.0, 0.75**0.5))
