"""Scene builders of others: one file and one card."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rsbench.core.errors import RsbenchError
from rsbench.scenes.load import _check_meshes, load_scene
from rsbench.scenes.model import Material, SceneMesh

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
    with pytest.raises(RsbenchError) as caught:
        load_scene(card)
    assert part in str(caught.value) and str(card) in str(caught.value) and "\n" not in str(caught.value)


MESH = SceneMesh(
    name="sound",
    vertices=np.eye(3),
    faces=np.array([[0, 1, 2]], dtype=np.int32),
    material=Material(name="m", texture=np.zeros((2, 2, 3), dtype=np.uint8)),
    uv=np.zeros((3, 2)),
    normals=np.eye(3),
)


def test_a_sound_mesh_is_let_through() -> None:
    _check_meshes((MESH, replace(MESH, name="other")), "here")


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
        (
            lambda mesh: replace(mesh, material=Material(name="m", texture=np.zeros((2, 2), dtype=np.uint8))),
            "texture of shape (2, 2)",
        ),
        (lambda mesh: replace(mesh, name="sound"), "has the name of another"),
    ],
)
def test_an_unsound_mesh_is_refused(spoil: Callable[[SceneMesh], SceneMesh], part: str) -> None:
    with pytest.raises(RsbenchError) as caught:
        _check_meshes((MESH, spoil(replace(MESH, name="spoilt"))), "here")
    assert part in str(caught.value)
