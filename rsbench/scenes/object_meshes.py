"""Moving objects of a scene: one of its meshes, or an added mesh file or textured box."""

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
"""Largest number of moving objects of a sequence."""
_PIXELS = 256
Vector = tuple[float, float, float]
_WORLD_FROM_SCENE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Rotation from axes x right, y forward, z up to x right, y down, z forward."""


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """A mesh file of the user, see ``scenes.mesh.MeshBuilder``."""

    file: str
    """Path of the mesh file, absolute or relative to the dataset's card; in a sequence.json only its name."""
    size: float | None = None
    """Longest edge of its bounding box, metres; by default that in the file times ``metres_per_unit``."""
    metres_per_unit: float = 1.0
    """Metres per unit of the file."""
    up_axis: Literal["x", "y", "z"] = "y"
    """The file's upward axis; glTF has y up."""
    shading: Literal["flat", "smooth"] = "flat"
    """Whether triangles are shaded flat or with the file's smooth normals."""
    transparent: Literal["refuse", "opaque"] = "refuse"
    """Treatment of surfaces with an alpha mask or blending: refuse the file, or render them opaque."""

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
        """Return the parts in a frame with z up whose origin is the centre of their bounding box.

        Raises:
            RsbenchError: see ``MeshBuilder.build``.
        """
        from rsbench.scenes.mesh import MeshBuilder, box_of  # imported here because it loads trimesh

        made = MeshBuilder(**asdict(self), place="origin").build(0, Path())
        middle = np.mean(box_of(made), axis=0)
        return tuple(replace(mesh, vertices=mesh.vertices - middle) for mesh in made)


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid moving object."""

    position: Vector
    """Centre of rotation, and centre of the box or of the bounding box of a mesh file: in the world frame at time
    0 (x right, y down, z forward), metres."""
    instance: str = ""
    """Name of a mesh of the scene that moves; exactly one of this, ``box`` and ``mesh`` is needed."""
    box: Vector | None = None
    """Edge lengths along x, y, z of a moving textured box, metres."""
    mesh: MeshFile | None = None
    """Mesh file of a moving object, which is upright with its x axis to the right if ``attitude_deg`` is zero."""
    attitude_deg: Vector = (0.0, 0.0, 0.0)
    """Rotation vector of the attitude of the box or mesh file at time 0, degrees."""
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
    """Add the bodies to a scene in the world frame at time 0, and set ``mover`` of their meshes.

    Raises:
        RsbenchError: the scene has no mesh of this name, a mesh moves twice, or a mesh file cannot be read.
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
    """Transform meshes from a frame with z up to the world frame, with their origin at the body's position."""
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
    """Make a box whose sides show different parts of one texture; its longest edge covers half a repeat."""
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
