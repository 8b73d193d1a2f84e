"""Scene cards: a builder, its parameters, the light and the viewpoints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rsbench.components.cards import card_path, parse_card, read_toml
from rsbench.components.imports import blaming
from rsbench.components.plugins import Kind, NoOptions, load_class, make_component
from rsbench.core.errors import RsbenchError
from rsbench.scenes.environment import lit_by, read_environment
from rsbench.scenes.model import Light, Scene, SceneBuilder, SceneMesh, Viewpoint
from rsbench.scenes.scene_cache import built_key, cached_meshes, keep

_FARTHEST = 1e9
Rgb: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class LightCard:
    """``Light`` with the sun given as people give it."""

    sun_azimuth_deg: float = 220.0
    """Direction of the sun in the scene frame, degrees anticlockwise from +x."""
    sun_elevation_deg: float = 45.0
    """Height of the sun above the horizon, degrees: above 0, at most 90."""
    sun_irradiance: Rgb = (2.6, 2.4, 2.1)
    """Linear RGB light of the sun on a surface that faces it."""
    sky_zenith: Rgb = (0.25, 0.45, 0.85)
    """Linear RGB radiance of the sky overhead."""
    sky_horizon: Rgb = (0.75, 0.85, 0.95)
    """Linear RGB radiance of the sky at the horizon."""
    environment: str = ""
    """Lat-long .hdr or .exr file, relative to the card, that replaces sun and sky; these then say only how bright
    it is."""
    environment_turn_deg: float = 0.0
    """Turn of the environment map, degrees anticlockwise from above; at 0 the middle of the map looks along +y."""

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
    """What a scene card holds."""

    name: str
    """Name of the scene, which is that of the card's file."""
    builder: str
    """Name of a scene builder, or ``package.module:Class``; the module may lie beside the card."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the builder: the fields of its class."""
    viewpoints: dict[str, Viewpoint]
    """Places to look from, by name; ``default`` is required."""
    description: str = ""
    """One line for ``rsbench list scenes``."""
    seed: int = 0
    """Seed of everything that the builder draws at random."""
    light: LightCard = field(default_factory=LightCard)
    """Sun, sky or environment map."""

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


BUILDERS: Kind[SceneBuilder, NoOptions] = Kind(
    singular="scene builder",
    group="rsbench.scenes",
    base=SceneBuilder,
    options=NoOptions,
    built_in={
        "castle": "rsbench.scenes.castle:CastleBuilder",
        "corridor": "rsbench.scenes.corridor:CorridorBuilder",
        "forest": "rsbench.scenes.forest:ForestBuilder",
        "mesh": "rsbench.scenes.mesh:MeshBuilder",
        "old-town": "rsbench.scenes.old_town:OldTownBuilder",
        "poles": "rsbench.scenes.poles:PolesBuilder",
        "room": "rsbench.scenes.room:RoomBuilder",
        "shelves": "rsbench.scenes.shelves:ShelvesBuilder",
        "street": "rsbench.scenes.street:StreetBuilder",
        "terrain": "rsbench.scenes.terrain:TerrainBuilder",
    },
)
"""What ``builder`` in a scene card may name; others' are of the entry points ``rsbench.scenes``."""


def load_scene(name_or_path: str | Path) -> Scene:
    """Build the scene of a card, in the scene frame. The same card gives the same arrays.

    Args:
        name_or_path: a card that comes with rsbench, or a path that ends in ``.toml``.

    Raises:
        RsbenchError: the card, its builder or a file that it names is missing or wrong, in one line.
    """
    path = card_path("scenes", name_or_path)
    card, builder = read_scene_card(path)
    if type(builder).__module__.partition(".")[0] == "rsbench":
        meshes = _built(builder, card.seed, path.parent)
    else:
        with blaming(f"{path}: builder = {card.builder!r}", "failed"):
            meshes = tuple(builder.build(card.seed, path.parent))
    _check_meshes(meshes, f"{path}: builder = {card.builder!r}")
    light = card.light.light()
    if card.light.environment:
        found = read_environment(path.parent / card.light.environment)
        light = lit_by(light, found, card.light.environment_turn_deg)
    return Scene(name=card.name, meshes=meshes, light=light, viewpoints=card.viewpoints)


def _built(builder: SceneBuilder, seed: int, folder: Path) -> tuple[SceneMesh, ...]:
    """Meshes of a builder of ours, from the cache where they can be kept."""
    key = built_key(builder, seed)
    meshes = None if key is None else cached_meshes(key)
    if meshes is None:
        meshes = tuple(builder.build(seed, folder))
        if key is not None:
            keep(key, meshes)
    return meshes


def read_scene_card(path: Path) -> tuple[SceneCard, SceneBuilder]:
    """Parse a scene card without building the scene: the card, and its builder with the card's parameters.

    Raises:
        RsbenchError: the card is wrong, in one line.
    """
    card = parse_card(SceneCard, read_toml(path), str(path))
    cls = load_class(BUILDERS, card.builder, path)
    return card, make_component(BUILDERS, cls, card.parameters, str(path))


def _check_meshes(meshes: tuple[SceneMesh, ...], where: str) -> None:
    """Refuse what a renderer would stumble over, or read beyond its end."""
    if not meshes:
        raise RsbenchError(f"{where}: made no meshes")
    names: set[str] = set()
    for number, mesh in enumerate(meshes):
        if not isinstance(mesh, SceneMesh):
            raise RsbenchError(f"{where}: item {number} is a {type(mesh).__name__}, not a SceneMesh")
        problem = _problem_of(mesh) or ("has the name of another" if mesh.name in names else None)
        if problem is not None:
            raise RsbenchError(f"{where}: mesh {mesh.name!r} {problem}")
        names.add(mesh.name)


def _problem_of(mesh: SceneMesh) -> str | None:
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    count = len(vertices) if vertices.ndim else 0
    for name, columns in (("vertices", 3), ("uv", 2), ("normals", 3)):
        values = getattr(mesh, name)
        if values is None:
            continue
        if np.shape(values) != (count, columns) or np.asarray(values).dtype.kind != "f":
            return f"has {name} of shape {np.shape(values)}: must be ({count}, {columns}) real numbers"
        used = name != "uv" or mesh.material.texture is not None
        if used and not np.all(np.isfinite(values)):
            return f"has {name} that are not finite"
        if used and np.max(np.abs(values), initial=0.0) > _FARTHEST:
            return f"has {name} beyond {_FARTHEST:g}, which single precision cannot place"
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        return f"has faces of shape {faces.shape}: must be (m, 3) whole numbers, m > 0"
    if faces.min() < 0 or faces.max() >= count:
        return f"has faces that name vertices beyond its {count}"
    texture = mesh.material.texture
    if texture is not None and (texture.ndim != 3 or texture.shape[2] != 3 or texture.dtype != np.uint8):
        return f"has a texture of shape {texture.shape}, {texture.dtype}: must be (h, w, 3) of uint8"
    return "has a texture but no uv" if texture is not None and mesh.uv is None else None
