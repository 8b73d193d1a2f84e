"""Limits of mesh files: the size that a file states, checked before trimesh reads it."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

from rsbench.core.errors import RsbenchError
from rsbench.scenes.gltf import TextureTransform, check_extensions, texture_transforms
from rsbench.storage.untrusted_files import FILE_BYTES, check_amount, check_image_size, parse_json, read_bytes

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
    """Nodes must be trees, as glTF asks, and not so deep that the way to each node takes long."""
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
