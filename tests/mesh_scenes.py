"""Small meshes that tests write to files, and the scenes that cards make of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from rsbench.scenes.load import load_scene
from rsbench.scenes.model import Scene, SceneMesh

RED, GREEN, BLUE, WHITE = (200, 20, 20), (20, 180, 30), (20, 40, 190), (240, 240, 240)

CARD = """
name = "mine"
builder = "mesh"
[parameters]
{parameters}
[viewpoints.default]
eye = [0.0, -5.0, 1.0]
target = [0.0, 0.0, 1.0]
"""


def load(folder: Path, parameters: str) -> Scene:
    card = folder / "mine.toml"
    card.write_text(CARD.format(parameters=parameters))
    return load_scene(card)


def textured_quad(material: trimesh.visual.material.Material | None = None) -> trimesh.Trimesh:
    """A 2 x 1 rectangle in the file's x, y; the image has red at its top left, blue at its bottom right."""
    image = Image.fromarray(np.array([[RED, GREEN], [WHITE, BLUE]], dtype=np.uint8))
    if material is None:
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, name="four")
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], dtype=float)
    faces = [[0, 1, 2], [0, 2, 3]]
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices=vertices, faces=faces, visual=visual, process=False)


def colour_at(mesh: SceneMesh, uv: NDArray[np.float64]) -> tuple[int, ...]:
    """Nearest texel by the rule of the contract: v up, row 0 at the top."""
    texture = mesh.material.texture
    assert texture is not None
    height, width = texture.shape[:2]
    column, row = int(uv[0] % 1 * width), int((1 - uv[1] % 1) * height)
    return tuple(int(value) for value in texture[row, column])


def uv_of(mesh: SceneMesh, point: tuple[float, float, float]) -> NDArray[np.float64]:
    assert mesh.uv is not None
    distance = np.linalg.norm(mesh.vertices - point, axis=1)
    assert distance.min() < 1e-6
    uv: NDArray[np.float64] = mesh.uv[int(np.argmin(distance))]
    return uv
