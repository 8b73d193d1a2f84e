"""Scene builders, viewpoints, and the cache of built scenes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from rsbench.core.errors import RsbenchError
from rsbench.dataset.manifest import scene_hash
from rsbench.scenes import load
from rsbench.scenes.load import (
    LightCard,
    _check_meshes,
    built_key,
    cached_meshes,
    keep,
    load_scene,
    read_scene_card,
)
from rsbench.scenes.model import Light, Material, Scene, SceneMesh, Viewpoint

MODULE = """
from dataclasses import dataclass

import numpy as np

from rsbench.scenes.model import Material, SceneBuilder, SceneMesh


@dataclass(frozen=True, kw_only=True)
class Heap(SceneBuilder):
    stones: int = 2

    def build(self, seed, folder):
        rng = np.random.default_rng(seed)
        corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        for number in range(self.stones):
            yield SceneMesh(
                name=f"stone {number}",
                vertices=corners + rng.uniform(0, 5, 3),
                faces=np.array([[0, 1, 2]], dtype=np.int32),
                material=Material(name=folder.name),
            )
"""
CARD = """
name = "heap"
builder = "{builder}"
seed = 4
[parameters]
stones = 3
[viewpoints.default]
eye = [0.0, -10.0, 1.6]
target = [0.0, 0.0, 1.6]
"""


def write(folder: Path, module: str, name: str, builder: str) -> Path:
    (folder / f"{name}.py").write_text(module, "utf-8")
    card = folder / "heap.toml"
    card.write_text(CARD.format(builder=builder), "utf-8")
    return card


def test_a_file_and_a_card_beside_it_make_a_scene(tmp_path: Path) -> None:
    card = write(tmp_path, MODULE, "heap_of_stones", "heap_of_stones:Heap")
    scene = load_scene(card)
    assert [mesh.name for mesh in scene.meshes] == ["stone 0", "stone 1", "stone 2"]
    assert scene.meshes[0].material.name == tmp_path.name
    offset = np.random.default_rng(4).uniform(0, 5, 3)
    np.testing.assert_array_equal(scene.meshes[0].vertices[0], offset)


@pytest.mark.parametrize(
    ("name", "old", "new", "part"),
    [
        ("heap_a", "SceneBuilder)", "object)", "is not a scene builder"),
        ("heap_b", "rng = np", "rng = nn", "failed: NameError"),
        ("heap_c", "stones: int", "rocks: int", "parameters: unknown key 'stones'"),
        ("heap_d", "yield SceneMesh(", "yield dict(", "item 0 is a dict, not a SceneMesh"),
        ("heap_e", "range(self.stones)", "range(0)", "made no meshes"),
        ("heap_f", "[[0, 1, 2]]", "[[0, 1, 3]]", "mesh 'stone 0' has faces that name vertices beyond its 3"),
    ],
)
def test_what_a_builder_does_wrong_is_one_line(tmp_path: Path, name: str, old: str, new: str, part: str) -> None:
    assert old in MODULE
    card = write(tmp_path, MODULE.replace(old, new), name, f"{name}:Heap")
    with refused(part, str(card)):
        load_scene(card)


GREY = np.zeros((2, 2), dtype=np.uint8)
MESH = SceneMesh(
    name="sound",
    vertices=np.eye(3),
    faces=np.array([[0, 1, 2]], dtype=np.int32),
    material=Material(name="m", texture=GREY[..., None].repeat(3, axis=2)),
    uv=np.zeros((3, 2)),
    normals=np.eye(3),
)


@pytest.mark.parametrize(
    ("spoil", "part"),
    [
        (lambda mesh: replace(mesh, vertices=np.eye(4)), "vertices of shape (4, 4)"),
        (lambda mesh: replace(mesh, vertices=np.eye(3, dtype=np.int64)), "real numbers"),
        (lambda mesh: replace(mesh, vertices=np.full((3, 3), np.nan)), "vertices that are not finite"),
        (lambda mesh: replace(mesh, uv=np.zeros((2, 2))), "uv of shape (2, 2): must be (3, 2)"),
        (lambda mesh: replace(mesh, uv=None), "a texture but no uv"),
        (lambda mesh: replace(mesh, uv=np.full((3, 2), np.inf)), "uv that are not finite"),
        (lambda mesh: replace(mesh, normals=np.zeros((3, 2))), "normals of shape"),
        (lambda mesh: replace(mesh, faces=np.zeros((0, 3), dtype=np.int32)), "faces of shape (0, 3)"),
        (lambda mesh: replace(mesh, faces=np.eye(3)), "whole numbers"),
        (lambda mesh: replace(mesh, faces=np.array([[0, 1, -1]])), "beyond its 3"),
        (lambda mesh: replace(mesh, material=Material(name="m", texture=GREY)), "texture of shape (2, 2)"),
        (lambda mesh: replace(mesh, name="sound"), "has the name of another"),
    ],
)
def test_an_unsound_mesh_is_refused(spoil: Callable[[SceneMesh], SceneMesh], part: str) -> None:
    _check_meshes((MESH, replace(MESH, name="other")), "here")
    with refused(part):
        _check_meshes((MESH, spoil(replace(MESH, name="spoilt"))), "here")


KEY = "0123"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rsbench" / "scenes"


def _meshes() -> tuple[SceneMesh, ...]:
    """Two that share a material, and one without uv, normals and texture."""
    rng = np.random.default_rng(0)
    painted = Material(name="painted", texture=rng.integers(0, 255, (4, 6, 3), dtype=np.uint8))
    faces = np.array([[0, 1, 2], [2, 1, 3]], dtype=np.int32)
    found = list[SceneMesh]()
    for name in ("wall_0", "wall_1"):
        vertices, uv, normals = rng.normal(size=(4, 3)), rng.random((4, 2)), rng.normal(size=(4, 3))
        found.append(
            SceneMesh(name=name, vertices=vertices, faces=faces, material=painted, uv=uv, normals=normals)
        )
    plain = Material(name="m", colour=(0.1, 1.0, 0.3))
    return (*found, SceneMesh(name="plain", vertices=np.eye(3), faces=faces[:1], material=plain))


def test_what_is_kept_is_the_same_to_the_last_bit(cache: Path) -> None:
    meshes = _meshes()
    assert cached_meshes(KEY) is None
    keep(KEY, meshes)
    found = cached_meshes(KEY)
    assert found is not None
    assert [mesh.name for mesh in found] == [mesh.name for mesh in meshes]
    assert found[0].material is found[1].material is not found[2].material
    assert found[2].material == meshes[2].material
    assert found[2].uv is None and found[2].normals is None
    for mesh, expected in zip(found, meshes, strict=True):
        for name in ("vertices", "faces", "uv", "normals"):
            ours, theirs = getattr(mesh, name), getattr(expected, name)
            if theirs is not None:
                assert ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes()
    assert found[0].material.texture is not None and meshes[0].material.texture is not None
    assert found[0].material.texture.tobytes() == meshes[0].material.texture.tobytes()


def test_a_damaged_file_is_nothing(cache: Path) -> None:
    keep(KEY, _meshes())
    path = cache / f"{KEY}.npz"
    whole = path.read_bytes()
    for at in range(0, len(whole), 97):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        found = cached_meshes(KEY)
        # A bit of the archive's own fields that nobody reads, such as a date, may go unseen; no array may.
        if found is not None:
            for mesh, expected in zip(found, _meshes(), strict=True):
                assert mesh.vertices.tobytes() == expected.vertices.tobytes()
                assert mesh.faces.tobytes() == expected.faces.tobytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert cached_meshes(KEY) is None


def test_only_the_latest_stay_and_what_was_abandoned_goes(cache: Path) -> None:
    cache.mkdir(parents=True)
    (old := cache / "x.partial").touch()
    (young := cache / "y.partial").touch()
    os.utime(old, (0.0, time.time() - 2 * load._ABANDONED_S))
    for number in range(load._MOST + 2):
        keep(str(number), _meshes())
        os.utime(cache / f"{number}.npz", (number, number))
        if number > 0:
            assert cached_meshes("0") is not None  # its use makes it the latest
    assert len(list(cache.glob("*.npz"))) == load._MOST
    assert cached_meshes("0") is not None and cached_meshes("1") is None
    assert not old.exists() and young.exists()


def test_where_nothing_can_be_kept_scenes_are_built(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for place in (None, tmp_path / "file"):
        monkeypatch.setattr(load, "user_cache", lambda place=place: place)
        keep(KEY, _meshes())
        assert cached_meshes(KEY) is None


def test_a_scene_is_built_once(cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first = load_scene("corridor")
    monkeypatch.setattr("rsbench.scenes.corridor.CorridorBuilder.build", None)
    second = load_scene("corridor")
    assert scene_hash(first) == scene_hash(second)
    card, builder = read_scene_card(Path(load.__file__).parents[2] / "scenes" / "corridor.toml")
    assert built_key(builder, card.seed) != built_key(builder, card.seed + 1)


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
    mesh = replace(MESH, vertices=vertices, normals=normals)
    scene = Scene(name="s", meshes=(mesh,), light=Light(sun_direction=(0.6, 0.0, 0.8)))
    seen = scene.seen_from(Viewpoint(eye=(3, 3, 3), target=(0, 7, 1)))
    moved = seen.meshes[0]
    before, after = (each[:, None] - each for each in (vertices, moved.vertices))
    assert np.linalg.norm(after, axis=2) == pytest.approx(np.linalg.norm(before, axis=2))
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
