"""Scene cards: parsing, building with a cache of built scenes, and lighting, also by environment maps.

Our builders take seconds, and every process needs the same arrays. The cache has one file per scene, named by a
hash of everything that affects its arrays. A file is renamed when complete, so that several processes can fill the
cache at the same time; zip's checksums detect a damaged file, which is then built again.

An environment map, a lat-long HDR or EXR file, replaces the two-colour sky by light from all directions. The
centre of the map is in direction +y of the scene, its right side in direction +x; its upper border is the zenith.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import card_path, parse_card, read_toml
from rsbench.components.imports import blaming, component_key, hash_of_files
from rsbench.components.plugins import Kind, NoOptions, load_class, make_component
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import (
    Environment,
    FloatArray,
    Light,
    Material,
    Scene,
    SceneBuilder,
    SceneMesh,
    Viewpoint,
)
from rsbench.storage.untrusted_files import check_amount, read_bytes
from rsbench.storage.work_folder import cpu_key, user_cache

_PACKAGES = ("numpy", "trimesh", "shapely", "mapbox-earcut")
"""Packages that affect the meshes of our builders, besides the sources of ``rsbench.scenes``."""
_MOST = 12
"""Largest number of scenes in the cache: 0.2 GB each."""
_ABANDONED_S = 3600.0
_ARRAYS = ("vertices", "faces", "uv", "normals")


def built_key(builder: SceneBuilder, seed: int) -> str | None:
    """Return a key that identifies meshes on one machine; None if they depend on files or other packages' code."""
    if not builder.closed or type(builder).__module__.partition(".")[0] != "rsbench":
        return None
    package = Path(str(resources.files("rsbench")))
    content = {
        "builder": component_key(builder, {}),
        "seed": seed,
        "source": hash_of_files(package, sorted((package / "scenes").glob("*.py"))),
        "packages": {each: version(each) for each in _PACKAGES},
        "processor": cpu_key(),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def cached_meshes(key: str) -> tuple[SceneMesh, ...] | None:
    """Return the meshes that ``keep`` stored under a key, or None if they cannot be read."""
    folder = _folder()
    if folder is None:
        return None
    path = folder / f"{key}.npz"
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            meshes = tuple(_unpacked(arrays))
        os.utime(path)  # ``_trim`` removes the least recently used
    except Exception:  # a damaged file may cause any exception in NumPy or in our code
        return None
    return meshes


def keep(key: str, meshes: tuple[SceneMesh, ...]) -> None:
    """Store meshes in the cache; do nothing if it cannot be written."""
    folder = _folder()
    if folder is None:
        return
    partial = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _trim(folder)
        handle, partial = tempfile.mkstemp(dir=folder, suffix=".partial")
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, allow_pickle=False, **_packed(meshes))
        os.replace(partial, folder / f"{key}.npz")
    except OSError:
        pass
    finally:
        if partial is not None:
            with contextlib.suppress(OSError):
                os.unlink(partial)


def _folder() -> Path | None:
    base = user_cache()
    return None if base is None else base / "scenes"


def _trim(folder: Path) -> None:
    """Make room for one more scene, and remove partial files of killed processes."""
    kept = sorted(folder.glob("*.npz"), key=lambda path: path.stat().st_mtime)
    for path in kept[: max(len(kept) - _MOST + 1, 0)]:
        path.unlink(missing_ok=True)
    for path in folder.glob("*.partial"):
        if time.time() - path.stat().st_mtime > _ABANDONED_S:
            path.unlink(missing_ok=True)


def _packed(meshes: tuple[SceneMesh, ...]) -> dict[str, NDArray[Any]]:
    """Return arrays by name, and everything else as JSON; shared materials are stored once."""
    materials = list({id(mesh.material): mesh.material for mesh in meshes}.values())
    numbers = {id(material): number for number, material in enumerate(materials)}
    arrays: dict[str, NDArray[Any]] = {}
    for number, material in enumerate(materials):
        if material.texture is not None:
            arrays[f"texture-{number}"] = material.texture
    for number, mesh in enumerate(meshes):
        found = {name: getattr(mesh, name) for name in _ARRAYS}
        arrays |= {f"{name}-{number}": array for name, array in found.items() if array is not None}
    content = {
        "materials": [{**asdict(one), "texture": one.texture is not None} for one in materials],
        "meshes": [{"name": mesh.name, "material": numbers[id(mesh.material)]} for mesh in meshes],
    }
    return arrays | {"content": np.frombuffer(json.dumps(content).encode(), dtype=np.uint8)}


def _unpacked(arrays: Any) -> Iterator[SceneMesh]:
    content = json.loads(arrays["content"].tobytes())
    materials = []
    for number, found in enumerate(content["materials"]):
        texture = arrays[f"texture-{number}"] if found["texture"] else None
        parts: dict[str, Any] = {**found, "colour": tuple(found["colour"]), "texture": texture}
        materials.append(Material(**parts))
    for number, found in enumerate(content["meshes"]):
        own = {name: arrays[f"{name}-{number}"] for name in _ARRAYS if f"{name}-{number}" in arrays}
        yield SceneMesh(name=found["name"], material=materials[found["material"]], **own)


PIXELS = 1 << 23
"""Largest number of pixels of a map: 4096 x 2048."""
_CHANNELS = 16
_REC_709 = np.array([0.2126, 0.7152, 0.0722])
_SUN_DEG, _RING_DEG, _SUNNY = 5.0, 8.0, 50.0
"""Radius of the sun's disc around the brightest pixel, outer radius of the ring that estimates its background, and
least ratio of that pixel's brightness to the median of the upper half."""


def read_environment(path: Path) -> NDArray[np.float32]:
    """Read linear radiance (H, 2 H, 3) from a Radiance HDR or EXR file, after checking its size.

    Raises:
        RsbenchError: the file cannot be read, is too large, not twice as wide as high, or has invalid radiance.
    """
    data, kind = read_bytes(path), path.suffix.lower()
    if kind not in (".hdr", ".exr"):
        raise RsbenchError(f"environment map {path}: must end in .hdr or .exr")
    try:
        radiance = _read_exr(data, path) if kind == ".exr" else _read_hdr(data, path)
    except RsbenchError:
        raise
    except Exception as error:  # decoders raise various exceptions for damaged files
        raise RsbenchError(f"environment map {path}: damaged, or no {kind[1:].upper()} file") from error
    if not (np.isfinite(radiance).all() and radiance.min() >= 0.0 and radiance.max() > 0.0):
        raise RsbenchError(
            f"environment map {path}: holds values below 0, that are not finite, or no light at all"
        )
    return radiance


def _check_map(path: Path, width: int, height: int, channels: int = 3) -> None:
    if width != 2 * height or height < 2:
        raise RsbenchError(f"environment map {path}: {width} x {height}: a lat-long map is twice as wide as high")
    check_amount(f"environment map {path}", "pixels", width * height, PIXELS)
    check_amount(f"environment map {path}", "channels", channels, _CHANNELS)


def _read_hdr(data: bytes, path: Path) -> NDArray[np.float32]:
    size = re.search(rb"\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:4096])
    if size is None or not data.startswith(b"#?"):
        raise RsbenchError(f"environment map {path}: no Radiance HDR file with rows from the top")
    height, width = int(size[1]), int(size[2])
    _check_map(path, width, height)
    decoded: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded.shape != (height, width, 3):
        raise ValueError("decoded to another size")
    return np.ascontiguousarray(decoded[..., ::-1], dtype=np.float32)


def _read_exr(data: bytes, path: Path) -> NDArray[np.float32]:
    import OpenEXR

    with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
        headers = [part.header for part in file.parts]
        low, high = headers[0]["dataWindow"]
        width, height = (int(end - start) + 1 for start, end in zip(low, high, strict=True))
        names = [channel.name for channel in headers[0]["channels"]]
    if len(headers) != 1 or not {"R", "G", "B"} <= set(names):
        raise RsbenchError(f"environment map {path}: one part with the channels R, G and B is needed")
    _check_map(path, width, height, len(names))
    with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
        pixels = [np.asarray(file.channels()[name].pixels, dtype=np.float32) for name in "RGB"]
    return np.stack(pixels, axis=-1)


def lit_by(light: Light, radiance: NDArray[np.float32], turn_deg: float) -> Light:
    """Return the light of an environment map, scaled so that open level ground is as bright as under ``light``.

    A sun in the map becomes the directional sun, whose shadows have no noise; otherwise there is no sun.

    Args:
        light: light in the frame of the scene, z up; its sun and sky only set the brightness.
        radiance: radiance from ``read_environment``.
        turn_deg: rotation of the map, degrees anticlockwise seen from above.

    Raises:
        RsbenchError: the upper half of the map is black.
    """
    directions, weights = _directions(radiance.shape[0])
    sky, direction, irradiance = _without_sun(radiance.astype(np.float64), directions, weights)
    level = np.sum(sky * (np.maximum(directions[..., 2], 0.0) * weights)[..., None], axis=(0, 1))
    own = float((level + irradiance * direction[2]) @ _REC_709)
    if own <= 0.0:
        raise RsbenchError("environment map: its upper half is black")
    up = np.asarray(light.sun_direction)[2]
    factor = float((np.asarray(light.sun_irradiance) * up + np.pi * light.mean_sky) @ _REC_709) / own
    turn = so3.exp(np.array([0.0, 0.0, np.deg2rad(turn_deg)]))
    return replace(
        light,
        sun_direction=tuple(turn @ direction),
        sun_irradiance=tuple(factor * irradiance),
        environment=Environment(radiance=_at_edges(factor * sky), frame_from_map=turn @ _SCENE_FROM_MAP),
    )


_SCENE_FROM_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""The map's axes are those of a camera that looks at the map's centre: x right, y down, z forward."""


def _directions(height: int) -> tuple[FloatArray, FloatArray]:
    """Return unit directions (H, 2 H, 3) of a map's pixels in the scene frame, and solid angles (H, 1)."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    directions = _around(np.pi * (np.arange(height) + 0.5) / height, height)
    return directions, (edges[:-1] - edges[1:])[:, None] * np.pi / height


def _around(down: FloatArray, height: int) -> FloatArray:
    """Return unit directions (n, 2 H, 3) at angles (n) from the zenith, for the columns of a map of height H."""
    around = np.pi * ((np.arange(2 * height) + 0.5) / height - 1.0)
    level = np.sin(down)[:, None]
    return np.stack(
        [level * np.sin(around), level * np.cos(around), np.cos(down)[:, None] + 0.0 * around], axis=-1
    )


def _without_sun(
    radiance: FloatArray, directions: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Replace a map's sun by the surrounding radiance; return map, sun direction (3,) and irradiance (3,)."""
    bright = radiance @ _REC_709
    upper = bright[: len(bright) // 2]
    peak = np.unravel_index(int(np.argmax(upper)), upper.shape)
    if upper[peak] <= _SUNNY * np.median(upper):
        return radiance, np.array([0.0, 0.0, 1.0]), np.zeros(3)
    apart = directions @ directions[peak]
    near = apart > np.cos(np.deg2rad(_SUN_DEG))
    ring = ~near & (apart > np.cos(np.deg2rad(_RING_DEG)))
    around = np.median(radiance[ring], axis=0) if np.any(ring) else np.median(radiance, axis=(0, 1))
    more = np.where(near[..., None], np.maximum(radiance - around, 0.0), 0.0) * weights[..., None]
    direction = np.sum(directions * (more @ _REC_709)[..., None], axis=(0, 1))
    sky = np.where(near[..., None], np.minimum(radiance, around), radiance)
    return sky, direction / np.linalg.norm(direction), np.sum(more, axis=(0, 1))


def _at_edges(radiance: FloatArray) -> NDArray[np.float32]:
    """Interpolate values (H + 1, W, 3) at the edges of rows; the first and last are the poles."""
    top, bottom = (np.broadcast_to(np.mean(radiance[row], axis=0), (1, *radiance.shape[1:])) for row in (0, -1))
    between = 0.5 * (radiance[:-1] + radiance[1:])
    return np.concatenate([top, between, bottom]).astype(np.float32)


def irradiance_map(radiance: NDArray[np.float32], rows: int = 32) -> NDArray[np.float32]:
    """Return the radiance (rows + 1, 2 rows, 3) of unoccluded white diffuse surfaces under a map (H + 1, 2 H, 3).

    The directions of the surface normals are arranged as in ``Environment.radiance``.
    """
    height = min(len(radiance) - 1, 4 * rows)
    middle = 0.5 * (radiance[:-1] + radiance[1:])
    small = np.asarray(cv2.resize(middle, (2 * height, height), interpolation=cv2.INTER_AREA), dtype=np.float64)
    directions, weights = _directions(height)
    light = (small * weights[..., None]).reshape(-1, 3)
    normals = _around(np.pi * np.arange(rows + 1) / rows, rows)
    seen = [np.maximum(row @ directions.reshape(-1, 3).T, 0.0) @ light for row in normals]
    return (np.stack(seen) / np.pi).astype(np.float32)


_FARTHEST = 1e9
Rgb: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class LightCard:
    """``Light`` with the direction of the sun given by azimuth and elevation."""

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
    """Lat-long .hdr or .exr file, relative to the card, that replaces sun and sky; these then only set its
    brightness."""
    environment_turn_deg: float = 0.0
    """Rotation of the environment map, degrees anticlockwise from above; at 0 its centre is in direction +y."""

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
    """Content of a scene card."""

    name: str
    """Name of the scene, equal to that of the card's file."""
    builder: str
    """Name of a scene builder, or ``package.module:Class``; the module may lie beside the card."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """Parameters of the builder: the fields of its class."""
    viewpoints: dict[str, Viewpoint]
    """Viewpoints by name; ``default`` is required."""
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
"""Names that ``builder`` in a scene card may have; other packages add entry points ``rsbench.scenes``."""


def load_scene(name_or_path: str | Path) -> Scene:
    """Build the scene of a card, in the scene frame. The same card gives the same arrays.

    Args:
        name_or_path: name of a card that comes with rsbench, or a path that ends in ``.toml``.

    Raises:
        RsbenchError: the card, its builder or a file that it names is missing or wrong; the message is one line.
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
    """Return the meshes of one of our builders, from the cache if possible."""
    key = built_key(builder, seed)
    meshes = None if key is None else cached_meshes(key)
    if meshes is None:
        meshes = tuple(builder.build(seed, folder))
        if key is not None:
            keep(key, meshes)
    return meshes


def read_scene_card(path: Path) -> tuple[SceneCard, SceneBuilder]:
    """Parse a scene card without building the scene; return it and its builder with the card's parameters.

    Raises:
        RsbenchError: the card is wrong; the message is one line.
    """
    card = parse_card(SceneCard, read_toml(path), str(path))
    cls = load_class(BUILDERS, card.builder, path)
    return card, make_component(BUILDERS, cls, card.parameters, str(path))


def _check_meshes(meshes: tuple[SceneMesh, ...], where: str) -> None:
    """Refuse invalid meshes, which could make a renderer fail or read beyond arrays."""
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
