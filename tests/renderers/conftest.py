"""Small scenes and motions for the renderer tests; poses come from formulas written here, not from the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsbench.scenes.model import Light, Material, Scene, SceneMesh

FloatArray = NDArray[np.float64]
Quad = Callable[..., SceneMesh]
Poses = tuple[FloatArray, FloatArray]

SUN = Light(sun_direction=(0.4, -0.7, -0.6), up=(0.0, -1.0, 0.0))


def make_quad(corners: Any, material: Material | None = None, **extra: Any) -> SceneMesh:
    """Rectangle of four corners in order; its uv is (0, 1) at the first, (1, 1) at the second, v up."""
    return SceneMesh(
        name=extra.pop("name", "quad"),
        vertices=np.asarray(corners, dtype=np.float64),
        faces=np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32),
        material=Material(name="grey") if material is None else material,
        uv=extra.pop("uv", np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])),
        **extra,
    )


def make_solid(
    name: str, solid: trimesh.Trimesh, place: Any, smooth: bool = False, colour: Any = (0.8, 0.8, 0.8)
) -> SceneMesh:
    return SceneMesh(
        name=name,
        vertices=np.asarray(solid.vertices) + place,
        faces=np.asarray(solid.faces, dtype=np.int32),
        material=Material(name=name, colour=colour),
        normals=np.asarray(solid.vertex_normals) if smooth else None,
    )


@pytest.fixture(scope="session")
def quad() -> Quad:
    return make_quad


@pytest.fixture(scope="session")
def solid() -> Callable[..., SceneMesh]:
    return make_solid


@pytest.fixture(scope="session")
def town() -> Scene:
    """Textured ground, boxes and a smooth sphere, in the world frame (y down)."""
    noise = np.random.default_rng(5).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    ground = make_quad(
        [[-20, 1.5, 30], [20, 1.5, 30], [20, 1.5, -2], [-20, 1.5, -2]],
        Material(name="ground", texture=noise),
        uv=np.array([[0.0, 8.0], [10.0, 8.0], [10.0, 0.0], [0.0, 0.0]]),
    )
    box = trimesh.creation.box((1.0, 2.0, 1.0))
    boxes = [make_solid(f"box{i}", box, (2.0 * i - 3.0, 0.5, 5.0 + i), colour=(0.7, 0.5, 0.3)) for i in range(4)]
    sphere = make_solid("sphere", trimesh.creation.icosphere(2), (0.3, 0.2, 4.0), True, (0.2, 0.4, 0.8))
    return Scene(name="town", meshes=(ground, *boxes, sphere), light=SUN)


@pytest.fixture(scope="session")
def room() -> Scene:
    """Closed box around the camera, so that light bounces and no ray misses but those through the missing lid."""
    walls = trimesh.creation.box((6.0, 4.0, 8.0))
    walls.update_faces(walls.face_normals[:, 1] > -0.5)
    ball = make_solid("ball", trimesh.creation.icosphere(1), (0.5, 0.8, 2.0), colour=(0.9, 0.9, 0.2))
    inside = make_solid("walls", walls, (0, 0, 0), colour=(0.8, 0.3, 0.3))
    return Scene(name="room", meshes=(inside, ball), light=SUN)


@pytest.fixture(scope="session")
def row_poses() -> Callable[..., Poses]:
    """Poses of linear motion: R = exp(tau w), t = start + tau d, tau = ratio * row / height."""

    def make(
        height: int, w: Any = (0, 0, 0), d: Any = (0, 0, 0), start: Any = (0, 0, 0), ratio: float = 0.8
    ) -> Poses:
        tau = ratio * np.arange(height)[:, None] / height
        R = Rotation.from_rotvec(tau * np.asarray(w, dtype=np.float64)).as_matrix()
        return R, np.asarray(start) + tau * np.asarray(d, dtype=np.float64)

    return make
