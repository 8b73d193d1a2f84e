"""Tracing ray by ray with ``scalar_rgb``, for machines without a working LLVM: slow, but needs no compiler.

The same formulas as the wavefront, sample for sample; only rounding differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.renderers.integrators import (
    Hits,
    depth_and_label,
    is_glossy,
    lane_sampler,
    path_integrator,
    placed,
    sunsky_radiance,
)
from rsbench.renderers.mitsuba_modules import dr, mi
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.pixel_samples import facet_points, instant_of, sky_points, subpixel_grid
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LineRays

Float32Array = NDArray[np.float32]


def depth_rows(scene: MitsubaScene, rays: LineRays, camera: PinholeCamera, rows: Sequence[int]) -> Hits:
    """Return the first hits of the rays through the pixel centres."""
    depth, labels, gloss = result = Hits.none(len(rows), camera.width)
    for place, row in enumerate(rows):
        for column in range(camera.width):
            pose = column if rays.columns else row
            ray = mi.Ray3f(*rays.row_ray(float(column), float(row), pose))
            if scene.objects:
                found = depth_and_label(scene, ray, True, placed(scene, rays, pose))
                depth[place, column], labels[place, column], bsdf = found
            else:
                hit = scene.scene.ray_intersect_preliminary(ray)
                depth[place, column] = hit.t if hit.is_valid() else 0.0
                bsdf = hit.shape.bsdf() if hit.is_valid() else None
            gloss[place, column] = bsdf is not None and is_glossy(bsdf, True)
    return result


def radiance_rows(
    scene: MitsubaScene, rays: LineRays, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Float32Array:
    """Return linear RGB (rows, width, 3): the mean over the sub-pixel grid (a box filter)."""
    grid = subpixel_grid(options.samples).tolist()
    sky = sky_points(options.samples, options.sky_rays).tolist() if options.sky_rays else [[]] * options.samples
    facets = facet_points(options.samples).tolist()

    def sunsky(origin: Any, direction: Any, pixel: int, sample: int, pose: int) -> Any:
        above = [mi.Vector3f(*point) for point in sky[sample]]
        facet = mi.Point2f(facets[sample]) if scene.glossy else None
        ray = mi.Ray3f(origin, dr.normalize(direction))
        return sunsky_radiance(scene, ray, True, above, placed(scene, rays, pose), facet)

    def path(origin: Any, direction: Any, pixel: int, sample: int, pose: int) -> Any:
        sampler = lane_sampler()
        sampler.seed_lanes(options.seed, pixel, sample)
        ray = mi.RayDifferential3f(origin, dr.normalize(direction))
        radiance, _, _ = path_integrator(options.max_depth).sample(scene.scene, sampler, ray)
        return radiance

    trace = sunsky if options.integrator == "sunsky" else path
    result = np.zeros((len(rows), camera.width, 3), dtype=np.float32)
    for place, row in enumerate(rows):
        for column in range(camera.width):
            total = np.zeros(3, dtype=np.float32)
            for number, (dx, dy) in enumerate(grid):
                pixel, pose = row * camera.width + column, column if rays.columns else row
                if rays.instants > 1:
                    instant = instant_of(options.seed, pixel, number, options.samples, rays.instants)
                    pose += int(rays.lines) * int(instant)
                origin, direction = rays.row_ray(column + dx, row + dy, pose)
                total += np.asarray(trace(origin, direction, pixel, number, pose), dtype=np.float32)
            result[place, column] = total / np.float32(options.samples)
    return result
