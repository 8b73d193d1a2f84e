"""The castle after rain: the scene of most planted faults, with a fifth of what is seen glossy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rsbench.scenes.castle import CastleBuilder
from rsbench.scenes.model import SceneMesh

_WET = {"glass": 0.1, "cobbles": 0.3, "tiles_0": 0.2, "tiles_1": 0.2, "tiles_2": 0.2, "planks": 0.4}
"""Roughness by the names of materials."""
WET_CASTLE = Path(__file__).with_name("wet-castle.toml")


@dataclass(frozen=True, kw_only=True)
class WetCastleBuilder(CastleBuilder):
    """The same meshes of other materials."""

    def build(self, seed: int, folder: Path) -> tuple[SceneMesh, ...]:
        """Meshes in the scene frame."""
        dry = super().build(seed, folder)
        wet = {id(mesh.material): replace(mesh.material, roughness=_WET.get(mesh.material.name)) for mesh in dry}
        return tuple(replace(mesh, material=wet[id(mesh.material)]) for mesh in dry)
