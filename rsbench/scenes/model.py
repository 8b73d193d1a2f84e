"""The parts of a scene: textured meshes, sun, sky and viewpoints.

A scene builder returns meshes in the *scene frame*: right-handed, z up, metres, ground near z = 0.
``Scene.seen_from`` moves it into the *world frame* of the conventions (x right, y down, z forward, the rig's
body at time 0), which is the only frame that renderers see.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import so3
from rsbench.core.errors import RsbenchError

FloatArray = NDArray[np.float64]
SMOOTHEST, ROUGHEST = 0.05, 0.5
"""Least and largest roughness of glossy surfaces. The sun's reflection on a smoother surface is too small for
pixels. Above 0.5 the model, which has no interreflection between facets, loses more light than it reflects: such
surfaces are diffuse."""
_UNIT = 1e-6
"""Tolerance of the norm of quaternions, for rounding in files."""


def srgb_to_linear(srgb: ArrayLike) -> FloatArray:
    """Convert sRGB values in [0, 1] to linear intensity (IEC 61966-2-1)."""
    values = np.asarray(srgb, dtype=np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.0) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: NDArray[Any]) -> NDArray[Any]:
    """Convert linear intensity to sRGB, the inverse of ``srgb_to_linear``; values keep their type."""
    curve = 1.055 * np.power(np.maximum(linear, 0.0031308), 1 / 2.4) - 0.055
    return np.asarray(np.where(linear <= 0.0031308, 12.92 * linear, curve))


@dataclass(frozen=True, kw_only=True)
class Material:
    """A surface that is visible from both sides: diffuse, or glossy if it has a ``roughness``.

    Raises:
        RsbenchError: ``roughness`` is out of its range.
    """

    name: str
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    """sRGB reflectance in [0, 1]; ignored if there is a ``texture``."""
    texture: NDArray[np.uint8] | None = None
    """(h, w, 3) sRGB, repeated in both directions; row 0 is the top, uv v points up."""
    roughness: float | None = None
    """None for diffuse surfaces, else glTF's roughness in [0.05, 0.5]: that of a clear coat of refractive index
    1.5 with a Trowbridge-Reitz (GGX) distribution of microfacets, alpha = roughness squared."""

    def __post_init__(self) -> None:
        if self.roughness is not None and not SMOOTHEST <= self.roughness <= ROUGHEST:
            raise RsbenchError(
                f"material {self.name!r}: roughness = {self.roughness}: allowed are {SMOOTHEST} to {ROUGHEST}; "
                "without one it is diffuse"
            )


@dataclass(frozen=True, kw_only=True)
class SceneMesh:
    """Triangles of one material."""

    name: str
    vertices: FloatArray
    """(n, 3) metres."""
    faces: NDArray[np.int32]
    """(m, 3) vertex indices."""
    material: Material
    uv: FloatArray | None = None
    """(n, 2) texture coordinates, v up; one unit is one repeat of the texture."""
    normals: FloatArray | None = None
    """(n, 3) unit shading normals; absent = flat shading."""
    mover: int = 0
    """Number, from 1, of the moving object to which the mesh belongs; 0 for static meshes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Environment:
    """Light from all directions, instead of a two-colour sky."""

    radiance: NDArray[np.float32]
    """(H + 1, 2 H, 3) linear RGB of a lat-long map; the first row is the zenith, the last the nadir."""
    frame_from_map: FloatArray
    """(3, 3) rotation from the map's axes: x right, y down, z forward to the centre of the map."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """A directional sun and a two-colour sky, linear RGB."""

    sun_direction: tuple[float, float, float]
    """Unit vector towards the sun."""
    sun_irradiance: tuple[float, float, float] = (2.6, 2.4, 2.1)
    sky_zenith: tuple[float, float, float] = (0.25, 0.45, 0.85)
    sky_horizon: tuple[float, float, float] = (0.75, 0.85, 0.95)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector to the zenith, in the frame of the scene."""
    environment: Environment | None = field(default=None, repr=False)
    """Environment map without the sun, which replaces the sky colours if given."""

    @property
    def mean_sky(self) -> FloatArray:
        """Cosine-weighted mean radiance (3,) of the sky over the upper hemisphere: E / pi on level ground.

        The integral of (horizon + (zenith - horizon) cos) cos over it is pi horizon / 3 + 2 pi zenith / 3.
        """
        return np.asarray(self.sky_horizon) / 3.0 + 2.0 * np.asarray(self.sky_zenith) / 3.0


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Pose of the rig's body at time 0: at ``eye``, looking at ``target``, with a level horizon."""

    eye: tuple[float, float, float]
    """Position of the rig's body at time 0, in the scene frame (z up), metres."""
    target: tuple[float, float, float]
    """Point at which the body looks, in the scene frame, metres."""

    def world_from_scene(self) -> tuple[FloatArray, FloatArray]:
        """Return rotation (3, 3) and translation (3,) with ``X_world = R @ X_scene + t``.

        Raises:
            RsbenchError: the view is vertical or ``eye`` equals ``target``, so the horizon is undefined.
        """
        eye = np.asarray(self.eye, dtype=np.float64)
        forward = np.asarray(self.target, dtype=np.float64) - eye
        right = np.cross(forward, (0.0, 0.0, 1.0))
        if np.linalg.norm(right) <= 1e-9 * max(1.0, float(np.linalg.norm(forward))):
            raise RsbenchError(f"viewpoint looks along the vertical: eye = {self.eye}, target = {self.target}")
        z = forward / np.linalg.norm(forward)
        x = right / np.linalg.norm(right)
        rotation = np.stack([x, np.cross(z, x), z])
        return rotation, -rotation @ eye


@dataclass(frozen=True, kw_only=True)
class Start:
    """Pose of the rig's body at time 0 on a trajectory, relative to a viewpoint."""

    position: tuple[float, float, float]
    """Position in the frame of the viewpoint, metres: x right, y down, z forward from its eye."""
    quaternion: tuple[float, float, float, float]
    """Rotation (w, x, y, z) from the body's axes to that frame."""
    absolute: bool = False
    """Whether the pose is relative to the scene frame instead of the viewpoint."""

    def __post_init__(self) -> None:
        if abs(float(np.linalg.norm(self.quaternion)) - 1.0) > _UNIT:
            raise ValueError(f"quaternion = {self.quaternion}: must be of length 1")

    def world_from_scene(self, viewpoint: Viewpoint) -> tuple[FloatArray, FloatArray]:
        """Return rotation (3, 3) and translation (3,), as in ``Viewpoint``."""
        turn, position = so3.from_quaternion(self.quaternion).T, np.asarray(self.position)
        R, t = (np.eye(3), np.zeros(3)) if self.absolute else viewpoint.world_from_scene()
        return turn @ R, turn @ (t - position)


class SceneBuilder(ABC):
    """Builds the meshes of a scene. Subclasses are frozen dataclasses whose fields a scene card may set."""

    closed: ClassVar[bool] = False
    """Whether the meshes depend only on parameters and seed and can be cached; used for our builders only."""

    @abstractmethod
    def build(self, seed: int, folder: Path) -> Sequence[SceneMesh]:
        """Return meshes in the scene frame: right-handed, z up, metres, ground near z = 0.

        Args:
            seed: seed of the card; the same seed gives the same arrays.
            folder: folder of the card, to which paths in parameters are relative.
        """


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Meshes and light in one frame, and named viewpoints in the scene frame."""

    name: str
    meshes: tuple[SceneMesh, ...]
    light: Light
    viewpoints: dict[str, Viewpoint] = field(default_factory=dict)

    @property
    def glossy(self) -> bool:
        """Whether any surface is glossy."""
        return any(mesh.material.roughness is not None for mesh in self.meshes if mesh.faces.size)

    def seen_from(self, viewpoint: Viewpoint, start: Start | None = None) -> Scene:
        """Return the scene in the world frame, whose origin and axes are those of the body at time 0."""
        placed = viewpoint.world_from_scene() if start is None else start.world_from_scene(viewpoint)
        rotation, translation = placed
        meshes = tuple(
            replace(
                mesh,
                vertices=mesh.vertices @ rotation.T + translation,
                normals=None if mesh.normals is None else mesh.normals @ rotation.T,
            )
            for mesh in self.meshes
        )
        own = self.light.environment
        light = replace(
            self.light,
            environment=None if own is None else replace(own, frame_from_map=rotation @ own.frame_from_map),
            sun_direction=tuple(rotation @ np.asarray(self.light.sun_direction)),
            up=tuple(rotation @ np.asarray(self.light.up)),
        )
        return replace(self, meshes=meshes, light=light, viewpoints={})
