"""A scene from a mesh file of the user: glTF, GLB, OBJ, OFF, PLY or STL, read by trimesh.

The model is scaled and placed, optionally with ground below it and walls around it. Its surfaces are diffuse, or
glossy with the roughness in a glTF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from rsbench.components.imports import exception_text
from rsbench.core.errors import RsbenchError
from rsbench.scenes.mesh_files import TEXTURE, Surface, read_mesh_file
from rsbench.scenes.model import (
    ROUGHEST,
    SMOOTHEST,
    FloatArray,
    Material,
    SceneBuilder,
    SceneMesh,
    linear_to_srgb,
    srgb_to_linear,
)
from rsbench.scenes.parts import Piece, assemble, box, grid
from rsbench.scenes.surfaces import paint_palette
from rsbench.storage.untrusted_files import check_amount, check_size

_GROUND, _WALL = "cobbles", "brick"
_SUNK = 1e-3
"""Depth of the ground below the model, relative to the model's size, so that ground and base do not coincide."""
_APART, _HIGH = 4.0, 2.0
"""Distance from the model's axis to the walls, and their height, relative to the model's size."""


def standing(meshes: Sequence[SceneMesh], size: float | None) -> tuple[SceneMesh, ...]:
    """Return the model centred above the scene's origin, with its lowest point at z = 0.

    Args:
        meshes: meshes of the model; only vertices of triangles count for its bounding box.
        size: length of the longest side of that box, metres; None keeps it.
    """
    low, high = box_of(meshes)
    factor = 1.0 if size is None else size / float(np.max(high - low))
    foot = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    return tuple(replace(mesh, vertices=factor * (mesh.vertices - foot)) for mesh in meshes)


def box_of(meshes: Sequence[SceneMesh]) -> tuple[FloatArray, FloatArray]:
    """Return the bounding box of the triangles of meshes: least and largest coordinates (3,)."""
    used = [mesh.vertices[np.unique(mesh.faces)] for mesh in meshes]
    lows, highs = [part.min(axis=0) for part in used], [part.max(axis=0) for part in used]
    return np.min(lows, axis=0), np.max(highs, axis=0)


def surroundings(meshes: Sequence[SceneMesh], ground: bool, backdrop: bool, seed: int) -> tuple[SceneMesh, ...]:
    """Make cobbles below a model, and a square of brick walls around it, in proportion to its bounding box."""
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


# Rotations from the file's axes to a right-handed frame with z up.
_Z_UP = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
_SHEET = 1024  # columns of the sheet that holds colours of faces
_TRIANGLES = 1 << 22
_TEXTURES = 1 << 26
"""Largest number of pixels of all textures together."""


@dataclass(frozen=True, kw_only=True)
class MeshBuilder(SceneBuilder):
    """A mesh file, and the conversion of its axes and units to the scene frame."""

    file: str
    """Path of the mesh file, relative to the card, or absolute."""
    metres_per_unit: float = 1.0
    """Metres per unit of the file; ``size`` overrides it."""
    up_axis: Literal["x", "y", "z"] = "y"
    """The file's upward axis; glTF has y up."""
    heading_deg: float = 0.0
    """Rotation of the model about the vertical, degrees anticlockwise."""
    shading: Literal["flat", "smooth"] = "flat"
    """Whether triangles are shaded flat or with the file's smooth normals."""
    transparent: Literal["refuse", "opaque"] = "refuse"
    """Treatment of surfaces with an alpha mask or blending, since only opaque ones can be rendered."""
    gloss: Literal["none", "file"] = "none"
    """``file``: a clear coat with a glTF material's roughness, if that is 0.5 or less; ``none``: diffuse."""

    size: float | None = None
    """Longest side of the model's bounding box, metres, independent of the file's units."""
    place: Literal["file", "origin"] = "file"
    """``origin`` centres the model above the scene's origin, with its lowest point at z = 0."""
    ground: bool = False
    """Whether there are cobbles below the model."""
    backdrop: bool = False
    """Whether there are brick walls around the model, at four times its size."""

    def __post_init__(self) -> None:
        for name in ("metres_per_unit", "size"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} = {value}: must be positive")
        if self.size is not None and self.place == "file":
            raise ValueError('size: needs place = "origin"; with place = "file" use metres_per_unit')

    def build(self, seed: int, folder: Path) -> tuple[SceneMesh, ...]:
        """Return the textured meshes of a file in the scene frame, one for each part of its scene graph.

        Args:
            seed: seed of the textures of ground and walls.
            folder: folder to which the path of the file is relative.

        Raises:
            RsbenchError: the file or one that it refers to is missing or invalid, or has no triangles.
        """
        path = folder / Path(self.file).expanduser()
        try:
            with np.errstate(all="ignore"):  # values that are not finite are refused later
                meshes = self._meshes(path)
                if np.array_equal(*box_of(meshes)):
                    raise RsbenchError(f"mesh file {path}: all of it lies in one point")
                if self.place == "origin":
                    meshes = standing(meshes, self.size)
                return meshes + surroundings(meshes, self.ground, self.backdrop, seed)
        except RsbenchError:
            raise
        except Exception as error:  # trimesh raises various errors on a broken file, often late
            raise RsbenchError(f"mesh file {path}: cannot be read: {exception_text(error)}") from error

    def _meshes(self, path: Path) -> tuple[SceneMesh, ...]:
        model, surfaces = read_mesh_file(path)
        _check_size(model, path)
        angle = np.deg2rad(self.heading_deg)
        heading = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        axes = self.metres_per_unit * heading @ _Z_UP[self.up_axis]
        look, meshes = _Look(self, surfaces, {}), list[SceneMesh]()
        for node in sorted(model.graph.nodes_geometry):
            transform, name = model.graph[node]
            part = model.geometry[name]
            if isinstance(part, trimesh.Trimesh) and len(part.faces):
                meshes.append(_scene_mesh(str(node), part, axes, transform, look, path))
        if not meshes:
            raise RsbenchError(f"{path}: holds no triangles")
        return tuple(meshes)


class _Look(NamedTuple):
    """Data about appearance that the parts of a file share."""

    builder: MeshBuilder
    surfaces: dict[str, Surface]
    materials: dict[tuple[int, tuple[float, ...]], Material]
    """Materials made so far, by the id of trimesh's object and the colour that multiplies it."""


def _check_size(model: Any, path: Path) -> None:
    """Refuse a scene graph, which may contain a mesh many times, that is too large when expanded."""
    nodes = [model.geometry[model.graph[node][1]] for node in model.graph.nodes_geometry]
    triangles = sum(len(part.faces) for part in nodes if isinstance(part, trimesh.Trimesh))
    check_amount(f"mesh file {path}", "triangles", triangles, _TRIANGLES)


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
    # A reflection reverses the orientation of triangles; shading normals keep the side given in the file.
    faces = np.ascontiguousarray(faces[:, ::-1] if np.linalg.det(linear) < 0.0 else faces, dtype=np.int32)
    normals = _normals(part, linear, where) if look.builder.shading == "smooth" else None
    if part.visual.kind in ("vertex", "face"):
        return _coloured_faces(name, vertices, faces, normals, np.asarray(part.visual.face_colors)[:, :3])
    source = getattr(part.visual, "material", None)
    uv = getattr(part.visual, "uv", None)
    shades = _shades(part, where)
    plain = bool(np.all(shades == shades[:1]))
    key = id(source), tuple(shades[0].tolist()) if plain else ()
    surface = look.surfaces.get(str(getattr(source, "name", None)))
    if key not in look.materials:
        _check_alpha(source, part, where, look.builder.transparent)
        factor = shades[0] if plain else np.ones(3)
        material = _material(source, surface, factor, where, list(look.materials.values()))
        roughness = _roughness(source, where) if look.builder.gloss == "file" else None
        look.materials[key] = replace(material, roughness=roughness)
    material = look.materials[key]
    if not plain:
        if material.texture is not None:
            raise RsbenchError(
                f"{where} has vertex colours over a texture: bake them into it, or remove them on export"
            )
        colours = linear_to_srgb(srgb_to_linear(material.colour) * shades)
        colours = np.rint(255 * colours).astype(np.uint8)
        made = _coloured_faces(name, vertices, faces, normals, colours)
        return replace(made, material=replace(made.material, roughness=material.roughness))
    if material.texture is not None and (uv is None or not np.isfinite(uv).all()):
        raise RsbenchError(f"{where} has a texture but no finite texture coordinates")
    uv = None if uv is None else np.asarray(uv, dtype=np.float64)
    if uv is not None and surface is not None and material.texture is not None:
        uv = surface.coordinates(uv, _image(source).size, where)
    return SceneMesh(name=name, vertices=vertices, faces=faces, material=material, uv=uv, normals=normals)


def _image(source: Any) -> Any:
    """Return the colour texture of a trimesh material, or None."""
    pbr = isinstance(source, trimesh.visual.material.PBRMaterial)
    return source.baseColorTexture if pbr else getattr(source, "image", None)


def _shades(part: Any, where: str) -> FloatArray:
    """Return linear factors (m, 3) of the triangles from a glTF's vertex colours; ones (1, 3) without any."""
    colours = getattr(part.visual, "vertex_attributes", {}).get("color")
    if colours is None:
        return np.ones((1, 3))
    shades = _unit(colours)[:, :3][part.faces].mean(axis=1)
    if not (np.isfinite(shades).all() and shades.min() >= 0.0 and shades.max() <= 1.0):
        raise RsbenchError(f"{where} has vertex colours that are not between 0 and 1")
    return shades


def _normals(part: Any, linear: FloatArray, where: str) -> FloatArray:
    """Return the unit normals (n, 3) of the vertices in the scene frame."""
    try:
        normals = np.asarray(part.vertex_normals, dtype=np.float64) @ np.linalg.inv(linear)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    except np.linalg.LinAlgError as error:
        raise RsbenchError(f"{where} is flattened by its transform, so that it has no normals") from error
    if not np.isfinite(normals).all():
        raise RsbenchError(f"{where} has normals that are not finite")
    return normals


def _unit(colours: NDArray[Any]) -> FloatArray:
    """Convert colours from integers or floats to floats between 0 and 1."""
    most = np.iinfo(colours.dtype).max if np.issubdtype(colours.dtype, np.integer) else 1.0
    return np.asarray(colours, dtype=np.float64) / most


def _check_alpha(source: Any, part: Any, where: str, transparent: str) -> None:
    """Check that a material is opaque everywhere, unless ``transparent`` says to ignore alpha.

    Raises:
        RsbenchError: the material is transparent somewhere.
    """
    if transparent == "opaque" or source is None:
        return
    image, least = None, 1.0
    if isinstance(source, trimesh.visual.material.PBRMaterial):
        if source.alphaMode in ("MASK", "BLEND"):
            image = source.baseColorTexture
            least = 1.0 if source.baseColorFactor is None else float(source.baseColorFactor[3]) / 255
            colours = part.visual.vertex_attributes.get("color")
            least *= 1.0 if colours is None else float(_unit(colours)[:, 3:].min(initial=1.0))
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


def _material(
    source: Any, surface: Surface | None, shade: FloatArray, where: str, others: list[Material]
) -> Material:
    """Return the diffuse part of a glTF or MTL material times ``shade``; other properties are ignored."""
    if source is None:
        return Material(name="plain")
    if isinstance(source, trimesh.visual.material.MultiMaterial):
        raise RsbenchError(f"{where} has several materials in one part: export it as glTF instead")
    name = str(getattr(source, "name", None) or "unnamed") if surface is None else surface.name
    image = _image(source)
    if isinstance(source, trimesh.visual.material.PBRMaterial):
        linear = np.ones(3) if surface is None or surface.factor is None else surface.factor
    else:
        # If the file has Kd, it multiplies the texture; Kd is sRGB like textures.
        stated = "kd" in getattr(source, "kwargs", {})
        diffuse = np.asarray(getattr(source, "diffuse", (204, 204, 204)), dtype=np.float64)[:3] / 255
        linear = srgb_to_linear(diffuse) if image is None or stated else np.ones(3)
    linear = linear * shade
    if image is None:
        r, g, b = (float(value) for value in linear_to_srgb(linear))
        return Material(name=name, colour=(r, g, b))
    texture = _texture(image, linear, where, others)
    return Material(name=name, texture=texture if surface is None else surface.wrapped(texture))


def _roughness(source: Any, where: str) -> float | None:
    """Return the roughness of a glTF material, at least ``SMOOTHEST``; None (diffuse) above ``ROUGHEST``.

    The result is None for other files too.

    Raises:
        RsbenchError: the material is metallic or has a roughness map, which a clear coat cannot represent.
    """
    if not isinstance(source, trimesh.visual.material.PBRMaterial):
        return None
    if source.metallicRoughnessTexture is not None:
        raise RsbenchError(
            f'{where} has a map of roughness, and gloss = "file" takes one number for each material: export it '
            "without, or leave gloss out"
        )
    # Absent factors are 1, by glTF's specification.
    factors = (source.metallicFactor, source.roughnessFactor)
    metal, roughness = (1.0 if each is None else float(each) for each in factors)
    if metal > 0.0:
        raise RsbenchError(
            f'{where} is metal (metallicFactor = {metal:g}), and gloss = "file" takes clear coats on diffuse '
            "surfaces only: set it to 0, or leave gloss out"
        )
    return max(roughness, SMOOTHEST) if roughness <= ROUGHEST else None


def _texture(image: Any, factor: FloatArray, where: str, others: list[Material]) -> NDArray[np.uint8]:
    """Return the sRGB texture (h, w, 3) of an image times a linear factor, after checking the image's size."""
    check_size(f"{where}: texture", image.size, most=TEXTURE)
    taken = sum(other.texture.size // 3 for other in others if other.texture is not None)
    pixels = taken + image.size[0] * image.size[1]
    check_amount(where, "pixels of all textures", pixels, _TEXTURES)
    texture = np.array(image.convert("RGB"), dtype=np.uint8)
    if not np.all(factor == 1.0):
        levels = np.rint(linear_to_srgb(srgb_to_linear(np.arange(256)[:, None] / 255.0) * factor) * 255)
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
    """Make a mesh with one colour per face, using a texture with one texel per colour."""
    palette, index = np.unique(colours, axis=0, return_inverse=True)
    index = np.asarray(index).ravel()
    rows = -(-len(palette) // _SHEET)
    sheet = np.zeros((rows * _SHEET, 3), dtype=np.uint8)
    sheet[: len(palette)] = palette
    # At the centre of a texel, bilinear interpolation gives exactly its colour; v points up from the last row.
    centre = np.stack([(index % _SHEET + 0.5) / _SHEET, 1 - (index // _SHEET + 0.5) / rows], axis=1)
    return SceneMesh(
        name=name,
        vertices=vertices[faces].reshape(-1, 3),
        faces=np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3),
        material=Material(name="face colours", texture=sheet.reshape(rows, _SHEET, 3)),
        uv=np.repeat(centre, 3, axis=0),
        normals=None if normals is None else normals[faces].reshape(-1, 3),
    )
