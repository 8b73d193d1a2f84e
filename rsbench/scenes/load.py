"""Scene cards: a builder, its parameters, the light and the viewpoints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from rsbench.cards import card_path, choices, parse_card, read_toml
from rsbench.errors import RsbenchError
from rsbench.scenes.castle import CastleParameters, build_castle
from rsbench.scenes.mesh import MeshParameters, build_from_file
from rsbench.scenes.model import Light, Scene, SceneMesh, Viewpoint
from rsbench.scenes.old_town import OldTownParameters, build_old_town
from rsbench.scenes.room import RoomParameters, build_room

Rgb: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class LightCard:
    """``Light`` with the sun given as people give it."""

    sun_azimuth_deg: float = 220.0
    """Anticlockwise from +x, in the scene frame."""
    sun_elevation_deg: float = 45.0
    sun_irradiance: Rgb = (2.6, 2.4, 2.1)
    sky_zenith: Rgb = (0.25, 0.45, 0.85)
    sky_horizon: Rgb = (0.75, 0.85, 0.95)

    def __post_init__(self) -> None:
        if not 0 < self.sun_elevation_deg <= 90:
            raise ValueError(f"sun_elevation_deg = {self.sun_elevation_deg}: allowed are 0 to 90, without 0")
        for name in ("sun_irradiance", "sky_zenith", "sky_horizon"):
            if min(getattr(self, name)) < 0:
                raise ValueError(f"{name} = {getattr(self, name)}: no negative light")

    def light(self) -> Light:
        azimuth, elevation = np.deg2rad(self.sun_azimuth_deg), np.deg2rad(self.sun_elevation_deg)
        level = np.cos(elevation)
        direction = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation))
        return Light(
            sun_direction=(float(direction[0]), float(direction[1]), float(direction[2])),
            sun_irradiance=self.sun_irradiance,
            sky_zenith=self.sky_zenith,
            sky_horizon=self.sky_horizon,
        )


@dataclass(frozen=True, kw_only=True)
class SceneCard:
    """What every scene card holds; builders add their ``parameters``."""

    name: str
    builder: str
    viewpoints: dict[str, Viewpoint]
    description: str = ""
    seed: int = 0
    light: LightCard = field(default_factory=LightCard)

    def __post_init__(self) -> None:
        if "default" not in self.viewpoints:
            raise ValueError(
                f"[viewpoints.default] is required; there are: {', '.join(self.viewpoints) or 'none'}"
            )
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: allowed are 0 and above")
        for name, viewpoint in self.viewpoints.items():
            try:
                viewpoint.world_from_scene()
            except RsbenchError as error:
                raise ValueError(f"viewpoints.{name}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class CastleCard(SceneCard):
    builder: Literal["castle"]
    parameters: CastleParameters = field(default_factory=CastleParameters)


@dataclass(frozen=True, kw_only=True)
class OldTownCard(SceneCard):
    builder: Literal["old-town"]
    parameters: OldTownParameters = field(default_factory=OldTownParameters)


@dataclass(frozen=True, kw_only=True)
class RoomCard(SceneCard):
    builder: Literal["room"]
    parameters: RoomParameters = field(default_factory=RoomParameters)


@dataclass(frozen=True, kw_only=True)
class MeshCard(SceneCard):
    builder: Literal["mesh"]
    parameters: MeshParameters


CARDS: dict[str, type[SceneCard]] = {
    "castle": CastleCard,
    "old-town": OldTownCard,
    "room": RoomCard,
    "mesh": MeshCard,
}
"""Builder name to the dataclass of its cards."""


def load_scene(name_or_path: str | Path) -> Scene:
    """Build the scene of a card, in the scene frame. The same card gives the same arrays.

    Args:
        name_or_path: a card that comes with rsbench, or a path that ends in ``.toml``.

    Raises:
        RsbenchError: the card or a file that it names is missing or wrong, in one line.
    """
    path = card_path("scenes", name_or_path)
    card = read_scene_card(path)
    meshes = _build(card, path.parent)
    return Scene(name=card.name, meshes=meshes, light=card.light.light(), viewpoints=card.viewpoints)


def read_scene_card(path: Path) -> SceneCard:
    """Parse a scene card without building the scene.

    Raises:
        RsbenchError: the card is wrong, in one line.
    """
    data = read_toml(path)
    builder = data.get("builder")
    if not isinstance(builder, str) or builder not in CARDS:
        problem = "'builder' is required" if builder is None else f"builder = {builder!r} does not exist"
        raise RsbenchError(f"{path}: {problem}{choices(str(builder), CARDS)}")
    return parse_card(CARDS[builder], data, str(path))


def _build(card: SceneCard, folder: Path) -> tuple[SceneMesh, ...]:
    match card:
        case CastleCard():
            return build_castle(card.parameters, card.seed)
        case OldTownCard():
            return build_old_town(card.parameters, card.seed)
        case RoomCard():
            return build_room(card.parameters, card.seed)
        case MeshCard():
            return build_from_file(card.parameters, folder)
    raise TypeError(f"no builder for {type(card).__name__}")
