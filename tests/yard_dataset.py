"""The yard of test_channels.py: a small scene, the card of its dataset, and which planted faults share a copy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import trimesh
from channel_faults import FAULTS

from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.renderers.image import Sensor

SCENE = """
name = "{name}"
builder = "mesh"
{light}
[parameters]
file = "{name}.glb"
up_axis = "z"
[viewpoints.default]
eye = [0.0, -4.0, 1.2]
target = [0.2, 3.0, 0.9]
"""
Vector = tuple[float, float, float]
YARD: dict[str, tuple[Vector, Vector]] = {
    "part0": ((14.0, 12.0, 0.1), (0.0, 3.0, -0.05)),
    "part1": ((5.0, 0.3, 3.0), (2.0, 7.0, 1.5)),
    "part2": ((0.7, 0.7, 1.1), (-0.8, 0.5, 0.55)),
    "part3": ((1.2, 0.5, 0.8), (1.3, 2.0, 0.4)),
    "part4": ((0.15, 0.15, 2.6), (0.3, -0.8, 1.3)),
}
"""Edges and places of ground, a wall, two boxes and a post: every class of pixel occurs."""


def write_boxes(folder: Path, name: str, boxes: Mapping[str, tuple[Vector, Vector]], light: str = "") -> Path:
    """Write the scene card NAME.toml of boxes of these edges and places, a little askew, below an open sky."""
    parts = {}
    for part, (edges, place) in boxes.items():
        parts[part] = trimesh.creation.box(edges)
        parts[part].apply_transform(trimesh.transformations.rotation_matrix(0.3, (0, 0, 1)))
        parts[part].apply_translation(place)
    trimesh.Scene(parts).export(folder / f"{name}.glb")
    (folder / f"{name}.toml").write_text(SCENE.format(name=name, light=light))
    return folder / f"{name}.toml"


def write_yard(folder: Path) -> Path:
    return write_boxes(folder, "yard", YARD)


def boxes_card(scene: Path | str, **fields: object) -> DatasetCard:
    """A card of small pictures of a scene; ``fields`` are others than these."""
    motion = MotionCard(
        rotation_deg=4.0, rotation_axis=(0.5, 1.0, -0.6), translation=0.3, translation_axis=(-0.7, 0.3, -0.6)
    )
    kept = {
        "name": Path(scene).stem,
        "camera": CameraCard(width=64, height=48, focal=60.0),
        "baseline": 0.3,
        "readout_ratio": 0.9,
        "motion": motion,
        "renderer": "preview",
        "sequence": (SequenceCard(name=Path(scene).stem, scene=str(scene)),),
    }
    return DatasetCard(**(kept | fields))  # pyrefly: ignore[bad-argument-type]


def yard_card(folder: Path, **fields: object) -> DatasetCard:
    sensor = Sensor(exposure_s=0.004, full_well=6000, photon_noise=True, read_noise=2.5)
    return boxes_card(folder / "yard.toml", sensor=sensor, **fields)


ALONE = {
    *("instances of the other camera", "instances exchanged", "an instance that the table lacks"),
    *("timing of another readout", "timing of frames exchanged"),
    *(f"affine frames {what}" for what in ("transposed", "stretched", "on another plane")),
}
"""Faults of files that other checks read: where those are wrong too, these are not looked for."""


def rounds() -> list[list[str]]:
    """Faults of different files lie in one dataset: checking it takes longer than planting them.

    Those that rays alone find have one of their own.
    """
    found: list[dict[str, str]] = []
    for name, (_, words) in FAULTS.items():
        alone = "new computation" in words or name in ALONE
        fits = [each for each in found if words[0] not in each and "" not in each]
        if alone or not fits:
            found.append({})
            fits = found[-1:]
        fits[0][words[0]] = name
        if alone:
            fits[0][""] = name
    return [list(dict.fromkeys(each.values())) for each in found]
