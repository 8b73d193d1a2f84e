"""Rendering rolling-shutter images and their exact depth from row poses.

Two methods render the same frame. ``stitched`` is the method of the paper: it renders a whole global-shutter image
at the pose of every row and keeps one row. ``single-pass`` gives every ray the pose of its row in one kernel, at
the cost of one global-shutter image. Their images and depths agree bit for bit. ``sensed_rows`` renders the frame
as a camera delivers it: with exposure, noise, demosaicing and compression.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.geometry import Geometry, poses_of
from rsbench.core.rig import View
from rsbench.core.se3 import Pose
from rsbench.core.so3 import FloatArray
from rsbench.renderers import scalar_tracing, wavefront
from rsbench.renderers.image import Sensor, expose, processed, rows_needed
from rsbench.renderers.integrators import Hits
from rsbench.renderers.mitsuba_modules import dr, mi
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.pixel_samples import instant_count, instant_times
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LineRays, object_tables, pose_table

Float32Array = NDArray[np.float32]
OnGlobalFrame = Callable[[int, Float32Array], None]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """The requested rows of an image and its depth, in that order (by default, all ``height`` rows)."""

    image: Float32Array
    """(rows, width, 3) linear RGB radiance."""
    depth: Float32Array
    """(rows, width) z in the camera frame of the row, metres, at pixel centres; 0 = no surface."""
    labels: NDArray[np.uint8]
    """(rows, width) number of the moving object at pixel centres, 0 = none; see ``integrators.SHADED``."""
    gloss: NDArray[np.bool_]
    """(rows, width) whether the surface at the pixel centre is glossy."""


class LinePoses(NamedTuple):
    """Poses of the camera and of moving objects at the times when each line of a frame is read or exposed."""

    R: ArrayLike
    """([instants,] lines, 3, 3) ``cam_from_world``."""
    t: ArrayLike
    """([instants,] lines, 3) metres, ``X_cam = R @ X_world + t``; equal poses in all lines: a global shutter."""
    objects: Pose | None = None
    """(objects, [instants,] lines, ...) ``world_from_object`` of the scene's moving objects."""
    columns: bool = False
    """Whether lines are columns instead of rows."""


def render(
    scene: MitsubaScene,
    camera: PinholeCamera,
    poses: LinePoses,
    options: RendererOptions | None = None,
    *,
    exposed: LinePoses | None = None,
    rows: Sequence[int] | None = None,
    on_gs_frame: OnGlobalFrame | None = None,
) -> Frame:
    """Render a frame in which every line has its own poses, by ``options.method``.

    Args:
        scene: scene in the world frame of the poses.
        camera: size and intrinsics; the centre of the top-left pixel is (0, 0).
        poses: poses of each line at its time.
        options: options of the renderer, by default those of the default card.
        exposed: poses of each line at the instants of its exposure, see ``pixel_samples``; the image is the mean
            over the instants, the depth is that of ``poses``. ``options.samples`` must divide their number.
        rows: render only these rows of the full frame; their bits are the same as in the full frame.
        on_gs_frame: called by ``stitched`` with ``full_frames`` with each row and its global-shutter image
            (height, width, 3), so that the stack of images can be kept as in the paper.

    Raises:
        RsbenchError: poses have wrong shapes or values, rows lie outside the image, or ``on_gs_frame`` is given
            without whole frames.
    """
    options = RendererOptions() if options is None else options
    if on_gs_frame is not None and not (options.method == "stitched" and options.full_frames):
        raise RsbenchError("on_gs_frame needs renderer method = 'stitched' and full_frames = true")
    chosen = _checked_rows(rows, camera.height)
    image_poses = poses if exposed is None else exposed._replace(columns=poses.columns)
    for each in (poses, image_poses):
        _check_objects(scene, each.objects, options)
    if exposed is not None and (instants := len(np.asarray(exposed.R))) % options.samples:
        raise RsbenchError(f"{instants} instants: a multiple of the {options.samples} samples is needed")
    if options.method == "single-pass":
        return _single_pass(scene, camera, (image_poses, poses), options, chosen)
    return _stitched(scene, camera, (image_poses, poses), options, chosen, on_gs_frame)


def render_global(
    scene: MitsubaScene,
    camera: PinholeCamera,
    rotation: ArrayLike,
    translation: ArrayLike,
    options: RendererOptions | None = None,
) -> Frame:
    """Render a global-shutter frame: all rows at the pose ``rotation`` (3, 3), ``translation`` (3,) metres.

    Raises:
        RsbenchError: the pose has the wrong shape or is not finite.
    """
    R, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    if R.shape != (3, 3) or t.shape != (3,):
        raise RsbenchError(f"camera pose has shapes {R.shape} and {t.shape}: (3, 3) and (3,) are needed")
    poses = LinePoses(np.broadcast_to(R, (camera.height, 3, 3)), np.broadcast_to(t, (camera.height, 3)))
    return render(scene, camera, poses, replace(options or RendererOptions(), method="single-pass"))


def _single_pass(
    scene: MitsubaScene,
    camera: PinholeCamera,
    poses: tuple[LinePoses, LinePoses],
    options: RendererOptions,
    rows: Sequence[int],
) -> Frame:
    """Render by ``single-pass``; ``poses`` are those of the image and those of the depth."""
    tracer = _tracer()
    image_rays, row_rays = (_rays(camera, each) for each in poses)
    image = tracer.radiance_rows(scene, image_rays, camera, rows, options)
    return Frame(image=image, **tracer.depth_rows(scene, row_rays, camera, rows)._asdict())


def _stitched(
    scene: MitsubaScene,
    camera: PinholeCamera,
    poses: tuple[LinePoses, LinePoses],
    options: RendererOptions,
    rows: Sequence[int],
    on_gs_frame: OnGlobalFrame | None,
) -> Frame:
    """Render one global-shutter image per row. Without ``full_frames`` only the kept row of each is traced.

    The pixels of that row keep their index in the full frame and their neighbours in a packet, and so their random
    numbers and rounding: they have the bits of the whole image. For columns, all rows are traced.
    """
    tracer, columns = _tracer(), poses[0].columns
    rays = [_rays(camera, each) for each in poses]
    tables = [
        [pose_table(camera, each.R, each.t, columns), *object_tables(camera, each.objects, columns)]
        for each in poses
    ]
    image = np.zeros((len(rows), camera.width, 3), dtype=np.float32)
    hits = Hits.none(len(rows), camera.width)
    for place, line in enumerate(range(camera.width) if columns else rows):
        for each, own in zip(rays, tables, strict=True):
            one, *others = (np.repeat(t[..., line : line + 1, :], t.shape[-2], axis=-2) for t in own)
            each.set_poses(one)
            each.set_objects(others)
        traced = rows if columns else range(camera.height) if options.full_frames else [line]
        gs_image = tracer.radiance_rows(scene, rays[0], camera, traced, options)
        gs_hits = tracer.depth_rows(scene, rays[1], camera, traced)
        kept = line if options.full_frames else 0
        to, of = (np.s_[:, line], np.s_[:, line]) if columns else (np.s_[place], np.s_[kept])
        for result, whole in zip((image, *hits), (gs_image, *gs_hits), strict=True):
            result[to] = whole[of]
        if on_gs_frame is not None:
            on_gs_frame(line, gs_image)
    return Frame(image=image, **hits._asdict())


def _rays(camera: PinholeCamera, poses: LinePoses) -> LineRays:
    return LineRays.of(camera, poses.R, poses.t, poses.objects, columns=poses.columns)


def _check_objects(scene: MitsubaScene, objects: Pose | None, options: RendererOptions) -> None:
    given = 0 if objects is None else len(objects.R)
    if given != len(scene.objects):
        raise RsbenchError(f"poses of {given} objects that move: scene {scene.name!r} has {len(scene.objects)}")
    if given and options.integrator != "sunsky":
        raise RsbenchError(
            f"renderer integrator = {options.integrator!r}: takes no objects that move; take 'sunsky'"
        )


def _checked_rows(rows: Sequence[int] | None, height: int) -> Sequence[int]:
    if rows is None:
        return range(height)
    outside = [row for row in rows if not 0 <= row < height]
    if outside or len(rows) == 0:
        raise RsbenchError(f"rows = {list(rows)}: at least one row between 0 and {height - 1} is needed")
    return [int(row) for row in rows]


def _tracer() -> ModuleType:
    return wavefront if dr.is_jit_v(mi.Float) else scalar_tracing


def sensed_rows(
    scene: MitsubaScene,
    geometry: Geometry,
    view: View,
    sensor: Sensor,
    frame_period_s: float,
    options: RendererOptions,
    rows: Sequence[int] | None = None,
    twin: int | None = None,
) -> NDArray[np.uint8]:
    """Render rows (rows, width, 3) of a frame, by default all, as 8-bit sRGB of a simulated sensor.

    Args:
        scene: scene in the world frame of the motion.
        geometry: rig, shutter and motion; the time of a row is the middle of its exposure.
        view: side of the rig and number of the frame.
        sensor: sensor of this camera and frame.
        frame_period_s: frame period, seconds; the motion's unit of time.
        options: options of the renderer; their seed is also that of the sensor noise.
        rows: render only these rows; their bits are the same as in the whole frame.
        twin: a row, in readout order, at whose time all rows are exposed, as by a global shutter.
    """
    rig, shutter, (side, frame) = geometry.rig, geometry.shutter, view
    tau = shutter.line_times(frame, side)
    if twin is not None:
        tau = np.full(tau.shape, tau[abs(shutter.first_line(side) - twin)])

    def poses(tau: FloatArray) -> LinePoses:
        camera = rig.cam_from_world(geometry.motion, tau, side)
        return LinePoses(*camera, poses_of(geometry.objects, tau), columns=shutter.axis(side) == 0)

    exposed = None
    if sensor.exposure_s:
        exposed = poses(instant_times(tau, sensor.exposure_s / frame_period_s, instant_count(options.samples)))
    camera = rig.sensor(side)
    chosen = range(camera.height) if rows is None else rows
    options = replace(options, full_frames=False)
    needed = rows_needed(sensor, chosen, camera.height)
    light = render(scene, camera, poses(tau), options, exposed=exposed, rows=needed).image
    read = expose(light * np.float32(options.exposure), sensor, options.seed, camera.height, needed)
    return processed(read, sensor, camera.height, needed, chosen)
