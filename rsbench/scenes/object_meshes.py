"""Objects of a scene that move by themselves: one of its meshes, or a mesh file or a textured box put into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rsbench.components.cards import choices
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.scenes.model import FloatArray, Material, Scene, SceneMesh
from rsbench.scenes.surfaces import fractal_noise, to_bytes

MOST_MOVING = 64
"""Objects of a sequence."""
_PIXELS = 256
Vector = tuple[float, float, float]
_WORLD_FROM_SCENE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns axes x right, y forward, z up into x right, y down, z forward."""


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """A mesh file of the user, see ``scenes.mesh.MeshBuilder``."""

    file: str
    """Path of the mesh file, relative to the dataset's card, or absolute; in a sequence.json the name alone."""
    size: float | None = None
    """Longest edge of its box, metres; absent, as the file has it, times ``metres_per_unit``."""
    metres_per_unit: float = 1.0
    """Metres of one unit of the file."""
    up_axis: Literal["x", "y", "z"] = "y"
    """The file's upward axis; glTF has y up."""
    shading: Literal["flat", "smooth"] = "flat"
    """Whether triangles are shaded flat or with the file's smooth normals."""
    transparent: Literal["refuse", "opaque"] = "refuse"
    """What becomes of surfaces that are cut out or blended by an alpha: the file is refused, or they are rendered
    opaque."""

    def __post_init__(self) -> None:
        if not Path(self.file).name:
            raise ValueError(f"moving: mesh.file = {self.file!r}: must name a file")
        for name in ("size", "metres_per_unit"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"moving: mesh.{name} = {value}: must be positive")

    @property
    def name(self) -> str:
        """File name without folders."""
        return Path(self.file).name

    def meshes(self) -> tuple[SceneMesh, ...]:
        """Its parts, in a frame with z up whose origin is the middle of their box.

        Raises:
            RsbenchError: see ``MeshBuilder.build``.
        """
        from rsbench.scenes.mesh import MeshBuilder, box_of  # which load trimesh

        made = MeshBuilder(**asdict(self), place="origin").build(0, Path())
        middle = np.mean(box_of(made), axis=0)
        return tuple(replace(mesh, vertices=mesh.vertices - middle) for mesh in made)


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid thing that moves."""

    position: Vector
    """The point about which the object turns, the middle of the box or of the box around a mesh: in the world
    frame at time 0 (x right, y down, z forward), metres."""
    instance: str = ""
    """Name of a mesh of the scene that moves; give this, ``box`` or ``mesh``."""
    box: Vector | None = None
    """Edges along x, y, z of a textured box that moves, metres."""
    mesh: MeshFile | None = None
    """Mesh file of an object that moves: upright, its x to the right."""
    attitude_deg: Vector = (0.0, 0.0, 0.0)
    """Rotation vector by which the box, or the mesh of a file, is turned at time 0."""
    texture_seed: int = 0
    """Seed of the texture of the box."""

    def __post_init__(self) -> None:
        if [bool(self.instance), self.box is not None, self.mesh is not None].count(True) != 1:
            raise ValueError("moving: one of 'instance', 'box' and 'mesh' is needed")
        if not np.all(np.isfinite([self.position, self.box or self.position, self.attitude_deg])):
            raise ValueError("moving: position, box and attitude_deg must be finite numbers")
        if self.box is not None and not min(self.box) > 0.0:
            raise ValueError(f"moving: box = {list(self.box)}: edges must be positive")
        if self.instance and any(self.attitude_deg):
            raise ValueError(
                "moving: attitude_deg is of a box or a mesh file; an instance stays as the scene has it"
            )
        if self.texture_seed < 0:
            raise ValueError(f"moving: texture_seed = {self.texture_seed}: must not be negative")


def with_moving(scene: Scene, bodies: Sequence[Body]) -> Scene:
    """A scene in the world frame at time 0 whose meshes know to which body they belong.

    Raises:
        RsbenchError: a mesh that the scene does not have, or that moves twice; a mesh file that cannot be read.
    """
    meshes = list(scene.meshes)
    for number, body in enumerate(bodies, start=1):
        if body.box is not None:
            meshes.append(_box(body, body.box, number))
            continue
        if body.mesh is not None:
            meshes += _placed(body.mesh.meshes(), body, number)
            continue
        own = [place for place, mesh in enumerate(meshes) if mesh.name == body.instance and mesh.faces.size]
        if not own:
            names = choices(body.instance, {mesh.name for mesh in scene.meshes if mesh.faces.size})
            raise RsbenchError(f"moving: scene {scene.name!r} has no mesh {body.instance!r}{names}")
        for place in own:
            if meshes[place].mover:
                raise RsbenchError(f"moving: instance {body.instance!r} moves twice")
            meshes[place] = replace(meshes[place], mover=number)
    return replace(scene, meshes=tuple(meshes))


def _placed(meshes: Sequence[SceneMesh], body: Body, number: int) -> list[SceneMesh]:
    """Meshes of a frame with z up, whose origin comes to the position of a body."""
    turn = so3.exp(np.deg2rad(body.attitude_deg)) @ _WORLD_FROM_SCENE
    return [
        replace(
            mesh,
            name=f"moving_{number}: {mesh.name}",
            vertices=mesh.vertices @ turn.T + body.position,
            normals=None if mesh.normals is None else mesh.normals @ turn.T,
            mover=number,
        )
        for mesh in meshes
    ]


def _box(body: Body, edges: Vector, number: int) -> SceneMesh:
    """Six sides, each with a part of one texture of its own; the longest edge is half a repeat."""
    corners, uv, faces = list[FloatArray](), list[FloatArray](), list[list[int]]()
    for side, (axis, sign) in enumerate((axis, sign) for axis in range(3) for sign in (-1.0, 1.0)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for along, up in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            corner = np.zeros(3)
            corner[[axis, u, v]] = sign, along, up
            corners.append(0.5 * corner * edges)
            uv.append(0.25 * np.array([along * edges[u], up * edges[v]]) / max(edges) + [0.37 * side, 0.61 * side])
        faces += [[4 * side, 4 * side + 1, 4 * side + 2], [4 * side, 4 * side + 2, 4 * side + 3]]
    turned = np.array(corners) @ so3.exp(np.deg2rad(body.attitude_deg)).T
    name = f"moving_{number}"
    return SceneMesh(
        name=name,
        vertices=turned + body.position,
        faces=np.array(faces, dtype=np.int32),
        material=Material(name=name, texture=_texture(body.texture_seed)),
        uv=np.array(uv),
        mover=number,
    )


def _texture(seed: int) -> NDArray[np.uint8]:
    rng, shape = np.random.default_rng([seed, 1919]), (_PIXELS, _PIXELS)
    tone, hue, blue = (fractal_noise(rng, shape, (8, 8), 5, 0.8) for _ in range(3))
    return to_bytes(np.stack([0.5 + 0.4 * tone, 0.45 + 0.35 * tone + 0.12 * hue, 0.35 + 0.3 * tone + 0.12 * blue]))
