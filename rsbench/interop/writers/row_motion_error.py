"""Error, px, of a format's model of how a camera moves while it reads, against the true motion."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rsbench.core.se3 import Pose, transform
from rsbench.core.so3 import FloatArray
from rsbench.dataset.sequence import Sequence
from rsbench.interop.writers.image_poses import View
from rsbench.interop.writers.surface_points import Points, world_points

Law = Callable[[View, Points], FloatArray]
"""Pixels (n, 2), in our convention, at which a format says that the lines of ``points.pixels`` see the points."""
_TRIED = 5_000
"""Pixels of each image."""


def largest_error(sequence: Sequence, views: list[View], law: Law) -> float:
    """The largest distance, px, between where frames see points of their depth, and where a format's law has them.

    Each point is moved by the law's pose of the line that truly saw it. 0 where no image has depth.
    """
    camera = sequence.rig.camera
    step = max(math.ceil(math.sqrt(camera.width * camera.height / _TRIED)), 1)
    worst = 0.0
    for view in views:
        points = world_points(sequence, view, "rs", step)
        away = np.linalg.norm(law(view, points) - points.pixels, axis=-1)
        if len(away):  # NaN: behind the camera of the law, which is far off
            worst = max(worst, float(np.max(np.nan_to_num(away, nan=math.inf))))
    return worst


def seen_by(sequence: Sequence, poses: Pose, world: FloatArray) -> FloatArray:
    """Pixels (n, 2) of world points (n, 3) from poses ``cam_from_world`` (n, 3, 3), (n, 3)."""
    return sequence.rig.camera.project(transform(poses, world))


def lines_of(sequence: Sequence, view: View, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many lines were read before those of pixels (n, 2)."""
    shutter = sequence.shutter
    lines = pixels[:, shutter.axis(view.side)]
    return np.abs(lines - shutter.first_line(view.side))


def told(error_px: float, law: str) -> list[str]:
    """A sentence where the law is not exact: 1e-6 px is what reading our own numbers back is held to."""
    if error_px < 1e-6:
        return []
    return [f"the format's motion of the rows ({law}) is up to {error_px:.2g} px from the true one"]
