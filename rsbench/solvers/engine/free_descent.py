"""Least squares of the Sampson errors of one camera with free velocities in both frames.

The length of T(s0, s1), beside that of t, is undetermined where its direction and the rotation are the same for
all rows: any factor 1 + a s1 - b s0 leaves every constraint as it is. A constant velocity is that but for terms of
second order, so that two of the velocities' numbers are lost in noise of 1e-3 px, and least squares alone lets T
vanish in the middle of the image. What is minimised is therefore the most probable motion for velocities that in a
whole frame lead as far as t, within a standard deviation: with C the sum of squares of n matches,

    C (1 + (|v0|^2 + |v1|^2) (height / fy)^2 / n),

which on exact matches has its minimum at the truth.

The unknowns are a turn of R, t on the unit sphere, and half the sum and the difference of the velocities of both
frames in one frame's axes: both frames see a point at nearly the same row, and of slow motion the difference alone
is well determined.
"""

from __future__ import annotations

import numpy as np

from rsbench.core.so3 import FloatArray
from rsbench.solvers.engine.free_minimum import descend
from rsbench.solvers.engine.free_velocities import FreeMotion, Rows
from rsbench.solvers.engine.generalised_essential import places

_EXACT_PX, _EXACT = 1e-11, 1e-14
"""Root mean square errors, and misfit of unit coefficients, that rounding leaves."""


def refine(start: FreeMotion, rows: Rows, *, turning: bool, most: int) -> tuple[FreeMotion, float]:
    """Where a descent from a start ends, and what was minimised, px^2; the start where matches are too few.

    Args:
        turning: whether the camera turns within a frame.
        most: evaluations.
    """
    unknowns, camera = 17 if turning else 11, rows.camera
    if len(rows.x) < unknowns:
        return start, np.inf
    if not turning:
        start = start._replace(w0=np.zeros(3), w1=np.zeros(3))
    R, vectors, focal = np.array(start.R), np.stack(start[1:]), np.array([camera.fx, camera.fy])
    slowness, exact = (camera.height / camera.fy) ** 2 / len(rows.x), len(rows.x) * _EXACT_PX**2
    cost = descend(R, vectors, unknowns, most, exact, rows.packed(), focal, slowness, np.zeros(0), places(1))
    return FreeMotion(R, *vectors), cost


def nearest(start: FreeMotion, F: FloatArray, degree: int, most: int) -> tuple[FreeMotion, float]:
    """The motion whose unit coefficients (see ``generalised_essential``) have least across F, and its square."""
    R, vectors, unknowns = np.array(start.R), np.stack(start[1:]), 11 if degree == 1 else 17
    cost = descend(
        R,
        vectors,
        unknowns,
        most,
        _EXACT**2,
        np.zeros((0, 6)),
        np.ones(2),
        0.0,
        F / np.linalg.norm(F),
        places(degree),
    )
    return FreeMotion(R, *vectors), cost
