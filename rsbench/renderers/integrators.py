"""Integrators of radiance: ``sunsky``, free of noise, and Mitsuba's ``path`` on points of our own."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from rsbench.renderers.gloss import Coat, is_glossy
from rsbench.renderers.object_tracing import Placed, first_surface, hidden, level
from rsbench.renderers.scene import MitsubaScene


def sunsky_radiance(
    scene: MitsubaScene,
    ray: Any,
    active: Any = True,
    ways: Sequence[Any] = (),
    objects: Sequence[Placed] = (),
    facet: Any = None,
) -> Any:
    """Radiance (RGB) along unit rays: a sun with hard shadows and a hemisphere sky on diffuse surfaces.

    L = albedo (E_sun / pi max(n.s, 0) visible + S (0.6 + 0.4 n.up)), with S the cosine-weighted mean of the sky,
    so that level ground in the open has its exact sky irradiance and a wall three fifths of it. It draws no random
    number: the same ray has the same radiance, in every renderer, process and number of threads. With ``ways``,
    points on the unit sphere, the sky's part is that of ``_seen_sky``: all is direct light as ``path`` has it.

    The coat of a glossy surface mirrors the sun, and by ``facet``, a point of the unit square, what the mirrored
    ray meets: its light without what glossy surfaces there would mirror in turn. Without ``facet``, the sun alone.
    """
    import drjit as dr
    import mitsuba as mi

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
    if ways:
        ambient = _seen_sky(scene, hit, normal, ways, on_surface)
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
        mirrored.d = mi.Vector3f(*level(list(mirrored.d)))
        return found + share * sunsky_radiance(scene, mirrored, shiny, ways, objects)

    shiny = is_glossy(hit.bsdf(), on_surface)
    return dr.if_stmt(args=(light,), cond=shiny, true_fn=coated, false_fn=lambda plain: plain)


_WITHIN = 0.9999
"""Of the sphere's radius: the opposite of a normal would leave no direction."""


def _seen_sky(scene: MitsubaScene, hit: Any, normal: Any, ways: Sequence[Any], active: Any) -> Any:
    """Radiance that a white open surface would have from the sky, times the share of its light that nothing hides.

    A unit normal plus a point on the unit sphere is a direction that the cosine law draws; of those directions the
    sky's light is summed with and without what hides it. Their ratio is exact where nothing or all is hidden.
    """
    import drjit as dr
    import mitsuba as mi

    seen, whole = mi.Color3f(0.0), mi.Color3f(0.0)
    for way in ways:
        direction = dr.normalize(normal + _WITHIN * way)
        light = scene.sky.seen_along(direction)
        dark = scene.scene.ray_test(hit.spawn_ray(direction), active=active)
        seen += dr.select(dark, 0, light)
        whole += light
    return scene.sky.on_open_surface(normal) * dr.select(whole > 0, seen / whole, 0)


@cache
def path_integrator(max_depth: int) -> Any:
    """Mitsuba's path tracer, paths of at most ``max_depth`` segments."""
    import mitsuba as mi

    return mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})


def lane_sampler() -> Any:
    """A Mitsuba sampler whose numbers depend on seed, pixel and sample alone, not on the place in the wavefront.

    The samples of a pixel are spread evenly in each dimension of a path, and in pairs of them: Sobol' points, of
    which every pixel and dimension has its own scrambling (S. Laine, T. Karras, Stratified sampling for stochastic
    transparency, EGSR 2011; B. Burley, Practical hash-based Owen scrambling, JCGT 2020). Mitsuba's own samplers
    number the lanes of a launch, so a row rendered by itself would draw other numbers than the same row of a whole
    image. A new one each time: what it would draw next depends on the path so far, and so keeps the whole scene
    alive.
    """
    import mitsuba as mi

    _register_lane_sampler()
    return mi.load_dict({"type": "rsbench_lanes"})


@cache
def _register_lane_sampler() -> None:
    import mitsuba as mi

    class LaneSampler(mi.Sampler):
        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.pixel, self.place, self.dimension = mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)

        def seed_lanes(self, seed: Any, pixel: Any, sample: Any) -> None:
            """Start the sequences of (pixel, sample) pairs; ``pixel`` is the index in the full frame."""
            self.pixel, _ = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(pixel))
            self.place, self.dimension = reversed_bits(mi.UInt32(sample)), mi.UInt32(0)

        def next_1d(self, active: Any = True) -> Any:
            return self._next(False)[0]

        def next_2d(self, active: Any = True) -> Any:
            return mi.Point2f(*self._next(True))

        def _next(self, both: bool) -> list[Any]:
            """Coordinates of the next dimension, or of the next two."""
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
    """Of 32; as all below, of whole numbers and of Dr.Jit's arrays of them."""
    for step, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        x = ((x >> step) & mask) | ((x & mask) << step)
    return ((x >> 16) | (x << 16)) & _WORD


def scrambled(x: Any, key: Any) -> Any:
    """A permutation in which a bit changes none below it: of reversed bits, Owen's."""
    x = (x + key) & _WORD
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ ((x * factor) & _WORD)
    return x


def sobol(x: Any) -> Any:
    """The second coordinate, as 32 bits, of the Sobol' point whose first coordinate has these."""
    for step, mask in ((16, 0x0000FFFF), (8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = x ^ ((x & mask) << step)
    return x & _WORD


def unit(x: Any) -> Any:
    """32 bits as a number from 0 to below 1, which 24 of them fill."""
    import mitsuba as mi

    return mi.Float(x >> 8) * (1.0 / (1 << 24))
