"""Whether anything stands between an eye and a point: the rays that decide what hides what."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.core.so3 import FloatArray
from rsbench.renderers.scene import MitsubaScene
from rsbench.renderers.sensor import LEAST_COMPONENT

REACH = 1.0 - 1e-4
"""Share of the way to the point that must be free. The rest is the point's own surface: rays and points are
rounded to float32, so a ray that grazes a surface meets it a little early."""


def blocked(scene: MitsubaScene, eyes: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """Whether a surface stands before points (n, 3), seen from ``eyes`` (n, 3); world frame, metres."""
    import drjit as dr
    import mitsuba as mi

    origins, ways = eyes.astype(np.float32), (points - eyes).astype(np.float32)
    ways[np.abs(ways) < LEAST_COMPONENT] = 0.0
    if dr.is_jit_v(mi.Float):
        ray: Any = mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(ways.T))
        ray.maxt = REACH
        return np.array(scene.scene.ray_test(ray, coherent=True), dtype=np.bool_)
    found = np.zeros(len(eyes), dtype=np.bool_)
    for number, (origin, way) in enumerate(zip(origins.tolist(), ways.tolist(), strict=True)):
        ray = mi.Ray3f(origin, way)
        ray.maxt = REACH
        found[number] = scene.scene.ray_test(ray)
    return found
