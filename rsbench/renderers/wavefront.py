"""Tracing whole blocks of pixels at once with Dr.Jit (the variants ``llvm_ad_rgb`` and ``cuda_ad_rgb``).

A lane is one pixel. Embree traces neighbouring lanes together and does not guarantee that the rounding of a lane
is independent of its neighbours. So the lanes of a row are padded to whole packets: as no packet straddles rows, a
pixel has the same neighbours, and so the same bits, in a whole frame and in a row rendered alone.

A function that traces rays depends on the scene only through ``MitsubaScene.kernel_inputs``, and otherwise only on
its arguments. So Dr.Jit records its kernels once per scene and replays them for every other frame and row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary, proxy

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
from rsbench.renderers.sensor import LineRays, kernel_input

PACKET = 16
"""Largest number of lanes that are traced together (AVX-512)."""
LANES_PER_LAUNCH, _ON_GPU = 1 << 22, 8
"""Largest number of lanes of a launch, which bounds its memory, and the factor for a GPU, which idles between
launches. Larger work is split without changing any bit of the result."""

Float32Array = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class _Lanes:
    """Lanes for the pixels of a block of rows, repeated: inputs of the kernels.

    Rows and columns are computed inside the kernel, so that neither another size nor the alignment of host memory
    compiles a new one: a single row runs the same code as a whole frame.
    """

    number: Any
    """Number of each lane."""
    table: Any
    """Rows of the block in the frame."""
    rows: Any
    padded: Any
    """Lanes of a row."""
    width: Any

    @classmethod
    def of(cls, rows: Sequence[int], width: int, copies: int = 1) -> _Lanes:
        return cls(
            number=dr.arange(mi.UInt32, copies * len(rows) * _padded(width)),
            # Dr.Jit compiles a table of one entry to different code, hence the second entry.
            table=kernel_input(np.asarray([*rows, rows[-1]], dtype=np.uint32)),
            rows=dr.opaque(mi.UInt32, len(rows)),
            padded=dr.opaque(mi.UInt32, _padded(width)),
            width=dr.opaque(mi.UInt32, width),
        )

    @property
    def row(self) -> Any:
        return dr.gather(mi.UInt32, self.table, self.number // self.padded % self.rows)

    @property
    def column(self) -> Any:
        return self.number % self.padded

    @property
    def copy(self) -> Any:
        return self.number // self.padded // self.rows

    @property
    def active(self) -> Any:
        return self.column < self.width

    @property
    def pixel(self) -> Any:
        """Return the index of the pixel in the full frame."""
        return self.row * self.width + self.column

    def line(self, rays: LineRays) -> Any:
        """Return the row, or the column if the camera reads columns."""
        return self.column if rays.columns else self.row


def _on_host(channels: Sequence[Any], rows: int, width: int) -> Float32Array:
    """Convert Dr.Jit arrays with one entry per lane to a host array (rows, width, channels)."""
    dr.eval(channels)
    host = np.stack([np.array(each).reshape(rows, _padded(width))[:, :width] for each in channels], axis=-1)
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


_recorded: WeakKeyDictionary[MitsubaScene, dict[Callable[..., Any], Any]] = WeakKeyDictionary()
"""Recordings of the functions that trace rays in a scene."""
_RECORDINGS = 16
"""Largest number of recordings of a function: for cameras with and without a lens, an exposure or moving objects,
and for numbers of samples."""


def _traced(trace: Callable[..., Any], scene: MitsubaScene, *inputs: Any) -> Any:
    """Return ``trace(scene, *inputs)``, whose kernels are recorded, and replayed for other inputs of this kind.

    Among ``inputs``, a Python value is part of the recording, a Dr.Jit array is not.
    """
    functions = _recorded.setdefault(scene, {})
    if not functions:
        # The first recording turns the constants of all shapes into arrays, and only the next one merges equal
        # arrays: without it, each kernel would be compiled twice.
        functions[_nothing] = _recording(scene, _nothing)
        functions[_nothing](*inputs[:1])
    if trace not in functions:
        functions[trace] = _recording(scene, trace)
    return functions[trace](*inputs)


def _nothing(scene: MitsubaScene, rays: LineRays) -> Any:
    return rays.poses + 0


def _recording(scene: MitsubaScene, trace: Callable[..., Any]) -> Any:
    there = proxy(scene)  # a reference would keep the scene

    def traced_there(*inputs: Any) -> Any:
        return trace(there, *inputs)

    def state(*_: Any) -> Any:
        return there.kernel_inputs()

    return dr.freeze(traced_there, state_fn=state, auto_opaque=False, limit=_RECORDINGS, warn_after=1 << 30)


def depth_rows(scene: MitsubaScene, rays: LineRays, camera: PinholeCamera, rows: Sequence[int]) -> Hits:
    """Return the first hits of the rays through the pixel centres."""
    result = Hits.none(len(rows), camera.width)
    for place, band in _bands(rows, camera.width):
        found = _traced(_first_hits, scene, rays, _Lanes.of(band, camera.width))
        values = _on_host([*found.values()], len(band), camera.width)
        for number, name in enumerate(found):
            getattr(result, name)[place] = values[..., number]
    return result


def _first_hits(scene: MitsubaScene, rays: LineRays, lanes: _Lanes) -> dict[str, Any]:
    """Return what ``Hits`` contains, per lane."""
    active, line = lanes.active, lanes.line(rays)
    ray = mi.Ray3f(*rays.row_ray(mi.Float(lanes.column), mi.Float(lanes.row), line, active))
    if scene.objects:
        depth, label, bsdf = depth_and_label(scene, ray, active, placed(scene, rays, line, active))
        found = {"depth": depth, "labels": label}
    else:
        hit = scene.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        found, bsdf = {"depth": dr.select(hit.is_valid(), hit.t, 0)}, hit.shape.bsdf()
    if scene.glossy:
        found["gloss"] = dr.select(is_glossy(bsdf, active), mi.UInt32(1), 0)
    return found


def radiance_rows(
    scene: MitsubaScene, rays: LineRays, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Float32Array:
    """Return linear RGB (rows, width, 3): the mean over the sub-pixel grid (a box filter)."""
    band_total = _sunsky_band if options.integrator == "sunsky" else _path_band
    result = np.zeros((len(rows), camera.width, 3), dtype=np.float32)
    for place, band in _bands(rows, camera.width):
        total = band_total(scene, rays, camera, band, options)
        result[place] = _on_host([*total], len(band), camera.width) / np.float32(options.samples)
    return result


@dataclass(frozen=True, kw_only=True)
class _Samples:
    """Samples of a pixel, as inputs of the kernels."""

    count: Any
    seed: Any
    grid: Any
    """Positions (samples, 2) in the pixel."""
    exposed: int | None
    """Number of samples, if each has its own instant of an exposure."""

    @classmethod
    def of(cls, rays: LineRays, options: RendererOptions) -> _Samples:
        return cls(
            count=dr.opaque(mi.UInt32, options.samples),
            seed=dr.opaque(mi.UInt32, options.seed),
            grid=kernel_input(subpixel_grid(options.samples)),
            exposed=None if rays.instants == 1 else options.samples,
        )

    def offset(self, number: Any) -> tuple[Any, Any]:
        """Return the position of a sample, from the centre of its pixel."""
        return dr.gather(mi.Float, self.grid, 2 * number), dr.gather(mi.Float, self.grid, 2 * number + 1)

    def pose(self, rays: LineRays, lanes: _Lanes, number: Any) -> Any:
        """Return the index of the pose of a sample of each lane: its line's pose at an instant of the exposure."""
        if self.exposed is None:
            return lanes.line(rays)
        instant = instant_of(self.seed, lanes.pixel, number, self.exposed, rays.instants)
        return lanes.line(rays) + rays.lines * instant


def _sunsky_band(
    scene: MitsubaScene, rays: LineRays, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Any:
    """Render a band with ``sunsky``: return the sum of the samples of each lane."""
    above = sky_points(options.samples, options.sky_rays) if options.sky_rays else None
    return _traced(
        _sunsky_sum,
        scene,
        rays,
        _Lanes.of(rows, camera.width),
        _Samples.of(rays, options),
        options.sky_rays,
        None if above is None else kernel_input(above),
        kernel_input(facet_points(options.samples)) if scene.glossy else None,
    )


def _sunsky_sum(
    scene: MitsubaScene, rays: LineRays, lanes: _Lanes, samples: _Samples, sky_rays: int, above: Any, facets: Any
) -> Any:
    """Return the sum of the samples; the loop over them runs inside the kernel to keep memory constant."""
    x, y, active = mi.Float(lanes.column), mi.Float(lanes.row), lanes.active
    pixel = None if rays.lens is None else rays.lens.pixel(x, y, active)
    still = placed(scene, rays, lanes.line(rays), active) if samples.exposed is None else None

    def add_sample(k: Any, total: Any) -> tuple[Any, Any]:
        dx, dy = samples.offset(k)
        pose = samples.pose(rays, lanes, k)
        origin, direction = rays.row_ray(x + dx, y + dy, pose, active, pixel)
        ray = mi.Ray3f(origin, dr.normalize(direction))
        sky_points_here = [_entry(above, k * sky_rays + j) for j in range(sky_rays)]
        objects = placed(scene, rays, pose, active) if still is None else still
        facet = None if facets is None else mi.Point2f(*(dr.gather(mi.Float, facets, 2 * k + j) for j in (0, 1)))
        return k + 1, total + sunsky_radiance(scene, ray, active, sky_points_here, objects, facet)

    count = dr.width(lanes.number)
    _, total = dr.while_loop(
        state=(dr.zeros(mi.UInt32, count), dr.zeros(mi.Color3f, count)),
        cond=lambda k, total: k < samples.count,
        body=add_sample,
        labels=("sample", "total"),
    )
    return total


def _entry(table: Any, number: Any) -> Any:
    """Return a vector from a flat table with three numbers per entry."""
    return mi.Vector3f(*(dr.gather(mi.Float, table, 3 * number + k) for k in range(3)))


def _path_band(
    scene: MitsubaScene, rays: LineRays, camera: PinholeCamera, rows: Sequence[int], options: RendererOptions
) -> Any:
    """Render a band with ``path``, one lane per pixel and sample: return the sum of the samples of each pixel.

    The samples are split into passes, but summed in the same order for any number of passes.
    """
    # Loading within a recording would change its kernel, so all is loaded before.
    scene.textured()
    path_integrator(options.max_depth)
    lane_sampler()
    samples = _Samples.of(rays, options)
    count = len(rows) * _padded(camera.width)
    per_pass = max(1, _most_lanes() // count)
    total = dr.zeros(mi.Color3f, count)
    for first in range(0, options.samples, per_pass):
        copies = min(per_pass, options.samples - first)
        lanes = _Lanes.of(rows, camera.width, copies)
        which = [dr.opaque(mi.UInt32, number) for number in (first, copies)]
        total = _traced(_path_pass, scene, rays, lanes, samples, which, total, options.max_depth)
    return total


def _path_pass(
    scene: MitsubaScene,
    rays: LineRays,
    lanes: _Lanes,
    samples: _Samples,
    which: Sequence[Any],
    total: Any,
    max_depth: int,
) -> Any:
    """Return ``total`` plus the radiance of some samples of each pixel: the first one's number, and how many."""
    first, copies = which
    sample, sampler, active = lanes.copy + first, lane_sampler(), lanes.active
    dx, dy = samples.offset(sample)
    x, y = mi.Float(lanes.column) + dx, mi.Float(lanes.row) + dy
    origin, direction = rays.row_ray(x, y, samples.pose(rays, lanes, sample), active)
    sampler.seed_lanes(samples.seed, lanes.pixel, sample)
    ray = mi.RayDifferential3f(origin, dr.normalize(direction))
    radiance, _, _ = path_integrator(max_depth).sample(scene.textured(), sampler, ray, active=active)
    dr.eval(radiance)
    place, step = dr.arange(mi.UInt32, dr.width(total)), lanes.rows * lanes.padded

    def add_copy(k: Any, total: Any) -> tuple[Any, Any]:
        """Add the copies of each pixel's radiance to its total, one after another."""
        return k + 1, total + mi.Color3f(*(dr.gather(mi.Float, each, place + k * step) for each in radiance))

    _, total = dr.while_loop(
        state=(dr.zeros(mi.UInt32, dr.width(total)), total),
        cond=lambda k, total: k < copies,
        body=add_copy,
        labels=("copy", "total"),
    )
    return total
