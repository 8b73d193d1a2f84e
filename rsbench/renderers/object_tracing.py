"""Objects that move: each is a scene of its own, into whose frame every ray is carried at its own time.

A lane knows where each object is at the time of its row, or of its instant of an exposure, as it knows the pose of
its camera. So nothing is batched or interpolated, and without objects no instruction is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from rsbench.renderers.scene import MitsubaScene

SHADED = 128
"""Added to the label of a pixel whose surface an object hides from the sun; the rest is the object's number, 0 of
what stands still."""


@dataclass(frozen=True)
class Placed:
    """An object where it is at the times of the lanes."""

    scene: Any
    """Of Mitsuba, in the frame of the object."""
    ball: tuple[Any, Any]
    """Centre, in that frame, and square of the radius of a ball around it."""
    pose: list[Any]
    """12 values: ``world_from_object``, R row-major, then t."""

    def carried(self, ray: Any, active: Any) -> tuple[Any, Any]:
        """A ray of the world in the frame of the object, where its parameters mean the same; and whether it may
        meet the object."""
        import drjit as dr
        import mitsuba as mi

        origin = mi.Point3f(*self._turned(ray.o - mi.Vector3f(*self.pose[9:])))
        way = mi.Vector3f(*level(self._turned(ray.d)))
        centre, square = self.ball
        to = centre - origin
        off = dr.cross(to, way)
        return mi.Ray3f(origin, way), active & (dr.dot(off, off) <= square * dr.dot(way, way))

    def meets(self, ray: Any, active: Any) -> Any:
        """Whether the object lies on rays of the world."""
        own, near = self.carried(ray, active)
        return self.scene.ray_test(own, coherent=True, active=near)

    def _turned(self, v: Any) -> list[Any]:
        """``R^T v``."""
        R = self.pose
        return [R[k] * v.x + R[3 + k] * v.y + R[6 + k] * v.z for k in range(3)]


def placed(scene: MitsubaScene, sensor: Any, pose: Any, active: Any = True) -> list[Placed]:
    """The objects of a scene at the times of poses of the sensor, one number for each lane."""
    return [
        Placed(each, ball, sensor.object_pose(number, pose, active))
        for number, (each, ball) in enumerate(zip(scene.objects, scene.balls, strict=True))
    ]


class First(NamedTuple):
    """What rays meet first, in the frame of what they meet."""

    found: Any
    """Mitsuba's preliminary intersection."""
    ray: Any
    pose: list[Any]
    """12 values, as of ``Placed``."""
    label: Any
    """Number of the object, 0 of what stands still."""

    def surface(self, flags: Any, active: Any) -> Any:
        """Mitsuba's interaction, position and normals in the world."""
        import mitsuba as mi

        hit = self.found.compute_surface_interaction(self.ray, flags, active)
        at = self._out(hit.p)
        hit.p = mi.Point3f(*(value + place for value, place in zip(at, self.pose[9:], strict=True)))
        hit.n, hit.sh_frame.n = (mi.Normal3f(*self._out(n)) for n in (hit.n, hit.sh_frame.n))
        return hit

    def _out(self, v: Any) -> list[Any]:
        """``R v``."""
        R = self.pose
        return [R[3 * k] * v.x + R[3 * k + 1] * v.y + R[3 * k + 2] * v.z for k in range(3)]


def first(scene: MitsubaScene, ray: Any, active: Any, objects: Sequence[Placed]) -> First:
    """The nearest of what stands still and of the objects."""
    import mitsuba as mi

    here = [mi.Float(float(k in (0, 4, 8))) for k in range(12)]
    nearest = First(
        scene.scene.ray_intersect_preliminary(ray, coherent=True, active=active), ray, here, mi.UInt32(0)
    )
    for number, each in enumerate(objects, start=1):
        own_ray, near = each.carried(ray, active)
        own = each.scene.ray_intersect_preliminary(own_ray, coherent=True, active=near)
        other, nearer = First(own, own_ray, each.pose, mi.UInt32(number)), own.t < nearest.found.t
        nearest = First(
            _either(nearer, own, nearest.found),
            _either(nearer, own_ray, nearest.ray),
            [_either(nearer, a, b) for a, b in zip(other.pose, nearest.pose, strict=True)],
            _either(nearer, other.label, nearest.label),
        )
    return nearest


def first_surface(scene: MitsubaScene, ray: Any, flags: Any, active: Any, objects: Sequence[Placed]) -> Any:
    """Mitsuba's interaction with what the rays meet first; position and normals in the world."""
    if not objects:
        return scene.scene.ray_intersect(ray, ray_flags=flags, coherent=True, active=active)
    return first(scene, ray, active, objects).surface(flags, active)


def hidden(scene: MitsubaScene, ray: Any, active: Any, objects: Sequence[Placed]) -> Any:
    """Whether anything lies on the rays."""
    found = scene.scene.ray_test(ray, coherent=True, active=active)
    for each in objects:
        found = found | each.meets(ray, active & _not(found))
    return found


def depth_and_label(scene: MitsubaScene, ray: Any, active: Any, objects: Sequence[Placed]) -> tuple[Any, Any, Any]:
    """Of the first surface along rays its parameter, 0 where there is none, label (see ``SHADED``) and BSDF."""
    import drjit as dr
    import mitsuba as mi

    nearest = first(scene, ray, active, objects)
    hit = nearest.surface(mi.RayFlags.Minimal, active)
    seen, shaded = hit.is_valid() & active, active & False
    to_sun = hit.spawn_ray(scene.sky.sun_direction)
    for each in objects:
        shaded = shaded | each.meets(to_sun, seen & _not(shaded))
    label = dr.select(seen, nearest.label, 0)
    return dr.select(seen, hit.t, 0), dr.select(shaded, label + SHADED, label), hit.bsdf()


def _not(value: Any) -> Any:
    import drjit as dr

    return ~value if dr.is_jit_v(value) else not value


def _either(first: Any, own: Any, other: Any) -> Any:
    import drjit as dr

    if dr.is_jit_v(first):
        return dr.select(first, own, other)
    return own if first else other


def level(direction: list[Any]) -> list[Any]:
    """See ``sensor.LEAST_COMPONENT``."""
    import drjit as dr

    from rsbench.renderers.sensor import LEAST_COMPONENT

    return [dr.select(dr.abs(value) < LEAST_COMPONENT, 0.0, value) for value in direction]
