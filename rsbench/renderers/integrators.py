"""Integrators of radiance: ``sunsky``, free of noise, and Mitsuba's ``path`` with its own random numbers."""

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
    albedo = hit.bsdf().eval_diffuse_reflectance(hit, on_surface)
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

    Mitsuba's own samplers number the lanes of a launch, so a row rendered by itself would draw other numbers than
    the same row of a whole image. A new one each time: what it would draw next depends on the path so far, and so
    keeps the whole scene alive.
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
            self.rng = mi.PCG32()

        def seed_lanes(self, seed: Any, pixel: Any, sample: Any) -> None:
            """Start the sequences of (pixel, sample) pairs; ``pixel`` is the index in the full frame."""
            high, low = mi.sample_tea_32(seed, pixel)
            state, sequence = mi.sample_tea_32(high, (low + sample) & 0xFFFFFFFF)
            self.rng.seed(mi.UInt64(state), mi.UInt64(sequence))

        def next_1d(self, active: Any = True) -> Any:
            return self.rng.next_float32()

        def next_2d(self, active: Any = True) -> Any:
            first = self.rng.next_float32()
            return mi.Point2f(first, self.rng.next_float32())

        def to_string(self) -> str:
            return "LaneSampler[]"

    mi.register_sampler("rsbench_lanes", LaneSampler)
