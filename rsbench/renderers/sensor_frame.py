"""A rolling-shutter frame as a camera delivers it: exposed, with noise, interpolated and compressed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rsbench.core.motion import Motion
from rsbench.core.moving_objects import MovingObject, poses_of
from rsbench.core.rig import Side, StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.renderers.electrons import Sensor, expose
from rsbench.renderers.exposure import instant_count, instant_times
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.processing import processed, rows_needed
from rsbench.renderers.render import render
from rsbench.renderers.scene import MitsubaScene


def sensed_rows(
    scene: MitsubaScene,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    sensor: Sensor,
    frame_period_s: float,
    side: Side,
    frame: int,
    options: RendererOptions,
    rows: Sequence[int] | None = None,
    objects: Sequence[MovingObject] = (),
) -> NDArray[np.uint8]:
    """Rows (rows, width, 3) of a frame, all by default; 8-bit sRGB.

    Args:
        scene: in the world frame of the motion.
        rig: camera and baseline.
        shutter: the middle of a row's exposure is its time.
        motion: of the rig's body.
        sensor: of this camera and frame.
        frame_period_s: seconds of a frame period, in which the motion counts.
        side: of the rig.
        frame: 0 or 1.
        options: how to render; their seed is that of the image, of the noise too.
        rows: these only, with the bits that they have in the whole frame.
        objects: those of the scene that move.
    """
    tau = shutter.line_times(frame, side)
    exposed, blurred = None, poses_of(objects, tau)
    own = blurred
    if sensor.exposure_s:
        instants = instant_times(tau, sensor.exposure_s / frame_period_s, instant_count(options.samples))
        exposed, blurred = rig.cam_from_world(motion, instants, side), poses_of(objects, instants)
    chosen = range(shutter.height) if rows is None else rows
    R, t = rig.cam_from_world(motion, tau, side)
    options, columns = replace(options, full_frames=False), shutter.axis(side) == 0
    needed = rows_needed(sensor, chosen, shutter.height)
    light = render(
        scene,
        rig.camera,
        R,
        t,
        options,
        exposed=exposed,
        objects=own,
        exposed_objects=blurred,
        rows=needed,
        columns=columns,
    ).image
    read = expose(light * np.float32(options.exposure), sensor, options.seed, shutter.height, needed)
    return processed(read, sensor, shutter.height, needed, chosen)
