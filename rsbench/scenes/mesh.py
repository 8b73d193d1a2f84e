"""A scene from a mesh file of the user: glTF, GLB, OBJ, OFF, PLY or STL, read by trimesh.

A file may name others, such as textures, in its own folder and below. The size that a file states is checked
before trimesh reads it, and what trimesh ignores in a glTF header is read here: extensions that it cannot decode,
and transforms of textures. The model is then placed: its size and place, the ground below it and walls around.
"""

from __future__ import annotations

import base64
import io
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote_to_bytes

import numpy as np
import trimesh
from numpy.typing import NDArray

from rsbench.components.imports import in_words
from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import ROUGHEST, SMOOTHEST, FloatArray, Material, SceneBuilder, SceneMesh
from rsbench.scenes.parts import Piece, assemble, box, grid
from rsbench.scenes.surfaces import paint_palette
from rsbench.storage.untrusted_files import (
    FILE_BYTES,
    check_amount,
    check_image_size,
    check_size,
    parse_json,
    read_bytes,
)

_TRANSFORM = "KHR_texture_transform"
_HARMLESS = (_TRANSFORM, "KHR_materials_", "KHR_lights_", "EXT_texture_webp")
"""Beginnings of extensions that may be required: we read them, or they say what a diffuse surface has not."""
_ARCHIVED = "KHR_materials_pbrSpecularGlossiness"


@dataclass(frozen=True, kw_only=True)
class TextureTransform:
    """Transform of texture coordinates, in glTF's own frame: u right, v down."""

    offset: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    """Radians; anticlockwise as one sees it in a picture of u and v, so from +u towards -v."""
    scale: tuple[float, float] = (1.0, 1.0)

    def __call__(self, uv: FloatArray) -> FloatArray:
        """Coordinates (n, 2), v up, as trimesh gives them: scaled, then rotated, then moved."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        u, v = uv[:, 0] * self.scale[0], (1.0 - uv[:, 1]) * self.scale[1]
        turned = np.stack([c * u + s * v + self.offset[0], 1.0 - (c * v - s * u + self.offset[1])], axis=1)
        return np.asarray(turned, dtype=np.float64)


def check_extensions(header: Mapping[str, Any], where: str) -> None:
    """Refuse what would be read as something else than it is.

    Raises:
        RsbenchError: the file requires an extension that is not read, or has materials of an old one.
    """
    for name in header.get("extensionsRequired", []):
        if not str(name).startswith(_HARMLESS) or name == _ARCHIVED:
            raise RsbenchError(f"{where}: needs the glTF extension {name}, which is not read: export it without")
    if any(_ARCHIVED in material.get("extensions", {}) for material in header.get("materials", [])):
        raise RsbenchError(f"{where}: has materials of {_ARCHIVED}: export it with metallic-roughness ones")


def texture_transforms(header: Mapping[str, Any], where: str) -> dict[str, TextureTransform]:
    """Transforms of base colour textures by the names of their materials.

    Raises:
        RsbenchError: materials of one name have several, or a texture uses other coordinates than the first.
    """
    found: dict[str, TextureTransform] = {}
    for material in header.get("materials", []):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        stated = texture.get("extensions", {}).get(_TRANSFORM, {})
        name = str(material.get("name"))
        if stated.get("texCoord", texture.get("texCoord", 0)) != 0:
            raise RsbenchError(
                f"{where}: the texture of material {name!r} uses a second set of coordinates: export it with one"
            )
        transform = TextureTransform(
            offset=_pair(stated.get("offset", (0.0, 0.0))),
            rotation=float(stated.get("rotation", 0.0)),
            scale=_pair(stated.get("scale", (1.0, 1.0))),
        )
        if found.setdefault(name, transform) != transform:
            raise RsbenchError(
                f"{where}: materials of the name {name!r} have several {_TRANSFORM}: give them names of their own"
            )
    return {name: transform for name, transform in found.items() if transform != TextureTransform()}


def _pair(values: Any) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)


PARTS = 1 << 12
"""Nodes, meshes, materials and so on, of each kind."""
VALUES = 1 << 26
"""Numbers in the arrays of a file, and in those of all its parts, which may share them."""
_DEEPEST = 64
_VISITS = 1 << 28
TEXTURE = 1 << 24
"""Pixels of a texture, 4096 x 4096."""
SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def check_mesh_file(path: Path) -> dict[str, TextureTransform]:
    """Refuse a mesh file that says of itself that it unfolds to too much; returns its transforms of textures.

    Raises:
        RsbenchError: that, a format that is not read, or a header that cannot be one.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise RsbenchError(
            f"mesh file {path}: cannot be read: must end in {', '.join(SUFFIXES)}; export it as GLB"
        )
    data, where = read_bytes(path, FILE_BYTES), f"mesh file {path}"
    try:
        match path.suffix.lower():
            case ".glb":
                return _check_gltf(_json_chunk(data), where, _binary_chunk(data))
            case ".gltf":
                return _check_gltf(data, where)
            case ".ply":
                _check_ply(data, where)
            case ".obj":
                _check_obj(data, where)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise RsbenchError(f"{where}: cannot be read: {type(error).__name__} in its header: {error}") from error
    return {}


def _json_chunk(data: bytes) -> bytes:
    if data[:4] != b"glTF" or data[16:20] != b"JSON":
        raise ValueError("not binary glTF")
    return data[20 : 20 + int.from_bytes(data[12:16], "little")]


def _binary_chunk(data: bytes) -> bytes:
    start = 20 + int.from_bytes(data[12:16], "little")
    return data[start + 8 : start + 8 + int.from_bytes(data[start : start + 4], "little")]


def _check_gltf(text: bytes, where: str, binary: bytes = b"") -> dict[str, TextureTransform]:
    header = parse_json(text.decode("utf-8"), where)
    for name, items in header.items():
        if isinstance(items, list):
            check_amount(where, name, len(items), PARTS)
    sizes = [_size(accessor) for accessor in header.get("accessors", [])]
    check_amount(where, "values of all accessors", sum(sizes), VALUES)
    primitives = [primitive for mesh in header.get("meshes", []) for primitive in mesh["primitives"]]
    check_amount(where, "primitives", len(primitives), PARTS)
    used = [index for primitive in primitives for index in _accessors(primitive)]
    check_amount(where, "values of all primitives", sum(sizes[index] for index in used), VALUES)
    _check_graph(header, where)
    check_extensions(header, where)
    if any(not {"bufferView", "sparse"} & set(header["accessors"][index]) for index in used):
        raise RsbenchError(f"{where}: has meshes without data: export it without compression")
    for number in _coloured_images(header):
        _check_image(header, number, binary, f"{where}: image {number}")
    return texture_transforms(header, where)


def _coloured_images(header: dict[str, Any]) -> list[int]:
    """Numbers of the images that colour a material, each once."""
    textures = [
        each.get("pbrMetallicRoughness", {}).get("baseColorTexture") for each in header.get("materials", [])
    ]
    sources = [header["textures"][each["index"]].get("source") for each in textures if each is not None]
    return sorted({number for number in sources if number is not None})


def _check_image(header: dict[str, Any], number: int, binary: bytes, where: str) -> None:
    """Refuse an image inside the file that cannot be decoded, in whose place trimesh takes grey without a word.

    Images in files of their own are read, and refused, as they are needed.
    """
    image = header["images"][number]
    if str(image.get("uri", "")).startswith("data:"):
        kind, _, text = image["uri"].partition(",")
        data = base64.b64decode(text, validate=True) if kind.endswith(";base64") else unquote_to_bytes(text)
    elif "bufferView" in image and binary:
        view = header["bufferViews"][image["bufferView"]]
        start = int(view.get("byteOffset", 0))
        data = binary[start : start + int(view["byteLength"])]
    else:
        return
    check_image_size(data, where, most=TEXTURE)


def _check_graph(header: dict[str, Any], where: str) -> None:
    """Refuse nodes that are not trees, as glTF requires, or so deep that each path takes long."""
    children = [node.get("children", []) for node in header.get("nodes", [])]
    parents = {child: number for number, each in enumerate(children) for child in each}
    shown = [node for scene in header.get("scenes", []) for node in scene.get("nodes", [])]
    check_amount(where, "nodes of all scenes", len(shown), PARTS)
    if len(parents) < sum(map(len, children)):
        raise RsbenchError(f"{where}: a node has two parents")
    for node in parents:
        depth = 0
        while node in parents and depth <= _DEEPEST:
            node, depth = parents[node], depth + 1
        check_amount(where, "levels of nodes", depth, _DEEPEST)


def _size(accessor: dict[str, Any]) -> int:
    count, width = accessor["count"], _TYPES[accessor["type"]]
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise ValueError(f"count = {count!r}")
    return count * width


def _accessors(primitive: dict[str, Any]) -> Iterable[int]:
    found = [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]
    if any(isinstance(index, bool) or not isinstance(index, int) or index < 0 for index in found):
        raise ValueError(f"accessors {found}")
    return found


def _check_obj(data: bytes, where: str) -> None:
    groups = len(re.findall(rb"^\s*(?:usemtl|o|g)\s", data, re.MULTILINE))
    check_amount(where, "groups", groups, PARTS)
    # Its reader goes through all vertices for each group.
    vertices = len(re.findall(rb"^\s*v\s", data, re.MULTILINE))
    check_amount(where, "vertices times groups", vertices * groups, _VISITS)


def _check_ply(data: bytes, where: str) -> None:
    header, _, content = data.partition(b"end_header")
    counts = [int(count) for count in re.findall(rb"^element\s+\S+\s+(\S+)", header, re.MULTILINE)]
    # Each vertex and each face takes a byte at least; of text, each line is one.
    if min(counts, default=0) < 0 or sum(counts) > len(content):
        raise ValueError(f"states {sum(counts)} elements in {len(content)} bytes")
    if b"ascii" in header and content.count(b"\n") > 2 * sum(counts) + PARTS:
        raise ValueError(f"states {sum(counts)} elements in {content.count(bytes([10]))} lines")


_GROUND, _WALL = "cobbles", "brick"
_SUNK = 1e-3
"""Depth of the ground below the model, in sizes of the model: a base at its height would share its surface."""
_APART, _HIGH = 4.0, 2.0
"""Distance from the model's axis to the walls, and their height, in sizes of the model."""


def standing(meshes: Sequence[SceneMesh], size: float | None) -> tuple[SceneMesh, ...]:
    """The same model over the scene's origin, its lowest point at z = 0.

    Args:
        meshes: of the model; all vertices that triangles use are within its box.
        size: length of the longest side of that box, metres; None keeps it.
    """
    low, high = box_of(meshes)
    factor = 1.0 if size is None else size / float(np.max(high - low))
    foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return tuple(replace(mesh, vertices=factor * (mesh.vertices - foot)) for mesh in meshes)


def box_of(meshes: Sequence[SceneMesh]) -> tuple[FloatArray, FloatArray]:
    """Least and largest coordinates (3,) of what is seen of meshes."""
    used = [mesh.vertices[np.unique(mesh.faces)] for mesh in meshes]
    lows, highs = [part.min(axis=0) for part in used], [part.max(axis=0) for part in used]
    return np.min(lows, axis=0), np.max(highs, axis=0)


def surroundings(meshes: Sequence[SceneMesh], ground: bool, backdrop: bool, seed: int) -> tuple[SceneMesh, ...]:
    """Cobbles below a model, and a square of brick walls around it; its box decides their size."""
    low, high = box_of(meshes)
    size, (x, y) = float(np.max(high - low)), (low[:2] + high[:2]) / 2
    floor, reach, pieces = float(low[2]) - _SUNK * size, _APART * size, list[Piece]()
    if ground:
        steps = np.linspace(-2 * reach, 2 * reach, 33)
        across, along = np.meshgrid(steps, steps)
        points = np.stack([x + across, y + along, np.full_like(across, floor)], axis=-1)
        pieces.append(grid(_GROUND, points, np.stack([across, along], axis=-1)))
    if backdrop:
        thick, top = 0.1 * size, floor + _HIGH * size
        for sign in (-1, 1):
            near, far = sorted((sign * reach, sign * (reach + thick)))
            pieces.append(box(_WALL, (x + near, y - reach, floor), (x + far, y + reach, top)))
            pieces.append(box(_WALL, (x - reach, y + near, floor), (x + reach, y + far, top)))
    made = assemble(pieces, paint_palette((piece.surface for piece in pieces), seed), (seed, 2))
    return tuple(replace(mesh, name=f"around the model: {mesh.name}") for mesh in made)


# Rows turn file axes into a right-handed frame with z up.
_Z_UP = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
_SHEET = 1024  # columns of the sheet that holds colours of faces
_TRIANGLES = 1 << 22
_TEXTURES = 1 << 26
"""Pixels of all textures."""
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what it logs of a file is in our line


@dataclass(frozen=True, kw_only=True)
class MeshBuilder(SceneBuilder):
    """A mesh file: which, and how its axes and units become the scene frame's."""

    file: str
    """Path of the mesh file, relative to the card, or absolute."""
    metres_per_unit: float = 1.0
    """Metres of one unit of the file; ``size`` replaces it."""
    up_axis: Literal["x", "y", "z"] = "y"
    """The file's upward axis; glTF has y up."""
    heading_deg: float = 0.0
    """Turns the model anticlockwise about the vertical."""
    shading: Literal["flat", "smooth"] = "flat"
    """Whether triangles are shaded flat or with the file's smooth normals."""
    transparent: Literal["refuse", "opaque"] = "refuse"
    """What becomes of surfaces that the file cuts out or blends by an alpha: only opaque ones can be rendered."""
    gloss: Literal["none", "file"] = "none"
    """``file``: surfaces are as glossy as a glTF's roughness says, see ``_roughness``; ``none``: diffuse."""

    size: float | None = None
    """Longest side of the model's box, metres, whatever its units are."""
    place: Literal["file", "origin"] = "file"
    """``origin`` sets the model over the scene's origin, its lowest point at z = 0."""
    ground: bool = False
    """Cobbles below the model."""
    backdrop: bool = False
    """Brick walls around it, four of its sizes away."""

    def __post_init__(self) -> None:
        for name in ("metres_per_unit", "size"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} = {value}: must be positive")
        if self.size is not None and self.place == "file":
            raise ValueError('size: needs place = "origin", for the file\'s own place has no size')

    def build(self, seed: int, folder: Path) -> tuple[SceneMesh, ...]:
        """Meshes of a file in the scene frame, one for each part of its scene graph, textures and uv kept.

        Args:
            seed: of the textures of ground and walls.
            folder: where a relative path starts.

        Raises:
            RsbenchError: the file or one that it refers to is missing or broken, or holds no triangles.
        """
        path = folder / Path(self.file).expanduser()
        try:
            with np.errstate(all="ignore"):  # what is not finite is refused by name
                meshes = self._meshes(path)
                if np.array_equal(*box_of(meshes)):
                    raise RsbenchError(f"mesh file {path}: all of it lies in one point")
                if self.place == "origin":
                    meshes = standing(meshes, self.size)
                return meshes + surroundings(meshes, self.ground, self.backdrop, seed)
        except RsbenchError:
            raise
        except Exception as error:  # trimesh raises various errors on a broken file, often late
            raise RsbenchError(f"mesh file {path}: cannot be read: {in_words(error)}") from error

    def _meshes(self, path: Path) -> tuple[SceneMesh, ...]:
        model, transforms = _read(path)
        _check_size(model, path)
        angle = np.deg2rad(self.heading_deg)
        heading = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        axes = self.metres_per_unit * heading @ _Z_UP[self.up_axis]
        look = _Look(
            shading=self.shading,
            transparent=self.transparent,
            gloss=self.gloss,
            transforms=transforms,
            materials={},
        )
        meshes = []
        for node in sorted(model.graph.nodes_geometry):
            transform, name = model.graph[node]
            part = model.geometry[name]
            if isinstance(part, trimesh.Trimesh) and len(part.faces):
                meshes.append(_scene_mesh(str(node), part, axes, transform, look, path))
        if not meshes:
            raise RsbenchError(f"{path}: holds no triangles")
        return tuple(meshes)


@dataclass(frozen=True, kw_only=True)
class _Look:
    """What the parts of a file share, besides their geometry."""

    shading: str
    transparent: str
    gloss: str
    transforms: dict[str, TextureTransform]
    materials: dict[int, Material]
    """Made so far, by the identity of what trimesh read."""


def _check_size(model: Any, path: Path) -> None:
    """Refuse what its scene graph, which may show a mesh many times, unfolds to too much."""
    nodes = [model.geometry[model.graph[node][1]] for node in model.graph.nodes_geometry]
    triangles = sum(len(part.faces) for part in nodes if isinstance(part, trimesh.Trimesh))
    check_amount(f"mesh file {path}", "triangles", triangles, _TRIANGLES)


class _Neighbours(trimesh.resolvers.FilePathResolver):
    """Files beside the model and below, as UTF-8; remembers what was wrong with them, which trimesh only logs."""

    def __init__(self, source: str) -> None:
        super().__init__(source)
        self.wrong: list[str] = []
        self.libraries: list[bytes] = []
        """Contents of the MTL files that were read."""

    def get(self, name: str) -> bytes:
        try:
            content: bytes = super().get(name.replace("\\", "/"))  # exporters on Windows write paths of theirs
        except Exception as error:
            too_large = isinstance(error, RsbenchError)
            self.wrong.append(str(error) if too_large else f"{name}, which is missing or lies outside its folder")
            raise
        if name.lower().endswith(".mtl"):
            content = _as_utf8(content)
            self.libraries.append(content)
        return content

    def absolute(self, name: str) -> Path:
        path: Path = super().absolute(name)  # raises where links or dots lead out of the folder
        if path.exists():
            if not path.is_file():
                raise ValueError(f"{name} is no file")
            check_amount(name, "bytes", path.stat().st_size, FILE_BYTES)
        return path


def _as_utf8(text: bytes) -> bytes:
    """Text of unknown encoding: UTF-8 when it can be, else the old one of Western exporters."""
    try:
        text.decode("utf-8")
    except UnicodeDecodeError:
        return text.decode("latin-1").encode("utf-8")
    return text


def _read(path: Path) -> tuple[Any, dict[str, TextureTransform]]:
    """What trimesh makes of a file, and the transforms of its textures."""
    if not path.is_file():
        raise RsbenchError(f"mesh file {path}: no such file (parameters.file is relative to the card)")
    transforms = check_mesh_file(path)
    neighbours = _Neighbours(str(path))
    options = {"resolver": neighbours, "process": False}
    try:
        if path.suffix.lower() != ".obj":
            return trimesh.load_scene(str(path), **options), transforms
        content = path.read_bytes()
        text = _as_utf8(content)
        given = {"file_obj": str(path)} if text == content else {"file_obj": io.BytesIO(text), "file_type": "obj"}
        model = trimesh.load_scene(**given, **options)
        _check_names(text, neighbours.libraries, path)
        return model, transforms
    finally:
        if neighbours.wrong:
            raise RsbenchError(f"mesh file {path}: refers to {neighbours.wrong[0]}")


def _check_names(text: bytes, libraries: list[bytes], path: Path) -> None:
    """Refuse materials that no library has, where trimesh takes grey instead; an OBJ without any is grey."""
    used = re.findall(rb"^\s*usemtl[ \t]+(.+?)\s*$", text, re.MULTILINE)
    known = re.findall(rb"^\s*newmtl[ \t]+(.+?)\s*$", b"\n".join(libraries), re.MULTILINE)
    missing = sorted(set(used) - set(known)) if libraries else []
    if missing:
        raise RsbenchError(f"mesh file {path}: usemtl {missing[0].decode()}: its .mtl has no such material")


def _scene_mesh(
    name: str, part: Any, axes: FloatArray, transform: FloatArray, look: _Look, path: Path
) -> SceneMesh:
    where = f"mesh file {path}: part {name!r}"
    linear = axes @ transform[:3, :3]
    vertices = np.asarray(part.vertices, dtype=np.float64) @ linear.T + axes @ transform[:3, 3]
    faces: NDArray[np.int32] = np.asarray(part.faces)
    if not np.isfinite(vertices).all():
        raise RsbenchError(f"{where} has vertices that are not finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise RsbenchError(f"{where} has faces that name vertices beyond its {len(vertices)}")
    faces = faces.astype(np.int32)
    normals = _normals(part, linear, where) if look.shading == "smooth" else None
    if part.visual.kind in ("vertex", "face"):
        return _coloured_faces(name, vertices, faces, normals, np.asarray(part.visual.face_colors)[:, :3])
    source = getattr(part.visual, "material", None)
    uv = getattr(part.visual, "uv", None)
    if id(source) not in look.materials:
        _check_alpha(source, where, look.transparent)
        material = _material(source, where, list(look.materials.values()))
        roughness = _roughness(source, where) if look.gloss == "file" else None
        look.materials[id(source)] = replace(material, roughness=roughness)
    material = look.materials[id(source)]
    if material.texture is not None and (uv is None or not np.isfinite(uv).all()):
        raise RsbenchError(f"{where} has a texture but no finite texture coordinates")
    uv = None if uv is None else np.asarray(uv, dtype=np.float64)
    if uv is not None and (transform_of := look.transforms.get(material.name)) is not None:
        uv = transform_of(uv)
    return SceneMesh(name=name, vertices=vertices, faces=faces, material=material, uv=uv, normals=normals)


def _normals(part: Any, linear: FloatArray, where: str) -> FloatArray:
    """Unit normals (n, 3) of the vertices in the scene frame."""
    try:
        normals = np.asarray(part.vertex_normals, dtype=np.float64) @ np.linalg.inv(linear)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    except np.linalg.LinAlgError as error:
        raise RsbenchError(f"{where} is flattened by its transform, so that it has no normals") from error
    if not np.isfinite(normals).all():
        raise RsbenchError(f"{where} has normals that are not finite")
    return normals


def _check_alpha(source: Any, where: str, transparent: str) -> None:
    """Refuse a material that is anywhere less than opaque, unless that is to be passed over.

    Raises:
        RsbenchError: see above.
    """
    if transparent == "opaque" or source is None:
        return
    image, least = None, 1.0
    if isinstance(source, trimesh.visual.material.PBRMaterial):
        if source.alphaMode in ("MASK", "BLEND"):
            image = source.baseColorTexture
            least = 1.0 if source.baseColorFactor is None else float(source.baseColorFactor[3]) / 255
    else:
        stated = getattr(source, "kwargs", {})
        least = 0.0 if "map_d" in stated else float(stated.get("d", [1.0])[-1])
    if image is not None and image.mode in ("RGBA", "LA", "PA"):
        least = min(least, image.getchannel("A").getextrema()[0] / 255)
    if least < 1.0:
        raise RsbenchError(
            f"{where} is transparent, and only opaque surfaces are rendered: model its outline as geometry, or "
            'write transparent = "opaque" to fill it'
        )


def _material(source: Any, where: str, others: list[Material]) -> Material:
    """Diffuse part of a glTF or MTL material; all else that it may say is left out, or ``_roughness``."""
    if source is None:
        return Material(name="plain")
    if isinstance(source, trimesh.visual.material.MultiMaterial):
        raise RsbenchError(f"{where} has several materials in one part: export it as glTF instead")
    name = str(getattr(source, "name", None) or "unnamed")
    if isinstance(source, trimesh.visual.material.PBRMaterial):
        image, factor = source.baseColorTexture, source.baseColorFactor
        # glTF factors are linear reflectances; trimesh keeps them as bytes.
        linear = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255
    else:
        image = getattr(source, "image", None)
        diffuse = np.asarray(getattr(source, "diffuse", (204, 204, 204)), dtype=np.float64)[:3] / 255
        linear = np.ones(3) if image is not None else _to_linear(diffuse)
    if image is None:
        r, g, b = (float(value) for value in _to_srgb(linear))
        return Material(name=name, colour=(r, g, b))
    return Material(name=name, texture=_texture(image, linear, where, others))


def _roughness(source: Any, where: str) -> float | None:
    """Of a glTF material, no less than the smoothest; above the roughest, and of other files, None: diffuse.

    Raises:
        RsbenchError: metal, or a map: a coat has one roughness, and what is below it is diffuse.
    """
    if not isinstance(source, trimesh.visual.material.PBRMaterial):
        return None
    if source.metallicRoughnessTexture is not None:
        raise RsbenchError(
            f'{where} has a map of roughness, and gloss = "file" takes one number for each material: export it '
            "without, or leave gloss out"
        )
    # What a file does not state is 1, by glTF's specification.
    metal, roughness = (
        1.0 if each is None else float(each) for each in (source.metallicFactor, source.roughnessFactor)
    )
    if metal > 0.0:
        raise RsbenchError(
            f'{where} is metal (metallicFactor = {metal:g}), and gloss = "file" takes clear coats on diffuse '
            "surfaces only: set it to 0, or leave gloss out"
        )
    return max(roughness, SMOOTHEST) if roughness <= ROUGHEST else None


def _texture(image: Any, factor: FloatArray, where: str, others: list[Material]) -> NDArray[np.uint8]:
    """(h, w, 3) sRGB of an image times a linear factor; its size is checked before it is decoded."""
    check_size(f"{where}: texture", image.size, most=TEXTURE)
    taken = sum(other.texture.size // 3 for other in others if other.texture is not None)
    pixels = taken + image.size[0] * image.size[1]
    check_amount(where, "pixels of all textures", pixels, _TEXTURES)
    texture = np.array(image.convert("RGB"), dtype=np.uint8)
    if not np.all(factor == 1.0):
        levels = np.rint(_to_srgb(_to_linear(np.arange(256)[:, None] / 255.0) * factor) * 255)
        levels = np.clip(levels, 0, 255).astype(np.uint8)
        for channel in range(3):
            texture[..., channel] = levels[texture[..., channel], channel]
    return texture


def _coloured_faces(
    name: str,
    vertices: FloatArray,
    faces: NDArray[np.int32],
    normals: FloatArray | None,
    colours: NDArray[np.uint8],
) -> SceneMesh:
    """A mesh with a colour for each face, which a sheet of one texel for each colour holds."""
    palette, index = np.unique(colours, axis=0, return_inverse=True)
    index = np.asarray(index).ravel()
    rows = -(-len(palette) // _SHEET)
    sheet = np.zeros((rows * _SHEET, 3), dtype=np.uint8)
    sheet[: len(palette)] = palette
    # The centre of a texel, where bilinear interpolation gives its colour alone; v points up from the last row.
    centre = np.stack([(index % _SHEET + 0.5) / _SHEET, 1 - (index // _SHEET + 0.5) / rows], axis=1)
    return SceneMesh(
        name=name,
        vertices=vertices[faces].reshape(-1, 3),
        faces=np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3),
        material=Material(name="face colours", texture=sheet.reshape(rows, _SHEET, 3)),
        uv=np.repeat(centre, 3, axis=0),
        normals=None if normals is None else normals[faces].reshape(-1, 3),
    )


def _to_linear(srgb: FloatArray) -> FloatArray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)


def _to_srgb(linear: FloatArray) -> FloatArray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
