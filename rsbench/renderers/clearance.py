"""Collision check of a motion: no camera of the rig goes through a wall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rsbench.core.geometry import MovingObject, RelativeMotion
from rsbench.core.motion import Motion
from rsbench.core.rig import SIDES, StereoRig
from rsbench.core.se3 import inverse
from rsbench.core.shutter import RollingShutter
from rsbench.core.so3 import FloatArray
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.visibility import REACH, blocked


def obstacle(
    scene: MitsubaScene,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    frames: int,
    objects: Sequence[MovingObject] = (),
) -> str:
    """What stands in the way of a camera, in words; "" where the way is free. ``objects`` of the scene move.

    Followed in straight steps, from the middle of the rig at time 0 to each camera, and on its way until the last
    row of the last of so many frames is read. A rig that starts inside a solid and stays there meets nothing.
    """
    tau = np.linspace(0.0, frames - 1 + shutter.readout_ratio, 1 + 2 * (frames - 1) * shutter.height)
    for side in SIDES:
        centres = inverse(rig.cam_from_world(motion, tau, side)).t
        step = first_crossing(scene.scene, np.concatenate([np.zeros((1, 3)), centres]))
        if step == 0:
            return f"there is a surface between the middle of the rig and the {side} camera"
        if step is not None:
            return f"the {side} camera goes through a surface at time {tau[step - 1]:.3f}"
        for number, (own, each) in enumerate(zip(scene.objects, objects, strict=True), start=1):
            centres = inverse(rig.cam_from_world(RelativeMotion(motion, each), tau, side)).t
            if (step := first_crossing(own, centres)) is not None:
                return f"the {side} camera and moving object {number} meet at time {tau[step]:.3f}"
    return ""


def first_crossing(scene: Any, points: FloatArray) -> int | None:
    """The first straight step, from point k of (n, 3), metres, to the next, that meets a surface; None: none.

    ``scene`` is one of Mitsuba.
    """
    steps = np.diff(points, axis=0)
    moving = np.flatnonzero(np.any(steps, axis=1))
    if not len(moving):
        return None
    starts = points[moving]
    met = moving[blocked(scene, starts, starts + steps[moving] / REACH)]
    return int(met[0]) if len(met) else None
