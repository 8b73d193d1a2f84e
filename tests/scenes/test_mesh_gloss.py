"""What becomes of the roughness and metal of a glTF file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from mesh_scenes import load, textured_quad
from PIL import Image
from trimesh.visual.material import PBRMaterial

from rsbench.core.errors import RsbenchError
from rsbench.scenes.scene_cache import _packed, _unpacked

SHINY = 'file = "m.glb"\ngloss = "file"'


def roughness(folder: Path, parameters: str, **material: Any) -> float | None:
    made = PBRMaterial(name="m", baseColorFactor=[200, 100, 50, 255], **material)
    textured_quad(made).export(folder / "m.glb")
    (mesh,) = load(folder, parameters).meshes
    return mesh.material.roughness


@pytest.mark.parametrize(("stated", "taken"), [(0.2, 0.2), (0.0, 0.05), (0.5, 0.5), (0.7, None), (None, None)])
def test_a_coat_is_as_rough_as_the_file_says(tmp_path: Path, stated: float | None, taken: float | None) -> None:
    """A mirror is the smoothest coat; what is rougher than a half, or says nothing, which is 1, is diffuse."""
    found = roughness(tmp_path, SHINY, metallicFactor=0.0, roughnessFactor=stated)
    assert found == (None if taken is None else pytest.approx(taken))


def test_all_is_diffuse_unless_the_card_asks(tmp_path: Path) -> None:
    assert roughness(tmp_path, 'file = "m.glb"', metallicFactor=0.0, roughnessFactor=0.2) is None


def test_metal_and_maps_are_refused(tmp_path: Path) -> None:
    for metal in (1.0, None):
        with pytest.raises(RsbenchError, match=r"part .* is metal \(metallicFactor = 1\).*leave gloss out"):
            roughness(tmp_path, SHINY, metallicFactor=metal, roughnessFactor=0.2)
    image = Image.new("RGB", (2, 2), (0, 90, 0))
    with pytest.raises(RsbenchError, match=r"part .* has a map of roughness.*leave gloss out"):
        roughness(tmp_path, SHINY, metallicFactor=0.0, metallicRoughnessTexture=image)


def test_the_cache_keeps_roughness(tmp_path: Path) -> None:
    made = PBRMaterial(name="m", metallicFactor=0.0, roughnessFactor=0.2)
    textured_quad(made).export(tmp_path / "m.glb")
    meshes = load(tmp_path, SHINY).meshes
    (again,) = _unpacked(_packed(meshes))
    assert again.material == meshes[0].material
