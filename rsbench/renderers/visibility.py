"""Visibility of points from camera centres, the surfaces that rays hit, and collisions of a moving rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.components.compiled import compiled
from rsbench.core.geometry import MovingObject, RelativeMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import inverse, transform
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.renderers.mitsuba_modules import dr, mi
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LEAST_COMPONENT

REACH = 1.0 - 1e-4
"""Share of the distance to the point that must be unoccluded. The rest may contain the point's own surface: rays
and points are rounded to float32, so a grazing ray hits the surface slightly too early."""


class Surfaces(NamedTuple):
    """First surfaces that n rays hit."""

    normals: NDArray[np.float32]
    """(n, 3) normals of the triangles, towards the eye, world frame; 0 for no hit."""
    instances: NDArray[np.uint16]
    """(n,) numbers of meshes from 1, in the order of ``MitsubaScene.instances``; 0 for no hit."""


@dataclass(frozen=True)
class SceneRays:
    """Casts rays from eyes (n, 3) to points (n, 3), in the frame of the scene, metres."""

    scene: MitsubaScene
    objects: Sequence[MovingObject] = ()
    """The scene's moving objects; if empty, rays only hit the static scene."""

    def blocked(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> NDArray[np.bool_]:
        """Return whether (n,) a surface occludes the points at times (n,), which moving objects require."""
        found = blocked(self.scene.scene, eyes, points)
        for scene, each in zip(self.scene.objects, self._objects(tau), strict=False):
            left = np.flatnonzero(~found)
            own = inverse(each.world_from_object(np.asarray(tau)[left]))
            found[left] = blocked(scene, transform(own, eyes[left]), transform(own, points[left]))
        return found

    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray:
        """Return the distance (n,) to the first static surface on each ray, relative to the point's; inf: none.

        Moving objects are ignored.
        """
        hits = [self.scene.scene.ray_intersect_preliminary(ray, coherent=True) for ray in _rays(eyes, points)]
        met = np.concatenate([np.atleast_1d(np.array(hit.t, dtype=np.float64)) for hit in hits])
        return np.where(np.isfinite(met), met, np.inf)

    def surfaces(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> Surfaces:
        """Return the first surfaces on the rays to the points and beyond; ``tau`` as for ``blocked``."""
        met = _met(self.scene.scene, eyes, points)
        for scene, each in zip(self.scene.objects, self._objects(tau), strict=False):
            pose = each.world_from_object(np.asarray(tau))
            own = inverse(pose)
            other = _met(scene, transform(own, eyes), transform(own, points))
            nearer = other.distance < met.distance
            turned = (pose.R @ other.normals[..., None])[..., 0].astype(np.float32)
            met.normals[nearer], met.instances[nearer] = turned[nearer], other.instances[nearer]
            met.distance[nearer] = other.distance[nearer]
        return Surfaces(met.normals, met.instances)

    def _objects(self, tau: FloatArray | None) -> Sequence[MovingObject]:
        if self.objects and tau is None:
            raise ValueError("objects move: rays need times")
        return self.objects


class _Met(NamedTuple):
    normals: NDArray[np.float32]
    instances: NDArray[np.uint16]
    distance: NDArray[np.float32]
    """(n,) distance to the hit, relative to the distance to the point."""


def blocked(scene: Any, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """Implement ``SceneRays.blocked`` for one Mitsuba scene."""
    found = [np.zeros(0, dtype=np.bool_)]
    for ray in _rays(eyes, points):
        ray.maxt = REACH
        found.append(np.atleast_1d(np.array(scene.ray_test(ray, coherent=True), dtype=np.bool_)))
    return np.concatenate(found)


def _met(scene: Any, eyes: FloatArray, points: FloatArray) -> _Met:
    """Implement ``SceneRays.surfaces`` for one Mitsuba scene."""
    found = []
    for ray in _rays(eyes, points):
        hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True)
        dr.eval(hit.n, hit.t, hit.shape)  # in one call: separate evaluations would trace the rays again
        normals, directions = (np.array(each, dtype=np.float32).reshape(3, -1) for each in (hit.n, ray.d))
        numbers, distance = _numbers(scene, hit), np.atleast_1d(np.array(hit.t, dtype=np.float32))
        found.append((_towards_eyes(normals, directions, numbers), numbers, distance))
    return _Met(*(each[0] if len(each) == 1 else np.concatenate(each) for each in zip(*found, strict=True)))


def _numbers(scene: Any, hit: Any) -> NDArray[np.uint16]:
    if not _wide():
        return np.array([_number(hit.shape) if hit.is_valid() else 0], dtype=np.uint16)
    keys = np.array(dr.reinterpret_array(mi.UInt32, scene.shapes_dr()))
    table = np.zeros(np.max(keys) + 1, dtype=np.uint16)
    table[keys] = [_number(shape) for shape in scene.shapes()]
    return table[np.array(dr.reinterpret_array(mi.UInt32, hit.shape))]


def _number(shape: Any) -> int:
    return 1 + int(str(shape.id()).removeprefix("mesh"))


def _wide() -> bool:
    """Return whether the backend traces arrays of rays."""
    return bool(dr.is_jit_v(mi.Float))


def _rays(eyes: FloatArray, points: FloatArray) -> list[Any]:
    """Return rays whose parameter is 1 at the points: one array of rays, or single rays on scalar backends."""
    origins, directions = np.zeros((2, 3, len(points)), dtype=np.float32)
    _fill_rays(eyes, points, origins, directions)
    if _wide():
        return [mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions))]
    return [mi.Ray3f(o, d) for o, d in zip(origins.T.tolist(), directions.T.tolist(), strict=True)]


@compiled
def _fill_rays(
    eyes: FloatArray, points: FloatArray, origins: NDArray[np.float32], directions: NDArray[np.float32]
) -> None:
    """Fill origins and directions (3, n) in one pass: component-wise NumPy takes as long as tracing the rays."""
    for n in range(points.shape[0]):
        for k in range(3):
            direction = np.float32(points[n, k] - eyes[n, k])
            origins[k, n] = eyes[n, k]
            directions[k, n] = np.float32(0.0) if abs(direction) < LEAST_COMPONENT else direction  # NaN stays


@compiled
def _towards_eyes(
    normals: NDArray[np.float32], directions: NDArray[np.float32], numbers: NDArray[np.uint16]
) -> NDArray[np.float32]:
    """Flip normals (3, n) against the ray directions (3, n); return them as (n, 3), 0 where ``numbers`` is 0."""
    out = np.zeros((numbers.size, 3), np.float32)
    for n in np.flatnonzero(numbers):
        along = (
            normals[0, n] * directions[0, n] + normals[1, n] * directions[1, n] + normals[2, n] * directions[2, n]
        )
        sign = np.float32(-1.0) if along > 0 else np.float32(1.0)
        for k in range(3):
            out[n, k] = sign * normals[k, n] + np.float32(0.0)  # no -0
    return out


def obstacle(
    scene: MitsubaScene,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    frames: int,
    objects: Sequence[MovingObject] = (),
) -> str:
    """Describe the first surface or object that a camera collides with; return "" if there is none.

    Straight segments from the middle of the rig at time 0 to each camera, and along its path until the last row of
    the last frame is read, are tested. A rig that starts and stays inside a solid is not detected. ``objects`` are
    the moving objects of the scene.
    """
    for side in SIDES:
        tau = np.linspace(0.0, frames - 1 + shutter.ratio_of(side), 1 + 2 * (frames - 1) * rig.sensor(side).height)
        centres = inverse(rig.cam_from_world(motion, tau, side)).t
        step = first_crossing(scene.scene, np.concatenate([np.zeros((1, 3)), centres]))
        if step == 0:
            return f"there is a surface between the middle of the rig and the {side} camera"
        if step is not None:
            return f"the {side} camera goes through a surface at time {tau[step - 1]:.3f}"
        for number, (own, each) in enumerate(zip(scene.objects, objects, strict=True), start=1):
            centres = inverse(rig.cam_from_world(RelativeMotion(motion, each), tau, side)).t
            if (step := first_crossing(own, centres)) is not None:
                return f"the {side} camera and moving object {number} meet at time {tau[step]:.3f}"
    return ""


def first_crossing(scene: Any, points: FloatArray) -> int | None:
    """Return the first k for which the segment from point k to k + 1 of (n, 3), metres, hits a surface, or None.

    ``scene`` is a Mitsuba scene.
    """
    steps = np.diff(points, axis=0)
    moving = np.flatnonzero(np.any(steps, axis=1))
    if not len(moving):
        return None
    starts = points[moving]
    met = moving[blocked(scene, starts, starts + steps[moving] / REACH)]
    return int(met[0]) if len(met) else None
