"""Reads mesh files with trimesh, and adds features that trimesh ignores.

A file may refer to others, such as textures, in its own folder and below. The sizes stated in a file are checked
before trimesh reads it. This module handles what trimesh ignores: in glTF, transforms and wrap modes of textures,
exact colour factors and triangle fans (refused); in MTL, options of ``map_Kd``; in OBJ, negative indices, which
are relative to the current line, and non-convex polygons.
"""

from __future__ import annotations

import base64
import io
import json
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import unquote, unquote_to_bytes

import mapbox_earcut
import numpy as np
import trimesh
from numpy.typing import NDArray

from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import FloatArray
from rsbench.storage.untrusted_files import (
    FILE_BYTES,
    NUMBER,
    check_amount,
    check_image_size,
    parse_json,
    read_bytes,
)

logging.getLogger("trimesh").addHandler(logging.NullHandler())  # our errors contain what it logs
Wrap = Literal["repeat", "mirror", "clamp"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Properties of a material's colour that trimesh ignores."""

    name: str
    linear: FloatArray
    """(2, 2) linear part of the texture transform, see ``offset``."""
    offset: FloatArray
    """(2,) offset of the texture transform: texture coordinates are ``linear @ uv + offset``, v up in both."""
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    """Wrap mode outside of [0, 1], along u and along v."""
    factor: FloatArray | None = None
    """(3,) linear reflectance that multiplies texture and vertex colours; None: use trimesh's value."""

    def coordinates(self, uv: FloatArray, size: tuple[int, int], where: str) -> FloatArray:
        """Convert mesh coordinates (n, 2), v up, to coordinates in the texture returned by ``wrapped``.

        ``size`` is the width and height of the original texture.

        Raises:
            RsbenchError: the texture is clamped, and coordinates are outside of it.
        """
        found = uv @ self.linear.T + self.offset
        for axis, (wrap, texels) in enumerate(zip(self.wrap, size, strict=True)):
            if wrap == "mirror":
                found[:, axis] /= 2.0
            elif wrap == "clamp":
                if np.any(np.abs(found[:, axis] - 0.5) > 0.5 + 0.5 / texels):
                    raise RsbenchError(
                        f"{where}: its texture is clamped, and its coordinates {'uv'[axis]} leave 0 to 1, which "
                        "is not drawn: make the texture repeat, or the coordinates stay inside"
                    )
                found[:, axis] = (found[:, axis] * texels + 1.0) / (texels + 2.0)
        return found

    def wrapped(self, texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a texture (h, w, 3) to be repeated that emulates ``wrap``: with its mirror image or a border."""
        for axis, wrap in ((1, self.wrap[0]), (0, self.wrap[1])):
            if wrap == "mirror":
                pair = (texture, np.flip(texture, axis))
                texture = np.concatenate(pair if axis else pair[::-1], axis=axis)
            elif wrap == "clamp":
                border = [(0, 0), (0, 0), (0, 0)]
                border[axis] = (1, 1)
                texture = np.pad(texture, border, mode="edge")
        return texture


_TRANSFORM = "KHR_texture_transform"
_HARMLESS = (_TRANSFORM, "KHR_materials_", "KHR_lights_", "EXT_texture_webp")
"""Prefixes of extensions that a file may require: we read them, or they do not affect diffuse surfaces."""
_ARCHIVED = "KHR_materials_pbrSpecularGlossiness"


def check_extensions(header: Mapping[str, Any], where: str) -> None:
    """Refuse glTF files that would be misread.

    Raises:
        RsbenchError: the file requires an unsupported extension, or has materials of an archived one.
    """
    for name in header.get("extensionsRequired", []):
        if not str(name).startswith(_HARMLESS) or name == _ARCHIVED:
            raise RsbenchError(f"{where}: needs the glTF extension {name}, which is not read: export it without")
    if any(_ARCHIVED in material.get("extensions", {}) for material in header.get("materials", [])):
        raise RsbenchError(f"{where}: has materials of {_ARCHIVED}: export it with metallic-roughness ones")


def _surfaces(header: Mapping[str, Any], where: str) -> dict[str, Surface]:
    """Return surfaces by material number, which ``_numbered`` sets as the material's name.

    The transform is that of KHR_texture_transform, with v down: scale, then rotation, then offset.

    Raises:
        RsbenchError: a texture uses another set of coordinates than the first.
    """
    found = {}
    for number, material in enumerate(header.get("materials", [])):
        colour = material.get("pbrMetallicRoughness", {})
        texture = colour.get("baseColorTexture", {})
        stated = texture.get("extensions", {}).get(_TRANSFORM, {})
        name = str(material.get("name", "unnamed"))
        if stated.get("texCoord", texture.get("texCoord", 0)) != 0:
            raise RsbenchError(
                f"{where}: the texture of material {name!r} uses a second set of coordinates: export it with one"
            )
        angle, (su, sv) = float(stated.get("rotation", 0.0)), _pair(stated.get("scale", (1.0, 1.0)))
        (ou, ov), c, s = _pair(stated.get("offset", (0.0, 0.0))), np.cos(angle), np.sin(angle)
        sampler = header["textures"][texture["index"]].get("sampler") if texture else None
        wraps = {} if sampler is None else header["samplers"][sampler]
        found[str(number)] = Surface(
            name=name,
            linear=np.array([[c * su, -s * sv], [s * su, c * sv]]),
            offset=np.array([s * sv + ou, 1.0 - c * sv - ov]),
            wrap=(_WRAPS[wraps.get("wrapS", 10497)], _WRAPS[wraps.get("wrapT", 10497)]),
            factor=np.array([float(each) for each in colour.get("baseColorFactor", (1.0, 1.0, 1.0))[:3]]),
        )
    return found


def _numbered(header: dict[str, Any]) -> dict[str, Any]:
    """Return a header with numbered material names, and with a material for each primitive with vertex colours.

    Without a material, trimesh converts vertex colours to 8 bits, which is too coarse for linear light.
    """
    materials = [each | {"name": str(number)} for number, each in enumerate(header.get("materials", []))]
    bare = False
    for mesh in header.get("meshes", []):
        for primitive in mesh["primitives"]:
            if "COLOR_0" in primitive["attributes"] and "material" not in primitive:
                primitive["material"], bare = len(materials), True
    if bare:
        materials.append({"name": str(len(materials))})
    return header | ({"materials": materials} if materials else {})


def _pair(values: Any) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)


PARTS = 1 << 12
"""Largest number of nodes, meshes, materials and so on, each."""
VALUES = 1 << 26
"""Largest number of values in the arrays of a file, and in those of all its parts, which may share arrays."""
_DEEPEST = 64
_VISITS = 1 << 28
TEXTURE = 1 << 24
"""Largest number of pixels of a texture, 4096 x 4096."""
SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_FAN = 6
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def check_mesh_file(path: Path) -> tuple[bytes | None, dict[str, Surface]]:
    """Refuse a mesh file that is too large when expanded, or that trimesh would misread.

    Returns:
        The content that trimesh should read instead of the file (None: the file itself), and the surfaces by
        material name in that content.

    Raises:
        RsbenchError: the file is refused, its format is unsupported, or its header is invalid.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RsbenchError(
            f"mesh file {path}: cannot be read: must end in {', '.join(SUFFIXES)}; export it as GLB"
        )
    data, where = read_bytes(path, FILE_BYTES), f"mesh file {path}"
    try:
        match suffix:
            case ".glb" | ".gltf":
                binary = suffix == ".glb"
                text, rest = _chunks(data) if binary else (data, b"")
                header = parse_json(text.decode("utf-8-sig"), where)
                _check_gltf(header, where, rest[8 : 8 + int.from_bytes(rest[:4], "little")])
                surfaces = _surfaces(header, where)
                text = json.dumps(_numbered(header)).encode()
                return _binary_gltf(data[:8], text, rest) if binary else text, surfaces
            case ".ply":
                _check_ply(data, where)
            case ".obj":
                _check_obj(data, where)
                text = _plain_polygons(_as_utf8(data))
                return None if text == data else text, {}
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise RsbenchError(f"{where}: cannot be read: {type(error).__name__} in its header: {error}") from error
    return None, {}


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """Split a binary glTF into its JSON and the rest: the binary chunk with its header of eight bytes."""
    if data[:4] != b"glTF" or data[16:20] != b"JSON":
        raise ValueError("not binary glTF")
    end = 20 + int.from_bytes(data[12:16], "little")
    return data[20:end], data[end:]


def _binary_gltf(start: bytes, text: bytes, rest: bytes) -> bytes:
    """Assemble a binary glTF from its magic and version, its JSON and the remaining chunks."""
    text += b" " * (-len(text) % 4)
    size = (20 + len(text) + len(rest)).to_bytes(4, "little")
    return start + size + len(text).to_bytes(4, "little") + b"JSON" + text + rest


def _check_gltf(header: dict[str, Any], where: str, binary: bytes) -> None:
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
    if any(primitive.get("mode") == _FAN for primitive in primitives):
        raise RsbenchError(f"{where}: has triangle fans (mode {_FAN}), which are not read: export it as triangles")
    for number in _coloured_images(header):
        _check_image(header, number, binary, f"{where}: image {number}")


def _coloured_images(header: dict[str, Any]) -> list[int]:
    """Return the distinct numbers of the images that are colour textures of materials."""
    textures = [
        each.get("pbrMetallicRoughness", {}).get("baseColorTexture") for each in header.get("materials", [])
    ]
    sources = [header["textures"][each["index"]].get("source") for each in textures if each is not None]
    return sorted({number for number in sources if number is not None})


def _check_image(header: dict[str, Any], number: int, binary: bytes, where: str) -> None:
    """Refuse an embedded image that cannot be decoded; trimesh would silently replace it by grey.

    Images in separate files are checked when they are read.
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
    """Refuse nodes that do not form trees, as glTF requires, or trees that are too deep."""
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
    # Trimesh's OBJ reader processes all vertices for each group.
    vertices = len(re.findall(rb"^\s*v\s", data, re.MULTILINE))
    check_amount(where, "vertices times groups", vertices * groups, _VISITS)


def _check_ply(data: bytes, where: str) -> None:
    header, _, content = data.partition(b"end_header")
    counts = [int(count) for count in re.findall(rb"^element\s+\S+\s+(\S+)", header, re.MULTILINE)]
    # Each vertex and each face takes at least one byte, and in text, one line.
    if min(counts, default=0) < 0 or sum(counts) > len(content):
        raise ValueError(f"states {sum(counts)} elements in {len(content)} bytes")
    if b"ascii" in header and content.count(b"\n") > 2 * sum(counts) + PARTS:
        raise ValueError(f"states {sum(counts)} elements in {content.count(bytes([10]))} lines")


class _Neighbours(trimesh.resolvers.FilePathResolver):
    """Resolves files in the model's folder and below, as UTF-8; records their errors, which trimesh only logs."""

    def __init__(self, source: str) -> None:
        super().__init__(source)
        self.wrong: list[str] = []
        self.materials: dict[str, Surface] = {}
        """Surfaces of the MTL files that were read, by material name."""

    def get(self, name: str) -> bytes:
        try:
            content: bytes = super().get(self._written(name))
        except Exception as error:
            too_large = isinstance(error, RsbenchError)
            self.wrong.append(str(error) if too_large else f"{name}, which is missing or lies outside its folder")
            raise
        if name.lower().endswith(".mtl"):
            try:
                content, found = _library(_as_utf8(content), name)
            except RsbenchError as error:
                self.wrong.append(str(error))
                raise
            self.materials |= found
        return content

    def _written(self, name: str) -> str:
        """Normalise a file name: Windows exporters write backslashes, and glTF encodes names as URIs."""
        name = name.replace("\\", "/")
        return name if self.absolute(name).exists() else unquote(name)

    def absolute(self, name: str) -> Path:
        path: Path = super().absolute(name)  # raises where links or dots lead out of the folder
        if path.exists():
            if not path.is_file():
                raise ValueError(f"{name} is no file")
            check_amount(name, "bytes", path.stat().st_size, FILE_BYTES)
        return path


def _as_utf8(text: bytes) -> bytes:
    """Convert text of unknown encoding, UTF-8 if it is valid, else Latin-1, to UTF-8."""
    try:
        return text.decode("utf-8-sig").encode("utf-8")
    except UnicodeDecodeError:
        return text.decode("latin-1").encode("utf-8")


def read_mesh_file(path: Path) -> tuple[Any, dict[str, Surface]]:
    """Read a mesh file; return trimesh's scene and the surfaces by material name.

    Errors of trimesh are not converted.

    Raises:
        RsbenchError: the file or one that it refers to is missing or wrong.
    """
    if not path.is_file():
        raise RsbenchError(f"mesh file {path}: no such file (parameters.file is relative to the card)")
    content, surfaces = check_mesh_file(path)
    neighbours = _Neighbours(str(path))
    options = {"resolver": neighbours, "process": False}
    try:
        if content is None:
            model = trimesh.load_scene(str(path), **options)
        else:
            model = trimesh.load_scene(io.BytesIO(content), file_type=path.suffix.lower()[1:], **options)
    finally:
        if neighbours.wrong:
            raise RsbenchError(f"mesh file {path}: refers to {neighbours.wrong[0]}")
    if path.suffix.lower() == ".obj" and neighbours.materials:
        _check_names(content or path.read_bytes(), neighbours.materials, path)
    return model, surfaces | neighbours.materials


def _check_names(text: bytes, known: Mapping[str, Surface], path: Path) -> None:
    """Refuse material names that no MTL file defines; trimesh would silently use grey."""
    used = re.findall(rb"^\s*usemtl[ \t]+(.+?)\s*$", text, re.MULTILINE)
    missing = sorted({name.decode() for name in used} - set(known))
    if missing:
        raise RsbenchError(f"mesh file {path}: usemtl {missing[0]}: its .mtl has no such material")


_OPTIONS = {"-s": 3, "-o": 3, "-t": 3, "-mm": 2}
"""Largest number of values after an option of ``map_Kd``; other options have one."""


def _library(text: bytes, where: str) -> tuple[bytes, dict[str, Surface]]:
    """Return an MTL file without the options of its textures, and its surfaces by name.

    ``-s`` scales coordinates, ``-o`` is their offset, ``-clamp on`` clamps the texture to its border.

    Raises:
        RsbenchError: an option changes the colours of a texture.
    """
    lines, surfaces, name = list[str](), dict[str, Surface](), ""
    for number, line in enumerate(text.decode("utf-8").splitlines(), start=1):
        words = line.split()
        key = words[0].lower() if words else ""
        if key == "newmtl":
            name = " ".join(words[1:])
            surfaces[name] = Surface(name=name, linear=np.eye(2), offset=np.zeros(2))
        elif key == "map_kd":
            options, file = _map_options(line.split(maxsplit=1)[1:])
            if [float(each) for each in options.get("-mm", [])] not in ([], [0.0, 1.0]):
                raise RsbenchError(f"{where}:{number}: -mm changes the colours of a texture, which is not read")
            scale, offset = (
                np.array([float(each) for each in options.get(key, [])] or [usual] * 2)
                for key, usual in (("-s", 1.0), ("-o", 0.0))
            )
            wrap: Wrap = "clamp" if options.get("-clamp") == ["on"] else "repeat"
            surfaces[name] = Surface(
                name=name,
                linear=np.diag(np.append(scale, 1.0)[:2]),
                offset=np.append(offset, 0.0)[:2],
                wrap=(wrap, wrap),
            )
            line = f"map_Kd {file}"
        lines.append(line)
    return "\n".join(lines).encode(), surfaces


def _map_options(value: Sequence[str]) -> tuple[dict[str, list[str]], str]:
    """Parse the options of a texture and the name of its file, which may contain blanks."""
    options, rest = dict[str, list[str]](), value[0].strip() if value else ""
    while rest.startswith("-") and len(words := rest.split()) > 2:
        count = 1
        while count < _OPTIONS.get(words[0], 1) and len(words) > count + 2 and NUMBER.fullmatch(words[count + 1]):
            count += 1
        options[words[0]] = words[1 : 1 + count]
        rest = rest.split(maxsplit=1 + count)[1 + count]
    return options, rest


def _plain_polygons(text: bytes) -> bytes:
    """Return an OBJ with positive face indices and with non-convex polygons cut into triangles.

    Trimesh interprets negative indices relative to the end of the file, and splits all polygons into fans.
    """
    lines, counts = text.split(b"\n"), {b"v": 0, b"vt": 0, b"vn": 0}
    vertices, polygons = list[list[bytes]](), dict[int, list[tuple[int, list[int]]]]()
    for number, line in enumerate(lines):
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
            if words[0] == b"v":
                vertices.append(words[1:4])
        elif words and words[0] == b"f":
            if b"-" in line:
                words = [b"f", *(_from_one(word, counts) for word in words[1:])]
                lines[number] = b" ".join(words)
            if len(words) > 4:
                corners = [int(word.split(b"/")[0]) - 1 for word in words[1:]]
                polygons.setdefault(len(corners), []).append((number, corners))
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3) if polygons else np.zeros((0, 3))
    for same in polygons.values():
        found = points[np.array([corners for _, corners in same])]
        following = np.roll(found, -1, axis=1)
        normal = np.sum(np.cross(found, following), axis=1)  # Newell
        turns = np.cross(found - np.roll(found, 1, axis=1), following - found) @ normal[..., None]
        size = np.sum(normal**2, axis=-1)
        for k in np.flatnonzero(np.any(turns[..., 0] < -1e-9 * size[:, None], axis=1)):
            words = lines[same[k][0]].split()[1:]
            lines[same[k][0]] = b"\n".join(
                b"f " + b" ".join(words[each] for each in triangle) for triangle in _cut(found[k], normal[k])
            )
    return b"\n".join(lines)


def _from_one(word: bytes, counts: Mapping[bytes, int]) -> bytes:
    """Convert the negative indices of a corner ``v/vt/vn``, relative to the current counts, to positive ones."""
    kinds = zip(word.split(b"/"), counts.values(), strict=False)
    return b"/".join(b"%d" % (count + 1 + int(n)) if n.startswith(b"-") else n for n, count in kinds)


def _cut(polygon: FloatArray, normal: FloatArray) -> NDArray[np.intp]:
    """Triangulate a polygon (n, 3) to (m, 3) corner indices, with its orientation about the normal (3,)."""
    kept = np.delete(np.arange(3), np.argmax(np.abs(normal)))
    flat = np.ascontiguousarray(polygon[:, kept] - polygon[0, kept])
    found = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], dtype=np.uint32)).reshape(-1, 3)
    corners = polygon[found.astype(np.intp)]
    side = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ normal
    return np.where(side[:, None] < 0.0, found[:, ::-1], found).astype(np.intp)
