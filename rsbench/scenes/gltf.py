"""Parts of a glTF header that trimesh ignores: extensions that it cannot decode, and transforms of textures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import FloatArray

_TRANSFORM = "KHR_texture_transform"
_HARMLESS = (_TRANSFORM, "KHR_materials_", "KHR_lights_", "EXT_texture_webp")
"""Beginnings of extensions that may be required: we read them, or they say what a diffuse surface has not."""
_ARCHIVED = "KHR_materials_pbrSpecularGlossiness"


@dataclass(frozen=True, kw_only=True)
class TextureTransform:
    """Of texture coordinates, in glTF's own frame: u right, v down."""

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
