"""Rays between eyes and points of our own choice: what stands between them, and what surface is met."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LEAST_COMPONENT

REACH = 1.0 - 1e-4
"""Share of the way to the point that must be free. The rest is the point's own surface: rays and points are
rounded to float32, so a ray that grazes a surface meets it a little early."""


class Surfaces(NamedTuple):
    """What rays (n,) meet first."""

    normals: NDArray[np.float32]
    """(n, 3) of the triangles, towards the eye, world frame; 0 where nothing is met."""
    instances: NDArray[np.uint16]
    """(n,) numbers of meshes from 1, in the order of ``MitsubaScene.instances``; 0 where nothing is met."""


@dataclass(frozen=True)
class SceneRays:
    """Rays through a scene; eyes and points (n, 3) are in its frame, metres."""

    scene: MitsubaScene

    def blocked(self, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
        """Whether (n,) a surface stands before the points."""
        found = []
        for ray in _rays(eyes, points):
            ray.maxt = REACH
            found.append(np.atleast_1d(np.array(self.scene.scene.ray_test(ray), dtype=np.bool_)))
        return np.concatenate(found)

    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray:
        """Share (n,) of the way to the points, or beyond them, at which the first surface is met; inf: at none."""
        hits = [self.scene.scene.ray_intersect_preliminary(ray, coherent=True) for ray in _rays(eyes, points)]
        met = np.concatenate([np.atleast_1d(np.array(hit.t, dtype=np.float64)) for hit in hits])
        return np.where(np.isfinite(met), met, np.inf)

    def surfaces(self, eyes: FloatArray, points: FloatArray) -> Surfaces:
        """What is met on the way to the points and beyond."""
        import mitsuba as mi

        normals, instances = [], []
        for ray in _rays(eyes, points):
            hit = self.scene.scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True)
            normal, way = (np.array(each, dtype=np.float32).reshape(3, -1) for each in (hit.n, ray.d))
            normal *= np.where(np.sum(normal * way, axis=0) > 0, np.float32(-1.0), np.float32(1.0))
            numbers = self._numbers(hit)
            normal[:, numbers == 0] = 0.0
            normals.append(normal.T + np.float32(0.0))  # no -0
            instances.append(numbers)
        return Surfaces(np.concatenate(normals), np.concatenate(instances))

    def _numbers(self, hit: Any) -> NDArray[np.uint16]:
        import drjit as dr
        import mitsuba as mi

        if not _wide():
            return np.array([_number(hit.shape) if hit.is_valid() else 0], dtype=np.uint16)
        keys = np.array(dr.reinterpret_array(mi.UInt32, self.scene.scene.shapes_dr()))
        table = np.zeros(np.max(keys) + 1, dtype=np.uint16)
        table[keys] = [_number(shape) for shape in self.scene.scene.shapes()]
        return table[np.array(dr.reinterpret_array(mi.UInt32, hit.shape))]


def _number(shape: Any) -> int:
    return 1 + int(str(shape.id()).removeprefix("mesh"))


def _wide() -> bool:
    """Whether the backend traces arrays of rays."""
    import drjit as dr
    import mitsuba as mi

    return bool(dr.is_jit_v(mi.Float))


def _rays(eyes: FloatArray, points: FloatArray) -> list[Any]:
    """Rays whose parameter is 1 at the points: one array of all of them, or each alone."""
    import mitsuba as mi

    origins, ways = np.zeros((2, 3, len(points)), dtype=np.float32)
    for k in range(3):
        origins[k] = eyes[:, k]
        np.subtract(points[:, k], eyes[:, k], out=ways[k], casting="same_kind")
    ways[np.abs(ways) < LEAST_COMPONENT] = 0.0
    if _wide():
        return [mi.Ray3f(mi.Point3f(origins), mi.Vector3f(ways))]
    return [mi.Ray3f(o, d) for o, d in zip(origins.T.tolist(), ways.T.tolist(), strict=True)]
