"""Tracing whole blocks of pixels at once with Dr.Jit (the variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``).

A lane is one pixel. Embree traces neighbouring lanes together and does not guarantee that the rounding of a lane
is independent of its neighbours. So the lanes of a row are padded to whole packets: as no packet straddles rows, a
pixel has the same neighbours, and so the same bits, in a whole frame and in a row rendered alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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

PACKET = 16
"""Largest number of lanes that are traced together (AVX-512)."""
LANES_PER_LAUNCH, _ON_GPU = 1 << 22, 8
"""Largest number of lanes of a launch, which bounds its memory, and the factor for a GPU, which idles while
launches are recorded. Larger work is split without changing any bit of the result."""

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class _Lanes:
    """Lanes for the pixels of a block of rows, repeated ``copies`` times.

    The sizes are inputs of the kernel, and rows and columns are computed inside it, so that neither another size
    nor the alignment of host memory compiles a new kernel: a single row runs the same code as a whole frame.
    """

    row: Any
    column: Any
    copy: Any
    active: Any
    shape: tuple[int, int, int]  # copies, rows, padded width

    @classmethod
    def of(cls, rows: Sequence[int], width: int, copies: int = 1) -> _Lanes:
        shape = (copies, len(rows), _padded(width))
        lane = dr.arange(mi.UInt32, shape[0] * shape[1] * shape[2])
        padded, count = dr.opaque(mi.UInt32, shape[2]), dr.opaque(mi.UInt32, len(rows))
        place, column = lane // padded, lane % padded
        # Dr.Jit compiles a table of one entry to different code, hence the second entry.
        table = mi.UInt32(np.asarray([*rows, rows[-1]], dtype=np.uint32))
        row = dr.gather(mi.UInt32, table, place % count)
        return cls(row, column, place // count, column < dr.opaque(mi.UInt32, width), shape)

    def line(self, sensor: Any) -> Any:
        """Return the row, or the column if the camera reads columns."""
        return self.column if sensor.columns else self.row

    def pixel(self, camera: PinholeCamera) -> Any:
        """Return the index of the pixel in the full frame."""
        return self.row * dr.opaque(mi.UInt32, camera.width) + self.column

    def image(self, channels: Sequence[Any], width: int) -> Float32Array:
        """Convert Dr.Jit arrays with one entry per lane to a host array (copies, rows, width, channels)."""
        dr.eval(channels)
        host = np.stack([np.array(channel).reshape(self.shape)[:, :, :width] for channel in channels], axis=-1)
        return host.astype(np.float32, copy=False)


def _padded(width: int) -> int:
    return -(-width // PACKET) * PACKET


def _most_lanes() -> int:
    return LANES_PER_LAUNCH * (_ON_GPU if str(mi.variant()).startswith("cuda") else 1)


def _bands(rows: Sequence[int], width: int) -> Iterator[tuple[slice, Sequence[int]]]:
    """Yield the rows of each launch, with their position among all rows."""
    step = max(1, _most_lanes() // _padded(width))
    for start in range(0, len(rows), step):
        place = slice(start, min(start + step, len(rows)))
        yield place, rows[place]


def depth_rows(scene: MitsubaScene, sensor: Any, camera: PinholeCamera, rows: Sequence[int]) -> Hits:
    """Return the first hits of the rays through the pixel centres."""
    result = Hits.none(len(rows), camera.width)
    for place, band in _bands(rows, camera.width):
        lanes = _Lanes.of(band, camera.width)
        ray = mi.Ray3f(
            *sensor.row_ray(mi.Float(lanes.column), mi.Float(lanes.row), lanes.line(sensor), lanes.active)
        )
        if scene.objects:
            objects = placed(scene, sensor, lanes.line(sensor), lanes.active)
            depth, label, bsdf = depth_and_label(scene, ray, lanes.active, objects)
            found = {"depth": depth, "labels": label}
        else:
            hit = scene.scene.ray_intersect_preliminary(ray, coherent=True, active=lanes.active)
            found, bsdf = {"depth": dr.select(hit.is_valid(), hit.t, 0)}, hit.shape.bsdf()
        if scene.glossy:
            found["gloss"] = dr.select(is_glossy(bsdf, lanes.active), mi.UInt32(1), 0)
        values = lanes.image([*found.values()], camera.width)[0]
        for number, name in enumerate(found):
            getattr(result, name)[place] = values[..., number]
    return result


def radiance_rows(
    scene: MitsubaScene, sensor: Any, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Float32Array:
    """Return linear RGB (rows, width, 3): the mean over the sub-pixel grid (a box filter)."""
    trace = _sunsky_band if options.integrator == "sunsky" else _path_band
    result = np.zeros((len(rows), camera.width, 3), dtype=np.float32)
    for place, band in _bands(rows, camera.width):
        result[place] = trace(scene, sensor, camera, band, options)
    return result


def _pose(sensor: Any, camera: PinholeCamera, lanes: _Lanes, sample: Any, options: RendererOptions) -> Any:
    """Return the index of the pose of a sample of each lane: its row's pose at an instant of the exposure."""
    if sensor.instants == 1:
        return lanes.line(sensor)
    seed = dr.opaque(mi.UInt32, options.seed)
    instant = instant_of(seed, lanes.pixel(camera), sample, options.samples, sensor.instants)
    return lanes.line(sensor) + dr.opaque(mi.UInt32, sensor.lines) * instant


def _sunsky_band(
    scene: MitsubaScene, sensor: Any, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Float32Array:
    """Render a band with ``sunsky``; the loop over samples runs inside the kernel to keep memory constant."""
    lanes = _Lanes.of(rows, camera.width)
    grid = mi.Float(subpixel_grid(options.samples).ravel())
    count, rays = dr.opaque(mi.UInt32, options.samples), options.sky_rays
    table = mi.Float(sky_points(options.samples, rays).ravel()) if rays else None
    facets = mi.Float(facet_points(options.samples).ravel()) if scene.glossy else None
    x, y = mi.Float(lanes.column), mi.Float(lanes.row)
    pixel = None if sensor.lens is None else sensor.lens.pixel(x, y, lanes.active)
    still = placed(scene, sensor, lanes.line(sensor), lanes.active) if sensor.instants == 1 else None

    def add_sample(k: Any, total: Any) -> tuple[Any, Any]:
        dx, dy = dr.gather(mi.Float, grid, 2 * k), dr.gather(mi.Float, grid, 2 * k + 1)
        pose = _pose(sensor, camera, lanes, k, options)
        origin, direction = sensor.row_ray(x + dx, y + dy, pose, lanes.active, pixel)
        ray = mi.Ray3f(origin, dr.normalize(direction))
        sky_points_here = [_entry(table, k * rays + j) for j in range(rays)]
        objects = placed(scene, sensor, pose, lanes.active) if still is None else still
        facet = None if facets is None else mi.Point2f(*(dr.gather(mi.Float, facets, 2 * k + j) for j in (0, 1)))
        return k + 1, total + sunsky_radiance(scene, ray, lanes.active, sky_points_here, objects, facet)

    _, total = dr.while_loop(
        state=(dr.zeros(mi.UInt32, dr.width(lanes.row)), dr.zeros(mi.Color3f, dr.width(lanes.row))),
        cond=lambda k, total: k < count,
        body=add_sample,
        labels=("sample", "total"),
    )
    return lanes.image([*total], camera.width)[0] / np.float32(options.samples)


def _entry(table: Any, number: Any) -> Any:
    """Return a vector from a flat table with three numbers per entry."""
    return mi.Vector3f(*(dr.gather(mi.Float, table, 3 * number + k) for k in range(3)))


def _path_band(
    scene: MitsubaScene, sensor: Any, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Float32Array:
    """Render a band with ``path``, one lane per pixel and sample.

    The samples are split into passes, but summed in the same order for any number of passes.
    """
    world = scene.textured()  # this evaluates all recorded operations
    offsets = mi.Float(subpixel_grid(options.samples).ravel())
    integrator, sampler = path_integrator(options.max_depth), lane_sampler()
    pixels = _Lanes.of(rows, camera.width)
    count = dr.width(pixels.row)
    per_pass = max(1, _most_lanes() // count)
    total = dr.zeros(mi.Color3f, count)
    for first in range(0, options.samples, per_pass):
        copies = min(per_pass, options.samples - first)
        lanes = _Lanes.of(rows, camera.width, copies)
        sample = lanes.copy + dr.opaque(mi.UInt32, first)
        x = mi.Float(lanes.column) + dr.gather(mi.Float, offsets, 2 * sample)
        y = mi.Float(lanes.row) + dr.gather(mi.Float, offsets, 2 * sample + 1)
        origin, direction = sensor.row_ray(x, y, _pose(sensor, camera, lanes, sample, options), lanes.active)
        sampler.seed_lanes(dr.opaque(mi.UInt32, options.seed), lanes.pixel(camera), sample)
        ray = mi.RayDifferential3f(origin, dr.normalize(direction))
        radiance, _, _ = integrator.sample(world, sampler, ray, active=lanes.active)
        total = _added(total, radiance, copies)
    return pixels.image([*total], camera.width)[0] / np.float32(options.samples)


def _added(total: Any, radiance: Any, copies: int) -> Any:
    """Add the copies of each pixel's radiance to its total, one after another."""
    dr.eval(total, radiance)
    place, step = dr.arange(mi.UInt32, dr.width(total)), dr.opaque(mi.UInt32, dr.width(total))
    last = dr.opaque(mi.UInt32, copies)

    def add_copy(k: Any, total: Any) -> tuple[Any, Any]:
        return k + 1, total + mi.Color3f(*(dr.gather(mi.Float, each, place + k * step) for each in radiance))

    _, total = dr.while_loop(
        state=(dr.zeros(mi.UInt32, dr.width(total)), total),
        cond=lambda k, total: k < last,
        body=add_copy,
        labels=("copy", "total"),
    )
    return total
