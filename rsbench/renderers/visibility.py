"""Rays between eyes and chosen points: what stands between them, what surface is met; a motion's collisions."""

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
"""Share of the distance to the point that must be free. The rest is the point's own surface: rays and points are
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
    objects: Sequence[MovingObject] = ()
    """The scene's moving objects; without them rays meet only what stands still."""

    def blocked(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> NDArray[np.bool_]:
        """Whether (n,) a surface stands before the points, at times (n,): where objects move, these are needed."""
        found = blocked(self.scene.scene, eyes, points)
        for scene, each in zip(self.scene.objects, self._objects(tau), strict=False):
            left = np.flatnonzero(~found)
            own = inverse(each.world_from_object(np.asarray(tau)[left]))
            found[left] = blocked(scene, transform(own, eyes[left]), transform(own, points[left]))
        return found

    def share(self, eyes: FloatArray, points: FloatArray) -> FloatArray:
        """Distance (n,) of the first surface on each ray, in units of the distance to the point; inf: none.

        Of what stands still.
        """
        hits = [self.scene.scene.ray_intersect_preliminary(ray, coherent=True) for ray in _rays(eyes, points)]
        met = np.concatenate([np.atleast_1d(np.array(hit.t, dtype=np.float64)) for hit in hits])
        return np.where(np.isfinite(met), met, np.inf)

    def surfaces(self, eyes: FloatArray, points: FloatArray, tau: FloatArray | None = None) -> Surfaces:
        """What rays to the points, and beyond, meet first; ``tau`` as for ``blocked``."""
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
    """(n,) in units of the distance to the point."""


def blocked(scene: Any, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """``SceneRays.blocked`` for one scene of Mitsuba."""
    found = [np.zeros(0, dtype=np.bool_)]
    for ray in _rays(eyes, points):
        ray.maxt = REACH
        found.append(np.atleast_1d(np.array(scene.ray_test(ray, coherent=True), dtype=np.bool_)))
    return np.concatenate(found)


def _met(scene: Any, eyes: FloatArray, points: FloatArray) -> _Met:
    """``SceneRays.surfaces`` for one scene of Mitsuba."""
    found = []
    for ray in _rays(eyes, points):
        hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True)
        dr.eval(hit.n, hit.t, hit.shape)  # together: evaluated one by one, each traces the rays again
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
    """Whether the backend traces arrays of rays."""
    return bool(dr.is_jit_v(mi.Float))


def _rays(eyes: FloatArray, points: FloatArray) -> list[Any]:
    """Rays whose parameter is 1 at the points: one array of all of them, or each alone."""
    origins, directions = np.zeros((2, 3, len(points)), dtype=np.float32)
    _fill_rays(eyes, points, origins, directions)
    if _wide():
        return [mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions))]
    return [mi.Ray3f(o, d) for o, d in zip(origins.T.tolist(), directions.T.tolist(), strict=True)]


@compiled
def _fill_rays(
    eyes: FloatArray, points: FloatArray, origins: NDArray[np.float32], directions: NDArray[np.float32]
) -> None:
    """Origins and directions (3, n) in one pass: NumPy's, a component at a time, takes as long as tracing them."""
    for n in range(points.shape[0]):
        for k in range(3):
            direction = np.float32(points[n, k] - eyes[n, k])
            origins[k, n] = eyes[n, k]
            directions[k, n] = np.float32(0.0) if abs(direction) < LEAST_COMPONENT else direction  # NaN stays


@compiled
def _towards_eyes(
    normals: NDArray[np.float32], directions: NDArray[np.float32], numbers: NDArray[np.uint16]
) -> NDArray[np.float32]:
    """Normals (n, 3) of those (3, n) that are met along directions (3, n); 0 where the number (n,) is."""
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
    """The obstacle that a camera meets, in words; "" where there is none. ``objects`` of the scene move.

    Followed in straight steps, from the middle of the rig at time 0 to each camera, and along its path until the
    last row of the last of so many frames is read. A rig that starts inside a solid and stays there meets nothing.
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
    """The first straight step, from point k of (n, 3), metres, to the next, that meets a surface; None: none.

    ``scene`` is one of Mitsuba.
    """
    steps = np.diff(points, axis=0)
    moving = np.flatnonzero(np.any(steps, axis=1))
    if not len(moving):
        return None
    starts = points[moving]
    met = moving[blocked(scene, starts, starts + steps[moving] / REACH)]
    return int(met[0]) if len(met) else None
