"""Angular rates and specific forces at the rig's body, exactly: what an ideal inertial sensor measures.

The sensor stands at the body's origin with the body's axes: x right, y down, z forward.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rsbench.core import so3
from rsbench.core.motion import Motion
from rsbench.core.so3 import FloatArray

STANDARD_GRAVITY = 9.80665
"""m/s^2 (3rd CGPM, 1901)."""


class Inertial(NamedTuple):
    """What ideal sensors show; (..., 3) in the axes of the body."""

    turn: FloatArray
    """Angular velocity of the body, rad/s."""
    force: FloatArray
    """Specific force, acceleration less gravity, m/s^2: at rest it points up."""


def inertial(motion: Motion, tau: ArrayLike, frame_period_s: float, gravity: ArrayLike) -> Inertial:
    """What is felt at times ``tau`` (...), frame periods.

    With u = t' - w' x t the body's origin moves in the world by p' = -R^T u, and so p'' = R^T (w' x u - u').
    ``Motion`` carries points from the world into the body, hence the signs: the body turns by -w'.

    Args:
        motion: of the body.
        tau: times (...).
        frame_period_s: seconds of a frame period.
        gravity: (3,) acceleration of a free fall in the world frame, m/s^2.
    """
    R, t = motion.body_from_world(tau)
    w, speed = motion.velocity(tau)
    turn_change, speed_change = motion.accelerations(tau)
    u = speed - so3.cross(w, t)
    u_change = speed_change - so3.cross(turn_change, t) - so3.cross(w, speed)
    acceleration = (so3.cross(w, u) - u_change) / frame_period_s**2
    return Inertial(-w / frame_period_s, acceleration - R @ np.asarray(gravity, dtype=np.float64))
