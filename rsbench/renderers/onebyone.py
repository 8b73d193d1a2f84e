"""Tracing ray by ray with ``scalar_rgb``, where no LLVM works: slow, and free of any compiler.

The same formulas as the wavefront, sample for sample; only rounding differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.renderers.carried import Placed, depth_and_label, placed
from rsbench.renderers.exposure import instant_of
from rsbench.renderers.integrators import lane_sampler, path_integrator, sunsky_radiance
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.subpixel import sky_ways, subpixel_grid

Float32Array = NDArray[np.float32]


def depth_rows(
    scene: MitsubaScene, sensor: Any, camera: PinholeCamera, rows: Sequence[int]
) -> tuple[Float32Array, NDArray[np.uint8]]:
    """Depth z (rows, width) along the rays through pixel centres, metres, 0 = no surface; and ``Frame.labels``."""
    import mitsuba as mi

    result = np.zeros((len(rows), camera.width), dtype=np.float32)
    labels = np.zeros(result.shape, dtype=np.uint8)
    for place, row in enumerate(rows):
        for column in range(camera.width):
            pose = column if sensor.columns else row
            ray = mi.Ray3f(*sensor.row_ray(float(column), float(row), pose))
            if scene.objects:
                found = depth_and_label(scene, ray, True, placed(scene, sensor, pose))
                result[place, column], labels[place, column] = found
            else:
                hit = scene.scene.ray_intersect_preliminary(ray)
                result[place, column] = hit.t if hit.is_valid() else 0.0
    return result, labels


def radiance_rows(
    scene: MitsubaScene, sensor: Any, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Float32Array:
    """Linear RGB (rows, width, 3): the mean over the sub-pixel grid (a box filter)."""
    trace = _sunsky if options.integrator == "sunsky" else _path
    grid = subpixel_grid(options.samples).tolist()
    result = np.zeros((len(rows), camera.width, 3), dtype=np.float32)
    for place, row in enumerate(rows):
        for column in range(camera.width):
            total = np.zeros(3, dtype=np.float32)
            for number, (dx, dy) in enumerate(grid):
                pixel, pose = row * camera.width + column, column if sensor.columns else row
                if sensor.instants > 1:
                    instant = instant_of(options.seed, pixel, number, options.samples, sensor.instants)
                    pose += sensor.lines * int(instant)
                origin, direction = sensor.row_ray(column + dx, row + dy, pose)
                objects = placed(scene, sensor, pose)
                light = trace(scene, origin, direction, options, pixel, number, objects)
                total += np.asarray(light, dtype=np.float32)
            result[place, column] = total / np.float32(options.samples)
    return result


def _sunsky(
    scene: MitsubaScene,
    origin: Any,
    direction: Any,
    options: RendererOptions,
    pixel: int,
    sample: int,
    objects: list[Placed],
) -> Any:
    import drjit as dr
    import mitsuba as mi

    ways = [mi.Vector3f(*way) for way in _ways(options.samples, options.sky_rays)[sample]]
    return sunsky_radiance(scene, mi.Ray3f(origin, dr.normalize(direction)), ways=ways, objects=objects)


@cache
def _ways(samples: int, rays: int) -> Any:
    return sky_ways(samples, rays).tolist() if rays else [[]] * samples


def _path(
    scene: MitsubaScene,
    origin: Any,
    direction: Any,
    options: RendererOptions,
    pixel: int,
    sample: int,
    objects: list[Placed],
) -> Any:
    import drjit as dr
    import mitsuba as mi

    sampler = lane_sampler()
    sampler.seed_lanes(options.seed, pixel, sample)
    ray = mi.RayDifferential3f(origin, dr.normalize(direction))
    radiance, _, _ = path_integrator(options.max_depth).sample(scene.scene, sampler, ray)
    return radiance
