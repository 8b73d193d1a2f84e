"""The yard of test_channels.py: a small scene, the card of its dataset, and which planted faults share a copy."""

from __future__ import annotations

from pathlib import Path

import trimesh
from channel_faults import FAULTS

from rsbench.dataset.card import CameraCard, DatasetCard, MotionCard, SequenceCard
from rsbench.renderers.image import Sensor

SCENE = """
name = "yard"
builder = "mesh"
[parameters]
file = "yard.glb"
up_axis = "z"
[viewpoints.default]
eye = [0.0, -4.0, 1.2]
target = [0.2, 3.0, 0.9]
"""


def write_yard(folder: Path) -> Path:
    """Ground, a wall, a post and two boxes below an open sky: every class of pixel occurs."""
    parts = []
    for size, place in (
        ((14.0, 12.0, 0.1), (0.0, 3.0, -0.05)),
        ((5.0, 0.3, 3.0), (2.0, 7.0, 1.5)),
        ((0.7, 0.7, 1.1), (-0.8, 0.5, 0.55)),
        ((1.2, 0.5, 0.8), (1.3, 2.0, 0.4)),
        ((0.15, 0.15, 2.6), (0.3, -0.8, 1.3)),
    ):
        box = trimesh.creation.box(size)
        box.apply_transform(trimesh.transformations.rotation_matrix(0.3, (0, 0, 1)))
        box.apply_translation(place)
        parts.append(box)
    trimesh.Scene({f"part{number}": part for number, part in enumerate(parts)}).export(folder / "yard.glb")
    (folder / "yard.toml").write_text(SCENE)
    return folder / "yard.toml"


def yard_card(folder: Path, **fields: object) -> DatasetCard:
    return DatasetCard(
        name="yard",
        camera=CameraCard(width=64, height=48, focal=60.0),
        baseline=0.3,
        readout_ratio=0.9,
        motion=MotionCard(
            rotation_deg=4.0,
            rotation_axis=(0.5, 1.0, -0.6),
            translation=0.3,
            translation_axis=(-0.7, 0.3, -0.6),
        ),
        renderer="preview",
        sensor=Sensor(exposure_s=0.004, full_well=6000, photon_noise=True, read_noise=2.5),
        sequence=(SequenceCard(name="yard", scene=str(folder / "yard.toml")),),
        **fields,  # pyrefly: ignore[bad-argument-type]
    )


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
