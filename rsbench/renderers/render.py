"""Rendering rolling-shutter images and their exact depth from row poses.

Two methods make the same frame. ``stitched`` is how the paper made its data: a whole global-shutter image at the
pose of every row, of which one row is kept. ``single-pass`` gives every ray the pose of its row in one kernel, at
the price of one global-shutter image. They agree bit for bit, in image and depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core.camera import PinholeCamera
from rsbench.errors import RsbenchError
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import make_sensor, pose_table

Float32Array = NDArray[np.float32]
OnGlobalFrame = Callable[[int, Float32Array], None]


@dataclass(frozen=True, kw_only=True)
class Frame:
    """An image and its depth; the rows asked for, in that order (all ``height`` of them by default)."""

    image: Float32Array
    """(rows, width, 3) linear RGB radiance."""
    depth: Float32Array
    """(rows, width) z in the camera of the row, metres, at pixel centres; 0 = no surface."""


def render(
    scene: MitsubaScene,
    camera: PinholeCamera,
    rotations: ArrayLike,
    translations: ArrayLike,
    options: RendererOptions | None = None,
    *,
    rows: Sequence[int] | None = None,
    on_gs_frame: OnGlobalFrame | None = None,
) -> Frame:
    """Render a frame whose every row has its own pose, by ``options.method``.

    Args:
        scene: in the world frame of the poses.
        camera: size and intrinsics; the centre of the top-left pixel is (0, 0).
        rotations: (height, 3, 3) ``cam_from_world`` of each row.
        translations: (height, 3) metres, ``X_cam = R @ X_world + t``; equal rows make a global shutter.
        options: a renderer card; the default one when absent.
        rows: render only these rows of the full frame, with the bits that they have in it.
        on_gs_frame: ``stitched`` with ``full_frames`` calls it with each row and its global-shutter image
            (height, width, 3), so that the stack can be kept as the paper keeps it.

    Raises:
        RsbenchError: shapes or values of the poses, rows outside the image, ``on_gs_frame`` without whole frames.
    """
    options = RendererOptions() if options is None else options
    if on_gs_frame is not None and not (options.method == "stitched" and options.full_frames):
        raise RsbenchError("on_gs_frame needs renderer method = 'stitched' and full_frames = true")
    chosen = _checked_rows(rows, camera.height)
    if options.method == "single-pass":
        return _single_pass(scene, camera, rotations, translations, options, chosen)
    return _stitched(scene, camera, rotations, translations, options, chosen, on_gs_frame)


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
    options = RendererOptions() if options is None else options
    R, t = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
    if R.shape != (3, 3) or t.shape != (3,):
        raise RsbenchError(f"camera pose has shapes {R.shape} and {t.shape}: (3, 3) and (3,) are needed")
    rows = range(camera.height)
    R, t = np.broadcast_to(R, (camera.height, 3, 3)), np.broadcast_to(t, (camera.height, 3))
    return _single_pass(scene, camera, R, t, options, rows)


def _single_pass(
    scene: MitsubaScene,
    camera: PinholeCamera,
    rotations: ArrayLike,
    translations: ArrayLike,
    options: RendererOptions,
    rows: Sequence[int],
) -> Frame:
    tracer = _tracer()
    sensor = make_sensor(camera, rotations, translations)
    return Frame(
        image=tracer.radiance_rows(scene, sensor, camera, rows, options),
        depth=tracer.depth_rows(scene, sensor, camera, rows),
    )


def _stitched(
    scene: MitsubaScene,
    camera: PinholeCamera,
    rotations: ArrayLike,
    translations: ArrayLike,
    options: RendererOptions,
    rows: Sequence[int],
    on_gs_frame: OnGlobalFrame | None,
) -> Frame:
    """One global-shutter camera per row. Without ``full_frames`` only the kept row of each is traced.

    The pixels of that row keep their index in the full frame, hence their random numbers, and their neighbours in
    a packet, hence their rounding: they have the bits of the whole image.
    """
    tracer = _tracer()
    table = pose_table(camera, rotations, translations)
    sensor = make_sensor(camera, rotations, translations)
    image = np.zeros((len(rows), camera.width, 3), dtype=np.float32)
    depth = np.zeros((len(rows), camera.width), dtype=np.float32)
    for place, row in enumerate(rows):
        sensor.set_poses(np.tile(table[row], (camera.height, 1)))
        if options.full_frames:
            gs_image = tracer.radiance_rows(scene, sensor, camera, range(camera.height), options)
            gs_depth = tracer.depth_rows(scene, sensor, camera, range(camera.height))
            image[place], depth[place] = gs_image[row], gs_depth[row]
            if on_gs_frame is not None:
                on_gs_frame(row, gs_image)
        else:
            image[place] = tracer.radiance_rows(scene, sensor, camera, [row], options)[0]
            depth[place] = tracer.depth_rows(scene, sensor, camera, [row])[0]
    return Frame(image=image, depth=depth)


def _checked_rows(rows: Sequence[int] | None, height: int) -> Sequence[int]:
    if rows is None:
        return range(height)
    outside = [row for row in rows if not 0 <= row < height]
    if outside or len(rows) == 0:
        raise RsbenchError(f"rows = {list(rows)}: at least one row between 0 and {height - 1} is needed")
    return [int(row) for row in rows]


def _tracer() -> ModuleType | Any:
    import drjit as dr
    import mitsuba as mi

    if dr.is_jit_v(mi.Float):
        from rsbench.renderers import wavefront

        return wavefront
    from rsbench.renderers import onebyone

    return onebyone
