"""Integrators of radiance: ``sunsky``, which is noise-free, and Mitsuba's ``path`` with our own sampler.

Each moving object is a separate Mitsuba scene; every ray is transformed into the object's frame at the time of the
ray. Each lane reads the poses of the objects, like that of the camera, at the time of its row or, within an
exposure, of its instant. So no poses are interpolated, and scenes without objects run no additional instructions.

Glossy surfaces have a clear coat. Microfacets of the coat reflect light, or the light passes through the coat to
the diffuse surface below and back. Mitsuba's BSDF ``roughplastic`` models both parts; ``path`` uses it directly,
and ``sunsky`` evaluates it without random numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rsbench.renderers.mitsuba_modules import dr, mi
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LineRays, level


class Hits(NamedTuple):
    """First hits of the rays through the pixel centres of some rows; arrays (rows, width)."""

    depth: NDArray[np.float32]
    """z in the camera frame at the time of the row, metres; 0 = no surface."""
    labels: NDArray[np.uint8]
    """Number of the moving object seen there, 0 = none, plus ``SHADED`` in the shadow of one."""
    gloss: NDArray[np.bool_]
    """Whether the surface is glossy."""

    @classmethod
    def none(cls, rows: int, width: int) -> Hits:
        """Return arrays of zeros, to be filled."""
        shape = rows, width
        return cls(np.zeros(shape, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.bool_))


_BELOW_A_COAT = 0.95
"""Transmittance of the coat for uniform light from all directions, divided by that at normal incidence. It is
0.946 to 0.953 for the allowed roughnesses, by numerical integration of the BSDF over directions."""


def is_glossy(bsdf: Any, active: Any) -> Any:
    """Return whether BSDFs have a glossy coat."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection) & active


class Coat:
    """Reflection of light by glossy surfaces at the points where rays hit them."""

    def __init__(self, hit: Any, normal: Any, ray: Any) -> None:
        """
        Args:
            hit: Mitsuba's surface interaction, with position and normals in the world frame.
            normal: unit shading normals on the side of the ray's origin.
            ray: rays that hit the surfaces.
        """
        self._bsdf, self._frame = hit.bsdf(), mi.Frame3f(normal)
        self._hit = mi.SurfaceInteraction3f(hit)
        self._hit.sh_frame, self._hit.wi = self._frame, self._frame.to_local(-ray.d)

    def share_towards(self, direction: Any, active: Any) -> Any:
        """Return the radiance reflected, by coat and diffuse surface, per unit of light from unit directions.

        The light is an irradiance on a plane perpendicular to the direction.
        """
        return self._bsdf.eval(_context("all"), self._hit, self._frame.to_local(direction), active)

    def below(self, active: Any) -> Any:
        """Return the radiance of the diffuse surface, seen through the coat, under uniform radiance 1."""
        upright = self._bsdf.eval(_context("diffuse"), self._hit, mi.Vector3f(0, 0, 1), active)
        return upright * (dr.pi * _BELOW_A_COAT)

    def mirrored(self, facet: Any, active: Any) -> tuple[Any, Any]:
        """Return rays reflected by microfacets, and the factors by which their radiance contributes.

        ``facet`` are points of the unit square that select the microfacets: its centre gives nearly the mirror
        direction, and the mean over the square is the light that the coat reflects.
        """
        found, share = self._bsdf.sample(_context("coat"), self._hit, mi.Float(0.5), facet, active)
        return self._hit.spawn_ray(self._frame.to_world(found.wo)), share


@cache
def _context(part: str) -> Any:
    context = mi.BSDFContext()
    if part != "all":
        context.type_mask = mi.BSDFFlags.Diffuse if part == "diffuse" else mi.BSDFFlags.Glossy
    return context


SHADED = 128
"""Value added to the label of a pixel whose surface is in the shadow of a moving object; the rest of the label is
the number of the object seen there, 0 for the static scene."""


@dataclass(frozen=True)
class Placed:
    """A moving object with its poses at the times of the lanes."""

    scene: Any
    """Mitsuba's scene, in the frame of the object."""
    ball: tuple[Any, Any]
    """Centre, in that frame, and squared radius of a bounding sphere."""
    pose: list[Any]
    """The 12 values of ``world_from_object``: R row-major, then t."""

    def carried(self, ray: Any, active: Any) -> tuple[Any, Any]:
        """Transform a world ray into the object's frame, and test it against the bounding sphere.

        A ray parameter denotes the same point in both frames.
        """
        origin = mi.Point3f(*self._turned(ray.o - mi.Vector3f(*self.pose[9:])))
        direction = mi.Vector3f(*level(self._turned(ray.d)))
        centre, square = self.ball
        to = centre - origin
        off = dr.cross(to, direction)
        return mi.Ray3f(origin, direction), active & (dr.dot(off, off) <= square * dr.dot(direction, direction))

    def meets(self, ray: Any, active: Any) -> Any:
        """Return whether world rays hit the object."""
        own, near = self.carried(ray, active)
        return self.scene.ray_test(own, coherent=True, active=near)

    def _turned(self, v: Any) -> list[Any]:
        """Return ``R^T v``."""
        R = self.pose
        return [R[k] * v.x + R[3 + k] * v.y + R[6 + k] * v.z for k in range(3)]


def placed(scene: MitsubaScene, rays: LineRays, pose: Any, active: Any = True) -> list[Placed]:
    """Return the moving objects of a scene at the times of the rays' poses; ``pose`` is an index per lane."""
    return [
        Placed(each, ball, rays.object_pose(number, pose, active))
        for number, (each, ball) in enumerate(zip(scene.objects, scene.balls, strict=True))
    ]


class First(NamedTuple):
    """First hits of rays, each in the frame of the static scene or of the object that was hit."""

    found: Any
    """Mitsuba's preliminary intersection."""
    ray: Any
    pose: list[Any]
    """The 12 values of the frame's pose, as in ``Placed``."""
    label: Any
    """Number of the object, 0 for the static scene."""

    def surface(self, flags: Any, active: Any) -> Any:
        """Return Mitsuba's surface interaction with position and normals in the world frame."""
        hit = self.found.compute_surface_interaction(self.ray, flags, active)
        at = self._out(hit.p)
        hit.p = mi.Point3f(*(value + place for value, place in zip(at, self.pose[9:], strict=True)))
        hit.n, hit.sh_frame.n = (mi.Normal3f(*self._out(n)) for n in (hit.n, hit.sh_frame.n))
        return hit

    def _out(self, v: Any) -> list[Any]:
        """Return ``R v``."""
        R = self.pose
        return [R[3 * k] * v.x + R[3 * k + 1] * v.y + R[3 * k + 2] * v.z for k in range(3)]


def first(scene: MitsubaScene, ray: Any, active: Any, objects: Sequence[Placed]) -> First:
    """Return the nearest hit among the static scene and the moving objects."""
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
    """Return Mitsuba's interaction at the first hit; position and normals are in the world frame."""
    if not objects:
        return scene.scene.ray_intersect(ray, ray_flags=flags, coherent=True, active=active)
    return first(scene, ray, active, objects).surface(flags, active)


def hidden(scene: MitsubaScene, ray: Any, active: Any, objects: Sequence[Placed]) -> Any:
    """Return whether the static scene or an object blocks the rays."""
    found = scene.scene.ray_test(ray, coherent=True, active=active)
    for each in objects:
        found = found | each.meets(ray, active & _not(found))
    return found


def depth_and_label(scene: MitsubaScene, ray: Any, active: Any, objects: Sequence[Placed]) -> tuple[Any, Any, Any]:
    """Return the ray parameter (0: no hit), label (see ``SHADED``) and BSDF of the first surface along rays.

    The BSDF is None for a single (scalar) ray that hits nothing.
    """
    nearest = first(scene, ray, active, objects)
    hit = nearest.surface(mi.RayFlags.Minimal, active)
    seen, shaded = hit.is_valid() & active, active & False
    to_sun = hit.spawn_ray(scene.sky.sun_direction)
    for each in objects:
        shaded = shaded | each.meets(to_sun, seen & _not(shaded))
    label = dr.select(seen, nearest.label, 0)
    bsdf = hit.bsdf() if dr.is_jit_v(seen) or seen else None
    return dr.select(seen, hit.t, 0), dr.select(shaded, label + SHADED, label), bsdf


def _not(value: Any) -> Any:
    return ~value if dr.is_jit_v(value) else not value


def _either(first: Any, own: Any, other: Any) -> Any:
    if dr.is_jit_v(first):
        return dr.select(first, own, other)
    return own if first else other


def sunsky_radiance(
    scene: MitsubaScene,
    ray: Any,
    active: Any = True,
    sky_points: Sequence[Any] = (),
    objects: Sequence[Placed] = (),
    facet: Any = None,
) -> Any:
    """Return the radiance (RGB) along unit rays: a sun with hard shadows and a hemisphere sky on diffuse surfaces.

    L = albedo (E_sun / pi max(n.s, 0) visible + S (0.6 + 0.4 n.up)), where S is the cosine-weighted mean of the
    sky. So open horizontal ground gets its exact sky irradiance, and a vertical wall three fifths of it. No random
    numbers are drawn: the radiance of a ray is the same in every renderer, process and number of threads. With
    ``sky_points`` on the unit sphere, ``_seen_sky`` computes the sky's part: all direct light, as in ``path``.

    The coat of a glossy surface reflects the sun and, if ``facet`` (a point of the unit square) is given, the
    scene along one reflected ray; glossy surfaces hit by that ray reflect only the sun.
    """
    sky = scene.sky
    flags = mi.RayFlags.UV | mi.RayFlags.ShadingFrame
    hit = first_surface(scene, ray, flags, active, objects)
    on_surface = hit.is_valid() & active
    if not dr.is_jit_v(on_surface) and not on_surface:
        return sky.seen_along(ray.d)
    albedo = scene.reflectance(hit, on_surface)
    normal = hit.sh_frame.n
    normal = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
    facing = dr.maximum(dr.dot(normal, sky.sun_direction), 0)
    lit = on_surface & (facing > 0)
    dark = hidden(scene, hit.spawn_ray(sky.sun_direction), lit, objects)
    sun = sky.sun_radiance * dr.select(lit, dr.select(dark, 0, facing), 0)
    if sky_points:
        ambient = _seen_sky(scene, hit, normal, sky_points, on_surface)
    elif sky.mapped:
        ambient = sky.on_open_surface(normal)
    else:
        ambient = sky.overhead * dr.fma(dr.dot(normal, sky.up), 0.4, 0.6)
    light = dr.select(on_surface, albedo * (sun + ambient), sky.seen_along(ray.d))
    if not scene.glossy:
        return light

    def coated(_: Any) -> Any:
        coat = Coat(hit, normal, ray)
        direct = dr.select(lit & ~dark if dr.is_jit_v(lit) else lit and not dark, dr.pi * sky.sun_radiance, 0)
        found = direct * coat.share_towards(sky.sun_direction, lit) + ambient * coat.below(shiny)
        if facet is None:
            return found
        mirrored, share = coat.mirrored(facet, shiny)
        mirrored.d = mi.Vector3f(*level(mirrored.d))
        return found + share * sunsky_radiance(scene, mirrored, shiny, sky_points, objects)

    shiny = is_glossy(hit.bsdf(), on_surface)
    return dr.if_stmt(args=(light,), cond=shiny, true_fn=coated, false_fn=lambda plain: plain)


_WITHIN = 0.9999
"""Scale of the points on the unit sphere: a point opposite to a normal would otherwise give a zero direction."""


def _seen_sky(scene: MitsubaScene, hit: Any, normal: Any, sky_points: Sequence[Any], active: Any) -> Any:
    """Return the radiance of an unoccluded white surface under the sky, times the unoccluded share of that light.

    A unit normal plus a uniform point on the unit sphere gives a cosine-distributed direction. The sky's light is
    summed over these directions with and without occlusion; the ratio is exact if none or all are occluded.
    """
    seen, whole = mi.Color3f(0.0), mi.Color3f(0.0)
    for point in sky_points:
        direction = dr.normalize(normal + _WITHIN * point)
        light = scene.sky.seen_along(direction)
        dark = scene.scene.ray_test(hit.spawn_ray(direction), active=active)
        seen += dr.select(dark, 0, light)
        whole += light
    return scene.sky.on_open_surface(normal) * dr.select(whole > 0, seen / whole, 0)


@cache
def path_integrator(max_depth: int) -> Any:
    """Return Mitsuba's path tracer for paths of at most ``max_depth`` segments."""
    return mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})


def lane_sampler() -> Any:
    """Return a Mitsuba sampler whose numbers depend only on seed, pixel and sample, not on the lane number.

    The samples of a pixel are Sobol' points, stratified in each dimension or pair of dimensions of a path, with a
    different scrambling for each pixel and dimension (S. Laine, T. Karras, Stratified sampling for stochastic
    transparency, EGSR 2011; B. Burley, Practical hash-based Owen scrambling, JCGT 2020). Mitsuba's own samplers
    number the lanes of a launch, so a row rendered alone would draw other numbers than the same row of a whole
    image. The sampler is created anew each time, because its state refers to the traced path and would keep the
    whole scene in memory.
    """
    _register_lane_sampler()
    return mi.load_dict({"type": "rsbench_lanes"})


@cache
def _register_lane_sampler() -> None:
    class LaneSampler(mi.Sampler):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.pixel, self.place, self.dimension = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

        def seed_lanes(self, seed: Any, pixel: Any, sample: Any) -> None:
            """Start the sequences for (pixel, sample) pairs; ``pixel`` is the index in the full frame."""
            self.pixel, _ = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(pixel))
            self.place, self.dimension = reversed_bits(mi.UInt32(sample)), mi.UInt32(0)

        def next_1d(self, active: Any = True) -> Any:
            return self._next(False)[0]

        def next_2d(self, active: Any = True) -> Any:
            return mi.Point2f(*self._next(True))

        def _next(self, both: bool) -> list[Any]:
            """Return the coordinates of the next dimension, or of the next pair of dimensions."""
            order, first = mi.sample_tea_32(self.pixel, self.dimension)
            self.dimension += 1
            shuffled = scrambled(self.place, order)
            found = [(shuffled, first), (sobol(shuffled), first ^ order)][: 1 + both]
            return [unit(reversed_bits(scrambled(reversed_bits(bits), key))) for bits, key in found]

        def to_string(self) -> str:
            return "LaneSampler[]"

    mi.register_sampler("rsbench_lanes", LaneSampler)


_WORD = 0xFFFFFFFF


def reversed_bits(x: Any) -> Any:
    """Reverse the 32 bits; like the functions below, it accepts integers and Dr.Jit arrays of integers."""
    for step, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> step) & mask) | ((x & mask) << step)
    return ((x >> 16) | (x << 16)) & _WORD


def scrambled(x: Any, key: Any) -> Any:
    """Permute 32-bit values so that a bit never affects lower bits: Owen scrambling of the reversed bits."""
    x = (x + key) & _WORD
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ ((x * factor) & _WORD)
    return x


def sobol(x: Any) -> Any:
    """Return the second coordinate of a 2D Sobol' point from its first one; both are 32-bit fractions."""
    for step, mask in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = x ^ ((x & mask) << step)
    return x & _WORD


def unit(x: Any) -> Any:
    """Convert 32 bits to a single-precision number in [0, 1), using the 24 upper bits."""
    return mi.Float(x >> 8) * (1.0 / (1 << 24))
