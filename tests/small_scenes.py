"""Dataset cards of scenes that load and render in a moment: a textured box around the rig, from a mesh file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

if TYPE_CHECKING:  # attacks choose which rsbench is imported after this module
    from rsbench.core.rig import StereoRig

Vector = tuple[float, float, float]
SCENE = """
name = "{name}"
builder = "mesh"
[parameters]
file = "{name}.glb"
up_axis = "z"
[viewpoints.default]
eye = [0.0, -3.0, 0.2]
target = [0.3, 3.0, 0.0]
"""
DATASET = """
name = "small"
baseline = 0.3
readout_ratio = 0.8
renderer = "preview"
seed = 1
[camera]
width = 96
height = 64
focal = 80
"""
MOTION = """
[motion]
rotation_deg = 1.5
rotation_axis = [0.4, 1.0, -0.6]
translation = 0.2
translation_axis = [-0.7, 0.3, -0.6]
"""


def painted(texture: tuple[int, int] = (64, 64), **material: object) -> PBRMaterial:
    """A material with an image of (rows, columns)."""
    y, x = np.mgrid[: texture[0], : texture[1]]
    image = Image.fromarray(np.stack([x * 5 % 256, y * 3 % 256, (x + 2 * y) % 256], axis=-1).astype(np.uint8))
    return PBRMaterial(baseColorTexture=image, **material)


def box_of(edges: Vector, material: PBRMaterial, at: Vector = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """A box of these edges, metres, about a place."""
    corners = np.asarray(trimesh.creation.box(edges).triangles).reshape(-1, 3) + at
    uv = np.tile([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], (12, 1))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices=corners, faces=np.arange(36).reshape(12, 3), visual=visual, process=False)


def write_box_scene(folder: Path, name: str, texture: tuple[int, int] = (64, 64)) -> Path:
    """Write name.toml and name.glb: a box of 6 x 10 x 4 m from inside, its image of (rows, columns)."""
    box = box_of((6.0, 10.0, 4.0), painted(texture, name="paper"))
    box.faces = box.faces[:, ::-1]
    box.export(folder / f"{name}.glb")
    card = folder / f"{name}.toml"
    card.write_text(SCENE.format(name=name))
    return card


def write_small_card(folder: Path, scenes: Sequence[Path]) -> Path:
    """Write small.toml: a dataset of one sequence for each of these scene cards, named as they are."""
    sequences = [f'[[sequence]]\nname = "{scene.stem}"\nscene = "{scene}"\n' for scene in scenes]
    card = folder / "small.toml"
    card.write_text("\n".join([DATASET + MOTION, *sequences]))
    return card


def write_box_card(folder: Path, head: str, more: str = "") -> Path:
    """Write box-card.toml: this head, the motion of small.toml, a sequence in a box, and ``more``."""
    scene, card = write_box_scene(folder, "box"), folder / "box-card.toml"
    card.write_text(f'{head}{MOTION}[[sequence]]\nname = "box"\nscene = "{scene}"\n{more}')
    return card


def write_rig(path: Path, rig: StereoRig, readout_ratio: float | None = None, more: str = "") -> Path:
    """Write a rig of two equal aligned cameras as rig.toml; ``more`` is appended to the table of its camera."""
    ratio = "" if readout_ratio is None else f"readout_ratio = {readout_ratio}\n"
    camera = "".join(f"{name} = {getattr(rig.camera, name)}\n" for name in ("fx", "fy", "cx", "cy"))
    path.write_text(f"baseline = {rig.baseline}\n{ratio}[camera]\n{camera}{more}", "utf-8")
    return path
