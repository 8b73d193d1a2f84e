"""A rolling-shutter frame as a camera delivers it: exposed, with noise, interpolated and compressed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rsbench.core.geometry import Geometry, poses_of
from rsbench.core.rig import View
from rsbench.core.so3 import FloatArray
from rsbench.renderers.electrons import Sensor, expose
from rsbench.renderers.exposure import instant_count, instant_times
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.processing import processed, rows_needed
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene


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
    """Rows (rows, width, 3) of a frame, all by default; 8-bit sRGB.

    Args:
        scene: in the world frame of the motion.
        geometry: the middle of a row's exposure is its time.
        view: side of the rig and number of the frame.
        sensor: of this camera and frame.
        frame_period_s: seconds of a frame period, in which the motion counts.
        options: how to render; their seed is that of the image, of the noise too.
        rows: these only, with the bits that they have in the whole frame.
        twin: all rows are exposed about the time of this row, counted as rows are read, as by a global shutter.
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
    chosen = range(shutter.height) if rows is None else rows
    options = replace(options, full_frames=False)
    needed = rows_needed(sensor, chosen, shutter.height)
    light = render(scene, rig.camera, poses(tau), options, exposed=exposed, rows=needed).image
    read = expose(light * np.float32(options.exposure), sensor, options.seed, shutter.height, needed)
    return processed(read, sensor, shutter.height, needed, chosen)
